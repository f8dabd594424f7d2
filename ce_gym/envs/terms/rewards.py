"""Reward terms: free functions of a `TermContext` that return one number, to be weighted by a task.

Names and forms follow the widely used legged_gym velocity task (Rudin et al. 2022), so that scales carry over. A term
is a rate: a task multiplies it by its weight and by the control step.
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
    """Difference to the commanded horizontal velocity, squared [(m/s)^2]."""
    return ca.sumsqr(s.command[:2] - s.base_linear_velocity[:2])


def yaw_rate_error(s: TermContext) -> SX:
    """Difference to the commanded yaw rate, squared [(rad/s)^2]."""
    return (s.command[2] - s.base_angular_velocity[2]) ** 2


def linear_velocity_z(s: TermContext) -> SX:
    """Vertical speed of the base, squared [(m/s)^2]."""
    return s.base_linear_velocity[2] ** 2


def angular_velocity_xy(s: TermContext) -> SX:
    """Roll and pitch rates, squared [(rad/s)^2]."""
    return ca.sumsqr(s.base_angular_velocity[:2])


def orientation(s: TermContext) -> SX:
    """How far the base leans, squared sine of the angle to upright."""
    return ca.sumsqr(s.up[:2])


def base_height(s: TermContext) -> SX:
    """Distance of the base from its standing height, squared [m^2]."""
    return (s.base_height - s.mechanism.robot.pose.height) ** 2


def torques(s: TermContext) -> SX:
    """Motor torques at the joints, squared [(N m)^2]."""
    return ca.sumsqr(s.torque)


def power(s: TermContext) -> SX:
    """Mechanical power of the motors, positive and negative both counted [W]."""
    return ca.sum1(ca.fabs(s.torque * s.joint_velocities))


def action_rate(s: TermContext) -> SX:
    """Change of the action since the last control step, squared."""
    return ca.sumsqr(s.action - s.previous_action)


def pose(s: TermContext) -> SX:
    """Distance of the joints from the standing pose, squared [rad^2]."""
    return ca.sumsqr(s.joint_positions - s.standing_joints)


def stand_still(s: TermContext) -> SX:
    """Distance of the joints from the standing pose while no motion is commanded [rad]."""
    return ca.if_else(s.commanded_to_move, 0, ca.sum1(ca.fabs(s.joint_positions - s.standing_joints)))


def feet_air_time(s: TermContext, least: float = 0.1) -> SX:
    """At each touchdown, how long the foot was in the air beyond `least` [s], while motion is commanded [s]."""
    gained = ca.dot(s.air_time - least, s.landed) / s.control_dt  # an event, not a rate: the step cancels
    return ca.if_else(s.commanded_to_move, gained, 0)


def knee_contact(s: TermContext) -> SX:
    """Number of knees on the ground."""
    return ca.sum1(s.touching("knee"))


def joint_limits(s: TermContext, margin: float = 0.05) -> SX:
    """How far joints are nearer to an end of their range than `margin` of its length [rad]."""
    total = SX(0)
    for i, name in enumerate(s.mechanism.robot.commanded):
        low, high = s.mechanism.robot.body(name).joint.position
        if np.isfinite(high - low):
            near = margin * (high - low)
            total += ca.fmax(0, low + near - s.joint_positions[i]) + ca.fmax(0, s.joint_positions[i] - high + near)
    return total


def alive(s: TermContext) -> SX:
    """1 as long as the episode goes on."""
    return SX(1)


def survive(s: TermContext) -> SX:
    """1 as long as the episode goes on, under the name of Gymnasium's MuJoCo environments."""
    return SX(1)


def forward(s: TermContext) -> SX:
    """Forward speed of the base in its own heading [m/s]."""
    return s.base_linear_velocity[0]


def ctrl(s: TermContext) -> SX:
    """Size of the action, squared."""
    return ca.sumsqr(s.action)


def gait(s: TermContext) -> SX:
    """How many feet are on the ground and off it as the gait's clock demands, minus those that are not.

    Feet take turns: the first half of the cycle belongs to every second one. While no motion is commanded all stand.
    """
    swing = ca.vertcat(*[ca.sin(s.phase + np.pi * i) > 0 for i in range(s.foot_contact.numel())])
    wanted = ca.if_else(s.commanded_to_move, 1 - swing, 1)
    return ca.sum1(1 - 2 * ca.fabs(wanted - s.foot_contact))


def swing_height(s: TermContext, height: float = 0.06, offsets: Sequence[float] = (0.0, 0.5)) -> SX:
    """Distances of feet from the heights that the gait's clock demands, squared [m^2].

    A foot swings during half of the cycle, up to `height` [m] and down again; `offsets` are shares of the cycle by
    which feet are ahead, the first one again after the last. While no motion is commanded all stand.
    """
    total, moving = SX(0), s.commanded_to_move
    for i in range(s.foot_heights.numel()):
        lift = ca.fmax(0, ca.sin(s.phase + 2 * np.pi * offsets[i % len(offsets)]))
        total += (s.foot_heights[i] - ca.if_else(moving, height * lift, 0)) ** 2
    return total


def feet_distance(s: TermContext, least: float = 0.2) -> SX:
    """How much less than `least` [m] left feet are to the left of right ones, along the base's y-axis, squared [m^2].

    Left and right are those of the standing pose, where they are further apart than half of it. Keeps legs from
    crossing: links pass through each other unless a scene has self-collisions.
    """
    total, y_axis = SX(0), s.kinematics.bodies[s.mechanism.robot.bodies[0].name].R[:, 1]
    feet = list(zip(s.foot_places, s.foot_sides, strict=True))
    for (left, y_left), (right, y_right) in itertools.permutations(feet, 2):
        if y_left - y_right > least / 2:
            total += ca.fmax(0, least - ca.dot(y_axis, left - right)) ** 2
    return total


def foot_slip(s: TermContext) -> SX:
    """Horizontal speeds of feet on the ground, squared [(m/s)^2]."""
    return ca.dot(s.foot_contact, ca.sum1(s.foot_velocities[:2, :] ** 2).T)


def foot_clearance(s: TermContext, height: float = 0.08) -> SX:
    """How far feet in the air are below `height` [m], squared, times how fast they move, while motion is commanded."""
    low = ca.fmax(0, height - s.foot_heights) ** 2
    speed = ca.sqrt(ca.sum1(s.foot_velocities[:2, :] ** 2).T + 1e-6)
    return ca.if_else(s.commanded_to_move, ca.sum1(low * speed), 0)


def height(s: TermContext) -> SX:
    """How far the base is above its standing height, during the second half of the gait's clock [m]."""
    return ca.if_else(ca.sin(s.phase) < 0, ca.fmax(0, s.base_height - s.mechanism.robot.pose.height), 0)


def flight(s: TermContext) -> SX:
    """1 if no foot is on the ground."""
    return ca.sum1(s.foot_contact) < 0.5
