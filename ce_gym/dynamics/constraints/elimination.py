"""Elimination of the linear constraints of a cluster: coordinates as linear functions of the other coordinates."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.clusters import Cluster
from ce_gym.model.constraints import LinearConstraint

Array = NDArray[np.float64]

SMALLEST_PIVOT = 1e-9
ROUNDING = 1e-13
"""Coefficients below this come from rounding [-]."""


@dataclass(frozen=True)
class Elimination:
    """`q = B [y; z] + q0` solves the linear constraints of a cluster.

    Attributes:
        B: Shape (n, d + m).
        q0: [rad or m], shape (n,).
        unknown: Rows of `q` that are `z`: dependent coordinates that linear constraints do not determine, shape (m,).
        left: Number of redundant linear constraints.
    """

    B: Array
    q0: Array
    unknown: tuple[int, ...]
    left: int


def linear_rows(cluster: Cluster) -> tuple[Array, Array]:
    """Return `A` (rows, n) and `b` (rows,) of the linear constraints `A q = b`."""
    ties = [tie for tie in cluster.constraints if isinstance(tie, LinearConstraint)]
    A = np.array([[dict(tie.coefficients).get(body, 0.0) for body in cluster.bodies] for tie in ties])
    return A.reshape(len(ties), len(cluster.bodies)), np.array([tie.offset for tie in ties])


def eliminate(cluster: Cluster, last: Collection[int] = ()) -> Elimination:
    """Solve the linear constraints of a cluster for dependent coordinates, by Gauss and Jordan with full pivoting.

    Args:
        cluster: The cluster.
        last: Coordinates to solve for only if there are no others.
    """
    A, b = linear_rows(cluster)
    n, M = len(cluster.bodies), np.column_stack([A, b])
    independent = [cluster.bodies.index(name) for name in cluster.independent]
    dependent = [i for i in range(n) if i not in independent]
    rows, pivots = list(range(len(A))), {}
    for is_last in (False, True):
        columns = [i for i in dependent if (i in last) == is_last]
        while rows and columns and np.abs(M[np.ix_(rows, columns)]).max() > SMALLEST_PIVOT:
            r, c = divmod(int(np.abs(M[np.ix_(rows, columns)]).argmax()), len(columns))
            row, column = rows.pop(r), columns.pop(c)
            M[row] = M[row] / M[row, column]
            others = [i for i in range(len(M)) if i != row]
            M[others] -= np.outer(M[others, column], M[row])
            pivots[column] = row
    unknown = tuple(i for i in dependent if i not in pivots)
    kept = [*independent, *unknown]
    B, q0 = np.zeros((n, len(kept))), np.zeros(n)
    B[kept, range(len(kept))] = 1.0
    for column, row in pivots.items():
        B[column], q0[column] = -M[row, kept], M[row, -1]
    return Elimination(np.where(np.abs(B) < ROUNDING, 0.0, B), q0, unknown, len(rows))
