"""Timings in several processes one after the other, of which the fastest counts.

Where code and memory of a process lie makes one in five 15 to 30 % slower than others until it ends
(docs/explanation/numerics.md), and a kernel is loaded once in a process, so that neither rounds nor further copies
there tell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TypeAlias

from ce_gym.bench.measure.timing import Timing

Timings: TypeAlias = Mapping[str, Mapping[str, Timing]]
"""Of each case, those of its sides."""


def in_processes(measure: Callable[[], Timings], processes: int) -> Timings:
    """Return what a picklable function measures in so many new processes, the fastest; if in one, in this one."""
    if processes == 1:
        return measure()
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
        return fastest([pool.submit(measure).result() for _ in range(processes)])


def fastest(found: Sequence[Timings]) -> Timings:
    """Return timings of sides, round by round of the process that was the fastest then."""
    first, *_ = found
    return {
        case: {
            side: Timing(tuple(map(min, zip(*(each[case][side].seconds for each in found), strict=True))))
            for side in sides
        }
        for case, sides in first.items()
    }
