"""One CasADi SX function as straight-line vector code.

Every operation of the function's `graph` becomes one value, in the order that `ordering` chooses. Loads are emitted at
first use and stores at the very end, so an output may share memory with an input. Outputs that share no memory with
inputs are stored at once, which keeps fewer values alive.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import casadi

from ce_gym.compile.lowering import math as vector_math
from ce_gym.compile.lowering.graph import FMA, FMS, FNMA, SELECT, Graph, graph_of, sources
from ce_gym.compile.lowering.partial_evaluation import Fragment, Split, split, variants, whole
from ce_gym.compile.lowering.vector import Value, VectorBuilder


@dataclass(frozen=True)
class Arguments:
    """Memory that a lowered function works on; vectors of an input or output follow each other column by column.

    Attributes:
        inputs: Pointer to the first vector of each input of the function that is read, by number.
        outputs: Pointer to the first vector of each output that is written, by number; structural zeros are written
            as 0.
        kept: Pointer to the values that the fragments of a function keep for each other.
        disjoint: Whether no output shares memory with an input.
        shared: Pairs of an input and an output that share memory; values that do not change are not stored again.
    """

    inputs: Mapping[int, Value]
    outputs: Mapping[int, Value]
    kept: Value | None = None
    disjoint: bool = False
    shared: frozenset[tuple[int, int]] = frozenset()


def lower_function(
    v: VectorBuilder, function: casadi.Function, arguments: Arguments, fragment: Fragment | None = None
) -> None:
    """Emit an SX function, or a fragment of the function, at the builder's position.

    Raises:
        NotImplementedError: If an operation has no vector form.
    """
    lowering = _Lowering(v, function, arguments, fragment or whole(graph_of(function), function.n_out()))
    lowering.emit_operations()
    lowering.emit_stores()


def arguments_of(function: casadi.Function, fragment: Fragment) -> tuple[list[int], list[int]]:
    """Return the numbers of the inputs that a fragment of a function reads and of the outputs that it writes."""
    graph = fragment.graph
    read = {a for k in fragment.nodes for a in graph.operands[k]} | {
        *fragment.stores.values(),
        *fragment.keeps.values(),
    }
    inputs = {function.instruction_input(k)[0] for k in read if graph.ops[k] == casadi.OP_INPUT}
    outputs = {function.instruction_output(k)[0] for k in fragment.stores} | fragment.zeros
    return sorted(inputs), sorted(outputs)


def split_function(
    function: casadi.Function,
    changing: Collection[int],
    flags: Sequence[int] = (),
    shared: Collection[tuple[int, int]] = (),
) -> Split:
    """Split a function, see `split`.

    Args:
        function: The function.
        changing: Numbers of its inputs that change.
        flags: Numbers of its outputs that are flags.
        shared: Pairs of an input and an output that share memory.
    """
    graph = graph_of(function)
    positions = [dense_positions(function.sparsity_in(i)) for i in range(function.n_in())]
    inputs: dict[tuple[int, int], list[int]] = defaultdict(list)
    for k in sources(function, graph, {i for i, _ in shared}):
        number, nonzero = function.instruction_input(k)
        inputs[number, positions[number][nonzero]].append(k)
    outputs, overlaps = _outputs(function, graph), defaultdict(list)
    for i, j in shared:
        written = dense_positions(function.sparsity_out(j))
        for k in outputs[j]:
            overlaps[k] += inputs[i, written[function.instruction_output(k)[1]]]
    late = {j for _, j in shared}
    zeros = {i: i in late for i in range(function.n_out()) if function.nnz_out(i) < function.numel_out(i)}
    return split(graph, outputs, sources(function, graph, changing), flags, overlaps, zeros)


def variants_of(function: casadi.Function, flags: Sequence[int]) -> tuple[Fragment, Fragment, Fragment]:
    """Return the flags of a function, the full function, and the function where all flags are zero; see `variants`."""
    graph = graph_of(function)
    return variants(graph, _outputs(function, graph), flags)


def _outputs(function: casadi.Function, graph: Graph) -> list[set[int]]:
    """Return the nodes of each output."""
    outputs: list[set[int]] = [set() for _ in range(function.n_out())]
    for k, op in enumerate(graph.ops):
        if op == casadi.OP_OUTPUT:
            outputs[function.instruction_output(k)[0]].add(k)
    return outputs


def dense_positions(sparsity: casadi.Sparsity) -> list[int]:
    """Return the column-major position of each structural nonzero."""
    rows, columns = sparsity.get_triplet()
    return [row + column * sparsity.size1() for row, column in zip(rows, columns, strict=True)]


class _Lowering:
    """Emits a fragment of a function: one value for each operation.

    Attributes:
        values: Value of each node that has been emitted.
        loaded: Values that have been loaded, by number of the input and position in the input.
        stored: Outputs that have been stored, by number and position.
        places: Places among the values that fragments keep that each node is written to.
        destinations: Outputs that each node is written to, by number and position.
    """

    def __init__(self, v: VectorBuilder, function: casadi.Function, arguments: Arguments, fragment: Fragment) -> None:
        self.v, self.function, self.arguments, self.fragment = v, function, arguments, fragment
        self.operations = Operations(v, function.name())
        self.positions = [dense_positions(function.sparsity_in(i)) for i in range(function.n_in())]
        self.values: dict[int, Value] = {}
        self.loaded: dict[tuple[int, int], Value] = {}
        self.stored: set[tuple[int, int]] = set()
        self.places: dict[int, list[int]] = defaultdict(list)
        for slot, k in fragment.keeps.items():
            self.places[k].append(slot)
        self.destinations: dict[int, list[tuple[int, int]]] = defaultdict(list)
        positions = [dense_positions(function.sparsity_out(i)) for i in range(function.n_out())]
        for output, k in fragment.stores.items():
            number, nonzero = function.instruction_output(output)
            self.destinations[k].append((number, positions[number][nonzero]))

    def emit_operations(self) -> None:
        """Emit all operations, and the stores of values that later fragments read or that overwrite no input."""
        graph, arguments = self.fragment.graph, self.arguments
        for k in self.fragment.nodes:
            value = self.operations.emit(graph.ops[k], [self._value(a) for a in graph.operands[k]])
            self.values[k] = value
            for slot in self.places.pop(k, ()):
                self.v.store(value, arguments.kept, slot)
            for number, position in self.destinations.get(k, ()) if arguments.disjoint else ():
                self.v.store(value, arguments.outputs[number], position)
                self.stored.add((number, position))
        for k, slots in self.places.items():
            for slot in slots:
                self.v.store(self._value(k), arguments.kept, slot)

    def emit_stores(self) -> None:
        """Emit the stores of all outputs that have not been stored yet and may have changed."""
        zero = self.v.const(0.0)
        results: dict[tuple[int, int], Value] = {}
        for number in self.fragment.zeros:
            structural = set(dense_positions(self.function.sparsity_out(number)))
            results |= {(number, i): zero for i in range(self.function.numel_out(number)) if i not in structural}
        for k, places in self.destinations.items():
            results |= {place: self._value(k) for place in places if place not in self.stored}
        for (number, position), result in sorted(results.items(), key=lambda item: item[0]):
            if not self._is_unchanged(number, position, result):
                self.v.store(result, self.arguments.outputs[number], position)

    def _value(self, k: int) -> Value:
        """Return the value of a node: computed already, or an input, constant or kept value at its first use."""
        if k not in self.values:
            graph = self.fragment.graph
            if k in graph.constants:
                self.values[k] = self.operations.constant(graph.constants[k])
            elif k in self.fragment.slots:
                self.values[k] = self.v.load(self.arguments.kept, self.fragment.slots[k])
            else:
                number, nonzero = self.function.instruction_input(k)
                self.values[k] = self._loaded(number, self.positions[number][nonzero])
        return self.values[k]

    def _loaded(self, number: int, position: int) -> Value:
        if (number, position) not in self.loaded:
            self.loaded[number, position] = self.v.load(self.arguments.inputs[number], position)
        return self.loaded[number, position]

    def _is_unchanged(self, number: int, position: int, result: Value) -> bool:
        """Return whether an output is the value that was loaded from the same memory."""
        inputs = [source for source, output in self.arguments.shared if output == number]
        return any(self.loaded.get((source, position)) is result for source in inputs)


class Operations:
    """Emits operations; caches masks, constants and sine-cosine pairs of values already emitted."""

    def __init__(self, v: VectorBuilder, name: str):
        self.v = v
        self.name = name
        self.masks: dict[Value, Value] = {}
        self.numbers: dict[Value, float] = {}
        self.sines: dict[Value, tuple[Value, Value]] = {}

    def constant(self, number: float) -> Value:
        """Return a constant and record its number for `power`."""
        value = self.v.const(number)
        self.numbers[value] = number
        return value

    def emit(self, op: int, operands: Sequence[Value]) -> Value:
        """Emit one operation."""
        if op not in OPERATIONS:
            raise NotImplementedError(
                f"function {self.name!r}: {_name_of(op)} has no vector form; "
                f"expected one of {', '.join(sorted(_name_of(known) for known in OPERATIONS if known >= 0))}"
            )
        return OPERATIONS[op](self, *operands)

    def sin_cos(self, x: Value) -> tuple[Value, Value]:
        """Return sine and cosine; the argument is reduced once for all its sines and cosines."""
        if x not in self.sines:
            self.sines[x] = vector_math.sin_cos(self.v, x)
        return self.sines[x]

    def truth(self, mask: Value) -> Value:
        """Return a mask as a number, 1.0 or 0.0 as in CasADi, and record the mask for `mask`."""
        value = self.v.select(mask, self.v.const(1.0), self.v.const(0.0))
        self.masks[value] = mask
        return value

    def mask(self, value: Value) -> Value:
        """Return the mask of lanes where a value is not zero."""
        if value not in self.masks:
            self.masks[value] = self.v.compare("!=", value, self.v.const(0.0))
        return self.masks[value]

    def differ(self, a: Value, b: Value) -> Value:
        """Return whether two values differ; two masks are compared as bits."""
        if a in self.masks and b in self.masks:
            return self.truth(self.v.builder.xor(self.masks[a], self.masks[b]))
        return self.truth(self.v.compare("!=", a, b))

    def sign(self, x: Value) -> Value:
        """Return -1 or 1, and x itself where x is zero or NaN."""
        v, zero = self.v, self.v.const(0.0)
        positive = v.select(v.compare(">", x, zero), v.const(1.0), x)
        return v.select(v.compare("<", x, zero), v.const(-1.0), positive)

    def power(self, x: Value, y: Value) -> Value:
        """Return integer powers by multiplication, the power 0.5 as square root, and others by exp and log."""
        exponent = self.numbers.get(y)
        if exponent is not None and exponent == int(exponent) and abs(exponent) <= 64:
            return vector_math.integer_power(self.v, x, int(exponent))
        if exponent == 0.5:
            return self.v.intrinsic("sqrt", x)
        return vector_math.power(self.v, x, y)


Operation = Callable[..., Value]


def _builder(method: str) -> Operation:
    """Return an operation that is a method of the vector builder."""
    return lambda s, *operands: getattr(s.v, method)(*operands)


def _intrinsic(name: str) -> Operation:
    """Return an operation that is an LLVM intrinsic."""
    return lambda s, *operands: s.v.intrinsic(name, *operands)


def _elementary(name: str) -> Operation:
    """Return an operation of `lowering.math`."""
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
    casadi.OP_SIGN: Operations.sign,
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
    casadi.OP_POW: Operations.power,
    casadi.OP_CONSTPOW: Operations.power,
    casadi.OP_HYPOT: lambda s, x, y: s.v.intrinsic("sqrt", s.v.add(s.v.mul(x, x), s.v.mul(y, y))),
    casadi.OP_FMOD: lambda s, x, y: vector_math.remainder(s.v, x, y, "trunc"),
    casadi.OP_REMAINDER: lambda s, x, y: vector_math.remainder(s.v, x, y, "rint"),
    casadi.OP_LT: _comparison("<"),
    casadi.OP_LE: _comparison("<="),
    casadi.OP_EQ: _comparison("=="),
    casadi.OP_NE: Operations.differ,
    casadi.OP_NOT: lambda s, a: s.truth(s.v.builder.not_(s.mask(a))),
    casadi.OP_AND: lambda s, a, b: s.truth(s.v.builder.and_(s.mask(a), s.mask(b))),
    casadi.OP_OR: lambda s, a, b: s.truth(s.v.builder.or_(s.mask(a), s.mask(b))),
    casadi.OP_IF_ELSE_ZERO: lambda s, c, x: s.v.select(s.mask(c), x, s.v.const(0.0)),
}


def _name_of(op: int) -> str:
    names = [name for name in dir(casadi) if name.startswith("OP_") and getattr(casadi, name) == op]
    return names[0] if names else f"operation {op}"
