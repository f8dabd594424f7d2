"""A picture of a robot in its standing pose, with its contacts and the frames of its feet."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ce_gym.dynamics.model import Model
from ce_gym.model.description import Robot, Shape
from ce_gym.model.frames import ORIGIN, Placement, Vec3
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.page.three import png
from ce_gym.viewer.raytrace.picture import Picture

COLORS = {"foot": (0.9, 0.1, 0.1), "torso": (0.95, 0.6, 0.1)}
OTHER = (0.5, 0.2, 0.8)
"""Colour of contacts of other groups."""
PROUD = 0.002
"""A contact is drawn so much larger, to be seen outside its link [m]."""
WIDTH, HEIGHT = 960, 720


def write_picture(path: Path, robot: Robot) -> bool:
    """Write a PNG file of a robot in its standing pose; return False if embreex, which draws it, is not installed.

    Contacts of the feet are red balls, of the trunk orange, of other links violet. The base and the feet have axes: x
    red, y green, z blue.
    """
    model = Model(robot)
    try:
        picture = Picture(model, model.standing_q, width=WIDTH, height=HEIGHT, marks=marks_of(robot))
    except ViewerError:
        return False
    path.write_bytes(png(picture.draw(model.standing_q)))
    return True


def marks_of(robot: Robot) -> dict[str, list[Shape]]:
    """Return balls at the contacts and axes at the base and the feet, by name of the body."""
    size = max(robot.pose.height, 0.1)
    marks: dict[str, list[Shape]] = {}
    for c in robot.contacts:
        color = (*COLORS.get(c.group, OTHER), 1.0)
        marks.setdefault(c.body, []).append(
            Shape("sphere", (max(c.radius + PROUD, 0.012 * size),), Placement(c.position), color)
        )
    feet = {c.body for c in robot.contacts if c.group == "foot"}
    for frame in robot.frames:
        if frame.body in feet:
            marks[frame.body] += _axes(frame.placement, 0.12 * size)
    if robot.floating:
        marks.setdefault(robot.bodies[0].name, []).extend(_axes(ORIGIN, 0.4 * size))
    return marks


def _axes(placement: Placement, length: float) -> Iterator[Shape]:
    """Iterate over three thin bars along the axes of a frame."""
    rotation, origin = np.array(placement.rotation), np.array(placement.position)
    for i, color in enumerate(((0.9, 0.1, 0.1, 1.0), (0.1, 0.7, 0.1, 1.0), (0.1, 0.2, 0.9, 1.0))):
        x, y, z = (float(value) for value in origin + 0.5 * length * rotation[:, i])
        edges = [0.06 * length] * 3
        edges[i] = length
        centre: Vec3 = (x, y, z)
        yield Shape("box", tuple(edges), Placement(centre, placement.rotation), color)
