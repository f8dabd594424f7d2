"""A function in two parts: what follows from inputs that change from one call to the next, and what does not.

The second part of a further call goes by what the first part of the first one left. Both are operations of the whole
function, fused as there, and so are the bits of their results.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import casadi

from ce_gym.compile.lowering.graph import KEPT, NO_OPERATION, REMOVED, Graph
from ce_gym.compile.lowering.vector import Value

Places: TypeAlias = dict[int, int]
"""Where the values of nodes are kept from one part to the other."""


@dataclass(frozen=True)
class Part:
    """Which part of a function is meant.

    Attributes:
        number: 0 for what does not follow from some inputs, 1 for what does, and all results.
        changing: Those inputs.
        memory: Where the first part leaves what the second goes by.
    """

    number: int
    changing: frozenset[int]
    memory: Value


def parted(graph: Graph, changing: set[int]) -> tuple[Graph, Graph, Places]:
    """Return what does not follow from some nodes, what does with all outputs, and what goes from one to the other."""
    follows = _followers(graph, changing)
    follows |= {k for k, op in enumerate(graph.ops) if op == casadi.OP_OUTPUT}
    used = {a for k in follows for a in graph.operands[k]} - follows
    places = {k: i for i, k in enumerate(sorted(k for k in used if graph.ops[k] not in NO_OPERATION))}
    before = {k for k, op in enumerate(graph.ops) if op not in NO_OPERATION} - follows
    return _without(graph, follows - changing), _without(graph, before, places), places


def _followers(graph: Graph, nodes: set[int]) -> set[int]:
    """Return nodes and all that follow from them."""
    users, found, waiting = graph.users(), set(nodes), list(nodes)
    while waiting:
        new = set(users.get(waiting.pop(), ())) - found
        found |= new
        waiting += new
    return found


def _without(graph: Graph, nodes: set[int], places: Places | None = None) -> Graph:
    """Return a graph without some nodes, but for those that are kept, which are sources of it."""
    left = Graph(list(graph.ops), list(graph.operands), dict(graph.constants))
    for k in nodes:
        left.replace(k, KEPT if k in (places or ()) else REMOVED)
    return left
