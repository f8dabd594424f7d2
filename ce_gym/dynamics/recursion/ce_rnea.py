"""Inverse dynamics by the constraint-embedding recursive Newton-Euler algorithm (CE-RNEA), paper section V.

Bodies are visited one by one: accelerations base to tip, forces tip to base, and the cluster's constraint Jacobian
projects the spanning torques, `tau_y = G^T tau_span`. An eliminated rotor adds the couple `h thdd + v_c x* h thd` to
its carrier and `G_r^T (J thdd + h^T a_c)` to the torques, see ce_aba.py for the symbols; rotors.py has the additional
terms of rotors that are not symmetric.
"""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX, cross, turning_force
from ce_gym.dynamics.constraints.cluster_constraints import ClusterCoordinates
from ce_gym.dynamics.recursion.ce_aba import gravity_acceleration
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant, is_free
from ce_gym.dynamics.recursion.rotors import diagonal_bias, transverse_inertia
from ce_gym.model.mechanism import Mechanism


def inverse_dynamics(mechanism: Mechanism, kinematics: Kinematics, vdot: SX) -> SX:
    """Return the generalised force that produces an acceleration.

    Args:
        mechanism: The mechanism.
        kinematics: From the outward velocity pass.
        vdot: Acceleration in the coordinates of `v`, shape (nv,).

    Returns:
        tau, base wrench [moment; force] first, shape (nv,).
    """
    a, qdd = outward_acceleration(mechanism, kinematics, vdot)
    return inward_force_pass(mechanism, kinematics, a, net_forces(mechanism, kinematics, a), qdd)


def outward_acceleration(
    mechanism: Mechanism, kinematics: Kinematics, vdot: SX, a_base: SX | None = None
) -> tuple[dict[str, SX], list[SX]]:
    """Return each body's acceleration minus gravity, shape (6,), and each cluster's spanning accelerations.

    Args:
        mechanism: The mechanism.
        kinematics: From the outward velocity pass.
        vdot: Acceleration in the coordinates of `v`, shape (nv,).
        a_base: Acceleration of a floating base minus gravity, shape (6,); the one in `vdot` if None.
    """
    gravity = gravity_acceleration(mechanism)
    world = ca.vertcat(SX(3, 1), -gravity)
    a: dict[str, SX] = {}
    qdd: list[SX] = []
    for k in mechanism.tree.base_to_tip():
        cluster, rows = mechanism.tree.clusters[k], kinematics.rows[k]
        if is_free(mechanism, cluster):
            base = cluster.bodies[0]
            state = kinematics.bodies[base]
            if a_base is None:
                a_base = vdot[rows] + ca.vertcat(SX(3, 1), cross(state.v[:3], state.v[3:]) - state.R.T @ gravity)
            a[base] = a_base
            qdd.append(vdot[rows])
            continue
        coordinates: ClusterCoordinates = kinematics.coordinates[k]  # type: ignore[assignment]
        qdd.append(coordinates.G @ vdot[rows] + coordinates.g)
        for body in mechanism.moving(cluster):
            state = kinematics.bodies[body.name]
            from_parent = state.X.motion(a[body.parent] if body.parent is not None else world)
            a[body.name] = from_parent + state.S @ qdd[k][coordinates.index[body.name]] + state.c
    return a, qdd


def net_forces(mechanism: Mechanism, kinematics: Kinematics, a: dict[str, SX]) -> dict[str, SX]:
    """Return the net force on each body, [moment; force], shape (6,), given accelerations minus gravity."""
    f = {}
    for name, body in mechanism.bodies.items():
        inertia, w = constant(body.inertia), kinematics.bodies[name].v[:3]
        f[name] = inertia @ a[name] + turning_force(inertia, w)
    return f


def inward_force_pass(
    mechanism: Mechanism, kinematics: Kinematics, a: dict[str, SX], f: dict[str, SX], qdd: list[SX]
) -> SX:
    """Collect net forces `f` of the bodies, tip to base, into the generalised force, shape (nv,)."""
    tau = SX(sum(len(rows) for rows in kinematics.rows), 1)
    for k in mechanism.tree.tip_to_base():
        cluster, rows = mechanism.tree.clusters[k], kinematics.rows[k]
        if is_free(mechanism, cluster):
            tau[rows] = f[cluster.bodies[0]]
            continue
        coordinates: ClusterCoordinates = kinematics.coordinates[k]  # type: ignore[assignment]
        spanning = SX(coordinates.qd.numel(), 1)
        if mechanism.exact:
            for rotor in mechanism.eliminated_rotors[k]:
                row, J = coordinates.index[rotor.name], rotor.inertia
                spanning[row] = J * qdd[k][row]
                if rotor.carrier is not None:
                    h, w, wd = J * constant(rotor.axis), kinematics.bodies[rotor.carrier].v[:3], a[rotor.carrier][:3]
                    transverse = transverse_inertia(rotor, coordinates.q[row], coordinates.qd[row], w)
                    spanning[row] += ca.dot(h, wd) + transverse.torque
                    couple = (
                        h * qdd[k][row]
                        + cross(w, h * coordinates.qd[row])
                        + transverse.inertia @ wd
                        + transverse.couple
                    )
                    f[rotor.carrier] += ca.vertcat(couple, SX(3, 1))
        _to_parents(mechanism, kinematics, k, f, spanning)
        tau[rows] = coordinates.G.T @ spanning
        if mechanism.level in ("coupled", "armature"):
            tau[rows] += _reflected(mechanism, coordinates, k, qdd[k])
    return tau


def _reflected(mechanism: Mechanism, coordinates: ClusterCoordinates, k: int, qdd: SX) -> SX:
    """Return the torque of the reflected inertia: of the whole block, or its diagonal at the armature level, (d,).

    With closed loops `G_r` varies, which adds velocity terms, see rotors.py.
    """
    G, index, cluster = coordinates.G, coordinates.index, mechanism.tree.clusters[k]
    independent = [index[name] for name in cluster.independent]
    torque = SX(G.shape[1], 1)
    for rotor in mechanism.eliminated_rotors[k]:
        row = index[rotor.name]
        G_r = G[row, :]
        if mechanism.level == "armature":
            torque += rotor.inertia * (ca.vec(G_r) ** 2 * qdd[independent])
            torque += diagonal_bias(coordinates, coordinates.qd[independent], row, rotor.inertia)
        else:
            torque += rotor.inertia * (G_r.T * qdd[row])
    return torque


def _to_parents(mechanism: Mechanism, kinematics: Kinematics, k: int, f: dict[str, SX], spanning: SX) -> None:
    """Add forces on the bodies of a cluster to their parents, and write the torques of their joints to `spanning`."""
    coordinates: ClusterCoordinates = kinematics.coordinates[k]  # type: ignore[assignment]
    for body in reversed(mechanism.moving(mechanism.tree.clusters[k])):
        state = kinematics.bodies[body.name]
        spanning[coordinates.index[body.name]] = state.S.T @ f[body.name]
        if body.parent is not None:
            f[body.parent] += state.X.force_to_parent(f[body.name])


def force_on_coordinates(mechanism: Mechanism, kinematics: Kinematics, f: dict[str, SX]) -> SX:
    """Take forces on bodies [moment; force], body axes, shape (6,) each, to the coordinates of `v`, shape (nv,)."""
    tau, f = SX(sum(len(rows) for rows in kinematics.rows), 1), dict(f)
    for k in mechanism.tree.tip_to_base():
        cluster, rows = mechanism.tree.clusters[k], kinematics.rows[k]
        if is_free(mechanism, cluster):
            tau[rows] = f[cluster.bodies[0]]
            continue
        coordinates: ClusterCoordinates = kinematics.coordinates[k]  # type: ignore[assignment]
        spanning = SX(coordinates.qd.numel(), 1)
        _to_parents(mechanism, kinematics, k, f, spanning)
        tau[rows] = coordinates.G.T @ spanning
    return tau
