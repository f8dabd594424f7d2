"""What is said of policies that cannot be used, or are used elsewhere than they were trained."""

from __future__ import annotations


class PolicyError(ValueError):
    """A policy that cannot be used; the message is one line for the user."""


class LevelWarning(UserWarning):
    """A policy runs on another transmission level than it was trained on."""
