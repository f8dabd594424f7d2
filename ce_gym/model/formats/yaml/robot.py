"""The project's robot files: YAML over a plain URDF or an MJCF file -> `Robot`.

The URDF or MJCF says what the links are; the YAML adds rotors, transmissions, motors, contacts, a pose and gains. What
an MJCF file says of these holds where the YAML is silent. A key that is not known is refused. Every place that names a
body may also name a link that a fixed joint merged into a body.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path

from ce_gym.model.assets import assets_folder
from ce_gym.model.checks.robot import check_robot
from ce_gym.model.constraints import Constraint
from ce_gym.model.description import Body, ContactMaterial, Gains, Pose, Robot
from ce_gym.model.formats.identified import with_identified
from ce_gym.model.formats.placement import vec3
from ce_gym.model.formats.reading import Section, finite, frozen, read_yaml
from ce_gym.model.formats.standing import with_limits
from ce_gym.model.formats.urdf import drives
from ce_gym.model.formats.yaml.constraints import read_constraints
from ce_gym.model.formats.yaml.contacts import read_capsules, read_contacts, read_pairs
from ce_gym.model.formats.yaml.links import read_links
from ce_gym.model.formats.yaml.rotors import add_rotors, read_elastic, read_motors
from ce_gym.model.formats.yaml.supply import read_battery

_JOINT_FIGURES = {"joint_friction": "friction", "joint_stiffness": "stiffness", "joint_springref": "springref"}
_KEYS = (
    *("name", "urdf", "mjcf", "base", "sources", "notes", "kept_inertia", "gravity", "gears"),
    *("rotors", "constraints", "independent", "motors", "contacts", "material", "pose", "assembly", "gains", "tasks"),
    *("capsules", "self_collisions", "elastic", "battery", "passive"),
    *_JOINT_FIGURES,
)


def robot_from_yaml(path: Path) -> Robot:
    """Read a robot's YAML file and the URDF or MJCF file it names."""
    file = read_yaml(path)
    if "identified" in file:
        return _over(path, file.allow("robot", "identified", "notes"))
    file.allow(*_KEYS)
    links = read_links(path, file)
    below = links.robot
    file.texts("sources")  # for readers of the file; only its form is checked
    library, motors = read_motors(file.section("motors"))
    bodies, gears = add_rotors(file.section("rotors"), links, library)
    notes = list(below.notes)
    bodies, urdf_gears = drives.add_rotors(bodies, links.drives, links.driven, notes)
    gears = (*gears, *urdf_gears)
    bodies = _with_joint_figures(file, bodies)
    ties = (*gears, *read_constraints(file, bodies, links.frames))
    independent = _independent(file, below, ties)
    bodies = _without_actuators(file, bodies, independent)
    robot = replace(
        below,
        name=file.text("name", below.name),
        bodies=bodies,
        constraints=(*below.constraints, *ties),
        independent=independent,
        motors=motors,
        battery=read_battery(file),
        elastic=read_elastic(file.section("elastic"), bodies) if "elastic" in file else below.elastic,
        assembly=file.section("assembly").numbers()
        if "assembly" in file
        else _among(below.assembly, independent, False),
        gravity=vec3(file.vector("gravity", 3, below.gravity)),
        tasks=tuple((name, frozen(task.items())) for name, task in file.section("tasks").sections()),
        kept_inertia=file.texts("kept_inertia"),
        source=str(path),
        notes=(*notes, *file.texts("notes")),
    )
    if "contacts" in file:
        robot = replace(robot, contacts=tuple(read_contacts(file.section("contacts"), links)))
    pairs = read_pairs(file, links)
    robot = replace(robot, capsules=tuple(read_capsules(file.section("capsules"), links)), self_collisions=pairs)
    if "material" in file:
        robot = replace(robot, material=_material(file.section("material")))
    robot = replace(robot, pose=_pose(file.section("pose"), robot), gains=_gains(file.section("gains"), robot))
    check_robot(robot)
    return robot


def _over(path: Path, file: Section) -> Robot:
    """Return the robot of another file, with figures that were identified."""
    name = file.text("robot")
    beside = path.parent / name if name.endswith((".yaml", ".yml")) else assets_folder() / name / f"{name}.yaml"
    if not beside.is_file():
        known = sorted(file.stem for file in assets_folder().glob("*/*.yaml") if file.stem == file.parent.name)
        raise file.unknown("robot", name, known, "a robot of the package or a YAML file beside this one")
    if beside.resolve() == path.resolve() or "identified" in read_yaml(beside):
        raise file.invalid("robot", name, "a robot file without identified figures of its own")
    robot = with_identified(robot_from_yaml(beside), file.section("identified"))
    robot = replace(robot, source=str(path), notes=(*robot.notes, *file.texts("notes")))
    check_robot(robot)
    return robot


def _with_joint_figures(file: Section, bodies: tuple[Body, ...]) -> tuple[Body, ...]:
    """Return bodies whose joints have the friction and springs that the YAML gives them; it says nothing of rotors."""
    joints = tuple(body.name for body in bodies if body.kind == "link" and body.joint.nv == 1)
    for key, figure in _JOINT_FIGURES.items():
        given = dict(_for_each(file, key, joints)) if key in file else {}
        for name in given:
            if name not in joints:
                raise file.unknown(key, name, joints, "a link with a joint about or along one axis")
        bodies = tuple(
            replace(body, joint=replace(body.joint, **{figure: given[body.name]})) if body.name in given else body
            for body in bodies
        )
    return bodies


def _without_actuators(file: Section, bodies: tuple[Body, ...], independent: tuple[str, ...]) -> tuple[Body, ...]:
    """Return bodies with joints of no torque where a pattern of the list `passive` fits: no actuator moves these."""
    passive: set[str] = set()
    for pattern in file.texts("passive"):
        matches = {name for name in independent if fnmatchcase(name, pattern)}
        if not matches:
            raise file.unknown("passive", pattern, independent, "the name of an independent joint, or a pattern")
        passive |= matches
    if passive and passive == set(independent):
        raise file.invalid("passive", tuple(passive), "at least one independent joint that is not passive")
    return tuple(
        replace(body, joint=replace(body.joint, torque=0.0)) if body.name in passive else body for body in bodies
    )


def _independent(file: Section, below: Robot, ties: tuple[Constraint, ...]) -> tuple[str, ...]:
    """Return the independent joints; by default those that no tie solves for, and a tie solves for its first."""
    if "independent" in file:
        return file.texts("independent")
    if not all(tie.linear for tie in ties):
        expected = "the joints whose coordinates are independent, because loops and functions do not say which are"
        raise file.invalid("independent", None, expected)
    solved = {tie.bodies[0] for tie in ties if tie.bodies}
    return tuple(joint for joint in below.independent if joint not in solved)


def _among(
    pairs: tuple[tuple[str, float], ...], joints: Collection[str], among: bool = True
) -> tuple[tuple[str, float], ...]:
    """Return the pairs of a joint and a value whose joint is among some, or is not."""
    return tuple((joint, value) for joint, value in pairs if (joint in joints) == among)


def _pose(section: Section, robot: Robot) -> Pose:
    """Return the standing pose; joints that the YAML does not name are as the file below it has them."""
    section.allow("height", "joints")
    given = section.section("joints").figures(robot.independent)
    joints = (*given.items(), *_among(robot.pose.joints, set(robot.independent) - set(given)))
    pose = with_limits(joints, robot.bodies, robot.independent)
    return Pose(section.number("height", robot.pose.height), pose)


def _material(section: Section) -> ContactMaterial:
    section.allow("stiffness", "damping", "friction", "slip_speed", "bristle", "dissipation")
    return ContactMaterial(**{key: section.number(key) for key in section})


def _gains(section: Section, robot: Robot) -> Gains:
    """Return the gains of every driven joint, from one number for all or a number for each name or pattern."""
    section.allow("kp", "kd")
    below = {key: _among(getattr(robot.gains, key), robot.driven) for key in ("kp", "kd")}
    return Gains(**{**below, **{key: _for_each(section, key, robot.driven) for key in section}})


def _for_each(section: Section, key: str, joints: tuple[str, ...]) -> tuple[tuple[str, float], ...]:
    """Return pairs in the order of the joints; names that are none of them stay, for the checks to see."""
    value = section.get(key)
    if isinstance(value, dict):
        each = section.section(key).figures(joints)
        order = [*(joint for joint in joints if joint in each), *(name for name in each if name not in joints)]
        return tuple((joint, each[joint]) for joint in order)
    gain = finite(section.file, section.key(key), value)
    return tuple((joint, gain) for joint in joints)
