"""A builder that writes CUDA C, with the methods of `ce_gym.compile.lowering.vector.VectorBuilder`.

`lowering` and `math` emit through either builder, so the order of operations and the polynomials exist once. Every
operation is rounded alone. The compiler must not fuse sums and products, see `nvrtc`; then results have the bits of the
CPU.
"""

from __future__ import annotations

from math import inf, isnan

import numpy as np

WIDTH = {"float64": 64, "float32": 32}
INTEGER = {"add": "+", "sub": "-", "and_": "&", "or_": "|", "xor": "^", "shl": "<<"}
"""Operations on bits, some of them on masks too."""
NAMES = {"minnum": "fmin", "maxnum": "fmax"}
"""Names of functions in LLVM -> in C, where they differ."""


class Term(str):
    """A C expression without side effects: a literal or the name of a constant. Equal texts are equal values.

    Attributes:
        kind: type: `real`, `bits` (unsigned, as wide as a number) or `mask`.
    """

    kind: str

    def __new__(cls, text: str, kind: str = "real") -> Term:
        """Return an expression with a type."""
        term = super().__new__(cls, text)
        term.kind = kind
        return term


class Writer:
    """Writes the statements of one function.

    Attributes:
        dtype: `float64` or `float32`.
        bits: width of a number, 64 or 32.
        float_type: the type of numbers.
        builder: replacement of the builder of LLVM.
        lines: statements so far.
    """

    float_type = "real"

    def __init__(self, dtype: str):
        self.dtype, self.bits = dtype, WIDTH[dtype]
        self.builder = _Instructions(self)
        self.lines: list[str] = []

    def let(self, kind: str, expression: str) -> Term:
        """Assign the value of an expression to a new constant and return its name."""
        name = Term(f"x{len(self.lines)}", kind)
        self.lines.append(f"const {kind} {name} = {expression};")
        return name

    def const(self, number: float) -> Term:
        """Return a number, rounded to the dtype and written without loss."""
        rounded = float(np.dtype(self.dtype).type(number))
        if isnan(rounded):
            return Term("NOT_A_NUMBER")
        if abs(rounded) == inf:
            return Term("INFINITE" if rounded > 0 else "(-INFINITE)")
        text = rounded.hex() + ("f" if self.bits == 32 else "")
        return Term(f"({text})" if text.startswith("-") else text)

    def int_const(self, number: int) -> Term:
        """Return an integer as wide as a number."""
        return Term(f"bits({number % 2**self.bits:#x}ull)", "bits")

    def add(self, a: Term, b: Term) -> Term:
        """Sum."""
        return self.let("real", f"{a} + {b}")

    def sub(self, a: Term, b: Term) -> Term:
        """Difference."""
        return self.let("real", f"{a} - {b}")

    def mul(self, a: Term, b: Term) -> Term:
        """Product."""
        return self.let("real", f"{a} * {b}")

    def div(self, a: Term, b: Term) -> Term:
        """Quotient."""
        return self.let("real", f"{a} / {b}")

    def neg(self, a: Term) -> Term:
        """Sign changed."""
        return self.let("real", f"-{a}")

    def fma(self, a: Term, b: Term, c: Term) -> Term:
        """`a * b + c`, rounded once."""
        return self.intrinsic("fma", a, b, c)

    def intrinsic(self, name: str, *operands: Term) -> Term:
        """Return the value of a C function, such as fma, sqrt, fabs, floor, minnum, copysign."""
        suffix = "" if self.bits == 64 else "f"
        return self.let("real", f"{NAMES.get(name, name)}{suffix}({', '.join(operands)})")

    def polynomial(self, x: Term, coefficients: tuple[float, ...]) -> Term:
        """Return a polynomial by Horner's scheme; coefficients in ascending order."""
        result = self.const(coefficients[-1])
        for coefficient in reversed(coefficients[:-1]):
            result = self.fma(result, x, self.const(coefficient))
        return result

    def compare(self, sign: str, a: Term, b: Term) -> Term:
        """Return a mask; every comparison with NaN is false except `!=`."""
        return self.let("mask", f"{a} {sign} {b}")

    def select(self, mask: Term, a: Term, b: Term) -> Term:
        """Return `a` where the mask is true, else `b`."""
        return self.let(a.kind, f"choose<{a.kind}>({mask}, {a}, {b})")

    def from_limb(self, a: Term, limb: int, count: int) -> Term:
        """Return the value of the thread of another limb of the same robot."""
        return self.let("real", f"from_limb<{count}>({a}, {limb})")

    def to_bits(self, a: Term) -> Term:
        """Return the bits of a number as an integer."""
        return self.let("bits", f"bits({'__double_as_longlong' if self.bits == 64 else '__float_as_int'}({a}))")

    def from_bits(self, a: Term) -> Term:
        """Return the bits of an integer as a number."""
        name = "__longlong_as_double" if self.bits == 64 else "__int_as_float"
        return self.let("real", f"{name}({self.signed(a)})")

    def signed(self, a: Term) -> str:
        """Return an integer as a signed one."""
        return f"(signed_bits){a}"

    def is_odd(self, bits: Term) -> Term:
        """Return a mask: whether the lowest bit of an integer is set."""
        return self.let("mask", f"({bits} & 1) != 0")

    def load(self, base: str, index: int) -> Term:
        """Return the current value `index` of a buffer."""
        return self.let("real", f"{base}[{index}]")

    def store(self, value: Term, base: str, index: int) -> None:
        """Write value `index` of a buffer."""
        self.lines.append(f"{base}[{index}] = {value};")


class _Instructions:
    """Replacement of the builder of LLVM, for instructions that `math` and `lowering` use by name."""

    def __init__(self, writer: Writer):
        self._writer = writer

    def __getattr__(self, name: str):
        w = self._writer
        if name in INTEGER:
            return lambda a, b: w.let(a.kind, f"{a} {INTEGER[name]} {b}")
        raise AttributeError(f"{name!r} has no CUDA form")

    def not_(self, a: Term) -> Term:
        """Return the negation of a mask."""
        return self._writer.let("mask", f"!{a}")

    def ashr(self, a: Term, b: Term) -> Term:
        """Return bits shifted right arithmetically."""
        return self._writer.let("bits", f"bits(({self._writer.signed(a)}) >> {b})")

    def sitofp(self, a: Term, _type: str) -> Term:
        """Return a signed integer as a number."""
        return self._writer.let("real", f"real({self._writer.signed(a)})")

    def icmp_signed(self, sign: str, a: Term, b: Term) -> Term:
        """Return a mask from two signed integers."""
        return self._writer.let("mask", f"({self._writer.signed(a)}) {sign} ({self._writer.signed(b)})")
