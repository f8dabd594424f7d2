"""The folder of compiled kernels, what their names depend on, and writing that survives two processes at once.

Knows files and versions; knows nothing of kernels' contents.
"""

import hashlib
import importlib.util
import os
import platform
import sys
import tempfile
from functools import cache
from importlib.metadata import version
from pathlib import Path

FOLDER_VARIABLE = "CE_GYM_CACHE_DIR"
COMPILERS = ("casadi", "numba", "llvmlite", "numpy")


@cache
def source_fingerprint(*packages: str) -> str:
    """Hash of what the machine code follows from, beside the program itself.

    Args:
        packages: importable packages whose .py files count.

    Returns:
        16 hexadecimal digits, over the sources, the versions of CasADi, numba, llvmlite, numpy and Python, and the
        processor's name and features.
    """
    from llvmlite import binding

    digest = hashlib.sha256()
    for package in packages:
        for path in _sources(package):
            digest.update(path.name.encode() + b"\0" + path.read_bytes())
    facts = [f"{name} {version(name)}" for name in COMPILERS] + [platform.python_version(), platform.machine()]
    facts += [binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()]
    digest.update("\n".join(facts).encode())
    return digest.hexdigest()[:16]


def _sources(package: str) -> list[Path]:
    spec = importlib.util.find_spec(package)
    if spec is None or spec.submodule_search_locations is None:
        raise ValueError(f"package {package!r}: not found, expected an importable package with Python sources")
    return sorted(path for root in spec.submodule_search_locations for path in Path(root).rglob("*.py"))


def cache_folder() -> Path:
    """Where kernels are kept: $CE_GYM_CACHE_DIR, else the user's cache folder, else a temporary one."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
    wanted = Path(os.environ.get(FOLDER_VARIABLE) or os.path.join(home, "ce_gym"))
    for folder in (wanted, Path(tempfile.gettempdir()) / f"ce_gym-{user}"):
        if _is_ours(folder):
            return folder
    return Path(tempfile.mkdtemp(prefix="ce_gym-"))


def _is_ours(folder: Path) -> bool:
    """Whether this user can write there and, since code is run from it, nobody else made it."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return not hasattr(os, "getuid") or folder.stat().st_uid == os.getuid()
    except OSError:
        return False


def write_atomically(path: Path, content: str | bytes) -> None:
    """Replace a file as a whole: a reader sees the old content or the new, never half of one."""
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=path.name, delete=False) as file:
        file.write(content.encode() if isinstance(content, str) else content)
    os.replace(file.name, path)


def checksum(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def announce(text: str) -> None:
    """Begin or finish the one line that says why the user waits."""
    print(text, end="", file=sys.stderr, flush=True)
