"""Metrics: functions of a `TermContext` that are reported as means over each episode, beside rewards."""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.terms.context import TermContext


def forward_speed_error(s: TermContext) -> SX:
    """Absolute error of the commanded forward speed [m/s]."""
    return ca.fabs(s.command[0] - s.base_linear_velocity[0])


def sideways_speed_error(s: TermContext) -> SX:
    """Absolute error of the commanded sideways speed [m/s]."""
    return ca.fabs(s.command[1] - s.base_linear_velocity[1])


def yaw_rate_error(s: TermContext) -> SX:
    """Absolute error of the commanded yaw rate [rad/s]."""
    return ca.fabs(s.command[2] - s.base_angular_velocity[2])


def forward_speed(s: TermContext) -> SX:
    """Forward speed of the base [m/s]."""
    return s.base_linear_velocity[0]


def sideways_speed(s: TermContext) -> SX:
    """Sideways speed of the base, absolute [m/s]."""
    return ca.fabs(s.base_linear_velocity[1])


def tilt_angle(s: TermContext) -> SX:
    """Angle of the base to upright [rad]."""
    return ca.acos(ca.fmin(1, ca.fmax(-1, s.up[2])))


def highest_base(s: TermContext) -> SX:
    """Height of the base above its standing height, where positive [m]."""
    return ca.fmax(0, s.base_height - s.mechanism.robot.pose.height)


def terrain_level(s: TermContext) -> SX:
    """Terrain level of the episode; 0 is the easiest."""
    return s.terrain_level


def times_grown(s: TermContext) -> SX:
    """Growth steps of the command range before the episode."""
    return s.times_grown
