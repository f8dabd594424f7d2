"""`load_robot`: robots by name, path or collection; and a table of the package's robots."""

from __future__ import annotations

import os
from pathlib import Path

from ce_gym.model.assets import OTHERS, assets_folder, robots
from ce_gym.model.clusters import cluster_tree
from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError, invalid_value, unknown_name
from ce_gym.model.formats.collections import downloaded, is_in_collection
from ce_gym.model.formats.mjcf.robot import robot_from_mjcf
from ce_gym.model.formats.reading import read_yaml
from ce_gym.model.formats.urdf.graph import UrdfGraph
from ce_gym.model.formats.urdf.plus import robot_from_graph
from ce_gym.model.formats.urdf.tree import Base
from ce_gym.model.formats.yaml.robot import robot_from_yaml
from ce_gym.model.table import Cell, table_text

COLUMNS = ("robot", "base", "bodies", "joints", "rotors", "clusters", "mass [kg]")
"""Columns of `robot_table`."""


def load_robot(name_or_path: str | os.PathLike[str], *, floating: bool | None = None) -> Robot:
    """Load a robot.

    - `.yaml`: the package's own format. It names a plain URDF or an MJCF file and adds rotors, transmissions, motors,
      contacts and a pose.
    - `.urdf`: URDF+ if the file has `<loop>`, `<coupling>` or `independent`; a plain URDF otherwise. A YAML file of the
      same name beside a plain URDF is loaded instead if its key `urdf` names the URDF.
    - `.xml`: MJCF, read through the package `mujoco`.

    Args:
        name_or_path: A name such as "mini_cheetah" (`robots()` lists them) or of a robot that has been registered, the
            path of a file, or a robot that an installed package downloads: "menagerie:unitree_go2",
            "robot_descriptions:go2_description".
        floating: Whether the root link of a URDF or URDF+ moves freely or is fixed to the world. By default a root
            link without mass, or called "world", is fixed. In other formats the file describes its base.

    Raises:
        RobotError: There is no such robot, or its description is wrong; one line with file, key and problem.

    Examples:
        >>> robot = ce_gym.load_robot("tello")
        >>> print(len(robot.bodies), "bodies,", len(list(robot.rotors())), f"of them rotors, {robot.total_mass:.1f} kg")
        27 bodies, 10 of them rotors, 10.4 kg
    """
    path = Path(name_or_path)
    if isinstance(name_or_path, str) and is_in_collection(name_or_path):
        path = downloaded(name_or_path)
    elif isinstance(name_or_path, str) and not path.suffix and len(path.parts) <= 1:
        path = _asset(name_or_path)
    kind = path.suffix.lower()
    if kind == ".urdf":
        return _from_urdf(path, floating)
    if floating is not None:
        raise invalid_value(str(path), "floating", floating, "None: the file describes its base")
    if kind in (".yaml", ".yml"):
        return robot_from_yaml(path)
    if kind == ".xml":
        return robot_from_mjcf(path)
    raise RobotError(f"{path}: file type {path.suffix!r}: expected a name or a file that ends in .yaml, .urdf or .xml")


def _from_urdf(path: Path, floating: bool | None) -> Robot:
    base: Base | None = None if floating is None else "floating" if floating else "fixed"
    graph = UrdfGraph(path)
    yaml_file = path.with_suffix(".yaml")
    is_plain = base is None and not graph.is_plus
    if is_plain and yaml_file.is_file() and read_yaml(yaml_file).data.get("urdf") == path.name:
        return robot_from_yaml(yaml_file)
    return robot_from_graph(graph, base)


def _asset(name: str) -> Path:
    if name in OTHERS:
        return OTHERS[name]
    if name not in robots():
        raise unknown_name(str(assets_folder()), "robot", name, [*robots(), *OTHERS], "the name of a robot")
    return assets_folder() / name / f"{name}.yaml"


def robot_table() -> str:
    """Return a line for each robot: base, bodies with rotors, independent joints, rotors, clusters, mass."""
    return table_text(COLUMNS, [robot_row(load_robot(name)) for name in robots()])


def robot_row(robot: Robot) -> tuple[Cell, ...]:
    """Return the figures of one robot, in the order of `COLUMNS`."""
    return (
        robot.name,
        "floating" if robot.floating else "fixed",
        len(robot.bodies),
        len(robot.independent),
        len(list(robot.rotors())),
        len(cluster_tree(robot).clusters),
        robot.total_mass,
    )
