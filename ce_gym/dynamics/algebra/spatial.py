"""Spatial vector algebra on CasADi SX, angular part first (Featherstone 2008, chapter 2).

Motion and force vectors are (6, 1) columns [angular; linear] in body coordinates. A `Transform` takes motion vectors
from a parent frame to a child frame and, transposed, forces and inertias back. All operations work on 3x3 blocks and
upper triangles, because structural zeros and shared nodes keep traced code short: a symmetric matrix holds the *same*
node in both halves.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

SX = ca.SX


def cross(a: SX, b: SX) -> SX:
    """Return the cross product of two 3-vectors."""
    return ca.cross(a, b)


def skew(x: SX) -> SX:
    """Return the matrix of the cross product, `skew(x) @ y = cross(x, y)`."""
    m = SX(3, 3)
    m[0, 1], m[0, 2], m[1, 2] = -x[2], x[1], -x[0]
    m[1, 0], m[2, 0], m[2, 1] = x[2], -x[1], x[0]
    return ca.sparsify(m)


def mirrored(m: SX) -> SX:
    """Return the symmetric matrix with the upper triangle of `m`; its lower half shares the nodes."""
    return ca.triu2symm(ca.triu(m))


def turning_force(inertia: SX, w: SX) -> SX:
    """Return the force on a body of spatial inertia (6, 6) that turns at `w` without classical acceleration, (6,).

    `[w x (I w); w x (w x m c)]` of Newton and Euler, about the body's origin.
    """
    momentum = inertia @ ca.vertcat(w, SX(3, 1))
    return ca.vertcat(cross(w, momentum[:3]), cross(w, momentum[3:]))


@dataclass(frozen=True)
class Transform:
    """Motion transform from a parent frame to a child frame, `X = [E 0; -E skew(p) E]` (Featherstone eq. 2.24).

    Attributes:
        E: Rotation that takes coordinates from parent to child, shape (3, 3).
        p: Origin of the child in parent coordinates [m], shape (3,).
    """

    E: SX
    p: SX

    @staticmethod
    def identity() -> Transform:
        """Return the transform that changes nothing."""
        return Transform(SX.eye(3), SX(3, 1))

    def motion(self, v: SX) -> SX:
        """Take a motion vector from parent to child coordinates: `X v`."""
        return ca.vertcat(self.E @ v[:3], self.E @ (v[3:] - cross(self.p, v[:3])))

    def force_to_parent(self, f: SX) -> SX:
        """Take force vectors (6, n) from child to parent coordinates: `X^T f`."""
        moment, force = self.E.T @ f[:3, :], self.E.T @ f[3:, :]
        return ca.vertcat(moment + skew(self.p) @ force, force)

    def inertia_to_parent(self, inertia: SX) -> SX:
        """Take a symmetric (6, 6) inertia from child to parent coordinates: `X^T I X`."""
        Et, E, P = self.E.T, self.E, skew(self.p)
        A = mirrored(Et @ inertia[:3, :3] @ E)
        B = Et @ inertia[:3, 3:] @ E
        C = mirrored(Et @ inertia[3:, 3:] @ E)
        B_parent = B + P @ C
        A_parent = mirrored(A + P @ B.T - B_parent @ P)
        return symmetric_blocks(A_parent, B_parent, C)

    def rigid_inertia_to_parent(self, inertia: SX) -> SX:
        """Take the (6, 6) inertia of a rigid body from child to parent coordinates, in half as many instructions."""
        mass, moment = inertia[5, 5], ca.sparsify(ca.vertcat(inertia[2, 4], inertia[0, 5], inertia[1, 3]))
        turned, P = self.E.T @ moment, skew(self.p)
        across = P @ skew(turned)
        A = mirrored(self.E.T @ inertia[:3, :3] @ self.E) - mirrored(across + across.T + mass * (P @ P))
        return symmetric_blocks(A, skew(turned + mass * self.p), mass * SX.eye(3))

    def after(self, parent: Transform) -> Transform:
        """Return the transform that applies `parent` first, then this one."""
        return Transform(self.E @ parent.E, parent.p + parent.E.T @ self.p)


def symmetric_blocks(A: SX, B: SX, C: SX) -> SX:
    """Return the symmetric matrix [[A, B], [B^T, C]]."""
    return ca.vertcat(ca.horzcat(A, B), ca.horzcat(B.T, C))


def axis_rotation(axis: SX, angle: SX) -> SX:
    """Return the coordinate rotation `E` of a joint turned by `angle` about a constant unit axis (Rodrigues)."""
    c, s, u = ca.cos(angle), ca.sin(angle), skew(axis)
    return ca.sparsify(c * SX.eye(3) + (1 - c) * (axis @ axis.T) - s * u)


def quaternion_to_rotation(quat: SX) -> SX:
    """Return the rotation matrix, body to world, of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quat[0], quat[1], quat[2], quat[3]
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return ca.vertcat(*[ca.horzcat(*row) for row in rows])


def quaternion_product(a: SX, b: SX) -> SX:
    """Return the Hamilton product of two quaternions (w, x, y, z)."""
    scalar = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3]
    return ca.vertcat(scalar, a[0] * b[1:] + b[0] * a[1:] + cross(a[1:], b[1:]))


def solve_positive_definite(A: SX, b: SX) -> SX:
    """Solve `A x = b` by the LDL^T factorisation of a small symmetric positive definite matrix; no square roots.

    Args:
        A: Symmetric positive definite, shape (n, n).
        b: Right-hand sides, shape (n, m).
    """
    n = A.shape[0]
    L, scaled, inverse_pivot = SX.eye(n), SX(n, n), []  # scaled = L diag(pivots)
    for j in range(n):
        for i in range(j, n):
            scaled[i, j] = A[i, j] - sum(scaled[i, k] * L[j, k] for k in range(j))
        inverse_pivot.append(1 / scaled[j, j])
        for i in range(j + 1, n):
            L[i, j] = scaled[i, j] * inverse_pivot[j]
    x = [b[i, :] for i in range(n)]
    for i in range(n):
        x[i] = x[i] - sum(L[i, k] * x[k] for k in range(i))
    x = [x[i] * inverse_pivot[i] for i in range(n)]
    for i in reversed(range(n)):
        x[i] = x[i] - sum(L[k, i] * x[k] for k in range(i + 1, n))
    return ca.vertcat(*x)
