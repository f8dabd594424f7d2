"""`load_cuda_kernel`: read a kernel from the cache folder, or emit, compile and cache it."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from ce_gym.compile.cache import announced, cache_folder, read_or_make
from ce_gym.compile.cuda.kernel import CudaKernel, Launcher
from ce_gym.compile.cuda.nvrtc import Usage, compile_cubin, compiler_version
from ce_gym.compile.cuda.source import Source, emit_source
from ce_gym.compile.layout import layout_from
from ce_gym.compile.program import Program
from ce_gym.compile.sources import source_fingerprint, toolchain

SOURCES = tuple(f"ce_gym.compile.{name}" for name in ("arrays", "cuda", "layout", "lowering", "program"))
"""Modules that turn stages into entries of the cache."""
Stages = Callable[[], Sequence[Program]]
_loaded: dict[tuple[Path | None, str, int], CudaKernel] = {}
_lock = threading.RLock()


def load_cuda_kernel(key: str, build: Stages, dtype: str, gpu: int = 0) -> CudaKernel:
    """Return a kernel on a GPU from the cache, or compile and cache it.

    Args:
        key: all that the stages depend on, with the sources that build them. Equal keys must mean equal stages.
        build: returns the stages; called only if the machine code is not in the cache.
        dtype: `float64` or `float32`.
        gpu: number of the GPU.

    Raises:
        CudaUnavailable: If there is no such GPU, or a package is missing; one line.
        ValueError, NotImplementedError: See `emit_source`.
    """
    from ce_gym.compile.cuda.gpu import GpuLauncher, architecture

    arch, folder = architecture(gpu), cache_folder()
    name = kernel_name(key, dtype, arch)
    with _lock:
        if (folder, name, gpu) not in _loaded:
            code, source, _ = cached_cubin(folder, name, build, dtype, arch)
            _loaded[folder, name, gpu] = CudaKernel(source, GpuLauncher(code, source.threads, gpu), f"cuda:{gpu}")
        return _loaded[folder, name, gpu]


def kernel_name(key: str, dtype: str, arch: str) -> str:
    """Return the name of a kernel in the cache, from the key, our sources, the architecture and the compiler."""
    facts = repr((key, dtype, arch, compiler_version(), source_fingerprint(*SOURCES), toolchain()))
    return "cuda_" + hashlib.sha256(facts.encode()).hexdigest()[:24]


def cached_cubin(folder: Path | None, name: str, build: Stages, dtype: str, arch: str) -> tuple[bytes, Source, Usage]:
    """Read a kernel from the cache, or compile the kernel if it is missing or damaged.

    Returns:
        Machine code, the source, and the resources of a thread.
    """
    record, code = read_or_make(folder, name, lambda: _compile(build, dtype, arch, folder))
    source = Source(record["text"], layout_from(record["layout"]), record["threads"])
    return code, source, Usage(**record["usage"])


def _compile(build: Stages, dtype: str, arch: str, folder: Path | None) -> tuple[dict, bytes]:
    """Return source, layout and resources as JSON data, and machine code."""
    started = time.perf_counter()
    source = emit_source(build(), dtype)
    with announced(f"{source.layout.name} ({dtype}, {arch})", folder, started):
        code, usage = compile_cubin(source.text, arch)
    return asdict(source) | {"usage": asdict(usage)}, code


def host_kernel(build: Stages, dtype: str) -> CudaKernel:
    """Return a kernel that the CPU runs, for tests and comparisons without a GPU; see `ce_gym.compile.cuda.host`."""
    from ce_gym.compile.cuda.host import HostLauncher

    source = emit_source(build(), dtype)
    launch: Launcher = HostLauncher(source)
    return CudaKernel(source, launch, "cpu")
