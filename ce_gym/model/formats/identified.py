"""The keys `robot` and `identified` of YAML robot files: parameters identified from logs, applied to another robot.

Each kind equals the simulator's parameter of the same name: a factor on inertia, or friction in its unit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ce_gym.model.description import Body, Robot
from ce_gym.model.drives import ELASTIC_FACTORS
from ce_gym.model.errors import invalid_value, unknown_name
from ce_gym.model.formats.placement import mat3
from ce_gym.model.formats.reading import Section
from ce_gym.model.mechanism import spin_inertia

FRICTION = "motor_damping", "motor_friction", "joint_damping", "joint_friction"
KINDS = "link_inertia", "added_mass", "rotor_inertia", *FRICTION, *ELASTIC_FACTORS
"""Kinds of parameters in the order in which they are applied: factors on links act on the inertia in the file."""
MAY_VANISH = *FRICTION, "drive_damping", "backlash"
"""Kinds that may be 0."""


def with_identified(robot: Robot, section: Section) -> Robot:
    """Return a robot with the parameters of a section, by kind and by rotor, joint or link.

    Raises:
        RobotError: A kind or name does not exist, or a value is negative.
    """
    section.allow(*KINDS)
    for kind, part in sorted(section.sections(), key=lambda named: KINDS.index(named[0])):
        for name, value in part.numbers():
            if name not in (known := _owners(robot, kind)):
                raise unknown_name(section.file, part.path, name, known, "a rotor, joint or link with this parameter")
            if kind != "added_mass" and not (value > 0 or (value == 0 and kind in MAY_VANISH)):
                expected = "more than 0, or 0 for friction, damping and backlash"
                raise invalid_value(section.file, part.key(name), value, expected)
            robot = _with(robot, kind, name, value)
    return robot


def _owners(robot: Robot, kind: str) -> tuple[str, ...]:
    if kind == "rotor_inertia":
        return tuple(rotor.name for rotor in robot.rotors())
    if kind.startswith("motor"):
        return tuple(motor.rotor for motor in robot.motors)
    if kind.startswith("joint"):
        return robot.commanded
    if kind in ELASTIC_FACTORS:
        return tuple(elastic.rotor for elastic in robot.elastic)
    return tuple(body.name for body in robot.bodies if body.kind == "link")


def _with(robot: Robot, kind: str, name: str, value: float) -> Robot:
    figure = kind.split("_")[-1]
    if kind in ELASTIC_FACTORS:
        now = next(getattr(elastic, figure) for elastic in robot.elastic if elastic.rotor == name)
        return replace(robot, elastic=_changed(robot.elastic, "rotor", name, {figure: value * now}))
    if kind.startswith("motor"):
        return replace(robot, motors=_changed(robot.motors, "rotor", name, {figure: value}))
    body = robot.body(name)
    if kind.startswith("joint"):
        return _with_body(robot, replace(body, joint=replace(body.joint, **{figure: value})))
    inertial = body.inertial
    if kind == "added_mass":
        return _with_body(robot, replace(body, inertial=replace(inertial, mass=inertial.mass + value)))
    if kind == "link_inertia":
        scaled = mat3(value * np.array(inertial.inertia))
        return _with_body(robot, replace(body, inertial=replace(inertial, inertia=scaled)))
    return _with_spin(robot, body, value)


def _with_spin(robot: Robot, rotor: Body, factor: float) -> Robot:
    """Scale a rotor's moment of inertia about its axis; the sum of rotor and carrier at rest does not change."""
    axis, inertia = np.array(rotor.joint.axis), np.array(rotor.inertial.inertia)
    added = (factor - 1) * spin_inertia(rotor) * np.outer(axis, axis)
    robot = _with_body(robot, replace(rotor, inertial=replace(rotor.inertial, inertia=mat3(inertia + added))))
    if rotor.parent is None:
        return robot
    carrier, turn = robot.body(rotor.parent), np.array(rotor.placement.rotation)
    rest = mat3(np.array(carrier.inertial.inertia) - turn @ added @ turn.T)
    return _with_body(robot, replace(carrier, inertial=replace(carrier.inertial, inertia=rest)))


def _with_body(robot: Robot, body: Body) -> Robot:
    return replace(robot, bodies=tuple(body if old.name == body.name else old for old in robot.bodies))


def _changed(items: tuple[Any, ...], key: str, name: str, fields: Mapping[str, float]) -> tuple[Any, ...]:
    return tuple(replace(item, **fields) if getattr(item, key) == name else item for item in items)
