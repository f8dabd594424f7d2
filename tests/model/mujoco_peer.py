"""MuJoCo's own equations beside ours, for files that both read."""

from __future__ import annotations

import numpy as np
import pytest

from ce_gym.dynamics import Model

mujoco = pytest.importorskip("mujoco")
TOLERANCE = 1e-9
REPEATED = 1e-5  # singular values of equalities that repeat others, relative to the largest


class Peer:
    """MuJoCo's own equations for a file, in the coordinates of the robot imported from it."""

    def __init__(self, path, robot, model: Model, armature=None):
        self.mj = mujoco.MjModel.from_xml_path(str(path))
        for body, value in (armature or {}).items():
            self.mj.dof_armature[self.mj.body_dofadr[self.mj.body(body).id]] = value
        self.mj.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        self.data = mujoco.MjData(self.mj)
        self.model, self.robot = model, robot
        self.base = 6 if robot.floating else 0

    def joints(self) -> list[str]:
        """Our name for each of MuJoCo's scalar joints, in MuJoCo's order."""
        names = []
        for j in range(self.mj.njnt):
            body = self.mj.jnt_bodyid[j]
            last = j == self.mj.body_jntadr[body] + self.mj.body_jntnum[body] - 1
            if self.mj.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE:
                names.append(self.mj.body(body).name if last else self.mj.joint(j).name)
        return names

    def set_state(self, q, v):
        q_span, v_span = self.model.spanning(q, v)
        at, offset = self.model.spanning_names, bool(self.base)
        columns = [self.base + at.index(name) for name in self.joints()]
        qpos = np.concatenate([q_span[: self.base + offset], q_span[[c + offset for c in columns]]])
        self.set(qpos, np.concatenate([self._base_velocity(q, v), v_span[columns]]))

    def _base_velocity(self, q, v):
        return np.concatenate([self.rotation(q) @ v[3:6], v[:3]]) if self.base else np.zeros(0)

    @staticmethod
    def rotation(q):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, q[3:7])
        return matrix.reshape(3, 3)

    def set(self, qpos, qvel):
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        mujoco.mj_forward(self.mj, self.data)

    def mass_matrix(self):
        full = np.zeros((self.mj.nv, self.mj.nv))
        mujoco.mj_fullM(self.mj, self.data, full)
        return full

    def jacobian(self):
        rows = self.data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        return self.data.efc_J.reshape(-1, self.mj.nv)[: self.data.nefc][rows].copy()

    def gap(self):
        rows = self.data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        return float(np.abs(self.data.efc_pos[rows]).max(initial=0.0))

    def jacobian_rate(self, h=1e-3):
        """Jdot v by a central difference of fourth order."""
        qpos, qvel = self.data.qpos.copy(), self.data.qvel.copy()
        total = 0.0
        for step, weight in ((1, 8.0), (-1, -8.0), (2, -1.0), (-2, 1.0)):
            moved = qpos.copy()
            mujoco.mj_integratePos(self.mj, moved, qvel, step * h)
            self.set(moved, qvel)
            total = total + weight * self.jacobian() @ qvel / (12 * h)
        self.set(qpos, qvel)
        return total

    def acceleration(self, q, v, tau):
        """Solve MuJoCo's KKT system in numpy, and return the acceleration of our independent coordinates.

        Rows that repeat others are left out: those of planar loops, exactly, and those of parallel rods, within the
        digits of the file.
        """
        force = np.zeros(self.mj.nv)
        names = self.joints()
        for i, name in enumerate(self.robot.independent):
            force[self.base + names.index(name)] = tau[self.base + i]
        if self.base:
            force[:3], force[3:6] = self.rotation(q) @ tau[3:6], tau[:3]
        J, n = self.jacobian(), self.mj.nv
        U, s, _ = np.linalg.svd(J, full_matrices=False)
        U = U[:, s > REPEATED * s.max(initial=0.0)]
        rate = U.T @ self.jacobian_rate() if len(J) else np.zeros(0)
        K = np.block([[self.mass_matrix(), (U.T @ J).T], [U.T @ J, np.zeros((len(rate), len(rate)))]])
        qacc = np.linalg.solve(K, np.concatenate([force - self.data.qfrc_bias, -rate]))[:n]
        base = np.concatenate([qacc[3:6], self.rotation(q).T @ qacc[:3] - np.cross(v[:3], v[3:6])]) if self.base else []
        return np.concatenate([base, qacc[[self.base + names.index(name) for name in self.robot.independent]]])


def compare(path, robot, level="coupled", spread=0.3, seed=0, armature=None, rounding=0.0):
    """Mass matrix and accelerations agree in random states.

    Args:
        path: The file.
        robot: What is imported from it.
        level: Transmission level.
        spread: How far joints may be from their pose [rad or m].
        seed: Of the states.
        armature: Armature [kg m^2] by body, for MuJoCo alone.
        rounding: Relative size by which equalities contradict each other: no motion fulfils them better.
    """
    model = Model(robot, level)
    peer = Peer(path, robot, model, armature)
    rng = np.random.default_rng(seed)
    pose = dict(robot.pose.joints)
    for _ in range(4):
        y = np.array([pose.get(name, 0.0) for name in robot.independent]) + rng.uniform(
            -spread, spread, len(robot.independent)
        )
        quat = rng.normal(size=4)
        base = np.concatenate([rng.normal(size=3), quat / np.linalg.norm(quat)]) if robot.floating else np.zeros(0)
        q, v, tau = np.concatenate([base, y]), rng.uniform(-1, 1, model.nv), rng.uniform(-5, 5, model.nv)
        peer.set_state(q, v)
        assert peer.gap() < max(1e-9, rounding)
        theirs = peer.acceleration(q, v, tau)
        ours = model.forward_dynamics(q, v, tau)
        assert np.abs(ours - theirs).max() <= max(TOLERANCE, rounding) * max(1.0, np.abs(theirs).max())
        if len(peer.joints()) == len(robot.independent) and not robot.floating:
            M = peer.mass_matrix()
            assert np.abs(model.mass_matrix(q) - M).max() <= TOLERANCE * np.abs(M).max()
