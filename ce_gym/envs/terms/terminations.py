"""Conditions that end an episode as a failure: functions of a `TermContext` that return 0 or 1."""

from __future__ import annotations

import math

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.terms.context import TermContext
from ce_gym.envs.terms.skills import turned_back


def torso_contact(s: TermContext) -> SX:
    """A contact sphere of the torso touches the ground."""
    return ca.sum1(s.touching("torso")) > 0


def fallen(s: TermContext, share: float = 0.6) -> SX:
    """The base is lower than a `share` of its standing height."""
    return s.base_height < share * s.mechanism.robot.pose.height


def other_foot(s: TermContext, foot: int = 0, grace: float = 0.5) -> SX:
    """A foot other than `foot` is on the ground, after a time of `grace` [s]."""
    others = [s.foot_contact[i] for i in range(s.foot_contact.numel()) if i != foot]
    return ca.logic_and(s.time > grace, ca.sum1(ca.vertcat(SX(0, 1), *others)) > 0)


def turned_too_far(s: TermContext, most: float = 2 * math.pi + 0.8) -> SX:
    """The base has turned backwards about its y axis by more than `most` [rad], one turn and 0.8 rad."""
    return turned_back(s) > most


def tilt(s: TermContext, angle: float = math.radians(70)) -> SX:
    """The base leans by more than an `angle` [rad], 70 degrees."""
    return s.up[2] < math.cos(angle)
