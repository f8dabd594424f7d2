"""Look-up of a smooth surface over a table, with slopes, at a point in each lane.

The surface is the biquadratic B-spline whose control values are the entries. Its value at a point within half a cell of
entry (i, j) is a weighted mean of the nine entries around (i, j), with the weights along either axis

    (1/2 - t)^2 / 2,    3/4 - t^2,    (1/2 + t)^2 / 2,        -1/2 <= t <= 1/2 cells from the entry.

Its slopes are continuous; a bilinear surface has creases. Values stay in the range of the nine entries, and planes
are reproduced exactly. Beyond the outermost entries the surface is extrapolated linearly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from llvmlite import ir

from ce_gym.compile.lowering.vector import Value, VectorBuilder, loop

INT, INDEX = ir.IntType(64), ir.IntType(32)


@dataclass(frozen=True)
class Table:
    """Location and shape of a table.

    Attributes:
        address: of the first entry, 64-bit integer.
        rows, columns: shape, 64-bit integers.
    """

    address: Value
    rows: Value
    columns: Value


def emit_lookup(v: VectorBuilder, table: Table, frame: Value, points: Value, output: Value, n_points: int) -> None:
    """Emit a loop that looks up value and slopes at every point of the lanes.

    Only entries of the table are read, whatever the coordinates are, also for NaN.

    Args:
        v: builder of the block to append to.
        table: at least 3 by 3, of the builder's dtype.
        frame: pointer to three vectors: x and y of the first entry, and the cell size.
        points: pointer to the vectors x and y of each point.
        output: pointer to the vectors of value, slope along x and slope along y of each point.
        n_points: number of points.
    """
    b, cells = v.builder, in_cells(v, frame)
    with loop(b, INT(n_points), "point") as point:
        x, y = cells(b.gep(points, [b.mul(point, INT(2))]))
        there = b.gep(output, [b.mul(point, INT(3))])
        rows, columns = _along(v, x, table.rows), _along(v, y, table.columns)
        lines = _entries(v, table, rows.first, columns.first)
        values = [_sum(v, columns.weights, line) for line in lines]
        slopes = [_sum(v, columns.slopes, line) for line in lines]
        per_cell = v.div(v.const(1.0), v.load(frame, 2))
        v.store(_sum(v, rows.weights, values), there, 0)
        v.store(v.mul(_sum(v, rows.slopes, values), per_cell), there, 1)
        v.store(v.mul(_sum(v, rows.weights, slopes), per_cell), there, 2)


def in_cells(v: VectorBuilder, frame: Value) -> Callable[[Value], list[Value]]:
    """Return a function that emits x and y of the point at a pointer, in cells from the first entry."""
    x0, y0, cell = (v.load(frame, i) for i in range(3))
    per_cell = v.div(v.const(1.0), cell)
    return lambda here: [v.mul(v.sub(v.load(here, i), first), per_cell) for i, first in enumerate((x0, y0))]


@dataclass(frozen=True)
class _Along:
    """Interpolation along one axis: the first of three entries, their weights, and slopes of the weights per cell."""

    first: Value
    weights: tuple[Value, ...]
    slopes: tuple[Value, ...]


def _along(v: VectorBuilder, u: Value, count: Value) -> _Along:
    """Return the interpolation at a coordinate, in cells from the first of `count` entries."""
    half = v.const(0.5)
    first, t, beyond = nearest_entry(v, u, count)
    slopes = (v.sub(t, half), v.mul(v.const(-2.0), t), v.add(t, half))
    weights = (
        v.mul(half, v.mul(slopes[0], slopes[0])),
        v.sub(v.const(0.75), v.mul(t, t)),
        v.mul(half, v.mul(slopes[2], slopes[2])),
    )
    straight = tuple(v.add(w, v.mul(slope, beyond)) for w, slope in zip(weights, slopes, strict=True))
    return _Along(first, straight, slopes)


def nearest_entry(v: VectorBuilder, u: Value, count: Value) -> tuple[Value, Value, Value]:
    """Return the entry before the nearest one, the distance from the nearest one and the distance beyond the border."""
    b, half = v.builder, v.const(0.5)
    number = v.splat(b.sitofp(count, v.float_type.element))
    # Both comparisons are false for NaN, so that NaN becomes a number before it is converted to an index.
    inside = v.select(v.compare(">", u, half), u, half)
    upper = v.sub(number, v.const(1.5))
    inside = v.select(v.compare("<", inside, upper), inside, upper)
    nearest, last = v.intrinsic("floor", v.add(inside, half)), v.sub(number, v.const(2.0))
    nearest = v.select(v.compare("<", nearest, last), nearest, last)
    first = b.sub(b.fptosi(nearest, ir.VectorType(INDEX, v.lanes)), v.splat(INDEX(1)))
    return first, v.sub(inside, nearest), v.sub(u, inside)


def _entries(v: VectorBuilder, table: Table, row: Value, column: Value) -> list[list[Value]]:
    """Return three by three entries of each lane, from (row, column) on.

    Each load reads a line of three entries, which on many CPUs is faster than gather instructions.
    """
    b, pitch = v.builder, v.builder.mul(table.columns, INT(v.bits // 8))
    start = addresses(v, table, row, column)
    lines: list[list[Value]] = [[], [], []]
    for lane in map(INDEX, range(v.lanes)):
        address = b.extract_element(start, lane)
        for line in lines:
            line.append(
                v.load_three(address, more=line is not lines[2])
            )  # the fourth entry of the last line may lie outside the table
            address = b.add(address, pitch)
    return [v.spread(line) for line in lines]


def addresses(v: VectorBuilder, table: Table, row: Value, column: Value) -> Value:
    """Return the address of an entry in each lane, 64-bit integers."""
    b = v.builder
    index = b.add(b.mul(row, v.splat(b.trunc(table.columns, INDEX))), column)
    offsets = b.mul(b.sext(index, ir.VectorType(INT, v.lanes)), v.splat(INT(v.bits // 8)))
    return b.add(v.splat(table.address), offsets)


def _sum(v: VectorBuilder, weights: tuple[Value, ...], values: list[Value]) -> Value:
    """Return the weighted sum of three vectors."""
    products = [v.mul(weight, value) for weight, value in zip(weights, values, strict=True)]
    return v.add(v.add(products[0], products[1]), products[2])
