"""Belts between a rotor and a joint that it drives from another axis, visible through transparent links.

A robot file gives the ratio of rotor and joints, not the kind of transmission. A belt is drawn where both axes are
parallel and farther apart than two pulleys are wide: two strands, tangents to pulleys of one size, and a pulley on
each joint's axis. A belt that continues to a further joint runs over a free pulley on the axis between, so that its
rotor turns equally far with every joint on the way. Rotors with other ratios belong to differentials and have no belt.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import Body, Robot, Shape
from ce_gym.viewer.page.fallback_shapes import DARK, LIGHT, frame_along, placed_at, rotor_discs

Array = NDArray[np.float64]

PULLEY = 0.6  # radius of a pulley over the radius of the rotor's disc


@dataclass(frozen=True)
class Part:
    """A strand or a pulley.

    Attributes:
        shape: In the frame of its body; a strand is a box along its x.
        links: Links, each with 1 or -1; the sum of their joint angles turns the pulley or moves the strand.
        axis: Axis of a pulley through the origin of its body, shape (3,); None for a strand.
        reach: Motion of a strand along its x per radian [m]; 0 for a pulley.
    """

    shape: Shape
    links: tuple[tuple[str, int], ...]
    axis: Array | None = None
    reach: float = 0.0


@dataclass(frozen=True)
class _Stage:
    """A belt from one axis to the next, in the frame of the body with both axes."""

    carrier: str  # name of that body
    link: Body
    at: Array  # a point of the first axis [m], shape (3,)
    across: Array  # from there to the second axis [m], shape (3,)
    axis: Array  # direction of both axes, shape (3,)
    sign: int  # 1, or -1 if the link's joint axis has the opposite direction


def belt_parts(robot: Robot) -> dict[str, list[Part]]:
    """Return strands and pulleys by the name of their body.

    A rotor that drives several joints in a row, such as knee and ankle, has one belt to the first joint and one from
    there to the next.
    """
    discs = rotor_discs(robot)
    parts: dict[str, list[Part]] = {}
    for constraint in robot.constraints:
        rotors = [name for name in constraint.bodies if name in discs]
        if not isinstance(constraint, LinearConstraint) or len(rotors) != 1:
            continue
        radius = PULLEY * discs[rotors[0]].size[0]
        stages = _stages(robot, constraint, robot.body(rotors[0]), radius)
        for index, stage in enumerate(stages):
            links = tuple((later.link.name, later.sign) for later in stages[index:])
            parts.setdefault(stage.carrier, []).extend(_strands(stage, radius, links))
            rotation = np.array(stage.link.placement.rotation).T
            centre = rotation @ (stage.at + stage.across - np.array(stage.link.placement.position))
            pulley = _pulley(centre, rotation @ stage.axis, radius, links[1:])
            parts.setdefault(stage.link.name, []).append(pulley)
    return parts


def _stages(robot: Robot, constraint: LinearConstraint, rotor: Body, radius: float) -> list[_Stage]:
    """Return the belts, one after the other, that fulfil a constraint; an empty list if belts cannot."""
    stages: list[_Stage] = []
    turns: list[float] = []
    waiting = {name: coefficient for name, coefficient in constraint.coefficients if name != rotor.name}
    carrier, at, axis = rotor.parent, *_axis(rotor)
    while waiting:
        link = next((robot.body(name) for name in waiting if robot.body(name).parent == carrier), None)
        if link is None or carrier is None:
            return []
        place, other = _axis(link)
        across = place - at - axis * (axis @ (place - at))
        if abs(axis @ other) < 0.99 or np.linalg.norm(across) < 4 * radius:
            return []  # gears
        stages.append(_Stage(carrier, link, at, across, axis, 1 if axis @ other > 0 else -1))
        turns.append(waiting.pop(link.name) * stages[-1].sign)
        rotation = np.array(link.placement.rotation)
        carrier, at, axis = link.name, rotation.T @ (at + across - place), rotation.T @ axis
    return stages if np.allclose(turns, turns[0], rtol=1e-6) else []


def _axis(body: Body) -> tuple[Array, Array]:
    """Return a point of a joint's axis [m] and its direction in the parent's frame, each shape (3,)."""
    return np.array(body.placement.position), np.array(body.placement.rotation) @ np.array(body.joint.axis)


def _strands(stage: _Stage, radius: float, links: tuple[tuple[str, int], ...]) -> list[Part]:
    length = float(np.linalg.norm(stage.across))
    side = np.cross(stage.axis, stage.across / length)
    frame = np.column_stack([stage.across / length, side, stage.axis])
    size, middle = (length, 0.12 * radius, 0.5 * radius), stage.at + stage.across / 2
    # A pulley that turns about z moves its side of y against x.
    return [
        Part(Shape("box", size, placed_at(middle + s * radius * side, frame), (*DARK, 1.0)), links, reach=-s * radius)
        for s in (1, -1)
    ]


def _pulley(at: Array, axis: Array, radius: float, links: tuple[tuple[str, int], ...]) -> Part:
    shape = Shape("cylinder", (radius, 0.6 * radius), placed_at(at, frame_along(axis)), (*LIGHT, 1.0))
    return Part(shape, links, axis)
