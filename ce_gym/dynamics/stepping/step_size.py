"""Step-size control: acceptance of a step from its estimated error, and the length of the next step.

Every step is made by Euler's method as a whole and as two halves. Their difference d estimates the error of the halves,
and the result is extrapolated from both. d is in proportion to h^2, where h is the length of the step. Extrapolation
removes this part of the error, so that the remaining error follows from the change of d / h^2.

A step is accepted if the largest d of all positions is within `ALLOWED` times the tolerance. It is also accepted if the
change of d since the last step would reach that bound only after `HORIZON`; in free flight d does not change. Other
steps are rejected and tried again with a shorter length. Contact needs no search for events: a step in which a contact
begins or ends is rejected until it is so short that the landing does not matter. In contact the error of velocities
counts, too, because the flight after a bounce makes it grow, see `step_errors`.

Lengths follow Gustafsson's PI controller (Hairer and Wanner, Solving Ordinary Differential Equations II, IV.2, 1996;
Soederlind, Numerical Algorithms 31, 2002). As in CENIC (Kurtz and Castro 2025, arXiv:2511.08771), the norm is the
largest error of a position, with 1 rad counting as 1 m. Velocities do not count without contact.
"""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.integrators.plan import MOVED, OFF
from ce_gym.dynamics.stepping.halving import LARGEST_MOVE, accumulated
from ce_gym.dynamics.stepping.variables import DT, LEFT, RETRIES, UNFINISHED, StepVariables, Variable
from ce_gym.model.coordinates import Layout

ALLOWED = 0.25
"""Allowed error of one step as a fraction of the tolerance, because errors of steps add up."""
SHORTEST = 2.0**-14
"""Shortest step as a fraction of the interval; it is accepted whatever its error."""
AIM = 0.4
"""Aim for the error of the next step as a fraction of the allowed error, so that few steps are rejected."""
GROWTH, SHRINKAGE = 5.0, 0.1
"""Largest and smallest ratio of the next step to the last one."""
BEFORE, NOW = 0.2, 0.35
"""Exponents of the errors of the previous and of this step: 0.4 / 2 and 0.7 / 2 for an estimate of second order."""
STRETCH = 0.1
"""A step may be longer than proposed by this fraction if that saves a step of the interval."""
HORIZON = 1.0
"""Time in which the change of d may add up to the allowed error [s]."""
TRYING, REFUSING = Variable("trying"), Variable("refusing")
"""Length of the step that is tried [s], 0 for a robot that has finished; whether the step before was rejected."""


def control_sizes(layout: Layout) -> dict[str, int]:
    """Return the sizes of the variables of a controller, by name.

    They are the length to be tried next [s], the estimated error [rad or m] and d / h^2 [rad/s^2 or m/s^2] of the last
    accepted step, the numbers of accepted steps and of those that missed the tolerance, and the tolerance [rad or m].
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
        `control_sizes` without the tolerance, retries, refusing, left, trying, unfinished, lengths of the step and its
        stages). `start` and `tried` are the state and the outputs before and after the step.
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
    """Return the length of the next step [s]: an equal part of the rest of the interval, near the proposed length."""
    return left / ca.fmax(ca.ceil(left / length - STRETCH), 1)


def _proposed(trying: SX, length: SX, error: SX, before: SX, refused: SX, refusing: SX) -> SX:
    """Return the proposed length after a step [s].

    `error` and `before` are the errors of the step and of the previous one, divided by the aimed error. The length does
    not grow right after a rejected step. A step that the end of the interval cut short does not shorten the next one.
    """
    smallest = 1e-6  # so that powers stay finite
    error, before = ca.fmax(error, smallest), ca.fmax(before, smallest)
    at_once = trying / ca.sqrt(error)
    controlled = trying * ca.exp(BEFORE * ca.log(before) - NOW * ca.log(error))
    controlled = ca.fmin(ca.fmax(controlled, 2 * SHRINKAGE * trying), ca.if_else(refusing, 1, GROWTH) * trying)
    cut_short = ca.if_else(trying < (1 - STRETCH) * length, ca.fmin(at_once, length), 0)
    shorter = ca.fmin(ca.fmax(at_once, SHRINKAGE * trying), trying / 2)
    return ca.if_else(refused, shorter, ca.fmax(controlled, cut_short))
