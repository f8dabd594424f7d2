"""`load_cuda_kernel`: from the cache folder, or emitted, compiled and put there. Knows the order of these steps."""

from __future__ import annotations

import hashlib
import json
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from ce_gym.compile.cache import announce, cache_folder, checksum, source_fingerprint, write_atomically
from ce_gym.compile.cuda.kernel import CudaKernel, Launcher
from ce_gym.compile.cuda.nvrtc import Usage, compile_cubin, compiler_version
from ce_gym.compile.cuda.source import Source, emit_source
from ce_gym.compile.layout import layout_from_json, layout_to_json
from ce_gym.compile.program import Program

Stages = Callable[[], Sequence[Program]]
_loaded: dict[tuple[Path, str, int], CudaKernel] = {}
_lock = threading.RLock()


def load_cuda_kernel(key: str, build: Stages, dtype: str, gpu: int = 0) -> CudaKernel:
    """A kernel from the cache, or compiled and put there, on a GPU.

    Args:
        key: names everything the stages depend on; equal keys must mean equal stages.
        build: makes the stages; called only when the machine code is not in the cache.
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
            _loaded[folder, name, gpu] = CudaKernel(source, GpuLauncher(code, gpu), f"cuda:{gpu}")
        return _loaded[folder, name, gpu]


def kernel_name(key: str, dtype: str, arch: str) -> str:
    """Return the name under which a kernel is cached: our sources, the architecture and the compiler count."""
    facts = repr((key, dtype, arch, compiler_version(), source_fingerprint("ce_gym")))
    return "cuda_" + hashlib.sha256(facts.encode()).hexdigest()[:24]


def cached_cubin(folder: Path, name: str, build: Stages, dtype: str, arch: str) -> tuple[bytes, Source, Usage]:
    """Read `<name>.cubin`, `<name>.cu` and `<name>.json`, written last; make them if one is missing or damaged.

    Returns:
        Machine code, the source, and what the kernel takes.
    """
    cubin, text, record = (folder / f"{name}.{suffix}" for suffix in ("cubin", "cu", "json"))
    try:
        known = json.loads(record.read_text(encoding="utf-8"))
        if known["files"] == [checksum(cubin), checksum(text)]:
            source = Source(text.read_text(encoding="utf-8"), layout_from_json(known["layout"]))
            return cubin.read_bytes(), source, Usage(**known["usage"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    started = time.perf_counter()
    source = emit_source(build(), dtype)
    announce(f"ce_gym: compiling {source.layout.name} ({dtype}, {arch}), once; cached in {folder} ...")
    code, usage = compile_cubin(source.text, arch)
    announce(f" {time.perf_counter() - started:.1f} s\n")
    write_atomically(text, source.text)
    write_atomically(cubin, code)
    content = {
        "layout": layout_to_json(source.layout),
        "usage": asdict(usage),
        "files": [checksum(cubin), checksum(text)],
    }
    write_atomically(record, json.dumps(content))
    return code, source, usage


def host_kernel(build: Stages, dtype: str, folder: Path | None = None) -> CudaKernel:
    """The same kernel run by the processor, for tests and comparisons without a GPU; see `ce_gym.compile.cuda.host`."""
    from ce_gym.compile.cuda.host import HostLauncher

    source = emit_source(build(), dtype)
    launch: Launcher = HostLauncher(source, folder)
    return CudaKernel(source, launch, "cpu")
