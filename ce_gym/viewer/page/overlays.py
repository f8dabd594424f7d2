"""Overlays of a robot: contacts, frames, inertia boxes, collision shapes and centre of mass. Boxes of a page show them.

Overlays are hidden nodes of the scene, named `overlay_<kind>`; `overlays.js` shows them and moves the centre of mass.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.checks.collisions import capsules_of
from ce_gym.model.description import Body, Robot, Shape
from ce_gym.model.frames import ORIGIN, Placement
from ce_gym.viewer.page import three
from ce_gym.viewer.page.fallback_shapes import frame_along, longest_offset, placed_along, placed_at
from ce_gym.viewer.page.robot import body_paths, shape_command
from ce_gym.viewer.page.three import Command

Array = NDArray[np.float64]
Shapes = dict[str | None, list[Shape]]
"""Shapes by name of their body; None for the world."""

CONTACT_COLOR = (0.90, 0.20, 0.24, 0.75)
INERTIA_COLOR = (0.95, 0.60, 0.10, 0.35)
COLLISION_COLOR = (0.20, 0.55, 0.90, 0.40)
CENTER_COLOR = (0.80, 0.15, 0.75, 1.0)
AXIS_COLORS = ((0.86, 0.18, 0.18, 1.0), (0.16, 0.62, 0.24, 1.0), (0.16, 0.36, 0.88, 1.0))


def overlay_commands(robot: Robot, root: str) -> Iterator[Command]:
    """Draw all overlays of a robot, hidden.

    Args:
        robot: The robot.
        root: Scene path of the whole robot.
    """
    paths = {None: root, **body_paths(robot, root)}
    kinds = {
        "contacts": contact_shapes(robot),
        "frames": frame_shapes(robot),
        "inertia": inertia_boxes(robot),
        "collision": collision_shapes(robot),
    }
    for kind, shapes in kinds.items():
        for body, items in shapes.items():
            path = f"{paths[body]}/overlay_{kind}"
            for index, shape in enumerate(items):
                yield shape_command(f"{path}/{index}", shape, shape.color, shape.color[3])
            yield three.set_property(path, "visible", False)
    masses = [[paths[b.name], b.inertial.mass, *b.inertial.com] for b in robot.bodies if b.inertial.mass > 0]
    if masses:
        path = f"{root}/overlay_center"
        ball = shape_command(f"{path}/ball", Shape("sphere", (0.09 * longest_offset(robot),)), CENTER_COLOR, 1.0)
        ball["object"]["object"]["userData"] = {"center_of_mass": masses}
        yield ball
        yield three.set_property(path, "visible", False)


def contact_shapes(robot: Robot) -> Shapes:
    """Return a ball for each contact, at least 3 % of the robot's longest link in radius, and a disc for each rim."""
    shapes: Shapes = {}
    least = 0.03 * longest_offset(robot)
    for contact in robot.contacts:
        if contact.rim:
            size = contact.rim + contact.radius, max(2 * contact.radius, least)
            shape = Shape("cylinder", size, placed_along(np.array(contact.axis), contact.position), CONTACT_COLOR)
        else:
            shape = Shape("sphere", (max(contact.radius, least),), Placement(contact.position), CONTACT_COLOR)
        shapes.setdefault(contact.body, []).append(shape)
    return shapes


def frame_shapes(robot: Robot) -> Shapes:
    """Return three axes (x red, y green, z blue) for each link, and shorter axes for each named frame."""
    length = 0.3 * longest_offset(robot)
    shapes: Shapes = {body.name: _axes(ORIGIN, length) for body in robot.bodies if body.kind == "link"}
    for frame in robot.frames:
        shapes.setdefault(frame.body, []).extend(_axes(frame.placement, 0.6 * length))
    return shapes


def _axes(placement: Placement, length: float) -> list[Shape]:
    rotation, thick = np.array(placement.rotation), 0.07 * length
    return [
        Shape(
            "box",
            (length, thick, thick),
            placed_at(np.array(placement.position) + rotation[:, i] * length / 2, np.roll(rotation, -i, axis=1)),
            AXIS_COLORS[i],
        )
        for i in range(3)
    ]


def inertia_boxes(robot: Robot) -> Shapes:
    """Return, for each link with mass, the homogeneous box with the link's mass and inertia."""
    return {body.name: [_inertia_box(body)] for body in robot.bodies if body.kind == "link" and body.inertial.mass > 0}


def _inertia_box(body: Body) -> Shape:
    # A box has I_x = m (b^2 + c^2) / 12, so a^2 = 6 (I_y + I_z - I_x) / m.
    moments, axes = np.linalg.eigh(np.array(body.inertial.inertia))
    squares = 6 * (moments.sum() - 2 * moments) / body.inertial.mass
    edges = np.sqrt(np.maximum(squares, 1e-8))  # published inertias may violate the triangle inequality
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return Shape("box", tuple(edges.tolist()), placed_at(np.array(body.inertial.com), axes), INERTIA_COLOR)


def collision_shapes(robot: Robot) -> Shapes:
    """Return the capsule of each link that collisions of links use."""
    shapes: Shapes = {}
    for body in robot.bodies:
        for capsule in capsules_of(robot, body.name) if body.kind == "link" else ():
            start, end = np.array(capsule.start), np.array(capsule.end)
            size = capsule.radius, float(np.linalg.norm(end - start))
            placement = placed_at((start + end) / 2, frame_along(end - start))
            shapes.setdefault(body.name, []).append(Shape("capsule", size, placement, COLLISION_COLOR))
    return shapes
