"""The height map that a policy was trained on: a copy lies beside the policy, so that it plays from any folder."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ce_gym.policies.places import is_file


def with_map(env_kwargs: Mapping[str, Any], policy: Path) -> dict[str, Any]:
    """Return arguments of an environment with the path of their height map, where a copy lies near the policy.

    Args:
        env_kwargs: As a record has them.
        policy: File of the policy; the copy is beside it, or one folder above, as for checkpoints.
    """
    name = _map_of(env_kwargs)
    folders = [policy.parent, *([policy.parent.parent] if policy.parent.name in ("checkpoints", "present") else [])]
    copies = [folder / Path(name).name for folder in folders if name]
    copy = next((file for file in copies if is_file(file)), None)
    return {**env_kwargs, **({"terrain": {**env_kwargs["terrain"], "file": str(copy)}} if copy else {})}


def keep_map(env_kwargs: Mapping[str, Any], folder: Path) -> None:
    """Copy the height map of an environment's arguments, if they name one, into the folder of a policy.

    Raises:
        OSError: If it cannot be written.
    """
    name = _map_of(env_kwargs)
    copy = folder / Path(name).name
    if name and is_file(Path(name)) and not (copy.exists() and copy.samefile(name)):
        shutil.copyfile(name, copy)


def _map_of(env_kwargs: Mapping[str, Any]) -> str:
    """Return the path of a height map, "" if there is none; records are not trusted to hold what they should."""
    terrain = env_kwargs.get("terrain")
    file = terrain.get("file") if isinstance(terrain, Mapping) else None
    return file if isinstance(file, str) else ""
