# pyright: reportAttributeAccessIssue=false
"""MuJoCo as a peer: the same robot, in the same coordinates, and its batched rollout.

MuJoCo's velocities are [base linear in the world, base angular in the base, joints depth first]; ours are [base
angular, base linear, independent joints], base velocities in the base frame. (MuJoCo's compiled modules carry no types,
hence the line above.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray

from ce_gym.export.joint_ties import joint_ties
from ce_gym.export.mjcf import SMALLEST_INERTIA, mass_properties, to_mjcf
from ce_gym.export.mjcf_text import quaternion
from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError
from ce_gym.model.mechanism import build_mechanism

Array = NDArray[np.float64]
STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


def load(
    robot: Robot,
    transmission: str,
    *,
    timestep: float = 0.005,
    integrator: str = "implicitfast",
    solref: Sequence[float] | None = None,
    solimp: Sequence[float] | None = None,
) -> mujoco.MjModel:
    """Compile a robot's MJCF and put back inertias that MuJoCo's compiler refuses; arguments as in `to_mjcf`."""
    text = to_mjcf(
        robot,
        transmission,
        timestep=timestep,
        integrator=integrator,
        ground=robot.floating,
        solref=solref,
        solimp=solimp,
    )
    model = mujoco.MjModel.from_xml_string(text)
    for moving in build_mechanism(robot, transmission, eliminate=False).bodies.values():
        _, _, inertia = mass_properties(moving.inertia)
        moments, axes = np.linalg.eigh(inertia)
        axes *= np.sign(np.linalg.det(axes))
        model.body(moving.name).inertia[:] = np.maximum(moments, SMALLEST_INERTIA)
        model.body(moving.name).iquat[:] = quaternion(axes)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


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
        matrix[0:3, 3:6] = _rotation(q[3:7])
        matrix[3:6, 0:3] = np.eye(3)
        matrix[6:, 6:] = self.to_positions
        return matrix

    def velocity_product(self, q: Array, v: Array) -> Array:
        """Return Tdot v, shape (nv_mujoco,): MuJoCo's linear velocity is in world axes."""
        product = np.zeros(len(self.offset) + (6 if self.floating else 0))
        if self.floating:
            product[0:3] = _rotation(q[3:7]) @ np.cross(v[0:3], v[3:6])
        return product


def mass_matrix(model: mujoco.MjModel, robot: Robot, q: Array) -> Array:
    """Return MuJoCo's mass matrix in our coordinates, dependent joints eliminated exactly, shape (nv, nv)."""
    coordinates = Coordinates.of(model, robot)
    data = mujoco.MjData(model)
    data.qpos[:] = coordinates.positions(q)
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    T = coordinates.velocity_map(q)
    return T.T @ full @ T


def forward_dynamics(model: mujoco.MjModel, robot: Robot, q: Array, v: Array, tau: Array) -> Array:
    """Return the acceleration in our coordinates from MuJoCo's mass matrix and bias forces, shape (nv,).

    No contact and no joint damping; dependent joints are eliminated exactly, so that soft equalities play no part.
    """
    coordinates = Coordinates.of(model, robot)
    T = coordinates.velocity_map(q)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = coordinates.positions(q), T @ v
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    bias = data.qfrc_bias + full @ coordinates.velocity_product(q, v)
    return np.linalg.solve(T.T @ full @ T, tau - T.T @ bias)


@dataclass
class Batch:
    """Robots that MuJoCo rolls out with `mujoco.rollout`, one after another on each thread.

    Attributes:
        model: Compiled model.
        num_envs: Robots.
        num_threads: Threads; 1 is the calling one.
        states: Full physics states, shape (num_envs, n_state).
    """

    model: mujoco.MjModel
    num_envs: int
    num_threads: int = 1
    states: Array = field(init=False)

    def __post_init__(self) -> None:
        workers = self.num_threads if self.num_threads > 1 else 0
        self.datas = [mujoco.MjData(self.model) for _ in range(self.num_threads)]
        self.data = self.datas[0]
        self.pool = rollout.Rollout(nthread=workers)
        self.reset()

    def reset(self) -> None:
        """Put every robot into the standing keyframe."""
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        state = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, self.data, state, STATE)
        self.states = np.tile(state, (self.num_envs, 1))
        self.data.warning.number[:] = 0

    def trajectory(self, control: Array, out: Array | None = None) -> Array:
        """Roll out from the current states, which stay as they are.

        Args:
            control: Position targets of the actuators [rad] at every step, shape (num_envs, n_steps, nu).
            out: Where to write; None allocates.

        Returns:
            States after every step, shape (num_envs, n_steps, n_state).
        """
        n_steps = control.shape[1]
        states, _ = self.pool.rollout(self.model, self.datas, self.states, control, nstep=n_steps, state=out)
        return np.asarray(states)

    def split(self, states: Array) -> tuple[Array, Array]:
        """Return positions (..., nq) and velocities (..., nv), MuJoCo's coordinates, of full physics states."""
        nq, nv = self.model.nq, self.model.nv
        return states[..., 1 : 1 + nq], states[..., 1 + nq : 1 + nq + nv]

    def contacts(self) -> float:
        """Return the mean number of contacts of the current states."""
        counts = []
        for state in self.states:
            mujoco.mj_setState(self.model, self.data, state, STATE)
            mujoco.mj_forward(self.model, self.data)
            counts.append(self.data.ncon)
        return float(np.mean(counts))

    @property
    def diverged(self) -> bool:
        """Whether MuJoCo has met a bad state since the last reset (it then resets that robot silently)."""
        bad = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
        return any(self.data.warning[int(kind)].number > 0 for kind in bad)


def _rotation(quat: Array) -> Array:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)
