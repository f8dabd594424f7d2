"""Fingerprints of the sources and tools that trace and compile a kernel, for the keys of the cache."""

import hashlib
import importlib.util
import platform
from functools import cache
from importlib.metadata import version
from pathlib import Path

COMPILERS = ("casadi", "llvmlite", "numpy")


@cache
def source_fingerprint(*names: str) -> str:
    """Return a hash of sources, for the keys of kernels whose programs the sources build.

    Args:
        names: importable modules, and packages with all their modules.

    Returns:
        16 hexadecimal digits.

    Raises:
        ValueError: when a name is not a module with Python sources.
    """
    digest = hashlib.sha256()
    for name in names:
        for path in source_files(name):
            digest.update(hashlib.sha256(path.read_bytes()).digest() + path.name.encode() + b"\n")
    return digest.hexdigest()[:16]


def source_files(name: str) -> list[Path]:
    """Return the .py files of a module, or of a package with all its modules."""
    spec = importlib.util.find_spec(name)
    if spec is not None and spec.submodule_search_locations is not None:
        return sorted(path for root in spec.submodule_search_locations for path in Path(root).rglob("*.py"))
    if spec is None or spec.origin is None:
        raise ValueError(f"module {name!r}: not found, expected an importable one with Python sources")
    return [Path(spec.origin)]


@cache
def toolchain() -> str:
    """Return the versions of the packages that trace and compile."""
    return ", ".join([f"{name} {version(name)}" for name in COMPILERS] + [f"Python {platform.python_version()}"])
