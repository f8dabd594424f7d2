"""Semi-implicit update of positions and velocities from accelerations.

Velocities first, then positions with the new velocities. The base's linear momentum is integrated in the world frame,
so that free flight is a straight line whatever the spin; its orientation moves by the exponential map and the
quaternion is scaled back to unit length.
"""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, cross, quaternion_product, quaternion_to_rotation


def advance(q: SX, v: SX, vdot: SX, dt: float, floating: bool) -> tuple[SX, SX]:
    """Return positions (nq,) and velocities (nv,) after a step of length `dt` [s] with constant acceleration."""
    if not floating:
        v_next = v + dt * vdot
        return q + dt * v_next, v_next
    position, quaternion, w, u = q[:3], q[3:7], v[:3], v[3:6]
    R = quaternion_to_rotation(quaternion)
    w_next = w + dt * vdot[:3]
    u_world = R @ (u + dt * (vdot[3:6] + cross(w, u)))
    yd_next = v[6:] + dt * vdot[6:]
    quaternion_next = turned_by(quaternion, w_next * dt)
    u_next = quaternion_to_rotation(quaternion_next).T @ u_world
    q_next = ca.vertcat(position + dt * u_world, quaternion_next, q[7:] + dt * yd_next)
    return q_next, ca.vertcat(w_next, u_next, yd_next)


def turned_by(quaternion: SX, rotation: SX) -> SX:
    """Return a unit quaternion turned by a rotation vector [rad] in body axes, by the exponential map."""
    angle = ca.sqrt(ca.sumsqr(rotation) + 1e-24)  # never zero, so that sin(angle / 2) / angle stays finite
    half_turn = ca.vertcat(ca.cos(angle / 2), ca.sin(angle / 2) / angle * rotation)
    product = quaternion_product(quaternion, half_turn)
    return product / ca.sqrt(ca.sumsqr(product))


def between(a: SX, b: SX) -> SX:
    """Return the small rotation vector [rad], body axes, that takes unit quaternion `a` to `b`; shape (3,).

    The vector part of the relative quaternion is half of its sine; the arcsine is expanded to third order, which is far
    below the error of two results that approximate the same orientation.
    """
    relative = quaternion_product(ca.vertcat(a[0], -a[1:]), b)
    sine = ca.if_else(relative[0] < 0, -1, 1) * relative[1:]
    return 2 * sine * (1 + ca.sumsqr(sine) / 6)
