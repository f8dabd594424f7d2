"""Errors and warnings about policies."""

from __future__ import annotations


class PolicyError(ValueError):
    """A policy cannot be used; the message is one line for the user."""


class LevelWarning(UserWarning):
    """A policy runs at another transmission level than in training."""


class RobotWarning(UserWarning):
    """A policy runs on another robot than in training."""
