"""Observation blocks: functions of a `TermContext` that return a vector of order one.

Scales follow the velocity task of legged_gym.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.terms.context import TermContext


def base_linear_velocity(s: TermContext, scale: float = 2.0) -> SX:
    """Linear velocity of the base in its frame, times `scale`, 2 [m/s], shape (3,)."""
    return scale * s.base_linear_velocity


def base_angular_velocity(s: TermContext, scale: float = 0.25) -> SX:
    """Angular velocity of the base in its frame, times `scale`, 0.25 [rad/s], shape (3,)."""
    return scale * s.base_angular_velocity


def projected_gravity(s: TermContext) -> SX:
    """Direction of gravity in the base frame, shape (3,); (0, 0, -1) if upright."""
    return -s.up


def velocity_command(s: TermContext) -> SX:
    """Commanded forward and sideways velocity times 2 [m/s] and yaw rate times 0.25 [rad/s], shape (3,)."""
    return s.command * np.array([2.0, 2.0, 0.25])


def joint_positions(s: TermContext) -> SX:
    """Joint positions minus the standing pose [rad], shape (n_joints,)."""
    return s.joint_positions - s.standing_joints


def joint_velocities(s: TermContext, scale: float = 0.05) -> SX:
    """Joint velocities, times `scale`, 0.05 [rad/s], shape (n_joints,)."""
    return scale * s.joint_velocities


def ball_rotations(s: TermContext) -> SX:
    """Rotation vector of each ball joint from its standing pose [rad], shape (3 n_balls,)."""
    return s.ball_rotations


def ball_velocities(s: TermContext, scale: float = 0.05) -> SX:
    """Angular velocity of each ball joint, times `scale`, 0.05 [rad/s], shape (3 n_balls,)."""
    return scale * s.ball_velocities


def last_action(s: TermContext) -> SX:
    """Action of this control step, clipped, shape (n_joints,)."""
    return s.action


def feet_in_contact(s: TermContext) -> SX:
    """Whether each foot is on the ground, 0 or 1, shape (n_feet,)."""
    return ca.vertcat(s.foot_contact)


def gait_phase(s: TermContext) -> SX:
    """Sine and cosine of the phase of the gait clock, shape (2,)."""
    return ca.vertcat(ca.sin(s.phase), ca.cos(s.phase))


def base_height(s: TermContext) -> SX:
    """Height of the base above its standing height [m], shape (1,)."""
    return s.base_height - s.mechanism.robot.pose.height


def torques(s: TermContext) -> SX:
    """Motor torques at the joints over the torque limits of the joints [-], shape (n_joints,)."""
    limits = [s.mechanism.robot.body(name).joint.torque for name in s.mechanism.robot.commanded]
    return s.torque / np.array([limit if 0 < limit < np.inf else 100.0 for limit in limits])


def contact_forces(s: TermContext) -> SX:
    """Normal forces on the contacts over the weight of the robot [-], shape (n_contacts,)."""
    weight = -s.mechanism.robot.gravity[2] * s.mechanism.robot.total_mass
    return s.load / (weight if weight > 0 else 1.0)


def rotor_speeds(s: TermContext) -> SX:
    """Speeds of the rotors over 100 rad/s, shape (n_rotors,)."""
    return ca.vertcat(SX(0, 1), *[0.01 * speed for speed in s.rotor_velocities])


def parameters(s: TermContext) -> SX:
    """Randomised parameters of the episode, each scaled to [-1, 1] over its range, shape (n,)."""
    return s.scaled_parameters
