"""A traced function as a graph of IEEE 754 operations; operations are fused here and not by a compiler.

Compilers that may fuse multiply-adds and replace divisions by reciprocals choose differently for each target, and the
last bits differ with them. Both rewritings are done here once for all targets and forbidden to every compiler, so CPUs
and GPUs that follow IEEE 754 give the same bits. About 70 % of a step's CasADi instructions remain.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import casadi

REMOVED, SELECT, FMA, FMS, FNMA = -1, -2, -3, -4, -5
"""Operations that CasADi lacks: removed by a rewriting; of (a, b, c): `b if a else c`, `a b + c`, `a b - c`,
`c - a b`."""

COMMUTATIVE = (casadi.OP_ADD, casadi.OP_MUL, casadi.OP_AND, casadi.OP_OR)
"""Operations whose operands can be exchanged."""
UNBOUNDED = (
    *(casadi.OP_DIV, casadi.OP_INV, casadi.OP_POW, casadi.OP_CONSTPOW, casadi.OP_SQRT),
    *(casadi.OP_LOG, casadi.OP_EXP, casadi.OP_TAN, casadi.OP_ACOS, casadi.OP_ASIN),
)
"""Operations whose results may be infinite or undefined."""
NO_OPERATION = (casadi.OP_INPUT, casadi.OP_CONST, casadi.OP_OUTPUT, REMOVED)
"""Nothing is computed for these."""


@dataclass(frozen=True)
class Graph:
    """Operations of a function.

    Attributes:
        ops: Operation of each node: the function's instructions first, then nodes added by rewritings.
        operands: Operand nodes of each node.
        constants: Values of constant nodes.
    """

    ops: list[int]
    operands: list[tuple[int, ...]]
    constants: dict[int, float]

    def users(self) -> dict[int, list[int]]:
        """Return the users of each node; a node that uses another one twice is listed twice."""
        users = defaultdict(list)
        for k, of in enumerate(self.operands):
            for a in of:
                users[a].append(k)
        return users

    def ancestors(self, nodes: Iterable[int]) -> set[int]:
        """Return nodes and all nodes that they depend on."""
        return reached(nodes, dict(enumerate(self.operands)))

    def add(self, op: int, *operands: int) -> int:
        """Add a node and return its number."""
        self.ops.append(op)
        self.operands.append(operands)
        return len(self.ops) - 1

    def replace(self, k: int, op: int, *operands: int) -> None:
        """Replace the operation and the operands of a node."""
        self.ops[k], self.operands[k] = op, operands


def reached(nodes: Iterable[int], neighbours: Mapping[int, Iterable[int]]) -> set[int]:
    """Return nodes and all nodes that can be reached from them over their neighbours."""
    found, waiting = set(nodes), list(nodes)
    while waiting:
        new = set(neighbours.get(waiting.pop(), ())) - found
        found |= new
        waiting += new
    return found


def graph_of(function: casadi.Function) -> Graph:
    """Return the graph of an SX function, rewritten."""
    graph = instructions_of(function)
    _merge_equals(graph)
    _form_selects(graph)
    _share_choices(graph)
    _select_between_sums(graph)
    _use_reciprocals(graph)
    _fuse_multiply_adds(graph)
    return graph


def sources(function: casadi.Function, graph: Graph, inputs: Collection[int]) -> set[int]:
    """Return the nodes of a graph that are some inputs of its function."""
    nodes = [k for k, op in enumerate(graph.ops) if op == casadi.OP_INPUT]
    return {k for k in nodes if function.instruction_input(k)[0] in inputs}


def instructions_of(function: casadi.Function) -> Graph:
    """Return the instructions in static single assignment form: CasADi reuses registers."""
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


def _merge_equals(graph: Graph) -> None:
    """Let equal operations on equal operands be one node; CasADi finds most of them, but not in choices."""
    first: dict[tuple[object, ...], int] = {}
    same: dict[int, int] = {}
    for k, op in enumerate(graph.ops):
        operands = tuple(same.get(a, a) for a in graph.operands[k])
        if op in COMMUTATIVE:
            operands = tuple(sorted(operands))
        if op in NO_OPERATION:
            graph.replace(k, op, *operands)
        elif (op, operands) in first:
            same[k] = first[op, operands]
            graph.replace(k, REMOVED)
        else:
            first[op, operands] = k
            graph.replace(k, op, *operands)


def _form_selects(graph: Graph) -> None:
    """Rewrite `if_else_zero(c, x) + if_else_zero(not c, y)`, which is CasADi's `if_else`, as `select(c, x, y)`."""
    ops, operands, users = graph.ops, graph.operands, graph.users()
    for k, op in enumerate(ops):
        if op != casadi.OP_ADD or any(ops[a] != casadi.OP_IF_ELSE_ZERO for a in operands[k]):
            continue
        for yes, no in (operands[k], operands[k][::-1]):
            (condition, left), (otherwise, right) = operands[yes], operands[no]
            if ops[otherwise] == casadi.OP_NOT and operands[otherwise] == (condition,):
                graph.replace(k, SELECT, condition, left, right)
                for part in (yes, no):
                    if users[part] == [k]:
                        graph.replace(part, REMOVED)
                break


def _share_choices(graph: Graph) -> None:
    """Rewrite `if_else_zero(c, x y)` as `if_else_zero(c, x) y` where several choices have the same `c` and `x`.

    CasADi moves products and signs into choices, which takes one choice for each product and prevents multiply-adds.
    Where `y` may not be finite, the choice protects from it and stays.
    """
    ops, operands, made = graph.ops, graph.operands, {}
    unsafe = reached([k for k, op in enumerate(ops) if op in UNBOUNDED], graph.users())

    def node(op: int, *of: int) -> int:
        if (op, *of) not in made:
            made[op, *of] = graph.add(op, *of)
        return made[op, *of]

    waiting = True
    while waiting:
        products = {}
        for k, op in enumerate(ops):
            if op == casadi.OP_IF_ELSE_ZERO:
                condition, x = operands[k]
                made[op, condition, x] = k
                negative = ops[x] == casadi.OP_NEG
                x = operands[x][0] if negative else x
                if ops[x] == casadi.OP_MUL:
                    products[k] = condition, operands[x], negative
        counts = Counter((c, x) for c, factors, _ in products.values() for x in set(factors))
        waiting = False
        for k, (c, factors, negative) in products.items():
            x, y = sorted(factors, key=lambda factor: (factor not in unsafe, -counts[c, factor]))
            if counts[c, x] > 1 and y not in unsafe:
                choice = node(casadi.OP_IF_ELSE_ZERO, c, x)
                graph.replace(k, casadi.OP_MUL, node(casadi.OP_NEG, choice) if negative else choice, y)
                waiting = True
    used = graph.ancestors([k for k, op in enumerate(ops) if op == casadi.OP_OUTPUT])
    for k, op in enumerate(ops):
        if k not in used and op not in (casadi.OP_INPUT, casadi.OP_CONST):
            graph.replace(k, REMOVED)


def _select_between_sums(graph: Graph) -> None:
    """Rewrite `b + if_else_zero(c, x)` as `select(c, b + x, b)`: one instruction on CPUs with masked operations.

    Conditions that are outputs may be flags of parts, which must not depend on `b`.
    """
    ops, operands, users = graph.ops, graph.operands, graph.users()
    outputs = {operands[k] for k, op in enumerate(ops) if op == casadi.OP_OUTPUT}
    for k, op in enumerate(ops[:]):
        if op != casadi.OP_IF_ELSE_ZERO or not _has_one_user_a_sum(graph, users[k]) or operands[k][:1] in outputs:
            continue
        user, (condition, part) = users[k][0], operands[k]
        left, right = operands[user]
        if ops[user] == casadi.OP_ADD or right == k:
            other = left if right == k else right
            graph.replace(user, SELECT, condition, graph.add(ops[user], other, part), other)
            graph.replace(k, REMOVED)


def _use_reciprocals(graph: Graph) -> None:
    """Replace divisions by a constant, and several divisions by one value, by products with the reciprocal."""
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


def _fuse_multiply_adds(graph: Graph) -> None:
    """Fuse sums with products that have no other user; of two such products, the later one."""
    ops, operands, users = graph.ops, graph.operands, graph.users()
    for k in reversed(range(len(ops))):
        if ops[k] not in (casadi.OP_MUL, casadi.OP_SQ) or not _has_one_user_a_sum(graph, users[k]):
            continue
        user, a, b = users[k][0], operands[k][0], operands[k][-1]
        left, right = operands[user]
        if ops[user] == casadi.OP_ADD:
            graph.replace(user, FMA, a, b, right if left == k else left)
        elif left == k:
            graph.replace(user, FMS, a, b, right)
        else:
            graph.replace(user, FNMA, a, b, left)
        graph.replace(k, REMOVED)


def _has_one_user_a_sum(graph: Graph, users: list[int]) -> bool:
    """Whether the only user of a node is a sum or a difference."""
    return len(users) == 1 and graph.ops[users[0]] in (casadi.OP_ADD, casadi.OP_SUB)
