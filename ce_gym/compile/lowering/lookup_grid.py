"""Look-up of the surface of `lookup` without slopes at the points of a grid, which every lane moves and rotates.

Points are not stored; each is computed from the centre of the grid by two multiply-adds per coordinate. One test per
grid finds out whether all points of all lanes are away from the border, which spares the test of each point.
"""

from __future__ import annotations

from math import hypot

import numpy as np
from llvmlite import ir

from ce_gym.compile.arrays import ALIGNMENT
from ce_gym.compile.lowering.lookup import INT, Table
from ce_gym.compile.lowering.lookup_values import Cells, Room, emit_values
from ce_gym.compile.lowering.vector import Value, VectorBuilder, loop
from ce_gym.compile.program import Grid


def emit_grid_lookup(
    v: VectorBuilder, table: Table, frame: Value, pose: Value, output: Value, n_places: int, grid: Grid
) -> None:
    """Emit the look-up of values, one vector for each point.

    Args:
        v: builder of the block to append to.
        table: see `emit_lookup`.
        frame: see `emit_lookup`.
        pose: pointer to cosine and sine of the angle of all grids, then x and y of the centre of each grid.
        output: pointer to the values, grid after grid.
        n_places: number of grids.
        grid: x and y of the points of the grid.
    """
    b, room, offsets = v.builder, Room.of(v), _offsets(v, grid)
    per_cell = v.div(v.const(1.0), v.load(frame, 2))
    c, s = (v.mul(v.load(pose, i), per_cell) for i in range(2))
    reach = v.mul(v.const(1.001 * max(hypot(*point) for point in grid)), _length(v, c, s))
    with loop(b, INT(n_places), "grid") as number:
        at = b.gep(pose, [b.mul(b.add(number, INT(1)), INT(2))])
        middle = [v.mul(v.sub(v.load(at, i), v.load(frame, i)), per_cell) for i in range(2)]
        there = b.gep(output, [b.mul(number, INT(len(grid)))])
        cells = _turned(v, offsets, middle, c, s)
        with b.if_else(_all_inside(v, table, middle, reach)) as (inside, near_border):
            with inside:
                emit_values(v, table, room, cells, there, len(grid), inside=True)
            with near_border:
                emit_values(v, table, room, cells, there, len(grid))


def _length(v: VectorBuilder, x: Value, y: Value) -> Value:
    return v.intrinsic("sqrt", v.fma(x, x, v.mul(y, y)))


def _turned(v: VectorBuilder, offsets: Value, middle: list[Value], c: Value, s: Value) -> Cells:
    b, back = v.builder, v.neg(s)

    def cells(point: Value) -> list[Value]:
        x, y = (v.splat(b.load(b.gep(offsets, [b.add(b.mul(point, INT(2)), INT(i))]))) for i in range(2))
        return [v.fma(x, c, v.fma(y, back, middle[0])), v.fma(x, s, v.fma(y, c, middle[1]))]

    return cells


def _all_inside(v: VectorBuilder, table: Table, middle: list[Value], reach: Value) -> Value:
    """Return whether all points of all lanes are more than half a cell inside the border; false for NaN."""
    b, flags = v.builder, ir.IntType(v.lanes)
    far = flags(-1)
    for u, count in zip(middle, (table.rows, table.columns), strict=True):
        upper = v.sub(v.splat(b.sitofp(count, v.float_type.element)), v.const(2.0))
        for low, high in ((v.const(1.0), v.sub(u, reach)), (v.add(u, reach), upper)):
            far = b.and_(far, b.bitcast(v.compare("<", low, high), flags))
    return b.icmp_unsigned("==", far, flags(-1))


def _offsets(v: VectorBuilder, grid: Grid) -> Value:
    """Return a pointer to x and y of the points of a grid, which are constants of the module."""
    numbers = [float(np.dtype(v.dtype).type(x)) for point in grid for x in point]
    kind = ir.ArrayType(v.float_type.element, len(numbers))
    name = v.builder.module.get_unique_name("grid")
    held: Value = ir.GlobalVariable(v.builder.module, kind, name)
    held.global_constant, held.linkage, held.align = True, "internal", ALIGNMENT
    held.initializer = ir.Constant(kind, numbers)
    return v.builder.bitcast(held, v.float_type.element.as_pointer())
