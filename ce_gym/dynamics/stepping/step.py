"""One time step of one robot: all physics on one page.

The step is linearly implicit: stiff forces (contact, friction, joint stops, damping, position control) are taken one
step ahead, which adds to inertias and leaves the recursion unchanged. A step of length 0 gives the acceleration of the
moment.

    start = positions, velocities and memory of the robot
    forces = [law.place(start).linearise(iterate) for law in the scene's laws]      linear in the accelerations
    vdot = CE-ABA(inertias, forces)         the constraint-embedding articulated-body algorithm
    state, iterate = integrate(vdot), and the memory and next iterate of each force

Which contacts act, slip or stick, which motors are at their limits and which joints dry friction holds is an active
set. `iteration` makes the step with the set that its iterate assumes, says whether the accelerations confirm that set,
and returns the next iterate. The kernel repeats it for a tile of robots, from the same start, until all of them have
converged, at most `iterations_needed` times. A robot that has converged earlier repeats its result to the bit, so that
it does not depend on its neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import casadi as ca

from ce_gym.dynamics.algebra.integration import advance
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.contact import LinearContact
from ce_gym.dynamics.forces.dry_friction import stand_still
from ce_gym.dynamics.forces.linear import JointForce, Motion, is_moment
from ce_gym.dynamics.forces.scene import Scene, contact_places
from ce_gym.dynamics.forces.self_collision import add_pair_forces, solve_pair_forces
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
from ce_gym.dynamics.recursion.derived import guessed_coordinates
from ce_gym.dynamics.recursion.gyroscopic import TurningDamping, steadying_couples, turning_momentum
from ce_gym.dynamics.recursion.kinematics import Kinematics
from ce_gym.dynamics.state import State
from ce_gym.dynamics.stepping.broad_phase import any_in_range


@dataclass
class System:
    """The forces on a robot over one step, linear in its accelerations.

    Attributes:
        start: The robot at the start of the step.
        laws: The force laws of the scene.
        forces: The force of each law for the assumed active set.
        loads: Their sums on joints and bodies.
        near: 1 if a contact that is seldom near is in range, else 0; None if all contacts always act.
    """

    start: Start
    laws: Sequence[ForceLaw]
    forces: Sequence[LinearForce]
    loads: Loads
    near: SX | None

    @property
    def contacts(self) -> list[LinearContact]:
        """Forces on points of bodies."""
        return [contact for force in self.forces for contact in force.contacts]

    @property
    def joints(self) -> JointTerms:
        """Forces on the coordinates of `v`; none on the base."""
        base, balls, joints = self.start.scene.mechanism.robot.layout.base_nv, self.loads.balls, self.loads.joints
        slope = ca.diagcat(SX(base, base), balls.slope, joints.slope)
        return JointTerms(ca.vertcat(SX(base, 1), balls.tau, joints.tau), slope)

    def solved(self, vdot: SX, a: dict[str, SX], articulation: Articulation | None = None) -> Solved:
        """Return the system with its acceleration.

        Args:
            vdot: Acceleration, shape (nv,).
            a: Of each body minus gravity, body coordinates, shape (6,) each.
            articulation: Of the recursion that found it, for the loads of rotors and stretches; without it these keep
                their old values.
        """
        ydd = vdot[self.start.scene.mechanism.robot.layout.joints_v :]
        return Solved(self, vdot, Motion(ydd, a, self.loads.gravity, articulation))


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
    """

    state: State
    solved: Solved
    unconverged: SX
    iterate: SX
    error: SX

    @cached_property
    def _sources(self) -> dict[str, LinearForce]:
        system = self.solved.system
        pairs = zip(system.laws, system.forces, strict=True)
        return {output.name: force for law, force in pairs for output in law.outputs}

    def output(self, name: str) -> SX:
        """Return an output of one of the laws; a column of no entries if the scene does not have the law."""
        force = self._sources.get(name)
        return SX(0, 1) if force is None else force.output(name, self.solved.motion, self.state)


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
    near = cull(placed, dt) if scene.choosing else None
    parts = split(iterate, [law.size for law in laws])
    forces = [force.linearise(part) for force, part in zip(placed, parts, strict=True)]
    loads = first_loads(start)
    for force in forces:
        force.add_to(loads)
    return System(start, laws, forces, loads, near)


def cull(placed: Sequence[PlacedForce], dt: float) -> SX:
    """Let contacts that are seldom near act only if one of them is in range, in place; return 1 if one is, else 0."""
    seldom = [contact for force in placed for contact in force.culled]
    near = any_in_range([contact.touch for contact in seldom], dt)
    for contact in seldom:
        contact.near = near
    return near


def first_loads(start: Start) -> Loads:
    """Return the loads before any force: only the couples that steady the bodies of ball joints."""
    mechanism, n = start.scene.mechanism, start.yd.numel()
    couples = {} if is_moment(start.dt) else steadying_couples(mechanism, start.kinematics, start.dt)
    bodies = {name: BodyTerms(SX(6, 6), ca.vertcat(couple, SX(3, 1))) for name, couple in couples.items()}
    bodies_in_world = start.kinematics.bodies
    gravity = {name: bodies_in_world[name].R.T @ gravity_acceleration(mechanism) for name in mechanism.bodies}
    n_balls = 3 * len(mechanism.robot.balls)
    balls = JointForce(SX(n_balls, 1), SX(n_balls, n_balls))
    return Loads(bodies, balls, JointForce(SX(n, 1), SX(n, n)), gravity)


def solve(scene: Scene, state: State, target: SX, dt: float, iterate: SX) -> Solved:
    """Find the acceleration of one robot over a step by CE-ABA; arguments as for `linearise`."""
    system, mechanism = linearise(scene, state, target, dt, iterate), scene.mechanism
    kinematics, loads = system.start.kinematics, system.loads
    # implicit parts of the gyroscopic torque of the base, and of the Coriolis forces of its joints
    momentum = None if is_moment(dt) else turning_momentum(mechanism, state.v, dt)
    turning = None if is_moment(dt) else TurningDamping(state.v, dt)
    forces = SX.sym("forces", len(loads.pairs))  # the recursion is linear in them, and is solved for them
    external = add_pair_forces(loads.bodies, loads.pairs, forces)
    articulation = inward_inertia_pass(mechanism, kinematics, system.joints, external, turning)
    if loads.pairs:
        vdot, a = solve_pair_forces(mechanism, kinematics, articulation, momentum, loads.pairs, forces)
    else:
        vdot, a = outward_acceleration_pass(mechanism, kinematics, articulation, momentum)
    return system.solved(vdot, a, articulation)


def iteration(scene: Scene, state: State, target: SX, dt: float, iterate: SX) -> Stepped:
    """Make one iteration of a linearly implicit Euler step; arguments as for `linearise`."""
    return finish_step(solve(scene, state, target, dt, iterate))


def finish_step(solved: Solved) -> Stepped:
    """Return a robot after a step whose acceleration is known."""
    start, forces, motion = solved.system.start, solved.system.forces, solved.motion
    mechanism, kinematics, dt = start.scene.mechanism, start.kinematics, start.dt
    q, v = advance(start.state.q, start.state.v, solved.vdot, dt, mechanism.robot.layout)
    sticks = [stick for force in forces for stick in force.sticks]
    stand_still(mechanism, kinematics, sticks, start.state.q, q, v, dt)  # changes q and v
    memory = {"dependent": guessed_coordinates(kinematics, solved.vdot, dt)}
    for force in forces:
        memory |= force.advance(motion)
    unconverged = any_check(forces, motion)
    iterate = stacked([force.next_iterate(motion, unconverged) for force in forces])
    return Stepped(start.state.replaced(q=q, v=v, **memory), solved, unconverged, iterate, error=SX(0))


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
