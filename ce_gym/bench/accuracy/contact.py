"""What scenes with contact really do by our contact law, written a second time and integrated explicitly.

The law is that of `ce_gym.dynamics.forces.contact` in the limit of no step length: a contact of depth d > 0 that moves
out at v_n pushes with lam = max(0, k d - c v_n). Its bristle s follows the sliding velocity, s' = v_t, as far as
|s| <= mu lam / k_t; it resists with min(1, mu lam / |x|) x, where x = k_t s + (mu lam / v_s) v_t. Nothing here is
linearised, predicted or taken one step ahead, so the steps have to be tiny. The block is plain numpy and rigid-body
mechanics; robots take the acceleration from `Model`'s forward dynamics under wrenches. Midpoint rule throughout.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ce_gym.bench.accuracy.scenarios import HOLD, Array, Scene
from ce_gym.compile import Buffer, Call, Program, Repeat, aligned_zeros, lane_count, load_kernel, source_fingerprint
from ce_gym.dynamics.model import Model
from ce_gym.sim.kernel_key import model_key

SX = ca.SX


def block(scene: Scene, n: int) -> Array:
    """Return positions of a block at the end of every hold, with `n` steps to a hold, shape (n_holds, 7)."""
    robot, law = scene.robot, scene.robot.material
    body = robot.bodies[0].inertial
    corners, J = np.array([c.position for c in robot.contacts]), np.array(body.inertia)
    gravity, h = np.array(robot.gravity), HOLD / n
    push = np.zeros((scene.holds, 3)) if scene.push is None else scene.push
    p, R, v, w, s = scene.q[:3].copy(), np.eye(3), np.zeros(3), np.zeros(3), np.zeros((len(corners), 2))

    def forces(p: Array, R: Array, v: Array, w: Array, s: Array) -> tuple[Array, Array, Array, Array]:
        """Linear and angular acceleration, sliding velocities, and how far bristles may bend."""
        arms = corners @ R.T
        velocity = v + np.cross(R @ w, arms)
        depth, up, slide = -(p[2] + arms[:, 2]), velocity[:, 2], velocity[:, :2]
        lam = np.where(depth > 0, np.maximum(law.stiffness * depth - law.damping * up, 0.0), 0.0)
        cone = law.friction * lam
        x = law.bristle * s + (cone / law.slip_speed)[:, None] * slide
        size = np.maximum(np.hypot(x[:, 0], x[:, 1]), 1e-30)
        f = np.column_stack([-np.minimum(1.0, cone / size)[:, None] * x, lam])
        moment = R.T @ np.cross(arms, f).sum(axis=0)
        return (
            gravity + push[hold] + f.sum(axis=0) / body.mass,
            np.linalg.solve(J, moment - np.cross(w, J @ w)),
            slide * (lam > 0)[:, None],
            cone / law.bristle,
        )

    path = np.empty((scene.holds, 7))
    for hold in range(scene.holds):
        for _ in range(n):
            a, alpha, slide, reach = forces(p, R, v, w, s)
            middle = p + h / 2 * v, _turned(R, h / 2 * w), v + h / 2 * a, w + h / 2 * alpha
            a, alpha, slide, reach = forces(*middle, _bent(s + h / 2 * slide, reach))
            p, R = p + h * middle[2], _turned(R, h * middle[3])
            v, w = v + h * a, w + h * alpha
            s = _bent(s + h * slide, reach)
        path[hold] = [*p, *_quaternion(R)]
    return path


def _bent(s: Array, reach: Array) -> Array:
    size = np.maximum(np.hypot(s[:, 0], s[:, 1]), 1e-30)
    return s * np.minimum(1.0, reach / size)[:, None]


def _turned(R: Array, rotation: Array) -> Array:
    """Rodrigues' formula."""
    angle = float(np.linalg.norm(rotation))
    if angle == 0.0:
        return R
    x, y, z = rotation / angle
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return R @ (np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)


def _quaternion(R: Array) -> Array:
    """Of a rotation by less than half a turn."""
    w = np.sqrt(1.0 + np.trace(R)) / 2
    return np.array([w, *(np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w))])


def robot(scene: Scene, n: int) -> Array:
    """Return positions of a robot at the end of every hold, with `n` steps to a hold, shape (n_holds, nq)."""
    model = Model(scene.robot)

    def build() -> Program:
        step = _midpoint_step(model)
        buffers = [Buffer(name, step.numel_in(name), "tiles") for name in step.name_in()]
        call = Call(step, tuple(step.name_in()), ("q", "v", "s"))
        return Program(f"{scene.robot.name} explicit contact", tuple(buffers), (Repeat("n", (call,)),))

    kernel = load_kernel(f"{source_fingerprint(__name__)} {model_key(model)}", build, "float64")
    lanes = lane_count("float64")
    arrays = {name: aligned_zeros((1, buffer.size, lanes), "float64") for name, buffer in kernel.buffers.items()}
    arrays["q"][0], arrays["v"][0], arrays["dt"][:] = scene.q[:, None], scene.v[:, None], HOLD / n
    path = np.empty((scene.holds, model.nq))
    for i, target in enumerate(scene.drive):
        arrays["target"][0] = target[:, None]
        kernel(arrays, lanes, repeats={"n": n})
        path[i] = arrays["q"][0, :, 0]
    return path


def _midpoint_step(model: Model) -> ca.Function:
    """Trace one explicit midpoint step of a floating robot under position control, feet against the plane z = 0."""
    q, v, s = SX.sym("q", model.nq), SX.sym("v", model.nv), SX.sym("s", 2 * len(model.contact_names))
    target, h = SX.sym("target", len(model.joint_links)), SX.sym("dt")
    q_rate, v_rate, slide, reach = _rates(model, q, v, s, target)
    half = q + h / 2 * q_rate, v + h / 2 * v_rate, _bent_symbols(s + h / 2 * slide, reach)
    q_rate, v_rate, slide, reach = _rates(model, *half, target)
    q_next = q + h * q_rate
    q_next[3:7] /= ca.norm_2(q_next[3:7])
    after = [q_next, v + h * v_rate, _bent_symbols(s + h * slide, reach)]
    names = ["q", "v", "s"]
    return ca.Function(
        "step", [q, v, s, target, h], after, [*names, "target", "dt"], [f"{name}_next" for name in names]
    )


def _rates(model: Model, q: SX, v: SX, s: SX, target: SX) -> tuple[SX, SX, SX, list[SX]]:
    """Return time derivatives of positions and velocities, sliding velocities, and how far bristles may bend."""
    law, robot = model.robot.material, model.robot
    w, x, y, z = ca.vertsplit(q[3:7])
    unit = ca.vertcat(w, x, y, z) / ca.norm_2(q[3:7])
    q = ca.vertcat(q[:3], unit, q[7:])
    w, x, y, z = ca.vertsplit(unit)
    turning = ca.blockcat([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]) @ v[:3] / 2
    poses = model.casadi_function("body_poses")
    base = poses(q)[1][:, :3]
    q_rate = ca.vertcat(base @ v[3:6], turning, v[6:])
    at_q, along = SX.sym("q", model.nq), SX.sym("q_rate", model.nq)
    R_of_q = poses(at_q)[1]
    rotations, turns = ca.Function("turns", [at_q, along], [R_of_q, ca.jtimes(R_of_q, at_q, along)])(q, q_rate)

    centres, velocities = model.casadi_function("contact_points")(q, v)
    wrenches, slides, reaches = [SX(6, 1) for _ in robot.bodies], [], []
    for i, sphere in enumerate(robot.contacts):
        which = model.body_names.index(sphere.body)
        columns = slice(3 * which, 3 * which + 3)
        spin = turns[:, columns] @ rotations[:, columns].T  # of the body, as a skew matrix
        arm = SX([0.0, 0.0, -sphere.radius])
        at, velocity = centres[:, i] + arm, velocities[:, i] + spin @ arm
        lam = ca.if_else(at[2] < 0, ca.fmax(-law.stiffness * at[2] - law.damping * velocity[2], 0), 0)
        cone = law.friction * lam
        trial = law.bristle * s[2 * i : 2 * i + 2] + cone / law.slip_speed * velocity[:2]
        force = ca.vertcat(-ca.fmin(1, cone / ca.sqrt(ca.sumsqr(trial) + 1e-30)) * trial, lam)
        wrenches[which] += ca.vertcat(ca.cross(at, force), force)
        slides.append(ca.if_else(lam > 0, velocity[:2], 0))
        reaches.append(cone / law.bristle)
    kp, kd = dict(robot.gains.kp), dict(robot.gains.kd)
    torques = []
    for i, name in enumerate(robot.independent):
        joint = robot.body(name).joint
        asked = kp.get(name, 0.0) * (target[i] - q[7 + i]) - kd.get(name, 0.0) * v[6 + i]
        torques.append(ca.fmin(joint.torque, ca.fmax(-joint.torque, asked)) - joint.damping * v[6 + i])
    tau = ca.vertcat(SX(6, 1), *torques)
    v_rate = model.casadi_function("forward_dynamics_with_wrenches")(q, v, tau, ca.vertcat(*wrenches))
    return q_rate, v_rate, ca.vertcat(*slides), reaches


def _bent_symbols(s: SX, reach: list[SX]) -> SX:
    pairs = [s[2 * i : 2 * i + 2] for i in range(len(reach))]
    return ca.vertcat(*[p * ca.fmin(1, r / ca.sqrt(ca.sumsqr(p) + 1e-30)) for p, r in zip(pairs, reach, strict=True)])
