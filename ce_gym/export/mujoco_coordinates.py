# pyright: reportAttributeAccessIssue=false
# MuJoCo's compiled modules have no types
"""The change from our coordinates to MuJoCo's.

MuJoCo's velocities are [base linear in the world, base angular in the base, joints depth first]. Ours are [base
angular, base linear, ball joints, independent joints], with base velocities in the base frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from ce_gym.export.joint_ties import Tie, joint_ties
from ce_gym.export.mjcf_mechanism import largest_ratio
from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.coordinates import Layout
from ce_gym.model.description import Robot
from ce_gym.model.errors import file_error
from ce_gym.model.frames import rotation_matrix
from ce_gym.model.mechanism import build_mechanism

Array = NDArray[np.float64]


def rotor_scale(model: mujoco.MjModel, robot: Robot, name: str, tie: Tie) -> float:
    """Return a rotor's angle over its coordinate in MJCF: the largest ratio for `massless_rotors`, else 1."""
    rows = joint_rows(model)
    is_rotor = name in rows and robot.body(name).kind == "rotor"
    return largest_ratio(tie) if is_rotor and model.dof_armature[rows[name][1]] else 1.0


def joint_rows(model: mujoco.MjModel) -> dict[str, tuple[int, int]]:
    """Return the first rows of each joint in `qpos` and in `qvel`, by name of the body that the joint moves."""
    bodies = [model.body(body).name for body in model.jnt_bodyid]
    return {name: (int(model.jnt_qposadr[i]), int(model.jnt_dofadr[i])) for i, name in enumerate(bodies)}


@dataclass(frozen=True)
class Coordinates:
    """The change from our coordinates to MuJoCo's, for one compiled model.

    Attributes:
        layout: Layout of our coordinates.
        to_positions: Linear map from our joint positions to MuJoCo's, for joints with one coordinate, shape
            (n, n_independent).
        offset: Constant part of this map [rad or m], shape (n,).
        scalars: Rows of these joints in `qpos` and in `qvel`, shape (n,) each.
        balls: First rows of each ball joint in `qpos` and in `qvel`, in our order.
    """

    layout: Layout
    to_positions: Array
    offset: Array
    scalars: tuple[list[int], list[int]]
    balls: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, model: mujoco.MjModel, robot: Robot) -> Coordinates:
        """Read the order of joints from a compiled model.

        Raises:
            RobotError: The robot has closed loops, whose coordinates are not linear in the independent ones.
        """
        loops = [tie.name for tie in robot.constraints if not isinstance(tie, LinearConstraint)]
        if loops:
            raise file_error(robot.name, f"constraint {loops[0]!r}", "only linear ones for this comparison")
        ties = joint_ties(build_mechanism(robot))
        ties = {name: tie.scaled(1.0 / rotor_scale(model, robot, name, tie)) for name, tie in ties.items()}
        rows = joint_rows(model)
        names = [name for name in rows if name in ties]
        matrix = np.array([[ties[name].ratios.get(y, 0.0) for y in robot.independent] for name in names])
        scalars = [rows[name][0] for name in names], [rows[name][1] for name in names]
        return cls(
            layout=robot.layout,
            to_positions=matrix.reshape(len(names), len(robot.independent)),
            offset=np.array([ties[name].offset for name in names]),
            scalars=scalars,
            balls=tuple(rows[name] for name in robot.balls),
        )

    @property
    def sizes(self) -> tuple[int, int]:
        """Sizes of `qpos` and `qvel`."""
        return self.layout.joints_q + len(self.offset), self.layout.joints_v + len(self.offset)

    def positions(self, q: Array) -> Array:
        """Return MuJoCo's `qpos` for our configuration q, shape (nq,)."""
        qpos, base = np.zeros(self.sizes[0]), self.layout.base_nq
        qpos[:base] = q[:base]
        for (qpos_row, _), (row, _) in zip(self.balls, self.layout.ball_turns, strict=True):
            qpos[qpos_row : qpos_row + 4] = q[row : row + 4]
        qpos[self.scalars[0]] = self.to_positions @ q[self.layout.joints_q :] + self.offset
        return qpos

    def velocity_map(self, q: Array) -> Array:
        """Return the matrix T of qvel = T v, shape (nv_mujoco, nv)."""
        matrix = np.zeros((self.sizes[1], self.layout.nv))
        if self.layout.floating:
            matrix[0:3, 3:6] = rotation_matrix(q[3:7])
            matrix[3:6, 0:3] = np.eye(3)
        for (_, qvel_row), (_, row) in zip(self.balls, self.layout.ball_turns, strict=True):
            matrix[qvel_row : qvel_row + 3, row : row + 3] = np.eye(3)
        matrix[self.scalars[1], self.layout.joints_v :] = self.to_positions
        return matrix

    def velocity_product(self, q: Array, v: Array) -> Array:
        """Return Tdot v, shape (nv_mujoco,): MuJoCo's linear velocity is in world axes."""
        product = np.zeros(self.sizes[1])
        if self.layout.floating:
            product[0:3] = rotation_matrix(q[3:7]) @ np.cross(v[0:3], v[3:6])
        return product
