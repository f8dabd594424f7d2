"""Partial evaluation of a function: a prologue that is executed once, and variants of the remainder.

Two facts about a call allow a split. Inputs that change from call to call leave all other operations constant. A
`flag`, an output of size 1, says whether the operations that depend on the flag are needed. The prologue computes the
flag and everything that depends on neither; each variant of the remainder has a constant and a changing fragment. In
the variant for a flag of zero, choices that follow are made and dead code is removed. All operations also exist in the
full function, so results have the same bits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import casadi

from ce_gym.compile.lowering.graph import KEPT, NO_OPERATION, REMOVED, SELECT, Graph, reached
from ce_gym.compile.lowering.ordering import ordered

Nodes: TypeAlias = set[int]
CHEAP = 32
"""Most operations to recompute a value of the prologue that only the full variant needs, instead of keeping the value:
tiles with the short variant then do not store it."""


@dataclass(frozen=True, eq=False)
class Fragment:
    """Operations of a function that are executed together.

    Attributes:
        graph: The operations; values of earlier fragments are `KEPT` nodes.
        outputs: Numbers of the outputs of the function that the fragment writes.
        keeps: Nodes whose values later fragments read.
        slots: Place of each kept node in the memory that the fragments of a function share.
    """

    graph: Graph
    outputs: frozenset[int]
    keeps: frozenset[int] = frozenset()
    slots: Mapping[int, int] = field(default_factory=dict)

    @property
    def is_empty(self) -> bool:
        """Whether the fragment does nothing."""
        return not self.outputs and all(op in NO_OPERATION for op in self.graph.ops)


@dataclass(frozen=True, eq=False)
class Split:
    """A function in fragments.

    Attributes:
        prologue: Operations that depend neither on changing inputs nor on the flag.
        variants: The remainder as a constant and a changing fragment: of the full function and, if there is a flag, of
            the function where the flag is zero.
    """

    prologue: Fragment
    variants: tuple[tuple[Fragment, Fragment], ...]


def split(graph: Graph, outputs: Sequence[Nodes], changing: Nodes, flag: int | None = None) -> Split:
    """Split a function into fragments.

    Args:
        graph: The function.
        outputs: Nodes of each output of the function.
        changing: Nodes that may have other values in a repeated call.
        flag: Number of an output that is zero where operations that depend on it are not needed; None without a flag.

    Raises:
        ValueError: If the flag may change in a repeated call.
    """
    flags = set() if flag is None else _values(graph, outputs[flag])
    changes = _dependents(graph, changing)
    if flags & changes:
        raise ValueError(f"output {flag} is a choice; expected one that does not follow from what changes")
    short = graph if flag is None else specialize(graph, flags)
    dependent = changes | (_dependents(graph, flags) - flags)
    once = (_operations(graph) & (_operations(short) | graph.ancestors(flags))) - dependent
    of_prologue = frozenset(() if flag is None else (flag,))
    of_remainder = frozenset(range(len(outputs))) - of_prologue
    written = {k for number in of_remainder for k in outputs[number]}

    remainders = [_remainder(short, once, changing)]
    kept = _read(short, remainders[0][0] | remainders[0][1] | written) & once | flags
    if flag is not None:
        recomputed = _recomputed(graph, once, kept)
        kept |= (_read(graph, _operations(graph) - once) & once) - recomputed
        remainders.insert(0, _remainder(graph, once - recomputed, changing))
    graphs = [graph, short][-len(remainders) :]
    keeps = [_read(g, changed | written) & constant for g, (constant, changed) in zip(graphs, remainders, strict=True)]
    slots = {k: i for i, k in enumerate(sorted(kept.union(*keeps)))}

    def fragment(g: Graph, nodes: Nodes, numbers: frozenset[int], keeps: Nodes) -> Fragment:
        nodes = nodes | {k for number in numbers for k in outputs[number]}
        return Fragment(_subgraph(g, nodes, slots), numbers, frozenset(keeps), slots)

    return Split(
        fragment(graph, once, of_prologue, kept),
        tuple(
            (fragment(g, constant, frozenset(), keep), fragment(g, changed, of_remainder, set()))
            for g, (constant, changed), keep in zip(graphs, remainders, keeps, strict=True)
        ),
    )


def variants(graph: Graph, outputs: Sequence[Nodes], flag: int) -> tuple[Fragment, Fragment, Fragment]:
    """Return three fragments without kept values: the flag, the full function, and the function where the flag is zero.

    Arguments: see `split`.
    """
    flags, numbers = _values(graph, outputs[flag]), frozenset(range(len(outputs)))
    of_flag = _subgraph(graph, graph.ancestors(flags) | outputs[flag], {})
    short = Fragment(specialize(graph, flags), numbers - {flag})
    return Fragment(of_flag, frozenset({flag})), Fragment(graph, numbers), short


def specialize(graph: Graph, zeros: set[int]) -> Graph:
    """Return a graph in which some nodes are known to be zero, without operations that no output needs then."""
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
    for k in (*ordered(graph), *outputs):
        operands = graph.operands[k]
        value, chosen = _choice(graph.ops[k], operands, [known.get(replacements.get(a, a)) for a in operands])
        if value is not None:
            known[k] = value
        elif chosen is not None:
            replacements[k] = replacements.get(chosen, chosen)
        else:
            result.replace(k, graph.ops[k], *(replaced(a) for a in operands))
    _remove_dead_code(result, outputs)
    return result


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


def _remainder(graph: Graph, once: Nodes, changing: Nodes) -> tuple[Nodes, Nodes]:
    """Return the operations outside the prologue: the constant ones and the changing ones."""
    nodes, changes = _operations(graph) - once, _dependents(graph, changing)
    return nodes - changes, nodes & changes


def _recomputed(graph: Graph, once: Nodes, kept: Nodes) -> Nodes:
    """Return the nodes of the prologue that the remainder computes again, because they are `CHEAP` and not kept."""
    needed = _read(graph, _operations(graph) - once) & once
    costs: dict[int, int] = {}
    for k in ordered(graph):
        if k in once:
            costs[k] = 0 if k in kept else 1 + sum(costs.get(a, 0) for a in set(graph.operands[k]))
            costs[k] = 0 if k in needed and costs[k] > CHEAP else costs[k]
    return reached({k for k in needed if costs[k]}, {k: [a for a in graph.operands[k] if costs.get(a)] for k in once})


def _values(graph: Graph, outputs: Nodes) -> Nodes:
    """Return the nodes whose values are written to outputs."""
    return {graph.operands[k][0] for k in outputs}


def _operations(graph: Graph) -> Nodes:
    return {k for k, op in enumerate(graph.ops) if op not in NO_OPERATION}


def _read(graph: Graph, nodes: Nodes) -> Nodes:
    """Return the operands of nodes."""
    return {a for k in nodes for a in graph.operands[k]}


def _subgraph(graph: Graph, nodes: Nodes, slots: Mapping[int, int]) -> Graph:
    """Return a graph of some nodes, all inputs and constants, and kept values of other nodes."""
    result = Graph(list(graph.ops), list(graph.operands), dict(graph.constants))
    for k, op in enumerate(graph.ops):
        if k not in nodes and op not in (casadi.OP_INPUT, casadi.OP_CONST):
            result.replace(k, KEPT if k in slots else REMOVED)
    return result


def _dependents(graph: Graph, nodes: Nodes) -> Nodes:
    """Return nodes and all nodes that depend on them."""
    return reached(nodes, graph.users())
