"""Equal limbs of a robot, found in a traced function, and the operations of a thread that computes one limb.

Where the trace has one operation for each limb, a thread has one operation, and constants that differ are chosen by the
number of the limb. Operations that concern all limbs are computed by every thread. A value of another limb comes from
the thread of that limb. Each thread executes operations of the trace in their order. So results have the bits of the
trace, whatever symmetry is found.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import casadi

from ce_gym.compile.lowering.function import Arguments, Operations, dense_positions
from ce_gym.compile.lowering.graph import FMA, FMS, FNMA, NO_OPERATION, Graph, graph_of, instructions_of
from ce_gym.compile.lowering.ordering import ordered
from ce_gym.compile.program import Call, Program

Group: TypeAlias = tuple[int, ...]
"""A node of a graph, or an element of a buffer, for each limb; equal numbers if the limbs share it."""
Slots: TypeAlias = Mapping[str, Sequence[Group]]
"""The elements of each buffer that a thread holds, by limb."""
FROM_LIMB, BY_LIMB = -7, -8
"""Operations that a trace lacks: the value of another limb, and a choice by the number of the limb."""
COUNTS = (8, 4, 2)
"""Possible numbers of limbs: a warp holds whole robots."""
SHORT = 500
"""Programs without longer functions have one thread for each robot."""
MOST = 0.7
"""Most operations of a thread, as a fraction of all: otherwise a thread computes a robot."""
CHAINED = (casadi.OP_ADD, casadi.OP_AND, casadi.OP_OR, casadi.OP_FMAX, casadi.OP_FMIN)
"""Operations that combine limbs one after the other; the place in the chain does not tell limbs apart."""
COMMUTING = (*CHAINED, casadi.OP_MUL, casadi.OP_EQ, casadi.OP_NE, FMA, FMS, FNMA)
"""Operations whose first two operands may be exchanged."""
ALIKE = {casadi.OP_SUB: casadi.OP_ADD, casadi.OP_SQ: casadi.OP_MUL}


@dataclass(frozen=True)
class Folded:
    """The operations of a thread.

    Attributes:
        graph: The operations, `FROM_LIMB` and `BY_LIMB` among them.
        inputs: Number of the input, and slot, of each node that is an input.
        constants: Constants that differ between limbs.
        limbs: Limb that each `FROM_LIMB` reads, and number of limbs.
        outputs: Node of each slot of each output, by number of the output and slot.
    """

    graph: Graph = field(default_factory=lambda: Graph([], [], {}))
    inputs: dict[int, tuple[int, int]] = field(default_factory=dict)
    constants: dict[int, tuple[float, ...]] = field(default_factory=dict)
    limbs: dict[int, tuple[int, int]] = field(default_factory=dict)
    outputs: dict[tuple[int, int], int] = field(default_factory=dict)

    @property
    def n_operations(self) -> int:
        """Number of operations."""
        return sum(op not in NO_OPERATION for op in self.graph.ops)


def limb_slots(stages: Sequence[Program]) -> Slots:
    """Return the slots of all buffers of stages of which a thread should compute one limb, else nothing."""
    calls = [call for stage in stages for call in stage.calls if isinstance(call, Call)]
    if stages[0].skip_unless or len(calls) < sum(len(stage.calls) for stage in stages):
        return {}
    longest = max(calls, key=lambda call: call.function.n_instructions())
    function = longest.function
    slots = find_slots(function, longest.inputs) if function.n_instructions() > SHORT else {}
    if not slots:
        return {}
    n = len(slots[longest.inputs[0]][0])
    sizes = {b.name: b.size for stage in stages for b in stage.buffers}
    for call in dict.fromkeys((longest, *calls)):
        known = {name: slots.get(name) or _slots(sizes[name], n, ()) for name in call.inputs}
        folding = _Folding(call, graph_of(call.function), known, n)
        slots |= {name: folding.slots_of(i) for i, name in enumerate(call.outputs) if name not in slots}
        graph = folding.graph
        if call is longest and fold(call, graph, slots).n_operations > MOST * Folded(graph).n_operations:
            return {}
    return {name: slots.get(name) or _slots(size, n, ()) for name, size in sizes.items()}


def lower_limb(v: Any, folded: Folded, arguments: Arguments) -> None:
    """Emit the operations of a thread; the masks `limb_1`, `limb_2`, ... are the bits of the number of its limb."""
    graph, operations, values = folded.graph, Operations(v, "limb"), dict[int, Any]()

    def value(k: int) -> Any:
        if k in folded.constants:
            values[k] = by_limb([v.const(number) for number in folded.constants[k]])
        elif k in graph.constants:
            values[k] = operations.constant(graph.constants[k])
        elif k in folded.inputs:
            number, slot = folded.inputs[k]
            values[k] = v.load(arguments.inputs[number], slot)
        return values[k]

    def by_limb(of: Sequence[Any]) -> Any:
        half = len(of) // 2
        if not half or len(set(of)) == 1:
            return of[0]
        low, high = of[:half], of[half:]
        return by_limb(low) if low == high else v.select(f"limb_{half}", by_limb(high), by_limb(low))

    for k in ordered(graph):
        operands = [values.get(a) or value(a) for a in graph.operands[k]]
        if graph.ops[k] == FROM_LIMB:
            values[k] = v.from_limb(operands[0], *folded.limbs[k])
        elif graph.ops[k] == BY_LIMB:
            values[k] = by_limb(operands)
        else:
            values[k] = operations.emit(graph.ops[k], operands)
    for (number, slot), k in folded.outputs.items():
        v.store(values.get(k) or value(k), arguments.outputs[number], slot)


def find_slots(function: casadi.Function, inputs: Sequence[str]) -> dict[str, list[Group]]:
    """Return the slots of the inputs of a function whose trace has equal limbs, else nothing.

    Two elements of an input have the same role if they are used in the same way. Elements of different roles belong to
    one limb if an operation depends on them, and not on more elements of a role than a limb has.

    Args:
        function: The traced function.
        inputs: Names of the buffers of its inputs.
    """
    graph = instructions_of(function)
    elements = _elements(function, graph)
    uses = _uses(function, graph)
    counts = Counter(uses.values())
    limbs = {}
    for n in COUNTS:
        roles = {k: use for k, use in uses.items() if counts[use] % n == 0}
        limbs[n] = _limbs(graph, roles, elements, n)
    n = max(COUNTS, key=lambda n: len(limbs[n]) * (1 - 1 / n))
    limb_of = limbs[n]
    if not limb_of:
        return {}
    groups: dict[tuple[int, int], list[list[int]]] = defaultdict(lambda: [[] for _ in range(n)])
    for k in sorted(limb_of, key=lambda k: elements[k]):
        number, position = elements[k]
        groups[number, uses[k]][limb_of[k]].append(position)
    slots = {}
    for number, name in enumerate(inputs):
        of_input = [group for (at, _), of in groups.items() if at == number for group in zip(*of, strict=True)]
        slots[name] = _slots(function.numel_in(number), n, of_input)
    return slots


def fold(call: Call, graph: Graph, slots: Slots, numbers: Iterable[int] | None = None) -> Folded:
    """Return the operations of a thread for a function, or for a fragment of the function.

    Args:
        call: A call of the function.
        graph: The graph of the function, or of the fragment.
        slots: Slots of all buffers.
        numbers: Numbers of the computed outputs; all outputs if None.
    """
    folding = _Folding(call, graph, slots, len(next(iter(slots.values()))[0]))
    for number in range(len(call.outputs)) if numbers is None else numbers:
        for slot, places in enumerate(slots[call.outputs[number]]):
            folding.folded.outputs[number, slot] = folding.add(tuple(folding.outputs[number][p] for p in places))
    return folding.folded


def _elements(function: casadi.Function, graph: Graph) -> dict[int, tuple[int, int]]:
    """Return the number of the input, and the position in the input, of each node that is an input."""
    positions = [dense_positions(function.sparsity_in(i)) for i in range(function.n_in())]
    found = {}
    for k, op in enumerate(graph.ops):
        if op == casadi.OP_INPUT:
            number, nonzero = function.instruction_input(k)
            found[k] = number, positions[number][nonzero]
    return found


def _slots(size: int, n: int, groups: Iterable[Group]) -> list[Group]:
    """Return the slots of a buffer: groups of elements, and all other elements for all limbs."""
    found = list(groups)
    known = {position for group in found for position in group}
    return sorted(found + [(position,) * n for position in range(size) if position not in known])


def _uses(function: casadi.Function, graph: Graph) -> dict[int, int]:
    """Return a number for each input node, equal if two are used in the same way, but for constants and signs."""
    numbers: dict[tuple, int] = {}
    users, uses = graph.users(), {}
    kinds = [ALIKE.get(op, op) for op in graph.ops]
    for k in reversed(range(len(kinds))):
        kind, following = kinds[k], users.get(k, [])
        is_chained = len(following) == 1 and kind in CHAINED and kinds[following[0]] == kind
        if is_chained or (len(following) == 1 and kind == casadi.OP_NEG):
            uses[k] = uses[following[0]]
            continue
        argument = 0
        if kind == casadi.OP_OUTPUT:
            argument = function.instruction_output(k)[0]
        elif kind == casadi.OP_INPUT:
            argument = function.instruction_input(k)[0]
        places = (0 if kinds[u] in COMMUTING else graph.operands[u].index(k) for u in following)
        use = (kind, argument, *sorted(set(zip((uses[u] for u in following), places, strict=True))))
        uses[k] = numbers.setdefault(use, len(numbers))
    return {k: uses[k] for k, kind in enumerate(kinds) if kind == casadi.OP_INPUT}


def _limbs(graph: Graph, roles: Mapping[int, int], elements: Mapping[int, tuple[int, int]], n: int) -> dict[int, int]:
    """Return the number of the limb of each input that belongs to a limb with `n - 1` others like it."""
    most = {role: count // n for role, count in Counter(roles.values()).items()}
    part_of = {k: frozenset((k,)) for k in roles}
    needs: list[frozenset[int]] = []
    known: set[frozenset[int]] = set()
    for k, operands in enumerate(graph.operands):
        needs.append(frozenset((k,) if k in roles else ()).union(*(needs[a] for a in operands)))
        if needs[k] in known:
            continue
        known.add(needs[k])
        union = frozenset[int]().union(*(part_of[a] for a in needs[k]))
        counts = Counter(roles[a] for a in union)
        if all(counts[role] <= most[role] for role in counts):
            part_of.update(dict.fromkeys(union, union))
    alike: dict[tuple, list[frozenset[int]]] = defaultdict(list)
    for part in sorted(set(part_of.values()), key=lambda part: min(elements[k] for k in part)):
        alike[tuple(sorted(roles[k] for k in part))].append(part)
    return {k: limb for parts in alike.values() if len(parts) == n for limb, part in enumerate(parts) for k in part}


class _Folding:
    """Builds the operations of a thread from the outputs backwards.

    Attributes:
        folded: Result.
        outputs: Nodes of all elements of each output.
        homes: For each node of a limb, the group of that node and its counterparts.
    """

    def __init__(self, call: Call, graph: Graph, slots: Slots, n: int) -> None:
        function = call.function
        self.graph, self.folded = Graph(list(graph.ops), list(graph.operands), dict(graph.constants)), Folded()
        self.n = n
        self._made: dict[Group, int] = {}
        zero = self.graph.add(casadi.OP_CONST)
        self.graph.constants[zero] = 0.0
        self.outputs = [[zero] * function.numel_out(i) for i in range(function.n_out())]
        positions = [dense_positions(function.sparsity_out(i)) for i in range(function.n_out())]
        for k, op in enumerate(graph.ops):
            if op == casadi.OP_OUTPUT:
                number, nonzero = function.instruction_output(k)
                self.outputs[number][positions[number][nonzero]] = graph.operands[k][0]
        node_at = {place: k for k, place in _elements(function, graph).items()}
        self._slot_of: dict[Group, tuple[int, int]] = {}
        self.homes: dict[int, Group] = {}
        for number, name in enumerate(call.inputs):
            for slot, places in enumerate(slots[name]):
                group = tuple(node_at.get((number, p), -1) for p in places)
                self._slot_of[group] = number, slot
                if len(set(places)) > 1:
                    self.homes |= {k: group for k in group if k >= 0}
        self._order = ordered(self.graph)
        self._shapes = self._structure()
        self._find_homes()

    def _structure(self) -> list[int]:
        """Return a number for each node: equal if nodes of two limbs are computed by the same operations."""
        numbers: dict[tuple, int] = {}
        shapes = [-1] * len(self.graph.ops)

        def number(*shape) -> int:
            return numbers.setdefault(shape, len(numbers))

        for k, op in enumerate(self.graph.ops):
            if op == casadi.OP_CONST:
                shapes[k] = number("constant")
            elif op == casadi.OP_INPUT:
                shapes[k] = number("input", self.homes.get(k, (k,)))
        for k in self._order:
            op, of = self.graph.ops[k], [shapes[a] for a in self.graph.operands[k]]
            if op in COMMUTING:
                of[:2] = sorted(of[:2])
            shapes[k] = number(op, *of)
        return shapes

    def _find_homes(self) -> None:
        """Group the nodes of limbs, which depend on the inputs of one limb, with their counterparts."""
        alike: dict[int, list[int]] = defaultdict(list)
        for k in self._order:
            alike[self._shapes[k]].append(k)
        limb_of = {k: home.index(k) for k, home in self.homes.items()}
        for shape in sorted(alike):  # operands have lower numbers
            nodes: list[list[int]] = [[] for _ in range(self.n)]
            for k in sorted(alike[shape]):
                limbs = {limb_of[a] for a in self.graph.operands[k] if a in limb_of}
                if len(limbs) == 1:
                    nodes[limbs.pop()].append(k)
            if len(set(map(len, nodes))) == 1:
                for home in zip(*nodes, strict=True):
                    limb_of |= {k: limb for limb, k in enumerate(home)}
                    self.homes |= dict.fromkeys(home, home)

    def slots_of(self, number: int) -> list[Group]:
        """Return slots of an output in which elements of limbs are where they are computed."""
        nodes = self.outputs[number]
        homes = dict.fromkeys(self.homes[k] for k in nodes if k in self.homes)
        groups = [tuple(map(nodes.index, home)) for home in homes if set(home) <= set(nodes)]
        return _slots(len(nodes), self.n, groups)

    def add(self, group: Group) -> int:
        """Return the node of the result for a group of nodes, after adding that node and all that it needs."""
        waiting = [group]
        while waiting:
            op, needs = self._plan(waiting[-1])
            missing = [need for need in needs if need not in self._made]
            if missing:
                waiting += missing
                continue
            current = waiting.pop()
            if current not in self._made:
                self._made[current] = self.folded.graph.add(op, *(self._made[need] for need in needs))
                self._describe(self._made[current], op, current)
        return self._made[group]

    def _describe(self, node: int, op: int, group: Group) -> None:
        """Record input, constants or limb of a new node."""
        folded, known = self.folded, self.graph.constants
        if op == FROM_LIMB:
            folded.limbs[node] = self.homes[group[0]].index(group[0]), self.n
        elif op == casadi.OP_INPUT:
            folded.inputs[node] = self._slot_of[group]
        elif op == casadi.OP_CONST and len({known[k] for k in group}) > 1:
            folded.constants[node] = tuple(known[k] for k in group)
        elif op == casadi.OP_CONST:
            folded.graph.constants[node] = known[group[0]]

    def _plan(self, group: Group) -> tuple[int, list[Group]]:
        """Return the operation of a thread that computes a group, and the groups that it needs."""
        ops, first = self.graph.ops, group[0]
        if len(set(group)) == 1 and first in self.homes:
            return FROM_LIMB, [self.homes[first]]
        if group in self._slot_of:
            return casadi.OP_INPUT, []
        if all(k in self.graph.constants for k in group):
            return casadi.OP_CONST, []
        if len({ops[k] for k in group}) == 1 and ops[first] not in NO_OPERATION:
            return ops[first], self._operands(group)
        return BY_LIMB, [(k,) * self.n for k in group]

    def _operands(self, group: Group) -> list[Group]:
        """Return the groups of operands of nodes with the same operation."""
        operands = [list(self.graph.operands[k]) for k in group]
        if self.graph.ops[group[0]] in COMMUTING:
            a, b = operands[0][:2]
            for of in operands[1:]:
                x, y = of[:2]
                if self._likeness(a, y) + self._likeness(b, x) > self._likeness(a, x) + self._likeness(b, y):
                    of[:2] = y, x
        return list(zip(*operands, strict=True))

    def _likeness(self, a: int, b: int) -> int:
        """Return how well a node fits another one as its counterpart."""
        if a == b or (a in self.homes and self.homes[a] is self.homes.get(b)):
            return 2
        return int(self._shapes[a] == self._shapes[b])
