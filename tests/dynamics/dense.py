"""Dynamics of a robot by numpy alone, as a reference: spanning tree, constraint rows, one dense solve.

Nothing of the package is used but the description. World axes and classical accelerations throughout, Jacobians joint
by joint, no recursion over inertias and no spatial vectors, so that a mistake is unlikely to be made twice.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ce_gym.model import LinearConstraint, LoopConstraint, Placement, Robot, RodConstraint

Array = np.ndarray


def skew(x: Array) -> Array:
    return np.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])


def turn(axis: Array, angle: float) -> Array:
    """Rotation about a unit axis, by Rodrigues' formula."""
    a = skew(axis)
    return np.eye(3) + np.sin(angle) * a + (1.0 - np.cos(angle)) * a @ a


def quaternion_rotation(q: Array) -> Array:
    w, r = q[0], skew(q[1:])
    return np.eye(3) + 2.0 * w * r + 2.0 * r @ r


@dataclass
class Motion:
    """A frame: pose, velocity, Jacobians, and its accelerations when all joint accelerations vanish; world axes."""

    R: Array
    p: Array
    w: Array
    v: Array
    Jw: Array
    Jv: Array
    alpha: Array
    a: Array

    def at(self, point: Array | tuple) -> Motion:
        """The same body, seen at another of its points."""
        r = self.R @ np.asarray(point)
        v = self.v + np.cross(self.w, r)
        Jv, a = self.Jv - skew(r) @ self.Jw, self.a + self.turning(r)
        return Motion(self.R, self.p + r, self.w, v, self.Jw, Jv, self.alpha, a)

    def turning(self, u: Array) -> Array:
        """Second derivative of a body-fixed vector when all joint accelerations vanish."""
        return np.cross(self.alpha, u) + np.cross(self.w, np.cross(self.w, u))

    def turned(self, R: Array) -> Motion:
        """The same body, with other axes."""
        return Motion(self.R @ R, self.p, self.w, self.v, self.Jw, self.Jv, self.alpha, self.a)

    def placed(self, placement: Placement) -> Motion:
        return self.at(placement.position).turned(np.array(placement.rotation))


@dataclass
class Dense:
    """A robot at one spanning state: `q` (nq_span,), `v` (nv_span,), in the order of `Model.spanning`."""

    robot: Robot
    q: Array
    v: Array
    gravity: Array | None = None
    bodies: dict[str, Motion] = field(default_factory=dict)
    columns: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.n = len(self.v)
        self.gravity = np.array(self.robot.gravity) if self.gravity is None else self.gravity
        zero, none = np.zeros(3), np.zeros((3, self.n))
        self.world = Motion(np.eye(3), zero, zero, zero, none, none, zero, zero)
        column = 0
        for body in self.robot.bodies:
            if body.joint.type == "free":
                self.bodies[body.name] = self._free()
                column = 6
                continue
            parent = self.frame(body.parent).placed(body.placement)
            self.columns[body.name] = column
            q = self.q[column + (1 if self.robot.floating else 0)]
            self.bodies[body.name] = self._moved(parent, body.joint.type, np.array(body.joint.axis), q, column)
            column += 1
        self.M, self.h = np.zeros((self.n, self.n)), np.zeros(self.n)
        for body in self.robot.bodies:
            m, I_body = body.inertial.mass, np.array(body.inertial.inertia)
            com = self.bodies[body.name].at(body.inertial.com)
            inertia = com.R @ I_body @ com.R.T
            self.M += m * com.Jv.T @ com.Jv + com.Jw.T @ inertia @ com.Jw
            self.h += m * com.Jv.T @ (com.a - self.gravity)
            self.h += com.Jw.T @ (inertia @ com.alpha + np.cross(com.w, inertia @ com.w))

    def frame(self, body: str | None) -> Motion:
        return self.world if body is None else self.bodies[body]

    def _free(self) -> Motion:
        R = quaternion_rotation(self.q[3:7])
        w, v = R @ self.v[:3], R @ self.v[3:6]
        Jw, Jv = np.zeros((3, self.n)), np.zeros((3, self.n))
        Jw[:, :3], Jv[:, 3:6] = R, R
        return Motion(R, self.q[:3], w, v, Jw, Jv, np.zeros(3), np.cross(w, v))

    def _moved(self, home: Motion, kind: str, axis: Array, q: float, column: int) -> Motion:
        z, rate = home.R @ axis, self.v[column]
        unit = np.zeros((1, self.n))
        unit[0, column] = 1.0
        if kind == "revolute":
            w, alpha = home.w + z * rate, home.alpha + np.cross(home.w, z * rate)
            return Motion(
                home.R @ turn(axis, q), home.p, w, home.v, home.Jw + z[:, None] * unit, home.Jv, alpha, home.a
            )
        slid = home.at(axis * q)
        a = slid.a + 2.0 * np.cross(home.w, z * rate)
        return Motion(home.R, slid.p, home.w, slid.v + z * rate, home.Jw, slid.Jv + z[:, None] * unit, home.alpha, a)

    def rows(self, tie: object) -> tuple[Array, Array, Array]:
        """phi, K and k of one constraint, redundant rows included: `phi = 0`, `K v = 0`, `K vdot = k`."""
        if isinstance(tie, LinearConstraint):
            K, base = np.zeros((1, self.n)), 1 if self.robot.floating else 0
            for body, coefficient in tie.coefficients:
                K[0, self.columns[body]] = coefficient
            phi = sum(c * self.q[self.columns[b] + base] for b, c in tie.coefficients) - tie.offset
            return np.array([phi]), K, np.zeros(1)
        if isinstance(tie, RodConstraint):
            one, two = self.frame(tie.first).at(tie.first_point), self.frame(tie.second).at(tie.second_point)
            d, rate = one.p - two.p, one.v - two.v
            phi = np.array([d @ d - tie.length**2]) / 2
            return phi, (d @ (one.Jv - two.Jv))[None], -np.array([d @ (one.a - two.a) + rate @ rate])
        assert isinstance(tie, LoopConstraint)
        one, two = (
            self.frame(tie.first).placed(tie.first_placement),
            self.frame(tie.second).placed(tie.second_placement),
        )
        phi, K, k = one.p - two.p, one.Jv - two.Jv, two.a - one.a
        if tie.joint == "ball":
            return phi, K, k
        u, w = one.R @ np.array(tie.axis), two.R @ np.array(tie.axis)
        K_axis = skew(w) @ two.Jw - skew(u) @ one.Jw
        return np.append(phi, u - w), np.vstack([K, K_axis]), np.append(k, two.turning(w) - one.turning(u))

    def constraints(self) -> tuple[Array, Array, Array]:
        """phi, K and k of all constraints, rows scaled to unit length, except those that are zero."""
        parts = [(np.zeros(0), np.zeros((0, self.n)), np.zeros(0)), *map(self.rows, self.robot.constraints)]
        phi, K, k = (np.concatenate([part[i] for part in parts]) for i in range(3))
        size = np.linalg.norm(K, axis=1)
        scale = np.where(size > 1e-9, size, 1.0)
        return phi / scale, K / scale[:, None], k / scale

    def free_directions(self) -> Array:
        """An orthonormal basis of the velocities that the constraints allow, shape (nv_span, nv)."""
        _, singular, right = np.linalg.svd(self.constraints()[1])
        return right[int((singular > 1e-8).sum()) :].T

    def acceleration(self, tau: Array) -> Array:
        """Solve `M vdot + h = tau + K^T lambda`, `K vdot = k` for vdot through the null space of K."""
        _, K, k = self.constraints()
        met = np.linalg.lstsq(K, k, rcond=1e-8)[0]
        free = self.free_directions()
        return met + free @ np.linalg.solve(free.T @ self.M @ free, free.T @ (tau - self.h - self.M @ met))

    def generalised(self, wrenches: dict[str, Array]) -> Array:
        """Spanning forces of wrenches [moment about the world's origin; force] on bodies, world axes."""
        tau = np.zeros(self.n)
        for name, wrench in wrenches.items():
            body = self.bodies[name]
            tau += body.Jw.T @ (wrench[:3] - np.cross(body.p, wrench[3:])) + body.Jv.T @ wrench[3:]
        return tau

    def energy(self) -> tuple[float, float]:
        """Kinetic and potential energy."""
        coms = [(b.inertial.mass, self.bodies[b.name].at(b.inertial.com).p) for b in self.robot.bodies]
        return self.v @ self.M @ self.v / 2, -sum(m * self.gravity @ p for m, p in coms)

    def energy_rate(self, vdot: Array) -> float:
        """Rate of change of kinetic and potential energy, body by body, for spanning accelerations."""
        rate = 0.0
        for body in self.robot.bodies:
            com = self.bodies[body.name].at(body.inertial.com)
            inertia = com.R @ np.array(body.inertial.inertia) @ com.R.T
            rate += body.inertial.mass * com.v @ (com.a + com.Jv @ vdot - self.gravity)
            rate += com.w @ inertia @ (com.alpha + com.Jw @ vdot)
        return float(rate)
