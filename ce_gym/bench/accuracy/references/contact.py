"""Reference solutions of scenes with contact: the contact law of ce_gym, written again and integrated explicitly.

The law is the limit of `ce_gym.dynamics.forces.contact` for short steps. A contact of depth d > 0 that separates at v_n
has the normal force lam = max(0, k d - c v_n). Its bristle s follows the sliding velocity, s' = v_t, within
|s| <= mu lam / k_t. The friction force is min(1, mu lam / |x|) x, where x = k_t s + (mu lam / v_s) v_t. No term is
linearised or predicted, so the midpoint rule needs tiny steps. `Model` computes accelerations under wrenches. On stairs
a sphere touches the tangent plane of the surface at the point where a sphere on the plane under its centre would touch.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ce_gym.bench.accuracy.references import restated
from ce_gym.bench.accuracy.references.restated import Moving, passive, plane, pressed
from ce_gym.bench.accuracy.scenarios import HOLD, Array, Scene
from ce_gym.compile import Buffer, Call, Program, Repeat, aligned_zeros, lane_count, load_kernel, source_fingerprint
from ce_gym.dynamics.model import Model
from ce_gym.sim.kernel_key import model_key

SX = ca.SX


def explicit(scene: Scene, n: int) -> Array:
    """Return positions at the end of every hold, with `n` steps per hold, shape (n_holds, nq)."""
    model = Model(scene.robot)

    ground = "" if scene.terrain is None else f"{scene.terrain} {scene.terrain.heights[:, 0].tolist()}"
    sources = source_fingerprint(__name__, restated.__name__)
    key = f"{sources} {model_key(model)} {ground} {scene.touching} {scene.push is not None}"

    def build() -> Program:
        step = _midpoint_step(scene)
        buffers = [Buffer(name, step.numel_in(name), "tiles") for name in step.name_in()]
        call = Call(step, tuple(step.name_in()), tuple(step.name_in()[: step.n_out()]))
        return Program(f"{scene.robot.name} explicit contact", tuple(buffers), (Repeat("n", (call,)),))

    kernel = load_kernel(key, build, "float64")
    lanes = lane_count("float64")
    arrays = {name: aligned_zeros((1, buffer.size, lanes), "float64") for name, buffer in kernel.buffers.items()}
    arrays["q"][0], arrays["v"][0], arrays["dt"][:] = scene.q[:, None], scene.v[:, None], HOLD / n
    path = np.empty((scene.holds, model.nq))
    for i, target in enumerate(scene.drive):
        if len(target):
            arrays["target"][0] = target[:, None]
        if scene.push is not None:
            arrays["push"][0] = scene.push[i][:, None]
        kernel(arrays, lanes, repeats={"n": n})
        path[i] = arrays["q"][0, :, 0]
    return path


def _midpoint_step(scene: Scene) -> ca.Function:
    """Trace one explicit midpoint step of a floating robot with position control, ground contact and self-contact."""
    model = Model(scene.robot)
    q, v, s = SX.sym("q", model.nq), SX.sym("v", model.nv), SX.sym("s", 2 * len(model.contact_names))
    target, push, h = SX.sym("target", len(model.joint_links)), SX.sym("push", 3), SX.sym("dt")
    q_rate, v_rate, slide, reach = _rates(scene, model, q, v, s, target, push)
    half = q + h / 2 * q_rate, v + h / 2 * v_rate, _bent_symbols(s + h / 2 * slide, reach)
    q_rate, v_rate, slide, reach = _rates(scene, model, *half, target, push)
    q_next = q + h * q_rate
    q_next[3:7] /= ca.norm_2(q_next[3:7])
    after = {"q": q_next, "v": v + h * v_rate, "s": _bent_symbols(s + h * slide, reach)}
    before = {"q": q, "v": v, "s": s, "target": target, "push": push, "dt": h}
    given = {name: symbol for name, symbol in before.items() if symbol.numel()}  # no bristles without contacts
    changed = {name: after[name] for name in given if name in after}
    ends = [f"{name}_next" for name in changed]
    return ca.Function("step", list(given.values()), list(changed.values()), list(given), ends)


def _rates(scene: Scene, model: Model, q: SX, v: SX, s: SX, target: SX, push: SX) -> tuple[SX, SX, SX, list[SX]]:
    """Return derivatives of positions and velocities, sliding velocities, and largest lengths of bristles."""
    law, robot = model.robot.material, model.robot
    w, x, y, z = ca.vertsplit(q[3:7])
    unit = ca.vertcat(w, x, y, z) / ca.norm_2(q[3:7])
    q = ca.vertcat(q[:3], unit, q[7:])
    w, x, y, z = ca.vertsplit(unit)
    turning = ca.blockcat([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]) @ v[:3] / 2
    poses = model.casadi_function("body_poses")
    places = poses(q)
    base = places[1][:, :3]
    q_rate = ca.vertcat(base @ v[3:6], turning, v[6:])
    at_q, along = SX.sym("q", model.nq), SX.sym("q_rate", model.nq)
    at_p, R_of_q = poses(at_q)
    rotations, turns, moving = ca.Function(
        "turns", [at_q, along], [R_of_q, *(ca.jtimes(x, at_q, along) for x in (R_of_q, at_p))]
    )(q, q_rate)

    centres, velocities = model.casadi_function("contact_points")(q, v)
    wrenches, slides, reaches = [SX(6, 1) for _ in robot.bodies], [], []
    for i, sphere in enumerate(robot.contacts):
        which = model.body_names.index(sphere.body)
        columns = slice(3 * which, 3 * which + 3)
        spin = turns[:, columns] @ rotations[:, columns].T  # angular velocity of the body as a skew matrix
        height, n = plane(scene.terrain, centres[0, i], sphere.radius)
        arm, depth = -sphere.radius * n, sphere.radius - n[2] * (centres[2, i] - height)
        at, velocity = centres[:, i] + arm, velocities[:, i] + spin @ arm
        out = ca.dot(n, velocity)
        lam = ca.if_else(depth > 0, ca.fmax(law.stiffness * depth - law.damping * out, 0), 0)
        cone, slide, flat = law.friction * lam, velocity - out * n, s[2 * i : 2 * i + 2]
        bristle = ca.vertcat(flat, -ca.dot(n[:2], flat) / n[2])  # in the contact plane
        trial = law.bristle * bristle + cone / law.slip_speed * slide
        force = -ca.fmin(1, cone / ca.sqrt(ca.sumsqr(trial) + 1e-30)) * trial + lam * n
        wrenches[which] += ca.vertcat(ca.cross(at, force), force)
        slides.append(ca.if_else(lam > 0, slide[:2], 0))
        reaches.append(cone / law.bristle * ca.sqrt((ca.sumsqr(flat) + 1e-30) / (ca.sumsqr(bristle) + 1e-30)))
    bodies = Moving(model.body_names, (places[0], places[1]), turns, moving)
    for which, wrench in pressed(scene, bodies):
        wrenches[which] += wrench
    if scene.push is not None:  # at the origin of the base, which is its centre of mass
        force = robot.bodies[0].inertial.mass * push
        wrenches[0] += ca.vertcat(ca.cross(q[:3], force), force)
    kp, kd = dict(robot.gains.kp), dict(robot.gains.kd)
    torques = []
    for i, name in enumerate(robot.independent):
        joint = robot.body(name).joint
        asked = kp.get(name, 0.0) * (target[i] - q[7 + i]) - kd.get(name, 0.0) * v[6 + i]
        torques.append(ca.fmin(joint.torque, ca.fmax(-joint.torque, asked)))
    tau = ca.vertcat(SX(6, 1), *torques) - passive(model, q, v)
    v_rate = model.casadi_function("forward_dynamics_with_wrenches")(q, v, tau, ca.vertcat(*wrenches))
    return q_rate, v_rate, ca.vertcat(*slides), reaches


def _bent_symbols(s: SX, reach: list[SX]) -> SX:
    pairs = [s[2 * i : 2 * i + 2] for i in range(len(reach))]
    return ca.vertcat(*[p * ca.fmin(1, r / ca.sqrt(ca.sumsqr(p) + 1e-30)) for p, r in zip(pairs, reach, strict=True)])
