"""Jumps and landings by a fixed program of poses, one design in each lane."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ce_gym.bench.exactness.protocol import (
    CROUCHED,
    DESIGN_STEP,
    DROP,
    FLIGHT,
    JUMP,
    LANDING,
    LANDING_LAW,
    PROGRAMS,
    PUSH,
    TARGET_STEP,
    TORQUE_POWER,
    TUCK,
    Array,
)
from ce_gym.dynamics.model import Model
from ce_gym.model import Robot, load_robot
from ce_gym.sim.simulator import Simulator

PARAMETERS = ("ratio", "rotor_inertia", "motor_strength")


@dataclass(frozen=True)
class Jump:
    """What a jump does, each of shape (n,).

    Attributes:
        apex: Highest point of the base above its standing pose [m].
        pitch: Of the base in flight [rad].
    """

    apex: Array
    pitch: Array


class Jumpers:
    """Copies of a robot at a level, each its own design, motion and noise.

    Args:
        name: Of the robot.
        level: Transmission level.
        ratio: Factor on gear ratios, shape (n,).
        inertia: Factor on rotor inertia, which the motors' torque follows, shape (n,).
    """

    def __init__(self, name: str, level: str, ratio: Array, inertia: Array) -> None:
        self.program, self.model = PROGRAMS[name], Model(jumping(name), level)
        options = {"contacts": "foot", "motors": "limited", "normal_law": "hunt_crossley"}
        known = {"outputs": ("contact_forces",), "parameters": PARAMETERS}
        self.sim = Simulator(self.model, len(ratio), DESIGN_STEP, **options, **known)
        for parameter, value in zip(PARAMETERS, (ratio, inertia, inertia**TORQUE_POWER), strict=True):
            self.sim.set_parameter(parameter, value[:, None])

    def jump(self, ramp: Array, noise: Array | float = 0.0) -> Jump:
        """Crouch, push and tuck.

        Args:
            ramp: Duration of the push [s], shape (n,).
            noise: Added to all targets [rad], shape (n, n_joints).
        """
        standing, sim = self.model.standing_q, self.sim
        crouch, push, tuck = (
            factor * standing[7:] + noise for factor in (self.program.crouch, PUSH, self.program.tuck)
        )
        sim.set_state(grounded(self.model, self.program.crouch), np.zeros(self.model.nv))
        self._hold(crouch, CROUCHED)
        n = round(JUMP / TARGET_STEP)
        height, pitch = np.empty((n, sim.num_envs)), np.empty(sim.num_envs)
        for i in range(n):
            t = i * TARGET_STEP
            share = np.minimum(t / ramp, 1.0)[:, None]
            self._hold(crouch + share * (push - crouch) if t < TUCK else tuck, TARGET_STEP)
            height[i] = sim.q[:, 2]
            if i + 1 == round((TUCK + FLIGHT) / TARGET_STEP):
                pitch = base_pitch(sim.q)
        return Jump(height.max(0) - standing[2], pitch)

    def land(self, noise: Array | float = 0.0) -> Array:
        """Drop from a height and return the highest total force of the ground [N], shape (n,)."""
        q = self.model.standing_q.copy()
        q[2] += DROP
        self.sim.set_state(q, np.zeros(self.model.nv))
        target, highest = self.model.standing_q[7:] + noise, np.zeros(self.sim.num_envs)
        self._hold(target, 0.9 * np.sqrt(2 * DROP / 9.81))
        for _ in range(round(LANDING / DESIGN_STEP)):
            self.sim.step(target)
            highest = np.maximum(highest, self.sim.contact_forces[..., 2].sum(-1))
        return highest

    def _hold(self, target: Array, seconds: float) -> None:
        self.sim.step(target, round(seconds / DESIGN_STEP))


def jumping(name: str) -> Robot:
    """Return a robot with the gains of its program and the ground of the study."""
    robot, factor = load_robot(name), PROGRAMS[name].gains
    kp, kd = (tuple((j, factor * k) for j, k in gains) for gains in (robot.gains.kp, robot.gains.kd))
    material = replace(robot.material, dissipation=LANDING_LAW)
    return replace(robot, gains=replace(robot.gains, kp=kp, kd=kd), material=material)


def grounded(model: Model, factor: float) -> Array:
    """Return the standing pose times a factor, its lowest foot on the ground, shape (nq,)."""
    q = model.standing_q.copy()
    q[7:] *= factor
    feet = [i for i, contact in enumerate(model.robot.contacts) if contact.group == "foot"]
    radii = np.array([model.robot.contacts[i].radius for i in feet])
    q[2] -= (model.contact_points(q, np.zeros(model.nv))[0][feet, 2] - radii).min()
    return q


def base_pitch(q: Array) -> Array:
    """Return the pitch of the base [rad], shape (n,), nose down positive."""
    w, x, y, z = q[:, 3:7].T
    return np.arctan2(2 * (x * z + w * y), 1 - 2 * (x**2 + y**2))
