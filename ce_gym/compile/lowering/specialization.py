"""Specialization of a graph for nodes that are known to be zero: choices that follow are made, dead code is removed.

Only choices are simplified. Every remaining operation also exists in the full graph, so results have the same bits.
"""

from __future__ import annotations

import casadi

from ce_gym.compile.lowering.graph import REMOVED, SELECT, Graph
from ce_gym.compile.lowering.ordering import ordered


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
