"""The robots that come with the package, in a table."""

from __future__ import annotations

from ce_gym.model.assets import robots
from ce_gym.model.clusters import cluster_tree
from ce_gym.model.description import Robot
from ce_gym.model.load import load_robot
from ce_gym.model.table import Cell, table_text

COLUMNS = ("robot", "base", "bodies", "joints", "rotors", "clusters", "mass [kg]")


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
