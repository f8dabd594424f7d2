"""What operating systems do not have in common: users, usable cores, names of CPUs, forks.

The only file that may call what some system lacks.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")
"""Where Linux describes the CPU."""


def _nothing() -> None:
    """Do nothing."""


def user_number() -> int | None:
    """Return the number of the user whose rights this process has; None where users have no numbers, as on Windows."""
    number = getattr(os, "geteuid", None)
    return number() if number else None


def usable_cores() -> int:
    """Return the number of cores this process may use, which is what `num_threads=None` of environments means.

    All cores there are, where the system does not tell.
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
    """Have functions called whenever this process is forked: before, and after in either process."""
    register = getattr(os, "register_at_fork", None)
    if register:
        register(before=before, after_in_parent=in_parent, after_in_child=in_child)


def _fields(path: Path) -> dict[str, str]:
    """Return the lines `name: value` of a file by name; nothing if there is no such file."""
    if not path.exists():
        return {}
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    return {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
