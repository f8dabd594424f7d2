"""Look-up of the surface of `lookup` without slopes at many points: two loops over a few points at a time.

    place   indices and weights of the nine entries of a point, in all lanes at once
    sum     lane by lane the weighted sum of the three lines of entries, one vector per line; then all lanes at once

Indices and weights are stored between the loops, because one instruction loads the weight of a lane into a whole
vector. The three weights of an axis add up to 1, so two of them are enough, applied to differences from the middle
entry. Values may differ from `emit_lookup` in the last bits. If no point is near the border, the code for borders is
left out, with the same bits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from llvmlite import ir

from ce_gym.compile.arrays import ALIGNMENT
from ce_gym.compile.lowering.lookup import INDEX, INT, Table, in_cells
from ce_gym.compile.lowering.vector import Value, VectorBuilder, loop

CHUNK = 16
"""Points at a time: few enough for their indices and weights to stay in the level-1 cache."""
Cells = Callable[[Value], list[Value]]
"""Emits x and y of a point by its number, in cells from the first entry."""


def emit_value_lookup(
    v: VectorBuilder, table: Table, frame: Value, points: Value, output: Value, n_points: int
) -> None:
    """Emit the look-up of values, one vector for each point; arguments: see `emit_lookup`."""
    cells = in_cells(v, frame)
    room = Room.of(v)
    emit_values(v, table, room, lambda i: cells(v.builder.gep(points, [v.builder.mul(i, INT(2))])), output, n_points)


@dataclass(frozen=True)
class Room:
    """Memory for the points of a chunk: index of the middle one of the nine entries, and four weights."""

    starts: Value
    weights: Value

    @classmethod
    def of(cls, v: VectorBuilder) -> Room:
        """Allocate the memory once in the whole function."""
        with v.builder.goto_entry_block():
            starts = v.builder.alloca(ir.VectorType(INDEX, v.lanes), INT(CHUNK))
            weights = v.builder.alloca(v.float_type, INT(4 * CHUNK))
        starts.align = weights.align = ALIGNMENT
        return cls(starts, weights)


def emit_values(
    v: VectorBuilder, table: Table, room: Room, cells: Cells, output: Value, n_points: int, *, inside: bool = False
) -> None:
    """Emit both loops.

    Args:
        v: builder of the block to append to.
        table: see `emit_lookup`.
        room: memory for a chunk.
        cells: emits the coordinates of the points.
        output: pointer to a vector for each point.
        n_points: number of points.
        inside: whether all points are more than half a cell inside the border.
    """
    b, place = v.builder, _inner if inside else _anywhere
    with loop(b, INT(-(-n_points // CHUNK)), "chunk") as chunk:
        first = b.mul(chunk, INT(CHUNK))
        left = b.sub(INT(n_points), first)
        count = b.select(b.icmp_signed("<", left, INT(CHUNK)), left, INT(CHUNK))
        with loop(b, count, "place") as i:
            x, y = cells(b.add(first, i))
            (row, across), (column, along) = place(v, x, table.rows), place(v, y, table.columns)
            start = b.add(b.mul(row, v.splat(b.trunc(table.columns, INDEX))), column)
            b.store(start, b.gep(room.starts, [i]), align=ALIGNMENT // (v.bits // 32))
            for k, weight in enumerate((*across, *along)):
                v.store(weight, b.gep(room.weights, [b.mul(i, INT(4))]), k)
        with loop(b, count, "sum") as i:
            own = b.gep(room.weights, [b.mul(i, INT(4))])
            columns = _columns(v, table, b.gep(room.starts, [i]), own)
            v.store(_mean(v, columns, v.load(own, 2), v.load(own, 3)), b.gep(output, [b.add(first, i)]), 0)


def _inner(v: VectorBuilder, u: Value, count: Value) -> tuple[Value, tuple[Value, Value]]:
    """Return the nearest entry to a coordinate, and the weights of its two neighbours."""
    nearest = v.intrinsic("rint", u)
    t, half = v.sub(u, nearest), v.const(0.5)
    low, high = v.sub(t, half), v.add(t, half)
    return _index(v, nearest), (v.mul(low, v.mul(half, low)), v.mul(high, v.mul(half, high)))


def _anywhere(v: VectorBuilder, u: Value, count: Value) -> tuple[Value, tuple[Value, Value]]:
    """Return the same for any coordinate, extrapolated linearly beyond the border; weights are NaN for NaN."""
    one, half = v.const(1.0), v.const(0.5)
    number = v.splat(v.builder.sitofp(count, v.float_type.element))
    # Both comparisons are false for NaN, so that NaN becomes a number before it is converted to an index.
    inside, upper = v.select(v.compare(">", u, half), u, half), v.sub(number, v.const(1.5))
    inside = v.select(v.compare("<", inside, upper), inside, upper)
    nearest, last = v.intrinsic("rint", inside), v.sub(number, v.const(2.0))
    nearest = v.select(v.compare("<", nearest, last), nearest, last)
    nearest = v.select(v.compare(">", nearest, one), nearest, one)
    t, beyond = v.sub(inside, nearest), v.sub(u, inside)
    low, high = v.sub(t, half), v.add(t, half)
    before, after = (v.mul(slope, v.fma(half, slope, beyond)) for slope in (low, high))
    return _index(v, nearest), (before, after)


def _index(v: VectorBuilder, number: Value) -> Value:
    return v.builder.fptosi(number, ir.VectorType(INDEX, v.lanes))


def _columns(v: VectorBuilder, table: Table, starts: Value, weights: Value) -> list[Value]:
    """Return the weighted means of the three columns of entries of each lane."""
    b, scalar = v.builder, v.float_type.element
    pitch = b.mul(table.columns, INT(v.bits // 8))
    corner = b.sub(
        table.address, b.add(pitch, INT(v.bits // 8))
    )  # first of the nine entries if the middle one is the first of the table
    starts, weights = (b.bitcast(at, kind.as_pointer()) for at, kind in ((starts, INDEX), (weights, scalar)))
    means = []
    for lane in range(v.lanes):
        offset = b.mul(b.sext(b.load(b.gep(starts, [INT(lane)])), INT), INT(v.bits // 8))
        addresses = [b.add(b.add(corner, b.mul(pitch, INT(k))), offset) for k in range(3)]
        lines = [
            v.load_three(addresses[k], more=k < 2) for k in range(3)
        ]  # the fourth entry of the last line may lie outside the table
        before, after = (v.splat(b.load(b.gep(weights, [INT(k * v.lanes + lane)])), 4) for k in range(2))
        means.append(_mean(v, lines, before, after))
    return v.spread(means)


def _mean(v: VectorBuilder, three: list[Value], before: Value, after: Value) -> Value:
    """Return the weighted mean of three vectors."""
    first, middle, last = three
    return v.fma(after, v.sub(last, middle), v.fma(before, v.sub(first, middle), middle))
