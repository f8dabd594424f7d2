"""A time step as traced functions: state in, state out, a diverged robot frozen where it was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.constraints.closure import closures
from ce_gym.dynamics.forces.scene import Scene, StepOptions, target_names
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.integrators.plan import AFTER, MOVED, OFF, combined, error_estimate, step_errors
from ce_gym.dynamics.laws.drive_meshes import stretching
from ce_gym.dynamics.laws.law import Start
from ce_gym.dynamics.laws.scene_laws import culled_rows, iterate_size, moment_of, scene_laws, symbolic_state
from ce_gym.dynamics.laws.scene_parameters import make_scene, parameter_defaults
from ce_gym.dynamics.recursion.derived import kinetic_and_potential, loop_gap, loop_state
from ce_gym.dynamics.recursion.kinematics import Kinematics, outward_velocity_pass
from ce_gym.dynamics.state import State
from ce_gym.dynamics.stepping.conservation import Balance, balance_size, combined_balance, conserving_velocity
from ce_gym.dynamics.stepping.step import Stepped, finished, iteration, stacked
from ce_gym.dynamics.stepping.unroll import unrolled
from ce_gym.dynamics.stepping.variables import BALANCE, StepVariables
from ce_gym.model.mechanism import Mechanism

LOST_LOOP = 1e-5
"""A robot with a loop whose residual is larger has diverged [m]."""
SINGULAR = 1e-3
"""A robot whose loops are nearer than this to a singularity (see `Model.nearness`) has diverged."""
SANE_SPEED = 1e4
"""A robot any of whose velocities is beyond this, or NaN, has diverged [rad/s or m/s]."""
NEAR, NEAR_ITERATE = "near_", "near_iterate_"
"""Begin the names of the flag of each culled group, and of its part of the iterate; the number of the group follows."""
SANE_DISTANCE = 1e6
"""A robot any of whose positions is beyond this, or NaN, has diverged [rad or m]."""


def step_function(
    mechanism: Mechanism, options: StepOptions, outputs: tuple[str, ...] = (), follows: bool = False
) -> ca.Function:
    """Trace a step.

    Args:
        mechanism: The robot at a transmission level.
        options: The scene.
        outputs: Names among `OUTPUTS`, or `MOVED` or `OFF`; others cost nothing.
        follows: Whether the height of the ground changes with the place of a contact, by the slope of its plane; for
            derivatives on a field. The function then has the input `places`, the centres of the contacts.

    Returns:
        Function (*state, diverged, *given) -> (*state, diverged, *outputs). `state` are the fields of the scene. Inputs
        in `given` are `target` if there are joints, `parameters` if any are declared, `ground` on a field,
        `region_points` on a field with hulls, and `dt` if the options leave it open.
    """
    given, plan = Given(mechanism, options, follows), METHODS[options.method]
    parts = unrolled(plan, given.scene, given.state, given.target, given.dt)
    told = {name: given.output(name, plan.shares(moment_of(name)), parts) for name in outputs}
    return traced("step", given.inputs(), given.guarded(parts[AFTER]) | told)


def iteration_function(
    mechanism: Mechanism,
    options: StepOptions,
    outputs: tuple[str, ...] = (),
    follows: bool = False,
    culls: bool = False,
    conserves: bool = True,
    joint_space: bool = True,
) -> ca.Function:
    """Trace one iteration of an Euler step: repeated on its own iterate until it has converged, it makes the step.

    Args:
        mechanism: The robot at a transmission level.
        options: The scene.
        outputs: See `step_function`.
        follows: See `step_function`.
        culls: Whether each culled group is left out where none of its contacts is in range. The output `NEAR` of the
            group is then 1 if one is in range, else 0, and `NEAR_ITERATE` holds the group's part of the iterate.
        conserves: Whether the velocities have their momentum and energy; if not, the output `BALANCE` is for
            `conserve_function`.
        joint_space: See `Scene`.

    Returns:
        Function (*state, diverged, *given, iterate) -> (*state, diverged, iterate, unconverged, *outputs), see
        `step_function`; the iterate is zero at first, shape (iterate_size,).
    """
    given, size = Given(mechanism, options, follows), iterate_size(mechanism, options)
    groups = culled_rows(mechanism, options) if culls else []
    rows = {f"{NEAR_ITERATE}{i}": group for i, group in enumerate(groups)}
    always = sorted({*range(size)}.difference(*groups))
    rows |= {"iterate": always} if always or not culls else {}
    parts, iterate = {name: SX.sym(name, len(of)) for name, of in rows.items()}, SX(size, 1)
    for name, part in parts.items():
        iterate[rows[name]] = part
    given.scene = replace(given.scene, culls=culls, joint_space=joint_space)
    symbol = SX.sym(BALANCE, 0 if conserves else balance_size(mechanism))
    balance = None if conserves else Balance.from_column(symbol)
    stepped = iteration(given.scene, given.state, given.target, given.dt, iterate, balance)
    end = finished(stepped)
    of_end = {name: end if conserves or name == "energy" else stepped for name in outputs}
    told = {name: given.output(name, {AFTER: 1.0}, {AFTER: part}) for name, part in of_end.items()}
    if conserves:
        stepped = end
    elif stepped.balance is not None:
        told[BALANCE] = stepped.balance.column
        parts[BALANCE] = symbol
    left = {f"{name}_next": stepped.iterate[of] for name, of in rows.items()} | {"unconverged": stepped.unconverged}
    left |= {f"{NEAR}{i}": near for i, near in enumerate(stepped.solved.system.near)}
    return traced("iteration", given.inputs() | parts, given.guarded(stepped) | left | told)


def conserve_function(mechanism: Mechanism, options: StepOptions) -> ca.Function:
    """Trace the velocities after a stage from its momentum and energy; a robot that has diverged keeps its own.

    Returns:
        Function (q, v, dependent, diverged, parameters, dt, balance) -> (v, balance), and `MOVED` if the stage is the
        whole step, and q of a robot without joints.
    """
    given, column = Given(mechanism, options), SX.sym(BALANCE, balance_size(mechanism))
    state, balance = given.state, Balance.from_column(column)
    q, v, balance = conserving_velocity(given.scene.mechanism, state.q, state.v, state.dependent, balance)
    results = {"v_next": ca.if_else(given.diverged, state.v, v), f"{BALANCE}_next": balance.column}
    if q is not state.q:
        results["q_next"] = ca.if_else(given.diverged, state.q, q)
    if METHODS[options.method].single:
        results[MOVED] = furthest(mechanism, results["v_next"], given.dt)
    return traced("conserve", _needed(given.inputs() | {BALANCE: column}, results), results)


def balance_function(mechanism: Mechanism, options: StepOptions) -> ca.Function:
    """Trace the momentum and energy of a state: (q, v, dependent, parameters) -> (balance)."""
    given = Given(mechanism, options)
    kinematics = outward_velocity_pass(given.scene.mechanism, given.state.q, given.state.v, given.state.dependent)
    results = {BALANCE: Balance.of(given.scene.mechanism, kinematics).column}
    return traced(BALANCE, _needed(given.inputs(), results), results)


def combination_function(mechanism: Mechanism, options: StepOptions, step: StepVariables) -> ca.Function:
    """Trace the combination of the stages of a step, for plans with several stages.

    Args:
        mechanism: The robot at a transmission level.
        options: The scene.
        step: Variables of the step.

    Returns:
        Function (*state, diverged, *of the stages) -> (*state, diverged, *outputs), whose inputs have the names of
        their variables. Only variables of the stages that are needed are inputs. A robot that diverges in one of the
        stages keeps its state.
    """
    plan, whole = METHODS[options.method], Given(mechanism, options)
    before = whole.state
    ends = {stage.name: symbolic_state(mechanism, options) for stage in plan.stages}
    flags = {"diverged": SX.sym("diverged")}
    flags |= {step.stages[name]["diverged"].name: SX.sym(name) for name in ends}
    given = dict(before.items()) | flags | {"parameters": whole.parameters}
    for stage, end in ends.items():
        given |= step.stages[stage].named(dict(end.items()))
    layout = mechanism.robot.layout
    columns = {stage: step.stages[stage][BALANCE].symbol() for stage in ends}
    given |= {step.stages[stage][BALANCE].name: column for stage, column in columns.items()}
    balance = combined_balance(plan, {stage: Balance.from_column(column) for stage, column in columns.items()})
    after = combined(plan, ends, layout)
    q, v, balance = conserving_velocity(whole.scene.mechanism, after.q, after.v, after.dependent, balance)
    after = after.replaced(q=q, v=v)
    sane = ca.logic_and(ca.sumsqr(after.v) < SANE_SPEED**2, ca.sum1(stacked(list(flags.values()))) < 0.5)
    results = {name: ca.if_else(sane, after[name], value) for name, value in before.items()}
    results |= {"diverged": ca.if_else(sane, 0, 1), BALANCE: balance.column}
    for name in step.tried:
        if name in results:
            continue
        if name == MOVED:
            given["dt"] = SX.sym("dt")
            results[name] = furthest(mechanism, after.v, given["dt"])
            continue
        if name in ("error", OFF):
            results[name] = error_estimate(plan, ends) if name == "error" else step_errors(plan, before, ends, layout)
            continue
        told = {stage: step.stages[stage][name].symbol() for stage in plan.shares(moment_of(name))}
        given |= {step.stages[stage][name].name: value for stage, value in told.items()}
        results[name] = weighted(plan.shares(moment_of(name)), told)
    return traced("combination", _needed(given, results), results)


def _needed(given: dict[str, SX], results: dict[str, SX]) -> dict[str, SX]:
    """Return those symbols that results depend on."""
    everything = ca.veccat(*results.values())
    return {name: value for name, value in given.items() if ca.depends_on(everything, value)}


class Given:
    """Symbols of one robot before a step, and expressions for its state after the step."""

    def __init__(self, mechanism: Mechanism, options: StepOptions, follows: bool = False) -> None:
        robot, n = mechanism.robot, len(options.touches)
        self.mechanism = mechanism
        self.state, self.diverged = symbolic_state(mechanism, options), SX.sym("diverged")
        self.target = SX.sym("target", len(target_names(mechanism, options.control)))
        defaults = parameter_defaults(robot, options.material, options.parameters)
        self.parameters = SX.sym("parameters", sum(len(default) for default in defaults.values()))
        self.ground = SX.sym("ground", 3, n if options.ground == "field" else 0)
        self.dt: float = SX.sym("dt") if options.dt is None else options.dt  # type: ignore[assignment]  # used as one
        self.region_points = SX.sym("region_points", 3, n - len(options.contacts))
        self.scene = replace(
            make_scene(mechanism, options, self.parameters, self.ground), region_points=self.region_points
        )
        self.places = SX.sym("places", 2, n if follows and options.ground == "field" else 0)
        if self.places.numel():
            self.scene = replace(self.scene, looked_up=self.places)

    def inputs(self) -> dict[str, SX]:
        """Return the symbols by name, without empty ones."""
        given = {"target": self.target, "parameters": self.parameters, "ground": ca.vec(self.ground)}
        given |= {"region_points": ca.vec(self.region_points), "places": ca.vec(self.places)}
        given = {name: value for name, value in given.items() if value.numel()}
        given |= {"dt": self.dt} if isinstance(self.dt, SX) else {}
        return dict(self.state.items()) | {"diverged": self.diverged} | given

    def guarded(self, stepped: Stepped) -> dict[str, SX]:
        """State after the step, or as it was if the robot has diverged now or before."""
        after = stepped.state
        size = ca.sumsqr(ca.vertcat(after.v, after["anchor"]))
        sane = ca.logic_and(size < SANE_SPEED**2, self.diverged < 0.5)  # false for NaN
        sane = ca.logic_and(sane, ca.sumsqr(after.q) < SANE_DISTANCE**2)  # not all positions act on velocities
        if any(closures(self.mechanism)):
            sane = ca.logic_and(sane, loops_close(self.mechanism, stepped.solved.kinematics, after))
        results = {f"{name}_next": ca.if_else(sane, after[name], value) for name, value in self.state.items()}
        return results | {"diverged_next": ca.if_else(sane, 0, 1)}

    def output(self, name: str, shares: Mapping[str, float], parts: Mapping[str, Stepped]) -> SX:
        """Return an output, combined from parts of a step."""
        if name == "error":
            return parts[AFTER].error
        if name == OFF:
            plan = METHODS[self.scene.options.method]
            ends = {stage.name: parts[stage.name].state for stage in plan.stages}
            return step_errors(plan, self.state, ends, self.mechanism.robot.layout)
        return ca.vec(weighted(shares, {part: self._of(parts[part], name) for part in shares}))

    def _of(self, stepped: Stepped, name: str) -> SX:
        if name == MOVED:
            return furthest(self.mechanism, stepped.state.v, self.dt)
        if name == "energy":
            return mechanical_energy(self.scene, stepped.state, self.target)
        if name == "loop_gap":
            return loop_gap(self.mechanism, stepped.solved.kinematics)
        if name == "nearness":
            return loop_state(stepped.solved.kinematics)[1]
        return stepped.output(name)


def weighted(weights: Mapping[str, float], values: Mapping[str, SX]) -> SX:
    """Return a weighted sum of values by name."""
    if len(set(weights.values())) == 1:
        return next(iter(weights.values())) * sum((values[name] for name in weights), SX(0))
    return sum((weight * values[name] for name, weight in weights.items()), SX(0))


def mechanical_energy(scene: Scene, state: State, target: SX) -> SX:
    """Return the kinetic and potential energy of the robot, and the energies of all force laws [J].

    Without motors nothing in the scene can give energy to the robot, so this sum must not grow.

    Args:
        scene: The robot and its surroundings.
        state: Of the robot.
        target: Targets or torques in the order of `target_names`, shape (n_targets,).
    """
    start = Start(scene, state, target, 0.0)
    total = sum(kinetic_and_potential(scene.mechanism, state.q, state.v, state.dependent), SX(0))
    return sum((law.energy(start) for law in scene_laws(scene.mechanism, scene.options)), total)


def furthest(mechanism: Mechanism, v: SX, dt: SX | float) -> SX:
    """Return how far the fastest joint moves in a step at velocities (nv,) [rad or m].

    Stretches of transmissions, the last ones, do not count: they move no body, so that nothing turns further than a
    step can follow, and the equations of motion do not change with them.
    """
    joints = v[mechanism.robot.layout.base_nv : v.numel() - len(stretching(mechanism))]
    return dt * ca.norm_inf(ca.vertcat(joints, 0))


def loops_close(mechanism: Mechanism, before: Kinematics, after: State) -> SX:
    """Return 1 if all closed loops can be assembled at the end of a step, away from singularities; else 0.

    A singularity where branches meet could be stepped over; being halfway to it within one step counts as being there.
    """
    still = SX(*after.v.shape)
    gap, nearness = loop_state(outward_velocity_pass(mechanism, after.q, still, after.dependent))
    away = ca.logic_and(nearness > SINGULAR, nearness > loop_state(before)[1] / 2)
    return ca.logic_and(gap < LOST_LOOP, away)
