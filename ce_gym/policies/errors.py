"""Errors and warnings about policies."""

from __future__ import annotations


class PolicyError(ValueError):
    """A policy that cannot be used; the message is one line for the user."""


class LevelWarning(UserWarning):
    """A policy runs on another transmission level than it was trained on."""
