"""What a scene costs, feature by feature: what is compiled into an environment, and what has been left out.

Everything is a difference of traced functions. A sub-step is built up in layers, each with one feature more; a layer
costs what its function takes beyond the one before, so that the layers add up to the whole. A feature that is left out
would cost what the whole takes with it beyond what it takes without. An instruction is one scalar operation of a CasADi
function for one robot.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import casadi as ca
import gymnasium

from ce_gym.compile import Call, Repeat, calls_of
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.constraints.closure import closures
from ce_gym.dynamics.forces.friction import FRICTION
from ce_gym.dynamics.forces.normal import KelvinVoigt, normal_law
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.laws.scene_laws import OUTPUTS, PARAMETERS, symbolic_state
from ce_gym.dynamics.laws.scene_parameters import make_scene
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.stepping.step import first_iterate, solve
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.runtime.setup import make_program
from ce_gym.envs.task.tasks import Task
from ce_gym.envs.terms.registry import OWN
from ce_gym.model.description import Robot
from ce_gym.model.mechanism import LEVELS
from ce_gym.sim.kernels import select_contacts
from ce_gym.sim.substeps import substeps

TERMS = {
    "terminations": "termination",
    "metrics": "metric",
    "rewards": "reward",
    "observations": "observation",
    "critic": "observation",
}
"""Fields of a `Task` that name terms, in the order in which they are added, and the kind of each."""

AGAIN = {"iteration": "another iteration of a sub-step", "subdivide": "a sub-step in parts"}
"""What is done in a sub-step only if some robot of a tile needs it, by name of the function."""

NO_TERMS: dict[str, Any] = {"rewards": {}, "noise": {}, "history": 1} | {f: () for f in TERMS if f != "rewards"}
"""What makes a task one without terms."""


WITHOUT_COST = ("autoreset_mode", "dtype", "max_episode_steps", "num_threads", "obs_mode", "width", "height")
"""Arguments of environments that a task's program does not depend on."""


@dataclass(frozen=True)
class SubStep:
    """A sub-step that could be compiled.

    Attributes:
        model: The robot at a transmission level.
        options: The scene.
        outputs: What is computed besides the state.
    """

    model: Model
    options: StepOptions
    outputs: tuple[str, ...]

    @cached_property
    def calls(self) -> list[Call]:
        """The calls that the kernel of this sub-step repeats."""
        _, _, steps = substeps(self.model.mechanism, self.options, self.outputs)
        return [call for call in calls_of(steps) if isinstance(call, Call)]

    @property
    def instructions(self) -> int:
        """Instructions that are always carried out."""
        return sum(call.function.n_instructions() for call in self.calls if not call.only_if)


@dataclass(frozen=True)
class Item:
    """One line of a report.

    Attributes:
        group: What it is part of.
        name: For people.
        instructions: That it adds, for one robot.
        compiled: The sub-step or function with it, and with all before it in a sequence; None if it is not timed.
    """

    group: str
    name: str
    instructions: int
    compiled: SubStep | ca.Function | None


@dataclass(frozen=True)
class SceneReport:
    """What an environment costs.

    Attributes:
        name: Id of the environment.
        program: The task on the robot.
        layers: Of a sub-step, in the order in which they are added; they sum to the sub-step.
        once: What is done once in each environment step: the action; then, in the order in which they are added,
            bookkeeping and the terms of the task.
        sometimes: What is done only if some robot of a tile needs it: another iteration, a reset.
        left_out: What each feature would add to a sub-step; less than 0 if it would save.
        terms_left_out: What each term would add to an environment step.
    """

    name: str
    program: TaskProgram
    layers: tuple[Item, ...]
    once: tuple[Item, ...]
    sometimes: tuple[Item, ...]
    left_out: tuple[Item, ...]
    terms_left_out: tuple[Item, ...]

    @property
    def groups(self) -> tuple[Item, ...]:
        """What is done once in each environment step, terms of a kind taken together."""
        together = itertools.groupby(self.once, lambda item: item.group)
        return tuple(
            Item(group, group, sum(item.instructions for item in items), items[-1].compiled)
            for group, items in ((group, list(items)) for group, items in together)
        )

    @property
    def sub_step(self) -> int:
        """Instructions of a sub-step."""
        return sum(item.instructions for item in self.layers)

    @property
    def env_step(self) -> int:
        """Instructions of an environment step."""
        return self.program.task.n_substeps * self.sub_step + sum(item.instructions for item in self.once)


def report_scene(env_id: str, **arguments: Any) -> SceneReport:
    """Count what a registered environment costs.

    Args:
        env_id: Its id.
        **arguments: What `gymnasium.make` would be given besides, see `ce_gym.envs.runtime.setup.make_program`.

    Raises:
        ValueError: If the id is no registered environment of robots of ours, or an argument is wrong.
    """
    spec = gymnasium.registry.get(env_id)
    if spec is None:
        raise ValueError(f"environment {env_id!r} is not registered; `python -m ce_gym list` shows those that are")
    given = {**spec.kwargs, **arguments}
    if not {"robot", "task"} <= given.keys():
        raise ValueError(f"environment {env_id!r}: made with {', '.join(given) or 'nothing'}; expected robot and task")
    program = make_program(**{name: value for name, value in given.items() if name not in WITHOUT_COST})
    outputs = ("torque", "contact_forces") if program.contact_forces else ("torque",)
    whole = SubStep(program.model, program.options, outputs)
    again = dict.fromkeys(call.function for call in whole.calls if call.only_if and call.inputs)
    sometimes = [(AGAIN[f.name()], f) for f in again] + [("reset", program.function("reset"))]
    return SceneReport(
        name=env_id,
        program=program,
        layers=tuple(_differences("sub-step", layers(whole))),
        once=tuple(_once(program)),
        sometimes=tuple(Item("where needed", name, f.n_instructions(), f) for name, f in sometimes),
        left_out=tuple(
            Item("left out", name, step.instructions - whole.instructions, step) for name, step in left_out(whole)
        ),
        terms_left_out=tuple(_terms_left_out(program)),
    )


def layers(whole: SubStep) -> Iterator[tuple[str, int, SubStep | ca.Function]]:
    """Build a sub-step up, one feature after the other.

    Yields:
        Name of the feature, instructions with it and with all before it, and what to compile.
    """
    options, robot = whole.options, whole.model.robot
    loose = _with_joints(robot, position=(-math.inf, math.inf))
    nothing: dict[str, Any] = {"contacts": (), "seldom": (), "self_collisions": (), "parameters": ()}
    bare = replace(
        options, control="torque", control_period=0.0, motors="ideal", ground="flat", method="euler", **nothing
    )
    step = SubStep(Model(_with_joints(loose, torque=math.inf, damping=0.0, friction=0.0), "none"), bare, ())
    kinematics, acceleration = _parts_of_dynamics(step)
    # the results of the first are not results of the whole, so that writing them does not count
    yield "kinematics", kinematics.n_instructions() - kinematics.nnz_out(), kinematics
    yield "inertias and accelerations", acceleration.n_instructions(), acceleration
    yield "integration and checks", step.instructions, step
    present = replace(step, options=replace(step.options, control=options.control))
    steps = [(f"{options.control} control", present, options.control != "torque")]
    steps += [("joint friction and torque limits", replace(present, model=Model(loose, "none")), True)]
    steps += [("joint stops", replace(present, model=Model(robot, "none")), True)]
    present = replace(present, model=whole.model)
    steps += [("rotors", present, whole.model.transmission != "none")]
    for name, field in (
        ("contact", "contacts"),
        ("contacts seldom near, where they are", "seldom"),
        ("pairs of links, where they are near", "self_collisions"),
        ("ground field", "ground"),
        ("limited motors", "motors"),
        ("method", "method"),
        ("parameters", "parameters"),
        ("control at a rate of its own", "control_period"),
    ):
        chosen = getattr(options, field)
        before, present = present, replace(present, options=replace(present.options, **{field: chosen}))
        steps += [(name, present, present.options != before.options)]
    steps += [("outputs", whole, bool(whole.outputs))]
    yield from ((name, step.instructions, step) for name, step, is_there in steps if is_there)


def left_out(whole: SubStep) -> Iterator[tuple[str, SubStep]]:
    """Yield what could be asked for and is not, each with the sub-step that has it."""
    options, robot = whole.options, whole.model.robot
    changes: dict[str, dict] = {}
    for group in dict.fromkeys(contact.group for contact in robot.contacts):
        wanted = tuple(dict.fromkeys((*options.contacts, *select_contacts(robot, group))))
        changes[f"contacts of group {group!r}"] = {"contacts": select_contacts(robot, wanted)}
    changes |= {f"friction={friction!r} instead": {"friction": friction} for friction in FRICTION}
    changes |= {f"method={method!r} instead": {"method": method} for method in METHODS}
    changes |= {"motors='limited'": {"motors": "limited"}} if robot.motors else {}
    changes |= {"ground='field'": {"ground": "field"}}
    if options.material.dissipation is None:
        changes["dissipation of the material"] = {"material": replace(options.material, dissipation=1.0)}
    damped = isinstance(normal_law(options.normal_law, options.material), KelvinVoigt)
    known = [name for name in PARAMETERS if "ROTOR" not in name and (name != "damping" or damped)]
    for name in (name.replace("BODY", robot.bodies[0].name) for name in known):
        changes[f"parameter {name!r}"] = {"parameters": tuple(dict.fromkeys((*options.parameters, name)))}
    for name, change in changes.items():
        if any(getattr(options, key) != value for key, value in change.items()):
            yield name, replace(whole, options=replace(options, **change))
    for level in LEVELS:
        if level != whole.model.transmission:
            yield f"transmission={level!r} instead", replace(whole, model=Model(robot, level))
    missing = set() if METHODS[options.method].estimates else {"error"}
    missing |= set() if any(closures(whole.model.mechanism)) else {"loop_gap", "nearness"}
    for name in OUTPUTS:
        step = replace(whole, outputs=(*whole.outputs, name))
        if name not in {*whole.outputs, *missing} and any(name in call.outputs for call in step.calls):
            yield f"output {name!r}", step


def _differences(group: str, cumulative: Iterable[tuple[str, int, SubStep | ca.Function]]) -> Iterator[Item]:
    """Turn running totals into items."""
    before = 0
    for name, total, compiled in cumulative:
        yield Item(group, name, total - before, compiled)
        before = total


def _with_joints(robot: Robot, **figures: Any) -> Robot:
    """Return the robot with some figures of all its joints replaced."""
    bodies = (replace(b, joint=replace(b.joint, **figures)) if b.joint.type != "free" else b for b in robot.bodies)
    return replace(robot, bodies=tuple(bodies))


def _parts_of_dynamics(step: SubStep) -> tuple[ca.Function, ca.Function]:
    """Trace what the kinematics leave for the recursions, and the accelerations."""
    mechanism, options = step.model.mechanism, step.options
    state, dt = symbolic_state(mechanism, options), cast(Any, SX.sym("dt"))
    target = SX.sym("target", len(mechanism.robot.commanded))
    scene = make_scene(mechanism, options, SX(0, 1), SX(3, 0))
    solved = solve(scene, state, target, dt, first_iterate(scene))
    found = [x for body in solved.kinematics.bodies.values() for x in (body.X.E, body.X.p, body.c, body.v[:3])]
    found += [x for c in solved.kinematics.coordinates if c is not None for x in (c.G, c.g)]
    results = {f"x{i}": ca.vec(x) for i, x in enumerate(found)}
    inputs = dict(state.items()) | {"dt": dt} | ({"target": target} if target.numel() else {})
    return traced("kinematics", inputs, results), traced("acceleration", inputs, {"vdot": solved.vdot})


def _once(program: TaskProgram) -> Iterator[Item]:
    """Build up what an environment step does around its sub-steps, one term after the other."""
    act = program.function("act")
    yield Item("action", "action", act.n_instructions(), act)
    if late := _late_actions(program):
        yield Item("late actions", "late actions", late, None)
    task = replace(program.task, **NO_TERMS)
    assess = TaskProgram(program.model, task).function("evaluate")
    yield Item("commands and clocks", "commands and clocks", assess.n_instructions(), assess)
    steps = [(field, term) for field in TERMS for term in getattr(program.task, field)]
    for field, term in (*steps, ("noise and history", "noise and history")):
        known = field in TERMS
        before, task = assess, with_term(task, field, term, program.task) if known else program.task
        assess = TaskProgram(program.model, task).function("evaluate")
        if known or assess.n_instructions() != before.n_instructions():
            yield Item(field, term, assess.n_instructions() - before.n_instructions(), assess)


def _late_actions(program: TaskProgram) -> int:
    """Instructions that choose, in each sub-step of an environment step, between the last action and the new one."""
    if "delay" not in program.schema:
        return 0
    each, last = (
        sum(call.function.n_instructions() for call in calls_of((step,)) if isinstance(call, Call))
        for step in program.actions.delayed((Repeat("n_substeps", ()),))
    )
    return program.task.n_substeps * each + last


def with_term(task: Task, field: str, term: str, like: Task | None = None) -> Task:
    """Return the task with one term more, its weight and parameters as in `like`; else with weight 1 and defaults."""
    given, default = getattr(like, field, ()), 1.0 if field == "rewards" else {}
    own = given.get(term, default) if isinstance(given, Mapping) else default
    terms = getattr(task, field)
    old = terms if isinstance(terms, Mapping) else {name: {} for name in terms}
    return replace(task, **{field: {**old, term: own}})


def _terms_left_out(program: TaskProgram) -> Iterator[Item]:
    """What each term and feature that the task does not have would add to what is done once in its step."""
    task, whole = program.task, program.function("evaluate").n_instructions()
    changes = [
        (field, term, with_term(task, field, term))
        for field, kind in TERMS.items()
        for term in OWN[kind]
        if field != "critic" and term not in getattr(task, field)
    ]
    for name, change in {
        "noise of every observation": {} if task.noise else {"noise": dict.fromkeys(task.observations, 0.1)},
        "history of 2 observations": {} if task.history > 1 else {"history": 2},
        "heading commands": {} if task.heading else {"heading": True},
        "pushes": {} if task.push_period else {"push_period": 1.0},
    }.items():
        if change:
            changes.append(("task", name, replace(task, **change)))
    for group, name, other in changes:
        function = TaskProgram(program.model, other).function("evaluate")
        yield Item(group, name, function.n_instructions() - whole, function)
