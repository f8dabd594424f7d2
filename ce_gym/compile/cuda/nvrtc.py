# pyright: reportAttributeAccessIssue=false
"""From CUDA C to machine code by NVIDIA's run-time compiler, and what the compiler tells of it.

Uses the packages `cuda-core` and `nvidia-cuda-nvrtc` (extra `gpu`); needs neither a GPU, a driver nor a C compiler.
(Compiled modules carry no types, hence the line above.)
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from functools import cache

OPTIONS = {"std": "c++17", "fma": False, "prec_div": True, "prec_sqrt": True, "ftz": False, "disable_warnings": True}
"""Every operation is rounded to nearest and by itself: which products and sums are rounded together is settled before,
for every device alike (`ce_gym.compile.lowering.graph`)."""
REGISTERS = 65536
"""32-bit registers of a multiprocessor, on every architecture from sm_70 to sm_120."""
WARPS = {"80": 64, "86": 48, "87": 48, "89": 48, "90": 64, "100": 64, "120": 48}
"""Most warps of a multiprocessor, by architecture (CUDA C++ Programming Guide, compute capabilities)."""


@dataclass(frozen=True)
class Usage:
    """What a thread of a kernel takes.

    Attributes:
        registers: 32-bit registers.
        stack: local memory [bytes]: arrays that have no register, and spills.
        spill_stores, spill_loads: bytes that the code writes and reads for want of registers, each place once.
    """

    registers: int
    stack: int
    spill_stores: int
    spill_loads: int

    def occupancy(self, arch: str, block: int) -> float:
        """Return the share of a multiCPU's warps that its registers can serve, as blocks of `block` threads."""
        most = WARPS[arch.removeprefix("sm_").rstrip("a")]
        per_warp = -(-32 * self.registers // 256) * 256  # registers are given to warps in units of 256
        blocks = (REGISTERS // per_warp) // (block // 32)
        return min(blocks * (block // 32), most) / most


class CudaUnavailable(ValueError):
    """What CUDA needs is not there; one line says what and how to get it."""


@cache
def compiler_version() -> str:
    """Return the version of the run-time compiler, such as `13.5`.

    Raises:
        CudaUnavailable: If it is not installed.
    """
    try:
        from cuda.bindings import nvrtc

        error, major, minor = nvrtc.nvrtcVersion()
    except (ImportError, RuntimeError, OSError) as problem:
        raise CudaUnavailable(_missing("the run-time compiler")) from problem
    if int(error):
        raise CudaUnavailable(_missing("a run-time compiler that works"))
    return f"{major}.{minor}"


def _missing(what: str) -> str:
    return f"device='cuda': {what} was not found; expected the extra gpu: pip install 'ce_gym[gpu]'"


def compile_cubin(text: str, arch: str) -> tuple[bytes, Usage]:
    """Compile a source.

    Args:
        text: CUDA C.
        arch: such as `sm_90`.

    Returns:
        Machine code, and what its kernel takes.

    Raises:
        CudaUnavailable: If the compiler is not installed.
        RuntimeError: One line, if it refuses the source.
    """
    compiler_version()
    from cuda.core import Program, ProgramOptions

    options = ProgramOptions(arch=arch, ptxas_options="-v", **OPTIONS)
    log = io.StringIO()
    try:
        code = Program(text, "c++", options).compile("cubin", logs=log)
    except Exception as problem:  # of a class of its own in every version
        lines = [line for line in f"{problem}\n{log.getvalue()}".splitlines() if "error" in line.lower()]
        raise RuntimeError(f"{text.splitlines()[0]}: {arch}: {(lines or ['refused'])[-1].strip()}") from None
    return bytes(code.code), usage_in(log.getvalue())


def usage_in(log: str) -> Usage:
    """Read what a kernel takes from the compiler's log.

    Raises:
        RuntimeError: If the log does not say.
    """
    spills = re.findall(r"(\d+) bytes spill stores, (\d+) bytes spill loads", log)  # of the kernel and what it calls
    used = re.findall(r"Used (\d+) registers(?:.* (\d+) bytes cumulative stack size)?", log)
    if not spills or len(used) != 1:
        raise RuntimeError("the compiler's log does not say what the kernel takes")
    stores, loads = (sum(map(int, column)) for column in zip(*spills, strict=True))
    return Usage(int(used[0][0]), int(used[0][1] or 0), stores, loads)
