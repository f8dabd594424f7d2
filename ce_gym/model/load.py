"""Where robots are found: by name in the assets folder, or by path.

Knows the layout of the assets folder and which reader a file needs.
"""

from __future__ import annotations

import os
from pathlib import Path

from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError, unknown
from ce_gym.model.yaml_file import robot_from_urdf, robot_from_yaml

_READERS = {".yaml": robot_from_yaml, ".yml": robot_from_yaml, ".urdf": robot_from_urdf}


def load_robot(name_or_path: str | os.PathLike[str]) -> Robot:
    """Load a robot.

    Args:
        name_or_path: A name such as "mini_cheetah" (`robots()` lists them), or the path of a .yaml or .urdf file.

    Raises:
        RobotError: There is no such robot, or its description is wrong; one line that says where and how.
    """
    path = Path(name_or_path)
    if isinstance(name_or_path, str) and not path.suffix and len(path.parts) <= 1:
        return robot_from_yaml(_asset(name_or_path))
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise RobotError(f"{path}: file type {path.suffix!r}: expected a name or a file that ends in .yaml or .urdf")
    return reader(path)


def robots() -> list[str]:
    """Return the names of the robots that come with the package."""
    return sorted(path.stem for path in assets_folder().glob("*/*.yaml") if path.stem == path.parent.name)


def assets_folder() -> Path:
    """Return the folder of robots: inside an installed package, or beside it in a source checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "assets"
    return installed if installed.is_dir() else package.parent / "assets"


def _asset(name: str) -> Path:
    if name not in robots():
        raise unknown(str(assets_folder()), "robot", name, robots(), "the name of a robot")
    return assets_folder() / name / f"{name}.yaml"
