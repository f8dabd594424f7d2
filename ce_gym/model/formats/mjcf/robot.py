"""MJCF -> `Robot`, through the package `mujoco` (extra `mjcf`).

| in the file                      | in the robot                                                                   |
|----------------------------------|--------------------------------------------------------------------------------|
| bodies, joints                   | bodies (`bodies.py`)                                                           |
| a ball joint inside a loop       | three hinges, zero in the reference pose (`balls.py`)                          |
| equalities                       | exact constraints (`equalities.py`)                                            |
| armature                         | rotors behind gears (`rotors.py`)                                              |
| geoms                            | contact spheres, and shapes to draw (`contacts.py`)                            |
| actuators                        | torque limits and gains (`actuators.py`)                                       |
| the first keyframe               | the standing pose, and the branch in which loops are assembled                 |

Other parts of the file that act on the robot are listed in its notes and in one `LossyImportWarning`. Cameras, lights,
sensors and textures are ignored.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ce_gym.model.checks.robot import check_robot
from ce_gym.model.description import Pose, Robot
from ce_gym.model.errors import LossyImportWarning
from ce_gym.model.formats.mjcf.actuators import read_actuators
from ce_gym.model.formats.mjcf.balls import balls_in_loops
from ce_gym.model.formats.mjcf.bodies import MjcfTree, read_bodies, read_sites, shapes
from ce_gym.model.formats.mjcf.contacts import read_contacts
from ce_gym.model.formats.mjcf.equalities import locked_joints, read_constraints
from ce_gym.model.formats.mjcf.independent import choose_independent, equality_rows, without_repeats
from ce_gym.model.formats.mjcf.rotors import add_rotors
from ce_gym.model.formats.mjcf.scenes import robot_name
from ce_gym.model.formats.mjcf.source import MjcfSource, quaternion, read_mjcf, rotation, summary
from ce_gym.model.formats.mjcf.unmodelled import report_unmodelled
from ce_gym.model.formats.placement import named_frames, vec3
from ce_gym.model.formats.reading import Section
from ce_gym.model.formats.rotor_links import FixedLink
from ce_gym.model.formats.rotor_rule import with_rotors
from ce_gym.model.formats.urdf.tree import Attachment
from ce_gym.model.frames import Placement

Angles = tuple[tuple[str, float], ...]  # pairs (body, joint coordinate [rad or m])

UPRIGHT = 1e-3
"""Largest inclination in the reference pose of a base that counts as upright [rad]: keyframes are rounded."""
DEEPEST = 0.01
"""Largest depth of contacts below ground without raising the reference pose [m]."""


def robot_from_mjcf(path: Path, gear_ratios: Mapping[str, float] | None = None) -> Robot:
    """Read an MJCF file.

    Args:
        path: The file.
        gear_ratios: Gear ratios of joints with armature where they differ from the `gear` of the actuator, by the name
            of the body that the joint moves, or a pattern. They matter at the exact level only, see `rotors.py`.

    Raises:
        RobotError: `mujoco` is missing or refuses the file, or the file describes an impossible robot.

    Warns:
        LossyImportWarning: Parts of the file have no counterpart; `Robot.notes` has the full list.
    """
    robot = read_robot(path, Section(str(path), "gears", dict(gear_ratios or {})))[0]
    check_robot(robot)
    return robot


def read_robot(
    path: Path, gears: Section, driven: Collection[str] = (), apart: Collection[str] = ()
) -> tuple[Robot, dict[str, Attachment], Mapping[str, FixedLink]]:
    """Read an MJCF file that a YAML file may add to; nothing is checked yet.

    Args:
        path: The file.
        gears: Gear ratios for `robot_from_mjcf`.
        driven: Joints, or bodies that they move, with rotors in the YAML file; the armature of their joints is ignored.
        apart: Names of bodies without joint to keep separate, because they are rotors.

    Returns:
        The robot; for each of the file's bodies, the body that carries it and its pose in that body; separate bodies.
    """
    source = read_mjcf(path)
    locked = locked_joints(source)
    tree = read_bodies(source, locked, balls_in_loops(source), apart)
    gears.aliases = Robot("", tuple(tree.bodies)).links_by_joint
    driven = {gears.aliases.get(name, name) for name in driven}
    equalities = read_constraints(source, tree, locked)
    poses = equality_rows(source, tree)
    constraints = without_repeats(source, equalities, poses)
    spinning = [
        body.name for body in with_rotors(tree.bodies, constraints, tree.moved_by.values()) if body.kind == "rotor"
    ]
    independent = choose_independent(source, tree, spinning, poses)
    gains = read_actuators(source, tree, independent, constraints, driven)
    contacts, material, lowest = read_contacts(source, tree)
    _add_shapes(source, tree)
    links = {*independent, *(contact.body for contact in contacts)}  # what touches the ground spins outside
    tree.bodies[:] = with_rotors(tree.bodies, constraints, [b for b in tree.moved_by.values() if b not in links])
    ties = add_rotors(source, tree, _ratios(gears, tree, driven), driven)
    pose, assembly = _pose(source, tree, independent, lowest)
    report_unmodelled(source)
    frames = {source.name("body", i): frame for i, frame in enumerate(tree.frames)}
    robot = Robot(
        name=_name(source, path),
        bodies=tuple(tree.bodies),
        constraints=(*constraints, *ties),
        independent=independent,
        contacts=contacts if source.enabled("CONTACT") and source.enabled("CONSTRAINT") else (),
        material=material,
        pose=pose,
        assembly=assembly,
        gains=gains,
        gravity=vec3(source.model.opt.gravity) if source.enabled("GRAVITY") else (0.0, 0.0, 0.0),
        frames=named_frames({**frames, **read_sites(source, tree)}, tree.bodies),
        source=str(path),
        notes=(*(f"left out: {what.format(name)}" for what, name in source.left_out), *source.notes),
    )
    if source.left_out:
        warnings.warn(f"{path}: left out: {summary(source.left_out)}", LossyImportWarning, stacklevel=4)
    return robot, {**frames, **{body.name: (body.name, Placement()) for body in tree.bodies}}, tree.fixed


def _ratios(gears: Section, tree: MjcfTree, driven: Collection[str]) -> dict[str, float]:
    """Return the gear ratios that the caller gives, by the name of the body that the joint moves."""
    joints = [body for body in tree.moved_by.values() if body not in driven]
    for joint, ratio in (ratios := gears.numbers_for(joints)).items():
        if joint not in joints:
            raise gears.unknown("", joint, joints, "the name of a joint that no rotor is given for")
        if ratio == 0.0:
            raise gears.invalid(joint, ratio, "a number other than 0")
    return ratios


def _name(source: MjcfSource, path: Path) -> str:
    name = source.model.names[: source.model.names.index(b"\0")].decode()
    return robot_name(path.stem if name in ("", "MuJoCo Model") else name, path)


def _add_shapes(source: MjcfSource, tree: MjcfTree) -> None:
    drawn: dict[str, list] = {}
    for carrier, shape in shapes(source, tree):
        drawn.setdefault(carrier, []).append(shape)
    tree.bodies[:] = [replace(body, shapes=tuple(drawn.get(body.name, ()))) for body in tree.bodies]


def _pose(source: MjcfSource, tree: MjcfTree, independent: tuple[str, ...], lowest: float) -> tuple[Pose, Angles]:
    """Return the standing pose, and the dependent coordinates at it.

    Args:
        source: The compiled file.
        tree: Its bodies.
        independent: Bodies whose joint coordinates are independent.
        lowest: Height of the lowest contact sphere's underside [m].
    """
    model, qpos = source.model, source.data.qpos
    height, angles, balls = 0.0, {}, []
    limits = {body.name: body.joint.position for body in tree.bodies}
    for j, body in tree.moved_by.items():
        address = model.jnt_qposadr[j]
        if model.jnt_type[j] == source.mujoco.mjtJoint.mjJNT_FREE:
            height = float(qpos[address + 2])
            up = rotation(qpos[address + 3 : address + 7])[:, 2]  # the base's z axis in the world, whatever the yaw
            inclination = float(np.arctan2(np.hypot(up[0], up[1]), up[2]))
            if inclination > UPRIGHT:
                angle = f"{np.degrees(inclination):.3g} degrees"
                source.leave_out("the inclination of the base in the reference pose ({})", angle)
            if source.moved:
                height -= lowest  # feet just touch
            elif lowest < -DEEPEST:
                source.leave_out("the height of the base in the reference pose ({} m)", f"{height:g}, under ground")
                height -= lowest
            continue
        if model.jnt_type[j] == source.mujoco.mjtJoint.mjJNT_BALL:
            balls.append((body, quaternion(qpos[address : address + 4])))
            continue
        angles[body] = float(qpos[address])
        allowed = min(max(angles[body], limits[body][0]), limits[body][1])
        if body in independent and abs(allowed - angles[body]) > 1e-6:
            source.leave_out("the angle in the reference pose, beyond its limits, of {}", body)
            angles[body] = allowed
    dependent = tuple((body, angle) for body, angle in angles.items() if body not in independent)
    return Pose(height, tuple((body, angles.get(body, 0.0)) for body in independent), tuple(balls)), dependent
