"""One time step of one robot: the page that says what the physics is.

The step is linearly implicit: whatever is stiff (contact, friction, joint stops, damping, position control) is taken
one step ahead, which adds to inertias and leaves the recursion as it is. A step of length 0 gives the acceleration of
the moment. May know everything in this room but the methods that are made of such steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.integration import advance
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.actuation import JointForce, MotorForce, limit_count, passive_forces
from ce_gym.dynamics.forces.contact import Contact, ContactResponse, Hint, touch_ground
from ce_gym.dynamics.forces.motor_control import commanded_forces
from ce_gym.dynamics.forces.scene import Scene, State, StepOptions
from ce_gym.dynamics.functions import guessed_coordinates
from ce_gym.dynamics.recursion.ce_aba import (
    BodyTerms,
    JointTerms,
    gravity_acceleration,
    inward_inertia_pass,
    outward_acceleration_pass,
)
from ce_gym.dynamics.recursion.gyroscopic import Whirl, turning_momentum
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant, outward_velocity_pass
from ce_gym.model.description import ContactSphere
from ce_gym.model.mechanism import Mechanism


@dataclass
class Solved:
    """Accelerations and forces over one step.

    Attributes:
        kinematics: At the start of the step.
        vdot: Acceleration, shape (nv,).
        motors: What the motors deliver to the joints.
        contacts: The contacts of the scene.
        responses: Their forces as functions of their velocities.
        gains: What their velocities gain in the step, body axes [m/s], shape (3,) each.
    """

    kinematics: Kinematics
    vdot: SX
    motors: MotorForce
    contacts: list[Contact]
    responses: list[ContactResponse]
    gains: list[SX]


def solve(scene: Scene, state: State, target: SX, dt: float, hints: SX) -> Solved:
    """Find the acceleration of one robot over a step, by CE-ABA.

    Args:
        scene: The robot and what surrounds it.
        state: At the start of the step.
        target: Targets or torques of what `target_names` says, shape (n_targets,).
        dt: Length of the step [s].
        hints: What the attempt before has found, shape (hint_count,): of the contacts, Hint.SIZE each, then of the
            limited torques; zero for the first.
    """
    mechanism, n = scene.mechanism, len(scene.mechanism.robot.independent)
    y, yd = state.q[state.q.shape[0] - n :], state.v[state.v.shape[0] - n :]
    kinematics = outward_velocity_pass(mechanism, state.q, state.v, state.dependent)

    motors = commanded_forces(scene, kinematics, y, yd, target, dt, hints[Hint.SIZE * len(scene.options.contacts) :])
    joints = on_coordinates(mechanism, motors + passive_forces(mechanism.robot, y, yd, dt))
    contacts = touching(scene, kinematics, state, dt, hints)
    if scene.options.friction == "secant":
        responses = [contact.secant() for contact in contacts]
    else:
        responses = [contact.tangent() for contact in contacts]

    gravity = {name: kinematics.bodies[name].R.T @ gravity_acceleration(mechanism) for name in mechanism.bodies}
    external = on_bodies(contacts, responses, gravity)
    at_once = isinstance(dt, float) and dt == 0  # the acceleration of the moment
    whirl = None if at_once else Whirl(state.v, dt)
    turning = None if at_once else turning_momentum(mechanism, state.v, dt)
    articulation = inward_inertia_pass(mechanism, kinematics, joints, external, whirl)
    vdot, a = outward_acceleration_pass(mechanism, kinematics, articulation, turning)
    gains = [r.velocity_gain(a[c.body], gravity[c.body]) for c, r in zip(contacts, responses, strict=True)]
    return Solved(kinematics, vdot, motors, contacts, responses, gains)


@dataclass
class Stepped:
    """What a step leaves behind.

    Attributes:
        state: At the end of the step.
        solved: How it came about.
        torque: Motor torque at each joint, mean over the step [N m or N], shape (nj,).
        contact_forces: Mean force on each contact over the step, world axes [N], shape (3, n_contacts).
        misjudged: 1 if a contact or a motor did not do what it was taken to do, else 0.
        hints: What to make another attempt with; if not misjudged, one that comes to the same.
        error: Estimate of the error of the step in `v` [rad/s or m/s]; 0 for a method that has none.
    """

    state: State
    solved: Solved
    torque: SX
    contact_forces: SX
    misjudged: SX
    hints: SX
    error: SX


def attempt(scene: Scene, state: State, target: SX, dt: float, hints: SX) -> Stepped:
    """Attempt one linearly implicit Euler step; arguments as for `solve`."""
    solved = solve(scene, state, target, dt, hints)
    kinematics, triples = solved.kinematics, list(zip(solved.contacts, solved.responses, solved.gains, strict=True))
    q, v = advance(state.q, state.v, solved.vdot, dt, scene.mechanism.robot.floating)
    rotations = [kinematics.bodies[contact.body].R for contact in solved.contacts]
    anchors = [(R @ c.anchor_after(gain))[:2] for R, (c, _, gain) in zip(rotations, triples, strict=True)]
    after = State(
        q=q,
        v=v,
        load=stacked([ca.fmax(c.normal_after(gain), 0) for c, _, gain in triples]),
        anchor=stacked(anchors) if state.anchor.numel() else state.anchor,
        dependent=guessed_coordinates(kinematics, solved.vdot, dt),
    )
    forces = [R @ r.force_after(gain) for R, (_, r, gain) in zip(rotations, triples, strict=True)]
    ydd = solved.vdot[solved.vdot.shape[0] - solved.motors.tau.shape[0] :]
    at_contacts = Hint.SIZE * len(triples)
    of_torques, wrong = solved.motors.found(ydd, hints.numel() - at_contacts)
    misjudged = ca.logic_or(wrong, ca.sum1(stacked([c.misjudged(r, gain) for c, r, gain in triples])) > 0)
    of_contacts = stacked([c.hint_after(gain, r.slip) for c, r, gain in triples])
    # A robot that was judged well makes the same step again if its tile does; torques found as they were taken to be.
    of_contacts = ca.if_else(misjudged, of_contacts, hints[:at_contacts])
    return Stepped(
        state=after,
        solved=solved,
        torque=solved.motors.tau - solved.motors.slope @ ydd,
        contact_forces=ca.horzcat(SX(3, 0), *forces),
        misjudged=misjudged,
        hints=ca.vertcat(of_contacts, of_torques),
        error=SX(0),
    )


def implicit_step(scene: Scene, state: State, target: SX, dt: float) -> Stepped:
    """Advance one robot by one linearly implicit Euler step, with further attempts where it was misjudged."""
    stepped = attempt(scene, state, target, dt, no_hints(scene))
    for _ in range(further_attempts(scene.mechanism, scene.options)):
        stepped = attempt(scene, state, target, dt, stepped.hints)
    return stepped


def further_attempts(mechanism: Mechanism, options: StepOptions) -> int:
    """Return how many attempts at a step may follow the first: for limited torques, or else for contacts alone."""
    contacts = options.contacts and options.friction != "secant"
    return 4 if limit_count(mechanism, options) else 2 if contacts else 0


def no_hints(scene: Scene) -> SX:
    """Return the hints of a first attempt."""
    return SX(hint_count(scene.mechanism, scene.options), 1)


def hint_count(mechanism: Mechanism, options: StepOptions) -> int:
    """Return how many numbers an attempt leaves for the next."""
    return Hint.SIZE * len(options.contacts) + limit_count(mechanism, options)


def touching(scene: Scene, kinematics: Kinematics, state: State, dt: float, hints: SX) -> list[Contact]:
    """Place every contact sphere of the scene against the ground."""
    contacts = []
    for i, sphere in enumerate(contact_spheres(scene.mechanism, scene.options)):
        body, position = kinematics.bodies[sphere.body], constant(np.array(sphere.position))
        height, normal = SX(0), constant(np.array([0.0, 0.0, 1.0]))
        if scene.options.ground == "field":
            height, slope = scene.ground[0, i], scene.ground[1:, i]
            if scene.looked_up.numel():
                height += ca.dot(slope, body.point_position(position)[:2] - scene.looked_up[:, i])
            normal = ca.vertcat(-slope, 1) / ca.sqrt(1 + ca.sumsqr(slope))
        anchor = state.anchor[2 * i : 2 * i + 2] if state.anchor.numel() else state.anchor
        hint = Hint.of(hints[Hint.SIZE * i : Hint.SIZE * (i + 1)])
        touch = touch_ground(body, position, sphere.radius, height, normal, state.load[i], anchor)
        contacts.append(Contact(sphere.body, touch, scene.figures.compliance, dt, hint))
    return contacts


def contact_spheres(mechanism: Mechanism, options: StepOptions) -> list[ContactSphere]:
    """Return the contact spheres of a scene."""
    spheres = {contact.name: contact for contact in mechanism.robot.contacts}
    return [spheres[name] for name in options.contacts]


def contact_places(mechanism: Mechanism, options: StepOptions, kinematics: Kinematics) -> SX:
    """Return x and y of the centre of every contact sphere of a scene [m], shape (2, n_contacts)."""
    places = [
        kinematics.bodies[sphere.body].point_position(constant(np.array(sphere.position)))[:2]
        for sphere in contact_spheres(mechanism, options)
    ]
    return ca.horzcat(SX(2, 0), *places)


def looked_up_from(scene: Scene, kinematics: Kinematics) -> Scene:
    """Return a scene whose ground is known around the contacts as they are, for use when they have moved on."""
    return replace(scene, looked_up=contact_places(scene.mechanism, scene.options, kinematics))


def on_coordinates(mechanism: Mechanism, force: JointForce) -> JointTerms:
    """Take a force on the independent joints to the coordinates of `v`; the base has none."""
    base = 6 if mechanism.robot.floating else 0
    return JointTerms(ca.vertcat(SX(base, 1), force.tau), ca.diagcat(SX(base, base), force.slope))


def on_bodies(
    contacts: list[Contact], responses: list[ContactResponse], gravity: dict[str, SX]
) -> dict[str, BodyTerms]:
    """Sum the contacts of each body."""
    terms: dict[str, BodyTerms] = {}
    for contact, response in zip(contacts, responses, strict=True):
        new, old = response.body_terms(gravity[contact.body]), terms.get(contact.body)
        terms[contact.body] = BodyTerms(old.inertia + new.inertia, old.force + new.force) if old else new
    return terms


def stacked(columns: list[SX]) -> SX:
    """Stack columns, perhaps none."""
    return ca.vertcat(SX(0, 1), *columns)
