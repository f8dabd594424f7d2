"""Sub-steps made in pieces, between which a long call answers Ctrl-C."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ce_gym.compile import CriticalSection
from ce_gym.sim.substeps import TIMES

LONGEST = 100_000
"""Sub-steps of all robots in one piece: a fraction of a second, whatever the robot and the method."""
FEWEST = 16
"""Robots that take no less time than this many: the lanes of a tile."""


def piece_length(num_envs: int) -> int:
    """Return the most sub-steps in one piece for so many robots."""
    return max(1, LONGEST // max(num_envs, FEWEST))


def run_substeps(
    kernel: Any,
    arrays: Mapping[str, Any],
    num_envs: int,
    n_substeps: int,
    section: CriticalSection,
    num_threads: int = 1,
) -> None:
    """Call a kernel until it has made `n_substeps` sub-steps; the state is that of a single call, bit for bit.

    Args:
        kernel: Repeats sub-steps.
        arrays: What it takes.
        num_envs: Number of robots.
        n_substeps: Number of sub-steps.
        section: The one that this is called in; its interruption points are between the pieces.
        num_threads: Threads that share the robots.
    """
    longest = piece_length(num_envs)
    while True:
        kernel(arrays, num_envs, repeats={TIMES: min(n_substeps, longest)}, num_threads=num_threads)
        n_substeps -= longest
        if n_substeps <= 0:
            return
        section.interruption_point()
