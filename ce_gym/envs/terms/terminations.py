"""Conditions that end an episode as a failure: functions of a `Snapshot` that return 0 or 1. May know snapshots."""

from __future__ import annotations

import math

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.terms.context import Snapshot


def torso_contact(s: Snapshot) -> SX:
    """Any torso sphere touches the ground."""
    return ca.sum1(s.touching("torso")) > 0


def fallen(s: Snapshot) -> SX:
    """The base is lower than 60 % of its standing height."""
    return s.base_height < 0.6 * s.mechanism.robot.pose.height


def tilt(s: Snapshot) -> SX:
    """The base leans by more than 70 degrees."""
    return s.up[2] < math.cos(math.radians(70))
