"""Figures to report beside rewards: free functions of a `Snapshot`, averaged over each episode. May know snapshots."""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.spatial import SX
from ce_gym.envs.snapshot import Snapshot


def forward_speed_error(s: Snapshot) -> SX:
    """Absolute error of the commanded forward speed [m/s]."""
    return ca.fabs(s.command[0] - s.base_linear_velocity[0])


def sideways_speed_error(s: Snapshot) -> SX:
    """Absolute error of the commanded sideways speed [m/s]."""
    return ca.fabs(s.command[1] - s.base_linear_velocity[1])


def yaw_rate_error(s: Snapshot) -> SX:
    """Absolute error of the commanded yaw rate [rad/s]."""
    return ca.fabs(s.command[2] - s.base_angular_velocity[2])
