"""`python -m ce_gym new`: a commented YAML file for a URDF or MJCF file, with marked guesses."""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from ce_gym.dynamics.standing_load import PLACEHOLDER
from ce_gym.files import ROBOT, check_output, written
from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError, file_error
from ce_gym.model.formats.pose import complete_pose
from ce_gym.model.formats.urdf.graph import UrdfGraph
from ce_gym.model.formats.urdf.plus import robot_from_graph
from ce_gym.model.load import load_robot
from ce_gym.new_robot.contacts import GuessedContact
from ce_gym.new_robot.guesses import Guesses, guess

GUESS = "# GUESS"
PLAIN = r"[A-Za-z_./][\w./-]*"
"""Names and paths that YAML reads without quotes, except words such as `on`."""
MOST_NOTES = 6


def write_new_robot(path: Path, out: Path | None = None) -> tuple[Path, Robot, Guesses]:
    """Write a YAML file for a URDF or MJCF file, and load the robot.

    Args:
        path: The .urdf or .xml file.
        out: The YAML file; by default beside `path`, with the same name.

    Returns:
        The YAML file, its robot, and the guesses in it.

    Raises:
        RobotError: The file is wrong or of another type, or the YAML file exists already.
    """
    kind = {".urdf": "urdf", ".xml": "mjcf"}.get(path.suffix.lower())
    if kind is None:
        raise file_error(path, f"file type {path.suffix!r}", "a file that ends in .urdf or .xml")
    out = path.with_suffix(".yaml") if out is None else out
    check_output(out, ROBOT)
    robot = robot_from_graph(UrdfGraph(path)) if kind == "urdf" else load_robot(path)  # without a YAML file beside it
    nearest = dict(complete_pose((), robot.bodies, robot.independent))  # to zero, the pose without a keyframe
    has_pose = kind == "mjcf" and any(abs(x - nearest.get(joint, 0.0)) > 1e-6 for joint, x in robot.pose.joints)
    guesses = guess(robot, has_pose)
    text = new_robot(robot, guesses, kind, _relative_path(path, out.parent))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # shown when `path` was read
        with written(out, ROBOT) as temporary:
            temporary.write_text(text, encoding="utf-8")
            try:
                load_robot(temporary)
            except RobotError as error:
                raise RobotError(str(error).replace(str(temporary), str(out))) from None
        return out, load_robot(out), guesses


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


def new_robot(robot: Robot, guesses: Guesses, kind: str, name: str) -> str:
    """Return the text of the YAML file.

    Args:
        robot: The robot as its URDF or MJCF file describes it.
        guesses: The data that the file lacks.
        kind: "urdf" or "mjcf".
        name: Path of that file, relative to the folder of the YAML file.
    """
    parts = [
        f"# Made by `python -m ce_gym new`. Check this file: values marked {GUESS[2:]} are rules of thumb.",
        f"name: {_yaml_name(robot.name)}\n{kind}: {_yaml_name(name)}",
    ]
    if guesses.warnings:
        parts.insert(1, "\n".join(["# Check first:", *(f"# - {line}" for line in guesses.warnings)]))
    if kind == "urdf":
        parts.append(f"base: {'floating' if robot.floating else 'fixed'}  {GUESS}, from the mass of the first link")
    parts += [_rotors(robot, kind), _contacts(robot, guesses), _pose(robot, guesses), _limits(robot, guesses)]
    parts += [_gains(robot, guesses), _tasks(robot, guesses)]
    if robot.notes:
        notes = [f"# - {note}" for note in robot.notes[:MOST_NOTES]]
        if len(robot.notes) > MOST_NOTES:
            notes.append(f"# and {len(robot.notes) - MOST_NOTES} more")
        parts.append("\n".join(["# Data of the file that were not used:", *notes]))
    return "\n\n".join(part for part in parts if part) + "\n"


def _rotors(robot: Robot, kind: str) -> str:
    """Return a template of rotors: URDF files do not have them, and MJCF files have no gear ratios."""
    driven = {body for tie in robot.constraints for body in tie.bodies if tie.linear and len(tie.bodies) > 1}
    joints = [robot.joint_name(joint) for joint in robot.independent if joint not in driven]
    if robot.unknown_ratios:
        return "\n".join(
            [
                "# Gears: the file has the reflected inertia (armature) of its motors, but no gear ratios, so level",
                "# exact equals level coupled. Give the ratios that you know:",
                f"# gears: {{{', '.join(f'{_joint(robot, joint)}: 9' for joint in robot.driven[:2])}}}",
            ]
        )
    if not joints:
        return ""
    lines = [
        "# Rotors: without them all transmission levels are the same. Give the gear ratio of each motor, and an entry",
        "# of the motor library (`python -m ce_gym list`) or the moment of inertia of its rotor [kg m^2]. Remove the #",
        "# of the rotors that you know; a belt or a differential has several joints in `ratios`.",
        "# rotors:",
    ]
    lines += [f"#   {_yaml_name(f'{j}_rotor')}: {{inertia: 5e-5, ratios: {{{_yaml_name(j)}: 9}}}}" for j in joints]
    return "\n".join(lines)


def _contacts(robot: Robot, guesses: Guesses) -> str:
    if not guesses.contacts:
        count = {group: sum(c.group == group for c in robot.contacts) for group in ("foot", "torso", "limb")}
        return "# Contacts of the MJCF file: " + ", ".join(f"{n} of group {g}" for g, n in count.items()) + "."
    lines = [f"# Not the contacts of the MJCF file, because {guesses.replaced}."] if guesses.replaced else []
    lines.append(f"contacts:  {GUESS}; an episode ends if torso touches the ground")
    basis = ""
    for contact in guesses.contacts:
        if contact.basis != basis:
            lines.append(f"  {GUESS}: {contact.basis}")
        basis = contact.basis
        lines.append(f"  {_yaml_name(contact.name)}: {{{_contact(contact)}}}")
    return "\n".join(lines)


def _contact(contact: GuessedContact) -> str:
    parts = [f"body: {_yaml_name(contact.body)}"]
    if contact.kind != "sphere":
        parts += [f"shape: {contact.kind}", f"size: {_numbers(contact.size)}"]
    parts.append(f"position: {_numbers(contact.position)}")
    if any(contact.rpy):
        parts.append(f"rpy: {_numbers(contact.rpy)}")
    if contact.kind == "sphere":
        parts.append(f"radius: {contact.radius:g}")
    if contact.kind == "cylinder":
        parts.append("rolls: true")
    return ", ".join([*parts, f"group: {contact.group}"])


def _numbers(values: Sequence[float]) -> str:
    return f"[{', '.join(f'{x:g}' for x in values)}]"


def _pose(robot: Robot, guesses: Guesses) -> str:
    joints = [f"    {_joint(robot, joint)}: {round(angle, 6)}" for joint, angle in guesses.pose.joints if angle]
    height = "auto  # the lowest contact touches the ground" if guesses.has_auto_height else f"{guesses.pose.height:g}"
    lines = [f"pose:  {GUESS}: {guesses.pose_basis}", f"  height: {height}"]
    return "\n".join([*lines, *(["  joints:", *joints] if joints else [])])


def _limits(robot: Robot, guesses: Guesses) -> str:
    if not guesses.torques:
        return ""
    torques = sorted(set(guesses.given_torques.values()))
    given = ", ".join("none" if torque == float("inf") else f"{torque:g}" for torque in torques[:3])
    lines = [
        f"# The torque limits of the file ({given}) are placeholders: more than {PLACEHOLDER:g} times weight times",
        "# height of the centre of mass. Write the limits of your motors [N m]; velocity and position are keys, too.",
        f"limits:  {GUESS}: a share of weight times height of the centre of mass",
        "  torque:",
    ]
    return "\n".join([*lines, *(f"    {_joint(robot, joint)}: {x:g}" for joint, x in guesses.torques.items())])


def _joint(robot: Robot, body: str) -> str:
    return _yaml_name(robot.joint_name(body))


def _gains(robot: Robot, guesses: Guesses) -> str:
    passive = [joint for joint in robot.independent if joint in robot.passive]
    lines = [f"# No gains for joints whose effort is 0: {', '.join(passive)}."] if passive else []
    if robot.gains.kp:
        return "\n".join([*lines, "# Gains of the position actuators of the MJCF file."])
    if not guesses.gains:
        return "\n".join(lines)
    lines.append(f"gains:  {GUESS}: stiff against the load in the standing pose, damped by the mass matrix")
    for key, column in (("kp", 0), ("kd", 1)):
        lines += [f"  {key}:", *(f"    {_joint(robot, name)}: {row[column]:g}" for name, row in guesses.gains.items())]
    return "\n".join(lines)


def _tasks(robot: Robot, guesses: Guesses) -> str:
    """Return the arguments of the velocity task."""
    if not guesses.task:
        return ""
    task = dict(guesses.task)
    if "action_joints" in task:
        task["action_joints"] = [robot.joint_name(joint) for joint in task["action_joints"]]
    rewards = task.pop("rewards")
    lines = [
        f"tasks:  {GUESS}: speeds and periods grow with the root of the robot's height (Froude)",
        "  velocity:",
    ]
    lines += [f"    {key}: {_flow(value)}" for key, value in task.items()]
    lines += ["    rewards:", *(f"      {key}: {_flow(value)}" for key, value in rewards.items())]
    return "\n".join(lines)


def _flow(value: Any) -> str:
    """Return a value as YAML on one line."""
    return yaml.safe_dump(value, default_flow_style=True, width=10**6, sort_keys=False).removesuffix("\n...\n").strip()
