"""One time step of one robot: all physics on one page.

The step is linearly implicit: stiff forces (contact, friction, joint stops, damping, position control) are taken one
step ahead, which adds to inertias and leaves the recursion unchanged. A step of length 0 gives the acceleration of the
moment.

    start = positions, velocities and memory of the robot
    forces = [law.place(start).linearise(iterate) for law in the scene's laws]      linear in the accelerations
    vdot = CE-ABA(inertias, forces)         the constraint-embedding articulated-body algorithm, or joint_space.py
    state, iterate = integrate(vdot), and the memory and next iterate of each force

Which contacts act, slip or stick, which motors are at their limits and which joints dry friction holds is an active
set. `iteration` makes the step with the set that its iterate assumes, says whether the accelerations confirm that set,
and returns the next iterate. The kernel repeats it for a tile of robots, from the same start, until all of them have
converged, at most `iterations_needed` times. A robot that has converged earlier repeats its result to the bit, so that
it does not depend on its neighbours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import casadi as ca

from ce_gym.dynamics.algebra.integration import advance
from ce_gym.dynamics.algebra.spatial import SX, cross
from ce_gym.dynamics.forces.contact import LinearContact, where
from ce_gym.dynamics.forces.dry_friction import stand_still
from ce_gym.dynamics.forces.linear import JointForce, Motion, is_moment
from ce_gym.dynamics.forces.scene import Scene, contact_places
from ce_gym.dynamics.forces.self_collision import add_pair_forces, solve_pair_forces
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.laws.contacts import with_contacts
from ce_gym.dynamics.laws.law import ForceLaw, LinearForce, Loads, PlacedForce, Start
from ce_gym.dynamics.laws.scene_laws import iterate_size, scene_laws
from ce_gym.dynamics.recursion.ce_aba import (
    Articulation,
    BodyTerms,
    JointTerms,
    gravity_acceleration,
    inward_inertia_pass,
    outward_acceleration_pass,
)
from ce_gym.dynamics.recursion.ce_rnea import outward_acceleration
from ce_gym.dynamics.recursion.derived import guessed_coordinates
from ce_gym.dynamics.recursion.gyroscopic import TurningDamping, steadying_couples
from ce_gym.dynamics.recursion.joint_space import JointSpace, base_acceleration, has_short_branches
from ce_gym.dynamics.recursion.kinematics import Kinematics
from ce_gym.dynamics.state import State
from ce_gym.dynamics.stepping.broad_phase import any_in_range
from ce_gym.dynamics.stepping.conservation import Balance, conserving_velocity
from ce_gym.model.mechanism import Mechanism


@dataclass
class System:
    """The forces on a robot over one step, linear in its accelerations.

    Attributes:
        start: The robot at the start of the step.
        laws: The force laws of the scene.
        forces: The force of each law for the assumed active set.
        loads: Their sums on joints and bodies.
        near: For each culled group 1 if one of its contacts is in range, else 0; empty if all contacts always act.
        pushed: Whether a law other than contacts acts on bodies.
    """

    start: Start
    laws: Sequence[ForceLaw]
    forces: Sequence[LinearForce]
    loads: Loads
    near: Sequence[SX]
    pushed: bool

    @property
    def contacts(self) -> list[LinearContact]:
        """Forces on points of bodies."""
        return [contact for force in self.forces for contact in force.contacts]

    @property
    def touching(self) -> SX:
        """1 if a contact with the ground or between links, or another force on a body, acts, else 0."""
        if self.pushed:
            return SX(1)
        acting = [where(contact.law.near, contact.active) for contact in (*self.contacts, *self.loads.pairs)]
        return ca.sum1(ca.vertcat(*acting)) > 0 if acting else SX(0)

    @property
    def joints(self) -> JointTerms:
        """Forces on the coordinates of `v`; none on the base."""
        base, balls, joints = self.start.scene.mechanism.robot.layout.base_nv, self.loads.balls, self.loads.joints
        slope = ca.diagcat(SX(base, base), balls.slope, joints.slope)
        return JointTerms(ca.vertcat(SX(base, 1), balls.tau, joints.tau), slope)

    def solved(
        self,
        vdot: SX,
        a: dict[str, SX],
        articulation: Articulation | None = None,
        gains: Mapping[LinearContact, SX] | None = None,
    ) -> Solved:
        """Return the system with its acceleration.

        Args:
            vdot: Acceleration, shape (nv,).
            a: Of each body minus gravity, body coordinates, shape (6,) each.
            articulation: Of the recursion that found it, for the loads of rotors and stretches; without it these keep
                their old values.
            gains: Change of the velocity of contacts in the step [m/s], shape (3,) each, where it is known otherwise.
        """
        ydd = vdot[self.start.scene.mechanism.robot.layout.joints_v :]
        return Solved(self, vdot, Motion(ydd, a, self.loads.gravity, articulation, gains or {}))


@dataclass
class Solved:
    """The forces on a robot over one step, and its accelerations.

    Attributes:
        system: The forces.
        vdot: Acceleration, shape (nv,).
        motion: Accelerations of joints and bodies.
    """

    system: System
    vdot: SX
    motion: Motion

    @property
    def kinematics(self) -> Kinematics:
        """Transforms and velocities at the start of the step."""
        return self.system.start.kinematics


@dataclass
class Stepped:
    """A robot after a step.

    Attributes:
        state: At the end of the step.
        solved: Forces and accelerations over the step.
        unconverged: 1 if the accelerations contradict the assumed active set, else 0.
        iterate: For the next iteration; once converged, a fixed point.
        error: Estimate of the error of the step in `v` [rad/s or m/s]; 0 for a method that has none.
        balance: Momentum and energy that the velocities of the state do not have yet, see `conserved`; None if they do.
        uncorrected: State before `finished` corrected it, to which the forces belong; None if it is `state`.
    """

    state: State
    solved: Solved
    unconverged: SX
    iterate: SX
    error: SX
    balance: Balance | None = None
    uncorrected: State | None = None

    @cached_property
    def _sources(self) -> dict[str, LinearForce]:
        system = self.solved.system
        pairs = zip(system.laws, system.forces, strict=True)
        return {output.name: force for law, force in pairs for output in law.outputs}

    def output(self, name: str) -> SX:
        """Return an output of one of the laws; a column of no entries if the scene does not have the law."""
        force = self._sources.get(name)
        return SX(0, 1) if force is None else force.output(name, self.solved.motion, self.uncorrected or self.state)


def linearise(scene: Scene, state: State, target: SX, dt: float, iterate: SX) -> System:
    """Linearise all forces about an iterate.

    Args:
        scene: The robot and its surroundings.
        state: At the start of the step.
        target: Targets or torques in the order of `target_names`, shape (n_targets,).
        dt: Length of the step [s].
        iterate: From the iteration before, the iterates of all laws stacked, shape (iterate_size,).
    """
    start, laws = Start(scene, state, target, dt), scene_laws(scene.mechanism, scene.options)
    placed = [law.place(start) for law in laws]
    near = cull(placed, dt) if scene.culls else []
    parts = split(iterate, [law.size for law in laws])
    forces = [force.linearise(part) for force, part in zip(placed, parts, strict=True)]
    loads = first_loads(start)
    pushed = False
    for force in forces:
        before = dict(loads.bodies)
        force.add_to(loads)
        changed = any(terms is not before.get(name) for name, terms in loads.bodies.items())
        pushed = pushed or (changed and not force.contacts)
    return System(start, laws, forces, loads, near, pushed)


def cull(placed: Sequence[PlacedForce], dt: float) -> list[SX]:
    """Let each culled group act only if one of its contacts is in range, in place; return 1 or 0 for each group."""
    groups = [contacts for force in placed for contacts in force.culled.values()]
    near = [any_in_range([contact.touch for contact in contacts], dt) for contacts in groups]
    for contacts, flag in zip(groups, near, strict=True):
        for contact in contacts:
            contact.near = flag
    return near


def first_loads(start: Start) -> Loads:
    """Return the loads before any force: only the couples that steady the bodies of ball joints."""
    mechanism, n = start.scene.mechanism, start.yd.numel()
    couples = {} if is_moment(start.dt) else steadying_couples(mechanism, start.kinematics, start.dt)
    bodies = {name: BodyTerms(SX(6, 6), ca.vertcat(couple, SX(3, 1))) for name, couple in couples.items()}
    n_balls = 3 * len(mechanism.robot.balls)
    balls = JointForce(SX(n_balls, 1), SX(n_balls, n_balls))
    return Loads(bodies, balls, JointForce(SX(n, 1), SX(n, n)), gravity_acceleration(mechanism))


def solve(scene: Scene, state: State, target: SX, dt: float, iterate: SX) -> Solved:
    """Find the acceleration of one robot over a step; arguments as for `linearise`."""
    return solve_system(linearise(scene, state, target, dt, iterate))


def solve_system(system: System) -> Solved:
    """Find the acceleration of a robot over a step by the algorithm that takes less time."""
    return (solve_in_joint_space if in_joint_space(system) else solve_by_recursion)(system)


def in_joint_space(system: System) -> bool:
    """Whether the equation of motion is solved in joint space: all branches are short, and no force excludes it."""
    scene, implicit = system.start.scene, any(ca.sparsify(t.inertia).nnz() for t in system.loads.bodies.values())
    only_rotors = not system.start.kinematics.bodies
    return scene.joint_space and has_short_branches(scene.mechanism) and not implicit and not only_rotors


def solve_in_joint_space(system: System) -> Solved:
    """Find the acceleration of a robot over a step by elimination in joint space."""
    start, loads, mechanism = system.start, system.loads, system.start.scene.mechanism
    kinematics, dt = start.kinematics, start.dt
    turning = None if is_moment(dt) else TurningDamping(start.state.v, dt)
    space = JointSpace.of(mechanism, kinematics, {name: terms.force for name, terms in loads.bodies.items()})
    touching = [space.jacobian(contact.body, contact.law.touch.point) for contact in loads.contacts]
    culled: dict[int, tuple[SX, list[tuple[SX, SX, SX]]]] = {}
    for contact, J in zip(loads.contacts, touching, strict=True):
        force = J, contact.force, dt * contact.C
        if contact.law.near is None:
            space.add_force(*force)
        else:
            culled.setdefault(id(contact.law.near), (contact.law.near, []))[1].append(force)
    for near, group in culled.values():
        space.add_where(near, group)
    ends = [[end.jacobian(space.jacobian(end.name, end.point)) for end in pair.law.ends] for pair in loads.pairs]
    pressing, forces = [first + second for first, second in ends], SX.sym("forces", len(loads.pairs))
    for i, J in enumerate(pressing):  # the equation is linear in forces of pairs, and is solved for them
        space.add_force(J, forces[i], SX(1, 1))
    articulation = space.eliminate(system.joints, turning)
    if loads.pairs:
        articulation = solve_pair_forces(mechanism, kinematics, articulation, loads.pairs, forces, False)
    x = space.acceleration(articulation)
    gains: dict[LinearContact, SX] = {c: dt * (J @ x) for c, J in zip(loads.contacts, touching, strict=True)}
    gains |= {pair: ca.vertcat(dt * (J @ x), SX(2, 1)) for pair, J in zip(loads.pairs, pressing, strict=True)}
    vdot = base_acceleration(mechanism, kinematics, x)
    a, _ = outward_acceleration(mechanism, kinematics, vdot)
    return system.solved(vdot, a, articulation, gains)


def solve_by_recursion(system: System) -> Solved:
    """Find the acceleration of a robot over a step by CE-ABA."""
    start, loads, mechanism = system.start, system.loads, system.start.scene.mechanism
    kinematics, dt = start.kinematics, start.dt
    turning = None if is_moment(dt) else TurningDamping(start.state.v, dt)
    forces = SX.sym("forces", len(loads.pairs))  # the recursion is linear in them, and is solved for them
    external = with_contacts(loads.bodies, loads.contacts, loads.gravity)
    external = add_pair_forces(external, loads.pairs, forces)
    articulation = inward_inertia_pass(mechanism, kinematics, system.joints, external, turning)
    if loads.pairs:
        articulation = solve_pair_forces(mechanism, kinematics, articulation, loads.pairs, forces)
    vdot, a = outward_acceleration_pass(mechanism, kinematics, articulation)
    return system.solved(vdot, a, articulation)


def iteration(
    scene: Scene, state: State, target: SX, dt: float, iterate: SX, balance: Balance | None = None
) -> Stepped:
    """Make one iteration of a linearly implicit Euler step; arguments as for `linearise` and `finish_step`."""
    return finish_step(solve(scene, state, target, dt, iterate), balance)


def finish_step(solved: Solved, balance: Balance | None = None) -> Stepped:
    """Return a robot after a step whose acceleration is known, up to the velocities that `finished` corrects.

    Args:
        solved: Forces and accelerations over the step.
        balance: Momentum and energy at the start of the step, if known.
    """
    start, forces, motion = solved.system.start, solved.system.forces, solved.motion
    mechanism, kinematics, dt = start.scene.mechanism, start.kinematics, start.dt
    share = moving_share(solved.system)
    q = advance(start.state.q, start.state.v, solved.vdot, dt, mechanism.robot.layout, share)
    v = start.state.v + dt * solved.vdot
    sticks = [stick for force in forces for stick in force.sticks]
    stand_still(mechanism, kinematics, sticks, start.state.q, q, v, dt)  # changes q and v
    memory = {"dependent": guessed_coordinates(kinematics, share * solved.vdot, dt)}
    for force in forces:
        memory |= force.advance(motion)
    unconverged = any_check(forces, motion)
    iterate = stacked([force.next_iterate(motion, unconverged) for force in forces])
    after = start.state.replaced(q=q, v=v, **memory)
    balance = None if is_moment(dt) else balance_after(solved, balance)
    return Stepped(after, solved, unconverged, iterate, error=SX(0), balance=balance)


def moving_share(system: System) -> SX:
    """Return for each velocity the share of its change in a step with which positions move, shape (nv,).

    Free motion moves at the mean velocity of the step, share 1/2, which is accurate to second order. Forces that are
    taken one step ahead need the velocity at the end, share 1: contacts and springs would bounce otherwise. Methods
    that extrapolate Euler steps need the same share at all times.
    """
    slope = ca.diag(system.joints.slope)
    if not METHODS[system.start.scene.options.method].is_euler:
        return SX.ones(slope.numel())
    return ca.if_else(system.touching, 1, ca.if_else(slope == 0, 0.5, 1))


def balance_after(solved: Solved, before: Balance | None) -> Balance:
    """Return the momentum, and the energy if nothing touches the robot, that it must have after a step.

    Args:
        solved: The forces over the step.
        before: What the robot has at the start of the step, if known.
    """
    start, system, vdot = solved.system.start, solved.system, solved.vdot
    mechanism = start.scene.mechanism
    force = system.joints.tau - system.joints.slope @ vdot
    work = start.dt * ca.dot(start.state.v + start.dt / 2 * vdot, force)
    balance = before or Balance.of(mechanism, start.kinematics)
    balance = balance.pushed(mechanism, start.kinematics, external_wrenches(solved), start.dt)
    known = ca.logic_not(system.touching) if METHODS[start.scene.options.method].is_euler else SX(0)
    if not mechanism.robot.floating:  # gravity does work, along the path of joints that move at their mean velocity
        slope = ca.diag(system.joints.slope)[: len(mechanism.robot.commanded) + 3 * len(mechanism.robot.balls)]
        known = ca.logic_and(known, ca.norm_inf(ca.vertcat(SX(0), slope)) == 0)
    return replace(balance, energy=balance.energy + work, touching=ca.logic_not(known))


def external_wrenches(solved: Solved) -> list[tuple[str, SX]]:
    """Return mean wrenches on bodies over a step, gravity left out: body, world wrench about its origin, (6,)."""
    system, motion, bodies = solved.system, solved.motion, solved.kinematics.bodies
    wrenches = []
    for contact in system.contacts:
        force = where(contact.law.near, contact.force_after(contact.gain(motion)))
        arm = contact.law.touch.R @ contact.law.touch.point
        wrenches.append((contact.body, ca.vertcat(cross(arm, force), force)))
    if system.pushed:  # by laws that are no contacts
        start, couples = system.start, {}
        if not is_moment(start.dt):  # between two bodies of the robot
            couples = steadying_couples(start.scene.mechanism, start.kinematics, start.dt)
        for name, terms in system.loads.bodies.items():
            wrench, R = terms.force - terms.inertia @ motion.a[name], bodies[name].R
            moment = wrench[:3] - couples.get(name, SX(3, 1))
            wrenches.append((name, ca.vertcat(R @ moment, R @ wrench[3:])))
    return wrenches


def conserved(mechanism: Mechanism, state: State, balance: Balance) -> State:
    """Return a state with the velocities, and for a single body the orientation, that satisfy a balance."""
    q, v, _ = conserving_velocity(mechanism, state.q, state.v, state.dependent, balance)
    return state.replaced(q=q, v=v)


def finished(stepped: Stepped) -> Stepped:
    """Return a step whose velocities have their momentum and energy."""
    if stepped.balance is None:
        return stepped
    state = conserved(stepped.solved.system.start.scene.mechanism, stepped.state, stepped.balance)
    return replace(stepped, state=state, uncorrected=stepped.state)


def any_check(forces: Sequence[LinearForce], motion: Motion) -> SX:
    """Return 1 if the accelerations contradict the active set that one of the forces assumed, else 0."""
    checks = [check for force in forces if (check := force.check(motion)) is not None]
    return reduce(lambda total, check: ca.logic_or(check, total), checks)


def first_iterate(scene: Scene) -> SX:
    """Return the iterate of a first iteration."""
    return SX(iterate_size(scene.mechanism, scene.options), 1)


def looked_up_from(scene: Scene, kinematics: Kinematics) -> Scene:
    """Return a scene whose ground is known around the present contacts, for use when they have moved on."""
    return replace(scene, looked_up=contact_places(scene, kinematics))


def split(column: SX, sizes: Sequence[int]) -> list[SX]:
    """Split a column into parts of some sizes."""
    ends = [sum(sizes[:i]) for i in range(len(sizes) + 1)]
    return ca.vertsplit(column, ends) if sizes else []


def stacked(columns: Sequence[SX]) -> SX:
    """Stack columns, perhaps none."""
    return ca.vertcat(SX(0, 1), *columns)
