# pyright: reportAttributeAccessIssue=false
"""Robots stepped by MuJoCo in our coordinates, so that a policy trained here can act there as it is.

The robots' MJCF has the same gains, torque limits, masses and friction. MuJoCo carries out the position control
implicitly in the joint velocities (`implicitfast`); the law of contact is its own, stiffness and damping are the
robot's, as near as its law has them. (MuJoCo's compiled modules carry no types, hence the line above.)
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.export.joint_ties import joint_ties
from ce_gym.export.mujoco_batch import Batch
from ce_gym.export.mujoco_coordinates import Coordinates, rotor_scale
from ce_gym.export.mujoco_model import STIFF, Settings, compiled
from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import Robot
from ce_gym.model.frames import rotation_matrix
from ce_gym.model.mechanism import build_mechanism

Array = NDArray[np.float64]

LEVELS = ("armature", "exact")

STICKING = 100.0
"""Damping of friction that sticks, over that of the normal [-]: feet carry tens of newtons at a creep of 1 mm/s."""

TIMESTEP, LOOPS_TIMESTEP = 0.001, 0.00025
"""MuJoCo's step [s], and the one for closed loops. Contacts as quick as ours are want 1 ms. At that step equalities
give so much that Cassie falls in 100 % of 24 episodes of 6 s, at 0.5 ms in 12 %, at 0.25 ms in none."""


class MujocoTwin:
    """Copies of a robot in MuJoCo.

    Args:
        robot: With a floating base.
        level: "armature", reflected inertia as MuJoCo users know it, or "exact", every rotor a body on the stiffest
            equality that is stable.
        num_envs: Copies.

    Attributes:
        robot: The robot.
        level: The level.
        diverged: Copies whose state MuJoCo found bad, shape (num_envs,).

    Raises:
        ValueError: If the level is another one.
        RobotError: If MJCF cannot express the robot at that level, as `armature` of loops whose rotors turn with joints
            that follow.
    """

    def __init__(self, robot: Robot, level: str, num_envs: int) -> None:
        if level not in LEVELS:
            raise ValueError(f"level={level!r}; expected one of {', '.join(LEVELS)}")
        self.robot, self.level = robot, level
        impedance = STIFF if level == "exact" else None
        loops = not all(isinstance(tie, LinearConstraint) for tie in robot.constraints)
        self.model = compiled(robot, level, Settings(LOOPS_TIMESTEP if loops else TIMESTEP, solimp=impedance))
        lay_ground(self.model, robot)
        self._coordinates = None if loops else Coordinates.of(self.model, robot)
        self._tree = Model(robot, level) if loops else None
        ties = joint_ties(build_mechanism(robot)) if loops else {}
        scales = {name: rotor_scale(self.model, robot, name, tie) for name, tie in ties.items()}
        self._batch = Batch(self.model, num_envs)
        first = {self.model.joint(i).name: i for i in range(self.model.njnt)}
        addresses = {name: (int(self.model.jnt_qposadr[i]), int(self.model.jnt_dofadr[i])) for name, i in first.items()}
        rows = robot.spanning_rows  # rotors that are armature here have rows, and no joint
        known = [name for name in robot.joints if name in addresses]
        self._joints = [(addresses[name], rows[name], scales.get(name, 1.0)) for name in known]
        names = [*robot.balls, *robot.independent]
        at = [addresses[name] for name in names]
        sizes = [(len(rows), len(speeds)) for rows, speeds in (robot.rows[name] for name in names)]
        placed = list(zip(at, sizes, strict=True))
        self._positions = [*range(7), *(p + i for (p, _), (n, _) in placed for i in range(n))]
        self._velocities = [d + i for (_, d), (_, n) in placed for i in range(n)]
        self._driven = [robot.commanded.index(name) for name in robot.driven]
        self.diverged = np.zeros(num_envs, bool)

    def start(self, q: Array, v: Array) -> None:
        """Put every robot into a state; rotors turn with their joints.

        Args:
            q: Our positions, shape (num_envs, nq).
            v: Our velocities, shape (num_envs, nv).
        """
        self._batch.reset()
        self.diverged[:] = False
        nq, nv = self.model.nq, self.model.nv
        for state, q_i, v_i in zip(self._batch.states, q, v, strict=True):
            state[1 : 1 + nq], state[1 + nq : 1 + nq + nv] = self._theirs(q_i, v_i)

    def _theirs(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return MuJoCo's positions and velocities for ours."""
        if self._coordinates is not None:
            return self._coordinates.positions(q), self._coordinates.velocity_map(q) @ v
        assert self._tree is not None
        qpos, qvel = np.zeros(self.model.nq), np.zeros(self.model.nv)
        qpos[:7], qvel[:3], qvel[3:6] = q[:7], rotation_matrix(q[3:7]) @ v[3:6], v[:3]
        span = self._tree.spanning(q, v)
        for (position, speed), (rows, speeds), scale in self._joints:
            qpos[position : position + len(rows)] = span[0][rows] / scale
            qvel[speed : speed + len(speeds)] = span[1][speeds] / scale
        return qpos, qvel

    def step(self, target: Array, duration: float) -> None:
        """Hold joint targets [rad], shape (num_envs, n_joints), for a time [s]."""
        n = round(duration / self.model.opt.timestep)
        control = np.repeat(target[:, None, self._driven], n, axis=1)  # passive joints have no actuator
        before = self._batch.states[:, 0]
        after = self._batch.trajectory(control)[:, -1]
        # MuJoCo puts a robot whose state is bad back to the start, where its clock is zero.
        self.diverged |= (after[:, 0] < before + 0.5 * duration) | ~np.isfinite(after).all(axis=1)
        self._batch.states[:] = after

    def state(self) -> tuple[Array, Array]:
        """Return our positions (num_envs, nq) and velocities (num_envs, nv)."""
        qpos, qvel = self._batch.split(self._batch.states)
        q = qpos[:, self._positions]
        linear = np.einsum("nji,nj->ni", rotation_matrix(q[:, 3:7]), qvel[:, 0:3])  # MuJoCo's is in world axes
        return q, np.hstack([qvel[:, 3:6], linear, qvel[:, self._velocities]])


def lay_ground(model: mujoco.MjModel, robot: Robot) -> None:
    """Give contacts the stiffness k [N/m] and damping c [N s/m] of a robot's material, and a round friction cone.

    MuJoCo's force is f = (-b v - K r - a0) / (A + R), where r is how far and v how fast a contact leaves the ground, a0
    its acceleration without the force and A its mobility [1/kg] ("Constraint model" in its documentation). As
    a0 + A f = (v+ - v) / h, with R = 1 / (h (c + h k)), b = 1 / h and K = k R it is f = -k (r + h v+) - c v+: a spring
    and a damper at the end of the step h, as ours are, whatever they carry. R is said by an impedance d, as
    (1 - d) / d times the mobility that MuJoCo gives the body (`invweight0`); negative solref are d K and d b. A
    material without damping of its own is damped critically. The dissipation of Hunt and Crossley's law becomes the
    damping that it has where all contacts carry the robot together.
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
