"""`load_kernel`: read a kernel from the cache folder, or compile and cache it.

LLVM and CasADi are imported only when they are needed.
"""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from ce_gym.compile.arrays import lane_count
from ce_gym.compile.cache import announced, cache_folder, read_or_make
from ce_gym.compile.kernel import Kernel
from ce_gym.compile.layout import layout_from, layout_of
from ce_gym.compile.program import Call, Program, check_program
from ce_gym.compile.sources import source_fingerprint, toolchain
from ce_gym.compile.system import at_fork

SOURCES = tuple(
    f"ce_gym.compile.{name}" for name in ("arrays", "layout", "loading", "lowering", "machine_code", "program")
)
"""Modules that turn programs into entries of the cache."""

SECONDS = 1.5e-4
"""Time to compile an instruction of CasADi on a core of 2024 [s], for estimates."""

_loaded: dict[tuple[Path | None, str], Kernel] = {}
_lock = threading.RLock()


def load_kernel(key: str, build: Callable[[], Program], dtype: str = "float64") -> Kernel:
    """Return a kernel from the cache, or compile and cache it.

    Args:
        key: all that the program depends on, with the sources that build the program (`source_fingerprint`). Equal keys
            must mean equal programs.
        build: returns the program; called only if the machine code is not in the cache.
        dtype: `float64` or `float32`.

    Returns:
        The kernel; always the same object within a process.

    Raises:
        ValueError: when the program is not well formed.
        NotImplementedError: when a function has an operation without a vector form.
    """
    dtype = np.dtype(dtype).name
    lane_count(dtype)  # refuses other dtypes
    name, folder = kernel_name(key, dtype), cache_folder()
    with _lock:
        if (folder, name) not in _loaded:
            _loaded[folder, name] = _load(folder, name, build, dtype)
        return _loaded[folder, name]


def export_symbol(kernel: Kernel) -> str:
    """Let code that numba compiles in this process call a kernel by name, and return the name."""
    from ce_gym.compile.machine_code import add_symbol

    name = f"ce_gym_{kernel.digest}"
    add_symbol(name, kernel.code)
    return name


def kernel_name(key: str, dtype: str) -> str:
    """Return the name of a kernel in the cache, from the key, the dtype, the compiler and the CPU."""
    from ce_gym.compile.machine_code import host_cpu

    facts = repr((key, dtype, source_fingerprint(*SOURCES), toolchain(), host_cpu()))
    return "kernel_" + hashlib.sha256(facts.encode()).hexdigest()[:24]


def _load(folder: Path | None, name: str, build: Callable[[], Program], dtype: str) -> Kernel:
    from ce_gym.compile.machine_code import load_object

    record, code = read_or_make(folder, name, lambda: _compile(build, dtype, folder))
    return Kernel(layout_from(record), load_object(code), name)


def _compile(build: Callable[[], Program], dtype: str, folder: Path | None) -> tuple[dict, bytes]:
    """Return the calling convention as JSON data, and object code."""
    from ce_gym.compile.lowering.tile import emit_tile
    from ce_gym.compile.machine_code import compile_object, registers_per_vector

    started = time.perf_counter()
    program = build()
    check_program(program)
    layout = layout_of(program, dtype)
    functions = {call.function for call in program.calls if isinstance(call, Call)}
    expected = SECONDS * sum(function.n_instructions() for function in functions)
    with announced(f"{program.name} ({dtype})", folder, started, expected):
        parts = registers_per_vector() if program.compact else 1
        code = compile_object(
            lambda builder, arguments: emit_tile(builder, program, layout, arguments, parts), not program.compact
        )
    return asdict(layout), code


# A child could wait forever for a compiling thread of its parent.
at_fork(before=_lock.acquire, in_parent=_lock.release, in_child=_lock.release)
