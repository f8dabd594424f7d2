"""The order in which operations are emitted: a list schedule that keeps register pressure low.

A trace has several hundred live values, a CPU has 32 vector registers, and LLVM keeps the given order. With this order
the sub-step of a quadruped with 12 joints reloads a sixth fewer spilled values than with the order of CasADi.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Collection

import casadi

from ce_gym.compile.lowering.graph import NO_OPERATION, Graph

TWINS = (casadi.OP_SIN, casadi.OP_COS)
"""Operations that share an argument reduction."""


def ordered(graph: Graph, nodes: Collection[int] | None = None, outputs: Collection[int] | None = None) -> list[int]:
    """Return the operations, without inputs, constants and outputs, in the order of emission.

    Args:
        graph: The function.
        nodes: Operations to order; all if None.
        outputs: Output nodes that use them; all if None.

    Greedy: the next operation is the ready one that is the last user of most operands. Among equals, the operation that
    became ready last is next, because its operands are likely in registers.
    """
    ops, operands = graph.ops, graph.operands
    chosen = sorted([k for k, op in enumerate(ops) if op not in NO_OPERATION] if nodes is None else nodes)
    if outputs is None:
        outputs = [k for k, op in enumerate(ops) if op == casadi.OP_OUTPUT]
    members, done = set(chosen), set[int]()
    needs = {k: {a for a in operands[k] if a in members} for k in chosen}
    users: dict[int, list[int]] = defaultdict(list)
    for k in sorted((*chosen, *outputs)):
        for a in dict.fromkeys(operands[k]):
            users[a].append(k)
    missing, waiting = {k: len(of) for k, of in needs.items()}, {k: len(users[k]) for k in chosen}
    possible: list[tuple[int, int, int]] = []
    order: list[int] = []

    def offer(k: int) -> None:
        """Put an operation on the heap, again if its priority has risen."""
        heapq.heappush(possible, (-sum(waiting[a] == 1 for a in needs[k]), -len(order), k))

    def do(k: int) -> None:
        done.add(k)
        order.append(k)
        for a in needs[k]:
            waiting[a] -= 1
            if waiting[a] == 1:
                for user in users[a]:
                    if user in members and user not in done and missing[user] == 0:
                        offer(user)
        for user in users[k]:
            if user not in members:
                continue
            missing[user] -= 1
            if user not in done and missing[user] == 0:
                offer(user)

    for k in chosen:
        if missing[k] == 0:
            offer(k)
    while possible:
        k = heapq.heappop(possible)[-1]
        if k in done:
            continue
        do(k)
        if ops[k] in TWINS:
            for twin in users[operands[k][0]]:
                if ops[twin] in TWINS and twin in members and twin not in done:
                    do(twin)
    return order
