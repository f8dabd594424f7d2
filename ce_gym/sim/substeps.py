"""The sub-steps of a scene as part of a kernel's program: the plan of its method, stage by stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeAlias

import casadi as ca

from ce_gym.compile import Buffer, Call, Lookup, Repeat, Step, While
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.integrators.plan import LOAD, MOVED, OFF, Plan, Rates, Stage
from ce_gym.dynamics.laws.scene_laws import iterations_needed
from ce_gym.dynamics.stepping.choice import chooses
from ce_gym.dynamics.stepping.control import beginning_function as beginning_of_interval
from ce_gym.dynamics.stepping.control import control_function, control_sizes
from ce_gym.dynamics.stepping.ground_lookup import (
    hull_places_function,
    hulls_function,
    places_function,
    planes_function,
    touching_function,
)
from ce_gym.dynamics.stepping.parts import beginning_function, judging_function, mending_function
from ce_gym.dynamics.stepping.trace import NEAR, combination_function, iteration_function, step_function
from ce_gym.model.mechanism import Mechanism

TIMES = "n_substeps"
"""Name of the run-time integer that says how many sub-steps to make."""
DT = "dt"
"""Name of the buffer with the length of a sub-step of each robot [s]."""
HEIGHTS = "heights"
"""Name of the table of heights of the ground, on a field."""
FRAME = "frame"
"""Name of the buffer that says where each robot finds that table: x, y of its first entry, length of its cells [m]."""


def substeps(
    mechanism: Mechanism, options: StepOptions, outputs: tuple[str, ...]
) -> tuple[dict[str, int], list[Buffer], tuple[Step | Repeat, ...]]:
    """Return how to advance a robot `n_substeps` times, as a part of a program.

    Returns:
        Sizes of the buffers that the program must have: state, `diverged`, `retries`, what `step_function` is given,
        `DT` among it, `FRAME` on a field, and outputs; further buffers, for scratch and on a field the table `HEIGHTS`;
        and the steps. An output that is empty for this robot is left out.
    """
    options = replace(options, dt=None)
    plan, most = METHODS[options.method], iterations_needed(mechanism, options)
    staged = any(min(stage.iterations, most) for stage in plan.stages)
    measured = {MOVED: 1} | ({OFF: mechanism.robot.layout.nv + 1} if plan.controlled else {})
    asked = (*outputs, *measured) if plan.single or not staged else tuple(name for name in outputs if name != "error")
    function = (
        iteration_function(mechanism, options, asked, chooses=chooses(options))
        if staged
        else step_function(mechanism, options, asked)
    )
    kept = {name: size for name in outputs if (size := function.numel_out(name) if name in asked else 1)}
    if len(kept) < len(outputs):
        return substeps(mechanism, options, tuple(kept))
    sizes = {
        name: function.numel_in(name)
        for name in function.name_in()
        if name not in (*ITERATES, "ground", "region_points")
    }
    sizes |= {"retries": 1, **kept} | ({FRAME: 3} if "ground" in function.name_in() else {})
    sizes |= control_sizes(mechanism.robot.layout) if plan.controlled else {}
    fractions = {TRIED: 1.0} | ({_own(plan, stage): stage.length for stage in plan.stages} if staged else {})
    told = kept | measured
    buffers, try_part = _staged(mechanism, options, function, told) if staged else _whole(mechanism, options, function)
    clear = [Call(_zeros(function, name), (), (name,)) for name in function.name_in() if name == "near_iterate"]
    begin = (beginning_of_interval if plan.controlled else beginning_function)(fractions)
    take = (_take_step if plan.controlled else _take_part)(mechanism, options, kept, fractions)
    started = tuple(begin.name_out())
    buffers += [Buffer(name, 1, "scratch") for name in started]
    begins = Call(begin, tuple(begin.name_in()), started)
    return sizes, buffers, (*clear, Repeat(TIMES, (begins, While("unfinished", (*try_part, *take)))))


ITERATES = ("near_iterate", "iterate")
"""Buffers of iterates: of what is seldom near, zero between the stages of steps, and of all else."""
TRIED = "tried"
"""What names of buffers begin with that have the state after a part of a step that is tried, and what it reports."""
Parts: TypeAlias = tuple[list[Buffer], tuple[Call | Lookup, ...]]
"""Buffers, and how such a part is made."""


def _own(plan: Plan, stage: Stage) -> str:
    """Return what names of buffers begin with that a stage writes."""
    return TRIED if plan.single else stage.name


def _take_part(
    mechanism: Mechanism, options: StepOptions, outputs: Mapping[str, int], fractions: Mapping[str, float]
) -> tuple[Call, ...]:
    """Take what was tried where it is good; a tile whose robots all make the whole step just copies it."""
    judge, mend = judging_function(), mending_function(mechanism, options, outputs, fractions)
    left = tuple(name.removesuffix("_next") for name in mend.name_out())
    tried = {name: mend.numel_out(i) for i, name in enumerate(left) if name.startswith(f"{TRIED}_")}
    tried.pop(f"{TRIED}_{DT}", None)
    values = [SX.sym(name, size) for name, size in tried.items()]
    copy = ca.Function("copy", values, values)
    return (
        Call(judge, tuple(judge.name_in()), ("unfinished",)),
        Call(mend, tuple(mend.name_in()), left, only_if="unfinished"),
        Call(copy, tuple(tried), tuple(name.removeprefix(f"{TRIED}_") for name in tried)),
    )


def _take_step(
    mechanism: Mechanism, options: StepOptions, outputs: Mapping[str, int], fractions: Mapping[str, float]
) -> tuple[Call, ...]:
    """Take what was tried where its error is allowed, and say how long the next step is."""
    control = control_function(mechanism, options, outputs, fractions)
    return (Call(control, tuple(control.name_in()), tuple(name.removesuffix("_next") for name in control.name_out())),)


def _whole(mechanism: Mechanism, options: StepOptions, step: ca.Function) -> Parts:
    """Make a step by a method that does not iterate, in one call."""
    results = {f"{TRIED}_{name.removesuffix('_next')}": step.numel_out(name) for name in step.name_out()}
    buffers = [Buffer(name, size, "scratch") for name, size in results.items()]
    ground, look = look_up(mechanism, options) if "ground" in step.name_in() else ([], ())
    given = tuple(f"{TRIED}_dt" if name == DT else name for name in step.name_in())
    return buffers + ground, (*look, Call(step, given, tuple(results)))


def _staged(mechanism: Mechanism, options: StepOptions, iteration: ca.Function, outputs: Mapping[str, int]) -> Parts:
    """Make every stage with the iterations that a tile needs, and combine what is after the step from them.

    `iteration` is the traced iteration, `outputs` are sizes. A tile iterates again only if one of its robots has not
    converged; the others reproduce their result.
    """
    plan, most = METHODS[options.method], iterations_needed(mechanism, options)
    asked = tuple(name for name in outputs if name in iteration.name_out())
    state = [name for name in iteration.name_in() if f"{name}_next" in iteration.name_out() and name not in ITERATES]
    iterates = {name: iteration.numel_in(name) for name in ITERATES if name in iteration.name_in()}
    sizes = {name: iteration.numel_in(name) for name in state} | {name: iteration.numel_out(name) for name in asked}
    scratch = {f"{_own(plan, stage)}_{name}": size for stage in plan.stages for name, size in sizes.items()}
    scratch |= iterates | {"unconverged": 1}
    zeros = {name: _zeros(iteration, name) for name in iterates}
    near = (NEAR,) if NEAR in iteration.name_out() else ()
    scratch |= dict.fromkeys(near, 1)
    buffers = look_up(mechanism, options)[0] if "ground" in iteration.name_in() else []
    each: list[Call | Lookup] = []
    ground_at: str | None = None
    for stage in plan.stages:
        assert not isinstance(stage.start, Rates), "explicit stages do not iterate"
        start, own = f"{stage.start}_" if stage.start else "", _own(plan, stage)
        if buffers and stage.start != ground_at:
            each += look_up(mechanism, options, start)[1]
            ground_at = stage.start
        here = {name: f"{start}{name}" for name in state} | {DT: f"{own}_dt"}
        if LOAD in here and not stage.start:
            here[LOAD] = stage.load
        given = tuple(here.get(name, name) for name in iteration.name_in())
        left = (*(f"{own}_{name}" for name in state), *iterates, "unconverged", *near)
        left = (*left, *(f"{own}_{name}" for name in asked))
        each += [Call(zeros[name], (), (name,)) for name in iterates if name != "near_iterate"]
        first = Call(iteration, given, left, short_if_zero="".join(near))
        each += [first] + [replace(first, only_if="unconverged", again=tuple(iterates))] * min(stage.iterations, most)
        each += [Call(zeros["near_iterate"], (), ("near_iterate",), only_if=NEAR)] if near else []
    if not plan.single:
        combine = combination_function(mechanism, options, outputs)
        tried = {f"{TRIED}_{name.removesuffix('_next')}": combine.numel_out(name) for name in combine.name_out()}
        given = tuple(f"{TRIED}_{DT}" if name == DT else name for name in combine.name_in())
        each.append(Call(combine, given, tuple(tried)))
        scratch |= tried
    return buffers + [Buffer(name, size, "scratch") for name, size in scratch.items()], tuple(each)


def _zeros(iteration: ca.Function, name: str) -> ca.Function:
    """Return the function that sets an iterate to zero."""
    return ca.Function("zeros", [], [SX(ca.DM.zeros(iteration.numel_in(name)))])


def look_up(mechanism: Mechanism, options: StepOptions, at: str = "") -> Parts:
    """Find the ground under the contacts; `at` is what the names of the state's buffers begin with."""
    places, touching = places_function(mechanism, options), touching_function(mechanism, options)
    n, state = len(options.contacts), tuple(f"{at}{name}" for name in places.name_in())
    centres, ground = ("contact_places", "contact_ground") if options.hulls else ("places", "ground")
    buffers = [Buffer(HEIGHTS, 0, "table"), Buffer(centres, 2 * n, "scratch"), Buffer(ground, 3 * n, "scratch")]
    steps: tuple[Call | Lookup, ...] = (Call(places, state, (centres,)), Lookup(HEIGHTS, FRAME, centres, ground))
    if touching is not None:
        m, planes = touching.numel_out(0) // 2, planes_function(mechanism, options)
        buffers += [Buffer("touching", 2 * m, "scratch"), Buffer("found", 3 * m, "scratch")]
        steps += (
            Call(touching, (*state[: touching.n_in() - 2], centres, ground), ("touching",)),
            Lookup(HEIGHTS, FRAME, "touching", "found"),
            Call(planes, (centres, ground, "touching", "found"), (ground,)),
        )
    if options.hulls:
        points, hulls = hull_places_function(mechanism, options), hulls_function(mechanism, options)
        m, results = points.numel_out(0) // 2, ("places", "ground", "region_points")
        buffers += [Buffer("hull_places", 2 * m, "scratch"), Buffer("hull_ground", 3 * m, "scratch")]
        buffers += [Buffer(name, hulls.numel_out(i), "scratch") for i, name in enumerate(results)]
        steps += (
            Call(points, state, ("hull_places",)),
            Lookup(HEIGHTS, FRAME, "hull_places", "hull_ground"),
            Call(hulls, (*state, "contact_places", "contact_ground", "hull_ground"), results),
        )
    return buffers, steps
