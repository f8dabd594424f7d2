"""Sphinx extension: writes the pages that the package can write about itself into `docs/generated/` before a build.

    generated/environments/<robot>_<task>.md   one for each environment
    generated/robots/<robot>.md                one for each robot that ships with the package
    generated/*.inc                            tables that hand-written pages include

Files that would not change are left alone, so that a second build is quick. Knows Sphinx's events and the page writers.
"""

from __future__ import annotations

import re
import shutil
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import level_figures
import reference_tables
from drawing import tree_drawing
from environment_page import environment_page, table, title
from robot_page import picture, robot_page, shipped
from sphinx.application import Sphinx

from ce_gym import InertiaWarning, Model, load_robot, robots
from ce_gym.envs.registration import ROBOTS, tasks_of
from ce_gym.envs.task.skills import SKILLS
from ce_gym.envs.task.tasks import TASKS
from ce_gym.model.formats.motor_library import motor_types


def setup(app: Sphinx) -> dict[str, Any]:
    """Tell Sphinx when to call us."""
    app.connect("builder-inited", lambda app: write_pages(Path(app.srcdir) / "generated"))
    return {"parallel_read_safe": True}


def write_pages(folder: Path) -> None:
    """Write every generated page into a folder."""
    warnings.simplefilter("ignore", InertiaWarning)  # robots' pages contain its text
    (folder / "robots").mkdir(parents=True, exist_ok=True)
    for robot in robots():
        _write(folder / "robots" / f"{robot}.md", robot_page(robot, folder / "robots"))
    for robot in ROBOTS:
        drawn = (folder / "robots" / f"{robot}.png").exists()
        for task in tasks_of(robot):
            _write(folder / "environments" / f"{robot}_{task}.md", environment_page(robot, task, drawn))
    for name in (
        "terms", "context", "task_arguments", "parameters", "outputs", "settings", "command_line", "policies",
    ):  # fmt: skip
        _write(folder / f"{name}.inc", getattr(reference_tables, name)())
    for name, text in reference_tables.results().items():
        _write(folder / "results" / f"{name}.inc", text)
    _write(folder / "environments.inc", _environment_list())
    _write(folder / "robots.inc", _robot_list())
    _write(folder / "motors.inc", _motor_list())
    _write(folder / "own_robot.inc", _own_robot(folder))
    _write(folder / "tracking.inc", level_figures.tracking_figures())
    _write(folder / "levels.inc", level_figures.acceleration_figures())


def _environment_list() -> str:
    """A table of links, robots down and tasks across."""
    rows = [
        (
            f"[{title(robot)}](/generated/robots/{robot}.md)",
            *(_environment_link(robot, task) for task in TASKS),
            ", ".join(_environment_link(robot, task) for task in tasks_of(robot) if task in SKILLS),
        )
        for robot in ROBOTS
    ]
    return table(("", *(task.capitalize() for task in TASKS), "Skills"), rows) + "\n"


def _environment_link(robot: str, task: str) -> str:
    return f"[{task.replace('_', ' ')}](/generated/environments/{robot}_{task}.md)"


def _robot_list() -> str:
    """A table of the robots that ship with the package, and their pages' place in the contents."""
    rows = []
    for name in robots():
        robot = shipped(name)
        rotors = len(list(robot.rotors()))
        base = "floating" if robot.floating else "fixed"
        link = f"[{title(name)}](/generated/robots/{name}.md)"
        rows.append((link, base, len(robot.independent), rotors, f"{robot.total_mass:.2f}"))
    pages = "\n".join(f"/generated/robots/{name}" for name in robots())
    columns = ("robot", "base", "independent joints", "rotors", "mass [kg]")
    return f"{table(columns, rows)}\n\n```{{toctree}}\n:hidden:\n\n{pages}\n```\n"


def _motor_list() -> str:
    """A table of the motor library, figures at the rotor."""
    rows = [
        (
            f"`{m.name}`",
            f"{m.ratio:.4g}",
            f"{m.inertia:.4g}",
            f"{m.torque:.4g}",
            "" if m.velocity is None else f"{m.velocity:.4g}",
        )
        for m in motor_types().values()
    ]
    return table(("motor", "ratio", "inertia [kg m^2]", "torque [N m]", "no-load speed [rad/s]"), rows) + "\n"


def _own_robot(folder: Path) -> str:
    """A picture and the tree of the walk-through's robot: the URDF of the tests' data with the YAML of the page."""
    docs = folder.parent
    page = (docs / "tutorials" / "own_robot.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"^```yaml\n(# pup.yaml\n.*?)^```", page, re.M | re.S)
    with TemporaryDirectory() as place:
        shutil.copy(docs.parent / "tests" / "data" / "own_robot" / "pup.urdf", place)
        path = Path(place) / "pup.yaml"
        path.write_text(text, encoding="utf-8")
        robot = load_robot(path)
    return f"{picture(Model(robot), folder / 'pup.png', docs, '/')}\n\n```{{raw}} html\n{tree_drawing(robot)}\n```\n"


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")
