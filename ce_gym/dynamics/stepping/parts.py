"""A step made in parts, for robots that fail in a whole one or move too far: half of it, and again half of what failed.

A light link under more torque than a step can follow turns by radians in one, and then its loops cannot be closed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.plan import MOVED
from ce_gym.dynamics.laws.scene_laws import moment_of, symbolic_state
from ce_gym.model.mechanism import Mechanism

LARGEST_MOVE = 0.5
"""A step is made in parts if it moves a joint by more [rad or m]."""
FAST, LARGEST_FAST_MOVE = 40.0, 0.2
"""The same of a joint that is faster than [rad/s or m/s], as hardly a motor turns one: docs/explanation/numerics.md"""
PROGRESS = ("part", "left", "unfinished")
"""Fraction of the step that is tried, 0 for a robot that is through; fraction ahead; whether it goes on. 1 at first."""


def lengths(part: SX, dt: SX, fractions: Mapping[str, float]) -> dict[str, SX]:
    """Return the lengths of stages [s] in a part of a step, by the names of their buffers."""
    return {f"{stage}_dt": fraction * (part * dt) for stage, fraction in fractions.items()}


def beginning_function(fractions: Mapping[str, float]) -> ca.Function:
    """Trace the beginning of a step: (dt) -> (*`PROGRESS`, lengths of the stages, of which `fractions` are given)."""
    dt = SX.sym("dt")
    return traced("begin", {"dt": dt}, dict.fromkeys(PROGRESS, SX(1)) | lengths(SX(1), dt, fractions))


def judging_function() -> ca.Function:
    """Trace whether a part that was tried is anything but a whole step with a good end.

    Returns:
        Function (tried_diverged, tried_moved, part, dt) -> (unfinished).
    """
    given = {name: SX.sym(name) for name in ("tried_diverged", f"tried_{MOVED}", "part", "dt")}
    diverged, moved, part, dt = given.values()
    good = ca.logic_and(ca.logic_and(near(moved, dt), part >= 1), diverged < 0.5)
    return traced("judge", given, {"unfinished": ca.logic_not(good)})


def near(moved: SX, dt: SX) -> SX:
    """Return whether the fastest joint moved no further in a step than it may [rad or m]; 0 for NaN."""
    return moved <= ca.fmin(ca.fmax(FAST * dt, LARGEST_FAST_MOVE), LARGEST_MOVE)


def mending_function(
    mechanism: Mechanism, options: StepOptions, outputs: Mapping[str, int], fractions: Mapping[str, float]
) -> ca.Function:
    """Trace what becomes of a part that was tried, and what is tried next, where some robot makes its step in parts.

    A part is refused if the robot diverged in it or a joint moved too far, unless it is the smallest. A robot that had
    diverged before, or does so in the smallest part, is through.

    Args:
        mechanism: The robot at a transmission level.
        options: The scene.
        outputs: Sizes of what the step reports. Means are added up over the step; what belongs to its start is that of
            the first part, all else that of the last one.
        fractions: Lengths of the stages, as fractions of the step.

    Returns:
        Function (*state, diverged, *outputs, *the same tried, tried_moved, part, left, retries, dt) -> (*the same
        tried, *`PROGRESS`, retries, *lengths of the stages), where `retries` counts steps made in parts.
    """
    sizes = {name: value.numel() for name, value in symbolic_state(mechanism, options).items()}
    sizes |= {"diverged": 1, **outputs}
    old, tried = ({name: SX.sym(name, size) for name, size in sizes.items()} for _ in range(2))
    given = {name: SX.sym(name) for name in (f"tried_{MOVED}", "part", "left", "retries", "dt")}
    moved, part, left, retries, dt = given.values()

    unfit = ca.logic_or(tried["diverged"] > 0.5, ca.logic_not(near(moved, part * dt)))
    divisible = ca.logic_and(part > 1.5 * 0.5**options.retry, old["diverged"] < 0.5)
    refused = ca.logic_and(unfit, divisible)
    taken = ca.logic_and(part > 0, ca.logic_not(refused))
    results = reported(old, tried, outputs, left >= 1, part)
    after = {f"tried_{name}": ca.if_else(taken, value, old[name]) for name, value in results.items()}
    ahead = ca.if_else(taken, left - part, left)
    unfinished = ca.logic_or(refused, ca.logic_and(taken, ca.logic_and(ahead > 0, tried["diverged"] < 0.5)))
    after |= {"left": ahead, "unfinished": unfinished}
    after["part"] = ca.if_else(unfinished, ca.if_else(refused, part / 2, part), 0)
    after["retries"] = retries + ca.logic_and(refused, part >= 1)
    given |= old | {f"tried_{name}": value for name, value in tried.items()}
    results = {name + "_next" * (name in given): value for name, value in after.items()}
    return traced("mend", given, results | lengths(after["part"], dt, fractions))


def reported(
    old: Mapping[str, SX], tried: Mapping[str, SX], outputs: Iterable[str], first: SX, part: SX
) -> dict[str, SX]:
    """Return what a part of a step leaves if it is taken: means are added up, what belongs to the start is the first's.

    Args:
        old: State and outputs after the part before.
        tried: The same after this one.
        outputs: Which are outputs.
        first: Whether it is the first.
        part: Of the whole.
    """
    results = dict(tried)
    for name in outputs:
        if moment_of(name) == "mean":
            results[name] = ca.if_else(first, 0, old[name]) + part * tried[name]
        elif moment_of(name) == "start":
            results[name] = ca.if_else(first, tried[name], old[name])
    return results
