"""Centre of mass and centroidal momentum, with the momentum of spinning rotors.

Source: Orin, Goswami, Lee, "Centroidal dynamics of a humanoid robot", Autonomous Robots 35, 2013.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX, cross
from ce_gym.dynamics.quantities.frames import rate_of_change
from ce_gym.dynamics.quantities.inputs import function_of_state, state_symbols
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant, outward_velocity_pass
from ce_gym.dynamics.recursion.momentum import momentum_of
from ce_gym.model.mechanism import Mechanism


def center_of_mass(mechanism: Mechanism, kinematics: Kinematics) -> tuple[SX, SX]:
    """Return the mass of a robot [kg] and its centre of mass in the world [m], rotors on the world included."""
    mass, moment = SX(0), SX(3, 1)
    for name, body in mechanism.bodies.items():
        state, inertia = kinematics.bodies[name], constant(body.inertia)
        mass += inertia[3, 3]
        moment += inertia[3, 3] * state.p + state.R @ ca.vertcat(inertia[2, 4], inertia[0, 5], inertia[1, 3])
    for rotor in mechanism.robot.rotors() if mechanism.exact or mechanism.locked_rotors else ():
        if rotor.parent is None and rotor.name not in mechanism.bodies:
            offset = np.array(rotor.placement.rotation) @ np.array(rotor.inertial.com)
            mass += rotor.inertial.mass
            moment += rotor.inertial.mass * (constant(np.array(rotor.placement.position) + offset))
    return mass, moment / mass


def centroidal_momentum(mechanism: Mechanism, kinematics: Kinematics) -> SX:
    """Return the momentum [angular about the centre of mass; linear], world axes, shape (6,)."""
    _, center = center_of_mass(mechanism, kinematics)
    momentum = momentum_of(mechanism, kinematics)
    if not mechanism.robot.floating:
        return ca.vertcat(momentum.about(center), momentum.linear)
    base = kinematics.bodies[next(iter(mechanism.bodies))]
    angular, linear = base.R @ momentum.angular, base.R @ momentum.linear
    return ca.vertcat(angular + cross(base.p - center, linear), linear)


def _center_of_mass(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    _, center = center_of_mass(mechanism, outward_velocity_pass(mechanism, q, SX(*v.shape), guess))
    return function_of_state("center_of_mass", guess, {"q": q}, {"position": center})


def _center_of_mass_velocity(mechanism: Mechanism) -> ca.Function:
    q, v, guess, velocity = _velocity_of_center(mechanism)
    return function_of_state("center_of_mass_velocity", guess, {"q": q, "v": v}, {"velocity": velocity})


def _center_of_mass_jacobian(mechanism: Mechanism) -> ca.Function:
    q, v, guess, velocity = _velocity_of_center(mechanism)
    return function_of_state("center_of_mass_jacobian", guess, {"q": q}, {"J": ca.jacobian(velocity, v)})


def _center_of_mass_bias_acceleration(mechanism: Mechanism) -> ca.Function:
    q, v, guess, velocity = _velocity_of_center(mechanism)
    acceleration = rate_of_change(velocity, mechanism, q, v)
    inputs, outputs = {"q": q, "v": v}, {"acceleration": acceleration}
    return function_of_state("center_of_mass_bias_acceleration", guess, inputs, outputs)


def _velocity_of_center(mechanism: Mechanism) -> tuple[SX, SX, SX, SX]:
    q, v, guess = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    mass, _ = center_of_mass(mechanism, kinematics)
    return q, v, guess, centroidal_momentum(mechanism, kinematics)[3:] / mass


def _centroidal_momentum(mechanism: Mechanism) -> ca.Function:
    q, v, guess, momentum = _momentum(mechanism)
    return function_of_state("centroidal_momentum", guess, {"q": q, "v": v}, {"momentum": momentum})


def _centroidal_momentum_matrix(mechanism: Mechanism) -> ca.Function:
    q, v, guess, momentum = _momentum(mechanism)
    return function_of_state("centroidal_momentum_matrix", guess, {"q": q}, {"A": ca.jacobian(momentum, v)})


def _centroidal_momentum_bias(mechanism: Mechanism) -> ca.Function:
    q, v, guess, momentum = _momentum(mechanism)
    rate = rate_of_change(momentum, mechanism, q, v)
    return function_of_state("centroidal_momentum_bias", guess, {"q": q, "v": v}, {"rate": rate})


def _momentum(mechanism: Mechanism) -> tuple[SX, SX, SX, SX]:
    q, v, guess = state_symbols(mechanism)
    return q, v, guess, centroidal_momentum(mechanism, outward_velocity_pass(mechanism, q, v, guess))


MOMENTUM_FUNCTIONS: dict[str, Callable[[Mechanism], ca.Function]] = {
    "center_of_mass": _center_of_mass,
    "center_of_mass_velocity": _center_of_mass_velocity,
    "center_of_mass_jacobian": _center_of_mass_jacobian,
    "center_of_mass_bias_acceleration": _center_of_mass_bias_acceleration,
    "centroidal_momentum": _centroidal_momentum,
    "centroidal_momentum_matrix": _centroidal_momentum_matrix,
    "centroidal_momentum_bias": _centroidal_momentum_bias,
}
