"""The sub-steps of a scene as part of a kernel's program: the plan of its method, stage by stage."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

import casadi as ca

from ce_gym.compile import Buffer, Call, Lookup, Repeat, Step
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.functions import traced
from ce_gym.dynamics.stepping.ground_lookup import places_function, planes_function, touching_function
from ce_gym.dynamics.stepping.methods import METHODS
from ce_gym.dynamics.stepping.plan import Plan, Rates
from ce_gym.dynamics.stepping.step import iterations_needed
from ce_gym.dynamics.stepping.trace import combination_function, iteration_function, step_function
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
        Sizes of the buffers that the program must have: state, `diverged`, what `step_function` is given, `DT` among
        it, `FRAME` on a field, and outputs; further buffers, for scratch and on a field the table `HEIGHTS`; and the
        steps. An output that is empty for this robot is left out.
    """
    options = replace(options, dt=None)
    plan, most = METHODS[options.method], iterations_needed(mechanism, options)
    staged = any(min(stage.iterations, most) for stage in plan.stages)
    asked = tuple(name for name in outputs if not staged or plan.single or name != "error")
    function = (iteration_function if staged else step_function)(mechanism, options, asked)
    if empty := [name for name in asked if not function.numel_out(name)]:
        return substeps(mechanism, options, tuple(name for name in outputs if name not in empty))
    sizes = {name: function.numel_in(name) for name in function.name_in() if name != "iterate"}
    state = tuple(name for name in sizes if f"{name}_next" in function.name_out())
    sizes |= {name: function.numel_out(name) if name in asked else 1 for name in outputs}
    on_field = "ground" in sizes
    buffers, look = _look_up(mechanism, options) if on_field else ([], ())
    if staged:
        further, before, each = _staged(mechanism, options, function, {name: sizes[name] for name in outputs})
    else:
        further, before, each = [], (), (*look, Call(function, tuple(function.name_in()), (*state, *outputs)))
    if on_field:
        sizes = {name: size for name, size in sizes.items() if name != "ground"} | {FRAME: 3}
    return sizes, [*further, *buffers], (*before, Repeat(TIMES, each))


Parts: TypeAlias = tuple[list[Buffer], tuple[Step, ...], tuple[Step, ...]]
"""Scratch buffers, what comes before the first sub-step, and what every sub-step consists of."""


def _look_up(mechanism: Mechanism, options: StepOptions, at: str = "") -> tuple[list[Buffer], tuple[Step, ...]]:
    """Find the ground under the contacts; `at` is what the names of the state's buffers begin with."""
    places, touching = places_function(mechanism, options), touching_function(mechanism, options)
    n = len(options.contacts)
    buffers = [Buffer(HEIGHTS, 0, "table"), Buffer("places", 2 * n, "scratch"), Buffer("ground", 3 * n, "scratch")]
    state = tuple(f"{at}{name}" for name in places.name_in())
    under = Call(places, state, ("places",)), Lookup(HEIGHTS, FRAME, "places", "ground")
    if touching is None:
        return buffers, under
    m, planes = touching.numel_out(0) // 2, planes_function(mechanism, options)
    buffers += [Buffer("touching", 2 * m, "scratch"), Buffer("found", 3 * m, "scratch")]
    beside = (
        Call(touching, tuple(touching.name_in()), ("touching",)),
        Lookup(HEIGHTS, FRAME, "touching", "found"),
        Call(planes, tuple(planes.name_in()), ("ground",)),
    )
    return buffers, (*under, *beside)


def _staged(mechanism: Mechanism, options: StepOptions, iteration: ca.Function, outputs: dict[str, int]) -> Parts:
    """Every stage with the iterations that a tile needs, and the state after the step combined from them.

    `iteration` is the traced iteration, `outputs` are sizes. A tile iterates again only if one of its robots has not
    converged; the others reproduce their result.
    """
    plan = METHODS[options.method]
    alone = plan.is_euler
    asked = tuple(name for name in outputs if name in iteration.name_out())
    combine = combination_function(mechanism, options, {} if plan.single else outputs)
    state = tuple(name.removesuffix("_next") for name in combine.name_out() if name.endswith("_next"))
    most = iterations_needed(mechanism, options)
    lengths, zeros = _lengths(plan), _zeros(iteration.numel_in("iterate"))
    sizes = {name: iteration.numel_in(name) for name in state}
    sizes |= {} if plan.single else {name: iteration.numel_out(name) for name in asked}
    buffers = {f"{stage.name}_{name}": size for stage in plan.stages for name, size in sizes.items()}
    buffers |= {"iterate": iteration.numel_in("iterate"), "unconverged": 1}
    buffers |= {} if alone else dict.fromkeys(lengths.name_out(), 1)
    each: list[Step] = []
    ground_at: str | None = None
    for stage in plan.stages:
        assert not isinstance(stage.start, Rates), "explicit stages do not iterate"
        start = f"{stage.start}_" if stage.start else ""
        if "ground" in iteration.name_in() and stage.start != ground_at:
            each += _look_up(mechanism, options, start)[1]
            ground_at = stage.start
        here = {name: f"{start}{name}" for name in state} | {DT: DT if alone else f"{stage.name}_dt"}
        given = tuple(here.get(name, name) for name in iteration.name_in())
        told = asked if plan.single else tuple(f"{stage.name}_{name}" for name in asked)
        left = (*(f"{stage.name}_{name}" for name in state), "iterate", "unconverged", *told)
        each += [Call(zeros, (), ("iterate",)), Call(iteration, given, left)]
        each += [Call(iteration, given, left, only_if="unconverged")] * min(stage.iterations, most)
    written = tuple(name.removesuffix("_next") for name in combine.name_out())
    each.append(Call(combine, tuple(combine.name_in()), written))
    before = () if alone else (Call(lengths, (DT,), tuple(lengths.name_out())),)
    return [Buffer(name, size, "scratch") for name, size in buffers.items()], before, tuple(each)


def _zeros(size: int) -> ca.Function:
    return ca.Function("zeros", [], [SX(ca.DM.zeros(size))])


def _lengths(plan: Plan) -> ca.Function:
    """Return the function that gives the length of each stage [s]."""
    dt = SX.sym(DT)
    return traced("lengths", {DT: dt}, {f"{stage.name}_dt": stage.length * dt for stage in plan.stages})
