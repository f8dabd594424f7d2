"""The ground of a task as data: a field of square tiles with one row for each level of difficulty.

Robots start in the middle of a tile. Tiles of slopes and stairs alternate between pyramids and pits from column to
column, so robots walk down or up in any direction. Tiles meet at height 0. The lowest level is flat, and the highest
level has the parameters of the task.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ce_gym.envs.task.terrain_kinds import BORDER, KINDS, PLATFORM, Tiles
from ce_gym.envs.task.terrain_map import checked_map
from ce_gym.model.arguments import check, is_number
from ce_gym.model.errors import listed_names
from ce_gym.sim.terrain import Terrain
from ce_gym.sim.terrain.files import MOST_HEIGHTS

COMMON: dict[str, Any] = {"levels": 6, "columns": 4, "size": 8.0, "cell": 0.1, "curriculum": True}
FINE = {**COMMON, "cell": 0.05}
DEFAULTS: dict[str, dict[str, Any]] = {
    "flat": {},
    "slope": {**COMMON, "angle": 0.35},
    "rough": {**COMMON, "amplitude": 0.04, "seed": 0},
    "stairs": {**FINE, "rise": 0.1, "tread": 0.3},
    "boxes": {**FINE, "height": 0.1, "side": 0.5, "seed": 0},
    "gaps": {**FINE, "gap": 0.3, "land": 1.0, "depth": 0.5},
    "stones": {**FINE, "gap": 0.15, "stone": 0.4, "depth": 0.5},
    "mixed": {**COMMON, "columns": 8, "kinds": {}},
}
"""Arguments of each kind with their defaults; lengths [m], angles [rad]."""


def checked_terrain(value: Any) -> dict[str, Any]:
    """Return the ground of a task with all its arguments.

    Args:
        value: A kind; a mapping with `kind` and its arguments, see `DEFAULTS`; a mapping with `kinds` for a mixture of
            columns, with a share for each kind or a mapping of `share` and arguments; or a height map, see
            `checked_map`.

    Raises:
        ValueError: An argument is not valid; one line.
    """
    value = {"kind": "map", "field": value} if isinstance(value, Terrain) else value
    arguments = {"kind": value} if isinstance(value, str) else dict(value) if isinstance(value, Mapping) else {}
    kind: Any = arguments.pop("kind", "mixed" if "kinds" in arguments else None)
    known = isinstance(kind, str) and kind in (*DEFAULTS, "map")
    expected = f"{', '.join(map(repr, DEFAULTS))}, a Terrain, or a mapping with such a `kind` or 'map'"
    check("terrain", value, known, expected)
    if kind == "map":
        return checked_map(arguments)
    _check_arguments("terrain", kind, arguments, DEFAULTS[kind])
    if kind != "mixed":
        return {"kind": kind, **DEFAULTS[kind], **arguments}
    kinds = _checked_mixture(arguments.get("kinds"))
    finest = min(DEFAULTS[name].get("cell", COMMON["cell"]) for name in kinds)
    return {"kind": kind, **DEFAULTS[kind], "cell": finest, **arguments, "kinds": kinds}


def _checked_mixture(shares: Any) -> dict[str, dict[str, Any]]:
    """Return the kinds of a mixture, each with its share and all its arguments."""
    known = isinstance(shares, Mapping) and bool(shares) and set(shares) <= set(DEFAULTS) - {"mixed"}
    check("terrain['kinds']", shares, known, f"shares by kind among {', '.join(list(DEFAULTS)[:-1])}")
    kinds = {}
    for name, value in shares.items():
        defaults = {"share": 1.0} | {key: x for key, x in DEFAULTS[name].items() if key not in COMMON}
        chosen = dict(value) if isinstance(value, Mapping) else {"share": value}
        _check_arguments(f"terrain['kinds'][{name!r}]", name, chosen, defaults)
        kinds[name] = defaults | chosen
    return kinds


def _check_arguments(place: str, kind: str, arguments: Mapping[str, Any], known: Mapping[str, Any]) -> None:
    for name, value in arguments.items():
        expected = f"one of {listed_names(name, known)}" if known else "no argument"
        check(f"{place}[{name!r}]", value, name in known, f"{expected} for {kind!r}")
        if name != "kinds":
            _check_argument(f"{place}[{name!r}]", name, value)


def _check_argument(place: str, name: str, value: Any) -> None:
    number = is_number(value)
    smallest = {"levels": 2, "columns": 2, "size": 2 * (PLATFORM + BORDER) + 1.0, "cell": 0.01, "seed": 0}
    smallest |= {"tread": 0.1, "side": 0.1, "land": 0.1, "stone": 0.1}
    if name == "curriculum":
        valid, expected = isinstance(value, bool), "true or false"
    elif name in ("levels", "columns", "seed"):
        valid, expected = number and isinstance(value, int) and value >= smallest[name], "a whole number"
    elif name == "angle":
        valid, expected = number and 0 <= value <= 1.2, "an angle from 0 to 1.2 rad"
    elif name == "share":
        valid, expected = number and value > 0, "a number above 0"
    else:
        valid, expected = number and value >= smallest.get(name, 0.0), "a length in metres"
    least = f", at least {smallest[name]}" if name in smallest else ""
    check(place, value, valid, f"{expected}{least}")


def make_field(terrain: Mapping[str, Any]) -> Terrain:
    """Return the field of a task; the middle of tile (level, column) is at `(level + 1/2, column + 1/2) size`.

    Args:
        terrain: Ground from `checked_terrain`, neither flat nor a map.

    Raises:
        ValueError: The field has more heights than a kernel supports.
    """
    levels, columns, size, cell = (terrain[name] for name in ("levels", "columns", "size", "cell"))
    rows, row = (math.ceil(round(n * size / cell, 6)) + 1 for n in (levels, columns))
    if rows * row > MOST_HEIGHTS:
        raise ValueError(f"terrain has {rows * row} heights; expected at most {MOST_HEIGHTS}, so a longer `cell`")
    x, y = cell * np.arange(rows), cell * np.arange(row)
    level, column = np.minimum(x // size, levels - 1)[:, None], np.minimum(y // size, columns - 1)[None, :].astype(int)
    offset = np.broadcast_arrays(x[:, None] - (level + 0.5) * size, y[None, :] - (column + 0.5) * size)
    difficulty = level / (levels - 1) * np.ones_like(column)
    heights = np.zeros_like(difficulty)
    for kind, parameters, chosen in _columns(terrain):
        order = np.cumsum([number in chosen for number in range(columns)])[column]
        pyramid_or_pit = np.where(order % 2 == 1, 1.0, -1.0)
        tiles = Tiles(size, difficulty, pyramid_or_pit, offset[0], offset[1])
        heights = np.where(np.isin(column, chosen), KINDS[kind](tiles, parameters), heights)
    return Terrain(np.pad(heights, 1, mode="edge"), cell, (-cell, -cell))


def _columns(terrain: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any], list[int]]]:
    """Return each kind of a field with its parameters and its columns, by the method of largest remainders."""
    count = terrain["columns"]
    if terrain["kind"] != "mixed":
        return [(terrain["kind"], terrain, list(range(count)))]
    kinds = terrain["kinds"]
    shares = np.array([parameters["share"] for parameters in kinds.values()])
    exact = count * shares / shares.sum()
    each = np.floor(exact).astype(int)
    each[np.argsort(each - exact, kind="stable")[: count - each.sum()]] += 1
    if not each.all():
        raise ValueError(f"terrain['columns']={count!r}; expected more, for a share of {shares.min():g} to be a column")
    ends = np.cumsum(each).tolist()
    columns = [list(range(end - n, end)) for n, end in zip(each.tolist(), ends, strict=True)]
    return [(name, kinds[name], chosen) for name, chosen in zip(kinds, columns, strict=True)]


def field_of(terrain: Mapping[str, Any]) -> Terrain | None:
    """Return the field of a ground from `checked_terrain`; None if the ground is flat."""
    if terrain["kind"] == "flat":
        return None
    return terrain["field"] if terrain["kind"] == "map" else make_field(terrain)
