"""The project's robot files: a YAML file beside a plain URDF -> `Robot`.

The URDF says what the links are; the YAML adds rotors, transmissions, motors, contacts, a pose and gains. A key that
is not known is refused. Every place that names a body may also name a link that a fixed joint merged into a body.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from ce_gym.model.checks.robot import check_robot
from ce_gym.model.constraints import Constraint, LinearConstraint
from ce_gym.model.description import Body, ContactMaterial, ContactSphere, Gains, Inertial, Joint, Motor, Pose, Robot
from ce_gym.model.errors import bad
from ce_gym.model.formats.placement import compose, rotation_from_rpy, symmetric, transform_point, vec3
from ce_gym.model.formats.reading import Section, finite, frozen, read_yaml
from ce_gym.model.formats.standing import with_limits
from ce_gym.model.formats.urdf.elements import unit_axis
from ce_gym.model.formats.urdf.tree import Base, Frame, read_urdf
from ce_gym.model.formats.yaml.constraints import coefficients, frame_named, read_constraints
from ce_gym.model.frames import Placement

_KEYS = (
    *("name", "urdf", "base", "sources", "notes", "kept_inertia", "gravity"),
    *("rotors", "constraints", "independent", "motors", "contacts", "material", "pose", "assembly", "gains", "tasks"),
)
_ROTOR_KEYS = ("parent", "xyz", "rpy", "axis", "mass", "com", "inertia", "ratios")


def robot_from_yaml(path: Path) -> Robot:
    """Read a robot's YAML file and the URDF it names."""
    file = read_yaml(path).allow(*_KEYS)
    tree = read_urdf(path.parent / file.text("urdf"), _base(file))
    file.texts("sources")  # for readers of the file; only its form is checked
    frames = dict(tree.frames)
    rotors = tuple(_rotors(file.section("rotors"), frames))
    bodies = _interleaved(tree.bodies, rotors, file.section("rotors"))
    constraints = (
        *tree.constraints,
        *_gears(file.section("rotors"), bodies),
        *read_constraints(file, bodies, frames),
    )
    independent = _independent(file, bodies, constraints)
    pose = file.section("pose").allow("height", "joints")
    robot = Robot(
        name=file.text("name", tree.name),
        bodies=bodies,
        constraints=constraints,
        independent=independent,
        contacts=tuple(_contacts(file.section("contacts"), frames)),
        material=_material(file.section("material")),
        motors=tuple(_motors(file.section("motors"))),
        pose=Pose(pose.number("height", 0.0), with_limits(pose.section("joints").numbers(), bodies, independent)),
        gains=_gains(file.section("gains"), independent),
        assembly=file.section("assembly").numbers(),
        gravity=vec3(file.vector("gravity", 3, (0.0, 0.0, -9.81))),
        tasks=tuple((name, frozen(task.items())) for name, task in file.section("tasks").sections()),
        kept_inertia=file.texts("kept_inertia"),
        source=str(path),
        notes=(*tree.notes, *file.texts("notes")),
    )
    check_robot(robot)
    return robot


def _base(file: Section) -> Base | None:
    return file.text("base", None, choices=("floating", "fixed"))  # type: ignore[return-value]


def _rotors(section: Section, frames: dict[str, Frame]) -> Iterator[Body]:
    """Iterate over the rotors; each becomes a frame that later ones can be mounted on."""
    for name, rotor in section.sections():
        rotor.allow(*_ROTOR_KEYS)
        if name in frames:
            raise bad(rotor.file, section.key(name), name, "a name that no other body has")
        carrier, mount = frame_named(rotor, "parent", frames)
        pose = Placement(vec3(rotor.vector("xyz", 3)), rotation_from_rpy(*rotor.vector("rpy", 3, (0.0, 0.0, 0.0))))
        axis = unit_axis(rotor.file, rotor.key("axis"), rotor.vector("axis", 3))
        inertial = Inertial(
            rotor.number("mass"), vec3(rotor.vector("com", 3, (0.0, 0.0, 0.0))), symmetric(*rotor.vector("inertia", 6))
        )
        frames[name] = (name, Placement())
        yield Body(name, "rotor", carrier, compose(mount, pose), Joint("revolute", axis), inertial)


def _interleaved(links: tuple[Body, ...], rotors: tuple[Body, ...], section: Section) -> tuple[Body, ...]:
    """Put every rotor behind the last link it drives, or behind the body it is mounted on if that comes later."""
    rank: dict[str, tuple[int, ...]] = {link.name: (i,) for i, link in enumerate(links)}
    for rotor in rotors:
        driven = [rank[link] for link in section.section(rotor.name).section("ratios") if link in rank]
        mount = [rank[rotor.parent]] if rotor.parent else []
        rank[rotor.name] = (*max(driven + mount, default=(0,)), len(rank))
    return tuple(sorted((*links, *rotors), key=lambda body: rank[body.name]))


def _gears(section: Section, bodies: Iterable[Body]) -> Iterator[LinearConstraint]:
    """Iterate over the ties `rotor angle = sum(ratio * joint angle)`."""
    names = [body.name for body in bodies]
    for rotor, figures in section.sections():
        ratios = figures.section("ratios")
        if not ratios.data:
            raise bad(figures.file, figures.key("ratios"), {}, "at least one link and its gear ratio")
        if rotor in ratios:
            raise bad(figures.file, ratios.key(rotor), rotor, "a link other than the rotor itself")
        pairs = coefficients(ratios, names)
        yield LinearConstraint(rotor, ((rotor, 1.0), *((link, -ratio) for link, ratio in pairs)))


def _independent(file: Section, bodies: tuple[Body, ...], constraints: tuple[Constraint, ...]) -> tuple[str, ...]:
    if "independent" not in file and not all(tie.linear for tie in constraints):
        expected = "the joints whose coordinates are independent, because loops and functions do not say which are"
        raise bad(file.file, "independent", None, expected)
    return file.texts("independent") if "independent" in file else _default_independent(bodies, constraints)


def _default_independent(bodies: Iterable[Body], constraints: Iterable[Constraint]) -> tuple[str, ...]:
    """Return the links that no constraint solves for; a constraint solves for the body it names first."""
    solved = {constraint.bodies[0] for constraint in constraints if constraint.bodies}
    return tuple(
        body.name for body in bodies if body.kind == "link" and body.joint.type != "free" and body.name not in solved
    )


def _contacts(section: Section, frames: dict[str, Frame]) -> Iterator[ContactSphere]:
    for name, contact in section.sections():
        contact.allow("body", "position", "radius", "group")
        body, pose = frame_named(contact, "body", frames)
        if body is None:
            raise bad(contact.file, contact.key("body"), contact.text("body"), "a body that moves")
        centre = transform_point(pose, vec3(contact.vector("position", 3)))
        yield ContactSphere(name, body, centre, contact.number("radius"), contact.text("group", "foot"))


def _motors(section: Section) -> Iterator[Motor]:
    for rotor, motor in section.sections():
        motor.allow("torque", "velocity", "stall", "damping", "friction")
        yield Motor(rotor, **{key: motor.number(key) for key in motor})


def _material(section: Section) -> ContactMaterial:
    section.allow("stiffness", "damping", "friction", "slip_speed", "bristle", "dissipation")
    return ContactMaterial(**{key: section.number(key) for key in section})


def _gains(section: Section, independent: tuple[str, ...]) -> Gains:
    """Return the gains of every independent joint, from one number for all or a number for each."""
    section.allow("kp", "kd")
    return Gains(**{key: _for_each(section, key, independent) for key in section})


def _for_each(section: Section, key: str, independent: tuple[str, ...]) -> tuple[tuple[str, float], ...]:
    """Return pairs in the order of the independent joints; names that are none of them stay, for the checks to see."""
    value = section.get(key)
    if isinstance(value, dict):
        each = dict(section.section(key).numbers())
        order = [
            *(joint for joint in independent if joint in each),
            *(name for name in each if name not in independent),
        ]
        return tuple((joint, each[joint]) for joint in order)
    gain = finite(section.file, section.key(key), value)
    return tuple((joint, gain) for joint in independent)
