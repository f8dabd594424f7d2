"""The quantities of a mechanism as traced CasADi functions, by name.

Each entry of `FUNCTIONS` takes a mechanism and returns an SX function of dense columns with shared common
sub-expressions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import casadi as ca

from ce_gym.dynamics.algebra.integration import difference, integrate
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.constraints.assembly import linear_rows, nonlinear_rows
from ce_gym.dynamics.constraints.closure import closures
from ce_gym.dynamics.quantities.forces import FORCE_FUNCTIONS
from ce_gym.dynamics.quantities.frames import CONTACT_FUNCTIONS, FRAME_FUNCTIONS, body_motion, frames_of
from ce_gym.dynamics.quantities.inputs import function_of_state, state_symbols
from ce_gym.dynamics.quantities.momentum import MOMENTUM_FUNCTIONS
from ce_gym.dynamics.recursion.ce_aba import (
    JointTerms,
    inward_inertia_pass,
    outward_acceleration_pass,
)
from ce_gym.dynamics.recursion.ce_rnea import inverse_dynamics
from ce_gym.dynamics.recursion.derived import (
    external_wrenches,
    guessed_coordinates,
    kinetic_and_potential,
    loop_gap,
    loop_state,
    spanning_coordinates,
)
from ce_gym.dynamics.recursion.kinematics import constant, outward_velocity_pass
from ce_gym.model.errors import listed_names
from ce_gym.model.mechanism import Mechanism


def _base(x: SX, count: int) -> list[SX]:
    """Return the first `count` rows as a list to stack; CasADi's `x[:0]` of a scalar would be one row."""
    return [x[:count]] if count else []


def _forward_dynamics(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    tau = SX.sym("tau", v.shape[0])
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    articulation = inward_inertia_pass(mechanism, kinematics, JointTerms(tau, SX(tau.numel(), tau.numel())), {})
    vdot, _ = outward_acceleration_pass(mechanism, kinematics, articulation)
    return function_of_state("forward_dynamics", guess, {"q": q, "v": v, "tau": tau}, {"vdot": vdot})


def _forward_dynamics_with_wrenches(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    tau, wrenches = SX.sym("tau", v.shape[0]), SX.sym("wrenches", 6 * len(mechanism.robot.bodies))
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    on_bodies, on_joints = external_wrenches(mechanism, kinematics, ca.reshape(wrenches, 6, -1))
    joints = JointTerms(tau + on_joints, SX(tau.numel(), tau.numel()))
    articulation = inward_inertia_pass(mechanism, kinematics, joints, on_bodies)
    vdot, _ = outward_acceleration_pass(mechanism, kinematics, articulation)
    inputs = {"q": q, "v": v, "tau": tau, "wrenches": wrenches}
    return function_of_state("forward_dynamics_with_wrenches", guess, inputs, {"vdot": vdot})


def _inverse_dynamics(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    vdot = SX.sym("vdot", v.shape[0])
    tau = inverse_dynamics(mechanism, outward_velocity_pass(mechanism, q, v, guess), vdot)
    return function_of_state("inverse_dynamics", guess, {"q": q, "v": v, "vdot": vdot}, {"tau": tau})


def _mass_matrix(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    vdot = SX.sym("vdot", v.shape[0])
    at_rest = outward_velocity_pass(mechanism, q, SX(*v.shape), guess)
    M = ca.jacobian(inverse_dynamics(mechanism, at_rest, vdot), vdot)  # tau = M vdot + bias is linear in vdot
    return function_of_state("mass_matrix", guess, {"q": q}, {"M": M})


def _bias_force(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    tau = inverse_dynamics(mechanism, outward_velocity_pass(mechanism, q, v, guess), SX(*v.shape))
    return function_of_state("bias_force", guess, {"q": q, "v": v}, {"tau": tau})


def _spanning(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    positions, velocities = spanning_coordinates(mechanism, kinematics)
    robot = mechanism.robot
    q_span = ca.vertcat(*_base(q, robot.layout.base_nq), *[positions[name] for name in robot.joints])
    v_span = ca.vertcat(*_base(v, robot.layout.base_nv), *[velocities[name] for name in robot.joints])
    return function_of_state("spanning", guess, {"q": q, "v": v}, {"q_span": q_span, "v_span": v_span})


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
    return function_of_state("spanning_acceleration", guess, {"q": q, "v": v, "vdot": vdot}, {"vdot_span": spanning})


def _spanning_jacobian(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    _, velocities = spanning_coordinates(mechanism, outward_velocity_pass(mechanism, q, v, guess))
    robot = mechanism.robot
    G = ca.jacobian(ca.vertcat(*_base(v, robot.layout.base_nv), *[velocities[name] for name in robot.joints]), v)
    return function_of_state("spanning_jacobian", guess, {"q": q}, {"G": G})


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
    return function_of_state("implicit_constraint", guess, {"q": q, "v": v}, outputs)


def _loops(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, SX(*v.shape), guess)
    _, nearness = loop_state(kinematics)
    dependent = guessed_coordinates(kinematics, SX(*v.shape), 0.0)
    outputs = {"dependent": dependent, "gap": loop_gap(mechanism, kinematics), "nearness": nearness}
    return function_of_state("loops", guess, {"q": q}, outputs)


def _body_poses(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, SX(*v.shape), guess)
    motions = [body_motion(mechanism, kinematics, body.name) for body in mechanism.robot.bodies]
    positions, rotations = ca.horzcat(*[motion.p for motion in motions]), ca.horzcat(*[motion.R for motion in motions])
    return function_of_state("body_poses", guess, {"q": q}, {"positions": positions, "rotations": rotations})


def _body_velocities(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    kinematics = outward_velocity_pass(mechanism, q, v, guess)
    motions = [body_motion(mechanism, kinematics, body.name) for body in mechanism.robot.bodies]
    outputs = {
        "angular": ca.horzcat(*[motion.w for motion in motions]),
        "linear": ca.horzcat(*[motion.v for motion in motions]),
    }
    return function_of_state("body_velocities", guess, {"q": q, "v": v}, outputs)


def _energy(mechanism: Mechanism) -> ca.Function:
    q, v, guess = state_symbols(mechanism)
    kinetic, potential = kinetic_and_potential(mechanism, q, v, guess)
    return function_of_state("energy", guess, {"q": q, "v": v}, {"kinetic": kinetic, "potential": potential})


def _integrate(mechanism: Mechanism) -> ca.Function:
    q, v, _ = state_symbols(mechanism)
    return traced("integrate", {"q": q, "dv": v}, {"q": integrate(q, v, mechanism.robot.layout)})


def _difference(mechanism: Mechanism) -> ca.Function:
    q, _, _ = state_symbols(mechanism)
    q1 = SX.sym("q1", *q.shape)
    return traced("difference", {"q": q, "q1": q1}, {"dv": difference(q, q1, mechanism.robot.layout)})


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
    "energy": _energy,
    "integrate": _integrate,
    "difference": _difference,
    **MOMENTUM_FUNCTIONS,
    **FORCE_FUNCTIONS,
}


def trace(mechanism: Mechanism, name: str) -> ca.Function:
    """Trace a quantity: of `FUNCTIONS`, of a frame, or of contacts, all or by name.

    Names are such as "mass_matrix", "frame_jacobian:FRAME", "contact_jacobian" and "contact_jacobian:CONTACT,CONTACT".

    Raises:
        KeyError: If there is no such quantity, frame or contact.
    """
    kind, colon, place = name.partition(":")
    if kind in FRAME_FUNCTIONS:
        _check_known("frame", place, kind, frames_of(mechanism))
        return FRAME_FUNCTIONS[kind](mechanism, place)
    if kind in CONTACT_FUNCTIONS:
        contacts = {contact.name: contact for contact in mechanism.robot.contacts}
        names = place.split(",") if place else [] if colon else [*contacts]
        for contact in names:
            _check_known("contact", contact, kind, contacts)
        return CONTACT_FUNCTIONS[kind](mechanism, [contacts[contact] for contact in names])
    if name not in FUNCTIONS:
        known = [*FUNCTIONS, *CONTACT_FUNCTIONS, *(f"{kind}:FRAME" for kind in FRAME_FUNCTIONS)]
        raise KeyError(f"no function {name!r}; expected one of {listed_names(name, known)}")
    return FUNCTIONS[name](mechanism)


def _check_known(what: str, name: str, quantity: str, known: Iterable[str]) -> None:
    if name not in known:
        raise KeyError(f"no {what} {name!r} for {quantity!r}; expected one of {listed_names(name, known)}")
