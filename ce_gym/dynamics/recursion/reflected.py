"""Velocity terms of reflected inertia for gear ratios that depend on the pose.

Behind a closed loop the speed `G_r yd` of a rotor has a Jacobian `G_r(y)` that varies. The levels `coupled` and
`armature` conserve their kinetic energy T: Lagrange's equations add `dt(dT/dyd) - dT/dy`. With H the second derivative
of the rotor's angle by y, and `g_r = yd^T H yd`, the terms are

    coupled     T = J (G_r yd)^2 / 2              J G_r^T g_r
    armature    T = J sum(G_ri^2 yd_i^2) / 2      J (2 G_r * yd * (H yd) - H (G_r * yd^2))      (* entry by entry)

Both are equal if the rotor depends on one independent coordinate.
"""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.constraints.cluster_constraints import ClusterCoordinates


def diagonal_bias(coordinates: ClusterCoordinates, yd: SX, row: int, inertia: SX | float) -> SX:
    """Return the velocity terms of a rotor at the level `armature`, shape (d,); structurally zero for constant ratios.

    Args:
        coordinates: Coordinates of the rotor's cluster.
        yd: Independent velocities of the cluster, shape (d,).
        row: Row of the rotor.
        inertia: Moment of inertia of the rotor about its axis [kg m^2].
    """
    G_r, g_r = ca.vec(coordinates.G[row, :]), coordinates.g[row]
    if coordinates.second_derivative is None or not g_r.nnz():
        return SX(*G_r.shape)
    if ca.sparsify(G_r).nnz() == 1:
        return G_r * (inertia * g_r)
    H = coordinates.second_derivative(row)
    return inertia * (2 * G_r * yd * (H @ yd) - H @ (G_r * yd**2))
