"""Description of the machine of a measurement."""

from __future__ import annotations

import datetime
import importlib.metadata
import platform
import subprocess
from pathlib import Path

from ce_gym.compile.system import processor, usable_cores

PACKAGES = ("ce_gym", "numpy", "llvmlite", "casadi", "gymnasium", "mujoco")


def describe() -> dict[str, str]:
    """Return processor, cores, system, date and versions, in the order of the report."""
    versions = {name: version for name in PACKAGES if (version := _version(name))}
    return {
        "processor": processor(),
        "cores": str(usable_cores()),
        "system": f"{platform.system()} {platform.release()}, {platform.machine()}",
        "date": datetime.date.today().isoformat(),
        "python": platform.python_version(),
        **versions,
    }


def commit() -> str:
    """Return the commit of the source, with "-dirty" if files were changed; empty outside a repository."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=7", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    except FileNotFoundError:  # git is not installed
        return ""


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""
