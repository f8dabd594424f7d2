"""Reward terms: functions of a `TermContext` that return one number.

Names and forms follow the velocity task of legged_gym (Rudin et al. 2022). A term is a rate: a task multiplies the term
by its weight and by the length of the control step.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.terms.context import TermContext


def track_linear_velocity(s: TermContext, width: float = 0.25) -> SX:
    """Follow the commanded horizontal velocity; 1 if exact, 1/e where the squared error is `width` [(m/s)^2]."""
    return ca.exp(-ca.sumsqr(s.command[:2] - s.base_linear_velocity[:2]) / width)


def track_angular_velocity(s: TermContext, width: float = 0.25) -> SX:
    """Follow the commanded yaw rate; 1 if exact, 1/e where the squared error is `width` [(rad/s)^2]."""
    return ca.exp(-((s.command[2] - s.base_angular_velocity[2]) ** 2) / width)


def linear_velocity_error(s: TermContext) -> SX:
    """Squared error of the commanded horizontal velocity [(m/s)^2]."""
    return ca.sumsqr(s.command[:2] - s.base_linear_velocity[:2])


def yaw_rate_error(s: TermContext) -> SX:
    """Squared error of the commanded yaw rate [(rad/s)^2]."""
    return (s.command[2] - s.base_angular_velocity[2]) ** 2


def linear_velocity_z(s: TermContext) -> SX:
    """Squared vertical speed of the base [(m/s)^2]."""
    return s.base_linear_velocity[2] ** 2


def angular_velocity_xy(s: TermContext) -> SX:
    """Sum of squared roll and pitch rates [(rad/s)^2]."""
    return ca.sumsqr(s.base_angular_velocity[:2])


def orientation(s: TermContext) -> SX:
    """Squared sine of the angle of the base to upright."""
    return ca.sumsqr(s.up[:2])


def base_height(s: TermContext) -> SX:
    """Squared distance of the base from its standing height [m^2]."""
    return (s.base_height - s.mechanism.robot.pose.height) ** 2


def torques(s: TermContext) -> SX:
    """Sum of squared motor torques at the joints [(N m)^2]."""
    return ca.sumsqr(s.torque)


def power(s: TermContext) -> SX:
    """Sum over joints of the absolute mechanical power of the motors [W]."""
    return ca.sum1(ca.fabs(s.torque * s.joint_velocities))


def action_rate(s: TermContext) -> SX:
    """Squared change of the action since the previous control step."""
    return ca.sumsqr(s.action - s.previous_action)


def pose(s: TermContext) -> SX:
    """Squared distance of the joints from the standing pose [rad^2]."""
    return ca.sumsqr(s.joint_positions - s.standing_joints)


def stand_still(s: TermContext) -> SX:
    """Distance of the joints from the standing pose while no motion is commanded [rad]."""
    return ca.if_else(s.commanded_to_move, 0, ca.sum1(ca.fabs(s.joint_positions - s.standing_joints)))


def feet_air_time(s: TermContext, least: float = 0.1) -> SX:
    """At each touchdown, time that the foot was in the air minus `least`, while motion is commanded [s]."""
    air_time = ca.dot(s.air_time - least, s.landed) / s.control_dt  # an event, not a rate: the step cancels
    return ca.if_else(s.commanded_to_move, air_time, 0)


def knee_contact(s: TermContext) -> SX:
    """Number of knees on the ground."""
    return ca.sum1(s.touching("knee"))


def joint_limits(s: TermContext, margin: float = 0.05) -> SX:
    """Distance of joints into the outer `margin`, a share of their range, at each end [rad]."""
    total = SX(0)
    for i, name in enumerate(s.mechanism.robot.commanded):
        low, high = s.mechanism.robot.body(name).joint.position
        if np.isfinite(high - low):
            near = margin * (high - low)
            total += ca.fmax(0, low + near - s.joint_positions[i]) + ca.fmax(0, s.joint_positions[i] - high + near)
    return total


def alive(s: TermContext) -> SX:
    """1 in each step of the episode."""
    return SX(1)


def survive(s: TermContext) -> SX:
    """1 in each step of the episode, as in Gymnasium's MuJoCo environments."""
    return SX(1)


def forward(s: TermContext) -> SX:
    """Forward speed of the base in its frame [m/s]."""
    return s.base_linear_velocity[0]


def ctrl(s: TermContext) -> SX:
    """Sum of squared actions."""
    return ca.sumsqr(s.action)


def gait(s: TermContext) -> SX:
    """Number of feet in the contact state that the gait clock requires, minus the number of other feet.

    Every second foot swings in the first half of the cycle, the others in the second half. Without a motion command all
    feet must be on the ground.
    """
    swing = ca.vertcat(*[ca.sin(s.phase + np.pi * i) > 0 for i in range(s.foot_contact.numel())])
    wanted = ca.if_else(s.commanded_to_move, 1 - swing, 1)
    return ca.sum1(1 - 2 * ca.fabs(wanted - s.foot_contact))


def swing_height(s: TermContext, height: float = 0.06, offsets: Sequence[float] = (0.0, 0.5)) -> SX:
    """Sum of squared distances of feet from the heights that the gait clock requires [m^2].

    A foot swings in one half of the cycle, up to `height` [m] and down again. `offsets` are phase leads of the feet as
    shares of the cycle, repeated for further feet. Without a motion command all feet must be on the ground.
    """
    total, moving = SX(0), s.commanded_to_move
    for i in range(s.foot_heights.numel()):
        lift = ca.fmax(0, ca.sin(s.phase + 2 * np.pi * offsets[i % len(offsets)]))
        total += (s.foot_heights[i] - ca.if_else(moving, height * lift, 0)) ** 2
    return total


def feet_distance(s: TermContext, least: float = 0.2) -> SX:
    """Squared shortfall from `least` [m] of the distance from right to left feet along the y axis of the base [m^2].

    Pairs are feet that are more than `least / 2` apart along y in the standing pose. The term keeps legs from crossing
    in scenes without self-collisions.
    """
    total, y_axis = SX(0), s.kinematics.bodies[s.mechanism.robot.bodies[0].name].R[:, 1]
    feet = list(zip(s.foot_places, s.foot_sides, strict=True))
    for (left, y_left), (right, y_right) in itertools.permutations(feet, 2):
        if y_left - y_right > least / 2:
            total += ca.fmax(0, least - ca.dot(y_axis, left - right)) ** 2
    return total


def foot_slip(s: TermContext) -> SX:
    """Sum of squared horizontal speeds of feet on the ground [(m/s)^2]."""
    return ca.dot(s.foot_contact, ca.sum1(s.foot_velocities[:2, :] ** 2).T)


def foot_clearance(s: TermContext, height: float = 0.08) -> SX:
    """Sum over feet of squared distance below `height` [m] times horizontal speed, while motion is commanded."""
    low = ca.fmax(0, height - s.foot_heights) ** 2
    speed = ca.sqrt(ca.sum1(s.foot_velocities[:2, :] ** 2).T + 1e-6)
    return ca.if_else(s.commanded_to_move, ca.sum1(low * speed), 0)


def height(s: TermContext) -> SX:
    """Height of the base above its standing height, in the second half of the gait cycle [m]."""
    return ca.if_else(ca.sin(s.phase) < 0, ca.fmax(0, s.base_height - s.mechanism.robot.pose.height), 0)


def flight(s: TermContext) -> SX:
    """1 if no foot is on the ground."""
    return ca.sum1(s.foot_contact) < 0.5
