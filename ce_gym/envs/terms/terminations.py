"""Conditions that end an episode as a failure: functions of a `TermContext` that return 0 or 1."""

from __future__ import annotations

import math

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.terms.context import TermContext


def torso_contact(s: TermContext) -> SX:
    """Any torso sphere touches the ground."""
    return ca.sum1(s.touching("torso")) > 0


def fallen(s: TermContext, share: float = 0.6) -> SX:
    """The base is lower than a `share` of its standing height."""
    return s.base_height < share * s.mechanism.robot.pose.height


def tilt(s: TermContext, angle: float = math.radians(70)) -> SX:
    """The base leans by more than an `angle` [rad], 70 degrees."""
    return s.up[2] < math.cos(angle)
