"""The keys `rotors` and `elastic` of YAML robot files.

A rotor is given in one of three ways:

- in full: parent, xyz, axis, mass and inertia;
- as a link on a fixed joint of the URDF or MJCF file, with its axis;
- by its moment of inertia about its axis, or a motor of the library that has one. The rotor is then a thin disc whose
  inertia at rest the published inertia of its carrier includes (`rotor_links.py`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import Body, Inertial, Joint
from ce_gym.model.drives import Elasticity
from ce_gym.model.errors import invalid_value
from ce_gym.model.formats.motor_library import MotorType
from ce_gym.model.formats.placement import compose, rotation_from_rpy, symmetric, vec3
from ce_gym.model.formats.reading import Section
from ce_gym.model.formats.rotor_links import FixedLink, disc, without_rotors
from ce_gym.model.formats.urdf.elements import unit_axis
from ce_gym.model.formats.yaml.constraints import coefficients, frame_named
from ce_gym.model.formats.yaml.links import Links, names_in
from ce_gym.model.frames import ZERO, Placement, Vec3


def read_elastic(file: Section, bodies: Iterable[Body]) -> tuple[Elasticity, ...]:
    """Return the elastic transmissions, in the order of bodies."""
    section, rotors = file.section("elastic"), [body.name for body in bodies if body.kind == "rotor"]
    keys = section.keys_for(rotors)
    transmissions = []
    for rotor in (*(name for name in rotors if name in keys), *(name for name in keys if name not in rotors)):
        part = section.section(keys[rotor]).allow("stiffness", "damping", "backlash", "preload")
        optional = {key: part.number(key) for key in part if key != "stiffness"}
        transmissions.append(Elasticity(rotor, part.number("stiffness"), **optional))
    return tuple(transmissions)


def add_rotors(
    section: Section, links: Links, library: Mapping[str, MotorType]
) -> tuple[tuple[Body, ...], tuple[LinearConstraint, ...]]:
    """Return the bodies with the rotors among them, and the gears; other keys can then name the rotors as frames.

    Args:
        section: The section `rotors`.
        links: The links that carry the rotors; its frames gain the rotors.
        library: Entries of the motor library, by rotor.
    """
    rotors: list[Body] = []
    discs: dict[str | None, list[Body]] = {}
    for name, rotor in section.sections():
        rotor.allow("parent", "xyz", "rpy", "axis", "mass", "com", "inertia", "ratios")
        if name in links.frames and name not in links.fixed:
            raise section.invalid(name, name, "a name that no other body has")
        body, is_disc = _rotor(rotor, name, links, library.get(name))
        links.frames[name] = (name, Placement())
        rotors.append(body)
        if is_disc:
            discs.setdefault(body.parent, []).append(body)
    bodies = tuple(_without_discs(section, body, discs.get(body.name, [])) for body in links.robot.bodies)
    bodies = _interleaved(bodies, tuple(rotors), section)
    return bodies, tuple(_gears(section, bodies, library))


def _without_discs(section: Section, body: Body, discs: list[Body]) -> Body:
    """Return a link without the inertia at rest of the thin discs that it carries."""
    if not discs:
        return body
    inertial = without_rotors(body.inertial, discs)
    if inertial is None:
        names = ", ".join(rotor.name for rotor in discs)
        expected = "less inertia at rest than the body that carries them has"
        raise invalid_value(section.file, f"{section.path} on {body.name!r}", names, expected)
    return replace(body, inertial=inertial)


def _rotor(rotor: Section, name: str, links: Links, motor: MotorType | None) -> tuple[Body, bool]:
    """Return a rotor, and whether its carrier's inertia includes the rotor at rest."""
    if name in links.fixed:
        return _fixed(rotor, name, links.fixed[name]), False
    carrier, pose, axis = _mount(rotor, links)
    inertia = rotor.get("inertia", None)
    if isinstance(inertia, list) or (inertia is None and motor is None):
        com = vec3(rotor.vector("com", 3, ZERO))
        inertial = Inertial(rotor.number("mass"), com, symmetric(*rotor.vector("inertia", 6)))
        return Body(name, "rotor", carrier, pose, Joint("revolute", axis), inertial), False
    for key in ("mass", "com"):
        if key in rotor:
            raise rotor.invalid(key, rotor.get(key), "none: the carrier's values include the rotor")
    moment = motor.inertia if inertia is None and motor is not None else rotor.number("inertia")
    if not moment > 0.0:
        raise rotor.invalid("inertia", moment, "more than 0 [kg m^2]")
    return Body(name, "rotor", carrier, pose, Joint("revolute", axis), disc(moment, axis)), True


def _fixed(rotor: Section, name: str, link: FixedLink) -> Body:
    """Return a link on a fixed joint as a rotor."""
    for key in rotor:
        if key not in ("axis", "ratios"):
            expected = f"axis and ratios only: the link {name!r} has the other values"
            raise rotor.invalid(key, rotor.get(key), expected)
    axis = unit_axis(rotor.file, rotor.key("axis"), rotor.vector("axis", 3))
    return Body(name, "rotor", link.carrier, link.placement, Joint("revolute", axis), link.inertial, link.shapes)


def _mount(rotor: Section, links: Links) -> tuple[str | None, Placement, Vec3]:
    """Return a rotor's carrier, pose and axis; without `parent`, a rotor of one joint is mounted at that joint."""
    driven = names_in(rotor, "ratios")
    if "parent" not in rotor and len(driven) == 1 and driven[0] in links.robot.joints:
        for key in ("xyz", "rpy", "axis"):
            if key in rotor:
                raise rotor.invalid("parent", None, f"the body that carries the rotor, because of {key!r}")
        body = links.robot.body(driven[0])
        return body.parent, body.placement, body.joint.axis
    carrier, mount = frame_named(rotor, "parent", links.frames)
    pose = Placement(vec3(rotor.vector("xyz", 3)), rotation_from_rpy(*rotor.vector("rpy", 3, ZERO)))
    return carrier, compose(mount, pose), unit_axis(rotor.file, rotor.key("axis"), rotor.vector("axis", 3))


def _interleaved(links: tuple[Body, ...], rotors: tuple[Body, ...], section: Section) -> tuple[Body, ...]:
    """Put every rotor behind the last link that it drives, or behind its carrier if that comes later."""
    rank: dict[str, tuple[int, ...]] = {link.name: (i,) for i, link in enumerate(links)}
    for rotor in rotors:
        driven = [rank[link] for link in names_in(section.section(rotor.name), "ratios") if link in rank]
        mount = [rank[rotor.parent]] if rotor.parent else []
        rank[rotor.name] = (*max(driven + mount, default=(0,)), len(rank))
    return tuple(sorted((*links, *rotors), key=lambda body: rank[body.name]))


def _gears(section: Section, bodies: Iterable[Body], library: Mapping[str, MotorType]) -> Iterator[LinearConstraint]:
    """Iterate over the constraints `rotor angle = sum(ratio * joint angle)`."""
    names = [body.name for body in bodies]
    for name, rotor in section.sections():
        if isinstance(rotor.get("ratios", {}), list):
            rotor = _with_gearbox(rotor, library.get(name))
        ratios = rotor.section("ratios")
        if not ratios.data:
            raise rotor.invalid("ratios", {}, "at least one link and its gear ratio")
        if name in ratios:
            raise ratios.invalid(name, name, "a link other than the rotor itself")
        pairs = coefficients(ratios, names)
        yield LinearConstraint(name, ((name, 1.0), *((link, -ratio) for link, ratio in pairs)))


def _with_gearbox(rotor: Section, motor: MotorType | None) -> Section:
    """Return a rotor's section with the gear ratio of the motor's gearbox for each listed joint."""
    joints = rotor.texts("ratios")
    if motor is None:
        expected = "a mapping from joints to gear ratios, or a motor of the library under `motors`"
        raise rotor.invalid("ratios", list(joints), expected)
    return Section(rotor.file, rotor.path, {**rotor.data, "ratios": dict.fromkeys(joints, motor.ratio)}, rotor.aliases)
