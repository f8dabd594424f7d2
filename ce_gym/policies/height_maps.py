"""Height maps of policies: a copy beside the policy lets the policy run from any working directory."""

from __future__ import annotations

import filecmp
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ce_gym.files import MAP, written
from ce_gym.policies.places import is_file


def with_map(env_kwargs: Mapping[str, Any], policy: Path) -> dict[str, Any]:
    """Return arguments of an environment whose height map is the copy near the policy, if there is a copy.

    Args:
        env_kwargs: Arguments from a record.
        policy: File of the policy; the copy is in its folder, or one folder above for a checkpoint.
    """
    name = _map_of(env_kwargs)
    folders = [policy.parent, *([policy.parent.parent] if policy.parent.name in ("checkpoints", "present") else [])]
    copies = [folder / Path(name).name for folder in folders if name]
    copy = next((file for file in copies if is_file(file)), None)
    return {**env_kwargs, **({"terrain": {**env_kwargs["terrain"], "file": str(copy)}} if copy else {})}


def keep_map(env_kwargs: Mapping[str, Any], folder: Path) -> None:
    """Copy the height map of an environment, if its arguments name one, into the folder of a policy.

    Raises:
        OSError: If the copy cannot be written.
    """
    name = _map_of(env_kwargs)
    copy = folder / Path(name).name
    if name and is_file(Path(name)) and not (is_file(copy) and filecmp.cmp(name, copy, shallow=False)):
        with written(copy, MAP) as file:
            shutil.copyfile(name, file)


def _map_of(env_kwargs: Mapping[str, Any]) -> str:
    """Return the path of the height map in untrusted arguments, or an empty string."""
    terrain = env_kwargs.get("terrain")
    file = terrain.get("file") if isinstance(terrain, Mapping) else None
    return file if isinstance(file, str) else ""
