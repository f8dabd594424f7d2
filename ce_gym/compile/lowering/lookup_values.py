"""The surface of `lookup` without its slopes, at many points: two loops over a handful of points at a time.

    place   where the nine entries of a point are, and their weights, in all lanes at once
    sum     lane by lane the three lines of entries, weighed and added, a line being one vector; then all lanes at once

In between they are in memory, from which one instruction loads a lane's weight into all of a vector. Values may differ
from those of `emit_lookup` in their last bits.
"""

from __future__ import annotations

from llvmlite import ir

from ce_gym.compile.arrays import ALIGNMENT
from ce_gym.compile.lowering.lookup import INT, Table, addresses, in_cells, nearest_entry
from ce_gym.compile.lowering.vector import Value, VectorBuilder, loop

CHUNK = 16
"""Points at a time: few enough for what is kept of them to stay in the fastest memory."""


def emit_value_lookup(
    v: VectorBuilder, table: Table, frame: Value, points: Value, output: Value, n_points: int
) -> None:
    """Emit the look-up of values, one vector for each point; arguments as of `emit_lookup`."""
    b, cells = v.builder, in_cells(v, frame)
    starts, weights = _room(v, ir.VectorType(INT, v.lanes), 1), _room(v, v.float_type, 6)
    with loop(b, INT(-(-n_points // CHUNK)), "chunk") as chunk:
        first = b.mul(chunk, INT(CHUNK))
        left = b.sub(INT(n_points), first)
        count = b.select(b.icmp_signed("<", left, INT(CHUNK)), left, INT(CHUNK))
        with loop(b, count, "place") as i:
            x, y = cells(b.gep(points, [b.mul(b.add(first, i), INT(2))]))
            (row, across), (column, along) = _weights(v, x, table.rows), _weights(v, y, table.columns)
            b.store(addresses(v, table, row, column), b.gep(starts, [i]), align=ALIGNMENT)
            for k, weight in enumerate((*across, *along)):
                v.store(weight, b.gep(weights, [b.mul(i, INT(6))]), k)
        with loop(b, count, "sum") as i:
            own = b.gep(weights, [b.mul(i, INT(6))])
            columns = _columns(v, table, b.gep(starts, [i]), own)
            along = [v.load(own, 3 + k) for k in range(3)]
            v.store(_sum(v, along, columns), b.gep(output, [b.add(first, i)]), 0)


def _room(v: VectorBuilder, kind: ir.Type, count: int) -> Value:
    """Memory for so many vectors of each point of a chunk, taken once in the whole function."""
    with v.builder.goto_entry_block():
        room = v.builder.alloca(kind, INT(count * CHUNK))
    room.align = ALIGNMENT
    return room


def _weights(v: VectorBuilder, u: Value, count: Value) -> tuple[Value, tuple[Value, ...]]:
    """First of the three entries that take part at a coordinate in cells, and their weights."""
    half = v.const(0.5)
    first, t, beyond = nearest_entry(v, u, count)
    low, high, twice = v.sub(t, half), v.add(t, half), v.fma(v.const(2.0), beyond, t)
    outer = [v.mul(slope, v.fma(half, slope, beyond)) for slope in (low, high)]
    return first, (outer[0], v.fma(v.neg(t), twice, v.const(0.75)), outer[1])


def _columns(v: VectorBuilder, table: Table, starts: Value, weights: Value) -> list[Value]:
    """Each lane's three columns of entries, the entries of a column weighed and added."""
    b, scalar = v.builder, v.float_type.element
    pitch = b.mul(table.columns, INT(v.bits // 8))
    starts, weights = (b.bitcast(at, kind.as_pointer()) for at, kind in ((starts, INT), (weights, scalar)))
    sums = []
    for lane in range(v.lanes):
        address = b.load(b.gep(starts, [INT(lane)]))
        lines, shares = [], []
        for k in range(3):
            lines.append(v.load_three(address, more=k < 2))  # what follows the third line may not be the table's
            shares.append(v.splat(b.load(b.gep(weights, [INT(k * v.lanes + lane)])), 4))
            address = b.add(address, pitch)
        sums.append(_sum(v, shares, lines))
    return v.spread(sums)


def _sum(v: VectorBuilder, weights: list[Value], values: list[Value]) -> Value:
    """Weighted sum of three, each product but the first added without rounding it."""
    return v.fma(weights[2], values[2], v.fma(weights[1], values[1], v.mul(weights[0], values[0])))
