"""Points over the plane that the ground is nearby: for SX and numpy arrays alike."""

from __future__ import annotations

from typing import Any


def above(z: Any, height: Any, slope_x: Any, slope_y: Any) -> Any:
    """Return the distance of a point from the ground, along its normal [m].

    Args:
        z: Of the point [m].
        height: Of the ground under it [m].
        slope_x: dz/dx there.
        slope_y: dz/dy there.
    """
    return _cosine(slope_x, slope_y) * (z - height)


def lift(distance: Any, z: Any, height: Any, slope_x: Any, slope_y: Any) -> Any:
    """Return how far to raise a point for it to be at a distance from the ground [m]; arguments as for `above`."""
    return distance / _cosine(slope_x, slope_y) - (z - height)


def _cosine(slope_x: Any, slope_y: Any) -> Any:
    return 1 / (1 + (slope_x * slope_x + slope_y * slope_y)) ** 0.5
