"""Reward terms of skills: progress that counts once, and standing afterwards.

A `new_...` term rewards growth of the largest value in the episode. Over an episode the rewards sum to that value,
independent of the motion before and after.
"""

from __future__ import annotations

import math

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.terms.context import TermContext


def new_height(s: TermContext, most: float = 10.0) -> SX:
    """Rate of growth of the largest height of the base above its standing height [m/s], up to `most` [m]."""
    return _growth(s, ca.fmin(risen(s), most))


def new_distance(s: TermContext, most: float = 10.0) -> SX:
    """Rate of growth of the horizontal length of the longest flight [m/s], up to `most` [m]."""
    return _growth(s, ca.fmin(flown(s), most))


def new_turn(s: TermContext, most: float = 2 * math.pi) -> SX:
    """Rate of growth of the largest backward rotation about the y axis of the base [rad/s], up to `most` [rad]."""
    return _growth(s, ca.fmin(turned_back(s), most))


def upright(s: TermContext) -> SX:
    """1 if the base is upright, 0 if it lies on its back; linear in the cosine of the lean."""
    return (1 + s.up[2]) / 2


def standing(s: TermContext, begin: float = 0.0, width: float = 0.005) -> SX:
    """From time `begin` [s] on, 1 at rest, upright and at standing height; 0.5 at a squared error of `width` [m^2]."""
    error = risen(s) ** 2 / width + ca.sumsqr(s.base_linear_velocity) + 0.1 * ca.sumsqr(s.base_angular_velocity)
    return ca.if_else(s.time < begin, 0, ca.fmax(0, s.up[2]) ** 2 / (1 + error))


def standing_again(s: TermContext, least: float = 1.6 * math.pi, width: float = 0.005) -> SX:
    """The term `standing`, once the base has turned backwards by at least `least` [rad]."""
    return ca.if_else(turned_back(s) < least, 0, standing(s, width=width))


def swerve(s: TermContext) -> SX:
    """Sum of the squares of sideways speed [m/s] and yaw rate [rad/s] of the base."""
    return s.base_linear_velocity[1] ** 2 + s.base_angular_velocity[2] ** 2


def roll(s: TermContext) -> SX:
    """Squared sine of the sideways lean of the base."""
    return s.up[1] ** 2


def hop(s: TermContext, foot: int = 0) -> SX:
    """1 if one foot is on the ground in the first half of the gait cycle and in the air in the second, else -1."""
    wanted = ca.sin(s.phase) > 0
    return 1 - 2 * ca.fabs(wanted - s.foot_contact[foot])


def risen(s: TermContext) -> SX:
    """Return the height of the base above its standing height [m]."""
    return s.base_height - s.mechanism.robot.pose.height


def aloft(s: TermContext) -> SX:
    """Return 1 if neither a foot nor a knee is on the ground, else 0."""
    return ca.sum1(s.foot_contact) + ca.sum1(s.touching("knee")) < 0.5


def flown(s: TermContext) -> SX:
    """Return the horizontal distance of the base since feet and knees left the ground [m]; uses memory of the term."""
    rotation = s.kinematics.bodies[s.mechanism.robot.bodies[0].name].R
    velocity, ahead = rotation @ s.base_linear_velocity, rotation[:2, 0]
    speed = ca.dot(velocity[:2], ahead) / ca.sqrt(ca.sumsqr(ahead) + 1e-6)
    distance = ca.if_else(aloft(s), s.recall("flown") + s.control_dt * speed, 0)
    s.keep("flown", distance)
    return distance


def turned_back(s: TermContext) -> SX:
    """Return the backward rotation of the base about its y axis since the start [rad]; uses memory of the term."""
    turned = s.recall("turned") - s.control_dt * s.base_angular_velocity[1]
    s.keep("turned", turned)
    return turned


def _growth(s: TermContext, value: SX) -> SX:
    """Return the rate of growth of the largest value in the episode, which starts at 0."""
    most = s.recall("most")
    s.keep("most", ca.fmax(most, value))
    return ca.fmax(0, value - most) / s.control_dt
