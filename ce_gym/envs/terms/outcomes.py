"""Metrics that say how an episode went as a whole: what is reported is the value at its end, not the mean.

Free functions of a `TermContext`, as other metrics.
"""

from __future__ import annotations

import math

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.terms.context import TermContext
from ce_gym.envs.terms.skills import aloft, flown, risen, turned_back

LEAN, NEAR, SLOW = math.radians(20), 0.2, 0.5
"""Who stands leans by less [rad], is off its standing height by a smaller share of it, and moves slower [m/s]."""


def apex(s: TermContext) -> SX:
    """Greatest height of the base above its standing height [m]."""
    return _greatest(s, risen(s))


def longest_flight(s: TermContext) -> SX:
    """Greatest distance of the base over the ground while neither foot nor knee touched it [m]."""
    return _greatest(s, flown(s))


def turn(s: TermContext) -> SX:
    """Turn backwards about the base's y-axis since the start [rad]."""
    return turned_back(s)


def stands(s: TermContext) -> SX:
    """1 if the robot stands at the end: upright within 20 degrees, within 20 % of its height, below 0.5 m/s."""
    height = s.mechanism.robot.pose.height
    tall = ca.logic_and(s.up[2] > math.cos(LEAN), ca.fabs(risen(s)) < NEAR * height)
    return ca.logic_and(tall, ca.sumsqr(s.base_linear_velocity) < SLOW**2)


def flipped(s: TermContext) -> SX:
    """1 if the robot stands at the end after one turn backwards, within a tenth of it."""
    return ca.logic_and(stands(s), ca.fabs(turned_back(s) / (2 * math.pi) - 1) < 0.1)


def stood_after(s: TermContext) -> SX:
    """Time from which on the robot stood without a break until the end [s]."""
    since = ca.if_else(stands(s), s.recall("since"), s.time + s.control_dt)
    s.keep("since", since)
    return since


def flights(s: TermContext) -> SX:
    """How often the robot has come down again after neither foot nor knee touched the ground."""
    was, count = s.recall("aloft"), s.recall("count")
    now = aloft(s)
    count += ca.logic_and(was > 0.5, ca.logic_not(now))
    s.keep("aloft", now)
    s.keep("count", count)
    return count


def touch_down_pitch(s: TermContext) -> SX:
    """How far the base was pitched from level, either way, where its longest flight ended [rad]; 0 without a flight."""
    now, pitch = aloft(s), s.recall("pitch")
    lasted, longest = s.recall("lasted"), s.recall("longest")
    touched = ca.logic_and(ca.logic_not(now), lasted > longest)
    pitch = ca.if_else(touched, ca.fabs(ca.atan2(s.up[0], s.up[2])), pitch)
    s.keep("pitch", pitch)
    s.keep("longest", ca.if_else(touched, lasted, longest))
    s.keep("lasted", ca.if_else(now, lasted + s.control_dt, 0))
    return pitch


def distance(s: TermContext) -> SX:
    """Way of the base over the ground, turns included, in the direction in which it points [m]."""
    way = s.recall("way") + s.control_dt * s.base_linear_velocity[0]
    s.keep("way", way)
    return way


def _greatest(s: TermContext, value: SX) -> SX:
    most = ca.fmax(s.recall("most"), value)
    s.keep("most", most)
    return most
