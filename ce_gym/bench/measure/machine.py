"""The machine a figure was measured on."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
from pathlib import Path

PACKAGES = ("ce_gym", "numpy", "llvmlite", "casadi", "gymnasium", "mujoco")


def describe() -> dict[str, str]:
    """Return processor, cores, system, date and versions, in the order in which they are printed."""
    versions = {name: version for name in PACKAGES if (version := _version(name))}
    return {
        "processor": processor(),
        "cores": str(usable_cores()),
        "system": f"{platform.system()} {platform.release()}, {platform.machine()}",
        "date": datetime.date.today().isoformat(),
        "python": platform.python_version(),
        **versions,
    }


def processor() -> str:
    """Return the model name of the CPU, or its architecture where the system does not tell."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


def usable_cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""
