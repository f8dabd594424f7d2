"""Gravity, the Coriolis matrix and the regressor of inertial parameters.

The Coriolis matrix is the one of the Levi-Civita connection of the mass matrix. With the tangent derivatives
`e_j` of positions, `p = M v`, `P_ij = e_j p_i`, the cross-product matrix `A` of `v` (base and ball joints only, zero
for other joints) and `F Y = p x* Y`,

    2 C = Mdot + P - P^T + M A - A^T M + F.

`C v + g` is the bias force, and `Mdot - 2 C` is skew-symmetric. Without base and balls these are Christoffel's symbols.

Source: Koszul's formula; Echeandia, Wensing, "Numerical methods to compute the Coriolis matrix and Christoffel symbols
for rigid-body systems", J. Computational and Nonlinear Dynamics 16, 2021.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.algebra.integration import tangent_basis
from ce_gym.dynamics.algebra.spatial import SX, Transform, skew
from ce_gym.dynamics.quantities.frames import rate_of_change
from ce_gym.dynamics.quantities.inputs import function_of_state, state_symbols
from ce_gym.dynamics.recursion.ce_rnea import inverse_dynamics
from ce_gym.dynamics.recursion.kinematics import constant, outward_velocity_pass
from ce_gym.model.coordinates import Layout
from ce_gym.model.description import Robot
from ce_gym.model.mechanism import Mechanism, build_mechanism, spatial_inertia

PARAMETERS = 10
"""Inertial parameters of a body: mass, mass times centre of mass (3), and xx, xy, yy, xz, yz, zz of the inertia."""


def _gravity_force(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    at_rest = outward_velocity_pass(mechanism, q, SX(*v.shape), guess)
    return function_of_state(
        "gravity_force", guess, {"q": q}, {"tau": inverse_dynamics(mechanism, at_rest, SX(*v.shape))}
    )


def _coriolis_matrix(mechanism: Mechanism) -> ca.Function:
    weightless = replace(mechanism, gravity=np.zeros(3))
    q, v, guess = state_symbols(mechanism)
    x, layout = SX.sym("x", *v.shape), mechanism.robot.layout
    at_rest = outward_velocity_pass(weightless, q, SX(*v.shape), guess)
    momentum = inverse_dynamics(weightless, at_rest, x)  # M x
    M = ca.jacobian(momentum, x)
    Mdot = ca.jacobian(rate_of_change(momentum, mechanism, q, v), x)
    p, P = ca.substitute([momentum, ca.jacobian(momentum, q)], [x], [v])
    P = P @ tangent_basis(q, layout)
    A, F = _brackets(v, p, layout)
    C = (Mdot + P - P.T + M @ A - A.T @ M + F) / 2
    return function_of_state("coriolis_matrix", guess, {"q": q, "v": v}, {"C": C})


def _brackets(v: SX, p: SX, layout: Layout) -> tuple[SX, SX]:
    """Return the matrices of `v x` and of `p x*` on the base and ball joints, zero elsewhere, shape (nv, nv) each."""
    A, F = SX(layout.nv, layout.nv), SX(layout.nv, layout.nv)
    for _, i in layout.turns:
        A[i : i + 3, i : i + 3], F[i : i + 3, i : i + 3] = skew(v[i : i + 3]), -skew(p[i : i + 3])
    if layout.floating:
        A[3:6, :3], A[3:6, 3:6] = skew(v[3:6]), skew(v[:3])
        F[:3, 3:6], F[3:6, :3] = -skew(p[3:6]), -skew(p[3:6])
    return A, F


def inertial_parameters(robot: Robot) -> NDArray[np.float64]:
    """Return the inertial parameters of all bodies about their origins, shape (10 n_bodies,)."""
    parameters = []
    for body in robot.bodies:
        inertia = spatial_inertia(body)
        moment = body.inertial.mass * np.array(body.inertial.com)
        parameters += [body.inertial.mass, *moment, *inertia[(0, 0, 1, 0, 1, 2), (0, 1, 1, 2, 2, 2)]]
    return np.array(parameters)


def _inertia_of(parameters: SX) -> SX:
    """Return the spatial inertia of a body with inertial parameters (10,), shape (6, 6)."""
    mass, moment, (xx, xy, yy, xz, yz, zz) = parameters[0], skew(parameters[1:4]), ca.vertsplit(parameters[4:])
    rotational = ca.blockcat([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return ca.blockcat([[rotational, moment], [moment.T, mass * SX.eye(3)]])


def _inertial_regressor(mechanism: Mechanism) -> ca.Function:
    """With every rotor a body at the exact levels: each then has all its parameters."""
    robot, locked = mechanism.robot, mechanism.exact or mechanism.locked_rotors
    general = build_mechanism(robot, mechanism.level, locked_rotors=mechanism.locked_rotors, eliminate=False)
    parameters = SX.sym("parameters", PARAMETERS * len(robot.bodies))
    inertia = {
        body.name: _inertia_of(part)
        for body, part in zip(robot.bodies, ca.vertsplit(parameters, PARAMETERS), strict=True)
    }
    inertias = {name: inertia[name] for name in general.bodies}
    for rotor in robot.rotors():
        if rotor.name not in general.bodies and rotor.parent is not None and locked:
            rotation, position = np.array(rotor.placement.rotation), np.array(rotor.placement.position)
            to_rotor = Transform(constant(rotation.T), constant(position))
            inertias[rotor.parent] = inertias[rotor.parent] + to_rotor.inertia_to_parent(inertia[rotor.name])
    axes = {rotor.name: constant(np.array(rotor.joint.axis)) for rotor in robot.rotors()}
    spins = {name: axis.T @ inertia[name][:3, :3] @ axis for name, axis in axes.items()}
    varied = replace(
        general,
        gravity=mechanism.gravity,
        ratio=mechanism.ratio,
        bodies={name: replace(body, inertia=inertias[name]) for name, body in general.bodies.items()},
        eliminated_rotors=tuple(
            tuple(replace(rotor, inertia=spins[rotor.name]) for rotor in rotors) for rotors in general.eliminated_rotors
        ),
    )
    q, v, guess = state_symbols(varied)
    vdot = SX.sym("vdot", *v.shape)
    tau = inverse_dynamics(varied, outward_velocity_pass(varied, q, v, guess), vdot)
    Y = ca.jacobian(tau, parameters)
    return function_of_state("inertial_regressor", guess, {"q": q, "v": v, "vdot": vdot}, {"Y": Y})


FORCE_FUNCTIONS: dict[str, Callable[[Mechanism], ca.Function]] = {
    "gravity_force": _gravity_force,
    "coriolis_matrix": _coriolis_matrix,
    "inertial_regressor": _inertial_regressor,
}
