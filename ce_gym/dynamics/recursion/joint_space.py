"""The equation of motion in joint space, `H x + p = tau`, and its solution by elimination from the tips to the base.

`x` are the accelerations of the base and of the independent coordinates. Accelerations of the base are in world axes,
the linear one of its origin. The velocity of a point of the robot then changes in a step by `dt J x`, without gravity
and velocity products. `H` has composite inertias (the composite rigid-body algorithm), condensed with `G`
cluster by cluster as in ce_aba.py; `p` is inverse dynamics at `x = 0`.

A linearly implicit force `f - C J x` at a point adds `J^T C J` to `H` and `J^T f` to `tau`. Elimination starts at the
tips, so that nothing fills in, and its pivots are the matrices `D` of CE-ABA (Featherstone 2008, section 6.5). `H`, `p`
and `J` depend on the state alone. In further iterations of a step only the products with `C`, the elimination and the
back substitution are repeated, where CE-ABA repeats the transforms of articulated inertias. The rows above a joint grow
with its distance from the base, so that this pays for short branches only, see `LONGEST_BRANCH`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, mirrored, skew, solve_positive_definite, symmetric_blocks
from ce_gym.dynamics.constraints.cluster_constraints import ClusterCoordinates
from ce_gym.dynamics.recursion.ce_aba import (
    Articulation,
    Condensed,
    Condenser,
    JointTerms,
    add_transverse_inertias,
    eliminate,
    gravity_acceleration,
)
from ce_gym.dynamics.recursion.ce_rnea import inward_force_pass, net_forces, outward_acceleration
from ce_gym.dynamics.recursion.gyroscopic import TurningDamping
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant, independent_rows, is_free
from ce_gym.model.mechanism import Mechanism

LONGEST_BRANCH = 9
"""Most coordinates between world and tip, those of a floating base included, up to which this takes less time than
CE-ABA. In a step of two iterations, quadrupeds with three joints a leg need 0.80 of the operations and of the time.
Humanoids with five joints a leg need 0.92 of the operations but the same time, and 1.2 of the time in one iteration."""


@dataclass
class JointSpace:
    """The equation of motion of a mechanism in joint space, without forces on coordinates.

    Attributes:
        mechanism: The mechanism.
        kinematics: From the outward velocity pass.
        H: Inertia, shape (nv, nv).
        p: Bias force: gravity, velocity products and external forces, shape (nv,).
    """

    mechanism: Mechanism
    kinematics: Kinematics
    H: SX
    p: SX

    @staticmethod
    def of(mechanism: Mechanism, kinematics: Kinematics, external: dict[str, SX]) -> JointSpace:
        """Return the equation of motion under constant forces on bodies, body coordinates, shape (6,) each."""
        H, p = composite_inertia(mechanism, kinematics), bias_force(mechanism, kinematics, external)
        if mechanism.robot.floating:
            R = next(iter(kinematics.bodies.values())).R
            I, moment, mass = H[:3, :3], ca.sparsify(ca.vertcat(H[2, 4], H[0, 5], H[1, 3])), H[5, 5]
            H[:6, :6] = symmetric_blocks(mirrored(R @ I @ R.T), skew(R @ moment), mass * SX.eye(3))
            H[:6, 6:] = ca.vertcat(R @ H[:3, 6:], R @ H[3:6, 6:])
            H[6:, :6] = H[:6, 6:].T
            p[:6] = ca.vertcat(R @ p[:3], R @ p[3:6])
        return JointSpace(mechanism, kinematics, H, p)

    def jacobian(self, body: str, point: SX) -> SX:
        """Return the Jacobian of a point [m] of a body, world axes, shape (3, nv)."""
        return point_jacobian(self.mechanism, self.kinematics, body, point)

    def add_force(self, J: SX, force: SX, slope: SX) -> None:
        """Add the generalised force `J^T (force - slope J x)`, in place.

        Args:
            J: Jacobian of the motion that the force does work on, shape (n, nv).
            force: At `x = 0` [N], shape (n,).
            slope: Symmetric [kg], shape (n, n).
        """
        columns = [i for i in range(J.shape[1]) if J[:, i].nnz()]
        J_point = J[:, columns]
        H = mirrored(ca.mac(J_point.T, slope @ J_point, ca.densify(self.H[columns, columns])))
        self.H[columns, columns], self.p[columns] = H, ca.mac(J_point.T, -force, self.p[columns])

    def add_where(self, acts: SX, forces: Sequence[tuple[SX, SX, SX]]) -> None:
        """Add forces where they act, in place; each as for `add_force`."""
        H, p = SX(*self.H.shape), SX(*self.p.shape)
        for J, force, slope in forces:
            H, p = H + mirrored(J.T @ (slope @ J)), p - J.T @ force
        self.H, self.p = mirrored(self.H + ca.if_else(acts, H, 0)), self.p + ca.if_else(acts, p, 0)

    def eliminate(self, joints: JointTerms, turning: TurningDamping | None) -> Articulation:
        """Eliminate the clusters from the tips to the base.

        Args:
            joints: Forces on the independent coordinates.
            turning: Damping of joints on turning bodies, if there is a step.
        """
        mechanism, kinematics, H, p = self.mechanism, self.kinematics, SX(self.H), SX(self.p)
        articulation, above = Articulation(), rows_above(mechanism, kinematics.rows)
        for k in mechanism.tree.tip_to_base():
            rows, on = kinematics.rows[k], above[k]
            if is_free(mechanism, mechanism.tree.clusters[k]):
                articulation.base = H[rows, rows], -p[rows]
            else:
                condensed = Condensed(H[rows, rows], H[on, rows], p[rows], H[on, on], p[on, 0])
                H[on, on], p[on, 0] = eliminate(articulation, mechanism, kinematics, k, condensed, joints, turning)
        return articulation

    def acceleration(self, articulation: Articulation) -> SX:
        """Return the accelerations `x`, shape (nv,), given the result of `eliminate`."""
        x, above = SX(self.p.numel(), 1), rows_above(self.mechanism, self.kinematics.rows)
        for k in self.mechanism.tree.base_to_tip():
            rows = self.kinematics.rows[k]
            if not is_free(self.mechanism, self.mechanism.tree.clusters[k]):
                x[rows] = articulation.acceleration(k, x[above[k], 0])
            else:
                x[rows] = solve_positive_definite(*articulation.base)  # type: ignore[misc]
        return x


def has_short_branches(mechanism: Mechanism) -> bool:
    """Whether no branch is longer than `LONGEST_BRANCH`."""
    rows = independent_rows(mechanism)
    return all(len(on) + len(rows[k]) <= LONGEST_BRANCH for k, on in rows_above(mechanism, rows).items())


def rows_above(mechanism: Mechanism, rows: list[list[int]]) -> dict[int, list[int]]:
    """Return the rows of `v` between each cluster and the world, the base's first, given the rows of all clusters."""
    above: dict[int, list[int]] = {}
    for k in mechanism.tree.base_to_tip():
        output = mechanism.tree.clusters[k].output_body
        below = None if output is None else mechanism.tree.cluster_of(output)
        above[k] = [] if below is None else above[below] + rows[below]
    return above


def composite_inertia(mechanism: Mechanism, kinematics: Kinematics) -> SX:
    """Return the joint-space inertia by composite inertias, the base in its own axes, shape (nv, nv)."""
    IA = {name: constant(body.inertia) for name, body in mechanism.bodies.items()}
    unused = {name: SX(6, 1) for name in IA}
    nv = sum(len(rows) for rows in kinematics.rows)
    H = SX(nv, nv)
    for k in mechanism.tree.tip_to_base():
        cluster, rows = mechanism.tree.clusters[k], kinematics.rows[k]
        if is_free(mechanism, cluster):
            H[rows, rows] = IA[cluster.bodies[0]]
            continue
        add_transverse_inertias(mechanism, kinematics, k, IA, unused)
        condensed = Condenser(mechanism, kinematics, k, rigid=True).condense(IA, unused)
        H[rows, rows] = condensed.D
        if cluster.output_body is not None:
            IA[cluster.output_body] += condensed.inertia
            for on, coupling in _couplings(mechanism, kinematics, cluster.output_body, condensed.U):
                H[on, rows], H[rows, on] = coupling, coupling.T
    return H


def _couplings(mechanism: Mechanism, kinematics: Kinematics, body: str, force: SX) -> list[tuple[list[int], SX]]:
    """Take forces on a body, shape (6, m), to the coordinates between it and the base; return rows and (d, m) each."""
    couplings, at = [], body
    while at is not None:
        k = mechanism.tree.cluster_of(at)
        if is_free(mechanism, mechanism.tree.clusters[k]):
            couplings.append((kinematics.rows[k], force))
            break
        coordinates: ClusterCoordinates = kinematics.coordinates[k]  # type: ignore[assignment]
        torques = SX(coordinates.qd.numel(), force.shape[1])
        while at is not None and mechanism.tree.cluster_of(at) == k:
            state = kinematics.bodies[at]
            torques[coordinates.index[at], :] = state.S.T @ force
            force, at = state.X.force_to_parent(force), mechanism.bodies[at].parent
        couplings.append((kinematics.rows[k], coordinates.G.T @ torques))
    return couplings


def bias_force(mechanism: Mechanism, kinematics: Kinematics, external: dict[str, SX]) -> SX:
    """Return the generalised force at rest in `x`, the base in its own axes, shape (nv,)."""
    nv, base = sum(len(rows) for rows in kinematics.rows), next(iter(kinematics.bodies.values()))
    at_rest = ca.vertcat(SX(3, 1), -base.R.T @ gravity_acceleration(mechanism))
    a, qdd = outward_acceleration(mechanism, kinematics, SX(nv, 1), at_rest)
    forces = net_forces(mechanism, kinematics, a)
    for name, force in external.items():
        forces[name] -= force
    return inward_force_pass(mechanism, kinematics, a, forces, qdd)


def point_jacobian(mechanism: Mechanism, kinematics: Kinematics, body: str, point: SX) -> SX:
    """Return the Jacobian of a point [m] of a body, world axes, shape (3, nv)."""
    J = SX(3, sum(len(rows) for rows in kinematics.rows))
    at, arm = body, kinematics.bodies[body].R @ point
    while at is not None:
        k = mechanism.tree.cluster_of(at)
        rows = kinematics.rows[k]
        if is_free(mechanism, mechanism.tree.clusters[k]):
            J[:, rows] = ca.horzcat(-skew(arm), SX.eye(3))
            break
        coordinates: ClusterCoordinates = kinematics.coordinates[k]  # type: ignore[assignment]
        spanning = SX(3, coordinates.qd.numel())
        while at is not None and mechanism.tree.cluster_of(at) == k:
            state, parent = kinematics.bodies[at], mechanism.bodies[at].parent
            turn, slide = state.R @ state.S[:3, :], state.R @ state.S[3:, :]
            spanning[:, coordinates.index[at]] = slide - skew(arm) @ turn
            arm += (kinematics.bodies[parent].R if parent is not None else SX.eye(3)) @ state.X.p
            at = parent
        J[:, rows] = spanning @ coordinates.G
    return ca.sparsify(J)


def base_acceleration(mechanism: Mechanism, kinematics: Kinematics, x: SX) -> SX:
    """Return accelerations in the coordinates of `v`, given `x`, shape (nv,)."""
    vdot = SX(x)
    if mechanism.robot.floating:
        base = next(iter(kinematics.bodies.values()))
        vdot[:3], vdot[3:6] = base.R.T @ x[:3], base.R.T @ x[3:6] - ca.cross(base.v[:3], base.v[3:])
    return vdot
