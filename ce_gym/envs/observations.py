"""Observation blocks: free functions of a `Snapshot` that return a vector of order one.

Scales are those of legged_gym's velocity task, so that policies of similar make see similar numbers. May know
snapshots.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ce_gym.dynamics.spatial import SX
from ce_gym.envs.snapshot import Snapshot


def base_linear_velocity(s: Snapshot) -> SX:
    """Base frame, times 2 [m/s], shape (3,)."""
    return 2.0 * s.base_linear_velocity


def base_angular_velocity(s: Snapshot) -> SX:
    """Base frame, times 0.25 [rad/s], shape (3,)."""
    return 0.25 * s.base_angular_velocity


def projected_gravity(s: Snapshot) -> SX:
    """Direction of gravity in the base frame, shape (3,); (0, 0, -1) if upright."""
    return -s.up


def velocity_command(s: Snapshot) -> SX:
    """Commanded forward and sideways velocity times 2 [m/s] and yaw rate times 0.25 [rad/s], shape (3,)."""
    return s.command * np.array([2.0, 2.0, 0.25])


def joint_positions(s: Snapshot) -> SX:
    """Distance from the standing pose [rad], shape (n_joints,)."""
    return s.joint_positions - s.standing_joints


def joint_velocities(s: Snapshot) -> SX:
    """Times 0.05 [rad/s], shape (n_joints,)."""
    return 0.05 * s.joint_velocities


def last_action(s: Snapshot) -> SX:
    """The action just carried out, shape (n_joints,)."""
    return s.action


def feet_in_contact(s: Snapshot) -> SX:
    """Whether each foot is on the ground, 0 or 1, shape (n_feet,)."""
    return ca.vertcat(s.foot_contact)
