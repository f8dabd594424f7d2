"""What the machine code of a program follows from, beside the program itself: our sources, versions, the CPU."""

import hashlib
import importlib.util
import platform
from functools import cache
from importlib.metadata import version
from pathlib import Path

COMPILERS = ("casadi", "llvmlite", "numpy")


@cache
def source_fingerprint(*packages: str) -> str:
    """Hash of what the machine code follows from, beside the program itself.

    Args:
        packages: importable packages whose .py files count.

    Returns:
        16 hexadecimal digits, over the sources, the versions of CasADi, llvmlite, numpy and Python, and the CPU's name
        and features.
    """
    from ce_gym.compile.machine_code import host_cpu

    digest = hashlib.sha256()
    for package in packages:
        for path in _sources(package):
            digest.update(path.name.encode() + b"\0" + path.read_bytes())
    facts = [f"{name} {version(name)}" for name in COMPILERS] + [platform.python_version(), platform.machine()]
    digest.update("\n".join((*facts, *host_cpu())).encode())
    return digest.hexdigest()[:16]


def _sources(package: str) -> list[Path]:
    spec = importlib.util.find_spec(package)
    if spec is None or spec.submodule_search_locations is None:
        raise ValueError(f"package {package!r}: not found, expected an importable package with Python sources")
    return sorted(path for root in spec.submodule_search_locations for path in Path(root).rglob("*.py"))
