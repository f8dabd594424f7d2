"""A piece of a height field around a robot, small enough to be stored and drawn."""

from __future__ import annotations

import base64
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.sim.terrain import Terrain

Array = NDArray[np.float64]

MARGIN = 8.0  # so much of the ground is kept on every side of a path [m]
LEAST_MARGIN = 1.5  # before less than this is kept, heights are taken farther apart [m]
MOST = 1 << 16  # heights of one piece
STEPS = (1 << 16) - 1  # heights are kept as 16-bit shares of the piece's range


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

    The piece has the field's own heights, and those that its straight continuation has beyond its border. If these are
    more than `most`, less is kept on every side; if places are too far apart even so, heights that are farther apart.

    Args:
        terrain: The field.
        places: x and y [m], shape (n, 2).
        margin: How far the piece reaches beyond the places [m].
        most: Number of heights.
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
    """Return rows of heights by number, those outside on the straight line through the two nearest."""
    inside = np.clip(rows, 0, len(heights) - 1)
    beyond = (rows - inside)[:, None]
    slope = np.where(beyond < 0, heights[1] - heights[0], heights[-1] - heights[-2])
    return heights[inside] + beyond * slope


def _coarser(terrain: Terrain, low: Array, high: Array) -> Terrain:
    """Return the surface of a field about a box, by heights that are twice as far apart."""
    cell = 2 * terrain.cell
    first, last = (np.floor((low - 2 * LEAST_MARGIN) / cell), np.ceil((high + 2 * LEAST_MARGIN) / cell))
    x, y = (cell * np.arange(i, j + 1) for i, j in zip(first, last, strict=True))
    return Terrain(terrain.at(x[:, None], y)[..., 0], cell, (float(x[0]), float(y[0])))


def reach(terrain: Terrain, places: ArrayLike) -> float:
    """Return how far a piece of ground goes at least to every side of places [m], shape (n, 2); negative outside."""
    low = np.array(terrain.origin) + terrain.cell / 2
    high = np.array(terrain.origin) + terrain.cell * (np.array(terrain.heights.shape) - 1.5)
    places = np.asarray(places, float)
    return float(min((places.min(0) - low).min(), (high - places.max(0)).min()))


def level(terrain: Terrain | None, places: ArrayLike, radius: float) -> Array:
    """Return the mean height of the ground about places [m], shape (n,): roughness averaged out, slopes kept.

    Args:
        terrain: The ground, None where it is flat.
        places: x and y [m], shape (n, 2).
        radius: Half the edge of the square that is averaged over [m].
    """
    places = np.asarray(places, float)
    if terrain is None:
        return np.zeros(len(places))
    offsets = radius * np.linspace(-1, 1, 5)
    x = places[:, 0, None, None] + offsets[:, None]
    y = places[:, 1, None, None] + offsets
    return terrain.at(x, y)[..., 0].mean((1, 2))


def clear_view(terrain: Terrain | None, target: ArrayLike, eye: ArrayLike, room: float) -> Array:
    """Return where an eye may look at a target from above the ground: as high as is needed, straight above `eye`.

    Args:
        terrain: The ground, None where it is flat.
        target: What is looked at [m], shape (3,).
        eye: Where from [m], shape (3,).
        room: How far above the ground the line of sight is to stay on the half next to the eye [m].
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
    """Return the surface of a field where `ground.js` has it too, at every height and halfway between.

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
