"""Scalar operations of an environment's step, feature by feature: `inspect ENVIRONMENT`.

A sub-step is traced repeatedly, each time with one more feature. A feature costs the instructions that its function
adds to the one before, so all features sum to the sub-step. An instruction is one scalar operation of a CasADi
function for one robot.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import casadi as ca
import gymnasium

from ce_gym.compile import Call, Repeat, calls_of
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.forces.friction import FRICTION
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.laws.scene_laws import symbolic_state
from ce_gym.dynamics.laws.scene_parameters import make_scene
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.recursion.joint_space import LONGEST_BRANCH
from ce_gym.dynamics.stepping.step import first_iterate, in_joint_space, linearise, solve
from ce_gym.dynamics.stepping.trace import Given
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.runtime.setup import make_program
from ce_gym.envs.task.tasks import Task
from ce_gym.envs.terms.registry import OWN
from ce_gym.model.description import Robot
from ce_gym.model.mechanism import LEVELS
from ce_gym.model.table import table_text
from ce_gym.sim.scene import select_contacts
from ce_gym.sim.substeps import substeps

TERMS = {
    "terminations": "termination",
    "metrics": "metric",
    "rewards": "reward",
    "observations": "observation",
    "critic": "observation",
}
"""Fields of a `Task` that list terms, in the order in which they are added, and the kind of each."""
NO_TERMS: dict[str, Any] = {"rewards": {}, "noise": {}, "history": 1} | {f: () for f in TERMS if f != "rewards"}
"""Fields of a `Task` without terms."""
BARE: dict[str, Any] = {
    "control": "torque",
    "contacts": (),
    "self_collisions": (),
    "ground": "flat",
    "motors": "ideal",
    "method": "euler",
    "parameters": (),
    "control_period": 0.0,
}
"""Options of the smallest scene."""
OPTION_NAMES = {
    "contacts": "contact",
    "self_collisions": "pairs of links, where they are near",
    "ground": "ground field",
    "motors": "limited motors",
    "method": "method",
    "parameters": "parameters",
    "control_period": "sampled control",
}
"""Options of a scene in the order in which they are added, and their names in the report."""
CONDITIONAL = {"iteration": "another iteration of a sub-step", "subdivide": "a sub-step in parts"}
"""Functions of a sub-step that run only if some robot of a tile needs them, and their names in the report."""
NOT_TRACED = ("autoreset_mode", "dtype", "max_episode_steps", "num_threads", "obs_mode", "width", "height")
"""Arguments of environments that do not change a task's program."""


@dataclass(frozen=True)
class SubStep:
    """A traced sub-step.

    Attributes:
        model: The robot at a transmission level.
        options: The scene.
        outputs: Computed values other than the state.
    """

    model: Model
    options: StepOptions
    outputs: tuple[str, ...]

    @cached_property
    def calls(self) -> list[Call]:
        """The calls that the kernel of this sub-step repeats."""
        _, _, steps = substeps(self.model.mechanism, self.options, self.outputs)
        repeated = [step for step in steps if isinstance(step, Repeat)]
        return [call for call in calls_of(repeated) if isinstance(call, Call)]

    @property
    def instructions(self) -> int:
        """Instructions that always run."""
        return sum(call.function.n_instructions() for call in self.calls if not call.only_if)


@dataclass(frozen=True)
class Item:
    """One line of a report.

    Attributes:
        group: Part of the step to which the item belongs.
        name: Name of the feature or term.
        instructions: Instructions that the item adds, for one robot.
    """

    group: str
    name: str
    instructions: int


@dataclass(frozen=True)
class SceneReport:
    """Instructions of an environment's step.

    Attributes:
        name: Id of the environment.
        program: The task on the robot.
        solver: Algorithm that finds the accelerations.
        layers: Features of a sub-step, in the order in which they are added; they sum to the sub-step.
        once: Action, bookkeeping and terms, which run once in each environment step, in the order of addition.
        sometimes: Functions that run only if some robot of a tile needs them: another iteration, a reset.
        unused: Names of options and terms that the environment does not use, by field.
    """

    name: str
    program: TaskProgram
    solver: str
    layers: tuple[Item, ...]
    once: tuple[Item, ...]
    sometimes: tuple[Item, ...]
    unused: Mapping[str, list[str]]

    @property
    def groups(self) -> dict[str, int]:
        """Instructions of each group of `once`."""
        sums: dict[str, int] = {}
        for item in self.once:
            sums[item.group] = sums.get(item.group, 0) + item.instructions
        return sums

    @property
    def sub_step(self) -> int:
        """Instructions of a sub-step."""
        return sum(item.instructions for item in self.layers)

    @property
    def env_step(self) -> int:
        """Instructions of an environment step."""
        return self.program.task.n_substeps * self.sub_step + sum(item.instructions for item in self.once)


def scene_report(env_id: str, **arguments: Any) -> str:
    """Return the scalar operations of an environment's step, feature by feature, as plain text.

    Args:
        env_id: Id of a registered environment.
        **arguments: Further arguments of `gymnasium.make`, such as `motors="limited"`.

    Raises:
        ValueError: If the id is not one of this package's, or an argument is wrong.
    """
    return as_text(count_instructions(env_id, **arguments))


def count_instructions(env_id: str, **arguments: Any) -> SceneReport:
    """Count the instructions of a registered environment; see `scene_report`."""
    spec = gymnasium.registry.get(env_id)
    if spec is None:
        raise ValueError(f"environment {env_id!r} is not registered; `python -m ce_gym list` shows the known ids")
    kwargs = {**spec.kwargs, **arguments}
    if not {"robot", "task"} <= kwargs.keys():
        raise ValueError(f"environment {env_id!r}: made with {', '.join(kwargs) or 'nothing'}; expected robot and task")
    program = make_program(**{name: value for name, value in kwargs.items() if name not in NOT_TRACED})
    outputs = ("torque", "contact_forces") if program.contact_forces else ("torque",)
    sub_step = SubStep(program.model, program.options, outputs)
    conditional = dict.fromkeys(call.function for call in sub_step.calls if call.only_if and call.inputs)
    sometimes = [(CONDITIONAL[f.name()], f) for f in conditional] + [("reset", program.function("reset"))]
    return SceneReport(
        name=env_id,
        program=program,
        solver=solver_of(program),
        layers=tuple(_layer_items(sub_step)),
        once=tuple(_once(program)),
        sometimes=tuple(Item("where needed", name, f.n_instructions()) for name, f in sometimes),
        unused=unused(program),
    )


def solver_of(program: TaskProgram) -> str:
    """Return the name of the algorithm that finds the accelerations in a scene."""
    given = Given(program.model.mechanism, program.options)
    system = linearise(given.scene, given.state, given.target, given.dt, first_iterate(given.scene))
    short = f"elimination in joint space (at most {LONGEST_BRANCH} coordinates in a branch, with the base)"
    return short if in_joint_space(system) else "CE-ABA"


def layers(whole: SubStep) -> Iterator[tuple[str, int]]:
    """Build up a sub-step, one feature after the other.

    Yields:
        Name of the feature, and instructions with the feature and all before.
    """
    robot = whole.model.robot
    no_stops = _with_joints(robot, position=(-math.inf, math.inf))
    no_losses = _with_joints(no_stops, torque=math.inf, damping=0.0, friction=0.0)
    step = SubStep(Model(no_losses, "none"), replace(whole.options, **BARE), ())
    kinematics, acceleration = _dynamics_functions(step)
    # the results of the kinematics are no results of the whole sub-step, so storing them does not count
    yield "kinematics", kinematics.n_instructions() - kinematics.nnz_out()
    yield "inertias and accelerations", acceleration.n_instructions()
    yield "integration and checks", step.instructions
    step = replace(step, options=replace(step.options, control=whole.options.control))
    if whole.options.control != "torque":
        yield f"{whole.options.control} control", step.instructions
    yield "joint friction and torque limits", replace(step, model=Model(no_stops, "none")).instructions
    yield "joint stops", replace(step, model=Model(robot, "none")).instructions
    step = replace(step, model=whole.model)
    if whole.model.transmission != "none":
        yield "rotors", step.instructions
    for field, name in OPTION_NAMES.items():
        value = getattr(whole.options, field)
        if value != BARE[field]:
            step = replace(step, options=replace(step.options, **{field: value}))
            yield name, step.instructions
    if whole.outputs:
        yield "outputs", whole.instructions


def unused(program: TaskProgram) -> dict[str, list[str]]:
    """Return the names of options and terms that an environment does not use, by field."""
    options, robot, task = program.options, program.model.robot, program.task
    groups = dict.fromkeys(contact.group for contact in robot.contacts)
    limited = robot.motors and options.motors != "limited"
    names = {
        "transmission": [level for level in LEVELS if level != program.model.transmission],
        "contacts": [group for group in groups if not {*select_contacts(robot, group)} <= {*options.contacts}],
        "friction": [law for law in FRICTION if law != options.friction],
        "method": [method for method in METHODS if method != options.method],
        "motors": ["limited"] if limited else [],
        "terrain": [] if options.ground == "field" else ["field"],
    }
    terms = {field: OWN[kind] for field, kind in TERMS.items() if field != "critic"}
    names |= {field: [term for term in known if term not in getattr(task, field)] for field, known in terms.items()}
    return {field: listed for field, listed in names.items() if listed}


def as_text(report: SceneReport) -> str:
    """Return a report as plain text."""
    task, model = report.program.task, report.program.model
    n, layer_rows = task.n_substeps, [(item.name, item.instructions) for item in report.layers]
    step_rows = [("action", report.groups["action"]), (f"{n} sub-steps", n * report.sub_step)]
    for group, instructions in list(report.groups.items())[1:]:
        terms = [item for item in report.once if item.group == group != item.name]
        step_rows += [(group, instructions), *((f"  {item.name}", item.instructions) for item in terms)]
    columns = ("", "instructions")
    return "\n".join(
        [
            f"{report.name}: {model.robot.name}, transmission {model.transmission}, "
            f"{n} sub-steps of {1e3 * task.dt:g} ms in a step",
            "Instructions are scalar operations of the traced functions, for one robot.",
            "A line has the instructions that it adds to the lines above.",
            f"Accelerations are solved by {report.solver}.",
            "",
            "A sub-step",
            table_text(columns, [*layer_rows, ("sub-step", report.sub_step)]),
            "",
            "An environment step",
            table_text(columns, [*step_rows, ("environment step", report.env_step)]),
            "",
            "Only for tiles with a robot that needs it",
            table_text(columns, [(item.name, item.instructions) for item in report.sometimes]),
            "",
            "Not used",
            *(
                textwrap.fill(f"  {field}: {', '.join(names)}", 120, subsequent_indent="    ")
                for field, names in report.unused.items()
            ),
        ]
    )


def _layer_items(whole: SubStep) -> Iterator[Item]:
    previous = 0
    for name, total in layers(whole):
        yield Item("sub-step", name, total - previous)
        previous = total


def _with_joints(robot: Robot, **changes: Any) -> Robot:
    """Return the robot with the same changes to all joints."""
    bodies = (replace(b, joint=replace(b.joint, **changes)) if b.joint.type != "free" else b for b in robot.bodies)
    return replace(robot, bodies=tuple(bodies))


def _dynamics_functions(step: SubStep) -> tuple[ca.Function, ca.Function]:
    """Trace the kinematics, with all results that the recursions use, and the accelerations."""
    mechanism, options = step.model.mechanism, step.options
    state, dt = symbolic_state(mechanism, options), cast(Any, SX.sym("dt"))
    target = SX.sym("target", len(mechanism.robot.commanded))
    scene = make_scene(mechanism, options, SX(0, 1), SX(3, 0))
    solved = solve(scene, state, target, dt, first_iterate(scene))
    values = [x for body in solved.kinematics.bodies.values() for x in (body.X.E, body.X.p, body.c, body.v[:3])]
    values += [x for c in solved.kinematics.coordinates if c is not None for x in (c.G, c.g)]
    results = {f"x{i}": ca.vec(x) for i, x in enumerate(values)}
    inputs = dict(state.items()) | {"dt": dt} | ({"target": target} if target.numel() else {})
    return traced("kinematics", inputs, results), traced("acceleration", inputs, {"vdot": solved.vdot})


def _once(program: TaskProgram) -> Iterator[Item]:
    """Build up the calls of an environment step around its sub-steps, one term after the other."""
    yield Item("action", "action", program.function("act").n_instructions())
    if late := _late_actions(program):
        yield Item("late actions", "late actions", late)
    task = replace(program.task, **NO_TERMS)
    total = _evaluate_instructions(program, task)
    yield Item("commands and clocks", "commands and clocks", total)
    for field in TERMS:
        for term in getattr(program.task, field):
            task = _with_term(task, field, term, program.task)
            previous, total = total, _evaluate_instructions(program, task)
            yield Item(field, term, total - previous)
    whole = program.function("evaluate").n_instructions()
    if whole != total:
        yield Item("noise and history", "noise and history", whole - total)


def _evaluate_instructions(program: TaskProgram, task: Task) -> int:
    return TaskProgram(program.model, task).function("evaluate").n_instructions()


def _late_actions(program: TaskProgram) -> int:
    """Return the instructions that choose, in each sub-step, between the last action and the new one."""
    if "delay" not in program.schema:
        return 0
    each, last = (
        sum(call.function.n_instructions() for call in calls_of((step,)) if isinstance(call, Call))
        for step in program.actions.delayed((Repeat("n_substeps", ()),))
    )
    return program.task.n_substeps * each + last


def _with_term(task: Task, field: str, term: str, source: Task) -> Task:
    """Return the task with one more term, with weight and parameters of the source."""
    terms, all_terms = getattr(task, field), getattr(source, field)
    parameters = all_terms[term] if isinstance(all_terms, Mapping) else {}
    if not isinstance(terms, Mapping):
        terms = {name: {} for name in terms}
    return replace(task, **{field: {**terms, term: parameters}})
