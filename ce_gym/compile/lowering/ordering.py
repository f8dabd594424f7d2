"""The order in which operations are emitted: a list schedule that keeps register pressure low.

A trace has several hundred live values, a CPU has 32 vector registers, and LLVM keeps the given order. With this order
the sub-step of a quadruped with 12 joints reloads a sixth fewer spilled values than with the order of CasADi.
"""

from __future__ import annotations

import heapq

import casadi

from ce_gym.compile.lowering.graph import NO_OPERATION, Graph

TWINS = (casadi.OP_SIN, casadi.OP_COS)
"""Operations that share an argument reduction."""


def ordered(graph: Graph) -> list[int]:
    """Return the operations, without inputs, constants and outputs, in the order of emission.

    Greedy: the next operation is the ready one that is the last user of most operands. Among equals, the operation that
    became ready last is next, because its operands are likely in registers.
    """
    ops, operands = graph.ops, graph.operands
    users = {k: list(dict.fromkeys(by)) for k, by in graph.users().items()}
    is_operation = [op not in NO_OPERATION for op in ops]
    needs = [{a for a in of if is_operation[a]} for of in operands]
    missing, waiting = [len(of) for of in needs], [len(users.get(k, ())) for k in range(len(ops))]
    done = [not it for it in is_operation]
    possible: list[tuple[int, int, int]] = []
    order: list[int] = []

    def offer(k: int) -> None:
        """Put an operation on the heap, again if its priority has risen."""
        heapq.heappush(possible, (-sum(waiting[a] == 1 for a in needs[k]), -len(order), k))

    def do(k: int) -> None:
        done[k] = True
        order.append(k)
        for a in needs[k]:
            waiting[a] -= 1
            if waiting[a] == 1:
                for user in users[a]:
                    if not done[user] and missing[user] == 0:
                        offer(user)
        for user in users.get(k, ()):
            missing[user] -= 1
            if not done[user] and missing[user] == 0:
                offer(user)

    for k in range(len(ops)):
        if not done[k] and missing[k] == 0:
            offer(k)
    while possible:
        k = heapq.heappop(possible)[-1]
        if done[k]:
            continue
        do(k)
        if ops[k] in TWINS:
            for twin in users[operands[k][0]]:
                if ops[twin] in TWINS and not done[twin]:
                    do(twin)
    return order
