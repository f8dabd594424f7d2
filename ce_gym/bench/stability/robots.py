"""Endurance of whole robots: ten minutes of standing, a base that spins, random torques, single precision."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.sim import Simulator

Array = NDArray[np.float64]

DT = 0.005
SETTLED = 60.0
"""When drift starts to count [s]."""
SPIN, SPIN_TIME = 50.0, 10.0
"""Speed of the base [rad/s], and for how long it is watched [s]."""
SPIN_STEP = 0.001
"""Time step of the spin [s]."""
DIRECTIONS = 8
HELD = 4
"""Steps for which a random torque is held."""
CROWD = 2000
"""Robots under random torques."""
BOUNDLESS = 10.0
"""Torque of a motor that has no limit [N m]."""


@dataclass(frozen=True)
class Standing:
    """A robot that stands.

    Attributes:
        drift: How far its base moves [m].
        turn: How far it turns [rad].
        speed: Largest root mean square speed at any of the looks [m/s and rad/s].
    """

    drift: float
    turn: float
    speed: float


def stand(model: Model, time: float) -> Standing:
    """Let a robot hold its standing pose; drift counts from SETTLED on, for `time` [s]."""
    sim = Simulator(model, 1, DT, outputs=())
    target = model.standing_q[7:]
    sim.step(target, round(SETTLED / DT))
    start, drift, turn, speed = sim.q[0], 0.0, 0.0, 0.0
    for _ in range(max(1, round(time / 10.0))):
        sim.step(target, round(10.0 / DT))
        q = sim.q[0]
        drift = max(drift, float(np.linalg.norm(q[:3] - start[:3])))
        turn = max(turn, 2 * math.acos(min(1.0, abs(float(q[3:7] @ start[3:7])))))
        speed = max(speed, float(np.sqrt(np.mean(sim.v[0] ** 2))))
    if sim.diverged.any():
        return Standing(math.inf, math.inf, math.inf)
    return Standing(drift, turn, speed)


def spin(model: Model) -> tuple[int, float]:
    """Spin robots about random axes at SPIN, far above the ground, motors holding the standing pose.

    Returns:
        How many diverged, and the highest kinetic energy as a share of that at the start.
    """
    sim = Simulator(model, DIRECTIONS, SPIN_STEP, contacts=(), outputs=())
    axes = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    v = np.zeros((DIRECTIONS, model.nv))
    v[:, :3] = SPIN * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    R = model.body_poses(model.standing_q)[1][0]
    v[:, 3:6] = np.cross(centre_of_mass(model) @ R, v[:, :3])  # turning about the centre of mass, which falls
    sim.set_state(model.standing_q, v)
    start, highest = turning_energy(model, sim, 0.0), 0.0
    for i in range(round(SPIN_TIME / 0.1)):
        sim.step(model.standing_q[7:], round(0.1 / SPIN_STEP))
        highest = max(highest, float((turning_energy(model, sim, 0.1 * (i + 1)) / start).max()))
    return int(sim.diverged.sum()), highest


def turning_energy(model: Model, sim: Simulator, time: float) -> Array:
    """Return kinetic energies without that of the fall since the start [J], shape (num_envs,)."""
    kinetic, _ = model.energy(sim.q, sim.v)
    return kinetic - model.total_mass * (9.81 * time) ** 2 / 2


def centre_of_mass(model: Model) -> Array:
    """Return the centre of mass in the standing pose, from the base's origin [m], shape (3,)."""
    M = model.mass_matrix(model.standing_q)
    return np.array([M[2, 4], M[0, 5], M[1, 3]]) / M[3, 3]


def fuzz(model: Model, robot_steps: int, retry: int = 0) -> int:
    """Drive robots by random torques up to their motors' limits; return how many diverge.

    Args:
        model: The robot at a transmission level.
        robot_steps: Sub-steps of all robots together.
        retry: How often a step that fails may be halved.
    """
    sim = Simulator(model, CROWD, DT, control="torque", outputs=(), retry=retry)
    torques = np.array([model.robot.body(joint).joint.torque for joint in model.joint_links])
    torques = np.where(np.isfinite(torques), torques, BOUNDLESS)
    rng = np.random.default_rng(0)
    for _ in range(math.ceil(robot_steps / CROWD / HELD)):
        sim.step(rng.uniform(-1.0, 1.0, (CROWD, len(torques))) * torques, HELD)
    return int(sim.diverged.sum())


def precisions(model: Model) -> tuple[float, float, float]:
    """Drop a robot in double and in single precision.

    Returns:
        How far apart the two are after 1 s and after 30 s, largest difference in the positions [m and rad], and the
        root mean square speed of the second at rest [m/s and rad/s].
    """
    sims = [Simulator(model, 1, DT, dtype, outputs=()) for dtype in ("float64", "float32")]
    q, target = model.standing_q.copy(), model.standing_q[7:]
    q[2] += 0.05
    apart = []
    for sim in sims:
        sim.set_state(q, np.zeros(model.nv))
    for time in (1.0, 29.0):
        for sim in sims:
            sim.step(target, round(time / DT))
        apart.append(math.inf if any(s.diverged.any() for s in sims) else float(np.abs(sims[0].q - sims[1].q).max()))
    return apart[0], apart[1], float(np.sqrt(np.mean(sims[1].v.astype(np.float64) ** 2)))
