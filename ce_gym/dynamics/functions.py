"""The quantities of a mechanism as traced CasADi functions, by name.

Each entry of `FUNCTIONS` takes a mechanism and returns an SX function of dense columns with common sub-expressions
shared. May know the algorithms of this room.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

from ce_gym.dynamics.ce_aba import (
    JointTerms,
    gravity_acceleration,
    inward_inertia_pass,
    outward_acceleration_pass,
)
from ce_gym.dynamics.ce_rnea import inverse_dynamics
from ce_gym.dynamics.kinematics import Kinematics, constant, is_free, outward_velocity_pass
from ce_gym.dynamics.spatial import SX, axis_rotation
from ce_gym.model.mechanism import Mechanism


def traced(name: str, inputs: dict[str, SX], outputs: dict[str, SX]) -> ca.Function:
    """Make a function of named expressions, with dense outputs and common sub-expressions shared."""
    shared = ca.cse([ca.densify(expression) for expression in outputs.values()])
    return ca.Function(name, list(inputs.values()), shared, list(inputs), list(outputs))


def state_symbols(mechanism: Mechanism) -> tuple[SX, SX]:
    """Return fresh symbols for positions and velocities, shapes (nq,) and (nv,)."""
    joints = len(mechanism.robot.independent)
    floating = mechanism.robot.floating
    return SX.sym("q", joints + (7 if floating else 0)), SX.sym("v", joints + (6 if floating else 0))


def _forward_dynamics(mechanism: Mechanism) -> ca.Function:
    q, v = state_symbols(mechanism)
    tau = SX.sym("tau", v.shape[0])
    kinematics = outward_velocity_pass(mechanism, q, v)
    articulation = inward_inertia_pass(mechanism, kinematics, JointTerms(tau, SX(*tau.shape)), {})
    vdot, _ = outward_acceleration_pass(mechanism, kinematics, articulation)
    return traced("forward_dynamics", {"q": q, "v": v, "tau": tau}, {"vdot": vdot})


def _inverse_dynamics(mechanism: Mechanism) -> ca.Function:
    q, v = state_symbols(mechanism)
    vdot = SX.sym("vdot", v.shape[0])
    tau = inverse_dynamics(mechanism, outward_velocity_pass(mechanism, q, v), vdot)
    return traced("inverse_dynamics", {"q": q, "v": v, "vdot": vdot}, {"tau": tau})


def _mass_matrix(mechanism: Mechanism) -> ca.Function:
    q, v = state_symbols(mechanism)
    vdot = SX.sym("vdot", v.shape[0])
    at_rest = outward_velocity_pass(mechanism, q, SX(*v.shape))
    M = ca.jacobian(inverse_dynamics(mechanism, at_rest, vdot), vdot)  # tau = M vdot + bias is linear in vdot
    return traced("mass_matrix", {"q": q}, {"M": M})


def _bias_force(mechanism: Mechanism) -> ca.Function:
    q, v = state_symbols(mechanism)
    tau = inverse_dynamics(mechanism, outward_velocity_pass(mechanism, q, v), SX(*v.shape))
    return traced("bias_force", {"q": q, "v": v}, {"tau": tau})


def _spanning(mechanism: Mechanism) -> ca.Function:
    q, v = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, v)
    positions, velocities = spanning_coordinates(mechanism, kinematics)
    floating = mechanism.robot.floating
    names = [body.name for body in mechanism.robot.bodies if body.joint.type != "free"]
    q_span = ca.vertcat(*([q[:7]] if floating else []), *[positions[name] for name in names])
    v_span = ca.vertcat(*([v[:6]] if floating else []), *[velocities[name] for name in names])
    return traced("spanning", {"q": q, "v": v}, {"q_span": q_span, "v_span": v_span})


def _body_poses(mechanism: Mechanism) -> ca.Function:
    q, v = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, SX(*v.shape))
    angles, _ = spanning_coordinates(mechanism, kinematics)
    positions, rotations = [], []
    for body in mechanism.robot.bodies:
        if body.name in kinematics.bodies:
            p, R = kinematics.bodies[body.name].p, kinematics.bodies[body.name].R
        else:  # a rotor that is no body of the recursion still has a place to be drawn at
            parent = kinematics.bodies[body.parent] if body.parent is not None else None
            R_parent, p_parent = (parent.R, parent.p) if parent is not None else (SX.eye(3), SX(3, 1))
            p = p_parent + R_parent @ constant(np.array(body.placement.position))
            R = R_parent @ constant(np.array(body.placement.rotation)) @ turned(body.joint.axis, angles[body.name])
        positions.append(p)
        rotations.append(R)
    outputs = {"positions": ca.horzcat(*positions), "rotations": ca.horzcat(*rotations)}
    return traced("body_poses", {"q": q}, outputs)


def _contact_points(mechanism: Mechanism) -> ca.Function:
    q, v = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, v)
    positions, velocities = [SX(3, 0)], [SX(3, 0)]
    for contact in mechanism.robot.contacts:
        body, r = kinematics.bodies[contact.body], constant(np.array(contact.position))
        positions.append(body.point_position(r))
        velocities.append(body.R @ body.point_velocity(r))
    outputs = {"positions": ca.horzcat(*positions), "velocities": ca.horzcat(*velocities)}
    return traced("contact_points", {"q": q, "v": v}, outputs)


def _energy(mechanism: Mechanism) -> ca.Function:
    q, v = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, v)
    at_rest = outward_velocity_pass(mechanism, q, SX(*v.shape))
    momentum = inverse_dynamics(mechanism, at_rest, v) - inverse_dynamics(mechanism, at_rest, SX(*v.shape))
    potential = SX(0)
    gravity = gravity_acceleration(mechanism)
    for name, body in mechanism.bodies.items():
        mass = body.inertia[3, 3]
        moment = constant(np.array([body.inertia[2, 4], body.inertia[0, 5], body.inertia[1, 3]]))  # mass * com
        state = kinematics.bodies[name]
        potential -= ca.dot(gravity, mass * state.p + state.R @ moment)
    return traced("energy", {"q": q, "v": v}, {"kinetic": ca.dot(v, momentum) / 2, "potential": potential})


def spanning_coordinates(mechanism: Mechanism, kinematics: Kinematics) -> tuple[dict[str, SX], dict[str, SX]]:
    """Return position and velocity of every joint but a floating base's, by the name of the body it moves."""
    positions, velocities = {}, {}
    for cluster, coordinates in zip(mechanism.tree.clusters, kinematics.coordinates, strict=True):
        if coordinates is None or is_free(mechanism, cluster):
            continue
        for name, i in coordinates.index.items():
            positions[name], velocities[name] = coordinates.q[i], coordinates.qd[i]
    return positions, velocities


def turned(axis: Sequence[float], angle: SX) -> SX:
    """Return the rotation, child to parent, of a revolute joint at an angle."""
    return axis_rotation(constant(np.array(axis)), angle).T


FUNCTIONS: dict[str, Callable[[Mechanism], ca.Function]] = {
    "forward_dynamics": _forward_dynamics,
    "inverse_dynamics": _inverse_dynamics,
    "mass_matrix": _mass_matrix,
    "bias_force": _bias_force,
    "spanning": _spanning,
    "body_poses": _body_poses,
    "contact_points": _contact_points,
    "energy": _energy,
}
