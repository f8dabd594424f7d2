"""Interruptible runs: a long call is split into short calls of the kernel, between which Ctrl-C takes effect."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ce_gym.compile import CriticalSection
from ce_gym.sim.substeps import TIMES

NONE: Mapping[str, int] = {}
LONGEST = 64
"""Most sub-steps in one call of a kernel, for batches of any size.

A kernel integrates momentum through all sub-steps of a call, see `ce_gym.dynamics.stepping.conservation`. A call in
other pieces gives the same motion up to rounding.
"""


def is_long(n_substeps: int) -> bool:
    """Whether a call is made in pieces."""
    return n_substeps > LONGEST


def run_substeps(
    kernel: Any,
    arrays: Mapping[str, Any],
    num_envs: int,
    n_substeps: int,
    section: CriticalSection,
    num_threads: int = 1,
    addresses: Mapping[str, int] = NONE,
) -> None:
    """Call a kernel until it has made `n_substeps` sub-steps.

    Args:
        kernel: Repeats sub-steps.
        arrays: Arguments of the kernel.
        num_envs: Number of robots.
        n_substeps: Number of sub-steps.
        section: The section around this call; its interruption points are between the calls of the kernel.
        num_threads: Threads that share the robots.
        addresses: Addresses of functions that the kernel calls, by name.
    """
    while True:
        kernel(arrays, num_envs, repeats={TIMES: min(n_substeps, LONGEST), **addresses}, num_threads=num_threads)
        n_substeps -= LONGEST
        if n_substeps <= 0:
            return
        section.interruption_point()
