"""One CasADi SX function as straight-line vector code.

Every operation of the function's `graph` becomes one value, in the order that `ordering` chooses. Loads are emitted at
first use and stores at the very end, so outputs may share their memory with inputs; where they do not, they can be
stored as they come, and are not kept until the end.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence

import casadi

from ce_gym.compile.lowering import math as vector_math
from ce_gym.compile.lowering.graph import FMA, FMS, FNMA, KEPT, SELECT, Graph, graph_of, sources
from ce_gym.compile.lowering.ordering import ordered
from ce_gym.compile.lowering.parted import Part, Parts, parted, versions
from ce_gym.compile.lowering.vector import Value, VectorBuilder


def lower_function(
    v: VectorBuilder,
    function: casadi.Function,
    inputs: Sequence[Value],
    outputs: Sequence[Value],
    apart: bool = False,
    same: frozenset[tuple[int, int]] = frozenset(),
    part: Part | None = None,
) -> None:
    """Emit `function` at the builder's position.

    Args:
        v: builder of the block to append to.
        function: an SX function; sparse inputs and outputs are laid out densely, column by column.
        inputs: pointer to the first vector of each function input.
        outputs: pointer to the first vector of each function output; structural zeros are written as 0.
        apart: whether no output shares memory with an input.
        same: inputs and outputs that share their memory; what is only handed on is not stored again.
        part: which part of it, if not all.

    Raises:
        NotImplementedError: for an operation that has no vector form.
    """
    part = part or Part(graph_of(function), frozenset(range(function.n_out())))
    graph = part.graph
    lowering = _Lowering(v, function.name())
    loads = [_dense_positions(function.sparsity_in(i)) for i in range(function.n_in())]
    places = [_dense_positions(function.sparsity_out(i)) for i in range(function.n_out())]
    results = [[v.const(0.0)] * function.numel_out(i) for i in range(function.n_out())]
    loaded: dict[tuple[int, int], Value] = {}
    values: dict[int, Value] = {}

    def value(k: int) -> Value:
        """Result of instruction k: done already, or an input or a constant met for the first time."""
        if k not in values:
            if k in graph.constants:
                values[k] = lowering.constant(graph.constants[k])
            elif graph.ops[k] == KEPT:
                values[k] = v.load(part.memory, part.places[k])
            else:
                which, nonzero = function.instruction_input(k)
                place = which, loads[which][nonzero]
                if place not in loaded:
                    loaded[place] = v.load(inputs[which], place[1])
                values[k] = loaded[place]
        return values[k]

    def handed_on(which: int, position: int) -> bool:
        """Whether an output is what was loaded from where it would be stored."""
        found = [loaded.get((source, position)) for source, to in same if to == which]
        return any(place is results[which][position] for place in found)

    leave: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for k, op in enumerate(graph.ops):
        if op == casadi.OP_OUTPUT:
            which, nonzero = function.instruction_output(k)
            leave[graph.operands[k][0]].append((which, places[which][nonzero]))
    stored = set[tuple[int, int]]()
    for k in ordered(graph):
        values[k] = lowering.operation(graph.ops[k], [value(a) for a in graph.operands[k]])
        if k in part.keeps:
            v.store(values[k], part.memory, part.places[k])
        for which, position in leave[k] if apart else ():
            v.store(values[k], outputs[which], position)
            stored.add((which, position))
    for k, to in leave.items():
        for which, position in to:
            results[which][position] = value(k)
    for which in sorted(part.leaves):
        pointer = outputs[which]
        for position, result in enumerate(results[which]):
            if (which, position) not in stored and not handed_on(which, position):
                v.store(result, pointer, position)


def parts_of(function: casadi.Function, changing: frozenset[int], choice: int | None = None) -> Parts:
    """Take a function apart, given its inputs that change and its output that is a choice, if one is; see `parted`."""
    graph = graph_of(function)
    return parted(graph, _outputs(function, graph), sources(function, graph, changing), choice)


def versions_of(function: casadi.Function, choice: int) -> tuple[Part, Part, Part]:
    """Return a function's choice, all of it, and what is left where the choice is zero, each by itself."""
    graph = graph_of(function)
    return versions(graph, _outputs(function, graph), choice)


def _outputs(function: casadi.Function, graph: Graph) -> list[set[int]]:
    """Nodes of each output."""
    outputs: list[set[int]] = [set() for _ in range(function.n_out())]
    for k, op in enumerate(graph.ops):
        if op == casadi.OP_OUTPUT:
            outputs[function.instruction_output(k)[0]].add(k)
    return outputs


def _dense_positions(sparsity: casadi.Sparsity) -> list[int]:
    """Column-major position of each structural nonzero."""
    rows, columns = sparsity.get_triplet()
    return [row + column * sparsity.size1() for row, column in zip(rows, columns, strict=True)]


class _Lowering:
    """Emits operations; caches masks, constants and sine-cosine pairs of values already emitted."""

    def __init__(self, v: VectorBuilder, name: str):
        self.v = v
        self.name = name
        self.masks: dict[Value, Value] = {}
        self.numbers: dict[Value, float] = {}
        self.sines: dict[Value, tuple[Value, Value]] = {}

    def constant(self, number: float) -> Value:
        """A constant; its number is kept for `power`."""
        value = self.v.const(number)
        self.numbers[value] = number
        return value

    def operation(self, op: int, operands: Sequence[Value]) -> Value:
        """Emit one operation."""
        if op not in OPERATIONS:
            raise NotImplementedError(
                f"function {self.name!r}: {_name_of(op)} has no vector form; "
                f"expected one of {', '.join(sorted(_name_of(known) for known in OPERATIONS if known >= 0))}"
            )
        return OPERATIONS[op](self, *operands)

    def sin_cos(self, x: Value) -> tuple[Value, Value]:
        """Both at once: the argument is reduced once for all its sines and cosines."""
        if x not in self.sines:
            self.sines[x] = vector_math.sin_cos(self.v, x)
        return self.sines[x]

    def truth(self, mask: Value) -> Value:
        """A mask as CasADi has it, 1.0 or 0.0; the mask itself is kept for `mask`."""
        value = self.v.select(mask, self.v.const(1.0), self.v.const(0.0))
        self.masks[value] = mask
        return value

    def mask(self, value: Value) -> Value:
        """Where a value is not zero."""
        if value not in self.masks:
            self.masks[value] = self.v.compare("!=", value, self.v.const(0.0))
        return self.masks[value]

    def differ(self, a: Value, b: Value) -> Value:
        """Whether two values differ; of two that are masks already, by a bit each."""
        if a in self.masks and b in self.masks:
            return self.truth(self.v.builder.xor(self.masks[a], self.masks[b]))
        return self.truth(self.v.compare("!=", a, b))

    def sign(self, x: Value) -> Value:
        """-1, 1, or x itself where it is neither negative nor positive."""
        v, zero = self.v, self.v.const(0.0)
        positive = v.select(v.compare(">", x, zero), v.const(1.0), x)
        return v.select(v.compare("<", x, zero), v.const(-1.0), positive)

    def power(self, x: Value, y: Value) -> Value:
        """Integer powers by multiplication, halves by the square root, the rest by exp and log."""
        exponent = self.numbers.get(y)
        if exponent is not None and exponent == int(exponent) and abs(exponent) <= 64:
            return vector_math.integer_power(self.v, x, int(exponent))
        if exponent == 0.5:
            return self.v.intrinsic("sqrt", x)
        return vector_math.power(self.v, x, y)


Operation = Callable[..., Value]


def _builder(method: str) -> Operation:
    """An operation that the vector builder has."""
    return lambda s, *operands: getattr(s.v, method)(*operands)


def _intrinsic(name: str) -> Operation:
    """An operation that is one LLVM intrinsic."""
    return lambda s, *operands: s.v.intrinsic(name, *operands)


def _elementary(name: str) -> Operation:
    """An operation from `lowering.math`."""
    return lambda s, *operands: getattr(vector_math, name)(s.v, *operands)


def _comparison(sign: str) -> Operation:
    return lambda s, a, b: s.truth(s.v.compare(sign, a, b))


OPERATIONS: dict[int, Operation] = {
    SELECT: lambda s, c, a, b: s.v.select(s.mask(c), a, b),
    FMA: _builder("fma"),
    FMS: lambda s, a, b, c: s.v.fma(a, b, s.v.neg(c)),
    FNMA: lambda s, a, b, c: s.v.fma(s.v.neg(a), b, c),
    casadi.OP_ASSIGN: lambda s, x: x,
    casadi.OP_ADD: _builder("add"),
    casadi.OP_SUB: _builder("sub"),
    casadi.OP_MUL: _builder("mul"),
    casadi.OP_DIV: _builder("div"),
    casadi.OP_NEG: _builder("neg"),
    casadi.OP_SQ: lambda s, x: s.v.mul(x, x),
    casadi.OP_TWICE: lambda s, x: s.v.add(x, x),
    casadi.OP_INV: lambda s, x: s.v.div(s.v.const(1.0), x),
    casadi.OP_SQRT: _intrinsic("sqrt"),
    casadi.OP_FABS: _intrinsic("fabs"),
    casadi.OP_FLOOR: _intrinsic("floor"),
    casadi.OP_CEIL: _intrinsic("ceil"),
    casadi.OP_FMIN: _intrinsic("minnum"),
    casadi.OP_FMAX: _intrinsic("maxnum"),
    casadi.OP_COPYSIGN: _intrinsic("copysign"),
    casadi.OP_SIGN: _Lowering.sign,
    casadi.OP_SIN: lambda s, x: s.sin_cos(x)[0],
    casadi.OP_COS: lambda s, x: s.sin_cos(x)[1],
    casadi.OP_TAN: _elementary("tan"),
    casadi.OP_ASIN: _elementary("asin"),
    casadi.OP_ACOS: _elementary("acos"),
    casadi.OP_ATAN: _elementary("atan"),
    casadi.OP_ATAN2: _elementary("atan2"),
    casadi.OP_EXP: _elementary("exp"),
    casadi.OP_LOG: _elementary("log"),
    casadi.OP_TANH: _elementary("tanh"),
    casadi.OP_POW: _Lowering.power,
    casadi.OP_CONSTPOW: _Lowering.power,
    casadi.OP_HYPOT: lambda s, x, y: s.v.intrinsic("sqrt", s.v.add(s.v.mul(x, x), s.v.mul(y, y))),
    casadi.OP_FMOD: lambda s, x, y: vector_math.remainder(s.v, x, y, "trunc"),
    casadi.OP_REMAINDER: lambda s, x, y: vector_math.remainder(s.v, x, y, "rint"),
    casadi.OP_LT: _comparison("<"),
    casadi.OP_LE: _comparison("<="),
    casadi.OP_EQ: _comparison("=="),
    casadi.OP_NE: _Lowering.differ,
    casadi.OP_NOT: lambda s, a: s.truth(s.v.builder.not_(s.mask(a))),
    casadi.OP_AND: lambda s, a, b: s.truth(s.v.builder.and_(s.mask(a), s.mask(b))),
    casadi.OP_OR: lambda s, a, b: s.truth(s.v.builder.or_(s.mask(a), s.mask(b))),
    casadi.OP_IF_ELSE_ZERO: lambda s, c, x: s.v.select(s.mask(c), x, s.v.const(0.0)),
}


def _name_of(op: int) -> str:
    names = [name for name in dir(casadi) if name.startswith("OP_") and getattr(casadi, name) == op]
    return names[0] if names else f"operation {op}"
