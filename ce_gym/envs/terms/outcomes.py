"""Metrics of a whole episode: functions of a `TermContext` that are reported with their value at its end."""

from __future__ import annotations

import math

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.terms.context import TermContext
from ce_gym.envs.terms.skills import aloft, flown, risen, turned_back

STANDING_LEAN, STANDING_HEIGHT_ERROR, STANDING_SPEED = math.radians(20), 0.2, 0.5
"""Largest lean [rad], height error as a share of the standing height, and speed [m/s] of a robot that stands."""


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
    tall = ca.logic_and(s.up[2] > math.cos(STANDING_LEAN), ca.fabs(risen(s)) < STANDING_HEIGHT_ERROR * height)
    return ca.logic_and(tall, ca.sumsqr(s.base_linear_velocity) < STANDING_SPEED**2)


def flipped(s: TermContext) -> SX:
    """1 if the robot stands at the end after one turn backwards, within a tenth of a turn."""
    return ca.logic_and(stands(s), ca.fabs(turned_back(s) / (2 * math.pi) - 1) < 0.1)


def stood_after(s: TermContext) -> SX:
    """Time after which the robot stood without a break until the end [s]."""
    since = ca.if_else(stands(s), s.recall("since"), s.time + s.control_dt)
    s.keep("since", since)
    return since


def flights(s: TermContext) -> SX:
    """Number of flights that have ended; in a flight neither foot nor knee touches the ground."""
    was, count = s.recall("aloft"), s.recall("count")
    now = aloft(s)
    count += ca.logic_and(was > 0.5, ca.logic_not(now))
    s.keep("aloft", now)
    s.keep("count", count)
    return count


def touch_down_pitch(s: TermContext) -> SX:
    """Absolute pitch of the base at the end of its longest flight [rad]; 0 without a flight."""
    now, pitch = aloft(s), s.recall("pitch")
    lasted, longest = s.recall("lasted"), s.recall("longest")
    touched = ca.logic_and(ca.logic_not(now), lasted > longest)
    pitch = ca.if_else(touched, ca.fabs(ca.atan2(s.up[0], s.up[2])), pitch)
    s.keep("pitch", pitch)
    s.keep("longest", ca.if_else(touched, lasted, longest))
    s.keep("lasted", ca.if_else(now, lasted + s.control_dt, 0))
    return pitch


def distance(s: TermContext) -> SX:
    """Distance that the base has travelled along its own heading [m]."""
    travelled = s.recall("way") + s.control_dt * s.base_linear_velocity[0]
    s.keep("way", travelled)
    return travelled


def _greatest(s: TermContext, value: SX) -> SX:
    most = ca.fmax(s.recall("most"), value)
    s.keep("most", most)
    return most
