"""Grids of points and patterns of rays of the ground sensors, and checks of their parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.arguments import check, is_number

MAX_POINTS = 2000
"""Largest number of points of a grid."""


def grid_points(size: Sequence[float], spacing: float, centre: Sequence[float]) -> NDArray:
    """Return the points of a grid [m], shape (2, n); the second coordinate changes fastest.

    Raises:
        ValueError: A parameter of `height_scan` is not valid; one line.
    """
    for name, value, least in (("size", size, 0.0), ("centre", centre, -np.inf)):
        check_term("height_scan", name, value, are_numbers(value, 2) and min(value) >= least, "two lengths [m]")
    check_term("height_scan", "spacing", spacing, spacing > 0, "a length above 0 m")
    counts = [int(round(length / spacing, 6)) + 1 for length in size]
    check_term("height_scan", "size", size, counts[0] * counts[1] <= MAX_POINTS, f"at most {MAX_POINTS} points")
    x, y = (spacing * (np.arange(n) - (n - 1) / 2) + c for n, c in zip(counts, centre, strict=True))
    return np.stack([along.ravel() for along in np.meshgrid(x, y, indexing="ij")])


def ray_directions(rays: Sequence[int], view: Sequence[float], pattern: str) -> NDArray:
    """Return unit vectors of rays in the sensor's frame, shape (3, n): rows from the top, columns from the left.

    Raises:
        ValueError: A parameter of `range_scan` is not valid; one line.
    """
    whole = isinstance(rays, Sequence) and len(rays) == 2 and all(isinstance(n, int) and n >= 1 for n in rays)
    check_term("range_scan", "rays", rays, whole, "two whole numbers from 1 on")
    widest = np.pi if pattern == "camera" else 2 * np.pi
    angles = are_numbers(view, 2) and all(0 <= x < widest + 1e-9 for x in view)
    check_term("range_scan", "view", view, angles, f"two angles from 0 to {widest:.2f}")
    check_term("range_scan", "pattern", pattern, pattern in ("lidar", "camera"), "'lidar' or 'camera'")
    half = [np.tan(angle / 2) if pattern == "camera" else angle / 2 for angle in view]
    up, left = (h * np.linspace(1, -1, n) if n > 1 else np.zeros(1) for h, n in zip(half, rays, strict=True))
    up, left = (x.ravel() for x in np.meshgrid(up, left, indexing="ij"))
    if pattern == "camera":
        directions = np.stack([np.ones_like(left), left, up])
        return directions / np.linalg.norm(directions, axis=0)
    return np.stack([np.cos(up) * np.cos(left), np.cos(up) * np.sin(left), np.sin(up)])


def rotation_matrix(rotation: Sequence[float]) -> NDArray:
    """Return the rotation by roll, pitch and yaw [rad] about the link's fixed axes x, y, z, shape (3, 3)."""
    (a, b, c), (d, e, f) = np.cos(rotation), np.sin(rotation)
    about_x = np.array([[1, 0, 0], [0, a, -d], [0, d, a]])
    about_y = np.array([[b, 0, e], [0, 1, 0], [-e, 0, b]])
    return np.array([[c, -f, 0], [f, c, 0], [0, 0, 1]]) @ about_y @ about_x


def check_term(term: str, parameter: str, value: Any, valid: bool, expected: str) -> None:
    """Raise a ValueError unless a parameter of an observation term is `valid`."""
    check(f"observation term {term!r}: {parameter}", value, valid, expected)


def are_numbers(values: object, count: int) -> bool:
    """Return whether `values` is a sequence of `count` finite numbers."""
    return isinstance(values, Sequence) and len(values) == count and all(map(is_number, values))
