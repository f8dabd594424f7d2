"""Matrix products of small matrices as compiled loops, whose blocks stay in the processor's registers.

For layers of 64 or 128 units, the overhead of frameworks and BLAS libraries takes as long as the multiplications. Sums
have a fixed order with one rounding per step, so that results do not depend on the width of the processor's vectors.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from llvmlite import binding, ir
from numba import njit as numba_njit
from numba import types
from numba.extending import intrinsic

LANES = 16
"""Elements of a vector; processors with narrower vectors use several instructions."""

ROWS, COLUMNS = (8, 2) if binding.get_host_cpu_features().get("avx512f") else (4, 1)
"""Rows and vectors of a block, so that it fits the registers; `LANES` is a multiple of the rows."""

njit = partial(numba_njit, error_model="numpy")
"""Without checks of divisions, as in numpy, so that loops become vector instructions."""


def _make_block(rows: int, columns: int) -> Any:
    """Return a numba function for a block of `c = start + a @ b` in registers, `rows` times `columns` vectors.

    Its arguments are addresses of first elements, distances between rows and between terms of the sum in elements, and
    the number of terms.
    """

    @intrinsic
    def block(_typing, a, row_a, step_a, b, row_b, start, row_start, c, row_c, n):
        def emit(context, builder, _signature, arguments):
            name = f"product_{rows}_{columns}"
            function = builder.module.globals.get(name) or _emit(builder.module, name, rows, columns)
            builder.call(function, arguments)
            return context.get_dummy_value()

        return types.void(*[types.int64] * 10), emit

    return block


def _emit(module, name: str, rows: int, columns: int) -> ir.Function:
    """Return the block as a function of an LLVM module: a loop over the sum, which has at least one term."""
    word, lane = ir.IntType(64), ir.FloatType()
    vector = ir.VectorType(lane, LANES)
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [word] * 10), name)
    function.linkage = "linkonce_odr"
    function.attributes.add("noinline")
    a, row_a, step_a, b, row_b, start, row_start, c, row_c, n = function.args
    fused = f"llvm.fma.v{LANES}f32"
    fma = module.globals.get(fused) or ir.Function(module, ir.FunctionType(vector, [vector] * 3), fused)
    undefined, zeros = ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    entry, body, end = (function.append_basic_block(part) for part in ("entry", "body", "end"))
    builder: Any = ir.IRBuilder(entry)

    def element(base, row, distance, offset):
        index = builder.add(builder.mul(distance, word(row)), offset)
        return builder.gep(builder.inttoptr(base, lane.as_pointer()), [index])

    def address(base, row, distance, j):
        return builder.bitcast(element(base, row, distance, word(j * LANES)), vector.as_pointer())

    def everywhere(scalar):
        return builder.shuffle_vector(builder.insert_element(undefined, scalar, ir.IntType(32)(0)), undefined, zeros)

    places = [(i, j) for i in range(rows) for j in range(columns)]
    first = [builder.load(address(start, i, row_start, j), align=4) for i, j in places]
    builder.branch(body)
    builder.position_at_end(body)
    k, sums = builder.phi(word), [builder.phi(vector) for _ in places]
    below = builder.add(b, builder.mul(builder.mul(k, row_b), word(4)))
    right = [builder.load(address(below, 0, row_b, j), align=4) for j in range(columns)]
    left = [everywhere(builder.load(element(a, i, row_a, builder.mul(k, step_a)))) for i in range(rows)]
    added = [builder.call(fma, [left[i], right[j], sums[p]]) for p, (i, j) in enumerate(places)]
    following = builder.add(k, word(1))
    for phi, old, new in ((k, word(0), following), *zip(sums, first, added, strict=True)):
        phi.add_incoming(old, entry)
        phi.add_incoming(new, body)
    builder.cbranch(builder.icmp_signed("<", following, n), body, end)
    builder.position_at_end(end)
    for p, (i, j) in enumerate(places):
        builder.store(added[p], address(c, i, row_c, j), align=4)
    builder.ret_void()
    return function


_wide, _narrow = _make_block(ROWS, COLUMNS), _make_block(ROWS, 1)


@njit
def product(a, row_a, step_a, b, row_b, start, row_start, c, row_c, m, n, k):
    """Compute `c = start + a @ b` from addresses, shape (m, n) with k terms per sum; n is a multiple of `LANES`.

    Rows are computed `ROWS` at a time, so the arrays need a multiple of `ROWS` rows.
    """
    wide, j = LANES * COLUMNS, 0
    while j < n:
        two, at_b, at_s, at_c = j + wide <= n, b + 4 * j, start + 4 * j, c + 4 * j
        for i in range(0, m, ROWS):
            at_a, s, o = a + 4 * i * row_a, at_s + 4 * i * row_start, at_c + 4 * i * row_c
            if two:
                _wide(at_a, row_a, step_a, at_b, row_b, s, row_start, o, row_c, k)
            else:
                _narrow(at_a, row_a, step_a, at_b, row_b, s, row_start, o, row_c, k)
        j += wide if two else LANES
