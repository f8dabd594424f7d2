"""One time step of one robot: the page that says what the physics is.

The step is linearly implicit: whatever is stiff (contact, friction, joint stops, damping, position control) is taken
one step ahead, which adds to inertias and leaves the recursion as it is. May know everything in this room.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import casadi as ca
import numpy as np

from ce_gym.dynamics.actuation import (
    JointForce,
    limit_stiffness,
    limit_stop,
    position_motor,
    torque_motor,
    viscous_damping,
)
from ce_gym.dynamics.ce_aba import (
    BodyTerms,
    JointTerms,
    gravity_acceleration,
    inward_inertia_pass,
    outward_acceleration_pass,
)
from ce_gym.dynamics.closure import closures
from ce_gym.dynamics.contact import ContactResponse, ground_contact
from ce_gym.dynamics.functions import guessed_coordinates, loop_gap, loop_state, state_symbols, traced
from ce_gym.dynamics.integration import advance
from ce_gym.dynamics.kinematics import Kinematics, constant, outward_velocity_pass
from ce_gym.dynamics.spatial import SX
from ce_gym.model.description import ContactMaterial, ContactSphere
from ce_gym.model.mechanism import Mechanism

LOST_LOOP = 1e-5
"""A robot with a loop whose residual is larger has diverged [m]."""
SINGULAR = 1e-3
"""A robot whose loops are nearer than this to a singularity (see `Model.nearness`) has diverged."""
SANE_SPEED = 1e4
"""A robot any of whose velocities is beyond this, or not a number, has diverged [rad/s or m/s]."""


@dataclass(frozen=True)
class StepOptions:
    """What a scene consists of.

    Attributes:
        dt: Length of the step [s].
        control: "position" for joint targets [rad or m] through the robot's gains, "torque" for joint torques.
        contacts: Names of the contact spheres that can touch the ground.
        material: Compliance and friction of the contacts.
    """

    dt: float
    control: Literal["position", "torque"] = "position"
    contacts: tuple[str, ...] = ()
    material: ContactMaterial = field(default_factory=ContactMaterial)


@dataclass
class Stepped:
    """What a step leaves behind.

    Attributes:
        q: Positions, shape (nq,).
        v: Velocities, shape (nv,).
        pushed: 1 for each contact that pushed, else 0, shape (n_contacts,).
        dependent: Where the dependent coordinates that no formula gives will be, roughly, shape (n_guess,).
        diverged: 1 if the robot has diverged now or before; it then stays where it was.
        torque: Motor torque at each joint, mean over the step [N m or N], shape (nj,).
        contact_forces: Mean force on each contact over the step, world axes [N], shape (3, n_contacts).
        loop_gap: Norm of the residuals of the closed loops at the start of the step [m or -].
        nearness: Distance from a singularity there, see `Model.nearness`.
    """

    q: SX
    v: SX
    pushed: SX
    dependent: SX
    diverged: SX
    torque: SX
    contact_forces: SX
    loop_gap: SX
    nearness: SX


def step(
    mechanism: Mechanism,
    q: SX,
    v: SX,
    pushed: SX,
    diverged: SX,
    target: SX,
    options: StepOptions,
    dependent: SX | None = None,
) -> Stepped:
    """Advance one robot by one time step.

    Args:
        mechanism: The robot at a transmission level.
        q: Positions, shape (nq,).
        v: Velocities, shape (nv,).
        pushed: 1 for each contact that pushed in the step before, else 0, shape (n_contacts,).
        diverged: 1 if the robot has diverged before, else 0.
        target: Joint targets or torques, shape (nj,), see `StepOptions.control`.
        options: The scene.
        dependent: Guess of the dependent coordinates that no formula gives, from the step before, shape (n_guess,);
            those of the reference pose if None.
    """
    kinematics = outward_velocity_pass(mechanism, q, v, dependent)
    motors, passive = joint_forces(mechanism, q, v, target, options)
    contacts = touching(mechanism, kinematics, pushed, options)
    gravity = {name: kinematics.bodies[name].R.T @ gravity_acceleration(mechanism) for name in mechanism.bodies}

    joints = on_coordinates(mechanism, [m + p for m, p in zip(motors, passive, strict=True)])
    articulation = inward_inertia_pass(mechanism, kinematics, joints, on_bodies(contacts, gravity))
    vdot, a = outward_acceleration_pass(mechanism, kinematics, articulation)

    q_next, v_next = advance(q, v, vdot, options.dt, mechanism.robot.floating)
    dependent_next = guessed_coordinates(kinematics, vdot, options.dt)
    sane = ca.logic_and(ca.sumsqr(v_next) < SANE_SPEED**2, diverged < 0.5)  # false if anything is not a number
    if any(closures(mechanism)):
        sane = ca.logic_and(sane, loops_close(mechanism, kinematics, q_next, dependent_next))
    ydd = vdot[-len(motors) :] if motors else SX(0, 1)
    forces = [contact.force_after(a[sphere.body], gravity[sphere.body]) for sphere, contact in contacts]
    pushes = [ca.dot(contact.normal, force) > 0 for (_, contact), force in zip(contacts, forces, strict=True)]
    in_world = [kinematics.bodies[sphere.body].R @ f for (sphere, _), f in zip(contacts, forces, strict=True)]
    return Stepped(
        q=ca.if_else(sane, q_next, q),
        v=ca.if_else(sane, v_next, v),
        pushed=ca.vertcat(SX(0, 1), *pushes),
        dependent=ca.if_else(sane, dependent_next, SX(0, 1) if dependent is None else dependent),
        diverged=ca.if_else(sane, 0, 1),
        torque=ca.vertcat(*[m.tau - m.slope * ydd[i] for i, m in enumerate(motors)]),
        contact_forces=ca.horzcat(SX(3, 0), *in_world),
        loop_gap=loop_gap(mechanism, kinematics),
        nearness=loop_state(kinematics)[1],
    )


def loops_close(mechanism: Mechanism, before: Kinematics, q: SX, dependent: SX) -> SX:
    """Return 1 if all closed loops can be assembled at the next positions `q`, away from singularities; else 0.

    A singularity where branches meet could be stepped over; being halfway to it within one step counts as being there.
    """
    still = SX(q.shape[0] - (1 if mechanism.robot.floating else 0), 1)
    gap, nearness = loop_state(outward_velocity_pass(mechanism, q, still, dependent))
    away = ca.logic_and(nearness > SINGULAR, nearness > loop_state(before)[1] / 2)
    return ca.logic_and(gap < LOST_LOOP, away)


def joint_forces(
    mechanism: Mechanism, q: SX, v: SX, target: SX, options: StepOptions
) -> tuple[list[JointForce], list[JointForce]]:
    """Return the motor's and the passive force on each independent joint."""
    robot, dt = mechanism.robot, options.dt
    n = len(robot.independent)
    y, yd = q[q.shape[0] - n :], v[v.shape[0] - n :]
    kp, kd = dict(robot.gains.kp), dict(robot.gains.kd)
    motors, passive = [], []
    for i, name in enumerate(robot.independent):
        joint = robot.body(name).joint
        if options.control == "position":
            motors.append(position_motor(y[i], yd[i], target[i], kp[name], kd[name], joint.torque, dt))
        else:
            motors.append(torque_motor(target[i], joint.torque))
        stiffness, damping = limit_stiffness(robot, name)
        stop = limit_stop(y[i], yd[i], joint.position, stiffness, damping, dt)
        passive.append(viscous_damping(yd[i], joint.damping, dt) + stop)
    return motors, passive


def touching(
    mechanism: Mechanism, kinematics: Kinematics, pushed: SX, options: StepOptions
) -> list[tuple[ContactSphere, ContactResponse]]:
    """Evaluate every contact sphere of the scene against the ground."""
    spheres = {contact.name: contact for contact in mechanism.robot.contacts}
    pairs = []
    for i, sphere in enumerate(spheres[name] for name in options.contacts):
        body, position = kinematics.bodies[sphere.body], constant(np.array(sphere.position))
        contact = ground_contact(body, position, sphere.radius, pushed[i], options.material, options.dt)
        pairs.append((sphere, contact))
    return pairs


def on_coordinates(mechanism: Mechanism, forces: list[JointForce]) -> JointTerms:
    """Stack joint forces into the coordinates of `v`; the base has none."""
    base = SX(6 if mechanism.robot.floating else 0, 1)
    tau = ca.vertcat(base, *[force.tau for force in forces])
    return JointTerms(tau, ca.vertcat(base, *[force.slope for force in forces]))


def on_bodies(contacts: list[tuple[ContactSphere, ContactResponse]], gravity: dict[str, SX]) -> dict[str, BodyTerms]:
    """Sum the contacts of each body."""
    terms: dict[str, BodyTerms] = {}
    for sphere, contact in contacts:
        new = contact.body_terms(gravity[sphere.body])
        old = terms.get(sphere.body)
        terms[sphere.body] = BodyTerms(old.inertia + new.inertia, old.force + new.force) if old else new
    return terms


def step_function(mechanism: Mechanism, options: StepOptions, outputs: tuple[str, ...] = ()) -> ca.Function:
    """Trace a step.

    Args:
        mechanism: The robot at a transmission level.
        options: The scene.
        outputs: Any of "torque", "contact_forces", "loop_gap", "nearness"; what is not asked for costs nothing.

    Returns:
        Function (q, v, pushed, dependent, diverged, target) -> (q, v, pushed, dependent, diverged, *outputs); a scene
        without contacts has no `pushed`, a robot whose loops are closed by formulas no `dependent`.
    """
    q, v, dependent = state_symbols(mechanism)
    pushed, diverged = SX.sym("pushed", len(options.contacts)), SX.sym("diverged")
    target = SX.sym("target", len(mechanism.robot.independent))
    after = step(mechanism, q, v, pushed, diverged, target, options, dependent)
    state = {"q": q, "v": v, "pushed": pushed, "dependent": dependent, "diverged": diverged}
    kept = [name for name in state if state[name].numel()]
    results = {f"{name}_next": getattr(after, name) for name in kept}
    results |= {name: ca.vec(getattr(after, name)) for name in outputs}
    return traced("step", {name: state[name] for name in kept} | {"target": target}, results)
