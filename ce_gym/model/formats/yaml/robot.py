"""The package's own robot files: YAML over a plain URDF or an MJCF file -> `Robot`.

The URDF or MJCF file describes the links. The YAML file adds rotors, transmissions, motors, contacts, a pose and gains,
and goes before the MJCF file where both have one of these. Unknown keys are refused. A key that names a body may also
name a link that a fixed joint merged into a body. A joint has its name in that file, or the name of the link it moves.
"""

from __future__ import annotations

from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from ce_gym.model.assets import assets_folder, robots
from ce_gym.model.checks.robot import check_robot
from ce_gym.model.constraints import Constraint
from ce_gym.model.description import Body, ContactMaterial, Frame, Gains, Pose, Robot
from ce_gym.model.formats.identified import with_identified
from ce_gym.model.formats.placement import compose, rotation_from_rpy, vec3
from ce_gym.model.formats.pose import complete_pose, touching_height
from ce_gym.model.formats.reading import Section, finite, frozen, read_yaml
from ce_gym.model.formats.urdf import drives
from ce_gym.model.formats.yaml.constraints import frame_named, read_constraints
from ce_gym.model.formats.yaml.contacts import read_capsules, read_contacts, read_pairs
from ce_gym.model.formats.yaml.links import Links, read_links
from ce_gym.model.formats.yaml.motors import read_battery, read_motors
from ce_gym.model.formats.yaml.rotors import add_rotors, read_elastic
from ce_gym.model.frames import ZERO, Placement

Pairs = tuple[tuple[str, float], ...]

_JOINT_PARAMETERS = {"joint_friction": "friction", "joint_stiffness": "stiffness", "joint_springref": "springref"}
_KEYS = (
    *("name", "urdf", "mjcf", "base", "sources", "notes", "kept_inertia", "gravity", "gears"),
    *("rotors", "constraints", "independent", "motors", "contacts", "material", "pose", "assembly", "gains", "tasks"),
    *("capsules", "self_collisions", "elastic", "battery", "passive", "frames", "limits"),
    *_JOINT_PARAMETERS,
)


def robot_from_yaml(path: Path) -> Robot:
    """Read a robot's YAML file and the URDF or MJCF file that it names."""
    file = read_yaml(path)
    if "identified" in file:
        return _identified_robot(path, file.allow("robot", "identified", "notes"))
    file.allow(*_KEYS)
    links = read_links(path, file)
    file.aliases = links.joints
    file.texts("sources")  # for readers of the file; only its form is checked
    library, motors = read_motors(file)
    notes = list(links.robot.notes)
    bodies, gears = add_rotors(file.section("rotors"), links, library)
    bodies, urdf_gears = drives.add_rotors(bodies, links.drives, links.driven, notes)
    bodies = _with_limits(file.section("limits"), _with_joint_parameters(file, bodies))
    ties = (*gears, *urdf_gears, *read_constraints(file, bodies, links.frames))
    independent = _independent(file, links.robot, ties)
    bodies = _with_passive_joints(file, bodies, independent)
    robot = replace(
        links.robot,
        name=file.text("name", links.robot.name),
        bodies=bodies,
        constraints=(*links.robot.constraints, *ties),
        independent=independent,
        contacts=tuple(read_contacts(file, links)),
        material=_material(file, links.robot),
        capsules=tuple(read_capsules(file.section("capsules"), links)),
        self_collisions=read_pairs(file, links),
        motors=motors,
        battery=read_battery(file),
        elastic=read_elastic(file, bodies),
        pose=_pose(file.section("pose"), links.robot.pose, bodies, independent),
        assembly=_assembly(file, links.robot, independent),
        gravity=vec3(file.vector("gravity", 3, links.robot.gravity)),
        tasks=tuple((name, frozen(task.data)) for name, task in file.section("tasks").sections()),
        frames=_frames(file.section("frames"), links, bodies),
        kept_inertia=file.texts("kept_inertia"),
        source=str(path),
        notes=(*notes, *file.texts("notes")),
    )
    robot = replace(robot, gains=_gains(file.section("gains"), robot))
    check_robot(robot)
    return _with_height(file.section("pose"), links.robot, robot)


def _identified_robot(path: Path, file: Section) -> Robot:
    """Return the robot of another file with identified parameters."""
    name = file.text("robot")
    other = path.parent / name if name.endswith((".yaml", ".yml")) else assets_folder() / name / f"{name}.yaml"
    if not other.is_file():
        raise file.unknown("robot", name, robots(), "a robot of the package or a YAML file beside this one")
    if other.resolve() == path.resolve() or "identified" in read_yaml(other):
        raise file.invalid("robot", name, "a robot file without identified figures of its own")
    robot = with_identified(robot_from_yaml(other), file.section("identified"))
    robot = replace(robot, source=str(path), notes=(*robot.notes, *file.texts("notes")))
    check_robot(robot)
    return robot


def _with_joint_parameters(file: Section, bodies: tuple[Body, ...]) -> tuple[Body, ...]:
    """Return the bodies with the friction and springs of joints in the YAML file."""
    joints = tuple(body.name for body in bodies if body.kind == "link" and body.joint.nv == 1)
    parameters: dict[str, dict[str, float]] = {}
    for key, parameter in _JOINT_PARAMETERS.items():
        for name, value in _for_each(file, key, joints) if key in file else ():
            if name not in joints:
                raise file.unknown(key, name, joints, "a link with a joint about or along one axis")
            parameters.setdefault(name, {})[parameter] = value
    return tuple(replace(body, joint=replace(body.joint, **parameters.get(body.name, {}))) for body in bodies)


def _with_limits(section: Section, bodies: tuple[Body, ...]) -> tuple[Body, ...]:
    """Return the bodies with the limits of joints in the YAML file."""
    section.allow("torque", "velocity", "position")
    joints = tuple(body.name for body in bodies if body.kind == "link" and body.joint.nv == 1)
    limits: dict[str, dict[str, Any]] = {}
    for key in (key for key in ("torque", "velocity") if key in section):
        for name, value in _for_each(section, key, joints):
            limits.setdefault(name, {})[key] = value
    ranges = section.section("position")
    for name, pattern in ranges.keys_for(joints).items():
        lower, upper = ranges.vector(pattern, 2)
        if lower > upper:
            raise ranges.invalid(pattern, [lower, upper], "the lower limit first")
        limits.setdefault(name, {})["position"] = (lower, upper)
    for name in limits:
        if name not in joints:
            raise section.unknown("", name, joints, "a link with a joint about or along one axis")
    return tuple(replace(body, joint=replace(body.joint, **limits.get(body.name, {}))) for body in bodies)


def _with_passive_joints(file: Section, bodies: tuple[Body, ...], independent: tuple[str, ...]) -> tuple[Body, ...]:
    """Return the bodies with torque limits of 0 at joints that match the patterns under `passive`."""
    passive: set[str] = set()
    for pattern in file.texts("passive"):
        fitting = {name for alias, name in file.aliases.items() if fnmatchcase(alias, pattern)}
        matches = {name for name in independent if fnmatchcase(name, pattern) or name in fitting}
        if not matches:
            raise file.unknown("passive", pattern, independent, "the name of an independent joint, or a pattern")
        passive |= matches
    if passive and passive == set(independent):
        raise file.invalid("passive", tuple(passive), "at least one independent joint that is not passive")
    return tuple(
        replace(body, joint=replace(body.joint, torque=0.0)) if body.name in passive else body for body in bodies
    )


def _frames(section: Section, links: Links, bodies: tuple[Body, ...]) -> tuple[Frame, ...]:
    """Return the frames of the URDF or MJCF file, without those that became rotors, and the frames of the section."""
    names = {body.name for body in bodies}
    frames = [frame for frame in links.robot.frames if frame.name not in names]
    for name, entry in section.sections():
        entry.allow("body", "xyz", "rpy")
        body, pose = frame_named(entry, "body", links.frames)
        placement = Placement(vec3(entry.vector("xyz", 3, ZERO)), rotation_from_rpy(*entry.vector("rpy", 3, ZERO)))
        frames.append(Frame(name, body, compose(pose, placement)))
    return tuple(frames)


def _independent(file: Section, links: Robot, ties: tuple[Constraint, ...]) -> tuple[str, ...]:
    """Return the independent joints: by default all but the first joint of each linear constraint."""
    if "independent" in file:
        return file.texts("independent")
    if not all(tie.linear for tie in ties):
        expected = "the joints whose coordinates are independent, because loops and functions do not say which are"
        raise file.invalid("independent", None, expected)
    dependent = {tie.bodies[0] for tie in ties if tie.bodies}
    return tuple(joint for joint in links.independent if joint not in dependent)


def _assembly(file: Section, links: Robot, independent: tuple[str, ...]) -> Pairs:
    """Return rough coordinates of dependent joints in the standing pose."""
    if "assembly" in file:
        return file.section("assembly").numbers()
    return tuple((joint, value) for joint, value in links.assembly if joint not in independent)


def _pose(section: Section, default: Pose, bodies: tuple[Body, ...], independent: tuple[str, ...]) -> Pose:
    """Return the standing pose; joints that the YAML file does not name keep their default."""
    section.allow("height", "joints")
    if isinstance(section.get("height", 0.0), str) and section.get("height") != "auto":
        raise section.invalid("height", section.get("height"), "a number [m] or auto")
    named = section.section("joints").numbers_for(independent)
    rest = ((joint, value) for joint, value in default.joints if joint in independent and joint not in named)
    joints = complete_pose((*named.items(), *rest), bodies, independent)
    height = default.height if section.get("height", "auto") == "auto" else section.number("height")
    return Pose(height, joints)


def _with_height(section: Section, links: Robot, robot: Robot) -> Robot:
    """Return the robot at the height at which its lowest contact touches the ground, unless a file gives the height."""
    choice = section.get("height", "auto" if links.pose.height == 0.0 else links.pose.height)
    if choice != "auto" or not robot.floating:
        return robot
    height = touching_height(robot)
    if height is None and "height" in section:
        expected = "a number [m]: there are no contacts, or closed loops decide where they are"
        raise section.invalid("height", "auto", expected)
    return robot if height is None else replace(robot, pose=replace(robot.pose, height=height))


def _material(file: Section, links: Robot) -> ContactMaterial:
    if "material" not in file:
        return links.material
    section = file.section("material").allow("stiffness", "damping", "friction", "slip_speed", "bristle", "dissipation")
    return ContactMaterial(**{key: section.number(key) for key in section})


def _gains(section: Section, robot: Robot) -> Gains:
    """Return the gains of all driven joints, from one number for all or numbers by name or pattern."""
    section.allow("kp", "kd")
    gains = {}
    for key, pairs in (("kp", robot.gains.kp), ("kd", robot.gains.kd)):
        default = tuple((joint, gain) for joint, gain in pairs if joint in robot.driven)
        gains[key] = _for_each(section, key, robot.driven) if key in section else default
    return Gains(**gains)


def _for_each(section: Section, key: str, joints: tuple[str, ...]) -> Pairs:
    """Return a number for each joint in their order; unknown names come last, for `check_robot` to report."""
    value = section.get(key)
    if not isinstance(value, dict):
        return tuple((joint, finite(section.file, section.key(key), value)) for joint in joints)
    numbers = section.section(key).numbers_for(joints)
    order = [*(joint for joint in joints if joint in numbers), *(name for name in numbers if name not in joints)]
    return tuple((joint, numbers[joint]) for joint in order)
