"""Clusters with elastic transmissions: stretches are eliminated before joints.

A stretch is a coordinate with a sparse column of `U`: the momentum of a rotor along one axis. Stretches are the last
coordinates. With `D = L diag(pivots) L^T` from the last coordinate to the first,

    L left = [U^T, u],   U D^-1 U^T = left^T diag(pivots)^-1 left,   L^T ydd = diag(pivots)^-1 (left_u - left_U a),

a stretch adds one entry to a joint's column, while eliminating a joint first would fill the column of the stretch. The
outward pass needs as many instructions as without stretches.

Forces on coordinates are known before the outer bodies. They are summed with the terms of the elimination first, and
added to the articulated inertia last, so that one number is stored instead of one for each term.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, mirrored
from ce_gym.model.clusters import Cluster
from ce_gym.model.mechanism import Mechanism


@dataclass
class Stretched:
    """A cluster after elimination; rows are in reverse order, the last coordinate first.

    Attributes:
        L: Lower triangle with ones, shape (d, d).
        left: `L^-1 [U^T, u]`, shape (d, n + 1); n = 6 in CE-ABA.
        scaled: `diag(pivots)^-1 left`, shape (d, n + 1).
    """

    L: SX
    left: SX
    scaled: SX

    @staticmethod
    def of(inertia: SX, slope: SX, biased: SX, tau: SX) -> Stretched:
        """Eliminate the coordinates of a cluster.

        Args:
            inertia: `D` without `slope`, shape (d, d).
            slope: Slope of forces on coordinates, added to `inertia`, shape (d, d).
            biased: `[U^T, u]` without forces on coordinates, shape (d, n + 1).
            tau: Forces on coordinates, shape (d,).
        """
        n, forces = tau.numel(), ca.horzcat(SX(tau.numel(), biased.shape[1] - 1), tau)[::-1, :]
        inertia, slope, biased = inertia[::-1, ::-1], slope[::-1, ::-1], biased[::-1, :]
        L, pivoted, inverse_pivot, left = SX.eye(n), SX(n, n), [], []  # pivoted = L diag(pivots)
        for j in range(n):
            for i in range(j, n):
                pivoted[i, j] = inertia[i, j] + (slope[i, j] - sum(pivoted[i, k] * L[j, k] for k in range(j)))
            inverse_pivot.append(1 / pivoted[j, j])
            for i in range(j + 1, n):
                L[i, j] = pivoted[i, j] * inverse_pivot[j]
            left.append(biased[j, :] + (forces[j, :] - sum(L[j, k] * left[k] for k in range(j))))
        scaled = [row * inverse for row, inverse in zip(left, inverse_pivot, strict=True)]
        return Stretched(L, ca.vertcat(*left), ca.vertcat(*scaled))

    def articulated(self, inertia: SX, force: SX) -> tuple[SX, SX]:
        """Return `inertia - U D^-1 U^T`, its upper triangle mirrored, and `force + U D^-1 u`, (n, n) and (n,)."""
        for j in range(self.L.shape[0]):
            U, scaled = self.left[j, :-1].T, self.scaled[j, :]
            inertia, force = inertia - U @ scaled[:-1], force + U @ scaled[-1]
        return mirrored(inertia), force

    def acceleration(self, a: SX) -> SX:
        """Return `D^-1 (u - U^T a)`, shape (d,), of a cluster whose handle accelerates by `a`, shape (n,)."""
        n, ydd = self.L.shape[0], self.scaled[:, -1] - self.scaled[:, :-1] @ a
        for i in reversed(range(n)):
            ydd[i] -= sum(self.L[k, i] * ydd[k] for k in range(i + 1, n))
        return ydd[::-1]


def stretches(mechanism: Mechanism, cluster: Cluster) -> bool:
    """Whether a cluster has an elastic transmission."""
    return any(mechanism.robot.body(name).kind == "stretch" for name in cluster.independent)
