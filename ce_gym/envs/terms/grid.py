"""Grids of points on which a robot sees the ground, and what their parameters may be."""

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


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
