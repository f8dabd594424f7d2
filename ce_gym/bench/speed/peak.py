"""The most floating-point operations per second that a core does: independent chains of fused multiply-adds.

Compiled on the same way as everything else, so that vectors, flags and threads are those of the step.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ce_gym.bench.measure.timing import Competitor
from ce_gym.compile import (
    Buffer,
    Call,
    Kernel,
    Program,
    Repeat,
    aligned_zeros,
    lane_count,
    load_kernel,
    source_fingerprint,
)

CHAINS, LINKS = 16, 4
"""So many chains that they hide the latency of two units and stay in registers. Code goes through one chain after the
other, as that needs fewest registers: links of all chains must fit into what a CPU looks ahead."""

REPEATS = 400_000
"""Several milliseconds: a core that has done scalar work takes a while to reach its pace in vector work."""


def competitor(dtype: str, num_threads: int = 1) -> Competitor:
    """Return the chains as something to time; one unit of work is one floating-point operation."""
    kernel, lanes = _kernel(dtype), lane_count(dtype)
    arrays = {name: aligned_zeros((num_threads, b.size, lanes), dtype) for name, b in kernel.buffers.items()}
    arrays["factor"][:] = 0.5  # the chains settle at 1
    num_envs = num_threads * lanes

    def run() -> None:
        kernel(arrays, num_envs, repeats={"times": REPEATS}, num_threads=num_threads)

    return Competitor(run, 2 * CHAINS * LINKS * REPEATS * num_envs)


def links(x: np.ndarray) -> np.ndarray:
    """Return what the chains make of `x`, for factors of one half, shape (...)."""
    for _ in range(LINKS):
        x = 0.5 * x + 0.5
    return x


def _kernel(dtype: str) -> Kernel:
    def build() -> Program:
        x, factor = ca.SX.sym("x", CHAINS), ca.SX.sym("factor", 2)
        after = x
        for _ in range(LINKS):
            after = factor[0] * after + factor[1]
        call = Call(ca.Function("chains", [x, factor], [after]), ("x", "factor"), ("x",))
        buffers = (Buffer("x", CHAINS, "tiles"), Buffer("factor", 2, "tiles"))
        return Program("chains of multiply-adds", buffers, (Repeat("times", (call,)),))

    return load_kernel(source_fingerprint(__name__), build, dtype)
