"""Drake's side of the accuracy benchmark, where Drake is installed."""

from __future__ import annotations

from importlib.util import find_spec

SKIPPED = "Drake: skipped, it is not installed (pip install drake; wheels exist for Linux and macOS)."


def available() -> bool:
    """Return whether Drake is installed."""
    return find_spec("pydrake") is not None
