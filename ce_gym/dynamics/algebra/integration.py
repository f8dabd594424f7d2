"""Update of positions from velocities and accelerations, and the tangent space of positions.

The base moves in the axes of the world, so that free flight is a straight line at any spin. Orientations of the base
and of ball joints move by the exponential map, and quaternions are scaled back to unit length.
"""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, cross, quaternion_product, quaternion_to_rotation
from ce_gym.model.coordinates import Layout


def advance(q: SX, v: SX, vdot: SX, dt: float, layout: Layout, share: SX) -> SX:
    """Return positions (nq,) after a step of length `dt` [s] with constant acceleration.

    Each position moves at its velocity at the start of the step plus a share of the change, shape (nv,); the base moves
    so in the axes of the world.
    """
    moving = v + dt * share * vdot
    turned = [rotate_quaternion(q[i : i + 4], moving[j : j + 3] * dt) for i, j in layout.turns]
    y_next = q[layout.joints_q :] + dt * moving[layout.joints_v :]
    if not layout.floating:
        return ca.vertcat(*turned, y_next)
    u_world = quaternion_to_rotation(q[3:7]) @ (moving[3:6] + dt * share[3:6] * cross(v[:3], v[3:6]))
    return ca.vertcat(q[:3] + dt * u_world, *turned, y_next)


def integrate(q: SX, tangent: SX, layout: Layout) -> SX:
    """Return positions (nq,) after unit time at the constant velocity `tangent` (nv,): the exponential map of SE(3).

    The base moves by `R (u + b w x u + c w x (w x u))`, with `b = (1 - cos t) / t^2`, `c = (t - sin t) / t^3` and the
    angle `t = |w|`.
    """
    turned = [rotate_quaternion(q[i : i + 4], tangent[j : j + 3]) for i, j in layout.turns]
    joints = q[layout.joints_q :] + tangent[layout.joints_v :]
    if not layout.floating:
        return ca.vertcat(*turned, joints)
    w, u = tangent[:3], tangent[3:6]
    angle = _length(w)
    b, c = 2 * (ca.sin(angle / 2) / angle) ** 2, (angle - ca.sin(angle)) / angle**3
    moved = u + b * cross(w, u) + c * cross(w, cross(w, u))
    return ca.vertcat(q[:3] + quaternion_to_rotation(q[3:7]) @ moved, *turned, joints)


def difference(q: SX, q_end: SX, layout: Layout) -> SX:
    """Return the velocity (nv,) that moves `q` to `q_end` in unit time, the inverse of `integrate`."""
    ends = zip(*[[x[i : i + 4] for i, _ in layout.turns] for x in (q, q_end)], strict=True)
    turns = [rotation_vector(quaternion_product(ca.vertcat(a[0], -a[1:]), b)) for a, b in ends]
    joints = q_end[layout.joints_q :] - q[layout.joints_q :]
    if not layout.floating:
        return ca.vertcat(*turns, joints)
    w, moved = turns[0], quaternion_to_rotation(q[3:7]).T @ (q_end[:3] - q[:3])
    half = _length(w) / 2
    d = (1 - half * ca.cos(half) / ca.sin(half)) / (4 * half**2)
    u = moved - cross(w, moved) / 2 + d * cross(w, cross(w, moved))
    return ca.vertcat(w, u, *turns[1:], joints)


def _length(x: SX) -> SX:
    """Return the norm of a vector, never zero, so that quotients stay finite."""
    return ca.sqrt(ca.sumsqr(x) + 1e-24)


def tangent_basis(q: SX, layout: Layout) -> SX:
    """Return the derivative of positions (nq,) by their tangent, shape (nq, nv)."""
    turning = [_turning(q[i : i + 4]) for i, _ in layout.turns]
    if layout.floating:
        turning[0] = ca.blockcat([[SX(3, 3), quaternion_to_rotation(q[3:7])], [turning[0], SX(4, 3)]])
    return ca.diagcat(*turning, SX.eye(layout.joints))


def _turning(quaternion: SX) -> SX:
    """Return the derivative of a quaternion by a rotation about the axes of its body, shape (4, 3)."""
    return ca.horzcat(*[quaternion_product(quaternion, ca.vertcat(0, SX.eye(3)[:, i])) / 2 for i in range(3)])


def rotate_quaternion(quaternion: SX, rotation: SX) -> SX:
    """Return a unit quaternion turned by a rotation vector [rad] in body axes, by the exponential map."""
    angle = _length(rotation)
    half_turn = ca.vertcat(ca.cos(angle / 2), ca.sin(angle / 2) / angle * rotation)
    product = quaternion_product(quaternion, half_turn)
    return product / ca.sqrt(ca.sumsqr(product))


def rotation_between(a: SX, b: SX) -> SX:
    """Return the small rotation vector [rad], body axes, that takes unit quaternion `a` to `b`; shape (3,).

    The vector part of the relative quaternion is half of its sine; the arcsine is expanded to third order, which is far
    below the error of two results that approximate the same orientation.
    """
    relative = quaternion_product(ca.vertcat(a[0], -a[1:]), b)
    sine = ca.if_else(relative[0] < 0, -1, 1) * relative[1:]
    return 2 * sine * (1 + ca.sumsqr(sine) / 6)


def rotation_vector(quaternion: SX) -> SX:
    """Return the rotation vector [rad] of a unit quaternion, at most half a turn long; shape (3,)."""
    w, u = quaternion[0], quaternion[1:]
    sine = _length(u)
    return 2 * ca.atan2(sine, ca.fabs(w)) / sine * ca.if_else(w < 0, -1, 1) * u
