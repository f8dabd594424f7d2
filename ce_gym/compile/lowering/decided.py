"""What is left of a function where a value is zero: choices that follow from it are made, nothing is reckoned anew.

The operations that are left are those of the whole function, fused as there, and so are the bits of their results.
"""

from __future__ import annotations

import casadi

from ce_gym.compile.lowering.graph import REMOVED, SELECT, Graph
from ce_gym.compile.lowering.ordering import ordered


def decided(graph: Graph, zeros: set[int]) -> Graph:
    """Return a graph in which some nodes are known to be zero, without what nobody needs then."""
    left = Graph(list(graph.ops), list(graph.operands), dict(graph.constants))
    known: dict[int, float] = dict.fromkeys(zeros, 0.0)
    same: dict[int, int] = {}

    def meant(k: int) -> int:
        """Return the node that has a node's value: the one that was chosen, or a constant."""
        k = same.get(k, k)
        if k in known and k not in left.constants:
            constant = left.add(casadi.OP_CONST)
            left.constants[constant] = known[constant] = known[k]
            same[k] = constant
            return constant
        return k

    outputs = [k for k, op in enumerate(graph.ops) if op == casadi.OP_OUTPUT]
    for k in (*ordered(graph), *outputs):
        operands = graph.operands[k]
        value, chosen = _choice(graph.ops[k], operands, [known.get(same.get(a, a)) for a in operands])
        if value is not None:
            known[k] = value
        elif chosen is not None:
            same[k] = same.get(chosen, chosen)
        else:
            left.replace(k, graph.ops[k], *(meant(a) for a in operands))
    _remove_unneeded(left, outputs)
    return left


def _choice(op: int, operands: tuple[int, ...], known: list[float | None]) -> tuple[float | None, int | None]:
    """Return the truth of an operation, or which of its operands it is, if what is known of these decides it."""
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


def _remove_unneeded(graph: Graph, outputs: list[int]) -> None:
    """Remove operations that no output follows from."""
    needed, waiting = set[int](), list(outputs)
    while waiting:
        k = waiting.pop()
        if k not in needed:
            needed.add(k)
            waiting += graph.operands[k]
    for k, op in enumerate(graph.ops):
        if k not in needed and op not in (casadi.OP_INPUT, casadi.OP_CONST):
            graph.replace(k, REMOVED)
