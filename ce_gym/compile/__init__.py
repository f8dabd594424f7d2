"""CasADi SX functions, and look-ups in tables between them, as batched SIMD kernels.

Importing this package imports none of the heavy ones: `load_kernel` does, when it is called.
"""

from ce_gym.compile.arrays import aligned_copy, aligned_zeros, lane_count
from ce_gym.compile.critical import CriticalSection
from ce_gym.compile.kernel import Kernel
from ce_gym.compile.loading import load_kernel
from ce_gym.compile.program import Buffer, Call, Grid, Lookup, Program, Repeat, Step, While, calls_of, scratch_buffers
from ce_gym.compile.sources import source_fingerprint

__all__ = [
    "Buffer",
    "Call",
    "CriticalSection",
    "Grid",
    "Kernel",
    "Lookup",
    "Program",
    "Repeat",
    "Step",
    "While",
    "aligned_copy",
    "aligned_zeros",
    "calls_of",
    "lane_count",
    "load_kernel",
    "scratch_buffers",
    "source_fingerprint",
]
