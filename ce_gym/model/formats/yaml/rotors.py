"""The `rotors`, `motors` and `elastic` transmissions of the project's robot files.

A rotor is given in full (parent, xyz, axis, mass, inertia), or is a link on a fixed joint of the URDF or MJCF file, of
which only the axis is missing, or has one figure, the moment of inertia about its axis, perhaps from the motor library;
then it is a thin disc that its carrier's published figures count (`rotor_links.py`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, replace
from typing import Any

from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import Body, Inertial, Joint
from ce_gym.model.drives import DriveFriction, Elasticity, Motor
from ce_gym.model.errors import invalid_value
from ce_gym.model.formats.motors import MotorType, motor_type
from ce_gym.model.formats.placement import compose, rotation_from_rpy, symmetric, vec3
from ce_gym.model.formats.reading import Section
from ce_gym.model.formats.rotor_links import FixedLink, disc, without_rotors
from ce_gym.model.formats.urdf.elements import unit_axis
from ce_gym.model.formats.yaml.constraints import coefficients, frame_named
from ce_gym.model.formats.yaml.links import Links, names_in
from ce_gym.model.formats.yaml.supply import read_cogging, read_heat
from ce_gym.model.frames import Placement, Vec3

_KEYS = ("parent", "xyz", "rpy", "axis", "mass", "com", "inertia", "ratios")
_ELASTIC_KEYS = ("stiffness", "damping", "backlash", "preload")
_MOTOR_KEYS = ("torque", "velocity", "stall", "damping", "bandwidth", "motor_constant")
_MOTOR_PARTS = ("use", "friction", "heat", "cogging")
_FRICTION_KEYS = tuple(field.name for field in fields(DriveFriction) if field.name != "factor")
_BOTH_KEYS = ("load", "stribeck_load")
"""Stand for the share of the motor's torque and that of all else, equal."""


def read_motors(section: Section) -> tuple[dict[str, MotorType], tuple[Motor, ...]]:
    """Return the library's entries that motors name, by rotor, and the motors."""
    used: dict[str, MotorType] = {}
    motors = []
    for rotor, motor in section.sections():
        motor.allow(*_MOTOR_PARTS, *_MOTOR_KEYS)
        figures: dict[str, float] = {}
        if "use" in motor:
            used[rotor] = motor_type(motor.text("use"), motor.file, motor.key("use"))
            figures = used[rotor].limits()
        figures |= {key: motor.number(key) for key in motor if key in _MOTOR_KEYS}
        more = _friction(motor) | read_heat(motor, used.get(rotor)) | read_cogging(motor)
        motors.append(Motor(rotor, **figures, **more))
    return used, tuple(motors)


def _friction(motor: Section) -> dict[str, Any]:
    """Return what a motor has of dry friction: a number, or a mapping with what depends on speed and load."""
    if not isinstance(motor.get("friction", None), dict):
        return {"friction": motor.number("friction", 0.0)}
    section = motor.section("friction").allow("coulomb", *_BOTH_KEYS, *_FRICTION_KEYS)
    figures = {key: section.number(key) for key in section if key in _FRICTION_KEYS}
    for both in (key for key in _BOTH_KEYS if key in section):
        for key in (f"{both}_motor", f"{both}_external"):
            if key in section:
                raise section.invalid(key, section.get(key), f"none beside {both!r}, which is both")
            figures[key] = section.number(both)
    more = {"drive_friction": DriveFriction(**figures)} if figures else {}
    return {"friction": section.number("coulomb", 0.0)} | more


def read_elastic(section: Section, bodies: Iterable[Body]) -> tuple[Elasticity, ...]:
    """Return how transmissions give way, by rotor, in the order of bodies."""
    rotors = [body.name for body in bodies if body.kind == "rotor"]
    keys = section.keys_of(rotors)
    found = []
    for rotor in (*(name for name in rotors if name in keys), *(name for name in keys if name not in rotors)):
        part = section.section(keys[rotor]).allow(*_ELASTIC_KEYS)
        found.append(
            Elasticity(rotor, part.number("stiffness"), **{k: part.number(k) for k in part if k != "stiffness"})
        )
    return tuple(found)


def add_rotors(
    section: Section, links: Links, library: Mapping[str, MotorType]
) -> tuple[tuple[Body, ...], tuple[LinearConstraint, ...]]:
    """Return the bodies with the rotors among them, and the gears; each rotor becomes a frame that others can name.

    Args:
        section: The section `rotors`.
        links: What the rotors are mounted on and drive; its frames gain the rotors.
        library: Entries of the motor library, by rotor.
    """
    bodies = list(links.robot.bodies)
    rotors, counted = [], {}
    for name, rotor in section.sections():
        rotor.allow(*_KEYS)
        if name in links.frames and name not in links.fixed:
            raise invalid_value(rotor.file, section.key(name), name, "a name that no other body has")
        body, is_counted = _rotor(rotor, name, links, library.get(name))
        links.frames[name] = (name, Placement())
        rotors.append(body)
        if is_counted and body.parent is not None:
            counted.setdefault(body.parent, []).append(body)
    for i, body in enumerate(bodies):
        if body.name in counted:
            rest = without_rotors(body.inertial, counted[body.name])
            if rest is None:
                names = ", ".join(rotor.name for rotor in counted[body.name])
                expected = "less inertia at rest than the body that carries them has"
                raise invalid_value(section.file, f"{section.path} on {body.name!r}", names, expected)
            bodies[i] = replace(body, inertial=rest)
    everything = _interleaved(tuple(bodies), tuple(rotors), section)
    return everything, tuple(_gears(section, everything, library))


def _rotor(rotor: Section, name: str, links: Links, motor: MotorType | None) -> tuple[Body, bool]:
    """Return a rotor, and whether its inertia at rest is counted in its carrier's."""
    if name in links.fixed:
        return _fixed(rotor, name, links.fixed[name]), False
    carrier, pose, axis = _mount(rotor, links)
    inertia = rotor.get("inertia", None)
    if isinstance(inertia, list) or (inertia is None and motor is None):
        centre = vec3(rotor.vector("com", 3, (0.0, 0.0, 0.0)))
        inertial = Inertial(rotor.number("mass"), centre, symmetric(*rotor.vector("inertia", 6)))
        return Body(name, "rotor", carrier, pose, Joint("revolute", axis), inertial), False
    for key in ("mass", "com"):
        if key in rotor:
            raise rotor.invalid(key, rotor.get(key), "none: with one moment of inertia the carrier has it")
    moment = motor.inertia if inertia is None and motor is not None else rotor.number("inertia")
    if not moment > 0.0:
        raise rotor.invalid("inertia", moment, "more than 0 [kg m^2]")
    return Body(name, "rotor", carrier, pose, Joint("revolute", axis), disc(moment, axis)), True


def _fixed(rotor: Section, name: str, link: FixedLink) -> Body:
    """Return a link on a fixed joint as the rotor that it is."""
    for key in rotor:
        if key not in ("axis", "ratios"):
            expected = f"axis and ratios alone, because {name!r} is a link that has the rest"
            raise rotor.invalid(key, rotor.get(key), expected)
    axis = unit_axis(rotor.file, rotor.key("axis"), rotor.vector("axis", 3))
    return Body(name, "rotor", link.carrier, link.placement, Joint("revolute", axis), link.inertial, link.shapes)


def _mount(rotor: Section, links: Links) -> tuple[str | None, Placement, Vec3]:
    """Return a rotor's carrier, pose and axis: at the joint it drives, if it says nothing and drives only one."""
    driven = names_in(rotor, "ratios")
    if "parent" not in rotor and len(driven) == 1 and driven[0] in links.robot.joints:
        for key in ("xyz", "rpy", "axis"):
            if key in rotor:
                raise rotor.invalid("parent", None, f"the body that carries the rotor, because of {key!r}")
        body = links.robot.body(driven[0])
        return body.parent, body.placement, body.joint.axis
    carrier, mount = frame_named(rotor, "parent", links.frames)
    pose = Placement(vec3(rotor.vector("xyz", 3)), rotation_from_rpy(*rotor.vector("rpy", 3, (0.0, 0.0, 0.0))))
    return carrier, compose(mount, pose), unit_axis(rotor.file, rotor.key("axis"), rotor.vector("axis", 3))


def _interleaved(links: tuple[Body, ...], rotors: tuple[Body, ...], section: Section) -> tuple[Body, ...]:
    """Put every rotor behind the last link it drives, or behind the body it is mounted on if that comes later."""
    rank: dict[str, tuple[int, ...]] = {link.name: (i,) for i, link in enumerate(links)}
    for rotor in rotors:
        driven = [rank[link] for link in names_in(section.section(rotor.name), "ratios") if link in rank]
        mount = [rank[rotor.parent]] if rotor.parent else []
        rank[rotor.name] = (*max(driven + mount, default=(0,)), len(rank))
    return tuple(sorted((*links, *rotors), key=lambda body: rank[body.name]))


def _gears(section: Section, bodies: Iterable[Body], library: Mapping[str, MotorType]) -> Iterator[LinearConstraint]:
    """Iterate over the ties `rotor angle = sum(ratio * joint angle)`."""
    names = [body.name for body in bodies]
    for rotor, figures in section.sections():
        ratios = _with_gearbox(figures, library.get(rotor)) if isinstance(figures.get("ratios", {}), list) else figures
        ratios = ratios.section("ratios")
        if not ratios.data:
            raise figures.invalid("ratios", {}, "at least one link and its gear ratio")
        if rotor in ratios:
            raise invalid_value(figures.file, ratios.key(rotor), rotor, "a link other than the rotor itself")
        pairs = coefficients(ratios, names)
        yield LinearConstraint(rotor, ((rotor, 1.0), *((link, -ratio) for link, ratio in pairs)))


def _with_gearbox(rotor: Section, motor: MotorType | None) -> Section:
    """Return a rotor's section with the ratio of its motor's own gearbox for each of the joints that it lists."""
    joints = rotor.texts("ratios")
    if motor is None:
        expected = "a mapping from joints to gear ratios, or a motor of the library under `motors`, whose ratio it is"
        raise rotor.invalid("ratios", list(joints), expected)
    return Section(rotor.file, rotor.path, {**rotor.data, "ratios": dict.fromkeys(joints, motor.ratio)})
