"""Motors that a URDF describes -> rotors behind gears.

- <transmission> of one joint with <mechanicalReduction> and <motorInertia>, in the transmission, its joint or each
  actuator (ROS control), or with <drake:gear_ratio value> and <drake:rotor_inertia value> (Drake).
- <dynamics rotor_inertia> (RaiSim): a reflected inertia at the joint, so a rotor of unknown gear ratio.

Each becomes a thin disc without mass about the joint's axis, mounted where the joint is; see `rotor_links.py`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from xml.etree.ElementTree import Element

from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import UNKNOWN_RATIO, Body, Joint
from ce_gym.model.errors import invalid_value
from ce_gym.model.formats.rotor_links import disc, without_rotors
from ce_gym.model.formats.urdf import elements as read
from ce_gym.model.formats.urdf.graph import UrdfGraph

WORDS = {
    "ratio": ("mechanicalReduction", "drake:gear_ratio", "gear_ratio"),
    "inertia": ("motorInertia", "drake:rotor_inertia", "rotor_inertia"),
}
UNMODELLED = ("type", "joint", "actuator", "hardwareInterface", "role", "offset")
"""Other elements of a <transmission>, without inertia."""
_READ = {*UNMODELLED, *(tag for words in WORDS.values() for tag in words)}
MOST_NAMES = 3
"""Most transmissions that a note names."""


@dataclass(frozen=True)
class Drive:
    """A motor at a joint.

    Attributes:
        where: Element of the motor, for messages.
        link: The link that the joint moves.
        inertia: Inertia of the rotor about its axis [kg m^2].
        ratio: Turns of the rotor for one turn of the joint.
    """

    where: str
    link: str
    inertia: float
    ratio: float


def drives_of(graph: UrdfGraph, notes: list[str]) -> tuple[Drive, ...]:
    """Return the motors with inertia and ratio, and add a note for each incomplete motor.

    Raises:
        RobotError: A number is malformed or negative.
    """
    return (*_transmissions(graph, notes), *_added_inertias(graph))


def add_rotors(
    bodies: tuple[Body, ...], drives: tuple[Drive, ...], known: Collection[str], notes: list[str]
) -> tuple[tuple[Body, ...], tuple[LinearConstraint, ...]]:
    """Return the bodies with a rotor for each drive, and the gears.

    Args:
        bodies: Links, parents before children.
        drives: The motors.
        known: Links with rotors in the YAML file, which goes before the URDF.
        notes: Gains a note for each drive without rotor.
    """
    moved, rotors, gears = {body.name: body for body in bodies}, list[Body](), list[LinearConstraint]()
    for drive in drives:
        link = moved.get(drive.link)
        if link is None or link.joint.nv != 1:
            notes.append(f"left out: {drive.where}: its joint does not move")
            continue
        if drive.link in known:
            notes.append(f"left out: {drive.where}: the YAML file describes the rotor")
            continue
        name = f"{drive.link}_rotor"
        while name in moved or name in {rotor.name for rotor in rotors}:
            name += "_"
        axis = link.joint.axis
        inertia = disc(drive.inertia, axis)
        rotors.append(Body(name, "rotor", link.parent, link.placement, Joint("revolute", axis), inertia))
        gears.append(LinearConstraint(name, ((name, 1.0), (drive.link, -drive.ratio))))
    return (*_with_rest(bodies, rotors, gears, notes), *rotors), tuple(gears)


def _with_rest(
    bodies: tuple[Body, ...], rotors: list[Body], gears: list[LinearConstraint], notes: list[str]
) -> Iterator[Body]:
    """Iterate over the links without the inertia at rest of the rotors that they carry.

    A carrier with less inertia than its rotors keeps its inertia, and the ratios of these rotors become unknown.
    """
    unknown = {gear.name for gear in gears if abs(gear.coefficients[1][1]) == UNKNOWN_RATIO}
    for body in bodies:
        carried = [rotor for rotor in rotors if rotor.parent == body.name and rotor.name not in unknown]
        rest = without_rotors(body.inertial, carried) if carried else body.inertial
        if rest is None:
            names = ", ".join(rotor.name for rotor in carried)
            notes.append(f"left out: the gear ratios of {names}: such rotors have more inertia than {body.name}")
            for rotor in carried:
                _forget_ratio(rotor, rotors, gears)
        yield body if rest is None else replace(body, inertial=rest)


def _forget_ratio(rotor: Body, rotors: list[Body], gears: list[LinearConstraint]) -> None:
    """Keep only the reflected inertia of a rotor: a much lighter rotor behind a much higher ratio."""
    i = next(i for i, gear in enumerate(gears) if gear.name == rotor.name)
    (own, (link, ratio)), at = gears[i].coefficients, rotors.index(rotor)
    gears[i] = replace(gears[i], coefficients=(own, (link, math.copysign(UNKNOWN_RATIO, ratio))))
    share = (ratio / UNKNOWN_RATIO) ** 2
    inertia = tuple(tuple(share * x for x in row) for row in rotor.inertial.inertia)
    rotors[at] = replace(rotor, inertial=replace(rotor.inertial, inertia=inertia))


def _transmissions(graph: UrdfGraph, notes: list[str]) -> Iterator[Drive]:
    by_name: Mapping[str, str] = {joint.name: link for link, joint in graph.joints.items()}
    left_out: dict[str, list[str]] = {}
    for i, element in enumerate(graph.robot.findall("transmission")):
        name = element.get("name") or str(i + 1)
        where = f"transmission {name!r}"
        joints = [joint.get("name", (joint.text or "").strip()) for joint in element.findall("joint")]
        motors = list(_motors(graph.file, where, element))
        unread = {child.tag for part in element.iter() for child in part} - _READ
        for tag in sorted(unread):
            left_out.setdefault(f"<{tag}>", []).append(name)
        for inertia, ratios in motors:
            if len(joints) != 1 or joints[0] not in by_name:
                left_out.setdefault("<motorInertia>, which needs one joint of the file,", []).append(name)
            elif len(ratios) > 1:
                left_out.setdefault("<motorInertia> behind several ratios", []).append(name)
            else:
                yield Drive(where, by_name[joints[0]], inertia, ratios[0])
        if not motors and any(
            abs(ratio) not in (0.0, 1.0) for ratio in _figures(graph.file, where, element.iter(), "ratio")
        ):
            key = "<mechanicalReduction> without an inertia of the motor's rotor"
            left_out.setdefault(key, []).append(name)
    notes += [f"left out: {words} in transmission {_listed(names)}" for words, names in left_out.items()]


def _motors(file: str, where: str, transmission: Element) -> Iterator[tuple[float, list[float]]]:
    """Iterate over the inertia of each motor and its ratio; several ratios if the ratio is ambiguous.

    A number belongs to its <actuator>, a number outside to all actuators. A ratio of 1 beside another ratio is ignored.
    """
    actuators = transmission.findall("actuator")
    inside = {part for actuator in actuators for part in actuator.iter()}
    shared = [part for part in transmission.iter() if part not in inside]
    for parts, others in (*((list(actuator.iter()), shared) for actuator in actuators), (shared, list(inside))):
        for inertia in _figures(file, where, parts, "inertia"):
            ratios = {*_figures(file, where, parts, "ratio"), *_figures(file, where, others, "ratio")}
            if 0.0 in ratios and inertia:
                raise invalid_value(file, f"{where} <mechanicalReduction>", 0.0, "a ratio other than 0")
            if inertia:
                yield inertia, sorted(ratios - {1.0}) or [1.0]


def _figures(file: str, where: str, parts: Iterable[Element], key: str) -> list[float]:
    """Return the numbers in elements of a ratio or an inertia, as text or as `value`."""
    numbers = []
    for element in (part for part in parts if part.tag in WORDS[key]):
        text = element.get("value", element.text or "")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        negative = value < 0.0 and key == "inertia"
        if not math.isfinite(value) or negative:
            expected = "a finite number" + (" that is not negative" * negative)
            raise invalid_value(file, f"{where} <{element.tag}>", text, expected)
        numbers.append(value)
    return numbers


def _listed(names: list[str]) -> str:
    rest = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return ", ".join(map(repr, names[:MOST_NAMES])) + rest


def _added_inertias(graph: UrdfGraph) -> Iterator[Drive]:
    for link, joint in graph.joints.items():
        dynamics = joint.element.find("dynamics")
        reflected = read.number(graph.file, joint.where, dynamics, "rotor_inertia", 0.0)
        if reflected < 0.0:
            raise invalid_value(graph.file, f"{joint.where} <dynamics rotor_inertia>", reflected, "0 or more [kg m^2]")
        if reflected:
            yield Drive(f"{joint.where} <dynamics rotor_inertia>", link, reflected / UNKNOWN_RATIO**2, UNKNOWN_RATIO)
