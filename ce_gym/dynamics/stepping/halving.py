"""Step halving: a step that fails, or in which a joint moves too far, is repeated as two halves, and so on.

A light link under a large torque can turn by radians within one step, and then its loops cannot be closed.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.integrators.plan import MOVED
from ce_gym.dynamics.laws.scene_laws import moment_of
from ce_gym.dynamics.stepping.variables import DT, LEFT, RETRIES, UNFINISHED, StepVariables, Variable

LARGEST_MOVE = 0.5
"""A step in which a joint moves further is halved [rad or m]."""
FAST, LARGEST_FAST_MOVE = 40.0, 0.2
"""The same for a joint faster than `FAST` [rad/s or m/s], which few motors are: docs/explanation/numerics.md"""
PART = Variable("part")
"""Fraction of the step that is tried; 0 for a robot that has finished. `LEFT` is a fraction of the step, too."""


def begin_function(step: StepVariables) -> ca.Function:
    """Trace the start of a step: (dt) -> (part, left, unfinished, lengths of the step and its stages)."""
    dt = DT.symbol()
    progress = {variable.name: SX(1) for variable in (PART, LEFT, UNFINISHED)}
    return traced("begin", {DT.name: dt}, progress | step.lengths(dt))


def accept_function(step: StepVariables) -> ca.Function:
    """Trace whether a robot still has to work on its step after a try.

    Returns:
        Function (tried_diverged, tried_moved, part, dt) -> (unfinished): 0 if the try was a whole step without failure.
    """
    variables = step.tried["diverged"], step.tried[MOVED], PART, DT
    inputs = {variable.name: variable.symbol() for variable in variables}
    diverged, moved, part, dt = inputs.values()
    good = ca.logic_and(ca.logic_and(is_short(moved, dt), part >= 1), diverged < 0.5)
    return traced("accept", inputs, {UNFINISHED.name: ca.logic_not(good)})


def is_short(moved: SX, dt: SX) -> SX:
    """Return whether the distance of the fastest joint in a step is allowed [rad or m]; 0 for NaN."""
    return moved <= ca.fmin(ca.fmax(FAST * dt, LARGEST_FAST_MOVE), LARGEST_MOVE)


def subdivide_function(step: StepVariables, most: int) -> ca.Function:
    """Trace the result of a try and the next try, for tiles in which some robot halves its step.

    A try is rejected if the robot diverges or a joint moves too far, unless it is as short as allowed. A robot that had
    diverged before, or that diverges in the shortest try, has finished.

    Args:
        step: Variables of the step. Outputs that are means are summed over the parts of the step, outputs of its start
            are taken from the first part, all others from the last part.
        most: How often a step may be halved.

    Returns:
        Function (tried_moved, part, left, retries, dt, start, tried) -> (tried, left, unfinished, part, retries,
        lengths), where `start` and `tried` are the state and the outputs before and after the try.
    """
    old, tried = ({name: x[name].symbol() for name in step.start} for x in (step.start, step.tried))
    inputs = {variable.name: variable.symbol() for variable in (step.tried[MOVED], PART, LEFT, RETRIES, DT)}
    moved, part, left, retries, dt = inputs.values()
    inputs |= step.start.named(old) | step.tried.named(tried)

    failed = ca.logic_or(tried["diverged"] > 0.5, ca.logic_not(is_short(moved, part * dt)))
    divisible = ca.logic_and(part > 1.5 * 0.5**most, old["diverged"] < 0.5)
    rejected = ca.logic_and(failed, divisible)
    accepted = ca.logic_and(part > 0, ca.logic_not(rejected))
    results = accumulated(old, tried, left >= 1, part)
    results = step.tried.named({name: ca.if_else(accepted, value, old[name]) for name, value in results.items()})
    remaining = ca.if_else(accepted, left - part, left)
    continues = ca.logic_and(accepted, ca.logic_and(remaining > 0, tried["diverged"] < 0.5))
    unfinished = ca.logic_or(rejected, continues)
    following = ca.if_else(unfinished, ca.if_else(rejected, part / 2, part), 0)
    results |= {LEFT.name: remaining, UNFINISHED.name: unfinished, PART.name: following}
    results[RETRIES.name] = retries + ca.logic_and(rejected, part >= 1)
    return traced("subdivide", inputs, results | step.lengths(following * dt))


def copy_function(step: StepVariables) -> ca.Function:
    """Trace the acceptance of a try by all robots: (tried) -> (start), states and outputs."""
    tried = {name: step.tried[name].symbol() for name in step.start}
    return traced("copy", step.tried.named(tried), step.start.named(tried))


def accumulated(old: Mapping[str, SX], tried: Mapping[str, SX], first: SX, part: SX) -> dict[str, SX]:
    """Return state and outputs after a part of a step: means are summed, outputs of the start come from the first part.

    Args:
        old: State and outputs after the previous part.
        tried: State and outputs after this part.
        first: Whether this part is the first.
        part: Length of this part as a fraction of the step.
    """
    results = dict(tried)
    for name in tried:
        if moment_of(name) == "mean":
            results[name] = ca.if_else(first, 0, old[name]) + part * tried[name]
        elif moment_of(name) == "start":
            results[name] = ca.if_else(first, tried[name], old[name])
    return results
