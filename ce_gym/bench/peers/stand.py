"""Scene of the speed benchmark: robots stand on the ground while their joint targets jitter."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ce_gym.export.mujoco_batch import Batch
from ce_gym.export.mujoco_coordinates import Coordinates, joint_rows
from ce_gym.model import Robot
from ce_gym.sim import Simulator

Array = NDArray[np.float64]

JITTER = 0.05
"""Largest distance of a target from the standing pose [rad]."""

HOLD = 0.02
"""Time between two targets [s]."""

SETTLE, WATCH = 1.0, 1.0
"""Time before the observation of standing robots, and length of the observation [s]."""


LARGEST_SLIP = 0.1
"""Largest allowed gear error at a rotor of a peer [rad]."""


@dataclass(frozen=True)
class Behaviour:
    """Behaviour of standing robots during the observation.

    Attributes:
        finite: Whether no robot diverged.
        height: Lowest base origin, as a fraction of the standing pose's [-].
        speed: Root mean square of the independent velocities [rad/s and m/s].
        contacts: Mean number of contacts at the end.
        slip: Largest gear error at a rotor [rad].
    """

    finite: bool
    height: float
    speed: float
    contacts: float
    slip: float

    def like(self, reference: Behaviour) -> bool:
        """Return whether robots stand as in a reference: upright, gears engaged, at most 1.5 times the speed."""
        engaged = self.slip <= LARGEST_SLIP
        return self.finite and engaged and self.height > 0.75 and self.speed <= 1.5 * reference.speed


def bare(robot: Robot, contacts: str) -> Robot:
    """Return a robot with one group of contacts ("all" keeps all groups) and without visual shapes."""
    kept = tuple(contact for contact in robot.contacts if contacts in ("all", contact.group))
    bodies = tuple(replace(body, shapes=()) for body in robot.bodies)
    return replace(robot, contacts=kept, bodies=bodies)


def targets(robot: Robot, num_envs: int, n_targets: int, seed: int) -> Array:
    """Return jittered position targets [rad], shape (num_envs, n_targets, n_joints)."""
    pose = dict(robot.pose.joints)
    stand = np.array([pose.get(name, 0.0) for name in robot.independent])
    rng = np.random.default_rng(seed)
    return stand + rng.uniform(-JITTER, JITTER, (num_envs, n_targets, len(stand)))


def watch_mujoco(batch: Batch, robot: Robot, coordinates: Coordinates) -> Behaviour:
    """Let MuJoCo's robots settle, and return their behaviour; the robots then still stand."""
    n = round(HOLD / batch.model.opt.timestep)
    before, after = round(SETTLE / HOLD), round(WATCH / HOLD)
    control = np.repeat(targets(robot, batch.num_envs, before + after, seed=1), n, axis=1)
    batch.reset()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        states = batch.trajectory(control)
    batch.states[:] = states[:, -1]
    q, v = batch.split(states[:, before * n :])
    base = (7, 6) if robot.floating else (0, 0)
    rows = joint_rows(batch.model)
    joints = [rows[name][1] for name in robot.independent]
    spanning = q[..., base[0] :]
    y = spanning[..., [i - base[1] for i in joints]]
    slip = spanning - y @ coordinates.to_positions.T - coordinates.offset
    return Behaviour(
        finite=not batch.diverged and bool(np.isfinite(states).all()),
        height=float(q[..., 2].min()) / robot.pose.height if robot.floating else 1.0,
        speed=_rms(v[..., [*range(base[1]), *joints]]),
        contacts=batch.contacts(),
        slip=float(np.abs(slip).max()),
    )


def watch_ours(sim: Simulator, robot: Robot) -> Behaviour:
    """Let robots of ce_gym settle, and return their behaviour; the robots then still stand."""
    n = round(HOLD / sim.dt)
    before, after = round(SETTLE / HOLD), round(WATCH / HOLD)
    jitter = targets(robot, sim.num_envs, before + after, seed=1)
    sim.reset()
    speeds, heights = [], []
    for i in range(before + after):
        sim.step(jitter[:, i], n_substeps=n)
        if i >= before:
            speeds.append(sim.v)
            heights.append(sim.q[:, 2].min() if robot.floating else robot.pose.height)
    v = np.array(speeds)
    return Behaviour(
        finite=bool(np.isfinite(v).all()),
        height=float(np.min(heights)) / robot.pose.height if robot.floating else 1.0,
        speed=_rms(v),
        contacts=float((np.abs(sim.contact_forces).max(axis=-1) > 0.0).sum(axis=-1).mean()),
        slip=0.0,
    )


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x, dtype=np.float64))))
