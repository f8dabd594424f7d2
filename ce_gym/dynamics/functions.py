"""The quantities of a mechanism as traced CasADi functions, by name.

Each entry of `FUNCTIONS` takes a mechanism and returns an SX function of dense columns with shared common
sub-expressions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX, axis_rotation, cross
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.constraints.assembly import linear_rows, nonlinear_rows
from ce_gym.dynamics.constraints.closure import closures, reference_guess
from ce_gym.dynamics.recursion.ce_aba import (
    JointTerms,
    gravity_acceleration,
    inward_inertia_pass,
    outward_acceleration_pass,
)
from ce_gym.dynamics.recursion.ce_rnea import inverse_dynamics, outward_acceleration
from ce_gym.dynamics.recursion.derived import (
    external_wrenches,
    guessed_coordinates,
    kinetic_and_potential,
    loop_gap,
    loop_state,
    spanning_coordinates,
)
from ce_gym.dynamics.recursion.kinematics import constant, outward_velocity_pass
from ce_gym.model.mechanism import Mechanism


def state_symbols(mechanism: Mechanism) -> tuple[SX, SX, SX]:
    """Return fresh symbols for positions (nq,), velocities (nv,) and guesses of dependent positions (n_guess,)."""
    layout = mechanism.robot.layout
    q, v = SX.sym("q", layout.nq), SX.sym("v", layout.nv)
    return q, v, SX.sym("guess", len(reference_guess(mechanism)))


def _function(name: str, guess: SX, inputs: dict[str, SX], outputs: dict[str, SX]) -> ca.Function:
    """Trace a function that has an input `guess` only if the robot needs one."""
    return traced(name, inputs | ({"guess": guess} if guess.numel() else {}), outputs)


def _base(x: SX, count: int) -> list[SX]:
    """Return the first `count` rows as a list to stack; CasADi's `x[:0]` of a scalar would be one row."""
    return [x[:count]] if count else []


def _forward_dynamics(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    tau = SX.sym("tau", v.shape[0])
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    articulation = inward_inertia_pass(mechanism, kinematics, JointTerms(tau, SX(tau.numel(), tau.numel())), {})
    vdot, _ = outward_acceleration_pass(mechanism, kinematics, articulation)
    return _function("forward_dynamics", guess, {"q": q, "v": v, "tau": tau}, {"vdot": vdot})


def _forward_dynamics_with_wrenches(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    tau, wrenches = SX.sym("tau", v.shape[0]), SX.sym("wrenches", 6 * len(mechanism.robot.bodies))
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    on_bodies, on_joints = external_wrenches(mechanism, kinematics, ca.reshape(wrenches, 6, -1))
    joints = JointTerms(tau + on_joints, SX(tau.numel(), tau.numel()))
    articulation = inward_inertia_pass(mechanism, kinematics, joints, on_bodies)
    vdot, _ = outward_acceleration_pass(mechanism, kinematics, articulation)
    inputs = {"q": q, "v": v, "tau": tau, "wrenches": wrenches}
    return _function("forward_dynamics_with_wrenches", guess, inputs, {"vdot": vdot})


def _inverse_dynamics(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    vdot = SX.sym("vdot", v.shape[0])
    tau = inverse_dynamics(mechanism, outward_velocity_pass(mechanism, q, v, guess), vdot)
    return _function("inverse_dynamics", guess, {"q": q, "v": v, "vdot": vdot}, {"tau": tau})


def _mass_matrix(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    vdot = SX.sym("vdot", v.shape[0])
    at_rest = outward_velocity_pass(mechanism, q, SX(*v.shape), guess)
    M = ca.jacobian(inverse_dynamics(mechanism, at_rest, vdot), vdot)  # tau = M vdot + bias is linear in vdot
    return _function("mass_matrix", guess, {"q": q}, {"M": M})


def _bias_force(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    tau = inverse_dynamics(mechanism, outward_velocity_pass(mechanism, q, v, guess), SX(*v.shape))
    return _function("bias_force", guess, {"q": q, "v": v}, {"tau": tau})


def _spanning(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    positions, velocities = spanning_coordinates(mechanism, kinematics)
    robot = mechanism.robot
    q_span = ca.vertcat(*_base(q, robot.layout.base_nq), *[positions[name] for name in robot.joints])
    v_span = ca.vertcat(*_base(v, robot.layout.base_nv), *[velocities[name] for name in robot.joints])
    return _function("spanning", guess, {"q": q, "v": v}, {"q_span": q_span, "v_span": v_span})


def _spanning_acceleration(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    vdot = SX.sym("vdot", v.shape[0])
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    accelerations = {}
    for coordinates, rows in zip(kinematics.coordinates, kinematics.rows, strict=True):
        if coordinates is not None:
            qdd = coordinates.G @ vdot[rows] + coordinates.g
            accelerations |= {name: qdd[i] for name, i in coordinates.index.items()}
    robot = mechanism.robot
    spanning = ca.vertcat(*_base(vdot, robot.layout.base_nv), *[accelerations[name] for name in robot.joints])
    return _function("spanning_acceleration", guess, {"q": q, "v": v, "vdot": vdot}, {"vdot_span": spanning})


def _spanning_jacobian(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    _, velocities = spanning_coordinates(mechanism, outward_velocity_pass(mechanism, q, v, guess))
    robot = mechanism.robot
    G = ca.jacobian(ca.vertcat(*_base(v, robot.layout.base_nv), *[velocities[name] for name in robot.joints]), v)
    return _function("spanning_jacobian", guess, {"q": q}, {"G": G})


def _implicit_constraint(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    columns = {name: list(rows) for name, (_, rows) in mechanism.robot.spanning_rows.items()}
    count = sum(map(len, columns.values()))
    jacobians, biases = [SX(0, count)], [SX(0, 1)]
    for cluster, closure, coordinates in zip(
        mechanism.tree.clusters, closures(mechanism), kinematics.coordinates, strict=True
    ):
        if coordinates is None or not cluster.constraints:
            continue
        at, speed = SX.sym("q", len(cluster.bodies)), SX.sym("qd", len(cluster.bodies))
        phi = constant(linear_rows(cluster)[0]) @ at
        if closure is not None:
            phi = ca.vertcat(phi, nonlinear_rows(mechanism.robot, cluster, at)[list(closure.assembly.rows)])
        K = ca.jacobian(phi, at)
        rows = ca.Function("rows", [at, speed], [K, -ca.jtimes(K @ speed, at, speed)])
        K_here, bias = rows(coordinates.q, coordinates.qd)
        spread = SX(K_here.shape[0], count)
        spread[:, [column for name in cluster.bodies for column in columns[name]]] = K_here
        jacobians.append(spread)
        biases.append(bias)
    outputs = {"K": ca.vertcat(*jacobians), "k": ca.vertcat(*biases)}
    return _function("implicit_constraint", guess, {"q": q, "v": v}, outputs)


def _loops(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, SX(*v.shape), guess)
    _, nearness = loop_state(kinematics)
    dependent = guessed_coordinates(kinematics, SX(*v.shape), 0.0)
    outputs = {"dependent": dependent, "gap": loop_gap(mechanism, kinematics), "nearness": nearness}
    return _function("loops", guess, {"q": q}, outputs)


def _body_poses(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, SX(*v.shape), guess)
    angles, _ = spanning_coordinates(mechanism, kinematics)
    positions, rotations = [], []
    for body in mechanism.robot.bodies:
        if body.name in kinematics.bodies:
            p, R = kinematics.bodies[body.name].p, kinematics.bodies[body.name].R
        else:  # an eliminated rotor still has a pose
            parent = kinematics.bodies[body.parent] if body.parent is not None else None
            R_parent, p_parent = (parent.R, parent.p) if parent is not None else (SX.eye(3), SX(3, 1))
            p = p_parent + R_parent @ constant(np.array(body.placement.position))
            R = R_parent @ constant(np.array(body.placement.rotation)) @ turned(body.joint.axis, angles[body.name])
        positions.append(p)
        rotations.append(R)
    outputs = {"positions": ca.horzcat(*positions), "rotations": ca.horzcat(*rotations)}
    return _function("body_poses", guess, {"q": q}, outputs)


def _contact_points(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    positions, velocities = [SX(3, 0)], [SX(3, 0)]
    for contact in mechanism.robot.contacts:
        body, r = kinematics.bodies[contact.body], constant(np.array(contact.position))
        positions.append(body.point_position(r))
        velocities.append(body.R @ body.point_velocity(r))
    outputs = {"positions": ca.horzcat(*positions), "velocities": ca.horzcat(*velocities)}
    return _function("contact_points", guess, {"q": q, "v": v}, outputs)


def _body_velocities(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    _, rates = spanning_coordinates(mechanism, kinematics)
    angular, linear = [], []
    for body in mechanism.robot.bodies:
        if body.name in kinematics.bodies:
            state = kinematics.bodies[body.name]
            w, origin = state.R @ state.v[:3], state.R @ state.v[3:]
        else:  # an eliminated rotor turns about an axis of its carrier
            axis = constant(np.array(body.placement.rotation) @ np.array(body.joint.axis)) * rates[body.name]
            w, origin = axis, SX(3, 1)
            if body.parent is not None:
                carrier = kinematics.bodies[body.parent]
                w = carrier.R @ (carrier.v[:3] + axis)
                origin = carrier.R @ carrier.point_velocity(constant(np.array(body.placement.position)))
        angular.append(w)
        linear.append(origin)
    outputs = {"angular": ca.horzcat(*angular), "linear": ca.horzcat(*linear)}
    return _function("body_velocities", guess, {"q": q, "v": v}, outputs)


def _contact_accelerations(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    vdot = SX.sym("vdot", v.shape[0])
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    a_bodies, _ = outward_acceleration(mechanism, kinematics, vdot)
    gravity, accelerations = gravity_acceleration(mechanism), [SX(3, 0)]
    for contact in mechanism.robot.contacts:
        body, a, r = kinematics.bodies[contact.body], a_bodies[contact.body], constant(np.array(contact.position))
        in_body_axes = a[3:] + cross(a[:3], r) + cross(body.v[:3], cross(body.v[:3], r))
        accelerations.append(body.R @ in_body_axes + gravity)
    outputs = {"accelerations": ca.horzcat(*accelerations)}
    return _function("contact_accelerations", guess, {"q": q, "v": v, "vdot": vdot}, outputs)


def _energy(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    kinetic, potential = kinetic_and_potential(mechanism, q, v, guess)
    return _function("energy", guess, {"q": q, "v": v}, {"kinetic": kinetic, "potential": potential})


def turned(axis: Sequence[float], angle: SX) -> SX:
    """Return the rotation, child to parent, of a revolute joint at an angle."""
    return axis_rotation(constant(np.array(axis)), angle).T


FUNCTIONS: dict[str, Callable[[Mechanism], ca.Function]] = {
    "forward_dynamics": _forward_dynamics,
    "forward_dynamics_with_wrenches": _forward_dynamics_with_wrenches,
    "inverse_dynamics": _inverse_dynamics,
    "mass_matrix": _mass_matrix,
    "bias_force": _bias_force,
    "spanning": _spanning,
    "spanning_acceleration": _spanning_acceleration,
    "spanning_jacobian": _spanning_jacobian,
    "implicit_constraint": _implicit_constraint,
    "loops": _loops,
    "body_poses": _body_poses,
    "body_velocities": _body_velocities,
    "contact_points": _contact_points,
    "contact_accelerations": _contact_accelerations,
    "energy": _energy,
}
