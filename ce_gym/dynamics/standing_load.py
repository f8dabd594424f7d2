"""The load of a robot in its standing pose: its weight, the torques that hold it, and the inertia at each joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ce_gym.dynamics.standing import Array, Standing, mass_matrix
from ce_gym.model.description import ContactSphere, Robot
from ce_gym.model.mechanism import Mechanism

PLACEHOLDER = 8.0
"""A torque limit above this many times weight times height of the centre of mass is a placeholder [-]."""


@dataclass(frozen=True)
class Load:
    """The load of a robot in its standing pose.

    Attributes:
        weight: Weight [N].
        height: Height of the centre of mass above the lowest contact [m]; above the base's origin with a fixed base.
        inertias: Diagonal of the mass matrix, by joint [kg m^2 or kg].
        torques: Torque that holds the joint while the feet share the weight, by joint [N m or N].
    """

    weight: float
    height: float
    inertias: dict[str, float]
    torques: dict[str, float]

    @property
    def toppling(self) -> float:
        """Weight times height [N m]."""
        return self.weight * self.height


def load_of(mechanism: Mechanism, standing: Standing, feet: Sequence[ContactSphere]) -> Load:
    """Return the load in the standing pose; the feet share the weight with the smallest sum of squared forces."""
    robot = mechanism.robot
    M = mass_matrix(mechanism, standing)
    gravity = np.array(robot.gravity)
    pull, moment, mass = np.zeros(len(M)), np.zeros(3), 0.0
    for name, body in mechanism.bodies.items():  # their inertia includes the mass of eliminated rotors
        R, inertia = standing.R[name], body.inertia
        pull += standing.J[name].T @ inertia @ np.concatenate([np.zeros(3), R.T @ gravity])
        first_moment = np.array([inertia[2, 4], inertia[0, 5], inertia[1, 3]])
        moment += inertia[5, 5] * standing.p[name] + R @ first_moment
        mass += inertia[5, 5]
    free = robot.layout.joints_v
    holding = -pull
    if robot.floating and feet:
        J = np.concatenate([_point_jacobian(standing, c.body, np.array(c.position)) for c in feet])
        forces = np.linalg.lstsq(J[:, :6].T, -pull[:6], rcond=None)[0]
        holding = holding - J.T @ forces
    joints = dict(zip(robot.independent, range(free, len(M)), strict=True))
    height = moment[2] / mass - min((c.lowest_point(standing.p[c.body], standing.R[c.body]) for c in feet), default=0.0)
    return Load(
        mass * float(np.linalg.norm(gravity)),
        abs(float(height)),
        {name: float(M[row, row]) for name, row in joints.items()},
        {name: float(holding[row]) for name, row in joints.items()},
    )


def _point_jacobian(standing: Standing, body: str, point: Array) -> Array:
    """Return the world velocity of a point of a body for unit independent velocities, shape (3, nv)."""
    angular, linear = standing.J[body][:3], standing.J[body][3:]
    return standing.R[body] @ (linear + np.cross(angular.T, point).T)


def placeholders(robot: Robot, load: Load) -> list[str]:
    """Return the driven joints whose torque limit is infinite or far above what the robot's weight needs."""
    limits = {name: robot.body(name).joint.torque for name in robot.driven}
    return [name for name, torque in limits.items() if torque > PLACEHOLDER * load.toppling]
