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

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.stepping.halving import LARGEST_MOVE, accumulated
from ce_gym.dynamics.integrators.plan import MOVED, OFF
from ce_gym.dynamics.stepping.variables import DT, LEFT, RETRIES, UNFINISHED, StepVariables, Variable
from ce_gym.model.coordinates import Layout

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
TRYING, REFUSING = Variable("trying"), Variable("refusing")
"""Length of the step that is tried [s], 0 for a robot that has finished; whether the step before was rejected."""


def control_sizes(layout: Layout) -> dict[str, int]:
    """Return sizes of what a robot carries besides its state.

    The length to be tried next [s]; of the last step taken the estimated error [rad or m] and d / h^2, see above
    [rad/s^2 or m/s^2]; how many were taken and how many of those missed the tolerance; and that [rad or m].
    """
    names = ("step_length", "step_error", "step_change", "steps_taken", "steps_missed", "tolerance")
    return dict.fromkeys(names, 1) | {"step_change": layout.nv}


def begin_function(step: StepVariables) -> ca.Function:
    """Trace the start of an interval.

    Returns:
        Function (dt, step_length) -> (left, trying, refusing, unfinished, lengths of the step and its stages).
    """
    dt, length = DT.symbol(), SX.sym("step_length")
    trying = next_length(dt, length)
    progress = {LEFT.name: dt, TRYING.name: trying, REFUSING.name: SX(0), UNFINISHED.name: SX(1)}
    return traced("begin", {DT.name: dt, "step_length": length}, progress | step.lengths(trying))


def control_function(step: StepVariables, layout: Layout) -> ca.Function:
    """Trace the acceptance or rejection of a step that was tried, and the length of the next one.

    A step is rejected if its error is too large, if the robot diverged or a joint moved too far, unless the step is as
    short as allowed. A robot that has diverged, or diverges in the shortest step, has finished its interval.

    Args:
        step: Variables of the step; the outputs are means over the interval, or belong to its start or end, see
            `plan.py`.
        layout: Of the robot's coordinates.

    Returns:
        Function (tried_moved, left, trying, refusing, retries, dt, `control_sizes`, tried_off, start, tried) -> (start,
        all of `control_sizes` but the tolerance, retries, refusing, left, trying, unfinished, lengths of the step and
        its stages), where `start` and `tried` are the state and the outputs before and after the step.
    """
    old, tried = ({name: x[name].symbol() for name in step.start} for x in (step.start, step.tried))
    variables = (step.tried[MOVED], LEFT, TRYING, REFUSING, RETRIES, DT)
    inputs = {variable.name: variable.symbol() for variable in variables}
    inputs |= {name: SX.sym(name, size) for name, size in control_sizes(layout).items()}
    moved, left, trying, refusing, retries, dt, length, error, change, n_taken, missed, tolerance = inputs.values()
    off = step.tried[OFF].symbol()
    inputs |= {step.tried[OFF].name: off} | step.start.named(old) | step.tried.named(tried)
    errors, velocity_error = off[:-1], off[-1]
    changed = errors / (trying * trying)
    error_now = ca.fmin(ca.norm_inf(errors), HORIZON * trying * ca.norm_inf(changed - change))
    error_now = ca.fmax(error_now, velocity_error)

    live, allowed = trying > 0, ALLOWED * tolerance
    sane = ca.logic_and(tried["diverged"] < 0.5, moved <= LARGEST_MOVE)
    good = ca.logic_and(sane, error_now <= allowed)
    divisible = ca.logic_and(trying > 1.5 * SHORTEST * dt, old["diverged"] < 0.5)
    rejected = ca.logic_and(live, ca.logic_and(ca.logic_not(good), divisible))
    accepted = ca.logic_and(live, ca.logic_not(rejected))

    results = accumulated(old, tried, left >= dt, trying / dt)
    after = {name: ca.if_else(accepted, value, old[name]) for name, value in results.items()}
    aim = AIM * allowed
    now, before = ca.if_else(sane, error_now / aim, 1 / SHRINKAGE**4), ca.if_else(error > 0, error / aim, 1)
    new = _proposed(trying, length, now, before, rejected, refusing)
    length = ca.if_else(live, ca.fmin(ca.fmax(new, SHORTEST * dt), dt), length)
    remaining = ca.if_else(accepted, left - trying, left)
    unfinished = ca.logic_and(live, ca.logic_and(remaining > 0, after["diverged"] < 0.5))
    following = ca.if_else(unfinished, next_length(remaining, length), 0)
    outputs = step.start.named(after) | {
        "step_length": length,
        "step_error": ca.if_else(accepted, error_now, error),
        "step_change": ca.if_else(accepted, changed, change),
        "steps_taken": n_taken + accepted,
        "steps_missed": missed + ca.logic_and(accepted, ca.logic_not(good)),
        RETRIES.name: retries + rejected,
        REFUSING.name: rejected,
        LEFT.name: remaining,
        TRYING.name: following,
        UNFINISHED.name: unfinished,
    }
    return traced("control", inputs, outputs | step.lengths(following))


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
