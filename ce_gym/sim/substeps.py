"""The sub-steps of a scene as the part of a kernel's program that they are. May know dynamics and compile."""

from __future__ import annotations

import casadi as ca

from ce_gym.compile import Buffer, Call, Repeat
from ce_gym.dynamics.scene import StepOptions
from ce_gym.dynamics.spatial import SX
from ce_gym.dynamics.trace import attempt_function, step_function
from ce_gym.model.mechanism import Mechanism

TIMES = "n_substeps"
"""Name of the run-time integer that says how many sub-steps to make."""


def substeps(
    mechanism: Mechanism, options: StepOptions, outputs: tuple[str, ...]
) -> tuple[dict[str, int], list[Buffer], tuple[Call | Repeat, ...]]:
    """Return how to advance a robot `n_substeps` times, as a part of a program.

    Returns:
        Sizes of the buffers that the program must have: state, `diverged`, what `step_function` is given, and outputs;
        scratch buffers; and the steps. An output that is empty for this robot is left out.
    """
    twice = options.method == "euler" and options.friction == "tangent" and bool(options.contacts)
    trace = attempt_function if twice else step_function
    function = trace(mechanism, options, outputs)
    if empty := [name for name in outputs if not function.numel_out(name)]:
        return substeps(mechanism, options, tuple(name for name in outputs if name not in empty))
    state = tuple(n.removesuffix("_next") for n in function.name_out() if n.endswith("_next") and n != "hints_next")
    sizes = {name: function.numel_in(name) for name in function.name_in() if name != "hints"}
    sizes |= {name: function.numel_out(name) for name in outputs}
    if twice:
        return sizes, *_attempts(function, state, outputs)
    return sizes, [], (Repeat(TIMES, (Call(function, tuple(function.name_in()), (*state, *outputs)),)),)


def _attempts(
    attempt: ca.Function, state: tuple[str, ...], outputs: tuple[str, ...]
) -> tuple[list[Buffer], tuple[Call | Repeat, ...]]:
    """A tile makes a second attempt only if one of its robots needs it; the others come to the same result twice."""
    tried = tuple(f"tried_{name}" for name in state)
    sizes = {f"tried_{name}": attempt.numel_in(name) for name in state}
    values = [SX.sym(name, size) for name, size in sizes.items()]
    none = SX(ca.DM.zeros(attempt.numel_in("hints")))
    keep, forget = ca.Function("keep", values, [*values, none]), ca.Function("forget", [], [none])
    sizes |= {"hints": attempt.numel_in("hints"), "misjudged": 1}
    left = (*tried, "hints", "misjudged", *outputs)
    first = Call(attempt, tuple(attempt.name_in()), left)
    again = Call(attempt, tuple(attempt.name_in()), left, only_if="misjudged")
    steps = Call(forget, (), ("hints",)), Repeat(TIMES, (first, again, Call(keep, tried, (*state, "hints"))))
    return [Buffer(name, size, "scratch") for name, size in sizes.items()], steps
