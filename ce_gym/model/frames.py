"""Frames of bodies, as plain numbers in tuples."""

from __future__ import annotations

from dataclasses import dataclass

Vec3 = tuple[float, float, float]
Mat3 = tuple[Vec3, Vec3, Vec3]

IDENTITY: Mat3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
ZERO: Vec3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Placement:
    """Pose of a frame in its parent frame: `x_parent = rotation @ x + position`.

    Attributes:
        position: Origin of the frame in the parent frame [m].
        rotation: Columns are the axes of the frame in the parent frame.
    """

    position: Vec3 = ZERO
    rotation: Mat3 = IDENTITY


ORIGIN = Placement()
"""The pose of a frame that coincides with its parent."""
