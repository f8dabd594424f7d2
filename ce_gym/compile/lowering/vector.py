"""A thin layer over the builder of llvmlite: one value is one vector with a lane for each environment.

llvmlite cannot declare vector intrinsics, so they are declared here by their mangled names.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeAlias

import numpy as np
from llvmlite import ir

from ce_gym.compile.arrays import ALIGNMENT, lane_count

Value: TypeAlias = Any
"""An llvmlite value. The methods of llvmlite's builder have decorators that type checkers cannot follow."""

Builder: TypeAlias = Any
"""An llvmlite IRBuilder, see `Value`."""


class VectorBuilder:
    """Emits instructions on vectors of `lanes` floats of one dtype at the end of one LLVM block.

    No instruction has fast-math flags: LLVM may not fuse, reorder or replace any, and each operation is rounded alone.

    Args:
        builder: the llvmlite builder.
        dtype: `float64` or `float32`.
        parts: number of vectors that hold the lanes of a tile; the builder works on one of them.

    Attributes:
        builder, dtype, parts: see above.
        lanes: elements of a vector.
        bits: width of one float, 64 or 32.
        float_type, int_type: the vector type and the integer vector of the same shape.
    """

    def __init__(self, builder: Builder, dtype: str, parts: int = 1):
        self.builder = builder
        self.dtype = dtype
        self.parts = parts
        self.lanes = lane_count(dtype) // parts
        self.bits = 8 * np.dtype(dtype).itemsize
        scalar = ir.DoubleType() if self.bits == 64 else ir.FloatType()
        self.float_type = ir.VectorType(scalar, self.lanes)
        self.int_type = ir.VectorType(ir.IntType(self.bits), self.lanes)
        self._constants: dict[str, ir.Constant] = {}

    def const(self, number: float) -> ir.Constant:
        """Return the same number in every lane, rounded to the dtype."""
        rounded = float(np.dtype(self.dtype).type(number))
        key = rounded.hex()
        if key not in self._constants:
            self._constants[key] = ir.Constant(self.float_type, [rounded] * self.lanes)
        return self._constants[key]

    def int_const(self, number: int) -> ir.Constant:
        """Return the same integer in every lane."""
        return ir.Constant(self.int_type, [number] * self.lanes)

    def splat(self, scalar: Value, lanes: int = 0) -> Value:
        """Return a run-time number, float or integer, in every lane, or in a vector of `lanes` lanes."""
        vector = ir.VectorType(scalar.type, lanes or self.lanes)
        first = self.builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.IntType(32)(0))
        places = ir.Constant(ir.VectorType(ir.IntType(32), vector.count), [0] * vector.count)
        return self.builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), places)

    def add(self, a: Value, b: Value) -> Value:
        """Sum."""
        return self.builder.fadd(a, b)

    def sub(self, a: Value, b: Value) -> Value:
        """Difference."""
        return self.builder.fsub(a, b)

    def mul(self, a: Value, b: Value) -> Value:
        """Product."""
        return self.builder.fmul(a, b)

    def div(self, a: Value, b: Value) -> Value:
        """Quotient."""
        return self.builder.fdiv(a, b)

    def neg(self, a: Value) -> Value:
        """Sign changed."""
        return self.builder.fneg(a)

    def fma(self, a: Value, b: Value, c: Value) -> Value:
        """`a * b + c`, rounded once."""
        return self.intrinsic("fma", a, b, c)

    def intrinsic(self, name: str, *operands: Value) -> Value:
        """`llvm.<name>` on float vectors, such as sqrt, fabs, floor, minnum, copysign."""
        kind = operands[0].type
        function = self._declared(f"llvm.{name}.v{kind.count}f{self.bits}", kind, [kind] * len(operands))
        return self.builder.call(function, operands)

    def _declared(self, name: str, result: ir.Type, arguments: list[ir.Type]) -> Value:
        """Return an intrinsic, declared once in a module."""
        module = self.builder.module
        known = module.globals.get(name)
        return ir.Function(module, ir.FunctionType(result, arguments), name) if known is None else known

    def polynomial(self, x: Value, coefficients: tuple[float, ...]) -> Value:
        """Return a polynomial by Horner's scheme; coefficients in ascending order."""
        result: Value = self.const(coefficients[-1])
        for coefficient in reversed(coefficients[:-1]):
            result = self.fma(result, x, self.const(coefficient))
        return result

    def compare(self, sign: str, a: Value, b: Value) -> Value:
        """Return a mask; as in C, every comparison with NaN is false except `!=`."""
        if sign == "!=":
            return self.builder.fcmp_unordered(sign, a, b)
        return self.builder.fcmp_ordered(sign, a, b)

    def select(self, mask: Value, a: Value, b: Value) -> Value:
        """Return `a` where the mask is true, else `b`; the value that is not chosen may be NaN."""
        return self.builder.select(mask, a, b)

    def to_bits(self, a: Value) -> Value:
        """Return the bits of a float as an integer."""
        return self.builder.bitcast(a, self.int_type)

    def from_bits(self, a: Value) -> Value:
        """Return the bits of an integer as a float."""
        return self.builder.bitcast(a, self.float_type)

    def is_odd(self, bits: Value) -> Value:
        """Return a mask: whether the lowest bit of an integer is set."""
        return self.builder.trunc(bits, ir.VectorType(ir.IntType(1), self.lanes))

    def load(self, base: Value, index: int) -> Value:
        """Return vector `index` of an aligned buffer that starts at `base`."""
        return self.builder.load(self.element(base, index), align=ALIGNMENT // self.parts)

    def store(self, value: Value, base: Value, index: int) -> None:
        """Write vector `index` of an aligned buffer that starts at `base`."""
        self.builder.store(value, self.element(base, index), align=ALIGNMENT // self.parts)

    def transposed(self, vectors: list[Value]) -> list[Value]:
        """Return as many vectors as there are lanes; vector i holds lane i of each given vector, in their order."""
        vectors, half = list(vectors), self.lanes // 2
        while half:
            upper = [bool(lane & half) for lane in range(self.lanes)]
            low = [self.lanes + lane - half if up else lane for lane, up in enumerate(upper)]
            high = [self.lanes + lane if up else lane + half for lane, up in enumerate(upper)]
            for i in range(self.lanes):
                if not i & half:
                    pair = vectors[i], vectors[i + half]
                    vectors[i], vectors[i + half] = self._shuffled(*pair, low), self._shuffled(*pair, high)
            half //= 2
        return vectors

    def load_three(self, address: Value, *, more: bool = False) -> Value:
        """Return three floats from an address, a 64-bit integer, as a vector of four, for `spread`.

        `more` allows a read of a fourth float, which is faster.
        """
        four, word = ir.VectorType(self.float_type.element, 4), ir.IntType(32)
        pointer, flags = self.builder.inttoptr(address, four.as_pointer()), ir.VectorType(ir.IntType(1), 4)
        if more:
            return self.builder.load(pointer, align=self.bits // 8)
        load = self._declared(f"llvm.masked.load.v4f{self.bits}.p0", four, [pointer.type, word, flags, four])
        nothing = ir.Constant(four, [0.0] * 4)
        return self.builder.call(load, (pointer, word(self.bits // 8), ir.Constant(flags, [1, 1, 1, 0]), nothing))

    def spread(self, threes: list[Value]) -> list[Value]:
        """Return three vectors: lane l of vector i is number i of `threes[l]`, a result of `load_three`."""
        fours = [self._joined(threes[k::4]) for k in range(4)]  # number e of lane k + 4 g is at 4 g + e
        first, second = [(lane // 4) * 4 + lane % 4 // 2 for lane in range(self.lanes)], [0, self.lanes]

        def pairs(a: Value, b: Value, half: int) -> Value:
            """Return (a0 b0 a1 b1), or with the other half (a2 b2 a3 b3), in groups of four."""
            return self._shuffled(a, b, [2 * half + at + second[lane % 2] for lane, at in enumerate(first)])

        spread = []
        for half, odd in ((0, 0), (0, 2), (1, 0)):
            places = [(lane // 4) * 4 + odd + lane % 2 + second[lane % 4 // 2] for lane in range(self.lanes)]
            spread.append(self._shuffled(pairs(fours[0], fours[1], half), pairs(fours[2], fours[3], half), places))
        return spread

    def _joined(self, vectors: list[Value]) -> Value:
        """Return one vector after the other as one vector."""
        while len(vectors) > 1:
            length = vectors[0].type.count
            mask = ir.Constant(ir.VectorType(ir.IntType(32), 2 * length), list(range(2 * length)))
            pairs = zip(vectors[::2], vectors[1::2], strict=True)
            vectors = [self.builder.shuffle_vector(a, b, mask) for a, b in pairs]
        return vectors[0]

    def _shuffled(self, a: Value, b: Value, places: list[int]) -> Value:
        mask = ir.Constant(ir.VectorType(ir.IntType(32), self.lanes), places)
        return self.builder.shuffle_vector(a, b, mask)

    def element(self, base: Value, index: int) -> Value:
        """Return the address of vector `index`."""
        return self.builder.gep(base, [ir.Constant(ir.IntType(64), index * self.parts)], inbounds=True)


@contextmanager
def loop(builder: Builder, count: Value, name: str) -> Iterator[Value]:
    """Emit the code built inside `with` as a loop over 0 <= index < count."""
    word, before = ir.IntType(64), builder.block
    head, body, end = (builder.append_basic_block(f"{name}_{part}") for part in ("head", "body", "end"))
    builder.branch(head)
    builder.position_at_end(head)
    index = builder.phi(word, name)
    index.add_incoming(word(0), before)
    builder.cbranch(builder.icmp_signed("<", index, count), body, end)
    builder.position_at_end(body)
    yield index
    index.add_incoming(builder.add(index, word(1)), builder.block)
    builder.branch(head)
    builder.position_at_end(end)
