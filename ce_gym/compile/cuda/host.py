"""Emitted CUDA C on the CPU: a C++ compiler compiles the same text with a few definitions in place of CUDA.

This is for tests and comparisons without a GPU. It checks arithmetic, copies and the order of stages. It does not check
that a GPU rounds according to IEEE 754, and says little about speed.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ce_gym.compile.cache import cache_folder, read_or_make
from ce_gym.compile.cuda.source import BLOCK, ENTRY, Source

SHIM = """#include <cmath>
#include <cstring>
using namespace std;
#define __device__
#define __constant__ static
#define __global__
#define __forceinline__ inline
#define __noinline__
#define __launch_bounds__(...)
struct Place { unsigned x; };
static thread_local Place blockIdx, threadIdx;
static double __longlong_as_double(long long a) { double b; memcpy(&b, &a, 8); return b; }
static long long __double_as_longlong(double a) { long long b; memcpy(&b, &a, 8); return b; }
static float __int_as_float(int a) { float b; memcpy(&b, &a, 4); return b; }
static int __float_as_int(float a) { int b; memcpy(&b, &a, 4); return b; }
"""

OPTIONS = ("-std=c++17", "-O0", "-w", "-ffp-contract=off", "-shared", "-fPIC")
"""Without optimisation, which takes minutes; nothing is fused or reordered."""


def host_compiler() -> list[str] | None:
    """Return the command of a C++ compiler, the one of the package `ziglang` if the machine has none, or None."""
    for name in ("c++", "g++", "clang++"):
        if found := shutil.which(name):
            return [found]
    if importlib.util.find_spec("ziglang"):
        return [sys.executable, "-m", "ziglang", "c++"]
    return None


class HostLauncher:
    """Runs an emitted kernel robot by robot on arrays in the CPU's memory.

    Args:
        source: The kernel; compiled only if its library is not in the cache.

    Raises:
        RuntimeError: One line, if there is no C++ compiler or it refuses the source.
    """

    def __init__(self, source: Source) -> None:
        compiler = host_compiler()
        if compiler is None:
            raise RuntimeError("no C++ compiler (c++, g++, clang++ or the package ziglang) to run CUDA C on the host")
        text = SHIM + source.text + _loop(source.text)
        name = "host_" + hashlib.sha256(" ".join((*compiler, *OPTIONS, text)).encode()).hexdigest()[:24]
        _, code = read_or_make(cache_folder(), name, lambda: ({}, _compile(compiler, text, source.layout.name)))
        self._run = _load(code).run_all

    def __call__(self, addresses: Sequence[int], numbers: Sequence[int], count: int) -> None:
        """Run the kernel on all robots.

        Args:
            addresses: Of the arrays, in the order of the layout.
            numbers: Rows and columns of tables, repeat counts.
            count: Number of robots.
        """
        self._run(*map(ctypes.c_void_p, addresses), *map(ctypes.c_int, numbers), ctypes.c_int(count))


def _compile(compiler: list[str], text: str, name: str) -> bytes:
    """Return a shared library."""
    with tempfile.TemporaryDirectory(prefix="ce_gym-") as folder:
        file, library = Path(folder) / "kernel.cpp", Path(folder) / "kernel.so"
        file.write_text(text, encoding="utf-8")
        result = subprocess.run([*compiler, *OPTIONS, str(file), "-o", str(library)], capture_output=True, text=True)
        if result.returncode:
            errors = [line for line in result.stderr.splitlines() if "error" in line]
            raise RuntimeError(f"{name}: {(errors or [result.stderr])[0]}")
        return library.read_bytes()


def _load(code: bytes) -> ctypes.CDLL:
    """Load a shared library from a temporary file."""
    with tempfile.TemporaryDirectory(prefix="ce_gym-", ignore_cleanup_errors=True) as folder:
        file = Path(folder) / "kernel.so"
        file.write_bytes(code)
        return ctypes.CDLL(str(file))


def _loop(text: str) -> str:
    """Return a C function with the arguments of the kernel that runs its threads one after the other."""
    found = re.search(rf'extern "C" __global__ void [^;{{]*? {ENTRY}\((?P<arguments>[^)]*)\)', text)
    assert found, "no kernel in the source"
    arguments = " ".join(found["arguments"].split())
    names = ", ".join(part.split()[-1] for part in arguments.split(","))
    return f"""
extern "C" void run_all({arguments})
{{
    for (unsigned thread = 0; thread < unsigned(count); ++thread) {{
        blockIdx.x = thread / {BLOCK};
        threadIdx.x = thread % {BLOCK};
        {ENTRY}({names});
    }}
}}
"""
