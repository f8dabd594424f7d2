"""Differences of operating systems: users, usable cores, names of CPUs, forks.

Only this file calls functions that some system lacks.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")
"""Description of the CPU on Linux."""


def _nothing() -> None:
    """Do nothing."""


def user_number() -> int | None:
    """Return the effective user number of this process; None where users have no numbers, as on Windows."""
    number = getattr(os, "geteuid", None)
    return number() if number else None


def usable_cores() -> int:
    """Return the number of cores that this process may use; all cores where the system does not tell.

    Environments use as many threads with `num_threads=None`.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def processor() -> str:
    """Return the model name of the CPU, or its architecture where the system does not tell."""
    return _fields(CPUINFO).get("model name") or platform.processor() or platform.machine()


def at_fork(
    before: Callable[[], object] = _nothing,
    in_parent: Callable[[], object] = _nothing,
    in_child: Callable[[], object] = _nothing,
) -> None:
    """Register functions to be called before each fork of this process, and after it in parent and child."""
    register = getattr(os, "register_at_fork", None)
    if register:
        register(before=before, after_in_parent=in_parent, after_in_child=in_child)


def _fields(path: Path) -> dict[str, str]:
    """Return the lines `name: value` of a file by name; nothing if there is no such file."""
    if not path.exists():
        return {}
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    return {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
