"""The ground of a task as data: a field of square tiles, a row of them for each level of difficulty.

Robots start in the middle of a tile. On slopes and stairs that is the top of a pyramid or the bottom of a pit, by turns
from column to column, so that they walk down or up whatever their heading is; tiles meet at height 0. The lowest level
is flat, the highest has the figure that the task says.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.sim.arguments import check, is_number
from ce_gym.sim.terrain import Terrain

FIGURES = {"flat": "", "slope": "angle", "rough": "amplitude", "stairs": "rise"}
"""Kinds of ground, and the figure of each that grows with the level."""

COMMON: dict[str, Any] = {"levels": 6, "columns": 4, "size": 8.0, "cell": 0.1, "curriculum": True}
OWN: dict[str, dict[str, Any]] = {
    "flat": {},
    "slope": {**COMMON, "angle": 0.35},
    "rough": {**COMMON, "amplitude": 0.04, "seed": 0},
    "stairs": {**COMMON, "cell": 0.05, "rise": 0.1, "tread": 0.3},
}
"""Arguments of each kind and what they are if not given; lengths [m], angles [rad]."""

PLATFORM = 1.0
"""Half the side of the level square in the middle of a tile [m]."""
BORDER = 0.5
"""Width of the level rim of a tile [m]."""


def checked_terrain(value: Any) -> dict[str, Any]:
    """Return the ground of a task with all its arguments.

    Args:
        value: A kind, or a mapping with `kind` and other arguments, see `OWN`.

    Raises:
        ValueError: One line that names the argument, its value and what was expected.
    """
    given = {"kind": value} if isinstance(value, str) else dict(value) if isinstance(value, Mapping) else {}
    kind: Any = given.pop("kind", None)
    check("terrain", value, kind in tuple(OWN), f"{', '.join(map(repr, OWN))}, or a mapping with such a `kind`")
    for name, figure in given.items():
        expected = f"one of {', '.join(OWN[kind])}" if OWN[kind] else "no argument"
        check(f"terrain[{name!r}]", figure, name in OWN[kind], f"{expected} for {kind!r}")
        _check(name, figure)
    return {"kind": kind, **OWN[kind], **given}


def _check(name: str, value: Any) -> None:
    number = is_number(value)
    smallest = {"levels": 2, "columns": 2, "size": 2 * (PLATFORM + BORDER) + 1.0, "cell": 0.01, "tread": 0.1, "seed": 0}
    if name == "curriculum":
        valid, expected = isinstance(value, bool), "true or false"
    elif name in ("levels", "columns", "seed"):
        valid, expected = number and isinstance(value, int) and value >= smallest[name], "a whole number"
    elif name == "angle":
        valid, expected = number and 0 <= value <= 1.2, "an angle from 0 to 1.2 rad"
    else:
        valid, expected = number and value >= smallest.get(name, 0.0), "a length in metres"
    least = f", at least {smallest[name]}" if name in smallest else ""
    check(f"terrain[{name!r}]", value, valid, f"{expected}{least}")


def make_field(terrain: Mapping[str, Any]) -> Terrain:
    """Return the field of a task's ground; tile (level, column) has its middle at `(level + 1/2, column + 1/2) size`.

    Args:
        terrain: What `checked_terrain` returns, not flat.

    Raises:
        ValueError: If the field has more heights than a kernel takes.
    """
    levels, columns, size, cell = (terrain[name] for name in ("levels", "columns", "size", "cell"))
    x, y = (cell * np.arange(math.ceil(round(n * size / cell, 6)) + 1) for n in (levels, columns))
    if len(x) * len(y) > 2**24:
        raise ValueError(f"terrain has {len(x) * len(y)} heights; expected at most {2**24}, so a longer `cell`")
    level, column = np.minimum(x // size, levels - 1)[:, None], np.minimum(y // size, columns - 1)[None, :]
    from_middle = np.maximum(np.abs(x[:, None] - (level + 0.5) * size), np.abs(y[None, :] - (column + 0.5) * size))
    difficulty = level / (levels - 1) * np.ones_like(column)
    heights = _heights(terrain, difficulty, np.where(column % 2 == 0, 1.0, -1.0), from_middle)
    return Terrain(np.pad(heights, 1, mode="edge"), cell, (-cell, -cell))


def field_of(terrain: Mapping[str, Any]) -> Terrain | None:
    """Return the field of a task's ground, None if that is flat; `terrain` is what `checked_terrain` returns."""
    return None if terrain["kind"] == "flat" else make_field(terrain)


def _heights(terrain: Mapping[str, Any], difficulty: NDArray, side: NDArray, from_middle: NDArray) -> NDArray:
    """Height of places by the difficulty and side (1 pyramid, -1 pit) of their tile and how far off its middle."""
    if terrain["kind"] == "rough":
        draw = np.random.default_rng(terrain["seed"]).uniform(-1.0, 1.0, from_middle.shape)
        return terrain["amplitude"] * difficulty * draw
    run = np.maximum(terrain["size"] / 2 - BORDER - np.maximum(from_middle, PLATFORM), 0.0)
    if terrain["kind"] == "slope":
        return side * np.tan(terrain["angle"] * difficulty) * run
    return side * terrain["rise"] * difficulty * np.ceil(run / terrain["tread"] - 1e-9)
