"""A smooth surface over a table of numbers, looked up at a point in each lane, with its slopes.

The surface is the biquadratic B-spline whose control values are the entries: a point within half a cell of entry (i, j)
is a weighted mean of the nine entries around it, along either axis with the weights

    (1/2 - t)^2 / 2,    3/4 - t^2,    (1/2 + t)^2 / 2,        -1/2 <= t <= 1/2 cells from the entry.

Its slopes are continuous (a bilinear surface has creases), it never leaves the range of the entries around, and it is
the plane itself where they lie on one. Beyond the outermost entries it is extrapolated linearly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from llvmlite import ir

from ce_gym.compile.lowering.vector import Value, VectorBuilder, loop

INT, INDEX = ir.IntType(64), ir.IntType(32)


@dataclass(frozen=True)
class Table:
    """Where a table is.

    Attributes:
        address: of its first entry, 64-bit integer.
        rows, columns: its shape, 64-bit integers.
    """

    address: Value
    rows: Value
    columns: Value


def emit_lookup(v: VectorBuilder, table: Table, frame: Value, points: Value, output: Value, n_points: int) -> None:
    """Emit the look-up at every point of the lanes, as a loop.

    Whatever the coordinates are, NaN included, only entries of the table are read.

    Args:
        v: builder of the block to append to.
        table: at least 3 by 3, of the builder's dtype.
        frame: pointer to three vectors: place (x, y) of the first entry and the length of a cell.
        points: pointer to the vectors x, y of each point.
        output: pointer to the vectors value, slope along x, slope along y of each point.
        n_points: how many there are.
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
    """Return what emits the x and y of the point at a pointer, in cells from the first entry."""
    x0, y0, cell = (v.load(frame, i) for i in range(3))
    per_cell = v.div(v.const(1.0), cell)
    return lambda here: [v.mul(v.sub(v.load(here, i), first), per_cell) for i, first in enumerate((x0, y0))]


@dataclass(frozen=True)
class _Along:
    """One axis: the first of the three entries that take part, their weights, and the slopes of those per cell."""

    first: Value
    weights: tuple[Value, ...]
    slopes: tuple[Value, ...]


def _along(v: VectorBuilder, u: Value, count: Value) -> _Along:
    """Place a coordinate, in cells from the first of `count` entries, between entries."""
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
    """Return the entry before the nearest one, the distance from that, and how far the place is beyond the border."""
    b, half = v.builder, v.const(0.5)
    number = v.splat(b.sitofp(count, v.float_type.element))
    # Both comparisons are false for a NaN, which so becomes a number before it becomes an index.
    inside = v.select(v.compare(">", u, half), u, half)
    upper = v.sub(number, v.const(1.5))
    inside = v.select(v.compare("<", inside, upper), inside, upper)
    nearest, last = v.intrinsic("floor", v.add(inside, half)), v.sub(number, v.const(2.0))
    nearest = v.select(v.compare("<", nearest, last), nearest, last)
    first = b.sub(b.fptosi(nearest, ir.VectorType(INDEX, v.lanes)), v.splat(INDEX(1)))
    return first, v.sub(inside, nearest), v.sub(u, inside)


def _entries(v: VectorBuilder, table: Table, row: Value, column: Value) -> list[list[Value]]:
    """Load three by three entries of each lane, from (row, column) on.

    A line of three at a time, which on many CPUs is faster than their gather instructions.
    """
    b, pitch = v.builder, v.builder.mul(table.columns, INT(v.bits // 8))
    start = addresses(v, table, row, column)
    lines: list[list[Value]] = [[], [], []]
    for lane in map(INDEX, range(v.lanes)):
        address = b.extract_element(start, lane)
        for line in lines:
            line.append(v.load_three(address, more=line is not lines[2]))  # what follows may not be the table's
            address = b.add(address, pitch)
    return [v.spread(line) for line in lines]


def addresses(v: VectorBuilder, table: Table, row: Value, column: Value) -> Value:
    """Return the address of an entry in each lane, 64-bit integers."""
    b = v.builder
    index = b.add(b.mul(row, v.splat(b.trunc(table.columns, INDEX))), column)
    offsets = b.mul(b.sext(index, ir.VectorType(INT, v.lanes)), v.splat(INT(v.bits // 8)))
    return b.add(v.splat(table.address), offsets)


def _sum(v: VectorBuilder, weights: tuple[Value, ...], values: list[Value]) -> Value:
    """Weighted sum of three vectors."""
    products = [v.mul(weight, value) for weight, value in zip(weights, values, strict=True)]
    return v.add(v.add(products[0], products[1]), products[2])
