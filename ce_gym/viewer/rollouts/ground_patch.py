"""Pieces of height fields around robots, small enough for files and pages."""

from __future__ import annotations

import base64
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.sim.terrain import Terrain

Array = NDArray[np.float64]

MARGIN = 8.0  # of the piece around a path [m]
LEAST_MARGIN = 1.5  # a smaller margin is avoided by a coarser grid [m]
MOST = 1 << 16  # heights of one piece
STEPS = (1 << 16) - 1  # largest 16-bit number


class Heights(NamedTuple):
    """The heights of a field as whole numbers: `low + step * numbers` [m]."""

    numbers: NDArray[np.uint16]
    low: float
    step: float

    @classmethod
    def of(cls, terrain: Terrain) -> Heights:
        """Return the heights of a field, rounded to 1/65535 of their range."""
        low, high = float(terrain.heights.min()), float(terrain.heights.max())
        step = (high - low) / STEPS
        numbers = np.rint((terrain.heights - low) / (step or 1.0))
        return cls(numbers.astype(np.uint16), low, step)

    def metres(self) -> Array:
        """Return the heights [m]."""
        return self.low + self.step * self.numbers.astype(float)


def around(terrain: Terrain, places: ArrayLike, margin: float = MARGIN, most: int = MOST) -> Terrain:
    """Return the piece of a field around places.

    Beyond the border of the field its slope continues. With more than `most` heights first the margin shrinks, then the
    grid becomes coarser.

    Args:
        terrain: The field.
        places: x and y [m], shape (n, 2).
        margin: Distance from the places to the border of the piece [m].
        most: Largest number of heights.
    """
    places = np.asarray(places, float)
    low, high = places.min(0), places.max(0)
    while True:
        first = np.floor((low - margin - terrain.origin) / terrain.cell).astype(int) - 1
        last = np.ceil((high + margin - terrain.origin) / terrain.cell).astype(int) + 1
        if np.prod((last - first + 1).astype(float)) <= most:
            break
        if margin > LEAST_MARGIN:
            margin = max(0.8 * margin, LEAST_MARGIN)
        else:
            terrain = _coarser(terrain, low, high)
    rows, columns = (np.arange(i, j + 1) for i, j in zip(first, last, strict=True))
    heights = _continued(_continued(terrain.heights, rows).T, columns).T
    x, y = (terrain.origin + first * terrain.cell).tolist()
    return Terrain(heights, terrain.cell, (x, y))


def _continued(heights: Array, rows: NDArray[np.integer[Any]]) -> Array:
    """Return rows of heights by number; rows outside continue the line through the two nearest rows."""
    inside = np.clip(rows, 0, len(heights) - 1)
    beyond = (rows - inside)[:, None]
    slope = np.where(beyond < 0, heights[1] - heights[0], heights[-1] - heights[-2])
    return heights[inside] + beyond * slope


def _coarser(terrain: Terrain, low: Array, high: Array) -> Terrain:
    """Return the surface of a field around a box on a grid with twice the distance."""
    cell = 2 * terrain.cell
    first, last = (np.floor((low - 2 * LEAST_MARGIN) / cell), np.ceil((high + 2 * LEAST_MARGIN) / cell))
    x, y = (cell * np.arange(i, j + 1) for i, j in zip(first, last, strict=True))
    return Terrain(terrain.at(x[:, None], y)[..., 0], cell, (float(x[0]), float(y[0])))


def reach(terrain: Terrain, places: ArrayLike) -> float:
    """Return the smallest distance from places [m], shape (n, 2), to the border of a piece; negative outside [m]."""
    low = np.array(terrain.origin) + terrain.cell / 2
    high = np.array(terrain.origin) + terrain.cell * (np.array(terrain.heights.shape) - 1.5)
    places = np.asarray(places, float)
    return float(min((places.min(0) - low).min(), (high - places.max(0)).min()))


def level(terrain: Terrain | None, places: ArrayLike, radius: float) -> Array:
    """Return the mean height of the ground around places [m], shape (n,).

    Args:
        terrain: The ground; None if flat.
        places: x and y [m], shape (n, 2).
        radius: Half the edge of the averaged square [m].
    """
    places = np.asarray(places, float)
    if terrain is None:
        return np.zeros(len(places))
    offsets = radius * np.linspace(-1, 1, 5)
    x = places[:, 0, None, None] + offsets[:, None]
    y = places[:, 1, None, None] + offsets
    return terrain.at(x, y)[..., 0].mean((1, 2))


def clear_view(terrain: Terrain | None, target: ArrayLike, eye: ArrayLike, room: float) -> Array:
    """Return the eye, raised until the ground does not hide the target, shape (3,).

    Args:
        terrain: The ground; None if flat.
        target: Target of the camera [m], shape (3,).
        eye: Place of the camera [m], shape (3,).
        room: Least height of the line of sight above the ground, on the half next to the eye [m].
    """
    target, eye = np.array(target, float), np.array(eye, float)
    if terrain is None:
        return eye
    share = np.linspace(0.5, 1.0, 12)
    x, y = target[:2, None] + (eye - target)[:2, None] * share
    needed = target[2] + (terrain.at(x, y)[:, 0] + room - target[2]) / share
    eye[2] = max(eye[2], float(needed.max()))
    return eye


def surface(terrain: Terrain) -> tuple[Array, Array, Array]:
    """Return the surface of a field at the vertices of `ground.js`: at every height and halfway between.

    Returns:
        x [m], shape (n,), y [m], shape (m,), heights and slopes there, shape (n, m, 3).
    """
    rows, columns = (2 * count - 3 for count in terrain.heights.shape)
    x = terrain.origin[0] + terrain.cell / 2 * (1 + np.arange(rows))
    y = terrain.origin[1] + terrain.cell / 2 * (1 + np.arange(columns))
    return x, y, terrain.at(x[:, None], y)


def as_json(terrain: Terrain) -> dict[str, Any]:
    """Return a piece of ground for `ground.js`: heights as base64 of little-endian 16-bit numbers."""
    numbers, low, step = Heights.of(terrain)
    rows, columns = numbers.shape
    text = base64.b64encode(numbers.astype("<u2").tobytes()).decode()
    shape = {"rows": rows, "columns": columns, "cell": terrain.cell, "origin": list(terrain.origin)}
    return {**shape, "low": low, "step": step, "heights": text}
