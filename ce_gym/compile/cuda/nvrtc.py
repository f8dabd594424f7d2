# pyright: reportAttributeAccessIssue=false
"""Compilation of CUDA C by the run-time compiler of NVIDIA, with the registers and spills that the compiler reports.

This takes the packages `cuda-core` and `nvidia-cuda-nvrtc` (extra `gpu`), but no GPU, driver or C compiler. The first
line turns off checks of types, because compiled modules have none.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from functools import cache

OPTIONS = {
    "std": "c++17",
    "fma": False,
    "prec_div": True,
    "prec_sqrt": True,
    "ftz": False,
    "no_cache": True,
    "disable_warnings": True,
}
"""Every operation is rounded to nearest and alone. Multiply-adds have been fused before, equally for every device, by
`ce_gym.compile.lowering.graph`."""
REGISTERS = 65536
"""32-bit registers of a multiprocessor, on every architecture from sm_70 to sm_120."""
WARPS = {"80": 64, "86": 48, "87": 48, "89": 48, "90": 64, "100": 64, "120": 48}
"""Most warps of a multiprocessor, by architecture (CUDA C++ Programming Guide, compute capabilities)."""


@dataclass(frozen=True)
class Usage:
    """Resources of a thread of a kernel.

    Attributes:
        registers: 32-bit registers.
        stack: local memory [bytes] of arrays without registers, and of spills.
        spill_stores, spill_loads: bytes of spills that the code writes and reads, each instruction once.
    """

    registers: int
    stack: int
    spill_stores: int
    spill_loads: int

    def occupancy(self, arch: str, block: int) -> float:
        """Return the fraction of the warps of a multiprocessor that fit into its registers; `block` is in threads."""
        most = WARPS[arch.removeprefix("sm_").rstrip("a")]
        per_warp = -(-32 * self.registers // 256) * 256  # allocated in units of 256
        blocks = (REGISTERS // per_warp) // (block // 32)
        return min(blocks * (block // 32), most) / most


class CudaUnavailable(ValueError):
    """CUDA cannot be used; one line says which part is missing and how to install it."""


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
        Machine code, and the resources of a thread.

    Raises:
        CudaUnavailable: If the compiler is not installed.
        RuntimeError: One line, if the compiler rejects the source.
    """
    compiler_version()
    from cuda.core import Program, ProgramOptions

    options = ProgramOptions(arch=arch, ptxas_options="-v", **OPTIONS)
    log = io.StringIO()
    try:
        code = Program(text, "c++", options).compile("cubin", logs=log)
    except Exception as problem:  # another class in every version
        lines = [line for line in f"{problem}\n{log.getvalue()}".splitlines() if "error" in line.lower()]
        raise RuntimeError(f"{text.splitlines()[0]}: {arch}: {(lines or ['refused'])[-1].strip()}") from None
    return bytes(code.code), usage_in(log.getvalue())


def usage_in(log: str) -> Usage:
    """Return the resources of a thread from the log of the compiler.

    Raises:
        RuntimeError: If the log does not say.
    """
    spills = re.findall(r"(\d+) bytes spill stores, (\d+) bytes spill loads", log)  # of the kernel and of its functions
    used = re.findall(r"Used (\d+) registers(?:.* (\d+) bytes cumulative stack size)?", log)
    if not spills or len(used) != 1:
        raise RuntimeError("the compiler's log does not say what the kernel takes")
    stores, loads = (sum(map(int, column)) for column in zip(*spills, strict=True))
    return Usage(int(used[0][0]), int(used[0][1] or 0), stores, loads)
