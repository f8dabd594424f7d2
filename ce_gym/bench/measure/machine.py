"""The machine a figure was measured on."""

from __future__ import annotations

import datetime
import importlib.metadata
import platform

from ce_gym.compile.system import processor, usable_cores

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


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""
