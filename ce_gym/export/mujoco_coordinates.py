# pyright: reportAttributeAccessIssue=false
"""The change from our coordinates to MuJoCo's.

MuJoCo's velocities are [base linear in the world, base angular in the base, joints depth first]; ours are [base
angular, base linear, independent joints], base velocities in the base frame. (MuJoCo's compiled modules carry no types,
hence the line above.)
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from ce_gym.export.joint_ties import joint_ties
from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError
from ce_gym.model.frames import rotation_matrix
from ce_gym.model.mechanism import build_mechanism

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Coordinates:
    """The change from our coordinates to MuJoCo's, for one compiled model.

    Attributes:
        floating: Whether the base is free.
        to_positions: MuJoCo's joint positions for ours, shape (n_mujoco_joints, n_independent).
        offset: Its constant part [rad or m], shape (n_mujoco_joints,).
    """

    floating: bool
    to_positions: Array
    offset: Array

    @classmethod
    def of(cls, model: mujoco.MjModel, robot: Robot) -> Coordinates:
        """Read the order of joints from a compiled model.

        Raises:
            RobotError: The robot has closed loops, whose coordinates are no linear map of the independent ones.
        """
        loops = [tie.name for tie in robot.constraints if not isinstance(tie, LinearConstraint)]
        if loops:
            raise RobotError(f"{robot.name}: constraint {loops[0]!r}: expected only linear ones for this comparison")
        names = [model.joint(i).name for i in range(model.njnt)]
        if robot.floating:
            names = names[1:]
        ties = joint_ties(build_mechanism(robot))
        matrix = np.array([[ties[name].ratios.get(y, 0.0) for y in robot.independent] for name in names])
        return cls(robot.floating, matrix, np.array([ties[name].offset for name in names]))

    def positions(self, q: Array) -> Array:
        """Return MuJoCo's qpos for one configuration of ours, shape (nq,)."""
        base = 7 if self.floating else 0
        return np.concatenate([q[:base], self.to_positions @ q[base:] + self.offset])

    def velocity_map(self, q: Array) -> Array:
        """Return the matrix T of qvel = T v, shape (nv_mujoco, nv)."""
        if not self.floating:
            return self.to_positions
        n, m = self.to_positions.shape
        matrix = np.zeros((6 + n, 6 + m))
        matrix[0:3, 3:6] = rotation_matrix(q[3:7])
        matrix[3:6, 0:3] = np.eye(3)
        matrix[6:, 6:] = self.to_positions
        return matrix

    def velocity_product(self, q: Array, v: Array) -> Array:
        """Return Tdot v, shape (nv_mujoco,): MuJoCo's linear velocity is in world axes."""
        product = np.zeros(len(self.offset) + (6 if self.floating else 0))
        if self.floating:
            product[0:3] = rotation_matrix(q[3:7]) @ np.cross(v[0:3], v[3:6])
        return product
