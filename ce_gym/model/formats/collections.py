"""Robot files from packages that download them: `menagerie:unitree_go2`, `robot_descriptions:go2_description`.

`mujoco-menagerie` has MuJoCo's models, `robot_descriptions` URDF and MJCF files of many makers. Both packages are
optional, and cache their downloads.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

from ce_gym.model.errors import RobotError, unknown_name
from ce_gym.model.formats.text_file import one_line


def is_in_collection(name: str) -> bool:
    """Whether a name starts with the name of a collection and a colon."""
    return name.partition(":")[0] in COLLECTIONS and ":" in name


def downloaded(name: str) -> Path:
    """Return the file of a robot in a collection, and download the file on first use.

    Args:
        name: Collection and robot, such as "menagerie:unitree_go2".

    Raises:
        RobotError: The package is not installed, has no such robot, or fails to download the file.
    """
    collection, _, robot = name.partition(":")
    package, find = COLLECTIONS[collection]
    try:
        module = importlib.import_module(package.replace("-", "_"))
    except ImportError as error:
        raise RobotError(f"{name}: expected the package {package}; pip install {package} ({one_line(error)})") from None
    try:
        return find(module, name, robot)
    except RobotError:
        raise
    except Exception as error:  # no network, no git, no room, and others
        raise RobotError(
            f"{name}: cannot be downloaded: expected {package} to give a file ({one_line(error)})"
        ) from None


def _of_menagerie(module: ModuleType, name: str, robot: str) -> Path:
    if robot not in module.names():
        raise unknown_name(name, "robot", robot, module.names(), "the name of a robot of Menagerie")
    entry = module.get(robot)
    return Path(entry.xml(entry.default_model))


def _of_descriptions(module: ModuleType, name: str, robot: str) -> Path:
    known = sorted(path.stem for path in Path(module.__path__[0]).glob("*_description.py"))
    if robot not in known:
        raise unknown_name(name, "robot", robot, known, "the name of a description")
    description = importlib.import_module(f"{module.__name__}.{robot}")  # downloads
    return Path(getattr(description, "URDF_PATH", None) or description.MJCF_PATH)


COLLECTIONS: dict[str, tuple[str, Callable[[ModuleType, str, str], Path]]] = {
    "menagerie": ("mujoco-menagerie", _of_menagerie),
    "robot_descriptions": ("robot_descriptions", _of_descriptions),
}
"""For each collection, its package and the function that returns a robot's file."""
