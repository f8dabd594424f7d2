"""One time step of one robot: the page that says what the physics is.

The step is linearly implicit: whatever is stiff (contact, friction, joint stops, damping, position control) is taken
one step ahead, which adds to inertias and leaves the recursion as it is. A step of length 0 gives the acceleration of
the moment.

Which contacts act, slip or stick, which motors are at their limits and which joints dry friction holds is an active
set. `iteration` makes the step with the set that its iterate assumes, says whether that is the set it came to, and
returns the next iterate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.integration import advance
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.drives.load import carried_after, carried_now, supply_after, windings_after
from ce_gym.dynamics.drives.mesh import MESH_ITERATIONS, Meshes, MeshForce, mesh_count, stretch_resistances
from ce_gym.dynamics.drives.stretch import stretching
from ce_gym.dynamics.forces.actuation import Before, limit_count
from ce_gym.dynamics.forces.contact import Contact, LinearContact, touch_ground, where
from ce_gym.dynamics.forces.dry_friction import STICK_ITERATIONS, JointFriction, friction_count, stand_still
from ce_gym.dynamics.forces.friction import FRICTION
from ce_gym.dynamics.forces.law import JointForce, Motion, is_moment
from ce_gym.dynamics.forces.motor_control import Motors
from ce_gym.dynamics.forces.normal import normal_law
from ce_gym.dynamics.forces.passive import ball_forces, passive_forces, yielding_forces
from ce_gym.dynamics.forces.saturation import ITERATIONS, SaturatedForce
from ce_gym.dynamics.forces.scene import Scene, State, StepOptions, contact_centres, contact_places, state_sizes
from ce_gym.dynamics.forces.self_collision import Frictionless, LinearPair, Pair, meeting, pressed_on, settled
from ce_gym.dynamics.hulls import with_hulls
from ce_gym.dynamics.recursion.ce_aba import (
    BodyTerms,
    JointTerms,
    gravity_acceleration,
    inward_inertia_pass,
    outward_acceleration_pass,
)
from ce_gym.dynamics.recursion.derived import guessed_coordinates
from ce_gym.dynamics.recursion.gyroscopic import TurningDamping, steadying_couples, turning_momentum
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant, outward_velocity_pass
from ce_gym.dynamics.stepping.choice import anything_near
from ce_gym.dynamics.stepping.methods import METHODS
from ce_gym.model.checks.collisions import colliding
from ce_gym.model.mechanism import Mechanism


@dataclass
class Solved:
    """Accelerations and forces over one step.

    Attributes:
        kinematics: At the start of the step.
        vdot: Acceleration, shape (nv,).
        motion: The same of joints and bodies.
        contacts: Forces of the contacts of the scene.
        pairs: Forces between links.
        motors: What the motors deliver to the joints.
        friction: Dry friction of the joints, one or none.
        meshes: Of the transmissions that stretch, one or none.
        carried: What friction under load went by, as `State.carried` is.
        inertia: Of clusters, without what acts on their coordinates, shape (d, d) each.
        resistances: Of stretches, see `stretch_resistances`.
        near: Whether something that is seldom near is, 1 or 0; None if all acts always.
    """

    kinematics: Kinematics
    vdot: SX
    motion: Motion
    contacts: list[LinearContact]
    pairs: list[LinearPair]
    motors: SaturatedForce
    friction: list[SaturatedForce]
    meshes: list[MeshForce]
    carried: SX
    inertia: dict[int, SX]
    resistances: dict[int, SX]
    near: SX | None


def solve(scene: Scene, state: State, target: SX, dt: float, iterate: SX) -> Solved:
    """Find the acceleration of one robot over a step, by CE-ABA.

    Args:
        scene: The robot and what surrounds it.
        state: At the start of the step.
        target: Targets or torques of what `target_names` says, shape (n_targets,).
        dt: Length of the step [s].
        iterate: From the iteration before: of contacts, pairs, motors, joints' dry friction, meshes of transmissions
            and what motors carry, shape (iterate_size,).
    """
    mechanism, acting = scene.mechanism, acting_forces(scene, state, target, dt, iterate)
    kinematics, contacts, gravity = acting.kinematics, acting.contacts, acting.gravity
    external, at_once = on_bodies(contacts, gravity, acting.couples), is_moment(dt)
    turning = None if at_once else TurningDamping(state.v, dt)
    momentum = None if at_once else turning_momentum(mechanism, state.v, dt)
    forces = SX.sym("forces", len(acting.pairs))
    external = pressed_on(external, acting.pairs, forces)
    articulation = inward_inertia_pass(mechanism, kinematics, acting.joints, external, turning)
    if acting.pairs:
        vdot, a = settled(mechanism, kinematics, articulation, momentum, acting.pairs, forces)
    else:
        vdot, a = outward_acceleration_pass(mechanism, kinematics, articulation, momentum)
    of_clusters = articulation.D, articulation.inertia
    resistances = stretch_resistances(mechanism, kinematics, *of_clusters, acting.unmeshed.slope)
    return acting.solved(vdot, a, articulation.inertia, resistances)


@dataclass
class Acting:
    """What acts on a robot over one step, linear in its acceleration.

    Attributes:
        kinematics: At the start of the step.
        contacts: Forces of the contacts of the scene.
        pairs: Forces between links.
        motors: What the motors deliver to the joints.
        friction: Dry friction of the joints, one or none.
        meshes: Of the transmissions that stretch, one or none.
        unmeshed: Those on joints but for meshes.
        joints: Those and what the joints do by themselves.
        couples: What steadies the bodies of ball joints, body axes [N m], shape (3,) each, by name.
        gravity: Acceleration of free fall in the axes of each body, shape (3,) each.
        carried: What friction under load goes by, as `State.carried` is.
        near: Whether something that is seldom near is, 1 or 0; None if all acts always.
    """

    kinematics: Kinematics
    contacts: list[LinearContact]
    pairs: list[LinearPair]
    motors: SaturatedForce
    friction: list[SaturatedForce]
    meshes: list[MeshForce]
    unmeshed: JointForce
    joints: JointTerms
    couples: dict[str, SX]
    gravity: dict[str, SX]
    carried: SX
    near: SX | None

    def solved(
        self, vdot: SX, a: dict[str, SX], inertia: dict[int, SX] | None = None, resistances: dict[int, SX] | None = None
    ) -> Solved:
        """Return it with the acceleration (nv,) that comes of it, and that of each body minus gravity, (6,) each.

        Args:
            vdot: The acceleration.
            a: Of the bodies.
            inertia: Of clusters; if it is not known, what motors carry stays what it was.
            resistances: Of stretches, see `stretch_resistances`; if they are not known, the iterate of meshes stays.
        """
        motion = Motion(vdot[vdot.numel() - self.motors.tau.numel() :], a, self.gravity)
        laws = self.contacts, self.pairs, self.motors, self.friction, self.meshes
        found = inertia or {}, resistances or {}
        return Solved(self.kinematics, vdot, motion, *laws, self.carried, *found, self.near)


def acting_forces(scene: Scene, state: State, target: SX, dt: float, iterate: SX) -> Acting:
    """Linearise all forces about an iterate; arguments as for `solve`."""
    mechanism, layout = scene.mechanism, scene.mechanism.robot.layout
    y, yd = state.q[layout.joints_q :], state.v[layout.joints_v :]
    kinematics = outward_velocity_pass(mechanism, state.q, state.v, state.dependent)

    laws, meeting = touching(scene, kinematics, state, dt), meeting_pairs(scene, kinematics, state, dt)
    near = only_near(scene, laws, meeting, dt) if scene.choosing else None
    unloaded = iterate.numel() - state.carried.numel()
    carried = carried_now(state, iterate[unloaded:])
    before = Before.of(mechanism, scene.options, carried, state)
    driven = Motors(scene, kinematics, y, yd, target, dt, before)
    rubbing = JointFriction(mechanism, kinematics, yd, dt)
    sizes = [law.size for law in (*laws, *meeting, driven, rubbing)]
    *of_contacts, of_motors, of_friction, of_meshes = split(iterate[:unloaded], sizes)
    contacts = [law.linearise(part) for law, part in zip(laws, of_contacts, strict=False)]
    pairs = [law.linearise(part) for law, part in zip(meeting, of_contacts[len(laws) :], strict=True)]
    motors = driven.linearise(of_motors)
    friction = [rubbing.linearise(of_friction)] if rubbing.size else []
    meshes = [Meshes(scene, y, yd, dt).linearise(of_meshes)] if stretching(mechanism) else []

    of_balls = ball_forces(mechanism, state.q, state.v, dt)
    more = [*friction, *yielding_forces(mechanism, kinematics, dt)]
    unmeshed = sum(more, motors + passive_forces(mechanism, y, yd, dt))
    joints = on_coordinates(mechanism, of_balls, sum(meshes, unmeshed))
    couples = {} if is_moment(dt) else steadying_couples(mechanism, kinematics, dt)
    gravity = {name: kinematics.bodies[name].R.T @ gravity_acceleration(mechanism) for name in mechanism.bodies}
    laws = contacts, pairs, motors, friction, meshes
    return Acting(kinematics, *laws, unmeshed, joints, couples, gravity, carried, near)


@dataclass
class Stepped:
    """What a step leaves behind.

    Attributes:
        state: At the end of the step.
        before: At its start.
        solved: How it came about.
        torque: Motor torque at each joint, mean over the step [N m or N], shape (nj,).
        contact_forces: Mean force on each contact over the step, world axes [N], shape (3, n_contacts).
        unconverged: 1 if the active set of a contact, motor, joint's friction or mesh is not as was assumed, else 0.
        iterate: For the next iteration; once converged, a fixed point.
        error: Estimate of the error of the step in `v` [rad/s or m/s]; 0 for a method that has none.
    """

    state: State
    before: State
    solved: Solved
    torque: SX
    contact_forces: SX
    unconverged: SX
    iterate: SX
    error: SX


def iteration(scene: Scene, state: State, target: SX, dt: float, iterate: SX) -> Stepped:
    """Make one iteration of a linearly implicit Euler step; arguments as for `solve`."""
    return stepped(scene, state, solve(scene, state, target, dt, iterate), dt, iterate)


def stepped(scene: Scene, state: State, solved: Solved, dt: float, iterate: SX) -> Stepped:
    """Return what a step leaves behind whose acceleration is known; arguments as for `solve`."""
    kinematics, motion, motors = solved.kinematics, solved.motion, solved.motors
    yd = state.v[scene.mechanism.robot.layout.joints_v :]
    q, v = advance(state.q, state.v, solved.vdot, dt, scene.mechanism.robot.layout)
    saturated = [motors, *solved.friction]
    frictions = [one for force in saturated for one in force.frictions]
    stand_still(scene.mechanism, kinematics, frictions, state.q, q, v, dt)
    contacts = [(kinematics.bodies[c.body].R, c, c.gain(motion)) for c in solved.contacts]
    anchors = [where(c.law.near, (R @ c.anchor_after(gain))[:2]) for R, c, gain in contacts]
    after = State(
        q=q,
        v=v,
        load=stacked([where(c.law.near, ca.fmax(c.load_after(gain), 0)) for _, c, gain in contacts]),
        whole_load=state.whole_load,
        anchor=stacked(anchors) if state.anchor.numel() else state.anchor,
        dependent=guessed_coordinates(kinematics, solved.vdot, dt),
        pressed=stacked([where(p.law.near, ca.fmax(p.normal_after(p.gain(motion)), 0)) for p in solved.pairs]),
        carried=carried_after(scene, kinematics, motors, solved.inertia, motion) if solved.inertia else solved.carried,
        winding=windings_after(scene, motors, motion),
        supply=supply_after(scene, kinematics, motors, motion, state.supply, yd, dt),
        held=motors.sampled,
    )
    forces = [where(c.law.near, R @ c.force_after(gain)) for R, c, gain in contacts]
    touches = [*solved.contacts, *solved.pairs]
    unconverged = ca.sum1(stacked([c.check(motion) for c in touches])) > 0
    for force in (*saturated, *solved.meshes):
        unconverged = ca.logic_or(force.check(motion), unconverged)
    if solved.carried.numel():
        extrapolates = METHODS[scene.options.method].estimates
        unconverged = ca.logic_or(unconverged, (iterate if extrapolates else solved.carried)[-1] < 0.5)
    # Converged lanes keep their iterate, so re-running their tile reproduces their result; those of motors are fixed
    # points by themselves.
    parts = split(iterate, [c.law.size for c in touches])
    of_contacts = stacked(
        [
            where(c.law.near, ca.if_else(unconverged, c.next_iterate(motion), part), part)
            for c, part in zip(touches, parts, strict=False)
        ]
    )
    of_friction = stacked([force.next_iterate(motion) for force in solved.friction])
    sound = ca.logic_and(unconverged, ca.logic_not(motors.check(motion)))  # rotors that stop within a step carry a blow
    of_carried = ca.if_else(sound, after.carried, solved.carried)
    last = iterate.numel() - of_carried.numel()
    end = last - mesh_count(scene.mechanism)
    of_friction = ca.if_else(unconverged, of_friction, iterate[end - of_friction.numel() : end])
    of_meshes = iterate[end:last]
    if of_meshes.numel() and solved.resistances:
        of_meshes = ca.if_else(unconverged, solved.meshes[0].next_iterate(motion, solved.resistances), of_meshes)
    return Stepped(
        state=after,
        before=state,
        solved=solved,
        torque=(motors.tau - motors.slope @ motion.ydd)[: len(scene.mechanism.robot.commanded)],
        contact_forces=with_hulls(ca.horzcat(SX(3, 0), *forces), scene.options.hulls),
        unconverged=unconverged,
        iterate=ca.vertcat(of_contacts, motors.next_iterate(motion), of_friction, of_meshes, of_carried),
        error=SX(0),
    )


def iterations_needed(mechanism: Mechanism, options: StepOptions) -> int:
    """Return how many iterations of a step may follow the first."""
    contacts = FRICTION[options.friction].iterations if options.contacts else 0
    pairs = Frictionless.iterations if options.self_collisions else 0
    limited = ITERATIONS if limit_count(mechanism, options) else 0
    meshes = MESH_ITERATIONS if mesh_count(mechanism) else 0
    rubbing = STICK_ITERATIONS if friction_count(mechanism, options.parameters) else 0
    return max(contacts, pairs, limited, meshes, rubbing)


def first_iterate(scene: Scene) -> SX:
    """Return the iterate of a first iteration."""
    return SX(iterate_size(scene.mechanism, scene.options), 1)


def iterate_size(mechanism: Mechanism, options: StepOptions) -> int:
    """Return how many numbers an iteration leaves for the next."""
    touches = len(options.touches) + len(colliding(mechanism.robot, options.self_collisions))
    of_joints = limit_count(mechanism, options) + friction_count(mechanism, options.parameters) + mesh_count(mechanism)
    return Contact.size * touches + of_joints + state_sizes(mechanism, options).get("carried", 0)


def rows_of_near(mechanism: Mechanism, options: StepOptions) -> list[int]:
    """Return which rows of an iterate belong to what acts only where it is near."""
    acts = [name in options.seldom for name in options.touches]
    acts += [True] * len(colliding(mechanism.robot, options.self_collisions))
    return [Contact.size * i + j for i, seldom in enumerate(acts) if seldom for j in range(Contact.size)]


def touching(scene: Scene, kinematics: Kinematics, state: State, dt: float) -> list[Contact]:
    """Place every contact sphere of the scene against the ground."""
    contacts, options = [], scene.options
    normal, friction = normal_law(options.normal_law, options.material), FRICTION[options.friction]
    resolves = METHODS[options.method].controlled
    for i, (sphere, centre) in enumerate(contact_centres(scene)):
        body = kinematics.bodies[sphere.body]
        height, up = SX(0), constant(np.array([0.0, 0.0, 1.0]))
        if options.ground == "field":
            height, slope = scene.ground[0, i], scene.ground[1:, i]
            if scene.looked_up.numel():
                height += ca.dot(slope, body.point_position(centre)[:2] - scene.looked_up[:, i])
            up = ca.vertcat(-slope, 1) / ca.sqrt(1 + ca.sumsqr(slope))
        anchor = state.anchor[2 * i : 2 * i + 2] if state.anchor.numel() else state.anchor
        touch = touch_ground(body, sphere, centre, height, up, state.load[i], anchor)
        law = Contact(sphere.body, touch, scene.figures.compliance, normal, friction, dt, resolves_landing=resolves)
        contacts.append(law)
    return contacts


def meeting_pairs(scene: Scene, kinematics: Kinematics, state: State, dt: float) -> list[Pair]:
    """Place the capsules of every pair of links that may touch against each other."""
    robot, options, compliance = scene.mechanism.robot, scene.options, scene.figures.compliance
    law, pairs = normal_law(options.normal_law, options.material), []
    for i, pair in enumerate(colliding(robot, options.self_collisions)):
        bodies = kinematics.bodies[pair[0].body], kinematics.bodies[pair[1].body]
        meeting_pair = meeting(pair, bodies, state.pressed[i], compliance, law, dt)
        pairs.append(replace(meeting_pair, resolves_landing=METHODS[options.method].controlled))
    return pairs


def only_near(scene: Scene, contacts: list[Contact], pairs: list[Pair], dt: float) -> SX:
    """Let what is seldom near act only where it is; return whether something is, 1 or 0."""
    named = zip(scene.options.touches, contacts, strict=True)
    seldom = [*[contact for name, contact in named if name in scene.options.seldom], *pairs]
    near = anything_near([law.touch for law in seldom], dt)
    for law in seldom:
        law.near = near
    return near


def looked_up_from(scene: Scene, kinematics: Kinematics) -> Scene:
    """Return a scene whose ground is known around the contacts as they are, for use when they have moved on."""
    return replace(scene, looked_up=contact_places(scene, kinematics))


def on_coordinates(mechanism: Mechanism, of_balls: JointForce, force: JointForce) -> JointTerms:
    """Take forces on ball joints and on joints with one coordinate to the coordinates of `v`; the base has none."""
    base = mechanism.robot.layout.base_nv
    tau, slope = ca.vertcat(SX(base, 1), of_balls.tau, force.tau), (SX(base, base), of_balls.slope, force.slope)
    return JointTerms(tau, ca.diagcat(*slope))


def on_bodies(contacts: list[LinearContact], gravity: dict[str, SX], couples: dict[str, SX]) -> dict[str, BodyTerms]:
    """Sum the contacts of each body, and the couple on it."""
    terms = {name: BodyTerms(SX(6, 6), ca.vertcat(couple, SX(3, 1))) for name, couple in couples.items()}
    for contact in contacts:
        new, old = contact.body_terms(gravity[contact.body]), terms.get(contact.body)
        total, near = BodyTerms(old.inertia + new.inertia, old.force + new.force) if old else new, contact.law.near
        none = old or BodyTerms(SX(6, 6), SX(6, 1))
        terms[contact.body] = BodyTerms(where(near, total.inertia, none.inertia), where(near, total.force, none.force))
    return terms


def split(column: SX, sizes: list[int]) -> list[SX]:
    """Split a column into parts of some sizes, and the rest."""
    ends = np.cumsum([0, *sizes]).tolist()
    return [column[start:end] for start, end in pairwise((*ends, column.numel()))]


def stacked(columns: list[SX]) -> SX:
    """Stack columns, perhaps none."""
    return ca.vertcat(SX(0, 1), *columns)
