"""The sub-steps of a scene as the part of a kernel's program that they are. May know dynamics and compile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeAlias

import casadi as ca

from ce_gym.compile import Buffer, Call, Lookup, Repeat, Step
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.functions import traced
from ce_gym.dynamics.stepping.ground_lookup import places_function, planes_function, touching_function
from ce_gym.dynamics.stepping.step import further_attempts
from ce_gym.dynamics.stepping.trace import attempt_function, extrapolation_function, step_function
from ce_gym.model.mechanism import Mechanism

TIMES = "n_substeps"
"""Name of the run-time integer that says how many sub-steps to make."""
HEIGHTS = "heights"
"""Name of the table of heights of the ground, on a field."""
FRAME = "frame"
"""Name of the buffer that says where each robot finds that table: x, y of its first entry, length of its cells [m]."""


def substeps(
    mechanism: Mechanism, options: StepOptions, outputs: tuple[str, ...]
) -> tuple[dict[str, int], list[Buffer], tuple[Step | Repeat, ...]]:
    """Return how to advance a robot `n_substeps` times, as a part of a program.

    Returns:
        Sizes of the buffers that the program must have: state, `diverged`, what `step_function` is given, `FRAME` on a
        field, and outputs; further buffers, for scratch and on a field the table `HEIGHTS`; and the steps. An output
        that is empty for this robot is left out.
    """
    more = further_attempts(mechanism, options) if options.method in ("euler", "extrapolated") else 0
    trace = attempt_function if more else step_function
    function = trace(mechanism, options, outputs)
    if empty := [name for name in outputs if not function.numel_out(name)]:
        return substeps(mechanism, options, tuple(name for name in outputs if name not in empty))
    state = tuple(n.removesuffix("_next") for n in function.name_out() if n.endswith("_next") and n != "hints_next")
    sizes = {name: function.numel_in(name) for name in function.name_in() if name != "hints"}
    sizes |= {name: function.numel_out(name) for name in outputs}
    on_field = "ground" in sizes
    further, look = _look_up(mechanism, options) if on_field else ([], ())
    if not more:
        buffers, before, each = _single(function, state, outputs)
    elif options.method == "euler":
        buffers, before, each = _attempts(function, state, outputs, more)
    else:
        again = _look_up(mechanism, options, "half_")[1] if on_field else ()
        asked = {name: sizes[name] for name in outputs}
        buffers, before, each = _extrapolated(mechanism, options, state, asked, more, again)
    buffers, each = [*buffers, *further], (*look, *each)
    if on_field:
        sizes = {name: size for name, size in sizes.items() if name != "ground"} | {FRAME: 3}
    return sizes, buffers, (*before, Repeat(TIMES, each))


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


def _single(step: ca.Function, state: tuple[str, ...], outputs: tuple[str, ...]) -> Parts:
    return [], (), (Call(step, tuple(step.name_in()), (*state, *outputs)),)


def _attempts(attempt: ca.Function, state: tuple[str, ...], outputs: tuple[str, ...], more: int) -> Parts:
    """A tile makes another attempt only if one of its robots needs it; the others come to the same result again."""
    tried = tuple(f"tried_{name}" for name in state)
    sizes = {f"tried_{name}": attempt.numel_in(name) for name in state}
    values = [SX.sym(name, size) for name, size in sizes.items()]
    none = SX(ca.DM.zeros(attempt.numel_in("hints")))
    keep, forget = ca.Function("keep", values, [*values, none]), ca.Function("forget", [], [none])
    sizes |= {"hints": attempt.numel_in("hints"), "misjudged": 1}
    left = (*tried, "hints", "misjudged", *outputs)
    first = Call(attempt, tuple(attempt.name_in()), left)
    again = Call(attempt, tuple(attempt.name_in()), left, only_if="misjudged")
    each = (first, *[again] * more, Call(keep, tried, (*state, "hints")))
    return [Buffer(name, size, "scratch") for name, size in sizes.items()], (Call(forget, (), ("hints",)),), each


STAGES = (("coarse", "", "whole"), ("half", "", "part"), ("fine", "half_", "part"))
"""Steps that an extrapolated one is made of: name, what the buffers begin with that it starts from, and its length."""


def _extrapolated(
    mechanism: Mechanism, options: StepOptions, state: tuple[str, ...], outputs: Mapping[str, int], more: int,
    look_again: tuple[Step, ...],
) -> Parts:  # fmt: skip
    """A whole Euler step and two halves, each with as many attempts as it needs, and what follows from them."""
    asked = tuple(name for name in outputs if name != "error")
    attempt = attempt_function(mechanism, replace(options, dt=None), asked)
    combine = extrapolation_function(mechanism, options, outputs)
    lengths, forget = _lengths(options), ca.Function("forget", [], [SX(ca.DM.zeros(attempt.numel_in("hints")))])
    sizes = {name: attempt.numel_in(name) for name in state} | {name: attempt.numel_out(name) for name in asked}
    buffers = {f"{stage}_{name}": size for stage, _, _ in STAGES for name, size in sizes.items()}
    buffers |= {"hints": attempt.numel_in("hints"), "misjudged": 1, "whole": 1, "part": 1}
    each: list[Step] = []
    for stage, start, length in STAGES:
        here = {name: f"{start}{name}" for name in state} | {"dt": length}
        given = tuple(here.get(name, name) for name in attempt.name_in())
        kept, told = (tuple(f"{stage}_{name}" for name in names) for names in (state, asked))
        left = (*kept, "hints", "misjudged", *told)
        each += look_again if stage == "fine" else ()
        each += [Call(forget, (), ("hints",)), Call(attempt, given, left)]
        each += [Call(attempt, given, left, only_if="misjudged")] * more
    each.append(Call(combine, tuple(combine.name_in()), (*state, *outputs)))
    before = Call(lengths, tuple(lengths.name_in()), ("whole", "part"))
    return [Buffer(name, size, "scratch") for name, size in buffers.items()], (before,), tuple(each)


def _lengths(options: StepOptions) -> ca.Function:
    """Return the function that gives the length of a step and of half of it [s]."""
    dt = SX.sym("dt") if options.dt is None else SX(options.dt)
    return traced("lengths", {"dt": dt} if options.dt is None else {}, {"whole": dt, "part": dt / 2})
