"""`load_kernel`: from the cache folder, or built, compiled and put there.

Knows the order of these steps and nothing of how each is done. numba and CasADi are imported when a step needs them.
"""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ce_gym.compile.arrays import lane_count
from ce_gym.compile.cache import announce, cache_folder, source_fingerprint
from ce_gym.compile.kernel import Kernel
from ce_gym.compile.layout import Layout, layout_from_json, layout_of, layout_to_json
from ce_gym.compile.program import Program, check_program

_loaded: dict[tuple[Path, str], Kernel] = {}
_lock = threading.RLock()


def load_kernel(key: str, build: Callable[[], Program], dtype: str = "float64") -> Kernel:
    """A kernel from the cache, or compiled and put there.

    Args:
        key: names everything the program depends on; equal keys must mean equal programs.
        build: makes the program; it is called only when the machine code is not in the cache.
        dtype: `float64` or `float32`.

    Returns:
        The kernel; one and the same within a process.

    Raises:
        ValueError: when the program is not well formed.
        NotImplementedError: when a function holds an operation that has no vector form.
    """
    dtype = np.dtype(dtype).name
    lane_count(dtype)  # refuses other dtypes
    facts = repr((key, dtype, source_fingerprint("ce_gym")))
    name = "kernel_" + hashlib.sha256(facts.encode()).hexdigest()[:24]
    folder = cache_folder()
    with _lock:
        if (folder, name) not in _loaded:
            _loaded[folder, name] = _load(folder, name, _Source(build, dtype, folder))
        return _loaded[folder, name]


def _load(folder: Path, name: str, source: _Source) -> Kernel:
    from ce_gym.compile.module import CachedModule

    with source:
        module = CachedModule(folder, name)
        content = module.read()
        layout = source.layout() if content is None else layout_from_json(content)
        run = module.load(source.emit)
        if source.program is not None:
            module.write(layout_to_json(layout))
    return Kernel(layout, run)


class _Source:
    """The program, built at the moment something asks for it; tells the user how long the compilation took."""

    def __init__(self, build: Callable[[], Program], dtype: str, folder: Path):
        self.program: Program | None = None
        self._build, self._dtype, self._folder = build, dtype, folder
        self._started = 0.0

    def __enter__(self) -> None:
        self._started = time.perf_counter()

    def __exit__(self, *error: object) -> None:
        if self.program is not None:
            announce(f" {time.perf_counter() - self._started:.1f} s\n")

    def get(self) -> Program:
        """The program; the first call builds it."""
        if self.program is None:
            program = self._build()
            check_program(program)
            announce(f"ce_gym: compiling {program.name} ({self._dtype}), once; cached in {self._folder} ...")
            self.program = program
        return self.program

    def layout(self) -> Layout:
        """Its calling convention."""
        return layout_of(self.get(), self._dtype)

    def emit(self, builder: Any, arguments: tuple) -> None:
        """Emit the work on one tile."""
        from ce_gym.compile.lowering.tile import emit_tile

        emit_tile(builder, self.get(), self.layout(), arguments)
