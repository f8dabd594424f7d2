"""Partial evaluation of a function: parts that are executed once, or only where they matter.

Two facts about a call allow a split. Inputs that change from call to call leave all other operations constant. A
`flag`, an output of size 1, tells where some operations matter: an operation belongs to a flag if no output needs the
operation once choices are made for a flag of zero. Tiles where the flag is zero in all lanes skip these operations, and
copy the values that later operations read in their place. Lanes in which the flag is zero choose other values anyway,
so results have the same bits.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import casadi

from ce_gym.compile.lowering.graph import NO_OPERATION, REMOVED, SELECT, Graph, reached
from ce_gym.compile.lowering.ordering import ordered

Nodes: TypeAlias = Collection[int]
CHEAP = 32
"""Most operations to recompute a value that only tiles with a flag need, so that other tiles do not store the value."""
LONG, PIECE = 12_000, 4_000
"""Operations of a part that is divided into several functions, and of these. Parts of usual robots are shorter."""
NONE: Mapping[int, Nodes] = {}
NO_ZEROS: Mapping[int, bool] = {}
Owners: TypeAlias = dict[int, tuple[int, int | None]]
"""Of operations that belong to a flag, its position and the node to copy in place of the operation, if any."""


@dataclass(frozen=True, eq=False)
class Fragment:
    """Operations of a function that are executed together.

    Attributes:
        graph: The operations of the whole function, shared by all fragments.
        nodes: Nodes that the fragment computes, in the order of execution.
        stores: Node whose value is written to each output node.
        keeps: Node whose value is written to each place in the memory that the fragments of a function share.
        slots: Place in that memory of each node that the fragment reads there.
        zeros: Numbers of the outputs whose structural zeros are written.
    """

    graph: Graph
    nodes: Sequence[int]
    stores: Mapping[int, int]
    keeps: Mapping[int, int] = field(default_factory=dict)
    slots: Mapping[int, int] = field(default_factory=dict)
    zeros: frozenset[int] = frozenset()

    @property
    def is_empty(self) -> bool:
        """Whether the fragment does nothing."""
        return not (self.nodes or self.stores or self.keeps or self.zeros)


@dataclass(frozen=True, eq=False)
class Part:
    """A step in the execution of a function.

    Attributes:
        fragment: The operations.
        constant: Whether they depend on no changing input.
        flag: Number of the output that tells where the operations matter; None if they always do.
        skipped: Copies and stores that replace the fragment in tiles where the flag is zero in all lanes.
    """

    fragment: Fragment
    constant: bool
    flag: int | None
    skipped: Fragment


@dataclass(frozen=True, eq=False)
class Split:
    """A function in parts.

    Attributes:
        first: Constant parts of all tiles, which compute the flags; skipped in a repeated call.
        parts: Parts of tiles where a flag is not zero in some lane, in the order of execution.
        short: Parts of all other tiles.
        size: Number of values that fragments keep for each other.
    """

    first: tuple[Part, ...]
    parts: tuple[Part, ...]
    short: tuple[Part, ...]
    size: int


Key: TypeAlias = tuple[int, int, int]
"""Whether a part changes, its stage, and 1 + the position of its flag in the list of flags; 0 without a flag."""


def split(
    graph: Graph,
    outputs: Sequence[Nodes],
    changing: Nodes,
    flags: Sequence[int] = (),
    overlaps: Mapping[int, Nodes] = NONE,
    zeros: Mapping[int, bool] = NO_ZEROS,
) -> Split:
    """Split a function into parts.

    Args:
        graph: The function; constants are added to it.
        outputs: Nodes of each output of the function.
        changing: Nodes that may have other values in a repeated call.
        flags: Numbers of outputs that tell where some operations matter. An operation that matters only where several
            flags are not zero belongs to the first of them.
        overlaps: Input nodes that share memory with an output node; loads precede stores.
        zeros: Whether the memory of an output is shared with an input, for outputs with structural zeros.

    Raises:
        ValueError: If a flag may change in a repeated call.
    """
    flag_nodes = [_value(graph, outputs[flag]) for flag in flags]
    users = graph.users()
    changes, choices = reached(changing, users), reached(flag_nodes, users).difference(flag_nodes)
    for flag, node in zip(flags, flag_nodes, strict=True):
        if node in changes:
            raise ValueError(f"output {flag} is a choice; expected one that does not follow from what changes")
    order = _alive(graph, ordered(graph), [k for nodes in outputs for k in nodes])
    short, before = specialize(graph, order, set(flag_nodes))[0], graph.ancestors(flag_nodes)
    always = {k for k in order if k not in choices and short.ops[k] != REMOVED} | before
    once = [k for k in order if k in always and k not in changes]
    others = [k for number, nodes in enumerate(outputs) for k in nodes if number not in flags]
    of_short = _Path(short, set(once), _alive(short, order, others), changes, {}, overlaps, others, zeros)
    path = of_short
    if flags:
        again = _recomputed(graph, order, set(once), of_short.given | {*flag_nodes})
        owners = _owners(graph, order, flag_nodes)
        path = _Path(graph, set(once) - again, order, changes, owners, overlaps, others, zeros)
    of_flags = [k for flag in flags for k in outputs[flag]]
    first = _Path(graph, (), once, changes, {}, NONE, of_flags, NO_ZEROS, of_short.given | path.given)
    ended, slots, size = first.finished({}, 0, ())
    parts, _, of_parts = path.finished(slots, size, flags)
    of_others, _, of_short_parts = of_short.finished(slots, size, flags)
    return Split(ended, parts, of_others, max(of_parts, of_short_parts))


def variants(graph: Graph, outputs: Sequence[Nodes], flags: Sequence[int]) -> tuple[Fragment, Fragment, Fragment]:
    """Return three fragments without kept values: flags, the full function, and the function where all flags are zero.

    Arguments: see `split`.
    """
    flag_nodes, numbers = [_value(graph, outputs[flag]) for flag in flags], frozenset(range(len(outputs)))
    needed = graph.ancestors(flag_nodes)
    of_flags = Fragment(
        graph,
        [k for k in ordered(graph) if k in needed],
        _written(graph, [k for flag in flags for k in outputs[flag]]),
        zeros=frozenset(flags),
    )
    short, others = specialize(graph, ordered(graph), set(flag_nodes))[0], numbers - frozenset(flags)
    written = _written(short, [k for number in others for k in outputs[number]])
    return of_flags, whole(graph, len(outputs)), Fragment(short, ordered(short), written, zeros=others)


def whole(graph: Graph, n_outputs: int) -> Fragment:
    """Return all operations of a function as one fragment."""
    written = _written(graph, [k for k, op in enumerate(graph.ops) if op == casadi.OP_OUTPUT])
    return Fragment(graph, ordered(graph), written, zeros=frozenset(range(n_outputs)))


def specialize(graph: Graph, order: Sequence[int], zeros: set[int]) -> tuple[Graph, dict[int, int]]:
    """Return a graph in which some nodes are known to be zero, and the nodes that replace others there.

    The graph has no operations that no output needs. A node that replaces another one is an operand that is chosen, or
    a constant.

    Args:
        graph: The function.
        order: Its operations, operands first.
        zeros: The known nodes.
    """
    result = Graph(list(graph.ops), list(graph.operands), dict(graph.constants))
    known: dict[int, float] = dict.fromkeys(zeros, 0.0)
    replacements: dict[int, int] = {}

    def replaced(k: int) -> int:
        """Return the node that has the value of node k in the result: the chosen operand, or a constant."""
        k = replacements.get(k, k)
        if k in known and k not in result.constants:
            constant = result.add(casadi.OP_CONST)
            result.constants[constant] = known[constant] = known[k]
            replacements[k] = constant
            return constant
        return k

    outputs = [k for k, op in enumerate(graph.ops) if op == casadi.OP_OUTPUT]
    for k in (*order, *outputs):
        operands = graph.operands[k]
        value, chosen = _choice(graph.ops[k], operands, [known.get(replacements.get(a, a)) for a in operands])
        if value is not None:
            known[k] = value
        elif chosen is not None:
            replacements[k] = replacements.get(chosen, chosen)
        else:
            result.replace(k, graph.ops[k], *(replaced(a) for a in operands))
    _remove_dead_code(result, outputs)
    return result, {k: replaced(k) for k in {*replacements, *known} if k < len(graph.ops)}


def _choice(op: int, operands: tuple[int, ...], known: list[float | None]) -> tuple[float | None, int | None]:
    """Return the value of an operation, or the operand that the operation equals, if known operands determine it."""
    if op == casadi.OP_NOT and known[0] is not None:
        return float(not known[0]), None
    if op == casadi.OP_AND and 0.0 in known:
        return 0.0, None
    if op == casadi.OP_OR and 1.0 in known:
        return 1.0, None
    if op == casadi.OP_IF_ELSE_ZERO and known[0] is not None:
        return (None, operands[1]) if known[0] else (0.0, None)
    if op == SELECT and known[0] is not None:
        return None, operands[1 if known[0] else 2]
    return None, None


def _remove_dead_code(graph: Graph, outputs: list[int]) -> None:
    """Remove operations that no output depends on."""
    needed = graph.ancestors(outputs)
    for k, op in enumerate(graph.ops):
        if k not in needed and op not in (casadi.OP_INPUT, casadi.OP_CONST):
            graph.replace(k, REMOVED)


def _owners(graph: Graph, order: Sequence[int], flags: Sequence[int]) -> Owners:
    """Return the position of the flag that each operation belongs to, and the node to copy where the flag is zero.

    Constants to copy are added to the graph. An operation that nothing needs where the flag is zero has None to copy.
    """
    before, result = graph.ancestors(flags), {}
    for i, flag in enumerate(flags):
        n, (short, replacements) = len(graph.ops), specialize(graph, order, {flag})
        for k in order:
            if k in before or k in result or short.ops[k] != REMOVED:
                continue
            copy = replacements.get(k)
            if copy is not None and copy >= n:
                number, copy = short.constants[copy], graph.add(casadi.OP_CONST)
                graph.constants[copy] = number
            result[k] = i, copy
    return result


def _pieces(graph: Graph, nodes: list[int]) -> list[list[int]]:
    """Return operations in pieces: LLVM takes a time that grows with the square of a long function's length."""
    if len(nodes) <= LONG:
        return [nodes]
    order = ordered(graph, nodes, ())
    return [order[i : i + PIECE] for i in range(0, len(order), PIECE)]


def _alive(graph: Graph, order: Sequence[int], outputs: Nodes) -> list[int]:
    """Return the operations that outputs need, in the given order."""
    needed = graph.ancestors(outputs)
    return [k for k in order if k in needed]


def _recomputed(graph: Graph, order: Sequence[int], once: set[int], kept: set[int]) -> set[int]:
    """Return the operations in `once` that others compute again, because they are `CHEAP` and not kept anyway."""
    needed = {a for k in order if k not in once for a in graph.operands[k]} & once
    costs: dict[int, int] = {}
    for k in order:
        if k in once:
            costs[k] = 0 if k in kept else 1 + sum(costs.get(a, 0) for a in set(graph.operands[k]))
            costs[k] = 0 if k in needed and costs[k] > CHEAP else costs[k]
    return reached({k for k in needed if costs[k]}, {k: [a for a in graph.operands[k] if costs.get(a)] for k in once})


def _keys(graph: Graph, order: Sequence[int], changes: Nodes, owners: Owners) -> dict[int, Key]:
    """Return the key of the part of each operation.

    Operations without a flag are in even stages, as late as their users allow, so that few values are kept. Operations
    with a flag are in odd stages.

    Args:
        graph: The function.
        order: The operations, operands first.
        changes: Nodes that may change in a repeated call.
        owners: See `_owners`.
    """
    keys: dict[int, Key] = {}
    latest: dict[int, int] = {}
    for k in order:
        changing, group = k in changes, owners[k][0] + 1 if k in owners else 0
        known = [keys[a] for a in _read(graph, k, owners) if a in keys and keys[a][0] == changing]
        keys[k] = changing, max((stage + _steps(g, group) for _, stage, g in known), default=int(group > 0)), group
    for k in reversed(order):
        changing, stage, group = keys[k]
        if group == 0:
            stage = latest.get(k, stage)
            keys[k] = changing, stage, group
        for a in _read(graph, k, owners):
            if a in keys and keys[a][0] == changing:
                latest[a] = min(latest.get(a, stage), stage - bool(group))
    return keys


def _steps(before: int, after: int) -> int:
    """Return how many stages lie between an operand and an operation, given the groups of both."""
    return 0 if before == after else 1 + (before > 0 and after > 0)


def _read(graph: Graph, k: int, owners: Owners) -> tuple[int, ...]:
    """Return the nodes that must be known before an operation or the copy in its place."""
    copy = owners[k][1] if k in owners else None
    return graph.operands[k] if copy is None else (*graph.operands[k], copy)


class _Path:
    """Parts under construction: where operations are executed, and where outputs are stored.

    Args:
        graph: The function.
        once: Operations that have been executed.
        order: All operations, operands first.
        changes: Nodes that may change in a repeated call.
        owners: See `_owners`.
        overlaps: See `split`.
        outputs: Output nodes.
        zeros: See `split`.
        kept: Operations of the path that are read after it.

    Attributes:
        given: Operations that have been executed and are read.
    """

    def __init__(
        self,
        graph: Graph,
        once: Nodes,
        order: Sequence[int],
        changes: Nodes,
        owners: Owners,
        overlaps: Mapping[int, Nodes],
        outputs: Nodes,
        zeros: Mapping[int, bool],
        kept: Nodes = (),
    ) -> None:
        self.graph, self.owners, self.overlaps = graph, owners, overlaps
        keys = _keys(graph, [k for k in order if k not in once], changes, owners)
        groups: dict[Key, list[int]] = defaultdict(list)
        for k, key in keys.items():
            groups[key].append(k)
        pieces = [(key, piece) for key in sorted(groups) for piece in _pieces(graph, groups[key])]
        self.keys = [key for key, _ in pieces]
        self.nodes = [piece for _, piece in pieces]
        self.part_of = {k: i for i, nodes in enumerate(self.nodes) for k in nodes}
        self.last_read = {a: i for i, nodes in enumerate(self.nodes) for k in nodes for a in _read(graph, k, owners)}
        self.stores: list[dict[int, int]] = [{} for _ in self.keys]
        self.skipped: list[dict[int, int]] = [{} for _ in self.keys]
        self.zeros: list[set[int]] = [set() for _ in self.keys]
        for node in sorted(outputs, key=lambda k: (graph.operands[k][0] in self.part_of, k)):  # loads precede stores
            self._add_output(node)
        for number, shared in zeros.items():
            self.zeros[self._part(len(self.keys) - 1 if shared else 0, 0)].add(number)
        self.kept = self._read_later(kept)
        self.given = {k for k in self.kept if k not in self.part_of}

    def _add_output(self, node: int) -> None:
        """Store an output where its value is known and the inputs that share its memory have been read."""
        value = self.graph.operands[node][0]
        shared, own = self.overlaps.get(node, ()), self.part_of.get(value, 0)
        place = max([own, *(self.last_read.get(a, 0) for a in shared)])
        position, copy = self.owners.get(value, (-1, None))
        if copy in shared:  # unchanged where skipped
            place = self._part(place, position + 1)
        elif copy is not None and place == own:
            self.skipped[own][node] = copy
        else:
            place = self._part(place, 0)
        self.stores[place][node] = value
        self.last_read[value] = max(place, self.last_read.get(value, 0))

    def _part(self, earliest: int, group: int) -> int:
        """Return the first part of a group from a place on; add a part if the group has no such part."""
        for i in range(max(earliest, 0), len(self.keys)):
            if self.keys[i][2] == group:
                return i
        self.keys.append((1, self.keys[-1][1] + 1 if self.keys else 0, group))
        self.nodes.append([])
        self.stores.append({})
        self.skipped.append({})
        self.zeros.append(set())
        return len(self.keys) - 1

    def _read_later(self, after: Nodes) -> dict[int, int]:
        """Return the operations that are read in another part than theirs, or `after` all, and the last such part."""
        kept = dict.fromkeys(after, len(self.keys))
        for i in reversed(range(len(self.keys))):
            values = {a for k in self.nodes[i] for a in self.graph.operands[k]}
            values.update(self.stores[i].values(), self.skipped[i].values())
            values.update(copy for k in self.nodes[i] if k in kept and (copy := self._copy(k)) is not None)
            for k in values:
                if self.part_of.get(k) != i and self.graph.ops[k] not in NO_OPERATION:
                    kept.setdefault(k, i)
        return kept

    def _copy(self, k: int) -> int | None:
        return self.owners[k][1] if k in self.owners else None

    def finished(
        self, given: Mapping[int, int], size: int, flags: Sequence[int]
    ) -> tuple[tuple[Part, ...], dict[int, int], int]:
        """Return the parts, all slots and their number, given the slots of operations that have been executed."""
        slots, parts = dict(given), []
        free: list[int] = []
        for i, (nodes, (changing, _, group)) in enumerate(zip(self.nodes, self.keys, strict=True)):
            if changing:  # constants are read again in a repeated call
                ended = [k for k, last in self.kept.items() if last == i - 1 and self.keys[self.part_of.get(k, 0)][0]]
                free += [slots[k] for k in ended if k in self.part_of]
            for k in nodes:
                if k in self.kept:
                    slots[k] = free.pop() if free else size
                    size = max(size, slots[k] + 1)
            keeps = {slots[k]: k for k in nodes if k in self.kept}
            copies = {slot: copy for slot, k in keeps.items() if (copy := self._copy(k)) is not None}
            order = ordered(self.graph, nodes, list(self.stores[i]))
            fragment = Fragment(self.graph, order, self.stores[i], keeps, slots, frozenset(self.zeros[i]))
            skipped = Fragment(self.graph, (), self.skipped[i], copies, slots)
            parts.append(Part(fragment, not changing, flags[group - 1] if group else None, skipped))
        return tuple(parts), slots, size


def _value(graph: Graph, outputs: Nodes) -> int:
    """Return the node whose value is written to an output of size 1."""
    (node,) = outputs
    return graph.operands[node][0]


def _written(graph: Graph, outputs: Iterable[int]) -> dict[int, int]:
    """Return the node whose value is written to each output node."""
    return {k: graph.operands[k][0] for k in outputs}
