"""Forward dynamics by the constraint-embedding articulated-body algorithm (CE-ABA), two of its three passes.

The paper stacks the bodies of a cluster into one big link. Here each cluster is condensed to the frame where it hangs
on its output body, its *handle*: inside a cluster, composite inertias and forces are collected as in the composite
rigid-body algorithm and projected by the constraint Jacobian `G`,

    D = G^T H G,   U = F G,   u = tau - G^T (bias),    with H, F of the cluster's spanning tree,

which equals `S^T IA S`, `IA S` and `tau - S^T pA` of the paper's Alg. 1 because `IA` is block diagonal, and costs less.

An `EliminatedRotor` has momentum `h thd` along a constant axis of its carrier c (`h = [J u; 0]`, a pure couple). With
`thd = G_r yd`, `a_c = X_c a + S_c ydd + z_c` it adds

    D += G_r^T J G_r + S_c^T h G_r + (S_c^T h G_r)^T     U += X_c^T h G_r
    u -= G_r^T (J g_r + h^T z_c) + S_c^T f               p += X_c^T f,   f = h g_r + v_c x* h thd

where S_c and z_c vanish if c is the output body. A rotor that is not symmetric adds a little more to its carrier and to
u, see rotors.py. A cluster whose transmissions stretch is eliminated in another order, see stretched.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import (
    SX,
    Transform,
    cross,
    mirrored,
    solve_positive_definite,
    symmetric_blocks,
    turning_force,
)
from ce_gym.dynamics.constraints.cluster_constraints import ClusterCoordinates
from ce_gym.dynamics.recursion.gyroscopic import TurningDamping
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant, is_free
from ce_gym.dynamics.recursion.rotors import diagonal_bias, transverse_inertia
from ce_gym.dynamics.recursion.stretched import Stretched, stretches
from ce_gym.model.clusters import Cluster
from ce_gym.model.mechanism import EliminatedRotor, Mechanism, MovingBody, snapped


@dataclass
class JointTerms:
    """Forces on the independent coordinates, linearised over one time step: `tau - slope * ydd`.

    Attributes:
        tau: Generalised forces, base wrench [moment; force] first, shape (nv,).
        slope: Added to `D`: implicit damping and stiffness [kg m^2 or kg], shape (nv, nv); zero between clusters.
    """

    tau: SX
    slope: SX


@dataclass
class BodyTerms:
    """Forces on a body, linearised over one time step: `force - inertia * a`, with `a` free of gravity.

    Attributes:
        inertia: Added to the articulated inertia, shape (6, 6).
        force: Wrench [moment; force] on the body, body coordinates, shape (6,).
    """

    inertia: SX
    force: SX


@dataclass
class Articulation:
    """Results of the inward pass for the outward pass, for each cluster.

    Attributes:
        U: Force at the handle for a unit independent acceleration, shape (6, d).
        D: Inertia of the cluster's own motion, shape (d, d).
        inertia: `D` without the slope of joint forces and without damping, shape (d, d).
        u: Generalised force after all biases, shape (d,).
        handle_body: The body whose frame is the handle; None if the handle is the output body's frame.
        base: Articulated inertia of a floating base and the force left on it; None for a fixed base.
        stretched: Elimination of clusters with elastic transmissions, for the same `u`.
    """

    U: dict[int, SX] = field(default_factory=dict)
    D: dict[int, SX] = field(default_factory=dict)
    inertia: dict[int, SX] = field(default_factory=dict)
    u: dict[int, SX] = field(default_factory=dict)
    handle_body: dict[int, str | None] = field(default_factory=dict)
    base: tuple[SX, SX] | None = None
    stretched: dict[int, Stretched] = field(default_factory=dict)

    def acceleration(self, k: int, a: SX) -> SX:
        """Return `D^-1 (u - U^T a)`, the acceleration of a cluster whose handle accelerates by `a`, shape (d,)."""
        if k in self.stretched:
            return self.stretched[k].acceleration(a)
        return solve_positive_definite(self.D[k], self.u[k] - self.U[k].T @ a)


@dataclass
class Condensed:
    """A cluster condensed to its handle: `D`, `U`, bias force, and inertia and bias force at the handle."""

    D: SX
    U: SX
    bias: SX
    inertia: SX
    force: SX


def inward_inertia_pass(
    mechanism: Mechanism,
    kinematics: Kinematics,
    joints: JointTerms,
    external: dict[str, BodyTerms],
    turning: TurningDamping | None = None,
) -> Articulation:
    """Collect articulated inertias and bias forces, tip to base (paper Alg. 1, inward pass).

    Args:
        mechanism: The mechanism.
        kinematics: From the outward velocity pass.
        joints: Forces on the independent coordinates.
        external: Forces on bodies, by name, such as contacts.
        turning: Damping of joints on turning bodies, if there is a step.
    """
    IA: dict[str, SX] = {}
    pA: dict[str, SX] = {}
    for name, body in mechanism.bodies.items():
        state, inertia = kinematics.bodies[name], constant(body.inertia)
        IA[name], pA[name] = inertia, turning_force(inertia, state.v[:3])
        if name in external:
            IA[name], pA[name] = IA[name] + external[name].inertia, pA[name] - external[name].force

    articulation = Articulation()
    for k in mechanism.tree.tip_to_base():
        cluster, rows = mechanism.tree.clusters[k], kinematics.rows[k]
        if is_free(mechanism, cluster):
            base = cluster.bodies[0]
            articulation.base = IA[base], joints.tau[rows] - pA[base]
            continue
        transverse_bias = add_transverse_inertias(mechanism, kinematics, k, IA, pA)
        handle = _handle_body(mechanism, cluster, mechanism.eliminated_rotors[k])
        condensed = Condenser(mechanism, kinematics, k, handle).condense(IA, pA)
        condensed.bias += transverse_bias
        articulation.handle_body[k] = handle.name if handle else None
        Ia, pa = eliminate(articulation, mechanism, kinematics, k, condensed, joints, turning)
        if cluster.output_body is not None:
            X = kinematics.bodies[handle.name].X if handle else Transform.identity()
            IA[cluster.output_body] += X.inertia_to_parent(Ia)
            pA[cluster.output_body] += X.force_to_parent(pa)
    return articulation


def eliminate(
    articulation: Articulation,
    mechanism: Mechanism,
    kinematics: Kinematics,
    k: int,
    condensed: Condensed,
    joints: JointTerms,
    turning: TurningDamping | None,
) -> tuple[SX, SX]:
    """Add the elimination of a cluster's accelerations to an articulation; return `inertia - U D^-1 U^T` and bias.

    Args:
        articulation: Of the clusters beyond, changed in place.
        mechanism: The mechanism.
        kinematics: From the outward velocity pass.
        k: Number of the cluster.
        condensed: The cluster without forces on its coordinates.
        joints: Forces on the independent coordinates.
        turning: Damping of joints on turning bodies, if there is a step.
    """
    cluster, rows = mechanism.tree.clusters[k], kinematics.rows[k]
    tau, slope = joints.tau[rows], joints.slope[rows, rows]
    damping, drag = SX(*slope.shape), SX(len(rows), 1)
    if turning is not None and cluster.output_body is not None:
        damping, drag = turning.on(condensed.D, rows, kinematics.bodies[cluster.output_body].v[:3])
    D, u = mirrored(condensed.D + slope + damping), tau - condensed.bias + drag
    if stretches(mechanism, cluster):
        damped, biased = mirrored(condensed.D + damping), ca.horzcat(condensed.U.T, drag - condensed.bias)
        D = mirrored(damped + slope)
        articulation.stretched[k] = Stretched.of(damped, slope, biased, tau)
    articulation.U[k], articulation.D[k], articulation.u[k] = condensed.U, D, u
    articulation.inertia[k] = condensed.D
    if k in articulation.stretched:
        return articulation.stretched[k].articulated(condensed.inertia, condensed.force)
    solved = solve_positive_definite(D, ca.horzcat(condensed.U.T, u))  # D^-1 [U^T, u]
    inertia = mirrored(condensed.inertia - condensed.U @ solved[:, :-1])
    return inertia, condensed.force + condensed.U @ solved[:, -1]


def add_transverse_inertias(
    mechanism: Mechanism, kinematics: Kinematics, k: int, IA: dict[str, SX], pA: dict[str, SX]
) -> SX:
    """Add the transverse inertia of a cluster's rotors to their carriers, in place; return the cluster's bias, (d,)."""
    bias = SX(len(kinematics.rows[k]), 1)
    coordinates: ClusterCoordinates = kinematics.coordinates[k]  # type: ignore[assignment]
    for rotor in mechanism.eliminated_rotors[k]:
        if rotor.carrier is not None:
            row = coordinates.index[rotor.name]
            w = kinematics.bodies[rotor.carrier].v[:3]
            transverse = transverse_inertia(rotor, coordinates.q[row], coordinates.qd[row], w)
            IA[rotor.carrier] += symmetric_blocks(transverse.inertia, SX(3, 3), SX(3, 3))
            pA[rotor.carrier] += ca.vertcat(transverse.couple, SX(3, 1))
            bias += coordinates.G[row, :].T * transverse.torque
    return bias


def outward_acceleration_pass(
    mechanism: Mechanism, kinematics: Kinematics, articulation: Articulation
) -> tuple[SX, dict[str, SX]]:
    """Compute accelerations, base to tip (paper Alg. 1, outward pass 2, without its misprint).

    Args:
        mechanism: The mechanism.
        kinematics: From the outward velocity pass.
        articulation: From the inward pass.

    Returns:
        vdot, shape (nv,), in the coordinates of `v`; and the acceleration of every body *minus gravity*, body
        coordinates, shape (6,) each.
    """
    gravity = gravity_acceleration(mechanism)
    vdot = SX(sum(len(rows) for rows in kinematics.rows), 1)
    a: dict[str, SX] = {}
    for k in mechanism.tree.base_to_tip():
        cluster, rows = mechanism.tree.clusters[k], kinematics.rows[k]
        if is_free(mechanism, cluster):
            base = cluster.bodies[0]
            inertia, force = articulation.base  # type: ignore[misc]
            a[base] = solve_positive_definite(inertia, force)
            state = kinematics.bodies[base]
            vdot[rows] = a[base] + ca.vertcat(SX(3, 1), state.R.T @ gravity - cross(state.v[:3], state.v[3:]))
            continue
        a_output = a[cluster.output_body] if cluster.output_body is not None else ca.vertcat(SX(3, 1), -gravity)
        handle = articulation.handle_body[k]
        a_handle = kinematics.bodies[handle].X.motion(a_output) if handle else a_output
        ydd = articulation.acceleration(k, a_handle)
        vdot[rows] = ydd
        coordinates: ClusterCoordinates = kinematics.coordinates[k]  # type: ignore[assignment]
        qdd = coordinates.G @ ydd + coordinates.g
        for body in mechanism.moving(cluster):
            state = kinematics.bodies[body.name]
            from_parent = a_handle if body.name == handle else state.X.motion(_parent_acceleration(body, a, gravity))
            a[body.name] = from_parent + state.S @ qdd[coordinates.index[body.name]] + state.c
    return vdot, a


def gravity_acceleration(mechanism: Mechanism) -> SX:
    """Return the acceleration of free fall in the world, shape (3,)."""
    return constant(mechanism.gravity)


def _parent_acceleration(body: MovingBody, a: dict[str, SX], gravity: SX) -> SX:
    return a[body.parent] if body.parent is not None else ca.vertcat(SX(3, 1), -gravity)


def _handle_body(mechanism: Mechanism, cluster: Cluster, rotors: tuple[EliminatedRotor, ...]) -> MovingBody | None:
    """Return the body whose frame can serve as the cluster's handle, if there is one.

    The handle is the only base body, if every rotor on the output body spins parallel to the base body's joint, so that
    its momentum is constant in both frames. Condensing there keeps `S`, and so `U`, sparse.
    """
    moving = mechanism.moving(cluster)
    roots = [body for body in moving if body.parent == cluster.output_body]
    if len(roots) != 1 or roots[0].joint.type not in ("revolute", "ball"):
        return None
    axis = roots[0].rotation @ roots[0].axis
    on_output = [rotor for rotor in rotors if rotor.carrier == cluster.output_body]
    parallel = all(np.linalg.norm(np.cross(rotor.axis, axis)) < 1e-12 for rotor in on_output)
    return roots[0] if parallel else None


class Condenser:
    """Condenses one cluster to its handle: composite rigid bodies inside, projected by `G` outside.

    Args:
        mechanism: The mechanism.
        kinematics: From the outward velocity pass.
        k: Number of the cluster.
        handle: The body whose frame is the handle; None for the frame of the output body.
        rigid: Whether the inertias of its bodies are those of rigid bodies.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        kinematics: Kinematics,
        k: int,
        handle: MovingBody | None = None,
        rigid: bool = False,
    ) -> None:
        self.mechanism, self.states, self.handle = mechanism, kinematics.bodies, handle
        self.inertia_to_parent = Transform.rigid_inertia_to_parent if rigid else Transform.inertia_to_parent
        self.cluster, self.rotors = mechanism.tree.clusters[k], mechanism.eliminated_rotors[k]
        self.coordinates: ClusterCoordinates = kinematics.coordinates[k]  # type: ignore[assignment]
        self.moving = mechanism.moving(self.cluster)
        self.inside = {body.name: body for body in self.moving}
        self.n = self.coordinates.qd.numel()

    def condense(self, IA: dict[str, SX], pA: dict[str, SX]) -> Condensed:
        """Return the condensed cluster, given articulated inertias and bias forces of its bodies."""
        G, index = self.coordinates.G, self.coordinates.index
        zeta = self._bias_accelerations()
        composite = {body.name: IA[body.name] for body in self.moving}
        H, F, bias = SX(self.n, self.n), SX(6, self.n), SX(self.n, 1)
        at_handle = SX(6, 6)
        force_at_handle = SX(6, 1)
        for body in reversed(self.moving):
            i = index[body.name]
            F[:, i], H[:, i] = self._to_handle(body, composite[body.name] @ self.states[body.name].S)
            H[i, i] = ca.triu(H[i, i])  # of the three columns of a ball joint; the rest is one column each
            force, torques = self._to_handle(body, pA[body.name] + IA[body.name] @ zeta[body.name])
            force_at_handle, bias = force_at_handle + force, bias + torques
            in_parent = self.inertia_to_parent(self._transform(body), composite[body.name])
            if body.parent in self.inside:
                composite[body.parent] += in_parent
            else:
                at_handle += in_parent
        G, H, F = ca.sparsify(G), mirrored(_lower_to_upper(H)), ca.sparsify(F)
        condensed = Condensed(G.T @ H @ G, F @ G, G.T @ bias, at_handle, force_at_handle)
        for rotor in self.rotors:
            self._add_rotor(condensed, rotor, zeta)
        return condensed

    def _transform(self, body: MovingBody) -> Transform:
        return Transform.identity() if body is self.handle else self.states[body.name].X

    def _bias_accelerations(self) -> dict[str, SX]:
        """Return accelerations of the bodies for a handle without acceleration and `ydd = 0`."""
        zeta: dict[str, SX] = {}
        for body in self.moving:
            state, i = self.states[body.name], self.coordinates.index[body.name]
            zeta[body.name] = state.c + state.S @ self.coordinates.g[i]
            if body.parent in self.inside:
                zeta[body.name] += state.X.motion(zeta[body.parent])
        return zeta

    def _to_handle(self, body: MovingBody, force: SX) -> tuple[SX, SX]:
        """Return forces (6, m) on a body transformed to the handle, and torques (n, m) of the joints on the way."""
        torques = SX(self.n, force.shape[1])
        while True:
            torques[self.coordinates.index[body.name], :] = self.states[body.name].S.T @ force
            force = self._transform(body).force_to_parent(force)
            if body.parent not in self.inside:
                return force, torques
            body = self.inside[body.parent]

    def _add_rotor(self, condensed: Condensed, rotor: EliminatedRotor, zeta: dict[str, SX]) -> None:
        """Add a rotor in place, at the transmission level of the mechanism."""
        G, row, J = self.coordinates.G, self.coordinates.index[rotor.name], rotor.inertia
        G_r, g_r, thd = G[row, :], self.coordinates.g[row], self.coordinates.qd[row]
        level = self.mechanism.level
        if level == "none":
            return
        if level == "armature":
            yd = self.coordinates.qd[[self.coordinates.index[name] for name in self.cluster.independent]]
            condensed.D += ca.diag(J * ca.vec(G_r) ** 2)
            condensed.bias += diagonal_bias(self.coordinates, yd, row, J)
            return
        momentum = J * G_r  # products in this order are shared between D, U and the biases
        condensed.D += momentum.T @ G_r
        condensed.bias += G_r.T * (J * g_r)
        if level == "coupled":
            return
        axis, w = self._rotor_frame(rotor)
        couple = ca.vertcat(axis, SX(3, 1))  # h = J couple
        f = ca.vertcat(axis * (J * g_r) + cross(w, axis * (J * thd)), SX(3, 1))
        if rotor.carrier in self.inside:
            carrier = self.inside[rotor.carrier]
            condensed.bias += momentum.T * ca.dot(couple, zeta[rotor.carrier])
            couple, coupling = self._to_handle(carrier, couple)
            f, torques = self._to_handle(carrier, f)
            condensed.D += G.T @ coupling @ momentum + (G.T @ coupling @ momentum).T
            condensed.bias += G.T @ torques
        condensed.U += couple @ momentum
        condensed.force += f

    def _rotor_frame(self, rotor: EliminatedRotor) -> tuple[SX, SX]:
        """Return spin axis and angular velocity of the carrier; of an output body, in the frame of the handle."""
        if rotor.carrier in self.inside:
            return constant(rotor.axis), self.states[rotor.carrier].v[:3]
        if self.handle is not None:  # the axis is parallel to the handle's joint: constant, and so is cross(w, axis)
            return constant(snapped(self.handle.rotation.T @ rotor.axis)), self.states[self.handle.name].v[:3]
        w = self.states[rotor.carrier].v[:3] if rotor.carrier is not None else SX(3, 1)
        return constant(rotor.axis), w


def _lower_to_upper(m: SX) -> SX:
    """Return the upper triangle with the structurally nonzero entry of each pair (i, j), (j, i)."""
    return ca.triu(m) + ca.triu(m.T, False)
