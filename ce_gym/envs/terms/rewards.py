"""Reward terms: free functions of a `Snapshot` that return one number, to be weighted by a task.

Names and forms follow the widely used legged_gym velocity task (Rudin et al. 2022), so that scales carry over. A term
is a rate: a task multiplies it by its weight and by the control step. May know snapshots; no robots, no weights.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.terms.context import Snapshot

TRACKING_WIDTH = 0.25
"""Squared error at which a tracking reward has fallen to 1/e [(m/s)^2 or (rad/s)^2]."""


def track_linear_velocity(s: Snapshot) -> SX:
    """Follow the commanded horizontal velocity; 1 if exact."""
    return ca.exp(-ca.sumsqr(s.command[:2] - s.base_linear_velocity[:2]) / TRACKING_WIDTH)


def track_angular_velocity(s: Snapshot) -> SX:
    """Follow the commanded yaw rate; 1 if exact."""
    return ca.exp(-((s.command[2] - s.base_angular_velocity[2]) ** 2) / TRACKING_WIDTH)


def linear_velocity_z(s: Snapshot) -> SX:
    """Vertical speed of the base, squared [(m/s)^2]."""
    return s.base_linear_velocity[2] ** 2


def angular_velocity_xy(s: Snapshot) -> SX:
    """Roll and pitch rates, squared [(rad/s)^2]."""
    return ca.sumsqr(s.base_angular_velocity[:2])


def orientation(s: Snapshot) -> SX:
    """How far the base leans, squared sine of the angle to upright."""
    return ca.sumsqr(s.up[:2])


def base_height(s: Snapshot) -> SX:
    """Distance of the base from its standing height, squared [m^2]."""
    return (s.base_height - s.mechanism.robot.pose.height) ** 2


def torques(s: Snapshot) -> SX:
    """Motor torques at the joints, squared [(N m)^2]."""
    return ca.sumsqr(s.torque)


def power(s: Snapshot) -> SX:
    """Mechanical power of the motors, positive and negative both counted [W]."""
    return ca.sum1(ca.fabs(s.torque * s.joint_velocities))


def action_rate(s: Snapshot) -> SX:
    """Change of the action since the last control step, squared."""
    return ca.sumsqr(s.action - s.previous_action)


def pose(s: Snapshot) -> SX:
    """Distance of the joints from the standing pose, squared [rad^2]."""
    return ca.sumsqr(s.joint_positions - s.standing_joints)


def stand_still(s: Snapshot) -> SX:
    """Distance of the joints from the standing pose while no motion is commanded [rad]."""
    return ca.if_else(s.commanded_to_move, 0, ca.sum1(ca.fabs(s.joint_positions - s.standing_joints)))


def feet_air_time(s: Snapshot) -> SX:
    """At each touchdown, how long the foot was in the air beyond 0.1 s, while motion is commanded [s]."""
    gained = ca.dot(s.air_time - 0.1, s.landed) / s.control_dt  # an event, not a rate: the step cancels
    return ca.if_else(s.commanded_to_move, gained, 0)


def knee_contact(s: Snapshot) -> SX:
    """Number of knees on the ground."""
    return ca.sum1(s.touching("knee"))


def joint_limits(s: Snapshot) -> SX:
    """How far joints are beyond 90 % of their range [rad]."""
    total = SX(0)
    for i, name in enumerate(s.mechanism.robot.independent):
        low, high = s.mechanism.robot.body(name).joint.position
        if np.isfinite(high - low):
            margin = 0.05 * (high - low)
            total += ca.fmax(0, low + margin - s.joint_positions[i]) + ca.fmax(0, s.joint_positions[i] - high + margin)
    return total


def alive(s: Snapshot) -> SX:
    """1 as long as the episode goes on."""
    return SX(1)


def survive(s: Snapshot) -> SX:
    """1 as long as the episode goes on, under the name of Gymnasium's MuJoCo environments."""
    return SX(1)


def forward(s: Snapshot) -> SX:
    """Forward speed of the base in its own heading [m/s]."""
    return s.base_linear_velocity[0]


def ctrl(s: Snapshot) -> SX:
    """Size of the action, squared."""
    return ca.sumsqr(s.action)


def gait(s: Snapshot) -> SX:
    """How many feet are on the ground and off it when the gait's clock wants them, minus those that are not.

    Feet take turns: the first half of the cycle belongs to every second one. While no motion is commanded all stand.
    """
    swing = ca.vertcat(*[ca.sin(s.phase + np.pi * i) > 0 for i in range(s.foot_contact.numel())])
    wanted = ca.if_else(s.commanded_to_move, 1 - swing, 1)
    return ca.sum1(1 - 2 * ca.fabs(wanted - s.foot_contact))


def foot_slip(s: Snapshot) -> SX:
    """Horizontal speeds of feet on the ground, squared [(m/s)^2]."""
    return ca.dot(s.foot_contact, ca.sum1(s.foot_velocities[:2, :] ** 2).T)


def foot_clearance(s: Snapshot) -> SX:
    """How far feet in the air are below 8 cm, times how fast they move, while motion is commanded [m^2/s]."""
    low = ca.fmax(0, 0.08 - s.foot_heights) ** 2
    speed = ca.sqrt(ca.sum1(s.foot_velocities[:2, :] ** 2).T + 1e-6)
    return ca.if_else(s.commanded_to_move, ca.sum1(low * speed), 0)


def height(s: Snapshot) -> SX:
    """How far the base is above its standing height, during the second half of the gait's clock [m]."""
    return ca.if_else(ca.sin(s.phase) < 0, ca.fmax(0, s.base_height - s.mechanism.robot.pose.height), 0)


def flight(s: Snapshot) -> SX:
    """1 if no foot is on the ground."""
    return ca.sum1(s.foot_contact) < 0.5
