# pyright: reportAttributeAccessIssue=false
# MuJoCo's compiled modules have no types
"""Robots stepped by MuJoCo in our coordinates: policies trained here run there without changes.

The robots' MJCF has the same gains, torque limits, masses and friction. MuJoCo integrates the position control
implicitly in the joint velocities (`implicitfast`). Contacts follow MuJoCo's law, with stiffness and damping of the
robot's material.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.export.joint_ties import joint_ties
from ce_gym.export.mujoco_batch import Batch
from ce_gym.export.mujoco_coordinates import Coordinates, joint_rows, rotor_scale
from ce_gym.export.mujoco_model import STIFF, Settings, compile_model
from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import Robot
from ce_gym.model.frames import rotation_matrix
from ce_gym.model.mechanism import build_mechanism

Array = NDArray[np.float64]

LEVELS = ("armature", "exact")

STICKING = 100.0
"""Damping of sticking friction over damping of the normal force [-]: feet creep by 1 mm/s under tens of newtons."""

TIMESTEP, LOOPS_TIMESTEP = 0.001, 0.00025
"""MuJoCo's step [s], and its step for closed loops. The contacts need 1 ms. Loop equalities need a smaller step: at
1 ms they yield so much that Cassie falls."""


class MujocoTwin:
    """Copies of a robot in MuJoCo.

    Args:
        robot: A robot with a floating base.
        level: "armature" for reflected inertia as joint armature, or "exact" for rotors as bodies, tied by the stiffest
            stable equalities.
        num_envs: Number of copies.

    Attributes:
        robot: The robot.
        level: The level.
        diverged: Copies whose state MuJoCo found bad, shape (num_envs,).

    Raises:
        ValueError: If the level is another one.
        RobotError: If MJCF cannot express the robot at that level, see `to_mjcf`.
    """

    def __init__(self, robot: Robot, level: str, num_envs: int) -> None:
        if level not in LEVELS:
            raise ValueError(f"level={level!r}; expected one of {', '.join(LEVELS)}")
        self.robot, self.level = robot, level
        solimp = STIFF if level == "exact" else None
        loops = not all(isinstance(constraint, LinearConstraint) for constraint in robot.constraints)
        self.model = compile_model(robot, level, Settings(LOOPS_TIMESTEP if loops else TIMESTEP, solimp=solimp))
        set_contact_material(self.model, robot)
        self._coordinates = None if loops else Coordinates.of(self.model, robot)
        self._spanning_model = Model(robot, level) if loops else None
        ties = joint_ties(build_mechanism(robot)) if loops else {}
        scales = {name: rotor_scale(self.model, robot, name, tie) for name, tie in ties.items()}
        self._batch = Batch(self.model, num_envs)
        rows = joint_rows(self.model)
        joints = [name for name in robot.joints if name in rows]  # rotors that are armature in MuJoCo have no joint
        self._joints = [(rows[name], robot.spanning_rows[name], scales.get(name, 1.0)) for name in joints]
        self._positions, self._velocities = list(range(7)), []
        for name in (*robot.balls, *robot.independent):
            (qpos_row, qvel_row), (q_rows, v_rows) = rows[name], robot.rows[name]
            self._positions += [qpos_row + i for i in range(len(q_rows))]
            self._velocities += [qvel_row + i for i in range(len(v_rows))]
        self._driven = [robot.commanded.index(name) for name in robot.driven]
        self.diverged = np.zeros(num_envs, bool)

    def start(self, q: Array, v: Array) -> None:
        """Set the states of all copies; rotors turn with their joints.

        Args:
            q: Our positions, shape (num_envs, nq).
            v: Our velocities, shape (num_envs, nv).
        """
        self._batch.reset()
        self.diverged[:] = False
        nq, nv = self.model.nq, self.model.nv
        for state, q_i, v_i in zip(self._batch.states, q, v, strict=True):
            state[1 : 1 + nq], state[1 + nq : 1 + nq + nv] = self._mujoco_state(q_i, v_i)

    def _mujoco_state(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return MuJoCo's positions and velocities for ours."""
        if self._coordinates is not None:
            return self._coordinates.positions(q), self._coordinates.velocity_map(q) @ v
        assert self._spanning_model is not None
        qpos, qvel = np.zeros(self.model.nq), np.zeros(self.model.nv)
        qpos[:7], qvel[:3], qvel[3:6] = q[:7], rotation_matrix(q[3:7]) @ v[3:6], v[:3]
        q_span, v_span = self._spanning_model.spanning(q, v)
        for (qpos_row, qvel_row), (q_rows, v_rows), scale in self._joints:
            qpos[qpos_row : qpos_row + len(q_rows)] = q_span[q_rows] / scale
            qvel[qvel_row : qvel_row + len(v_rows)] = v_span[v_rows] / scale
        return qpos, qvel

    def step(self, target: Array, duration: float) -> None:
        """Hold joint targets [rad], shape (num_envs, n_joints), for a time [s]."""
        n = round(duration / self.model.opt.timestep)
        control = np.repeat(target[:, None, self._driven], n, axis=1)  # passive joints have no actuator
        time = self._batch.states[:, 0]
        states = self._batch.trajectory(control)[:, -1]
        # MuJoCo resets a robot with a bad state, so its clock is zero
        self.diverged |= (states[:, 0] < time + 0.5 * duration) | ~np.isfinite(states).all(axis=1)
        self._batch.states[:] = states

    def state(self) -> tuple[Array, Array]:
        """Return our positions (num_envs, nq) and velocities (num_envs, nv)."""
        qpos, qvel = self._batch.split(self._batch.states)
        q = qpos[:, self._positions]
        linear = np.einsum("nji,nj->ni", rotation_matrix(q[:, 3:7]), qvel[:, 0:3])  # MuJoCo's is in world axes
        return q, np.hstack([qvel[:, 3:6], linear, qvel[:, self._velocities]])


def set_contact_material(model: mujoco.MjModel, robot: Robot) -> None:
    """Give contacts the stiffness k [N/m] and damping c [N s/m] of a robot's material, and a round friction cone.

    MuJoCo's force is f = (-b v - K r - a0) / (A + R) ("Constraint model" in its documentation). A contact leaves the
    ground by r at velocity v, a0 is its acceleration without the force, and A its mobility [1/kg].
    Insert a0 + A f = (v+ - v) / h, R = 1 / (h (c + h k)), b = 1 / h and K = k R: the force becomes
    f = -k (r + h v+) - c v+, a spring and a damper at the end of the step h, as in our contacts.
    MuJoCo derives R from an impedance d, as (1 - d) / d times the body's mobility `invweight0`. Negative solref are
    d K and d b. A material without damping is damped critically. Dissipation of Hunt and Crossley's law becomes the
    damping at the load of a robot that stands on all contacts.
    """
    model.opt.cone, model.opt.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, STICKING
    material, h = robot.material, model.opt.timestep
    weight = robot.total_mass * math.hypot(*robot.gravity)
    for contact in robot.contacts:
        geom = model.geom(contact.name)
        mobility = float(model.body_invweight0[int(geom.bodyid[0]), 0])
        if material.dissipation is None:
            damping = material.damping or 2.0 * math.sqrt(material.stiffness / mobility)
        else:
            damping = material.dissipation * weight / len(robot.contacts)
        R = 1.0 / (h * (damping + h * material.stiffness))
        d = mobility / (mobility + R)
        geom.solimp[:2] = d  # at every depth
        geom.solref[:] = (-d * material.stiffness * R, -d / h)
        geom.priority[:] = 1  # over the ground's
