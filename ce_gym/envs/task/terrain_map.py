"""A height map as the ground of a task, with the range in which episodes start."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ce_gym.model.arguments import check, is_number
from ce_gym.model.errors import listed_names
from ce_gym.sim.terrain import Terrain

ARGUMENTS = ("field", "file", "cell", "height", "begin")
MARGIN = 1.0
"""Default distance of the starting range from the edge of the map, at most a quarter of its length [m]."""


def checked_map(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ground of a task on a map.

    Args:
        arguments: `field`, a `Terrain`, or `file` with `cell` and `height`, see `Terrain.from_file`; `begin`, the
            ranges of x and y in which episodes start [m].

    Returns:
        `kind`, `field` and `begin`.

    Raises:
        ValueError: An argument is not valid; one line.
    """
    for name, value in arguments.items():
        check(f"terrain[{name!r}]", value, name in ARGUMENTS, f"one of {listed_names(name, ARGUMENTS)} for 'map'")
    field: Any = arguments.get("field")
    file: Any = arguments.get("file")
    exactly_one = (field is None) != (file is None)
    check("terrain", {"kind": "map", **arguments}, exactly_one, "either a `field` or a `file` of a 'map'")
    if field is None:
        check("terrain['file']", file, isinstance(file, str), "a path")
        check("terrain['file']", file, Path(file).is_file(), _where(file))
        field = Terrain.from_file(file, arguments.get("cell", 0.1), arguments.get("height", 1.0))
    check("terrain['field']", field, isinstance(field, Terrain), "a Terrain")
    fits = file is not None or not {"cell", "height"} & arguments.keys()
    check("terrain", {"kind": "map", **arguments}, fits, "`cell` and `height` with a `file` only")
    begin = _inside(field) if arguments.get("begin") is None else arguments["begin"]
    check("terrain['begin']", begin, _are_ranges(begin), "two pairs (low, high), of x and of y [m]")
    for axis, (low, high), (first, last) in zip("xy", begin, _ends(field), strict=True):
        inside = first <= low and high <= last
        check("terrain['begin']", begin, inside, f"{axis} within the map, {first:g} to {last:g} m")
    return {"kind": "map", "field": field, "begin": tuple((float(low), float(high)) for low, high in begin)}


def _where(file: str) -> str:
    """Return the expectation for a file that does not exist: where it was searched, and the remedy."""
    searched = f", looked for in {str(Path.cwd())!r} and beside a policy that names it"
    places = "" if Path(file).is_absolute() else searched
    return f"a file with a height map{places}; copy it there or name another `file`"


def _inside(field: Terrain) -> list[tuple[float, float]]:
    return [(low + min(MARGIN, (high - low) / 4), high - min(MARGIN, (high - low) / 4)) for low, high in _ends(field)]


def _ends(field: Terrain) -> list[tuple[float, float]]:
    """Return the first and last position of the heights of a field, along x and along y [m]."""
    return [(low, low + field.cell * (n - 1)) for low, n in zip(field.origin, field.heights.shape, strict=True)]


def _are_ranges(value: Any) -> bool:
    pairs = isinstance(value, list | tuple) and len(value) == 2
    return pairs and all(_is_range(pair) for pair in value)


def _is_range(pair: Any) -> bool:
    numbers = isinstance(pair, list | tuple) and len(pair) == 2 and all(map(is_number, pair))
    return numbers and pair[0] <= pair[1]
