"""A function in parts: what its choice takes, what does not change from one call to the next, and what does.

A function may say by one of its outputs whether what it chooses is needed; where it is not, what is left of the rest is
made. Later parts go by what earlier ones left, and a further call makes the last part alone. All are operations of the
whole function, fused as there, and so are the bits of their results.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import casadi

from ce_gym.compile.lowering.decided import decided
from ce_gym.compile.lowering.graph import KEPT, NO_OPERATION, REMOVED, Graph
from ce_gym.compile.lowering.ordering import ordered
from ce_gym.compile.lowering.vector import Value

Nodes: TypeAlias = set[int]
MADE_AGAIN = 32
"""Values of the first part that only the whole function goes on with are made again there instead of kept, if so many
operations are enough: tiles that choose nothing then do not store them."""


@dataclass(frozen=True, eq=False)
class Part:
    """Operations of a function that are made together.

    Attributes:
        graph: They; what earlier parts have left is `KEPT`.
        leaves: Which outputs of the function it writes.
        keeps: Nodes whose values it leaves for later parts.
        places: Where those are in the memory of all parts.
        memory: That.
    """

    graph: Graph
    leaves: frozenset[int]
    keeps: frozenset[int] = frozenset()
    places: Mapping[int, int] = field(default_factory=dict)
    memory: Value | None = None

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to do."""
        return not self.leaves and all(op in NO_OPERATION for op in self.graph.ops)


@dataclass(frozen=True, eq=False)
class Parts:
    """A function in parts.

    Attributes:
        first: What neither follows from what changes nor from the choice.
        versions: The rest, what does not change and what does: all of it, and what is left without the choice, if there
            is one.
    """

    first: Part
    versions: tuple[tuple[Part, Part], ...]


def parted(graph: Graph, outputs: Sequence[Nodes], changing: Nodes, choice: int | None = None) -> Parts:
    """Take a function apart.

    Args:
        graph: The function.
        outputs: Nodes of each of its outputs.
        changing: Nodes that may have other values in a further call.
        choice: An output that is zero where what it chooses is not needed, if one is.

    Raises:
        ValueError: If the choice may change in a further call.
    """
    chosen = set() if choice is None else _values(graph, outputs[choice])
    changes = _followers(graph, changing)
    if chosen & changes:
        raise ValueError(f"output {choice} is a choice; expected one that does not follow from what changes")
    left = graph if choice is None else decided(graph, chosen)
    follows = changes | (_followers(graph, chosen) - chosen)
    first = (_operations(graph) & (_operations(left) | _ancestors(graph, chosen))) - follows
    says = frozenset(() if choice is None else (choice,))
    rest = frozenset(range(len(outputs))) - says
    written = {k for which in rest for k in outputs[which]}

    stages = [_stages(left, first, changing)]
    kept = _read(left, stages[0][0] | stages[0][1] | written) & first | chosen
    if choice is not None:
        again = _made_again(graph, first, kept)
        kept |= (_read(graph, _operations(graph) - first) & first) - again
        stages.insert(0, _stages(graph, first - again, changing))
    graphs = [graph, left][-len(stages) :]
    keeps = [_read(g, last | written) & before for g, (before, last) in zip(graphs, stages, strict=True)]
    places = {k: i for i, k in enumerate(sorted(kept.union(*keeps)))}

    def part(g: Graph, nodes: Nodes, leaves: frozenset[int], keeps: Nodes) -> Part:
        own = nodes | {k for which in leaves for k in outputs[which]}
        return Part(_only(g, own, places), leaves, frozenset(keeps), places)

    none = frozenset[int]()
    return Parts(
        part(graph, first, says, kept),
        tuple(
            (part(g, before, none, keep), part(g, last, rest, set()))
            for g, (before, last), keep in zip(graphs, stages, keeps, strict=True)
        ),
    )


def versions(graph: Graph, outputs: Sequence[Nodes], choice: int) -> tuple[Part, Part, Part]:
    """Return a function's choice, all of it, and what is left where the choice is zero; arguments as of `parted`."""
    chosen, every = _values(graph, outputs[choice]), frozenset(range(len(outputs)))
    says = _only(graph, _ancestors(graph, chosen) | outputs[choice], {})
    left = decided(graph, chosen)
    return Part(says, frozenset({choice})), Part(graph, every), Part(left, every - {choice})


def _stages(graph: Graph, first: Nodes, changing: Nodes) -> tuple[Nodes, Nodes]:
    """Return the operations that are not in the first part: those that do not change, then those that do."""
    left, changes = _operations(graph) - first, _followers(graph, changing)
    return left - changes, left & changes


def _made_again(graph: Graph, first: Nodes, kept: Nodes) -> Nodes:
    """Return what of the first part is made again where its values are needed, as it is not kept and not long."""
    needed = _read(graph, _operations(graph) - first) & first
    costs: dict[int, int] = {}
    for k in ordered(graph):
        if k in first:
            costs[k] = 0 if k in kept else 1 + sum(costs.get(a, 0) for a in set(graph.operands[k]))
            costs[k] = 0 if k in needed and costs[k] > MADE_AGAIN else costs[k]
    return _reached({k for k in needed if costs[k]}, {k: [a for a in graph.operands[k] if costs.get(a)] for k in first})


def _values(graph: Graph, outputs: Nodes) -> Nodes:
    """Return the nodes that outputs have the values of."""
    return {graph.operands[k][0] for k in outputs}


def _operations(graph: Graph) -> Nodes:
    return {k for k, op in enumerate(graph.ops) if op not in NO_OPERATION}


def _read(graph: Graph, nodes: Nodes) -> Nodes:
    """Return the operands of nodes."""
    return {a for k in nodes for a in graph.operands[k]}


def _only(graph: Graph, nodes: Nodes, places: Mapping[int, int]) -> Graph:
    """Return a graph of some nodes and of all sources, kept ones among them."""
    left = Graph(list(graph.ops), list(graph.operands), dict(graph.constants))
    for k, op in enumerate(graph.ops):
        if k not in nodes and op not in (casadi.OP_INPUT, casadi.OP_CONST):
            left.replace(k, KEPT if k in places else REMOVED)
    return left


def _followers(graph: Graph, nodes: Nodes) -> Nodes:
    """Return nodes and all that follow from them."""
    return _reached(nodes, graph.users())


def _ancestors(graph: Graph, nodes: Nodes) -> Nodes:
    """Return nodes and all that they follow from."""
    return _reached(nodes, dict(enumerate(graph.operands)))


def _reached(nodes: Nodes, ways: Mapping[int, Iterable[int]]) -> Nodes:
    found, waiting = set(nodes), list(nodes)
    while waiting:
        new = set(ways.get(waiting.pop(), ())) - found
        found |= new
        waiting += new
    return found
