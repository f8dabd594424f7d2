"""Grids of points and pictures of rays by which a robot sees the ground, and what their parameters may be."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_POINTS = 2000
"""In one scan."""


def grid_points(size: Sequence[float], spacing: float, centre: Sequence[float]) -> NDArray:
    """Return points of a grid about its middle [m], shape (2, n), the second coordinate changing first.

    Raises:
        ValueError: One line that names the parameter, its value and what was expected.
    """
    for name, value, least in (("size", size, 0.0), ("centre", centre, -np.inf)):
        numbers = isinstance(value, Sequence) and len(value) == 2 and all(_number(x) and x >= least for x in value)
        check(name, value, numbers, "two lengths [m]")
    check("spacing", spacing, spacing > 0, "a length above 0 m")
    counts = [int(round(length / spacing, 6)) + 1 for length in size]
    check("size", size, counts[0] * counts[1] <= MOST_POINTS, f"at most {MOST_POINTS} points")
    x, y = (spacing * (np.arange(n) - (n - 1) / 2) + c for n, c in zip(counts, centre, strict=True))
    return np.stack([along.ravel() for along in np.meshgrid(x, y, indexing="ij")])


def check_of(term: str) -> Callable[[str, Any, bool, str], None]:
    """Return what refuses a parameter of a term that is not valid, in one line."""

    def refuse_unless(name: str, value: Any, valid: bool, expected: str) -> None:
        if not valid:
            raise ValueError(f"observation term {term!r}: {name}={value!r}; expected {expected}")

    return refuse_unless


check = check_of("height_scan")


def ray_directions(rays: Sequence[int], view: Sequence[float], pattern: str) -> NDArray:
    """Return unit vectors in the sensor's frame, rows from the top, columns from the left, shape (3, n).

    Raises:
        ValueError: One line that names the parameter, its value and what was expected.
    """
    check = check_of("range_scan")
    whole = isinstance(rays, Sequence) and len(rays) == 2 and all(isinstance(n, int) and n >= 1 for n in rays)
    check("rays", rays, whole, "two whole numbers from 1 on")
    widest = np.pi if pattern == "camera" else 2 * np.pi
    angles = numbers(view, 2) and all(0 <= x < widest + 1e-9 for x in view)
    check("view", view, angles, f"two angles from 0 to {widest:.2f}")
    check("pattern", pattern, pattern in ("lidar", "camera"), "'lidar' or 'camera'")
    if pattern == "camera":
        up, left = (
            np.tan(v / 2) * np.linspace(1, -1, n) if n > 1 else np.zeros(1) for v, n in zip(view, rays, strict=True)
        )
        z, y = (x.ravel() for x in np.meshgrid(up, left, indexing="ij"))
        seen = np.stack([np.ones_like(y), y, z])
        return seen / np.linalg.norm(seen, axis=0)
    up, left = (v / 2 * np.linspace(1, -1, n) if n > 1 else np.zeros(1) for v, n in zip(view, rays, strict=True))
    e, a = (x.ravel() for x in np.meshgrid(up, left, indexing="ij"))
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def turned(rotation: Sequence[float]) -> NDArray:
    """Rotation of roll, pitch and yaw [rad] about the link's fixed axes x, y, z, shape (3, 3)."""
    (a, b, c), (d, e, f) = np.cos(rotation), np.sin(rotation)
    about_x = np.array([[1, 0, 0], [0, a, -d], [0, d, a]])
    about_y = np.array([[b, 0, e], [0, 1, 0], [-e, 0, b]])
    return np.array([[c, -f, 0], [f, c, 0], [0, 0, 1]]) @ about_y @ about_x


def numbers(values: object, count: int) -> bool:
    """Whether values are so many finite numbers."""
    if not isinstance(values, Sequence) or isinstance(values, str) or len(values) != count:
        return False
    return all(isinstance(x, int | float) and not isinstance(x, bool) and np.isfinite(x) for x in values)


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
