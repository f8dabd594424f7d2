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

from ce_gym.envs.task.terrain_kinds import BORDER, KINDS, PLATFORM, Tiles
from ce_gym.envs.task.terrain_map import checked_map
from ce_gym.model.errors import listed_names
from ce_gym.sim.arguments import check, is_number
from ce_gym.sim.terrain import Terrain
from ce_gym.sim.terrain.files import MOST_HEIGHTS

COMMON: dict[str, Any] = {"levels": 6, "columns": 4, "size": 8.0, "cell": 0.1, "curriculum": True}
FINE = {**COMMON, "cell": 0.05}
OWN: dict[str, dict[str, Any]] = {
    "flat": {},
    "slope": {**COMMON, "angle": 0.35},
    "rough": {**COMMON, "amplitude": 0.04, "seed": 0},
    "stairs": {**FINE, "rise": 0.1, "tread": 0.3},
    "boxes": {**FINE, "height": 0.1, "side": 0.5, "seed": 0},
    "gaps": {**FINE, "gap": 0.3, "land": 1.0, "depth": 0.5},
    "stones": {**FINE, "gap": 0.15, "stone": 0.4, "depth": 0.5},
    "mixed": {**COMMON, "columns": 8, "kinds": {}},
}
"""Arguments of each kind and what they are if not given; lengths [m], angles [rad]."""


def checked_terrain(value: Any) -> dict[str, Any]:
    """Return the ground of a task with all its arguments.

    Args:
        value: A kind; a mapping with `kind` and other arguments, see `OWN`; one with `kinds`, a mixture of columns: by
            kind its share, or a mapping of `share` and arguments of its own; or a height map, see `checked_map`.

    Raises:
        ValueError: One line that names the argument, its value and what was expected.
    """
    value = {"kind": "map", "field": value} if isinstance(value, Terrain) else value
    given = {"kind": value} if isinstance(value, str) else dict(value) if isinstance(value, Mapping) else {}
    kind: Any = given.pop("kind", "mixed" if "kinds" in given else None)
    known = isinstance(kind, str) and kind in (*OWN, "map")
    check("terrain", value, known, f"{', '.join(map(repr, OWN))}, a Terrain, or a mapping with such a `kind` or 'map'")
    if kind == "map":
        return checked_map(given)
    _check_arguments("terrain", kind, given, OWN[kind])
    if kind != "mixed":
        return {"kind": kind, **OWN[kind], **given}
    kinds = _checked_mixture(given.get("kinds"))
    finest = min(OWN[name].get("cell", COMMON["cell"]) for name in kinds)
    return {"kind": kind, **OWN[kind], "cell": finest, **given, "kinds": kinds}


def _checked_mixture(given: Any) -> dict[str, dict[str, Any]]:
    """Return the kinds of a mixture, each with its share and all arguments of its own."""
    known = isinstance(given, Mapping) and bool(given) and set(given) <= set(OWN) - {"mixed"}
    check("terrain['kinds']", given, known, f"shares by kind among {', '.join(list(OWN)[:-1])}")
    kinds = {}
    for name, value in given.items():
        own = {key: default for key, default in OWN[name].items() if key not in COMMON}
        figures = dict(value) if isinstance(value, Mapping) else {"share": value}
        _check_arguments(f"terrain['kinds'][{name!r}]", name, figures, {"share": 1.0, **own})
        kinds[name] = {"share": 1.0, **own, **figures}
    return kinds


def _check_arguments(place: str, kind: str, given: Mapping[str, Any], known: Mapping[str, Any]) -> None:
    for name, figure in given.items():
        expected = f"one of {listed_names(name, known)}" if known else "no argument"
        check(f"{place}[{name!r}]", figure, name in known, f"{expected} for {kind!r}")
        if name != "kinds":
            _check(f"{place}[{name!r}]", name, figure)


def _check(place: str, name: str, value: Any) -> None:
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
    """Return the field of a task's ground; tile (level, column) has its middle at `(level + 1/2, column + 1/2) size`.

    Args:
        terrain: What `checked_terrain` returns, neither flat nor a map.

    Raises:
        ValueError: If the field has more heights than a kernel takes.
    """
    levels, columns, size, cell = (terrain[name] for name in ("levels", "columns", "size", "cell"))
    x, y = (cell * np.arange(math.ceil(round(n * size / cell, 6)) + 1) for n in (levels, columns))
    if len(x) * len(y) > MOST_HEIGHTS:
        raise ValueError(f"terrain has {len(x) * len(y)} heights; expected at most {MOST_HEIGHTS}, so a longer `cell`")
    level, column = np.minimum(x // size, levels - 1)[:, None], np.minimum(y // size, columns - 1)[None, :].astype(int)
    away = np.broadcast_arrays(x[:, None] - (level + 0.5) * size, y[None, :] - (column + 0.5) * size)
    difficulty = level / (levels - 1) * np.ones_like(column)
    heights = np.zeros_like(difficulty)
    for kind, figures, own in _columns(terrain):
        turn = np.cumsum([number in own for number in range(columns)])[column]  # pyramids and pits by turns
        tiles = Tiles(size, difficulty, np.where(turn % 2 == 1, 1.0, -1.0), away[0], away[1])
        heights = np.where(np.isin(column, own), KINDS[kind](tiles, figures), heights)
    return Terrain(np.pad(heights, 1, mode="edge"), cell, (-cell, -cell))


def _columns(terrain: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any], list[int]]]:
    """Return the kinds of a field, their figures and the columns that are theirs, by largest remainders."""
    count = terrain["columns"]
    if terrain["kind"] != "mixed":
        return [(terrain["kind"], terrain, list(range(count)))]
    kinds = terrain["kinds"]
    shares = np.array([figures["share"] for figures in kinds.values()])
    exact = count * shares / shares.sum()
    each = np.floor(exact).astype(int)
    each[np.argsort(each - exact, kind="stable")[: count - each.sum()]] += 1
    if not each.all():
        raise ValueError(f"terrain['columns']={count!r}; expected more, for a share of {shares.min():g} to be a column")
    ends = np.cumsum(each).tolist()
    owned = [list(range(end - n, end)) for n, end in zip(each.tolist(), ends, strict=True)]
    return [(name, kinds[name], own) for name, own in zip(kinds, owned, strict=True)]


def field_of(terrain: Mapping[str, Any]) -> Terrain | None:
    """Return the field of a task's ground, None if that is flat; `terrain` is what `checked_terrain` returns."""
    if terrain["kind"] == "flat":
        return None
    return terrain["field"] if terrain["kind"] == "map" else make_field(terrain)
