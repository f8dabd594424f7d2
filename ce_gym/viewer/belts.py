"""Belts, for whoever looks through the links: where a rotor drives a joint that it does not sit on.

A robot file says how fast a rotor turns with which joints, not by what. Where axes are parallel and farther apart than
a pulley is wide, something flexible must run between them, and it is drawn: a pulley that turns with the joint, and two
strands. Knows the robot description.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.description import Body, LinearConstraint, Placement, Robot, Shape
from ce_gym.viewer.stand_ins import DARK, LIGHT, frame_along, rotor_discs

Array = NDArray[np.float64]

PULLEY = 0.6  # radius over that of the rotor's disc


def belt_shapes(robot: Robot) -> dict[str, list[Shape]]:
    """Return strands (boxes) and pulleys (cylinders) by the name of the body that carries them.

    A rotor that turns with several joints in a row, such as knee and ankle, has one belt to the first and from there
    one to the next.
    """
    discs = rotor_discs(robot)
    shapes: dict[str, list[Shape]] = {}
    for constraint in robot.constraints:
        rotors = [name for name in constraint.bodies if name in discs]
        if not isinstance(constraint, LinearConstraint) or len(rotors) != 1:
            continue
        rotor, radius = robot.body(rotors[0]), PULLEY * discs[rotors[0]].size[0]
        carrier, at, axis = rotor.parent, *_axis(rotor)
        for link in (robot.body(name) for name in constraint.bodies):
            if carrier is None or link.parent != carrier or link is rotor:
                continue
            place, other = _axis(link)
            across = place - at - axis * (axis @ (place - at))
            if abs(axis @ other) < 0.99 or np.linalg.norm(across) < 2 * radius:
                break  # gears
            shapes.setdefault(carrier, []).extend(_strands(at, across, axis, radius))
            rotation = np.array(link.placement.rotation)
            carrier, at, axis = link.name, rotation.T @ (at + across - place), rotation.T @ axis
            shapes.setdefault(carrier, []).append(_pulley(at, axis, radius))
    return shapes


def _axis(body: Body) -> tuple[Array, Array]:
    """Return a point of a joint's axis [m] and its direction in the parent's frame, each shape (3,)."""
    return np.array(body.placement.position), np.array(body.placement.rotation) @ np.array(body.joint.axis)


def _strands(at: Array, across: Array, axis: Array, radius: float) -> list[Shape]:
    length = float(np.linalg.norm(across))
    side = np.cross(axis, across / length)
    frame = np.column_stack([across / length, side, axis])
    size = (length, 0.12 * radius, 0.5 * radius)
    return [
        Shape("box", size, _placed(at + across / 2 + sign * radius * side, frame), (*DARK, 1.0)) for sign in (1, -1)
    ]


def _pulley(at: Array, axis: Array, radius: float) -> Shape:
    return Shape("cylinder", (radius, 0.6 * radius), _placed(at, frame_along(axis)), (*LIGHT, 1.0))


def _placed(position: Array, frame: Array) -> Placement:
    x, y, z = (tuple(row) for row in frame.tolist())
    return Placement(tuple(position.tolist()), (x, y, z))
