"""Drake in the accuracy benchmark, if it is installed."""

from __future__ import annotations

from importlib.util import find_spec

SKIPPED = "Drake: skipped, it is not installed (the extra `drake`; wheels exist for few systems)."


def available() -> bool:
    """Return whether Drake is installed."""
    return find_spec("pydrake") is not None
