"""A traced function as a graph of operations, each of which is rounded once: no compiler is left a choice.

Compilers fuse products with sums and turn quotients into products where they are allowed to. Which ones is their own
affair, and so are the last digits of the result. Here it is done once for all targets, and none is allowed to do more:
what is left are operations of IEEE 754: processors and GPUs that keep to it give the same numbers, bit for bit.
The rewritings leave seven tenths of the operations of a step. Knows CasADi's instruction list.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import casadi

ABSORBED, CHOICE, PRODUCT_PLUS, PRODUCT_MINUS, MINUS_PRODUCT = -1, -2, -3, -4, -5
"""What CasADi does not have: nothing to do any more; of operands (a, b, c) `b if a else c`, `a b + c`, `a b - c` and
`c - a b`."""

NO_OPERATION = (casadi.OP_INPUT, casadi.OP_CONST, casadi.OP_OUTPUT, ABSORBED)
"""What only reads or writes, or nothing at all."""


@dataclass(frozen=True)
class Graph:
    """Operations of a function.

    Attributes:
        ops: What is done, by number: first the function's instructions, then what the rewritings have added.
        operands: Of each, the numbers of those whose results it takes.
        constants: The numbers that are known, by number of the operation.
    """

    ops: list[int]
    operands: list[tuple[int, ...]]
    constants: dict[int, float]

    def users(self) -> dict[int, list[int]]:
        """Return, by number, all that take a result; one that takes it twice comes twice."""
        users = defaultdict(list)
        for k, of in enumerate(self.operands):
            for a in of:
                users[a].append(k)
        return users

    def add(self, op: int, *operands: int) -> int:
        """Add an operation and return its number."""
        self.ops.append(op)
        self.operands.append(operands)
        return len(self.ops) - 1

    def replace(self, k: int, op: int, *operands: int) -> None:
        """Get the result of an operation in another way."""
        self.ops[k], self.operands[k] = op, operands


def graph_of(function: casadi.Function) -> Graph:
    """Return the graph of an SX function, rewritten."""
    graph = _instructions(function)
    _join_choices(graph)
    _choose_sums(graph)
    _avoid_quotients(graph)
    _fuse_products(graph)
    return graph


def _instructions(function: casadi.Function) -> Graph:
    """The instructions as they are; CasADi names registers, which are used again and again."""
    registers = [-1] * function.sz_w()
    graph = Graph([], [], {})
    for k in range(function.n_instructions()):
        op = function.instruction_id(k)
        is_source = op in (casadi.OP_INPUT, casadi.OP_CONST)
        graph.ops.append(op)
        graph.operands.append(() if is_source else tuple(registers[i] for i in function.instruction_input(k)))
        if op == casadi.OP_CONST:
            graph.constants[k] = function.instruction_constant(k)
        if op != casadi.OP_OUTPUT:
            registers[function.instruction_output(k)[0]] = k
    return graph


def _join_choices(graph: Graph) -> None:
    """Make sums of what is zero unless a condition holds, and what is zero if it does, choices: CasADi's `if_else`."""
    ops, operands, users = graph.ops, graph.operands, graph.users()
    for k, op in enumerate(ops):
        if op != casadi.OP_ADD or any(ops[a] != casadi.OP_IF_ELSE_ZERO for a in operands[k]):
            continue
        for yes, no in (operands[k], operands[k][::-1]):
            (condition, left), (otherwise, right) = operands[yes], operands[no]
            if ops[otherwise] == casadi.OP_NOT and operands[otherwise] == (condition,):
                graph.replace(k, CHOICE, condition, left, right)
                for part in (yes, no):
                    if users[part] == [k]:
                        graph.replace(part, ABSORBED)
                break


def _choose_sums(graph: Graph) -> None:
    """Make the sum with what is zero unless a condition holds the choice of the sum or its other part.

    A processor with masks does that in one instruction; elsewhere there are as many as before.
    """
    ops, operands, users = graph.ops, graph.operands, graph.users()
    for k, op in enumerate(ops[:]):
        if op != casadi.OP_IF_ELSE_ZERO or not _is_for_a_sum(graph, users[k]):
            continue
        user, (condition, part) = users[k][0], operands[k]
        left, right = operands[user]
        if ops[user] == casadi.OP_ADD or right == k:
            other = left if right == k else right
            graph.replace(user, CHOICE, condition, graph.add(ops[user], other, part), other)
            graph.replace(k, ABSORBED)


def _avoid_quotients(graph: Graph) -> None:
    """Make quotients by constants, and several of one divisor, products with its reciprocal."""
    ops, operands, constants = graph.ops, graph.operands, graph.constants
    quotients: dict[int, list[int]] = defaultdict(list)
    for k, op in enumerate(ops):
        if op in (casadi.OP_DIV, casadi.OP_INV):
            quotients[operands[k][-1]].append(k)
    for divisor, same in quotients.items():
        inverses = [k for k in same if ops[k] == casadi.OP_INV]
        if constants.get(divisor):
            reciprocal = graph.add(casadi.OP_CONST)
            constants[reciprocal] = 1.0 / constants[divisor]
        elif len(same) > 1:
            reciprocal = inverses[0] if inverses else graph.add(casadi.OP_INV, divisor)
        else:
            continue
        for k in same:
            if ops[k] == casadi.OP_DIV:
                graph.replace(k, casadi.OP_MUL, operands[k][0], reciprocal)


def _fuse_products(graph: Graph) -> None:
    """Let sums take up the products that nobody else takes, one each: of two, the one that comes last."""
    ops, operands, users = graph.ops, graph.operands, graph.users()
    for k in reversed(range(len(ops))):
        if ops[k] not in (casadi.OP_MUL, casadi.OP_SQ) or not _is_for_a_sum(graph, users[k]):
            continue
        user, a, b = users[k][0], operands[k][0], operands[k][-1]
        left, right = operands[user]
        if ops[user] == casadi.OP_ADD:
            graph.replace(user, PRODUCT_PLUS, a, b, right if left == k else left)
        elif left == k:
            graph.replace(user, PRODUCT_MINUS, a, b, right)
        else:
            graph.replace(user, MINUS_PRODUCT, a, b, left)
        graph.replace(k, ABSORBED)


def _is_for_a_sum(graph: Graph, users: list[int]) -> bool:
    """Whether a result has one user, which is a sum or a difference."""
    return len(users) == 1 and graph.ops[users[0]] in (casadi.OP_ADD, casadi.OP_SUB)
