"""A whole control step as one kernel: act, sub-steps, assess, count, and the reset of those who are done.

    advance:  the step of `TaskProgram`, then `count`: the episode's clock, who is done, what is told of who is
    begin:    the reset of `TaskProgram`, for who is done

The processor keeps these as two kernels with numpy between; on a GPU a second launch and a look from the host would
cost as much as the physics. May know programs and compile.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from ce_gym.compile import Buffer, Call, Lookup, Program, Repeat, Step
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.functions import traced
from ce_gym.envs.runtime.program import TaskProgram

FLAGS = ("terminated", "truncated", "diverged", "done")
"""Columns of the rows `flags`, 1 or 0."""
OWN_STATE = ("elapsed", "limit", "failures", "chosen")
"""State of one robot besides the task's: control steps of the episode and the most of them, episodes that have ended
because the simulation failed, and whether a new episode begins; one number each."""


def round_stages(program: TaskProgram) -> tuple[Program, Program]:
    """Return the stages of one launch."""
    step, begin = program.step_program(), reset_stage(program)
    observation = next(b for b in step.buffers if b.name == "observation")
    count = _count(program)
    keep = SX.sym("observation", observation.size)
    copy = ca.Function("copy", [keep], [keep])
    buffers = [
        *step.buffers,
        *(Buffer(name, 1, "tiles") for name in OWN_STATE),
        Buffer("flags", len(FLAGS), "rows_out", "float32"),
        Buffer("ended", 1 + len(program.sum_names), "rows_out"),
        Buffer("final_observation", observation.size, "rows_out", "float32"),
    ]
    outputs = tuple(name.removesuffix("_next") for name in count.name_out())
    more = (
        Call(count, tuple(count.name_in()), outputs),
        Call(copy, ("observation",), ("final_observation",)),
    )
    return replace(step, buffers=tuple(buffers), steps=(*step.steps, *more)), begin


def reset_stage(program: TaskProgram) -> Program:
    """Return the task's reset; its random numbers under a name of their own."""
    return _renamed(program.reset_program(), {"draws": "first_draws"})


def _count(program: TaskProgram) -> ca.Function:
    """Outcome of a step -> the episode's clock, flags, and length and sums of an episode that has ended, else zeros."""
    outcome = SX.sym("outcome", 3 + len(program.reward_terms))
    sums = SX.sym("sums", len(program.sum_names))
    elapsed, limit, failures = SX.sym("elapsed"), SX.sym("limit"), SX.sym("failures")
    length, terminated, diverged = elapsed + 1, outcome[1] > 0.5, outcome[2] > 0.5
    truncated = ca.logic_or(length >= limit, diverged)
    done = ca.logic_or(terminated, truncated)
    # A robot that diverged may hold numbers that are none; nobody adds those up.
    told = ca.if_else(ca.logic_or(ca.logic_not(diverged), ca.fabs(outcome) < ca.inf), outcome, 0)
    added = ca.if_else(ca.logic_and(done, ca.fabs(sums) < ca.inf), sums, 0)
    outputs = {
        "outcome_next": told,
        "elapsed_next": ca.if_else(done, 0, length),
        "failures_next": failures + diverged,
        "chosen_next": done,
        "flags": ca.vertcat(terminated, truncated, diverged, done),
        "ended": ca.vertcat(ca.if_else(done, length, 0), added),
    }
    inputs = {"outcome": outcome, "sums": sums, "elapsed": elapsed, "limit": limit, "failures": failures}
    return traced("count", inputs, outputs)


def _renamed(program: Program, names: dict[str, str]) -> Program:
    """The same program with other names of buffers."""

    def of(name: str) -> str:
        return names.get(name, name)

    def step(s: Step | Repeat) -> Step | Repeat:
        if isinstance(s, Repeat):
            return replace(s, calls=tuple(step(c) for c in s.calls))
        if isinstance(s, Lookup):
            return replace(s, table=of(s.table), frame=of(s.frame), points=of(s.points), output=of(s.output))
        inputs, outputs = (tuple(map(of, side)) for side in (s.inputs, s.outputs))
        return replace(s, inputs=inputs, outputs=outputs, only_if=of(s.only_if))

    buffers = tuple(replace(b, name=of(b.name)) for b in program.buffers)
    return replace(program, buffers=buffers, steps=tuple(map(step, program.steps)), skip_unless=of(program.skip_unless))
