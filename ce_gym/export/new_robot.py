"""`python -m ce_gym new`: a commented YAML file for a URDF or MJCF file, with marked guesses."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import yaml

from ce_gym.export.guesses import BEND, DAMPING_TIME, FULL_TORQUE_AT, Guesses, guess
from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError, file_error
from ce_gym.model.formats.urdf.graph import UrdfGraph
from ce_gym.model.formats.urdf.plus import robot_from_graph
from ce_gym.model.load import load_robot

GUESS = "# GUESS"
PLAIN = r"[A-Za-z_./][\w./-]*"
"""Names and paths that YAML reads without quotes, except words such as `on`."""
MOST_NOTES = 6
ANY_GAIN = {"kp": 20.0, "kd": 0.5}
"""Gains of joints without a known largest torque [N m/rad, N m s/rad]."""


def write_new_robot(path: Path, out: Path | None = None) -> tuple[Path, Robot]:
    """Write a YAML file for a URDF or MJCF file, and load the robot.

    Args:
        path: The .urdf or .xml file.
        out: The YAML file; by default beside `path`, with the same name.

    Returns:
        The YAML file and its robot.

    Raises:
        RobotError: The file is wrong or of another type, or the YAML file exists already.
    """
    kind = {".urdf": "urdf", ".xml": "mjcf"}.get(path.suffix.lower())
    if kind is None:
        raise file_error(path, f"file type {path.suffix!r}", "a file that ends in .urdf or .xml")
    out = path.with_suffix(".yaml") if out is None else out
    if out.exists():
        raise file_error(out, "exists already", "a free name; --out gives another")
    robot = robot_from_graph(UrdfGraph(path)) if kind == "urdf" else load_robot(path)  # without a YAML file beside it
    out.write_text(new_robot(robot, kind, _relative_path(path, out.parent)), encoding="utf-8")
    try:
        return out, load_robot(out)
    except RobotError:  # leave no broken file
        out.unlink()
        raise


def _yaml_name(name: str) -> str:
    """Return a name in YAML, in quotes if necessary."""
    plain = re.fullmatch(PLAIN, name) and isinstance(yaml.safe_load(name), str)
    return name if plain else json.dumps(name, ensure_ascii=False)


def _relative_path(path: Path, folder: Path) -> str:
    """Return a path relative to a folder; absolute if it is on another drive."""
    target, start = path.resolve(), folder.resolve()
    try:
        return Path(os.path.relpath(target, start)).as_posix()
    except ValueError:  # another drive of Windows
        return target.as_posix()


def new_robot(robot: Robot, kind: str, name: str) -> str:
    """Return the text of the YAML file.

    Args:
        robot: The robot as its URDF or MJCF file describes it.
        kind: "urdf" or "mjcf".
        name: Path of that file, relative to the folder of the YAML file.
    """
    has_pose = kind == "mjcf" and any(angle for _, angle in robot.pose.joints)
    guesses = guess(robot, has_pose)
    parts = [
        f"# Made by `python -m ce_gym new`. Check this file: values marked {GUESS[2:]} are rules of thumb.",
        f"name: {_yaml_name(robot.name)}\n{kind}: {_yaml_name(name)}",
    ]
    if kind == "urdf":
        parts.append(f"base: {'floating' if robot.floating else 'fixed'}  {GUESS}, from the mass of the first link")
    parts += [_rotors(robot), _contacts(robot, guesses), _pose(guesses, has_pose), _gains(robot, guesses)]
    if robot.notes:
        notes = [f"# - {note}" for note in robot.notes[:MOST_NOTES]]
        if len(robot.notes) > MOST_NOTES:
            notes.append(f"# and {len(robot.notes) - MOST_NOTES} more")
        parts.append("\n".join(["# Data of the file that were not used:", *notes]))
    return "\n\n".join(parts) + "\n"


def _rotors(robot: Robot) -> str:
    """Return a template of rotors: URDF and MJCF files do not have them."""
    driven = {body for tie in robot.constraints for body in tie.bodies if tie.linear and len(tie.bodies) > 1}
    lines = [
        "# Rotors: without them all transmission levels are the same. Give the gear ratio of each motor, and an entry",
        "# of the motor library (`python -m ce_gym list`) or the moment of inertia of its rotor [kg m^2]. Remove the #",
        "# of the rotors that you know; a belt or a differential has several joints in `ratios`.",
        "# rotors:",
    ]
    joints = [joint for joint in robot.independent if joint not in driven]
    lines += [f"#   {_yaml_name(f'{j}_rotor')}: {{inertia: 5e-5, ratios: {{{_yaml_name(j)}: 9}}}}" for j in joints]
    return "\n".join(lines)


def _contacts(robot: Robot, guesses: Guesses) -> str:
    if robot.contacts:
        count = {group: sum(c.group == group for c in robot.contacts) for group in ("foot", "torso", "limb")}
        return "# Contacts of the MJCF file: " + ", ".join(f"{n} of group {g}" for g, n in count.items()) + "."
    lines = [f"contacts:  {GUESS}: the lowest points of the lowest limbs; an episode ends if torso touches the ground"]
    for c in guesses.contacts:
        position = ", ".join(f"{x:g}" for x in c.position)
        place = f"position: [{position}], radius: {c.radius:g}, group: {c.group}"
        lines.append(f"  {_yaml_name(c.name)}: {{body: {_yaml_name(c.body)}, {place}}}")
    return "\n".join(lines)


def _pose(guesses: Guesses, has_pose: bool) -> str:
    source = "as in the file" if has_pose else f"knees bent by {2 * BEND:g} rad"
    joints = [f"    {_yaml_name(joint)}: {angle:g}" for joint, angle in guesses.pose.joints if angle]
    lines = [f"pose:  {GUESS}: {source}, feet just touching", f"  height: {guesses.pose.height:g}"]
    return "\n".join([*lines, *(["  joints:", *joints] if joints else [])])


def _torque_note(robot: Robot, joint: str) -> str:
    return "effort is 0 in the file" if robot.body(joint).joint.torque == 0.0 else "no torque limit"


def _gains(robot: Robot, guesses: Guesses) -> str:
    if robot.gains.kp:
        return "# Gains of the position actuators of the MJCF file."
    lines = [
        f"gains:  {GUESS}: all the torque of a joint at an error of {FULL_TORQUE_AT} rad, and kd {DAMPING_TIME} s * kp"
    ]
    for key, column in (("kp", 1), ("kd", 2)):
        lines += [f"  {key}:", *(f"    {_yaml_name(row[0])}: {row[column]:g}" for row in guesses.gains)]
        for joint in (joint for joint in guesses.no_torque if joint not in robot.passive):
            lines.append(f"    {_yaml_name(joint)}: {ANY_GAIN[key]:g}  {GUESS}: {_torque_note(robot, joint)}")
    passive = [joint for joint in guesses.no_torque if joint in robot.passive]
    lines += [f"# No gains for joints whose effort is 0: {', '.join(passive)}."] if passive else []
    return "\n".join(lines)
