"""The sub-steps of a scene as the part of a kernel's program that they are. May know dynamics and compile."""

from __future__ import annotations

from typing import TypeAlias

import casadi as ca

from ce_gym.compile import Buffer, Call, Lookup, Repeat, Step
from ce_gym.dynamics.ground import places_function, planes_function, touching_function
from ce_gym.dynamics.scene import StepOptions
from ce_gym.dynamics.spatial import SX
from ce_gym.dynamics.step import further_attempts
from ce_gym.dynamics.trace import attempt_function, step_function
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
    more = further_attempts(options) if options.method == "euler" else 0
    trace = attempt_function if more else step_function
    function = trace(mechanism, options, outputs)
    if empty := [name for name in outputs if not function.numel_out(name)]:
        return substeps(mechanism, options, tuple(name for name in outputs if name not in empty))
    state = tuple(n.removesuffix("_next") for n in function.name_out() if n.endswith("_next") and n != "hints_next")
    sizes = {name: function.numel_in(name) for name in function.name_in() if name != "hints"}
    sizes |= {name: function.numel_out(name) for name in outputs}
    buffers, before, each = _attempts(function, state, outputs, more) if more else _single(function, state, outputs)
    if "ground" in sizes:
        further, look = _look_up(mechanism, options)
        buffers, each = [*buffers, *further], (*look, *each)
        sizes = {name: size for name, size in sizes.items() if name != "ground"} | {FRAME: 3}
    return sizes, buffers, (*before, Repeat(TIMES, each))


Parts: TypeAlias = tuple[list[Buffer], tuple[Step, ...], tuple[Step, ...]]
"""Scratch buffers, what comes before the first sub-step, and what every sub-step consists of."""


def _look_up(mechanism: Mechanism, options: StepOptions) -> tuple[list[Buffer], tuple[Step, ...]]:
    """Find the ground under the contacts, before a sub-step."""
    places, touching = places_function(mechanism, options), touching_function(mechanism, options)
    n = len(options.contacts)
    buffers = [Buffer(HEIGHTS, 0, "table"), Buffer("places", 2 * n, "scratch"), Buffer("ground", 3 * n, "scratch")]
    under = Call(places, tuple(places.name_in()), ("places",)), Lookup(HEIGHTS, FRAME, "places", "ground")
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
