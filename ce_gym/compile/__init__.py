"""Compiler of CasADi SX functions, with look-ups in tables between them, to batched SIMD kernels.

Importing this package imports neither CasADi nor LLVM; `load_kernel` does so when needed.
"""

from ce_gym.compile.arrays import aligned_copy, aligned_zeros, lane_count, tile_count
from ce_gym.compile.critical import CriticalSection
from ce_gym.compile.kernel import Kernel
from ce_gym.compile.loading import export_symbol, load_kernel
from ce_gym.compile.program import (
    Buffer,
    Call,
    Foreign,
    Grid,
    Lookup,
    Program,
    Repeat,
    Step,
    While,
    calls_of,
    scratch_buffers,
)
from ce_gym.compile.sources import source_fingerprint

__all__ = [
    "Buffer",
    "Call",
    "CriticalSection",
    "Foreign",
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
    "export_symbol",
    "lane_count",
    "load_kernel",
    "scratch_buffers",
    "source_fingerprint",
    "tile_count",
]
