"""Semi-implicit update of positions and velocities from accelerations.

Velocities first, then positions with the new velocities. The base's linear momentum is integrated in the world frame,
so that free flight is a straight line at any spin. Orientations of the base and of ball joints move by the exponential
map, and quaternions are scaled back to unit length.
"""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, cross, quaternion_product, quaternion_to_rotation
from ce_gym.model.coordinates import Layout


def advance(q: SX, v: SX, vdot: SX, dt: float, layout: Layout) -> tuple[SX, SX]:
    """Return positions (nq,) and velocities (nv,) after a step of length `dt` [s] with constant acceleration."""
    v_next = v + dt * vdot
    turned = [rotate_quaternion(q[i : i + 4], v_next[j : j + 3] * dt) for i, j in layout.turns]
    y_next = q[layout.joints_q :] + dt * v_next[layout.joints_v :]
    if not layout.floating:
        return ca.vertcat(*turned, y_next), v_next
    w, u = v[:3], v[3:6]
    u_world = quaternion_to_rotation(q[3:7]) @ (u + dt * (vdot[3:6] + cross(w, u)))
    v_next[3:6] = quaternion_to_rotation(turned[0]).T @ u_world
    return ca.vertcat(q[:3] + dt * u_world, *turned, y_next), v_next


def rotate_quaternion(quaternion: SX, rotation: SX) -> SX:
    """Return a unit quaternion turned by a rotation vector [rad] in body axes, by the exponential map."""
    angle = ca.sqrt(ca.sumsqr(rotation) + 1e-24)  # never zero, so that sin(angle / 2) / angle stays finite
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
    sine = ca.sqrt(ca.sumsqr(u) + 1e-24)  # never zero, so that the quotient stays finite
    return 2 * ca.atan2(sine, ca.fabs(w)) / sine * ca.if_else(w < 0, -1, 1) * u
