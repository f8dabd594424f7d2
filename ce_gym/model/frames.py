"""Frames of bodies, as plain numbers in tuples, rotations by quaternions, and sums with the same bits everywhere."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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


def added(numbers: Iterable[float]) -> float:
    """Return a sum made from left to right: Python's own compensates rounding from 3.12 on, which changes bits."""
    total = 0.0
    for number in numbers:
        total += number
    return total


def rotation_matrix(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrices, shape (..., 3, 3), of unit quaternions (w, x, y, z), shape (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))
