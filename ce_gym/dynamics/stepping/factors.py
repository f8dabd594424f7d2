"""Sparse factors of matrices with the sparsity of a tree of joints, without pivoting, and solutions with them."""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX


def factorised(A: SX, order: list[int]) -> SX:
    """Factorise a matrix `A = U L` with positive definite symmetric part, from tips to base, which avoids fill-in.

    Args:
        A: Shape (n, n).
        order: Rows of the matrix, the rows of a body before the rows of its children.

    Returns:
        Shape (n, n): reciprocals of the pivots on the diagonal; in the given order, `U` above, whose diagonal is 1, and
        `L` below, whose diagonal has the pivots.
    """
    A = SX(A)
    for place in reversed(range(len(order))):
        i, above = order[place], order[:place]
        A[i, i] = 1 / A[i, i]
        for j in above:
            if A.sparsity().has_nz(j, i):
                A[j, i] = A[j, i] * A[i, i]
                for k in above:
                    if A.sparsity().has_nz(i, k):
                        A[j, k] = A[j, k] - A[j, i] * A[i, k]
    return A


def solved_with(factor: SX, order: list[int], b: SX) -> SX:
    """Solve `A x = b` for right-hand sides (n, m), given the result of `factorised`."""
    known, x = factor.sparsity(), [b[i, :] for i in range(b.shape[0])]
    for place in reversed(range(len(order))):
        for j in order[:place]:
            if known.has_nz(j, order[place]):
                x[j] -= factor[j, order[place]] * x[order[place]]
    for place, i in enumerate(order):
        for j in order[:place]:
            if known.has_nz(i, j):
                x[i] -= factor[i, j] * x[j]
        x[i] *= factor[i, i]
    return ca.vertcat(*x)
