"""Terms of eliminated rotors that few rotors have: without symmetry about the spin axis, or behind varying ratios.

*No symmetry.* A rotor that spins by theta about a principal axis u of its inertia, centre of mass on that axis, has the
kinetic energy

    T = m |v_com|^2 / 2 + w^T I(theta) w / 2 + J thd u^T w + J thd^2 / 2        (w of the carrier, all in its frame)

because I(theta) u = J u at every angle. Its two transverse principal moments, mean +- transverse, turn with it:

    I(theta) = I_mean + dI,   dI = transverse (cos(2 theta) (e e^T - n n^T) + sin(2 theta) (e n^T + n e^T)),   n = u x e

with the axis e of the larger moment at theta = 0. I_mean is constant and merged into the carrier. ce_aba.py has the
terms with J, as for a symmetric rotor. Since (d dI/dtheta) w = 2 u x (dI w), Lagrange's equations leave

    couple on the carrier   dI wd + (w + 2 thd u) x (dI w)
    torque about the axis   -w^T (d dI/dtheta) w / 2 = u^T (w x (dI w))

and no force.

*Varying ratio.* Behind a closed loop the speed `G_r yd` of a rotor has a Jacobian `G_r(y)` that varies. The levels
`coupled` and `armature` conserve their kinetic energy T: Lagrange's equations add `dt(dT/dyd) - dT/dy`. With H the
second derivative of the rotor's angle by y, and `g_r = yd^T H yd`, the terms are

    coupled     T = J (G_r yd)^2 / 2              J G_r^T g_r
    armature    T = J sum(G_ri^2 yd_i^2) / 2      J (2 G_r * yd * (H yd) - H (G_r * yd^2))      (* entry by entry)

Both are equal if the rotor depends on one independent coordinate.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX, cross, mirrored
from ce_gym.dynamics.constraints.cluster_constraints import ClusterCoordinates
from ce_gym.dynamics.recursion.kinematics import constant
from ce_gym.model.mechanism import EliminatedRotor


@dataclass
class TransverseInertia:
    """Additional terms of a rotor's transverse inertia at one state; zero for a symmetric rotor.

    Attributes:
        inertia: dI, added to the angular inertia of the carrier [kg m^2], carrier's frame, shape (3, 3).
        couple: Velocity-product couple of the carrier's motion [N m], carrier's frame, shape (3,).
        torque: Velocity-product torque of the rotor's motion about its axis [N m].
    """

    inertia: SX
    couple: SX
    torque: SX


def transverse_inertia(rotor: EliminatedRotor, angle: SX, rate: SX, w: SX) -> TransverseInertia:
    """Return the transverse inertia of a rotor on a carrier.

    Args:
        rotor: The rotor.
        angle: Joint coordinate of the rotor [rad].
        rate: Speed of the rotor [rad/s].
        w: Angular velocity of the carrier [rad/s], carrier's frame, shape (3,).
    """
    e, n = rotor.heavy_axis, np.cross(rotor.axis, rotor.heavy_axis)
    at_zero, at_quarter = np.outer(e, e) - np.outer(n, n), np.outer(e, n) + np.outer(n, e)
    c, s = rotor.transverse * ca.cos(2 * angle), rotor.transverse * ca.sin(2 * angle)
    inertia = ca.sparsify(mirrored(c * constant(at_zero) + s * constant(at_quarter)))
    momentum, axis = ca.sparsify(inertia @ w), constant(rotor.axis)
    return TransverseInertia(inertia, cross(w + 2 * rate * axis, momentum), ca.dot(axis, cross(w, momentum)))


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
