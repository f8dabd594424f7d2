# pyright: reportAttributeAccessIssue=false
"""Reference solutions of smooth scenes, from two codes that share only the description of the robot.

The first is the eighth-order method of ce_gym with tiny steps, evaluated by CasADi. The second uses MuJoCo's mass
matrix, bias forces and equality Jacobian, with rotors as bodies. Accelerations are restricted to the null space of this
Jacobian, which MuJoCo itself does not do, and integrated with the classical fourth-order method in MuJoCo's
coordinates. This file has its own formulas for the springs of elastic transmissions.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from ce_gym.bench.accuracy.peers import compiled, forces, initial_state, positions
from ce_gym.bench.accuracy.scenarios import HOLD, Array, Scene
from ce_gym.bench.accuracy.statements import ratios
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.export.mujoco_coordinates import joint_rows
from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.mechanism import ELASTIC


def ours(scene: Scene, n: int, level: str | None = None) -> Array:
    """Return positions at the end of every hold from rk8, shape (n_holds, nq).

    Args:
        scene: The scene.
        n: Steps per hold.
        level: Transmission level; None takes the level `scene.exact`.
    """
    model = Model(scene.robot, transmission=level or scene.exact)
    step = step_function(model.mechanism, StepOptions(HOLD / n, control=scene.control, method="rk8"))
    q, v = (np.pad(x, (0, n_all - len(x))) for x, n_all in ((scene.q, model.nq), (scene.v, model.nv)))
    state = {"q": q, "v": v, "diverged": np.zeros(1)}
    if "dependent" in step.name_in():
        state["dependent"] = model.dependent_guess(scene.q)
    path = []
    for target in scene.drive:
        given = {"target": target} if len(target) else {}
        for _ in range(n):
            result = step(**state, **given)
            state = {name: result[f"{name}_next"] for name in state}
        path.append(np.array(state["q"]).ravel()[: len(scene.q)])
    return np.array(path)


def theirs(scene: Scene, n: int) -> Array:
    """Return positions from MuJoCo's matrices, with `n` Runge-Kutta steps per hold, shape (n_holds, nq)."""
    system = _Constrained(scene)
    y, h = np.concatenate([system.data.qpos, system.data.qvel]), HOLD / n
    path = []
    for hold in range(scene.holds):
        for _ in range(n):
            a = system.rate(y, hold)
            b = system.rate(y + h / 2 * a, hold)
            c = system.rate(y + h / 2 * b, hold)
            d = system.rate(y + h * c, hold)
            y = system.with_unit_quaternion(y + h / 6 * (a + 2 * b + 2 * c + d))
        path.append(positions(scene, system.model, y[: system.model.nq]))
    return np.array(path)


class _Constrained:
    """The equations of motion of a scene from MuJoCo's mass matrix M, bias c and equality Jacobian J.

    M a + c = f + J^T l and J a = -Jdot v, with Jdot v by a central difference along the motion, solved in an
    orthonormal basis of the null space of J, whose rows may be redundant.
    """

    STEP = 1e-6

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.model = compiled(scene, scene.exact)
        self.model.tendon_stiffness[:], self.model.tendon_damping[:] = 0.0, 0.0
        self.springs = springs(scene, self.model)
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_ACTUATION
        self.data = initial_state(scene, self.model)
        self.mass = np.zeros((self.model.nv, self.model.nv))
        loops = any(not isinstance(tie, LinearConstraint) for tie in scene.robot.constraints)
        self.moving_jacobian = loops
        rows = joint_rows(self.model)
        self.dofs = [rows[name][1] for name in scene.robot.independent]
        self.basis: tuple[Array, Array] | None = None

    def rate(self, y: Array, hold: int) -> Array:
        """Return the time derivative of positions and velocities."""
        y = self.with_unit_quaternion(y)
        qpos, qvel, model, data = y[: self.model.nq], y[self.model.nq :], self.model, self.data
        drift = np.zeros(model.nv)
        if self.moving_jacobian:
            ahead, behind = (self._jacobian(qpos + s * self.STEP * self._motion(qpos, qvel)) for s in (1, -1))
            J = self._jacobian(qpos)
            inverse = np.linalg.pinv(J, rcond=1e-9)
            drift = -inverse @ ((ahead - behind) @ qvel) / (2 * self.STEP)
            basis = _null_space(J)
        else:
            if self.basis is None:
                J = self._jacobian(qpos)
                self.basis = (_null_space(J), J)
            basis = self.basis[0]
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_fullM(model, data, self.mass)
        force = (
            self._force(qpos, qvel, hold)
            - self.springs(qpos, qvel)
            + data.qfrc_passive
            - data.qfrc_bias
            - self.mass @ drift
        )
        a = drift + basis @ np.linalg.solve(basis.T @ self.mass @ basis, basis.T @ force)
        return np.concatenate([self._motion(qpos, qvel), a])

    def with_unit_quaternion(self, y: Array) -> Array:
        """Return the state with the quaternion of a floating base scaled to unit length."""
        if self.scene.robot.floating:
            y = y.copy()
            y[3:7] /= np.linalg.norm(y[3:7])
        return y

    def _force(self, qpos: Array, qvel: Array, hold: int) -> Array:
        force, scene = forces(self.scene, self.model, hold, self.scene.exact), self.scene
        if scene.control == "position":
            kp, kd = dict(scene.robot.gains.kp), dict(scene.robot.gains.kd)
            y = positions(scene, self.model, qpos)[7 if scene.robot.floating else 0 :]
            for i, (name, dof) in enumerate(zip(scene.robot.independent, self.dofs, strict=True)):
                force[dof] += kp.get(name, 0.0) * (scene.drive[hold, i] - y[i]) - kd.get(name, 0.0) * qvel[dof]
        return force

    def _jacobian(self, qpos: Array) -> Array:
        self.data.qpos[:] = qpos
        mujoco.mj_fwdPosition(self.model, self.data)
        return self.data.efc_J.reshape(self.data.nefc, self.model.nv).copy()

    def _motion(self, qpos: Array, qvel: Array) -> Array:
        """Return the time derivative of MuJoCo's positions."""
        if not self.scene.robot.floating:
            return qvel
        w, x, y, z = qpos[3:7]
        turning = 0.5 * np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]) @ qvel[3:6]
        return np.concatenate([qvel[:3], turning, qvel[6:]])


def springs(scene: Scene, model: mujoco.MjModel) -> Callable[[Array, Array], Array]:
    """Return a function for the generalised forces of transmission springs in MuJoCo's coordinates."""
    if scene.exact != ELASTIC:
        return lambda qpos, qvel: np.zeros(model.nv)
    ties, rows, stretch = ratios(scene.robot), joint_rows(model), np.zeros((len(scene.robot.elastic), model.nv))
    for row, elastic in zip(stretch, scene.robot.elastic, strict=True):
        for name, ratio in {elastic.rotor: -1.0, **ties[elastic.rotor]}.items():
            row[rows[name][1]] = -ratio
    k, d = (np.array([getattr(e, figure) for e in scene.robot.elastic]) for figure in ("stiffness", "damping"))
    return lambda qpos, qvel: stretch.T @ (k * (stretch @ qpos) + d * (stretch @ qvel))


def _null_space(J: Array) -> Array:
    """Return an orthonormal basis of the null space of J, shape (n, n - rank)."""
    if not len(J):
        return np.eye(J.shape[1])
    _, sizes, rows = np.linalg.svd(J)
    return rows[int((sizes > 1e-9 * sizes[0]).sum()) :].T
