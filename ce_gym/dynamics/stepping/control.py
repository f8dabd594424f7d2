"""Steps as long as their error allows: what becomes of a step that was tried, and how long the next one is.

Every step is made by Euler's method in a whole and in two halves, which differ by an estimate of the error of the
halves, d; what is taken is the result extrapolated from both. Its own error is less: d is in proportion to h^2, and
extrapolation removes that part, so that what is left is how much d / h^2 changes. A step is taken if the largest d of
all positions is within `ALLOWED` times the tolerance, or the change of d since the last step is at such a rate that it
would take `HORIZON` to add up to that: in free flight d does not change. Other steps are refused and tried again
shorter. Contact needs no search for events: a step in which a contact begins or ends is refused until it is so short
that the landing does not matter. In contact the error of velocities counts too, see `step_errors`: the flight after a
bounce makes it grow.

Lengths follow Gustafsson's PI controller (Hairer and Wanner, Solving Ordinary Differential Equations II, IV.2, 1996;
Soederlind, Numerical Algorithms 31, 2002). The norm is that of CENIC (Kurtz and Castro 2025, arXiv:2511.08771): the
largest error of a position, 1 rad counting as 1 m, with no part for velocities without contact.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.plan import MOVED, OFF
from ce_gym.dynamics.laws.scene_laws import symbolic_state
from ce_gym.dynamics.stepping.parts import LARGEST_MOVE, reported
from ce_gym.model.coordinates import Layout
from ce_gym.model.mechanism import Mechanism

ALLOWED = 0.25
"""Part of the tolerance that one step may be off by: errors of steps add up."""
SHORTEST = 2.0**-14
"""Least length of a step as a part of the interval: there it is taken whatever its error."""
AIM = 0.4
"""Part of what is allowed that the error of the next step should be: few are refused."""
GROWTH, SHRINKAGE = 5.0, 0.1
"""Most and least that the next step is to the last one."""
BEFORE, NOW = 0.2, 0.35
"""Exponents of the errors of the step before and of this one: 0.4 / 2 and 0.7 / 2 for an estimate of second order."""
STRETCH = 0.1
"""A step may be longer than proposed by so much if that spares the interval one more."""
HORIZON = 1.0
"""See above [s]."""


def control_sizes(layout: Layout) -> dict[str, int]:
    """Return sizes of what a robot carries besides its state.

    The length to be tried next [s]; of the last step taken the estimated error [rad or m] and d / h^2, see above
    [rad/s^2 or m/s^2]; how many were taken and how many of those missed the tolerance; and that [rad or m].
    """
    names = ("step_length", "step_error", "step_change", "steps_taken", "steps_missed", "tolerance")
    return dict.fromkeys(names, 1) | {"step_change": layout.nv}


def beginning_function(fractions: Mapping[str, float]) -> ca.Function:
    """Trace the beginning of an interval.

    Args:
        fractions: Lengths of the stages, as fractions of a step.

    Returns:
        Function (dt, step_length) -> (left, trying, refusing, unfinished, *lengths of the stages): what is ahead [s],
        the step to be tried [s], whether the one before was refused, and 1.
    """
    dt, length = SX.sym("dt"), SX.sym("step_length")
    trying = next_length(dt, length)
    progress = {"left": dt, "trying": trying, "refusing": SX(0), "unfinished": SX(1)}
    return traced("begin", {"dt": dt, "step_length": length}, progress | _lengths(trying, fractions))


def control_function(
    mechanism: Mechanism, options: StepOptions, outputs: Mapping[str, int], fractions: Mapping[str, float]
) -> ca.Function:
    """Trace what becomes of a step that was tried, and what is tried next.

    A step is refused if its error is not allowed, if the robot diverged in it or a joint moved too far, unless it is as
    short as can be. A robot that has diverged, or does so in the shortest step, is through with its interval.

    Args:
        mechanism: The robot at a transmission level.
        options: The scene.
        outputs: Sizes of what the step reports: means over the interval, its start or its end, see `plan.py`.
        fractions: Lengths of the stages, as fractions of a step.

    Returns:
        Function (*state, diverged, *outputs, *the same tried, tried_moved, tried_off, left, trying, refusing, retries,
        dt, *`control_sizes`) -> (what of that changes, unfinished, *lengths of the stages), where `retries` counts
        refused steps.
    """
    sizes = {name: value.numel() for name, value in symbolic_state(mechanism, options).items()}
    sizes |= {"diverged": 1, **outputs}
    old, tried = ({name: SX.sym(name, size) for name, size in sizes.items()} for _ in range(2))
    carried = control_sizes(mechanism.robot.layout)
    given = {name: SX.sym(name) for name in (f"tried_{MOVED}", "left", "trying", "refusing", "retries", "dt")}
    given |= {name: SX.sym(name, size) for name, size in carried.items()}
    moved, left, trying, refusing, retries, dt, length, error, change, taken_before, missed, tolerance = given.values()
    given |= {f"tried_{OFF}": SX.sym("off", change.numel() + 1)}
    errors, velocity_error = given[f"tried_{OFF}"][:-1], given[f"tried_{OFF}"][-1]
    changed = errors / (trying * trying)
    off = ca.fmin(ca.norm_inf(errors), HORIZON * trying * ca.norm_inf(changed - change))
    off = ca.fmax(off, velocity_error)

    live, allowed = trying > 0, ALLOWED * tolerance
    sane = ca.logic_and(tried["diverged"] < 0.5, moved <= LARGEST_MOVE)
    good = ca.logic_and(sane, off <= allowed)
    divisible = ca.logic_and(trying > 1.5 * SHORTEST * dt, old["diverged"] < 0.5)
    refused = ca.logic_and(live, ca.logic_and(ca.logic_not(good), divisible))
    taken = ca.logic_and(live, ca.logic_not(refused))

    results = reported(old, tried, outputs, left >= dt, trying / dt)
    after = {name: ca.if_else(taken, value, old[name]) for name, value in results.items()}
    aim = AIM * allowed
    now, before = ca.if_else(sane, off / aim, 1 / SHRINKAGE**4), ca.if_else(error > 0, error / aim, 1)
    new = _proposed(trying, length, now, before, refused, refusing)
    after["step_length"] = ca.if_else(live, ca.fmin(ca.fmax(new, SHORTEST * dt), dt), length)
    after["step_error"] = ca.if_else(taken, off, error)
    after["step_change"] = ca.if_else(taken, changed, change)
    after["steps_taken"] = taken_before + taken
    after["steps_missed"] = missed + ca.logic_and(taken, ca.logic_not(good))
    after["retries"] = retries + refused
    after["refusing"] = refused
    after["left"] = ca.if_else(taken, left - trying, left)
    unfinished = ca.logic_and(live, ca.logic_and(after["left"] > 0, after["diverged"] < 0.5))
    after["trying"] = ca.if_else(unfinished, next_length(after["left"], after["step_length"]), 0)
    given |= old | {f"tried_{name}": value for name, value in tried.items()}
    results = {f"{name}_next": value for name, value in after.items()} | {"unfinished": unfinished}
    return traced("control", given, results | _lengths(after["trying"], fractions))


def next_length(left: SX, length: SX) -> SX:
    """Return the length of the next step [s]: an equal part of what is left, not much longer than proposed."""
    return left / ca.fmax(ca.ceil(left / length - STRETCH), 1)


def _proposed(trying: SX, length: SX, error: SX, before: SX, refused: SX, refusing: SX) -> SX:
    """Return the length that is proposed after a step, given its error and the one before as parts of what is aimed at.

    Right after a refused one no step grows; one that was cut short by the end of its interval does not lower it.
    """
    smallest = 1e-6  # so that powers stay finite
    error, before = ca.fmax(error, smallest), ca.fmax(before, smallest)
    at_once = trying / ca.sqrt(error)
    controlled = trying * ca.exp(BEFORE * ca.log(before) - NOW * ca.log(error))
    controlled = ca.fmin(ca.fmax(controlled, 2 * SHRINKAGE * trying), ca.if_else(refusing, 1, GROWTH) * trying)
    cut_short = ca.if_else(trying < (1 - STRETCH) * length, ca.fmin(at_once, length), 0)
    shorter = ca.fmin(ca.fmax(at_once, SHRINKAGE * trying), trying / 2)
    return ca.if_else(refused, shorter, ca.fmax(controlled, cut_short))


def _lengths(trying: SX, fractions: Mapping[str, float]) -> dict[str, SX]:
    return {f"{stage}_dt": fraction * trying for stage, fraction in fractions.items()}
