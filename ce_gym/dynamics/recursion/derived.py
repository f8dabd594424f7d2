"""Quantities that follow from the kinematics of a mechanism: energies, loop residuals, joint coordinates, wrenches."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX, cross
from ce_gym.dynamics.constraints.cluster_constraints import ClusterCoordinates
from ce_gym.dynamics.constraints.residuals import gap as constraint_gap
from ce_gym.dynamics.recursion.ce_aba import BodyTerms
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant, is_free, outward_velocity_pass
from ce_gym.dynamics.recursion.momentum import momentum_of, potential_energy
from ce_gym.model.mechanism import Mechanism


def kinetic_and_potential(mechanism: Mechanism, q: SX, v: SX, guess: SX) -> tuple[SX, SX]:
    """Return kinetic and potential energy [J] of a mechanism at positions (nq,) and velocities (nv,)."""
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    return momentum_of(mechanism, kinematics).energy, potential_energy(mechanism, kinematics)


def loop_gap(mechanism: Mechanism, kinematics: Kinematics) -> SX:
    """Return the norm of the residuals of all loops, rods and functions, redundant rows included [m or -]."""
    angles, _ = spanning_coordinates(mechanism, kinematics)
    loops = [tie for tie in mechanism.robot.constraints if not tie.linear]
    rows = [constraint_gap(mechanism.robot, tie, angles) for tie in loops]
    return ca.norm_2(ca.vertcat(*rows)) if rows else SX(0)


def loop_state(kinematics: Kinematics) -> tuple[SX, SX]:
    """Return the largest gap and the smallest nearness of all clusters with closed loops, see `LoopState`."""
    gap, nearness = SX(0), SX(1)
    for coordinates in kinematics.coordinates:
        if coordinates is not None and coordinates.loop is not None:
            gap, nearness = ca.fmax(gap, coordinates.loop.gap), ca.fmin(nearness, coordinates.loop.nearness)
    return gap, nearness


def guessed_coordinates(kinematics: Kinematics, vdot: SX, dt: float) -> SX:
    """Return the dependent coordinates that are computed from a guess, a time `dt` [s] later, shape (n_guess,)."""
    later = [SX(0, 1)]
    for coordinates, rows in zip(kinematics.coordinates, kinematics.rows, strict=True):
        if coordinates is not None and coordinates.loop is not None and coordinates.loop.guessed:
            qdd = coordinates.G @ vdot[rows] + coordinates.g / 2  # positions move by dt * (G yd_next + dt / 2 * g)
            later.append((coordinates.q + dt * (coordinates.qd + dt * qdd))[list(coordinates.loop.guessed)])
    return ca.vertcat(*later)


def external_wrenches(mechanism: Mechanism, kinematics: Kinematics, wrenches: SX) -> tuple[dict[str, BodyTerms], SX]:
    """Take wrenches in the world to forces on the bodies of the recursion and on the independent coordinates.

    Args:
        mechanism: The mechanism.
        kinematics: From the outward velocity pass.
        wrenches: [moment about the world's origin; force] on each body of the robot, world axes, shape (6, n_bodies).
    """
    on_bodies: dict[str, SX] = {}
    tau = SX(sum(len(rows) for rows in kinematics.rows), 1)
    for i, body in enumerate(mechanism.robot.bodies):
        moment, force = wrenches[:3, i], wrenches[3:, i]
        carrier = body.name if body.name in kinematics.bodies else body.parent
        if carrier is not None:
            state = kinematics.bodies[carrier]
            about_origin = moment - cross(state.p, force)
            old = on_bodies.get(carrier, SX(6, 1))
            on_bodies[carrier] = old + ca.vertcat(state.R.T @ about_origin, state.R.T @ force)
        if carrier != body.name:  # an eliminated rotor still turns
            k = mechanism.tree.cluster_of(body.name)
            coordinates: ClusterCoordinates = kinematics.coordinates[k]  # type: ignore[assignment]
            R, p = (state.R, state.p) if carrier is not None else (SX.eye(3), SX(3, 1))
            axis = R @ constant(np.array(body.placement.rotation) @ np.array(body.joint.axis))
            at = p + R @ constant(np.array(body.placement.position))
            G_r = coordinates.G[coordinates.index[body.name], :]
            tau[kinematics.rows[k]] += G_r.T * ca.dot(axis, moment - cross(at, force))
    return {name: BodyTerms(SX(6, 6), force) for name, force in on_bodies.items()}, tau


def spanning_coordinates(mechanism: Mechanism, kinematics: Kinematics) -> tuple[dict[str, SX], dict[str, SX]]:
    """Return position and velocity of every joint but a floating base's, by the name of the body it moves."""
    positions, velocities = {}, {}
    for cluster, coordinates in zip(mechanism.tree.clusters, kinematics.coordinates, strict=True):
        if coordinates is None or is_free(mechanism, cluster):
            continue
        for name, i in coordinates.index.items():
            positions[name], velocities[name] = coordinates.position(name), coordinates.qd[i]
    return positions, velocities
