"""Differences of operating systems: users, usable cores, memory, names of CPUs, forks, locks of files.

Only this file calls functions that some system lacks.
"""

from __future__ import annotations

import contextlib
import os
import platform
import sys
from collections.abc import Callable
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")
"""Description of the CPU on Linux."""
CONTAINER = Path("/sys/fs/cgroup/memory.max")
"""Limit on the memory of a container on Linux."""


def _nothing() -> None:
    """Do nothing."""


def user_number() -> int | None:
    """Return the effective user number of this process; None where users have no numbers, as on Windows."""
    number = getattr(os, "geteuid", None)
    return number() if number else None


def lock(descriptor: int) -> None:
    """Lock an open file for this process; the system frees the lock when the process ends.

    Raises:
        OSError: Another process has the lock, or the file system has no locks.
    """
    if sys.platform == "win32":
        import msvcrt

        os.lseek(descriptor, 2**20, os.SEEK_SET)  # others cannot read the locked byte
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def usable_cores() -> int:
    """Return the number of cores that this process may use; all cores where the system does not tell.

    Environments use as many threads with `num_threads=None`.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def memory() -> float:
    """Return the memory that this process may use [bytes]; inf where the system does not tell."""
    sizes = [float("inf")]
    with contextlib.suppress(OSError, ValueError):  # "max" is no number
        sizes.append(int(CONTAINER.read_text()))
    if sys.platform != "win32":
        sizes.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
        with contextlib.suppress(ImportError):
            import resource

            limit, _ = resource.getrlimit(resource.RLIMIT_AS)
            sizes += [limit] if limit != resource.RLIM_INFINITY else []
    return min(sizes)


def check_memory(argument: str, needed: float) -> None:
    """Check an estimate before memory is allocated.

    Args:
        argument: The argument with its value, for the message.
        needed: Estimate [bytes].

    Raises:
        ValueError: More than this process may use; one line.
    """
    if not needed <= (most := memory()):
        gib = f"{needed / 2**30:.3g} GiB of memory; expected at most {most / 2**30:.3g} GiB, what there is"
        raise ValueError(f"{argument} needs {gib}")


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
