"""Interruptible runs: a long call is split into short calls of the kernel, between which Ctrl-C takes effect."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ce_gym.compile import CriticalSection
from ce_gym.sim.substeps import TIMES

NONE: Mapping[str, int] = {}
LONGEST = 100_000
"""Most sub-steps of all robots in one call of a kernel, which take a fraction of a second for any robot and method."""
FEWEST = 16
"""Smaller batches take as long as this many robots: the lanes of a tile."""


def longest_run(num_envs: int) -> int:
    """Return the most sub-steps in one call of a kernel for a number of robots."""
    return max(1, LONGEST // max(num_envs, FEWEST))


def run_substeps(
    kernel: Any,
    arrays: Mapping[str, Any],
    num_envs: int,
    n_substeps: int,
    section: CriticalSection,
    num_threads: int = 1,
    addresses: Mapping[str, int] = NONE,
) -> None:
    """Call a kernel until it has made `n_substeps` sub-steps; results have the same bits as after a single call.

    Args:
        kernel: Repeats sub-steps.
        arrays: Arguments of the kernel.
        num_envs: Number of robots.
        n_substeps: Number of sub-steps.
        section: The section around this call; its interruption points are between the calls of the kernel.
        num_threads: Threads that share the robots.
        addresses: Addresses of functions that the kernel calls, by name.
    """
    longest = longest_run(num_envs)
    while True:
        kernel(arrays, num_envs, repeats={TIMES: min(n_substeps, longest), **addresses}, num_threads=num_threads)
        n_substeps -= longest
        if n_substeps <= 0:
            return
        section.interruption_point()
