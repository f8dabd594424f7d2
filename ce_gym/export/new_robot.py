"""`python -m ce_gym new`: a commented YAML file for a user's own robot, guesses marked."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import yaml

from ce_gym.export.guesses import BEND, DAMPING_TIME, FULL_TORQUE_AT, Guesses, guess
from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError
from ce_gym.model.formats.urdf.graph import UrdfGraph
from ce_gym.model.formats.urdf.plus import robot_from_graph
from ce_gym.model.load import load_robot

GUESS = "# GUESS"
PLAIN = r"[A-Za-z_./][\w./-]*"
"""Names and paths that YAML reads without quotes, unless it has another meaning for them, as for `on`."""
MOST_NOTES = 6
ANY_GAIN = {"kp": 20.0, "kd": 0.5}
"""Gains of joints of which not even the torque is known [N m/rad, N m s/rad]."""


def write_new_robot(path: Path, out: Path | None = None) -> tuple[Path, Robot]:
    """Write a YAML file beside a URDF or MJCF file, and load it.

    Args:
        path: The file; .urdf or .xml.
        out: The YAML file; by default the same name with .yaml.

    Returns:
        The file that was written, and the robot that it makes.

    Raises:
        RobotError: The file is wrong, is something else, or there is a YAML file already.
    """
    kind = {".urdf": "urdf", ".xml": "mjcf"}.get(path.suffix.lower())
    if kind is None:
        raise RobotError(f"{path}: file type {path.suffix!r}: expected a file that ends in .urdf or .xml")
    out = path.with_suffix(".yaml") if out is None else out
    if out.exists():
        raise RobotError(f"{out}: is there already: expected a name that is free; --out gives another")
    robot = robot_from_graph(UrdfGraph(path)) if kind == "urdf" else load_robot(path)  # without a YAML file beside it
    out.write_text(new_robot(robot, kind, _from_folder(path, out.parent)), encoding="utf-8")
    try:
        return out, load_robot(out)
    except RobotError:  # nothing is left behind that cannot be used
        out.unlink()
        raise


def _quoted(name: str) -> str:
    """Return a name as YAML reads it."""
    plain = re.fullmatch(PLAIN, name) and isinstance(yaml.safe_load(name), str)
    return name if plain else json.dumps(name, ensure_ascii=False)


def _from_folder(path: Path, folder: Path) -> str:
    """Return how a file in a folder names another file: relative to the folder, absolute on another drive."""
    target, start = path.resolve(), folder.resolve()
    try:
        return Path(os.path.relpath(target, start)).as_posix()
    except ValueError:  # Windows has a tree for each drive
        return target.as_posix()


def new_robot(robot: Robot, kind: str, name: str) -> str:
    """Return the text of the YAML file.

    Args:
        robot: What the links alone say.
        kind: "urdf" or "mjcf".
        name: Of that file, from the folder of the YAML file.
    """
    has_pose = kind == "mjcf" and any(angle for _, angle in robot.pose.joints)
    found = guess(robot, has_pose)
    parts = [
        f"# Made by `python -m ce_gym new`. Go through it: what is marked {GUESS[2:]} are rules of thumb.",
        f"name: {_quoted(robot.name)}\n{kind}: {_quoted(name)}",
    ]
    if kind == "urdf":
        parts.append(f"base: {'floating' if robot.floating else 'fixed'}  {GUESS}, from the mass of the first link")
    parts += [_rotors(robot), _contacts(robot, found), _pose(found, has_pose), _gains(robot, found)]
    if robot.notes:
        more = [f"# and {len(robot.notes) - MOST_NOTES} more"] if len(robot.notes) > MOST_NOTES else []
        notes = [f"# - {note}" for note in robot.notes[:MOST_NOTES]]
        parts.append("\n".join(["# The file says more than a robot can have:", *notes, *more]))
    return "\n\n".join(parts) + "\n"


def _rotors(robot: Robot) -> str:
    """A template, since no file says what spins inside."""
    driven = {body for tie in robot.constraints for body in tie.bodies if tie.linear and len(tie.bodies) > 1}
    lines = [
        "# Rotors: without them all transmission levels are the same. For each motor its gear ratio and either an",
        "# entry of the motor library (`python -m ce_gym list`) or the moment of inertia of its rotor [kg m^2]. Remove",
        "# the # of those that you know; a belt or a differential has several joints in `ratios`.",
        "# rotors:",
    ]
    joints = [joint for joint in robot.independent if joint not in driven]
    lines += [f"#   {_quoted(f'{j}_rotor')}: {{inertia: 5e-5, ratios: {{{_quoted(j)}: 9}}}}" for j in joints]
    return "\n".join(lines)


def _contacts(robot: Robot, found: Guesses) -> str:
    if robot.contacts:
        count = {group: sum(c.group == group for c in robot.contacts) for group in ("foot", "torso", "limb")}
        return (
            "# Contacts are those of the MJCF file: " + ", ".join(f"{n} of group {g}" for g, n in count.items()) + "."
        )
    lines = [f"contacts:  {GUESS}: the lowest points of the lowest limbs; torso is what ends an episode on the ground"]
    for c in found.contacts:
        position = ", ".join(f"{x:g}" for x in c.position)
        place = f"position: [{position}], radius: {c.radius:g}, group: {c.group}"
        lines.append(f"  {_quoted(c.name)}: {{body: {_quoted(c.body)}, {place}}}")
    return "\n".join(lines)


def _pose(found: Guesses, has_pose: bool) -> str:
    how = "as in the file" if has_pose else f"knees bent by {2 * BEND:g} rad"
    joints = [f"    {_quoted(joint)}: {angle:g}" for joint, angle in found.pose.joints if angle]
    lines = [f"pose:  {GUESS}: {how}, feet just touching", f"  height: {found.pose.height:g}"]
    return "\n".join([*lines, *(["  joints:", *joints] if joints else [])])


def _why(robot: Robot, joint: str) -> str:
    """Return what a file says of a joint without a largest torque."""
    return "the file says that its effort is 0" if robot.body(joint).joint.torque == 0.0 else "no torque limit"


def _gains(robot: Robot, found: Guesses) -> str:
    if robot.gains.kp:
        return "# Gains are those of the MJCF file's position actuators."
    lines = [
        f"gains:  {GUESS}: all the torque of a joint at an error of {FULL_TORQUE_AT} rad, and kd {DAMPING_TIME} s * kp"
    ]
    for key, column in (("kp", 1), ("kd", 2)):
        lines += [f"  {key}:", *(f"    {_quoted(row[0])}: {row[column]:g}" for row in found.gains)]
        for joint in (joint for joint in found.no_torque if joint not in robot.passive):
            lines.append(f"    {_quoted(joint)}: {ANY_GAIN[key]:g}  {GUESS}: {_why(robot, joint)}")
    passive = [joint for joint in found.no_torque if joint in robot.passive]
    lines += [f"# No gains, because the file says that their effort is 0: {', '.join(passive)}."] if passive else []
    return "\n".join(lines)
