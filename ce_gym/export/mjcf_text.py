"""Numbers and rotations as MJCF writes them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def text(x: float | Iterable[float]) -> str:
    """Return numbers as text that reads back to the same bits."""
    return " ".join(repr(float(value)) for value in np.atleast_1d(np.asarray(x, dtype=np.float64)))


def quaternion(rotation: Array) -> Array:
    """Return the unit quaternion (w, x, y, z) of a rotation matrix, shape (4,), with w >= 0.

    The eigenvector of the largest eigenvalue of Bar-Itzhack's symmetric matrix (2000), accurate at every angle.
    """
    r = rotation
    upper = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], 0.0, 0.0, 0.0],
            [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], 0.0, 0.0],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0.0],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    largest = np.linalg.eigh(upper)[1][:, -1]
    return largest if largest[0] >= 0.0 else -largest
