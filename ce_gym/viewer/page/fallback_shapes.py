"""The shapes of a robot's bodies: meshes, its file's shapes, or a stick figure; and discs for rotors without shapes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.description import Body, ContactSphere, Robot, Shape
from ce_gym.model.frames import Placement, Vec3
from ce_gym.viewer.meshes.triangles import MOST, Triangles, drawn_meshes
from ce_gym.viewer.meshes.visuals import visuals_of
from ce_gym.viewer.page.three import Color

Array = NDArray[np.float64]

LIGHT, DARK = (0.93, 0.94, 0.95), (0.16, 0.18, 0.21)
STICK_COLORS = {"link": (0.30, 0.45, 0.62), "rotor": (0.90, 0.55, 0.20)}
ROTOR_DENSITY = 1000.0  # of a drawn rotor [kg/m^3]: a ring of steel and copper with air inside


def shapes_of(robot: Robot, triangles: int = MOST) -> dict[str, tuple[Shape | Triangles, ...]]:
    """Return the shapes of each body, by name: its meshes, else its file's shapes; a stick figure if no body has any.

    Args:
        robot: The robot.
        triangles: Most triangles of all meshes together.
    """
    meshes = drawn_meshes(robot, triangles)
    if meshes or any(body.shapes for body in robot.bodies):
        return {body.name: meshes.get(body.name, body.shapes) for body in robot.bodies}
    return {**stick_figure(robot)}


def stick_figure(robot: Robot) -> dict[str, tuple[Shape, ...]]:
    """Return a ball at each body's origin, and sticks from there to its children and contacts."""
    ends = _ends(robot)
    radius = 0.07 * longest_offset(robot)
    shapes = {body.name: [_ball(STICK_COLORS[body.kind], radius)] for body in robot.bodies}
    for name, end in ends:
        if np.linalg.norm(end) > 1e-6:
            shapes[name].append(_stick(np.array(end), 0.5 * radius))
    for sphere in robot.contacts:
        shapes[sphere.body].append(_contact_shape(sphere, max(sphere.radius, 0.5 * radius)))
    return {name: tuple(items) for name, items in shapes.items()}


def _ends(robot: Robot) -> list[tuple[str, Vec3]]:
    """Return the place of each child and contact on a body, with the name of that body."""
    ends = [(body.parent, body.placement.position) for body in robot.bodies if body.parent is not None]
    return [*ends, *((sphere.body, sphere.position) for sphere in robot.contacts)]


def longest_offset(robot: Robot) -> float:
    """Return the longest distance from a body's origin to a child or contact [m], the scale of marks on a robot."""
    return max((float(np.linalg.norm(end)) for _, end in _ends(robot)), default=0.0) or 0.7


def _contact_shape(sphere: ContactSphere, radius: float) -> Shape:
    """Return a ball for a contact sphere, a disc for a sphere that moves around a rim."""
    if not sphere.rim:
        return _ball(DARK, radius, Placement(sphere.position))
    size = sphere.rim + sphere.radius, 2 * sphere.radius or 0.2 * radius
    return Shape("cylinder", size, placed_along(np.array(sphere.axis), sphere.position), (*DARK, 1.0))


def _ball(color: Color, radius: float, placement: Placement | None = None) -> Shape:
    red, green, blue = color
    return Shape("sphere", (radius,), placement or Placement(), (red, green, blue, 1.0))


def _stick(end: Array, radius: float) -> Shape:
    pose = placed_at(end / 2, frame_along(end))
    return Shape("cylinder", (radius, float(np.linalg.norm(end))), pose, (*LIGHT, 1.0))


def rotor_discs(robot: Robot) -> dict[str, Shape]:
    """Return a disc for each rotor without shapes; none for stick figures."""
    if not visuals_of(robot) and not any(body.shapes for body in robot.bodies):
        return {}
    least = 0.03 * longest_offset(robot)
    return {body.name: _disc(body, least) for body in robot.rotors() if not body.shapes}


def _disc(rotor: Body, least: float) -> Shape:
    """Return the disc of `ROTOR_DENSITY`, half as thick as its radius, with a rotor's inertia about its axis.

    The mass is not used: in many files the mass of the carrier includes the rotor's. Rotors without known inertia have
    the radius `least` [m].
    """
    # I = m r^2 / 2 = density pi r^5 / 4
    axis = np.array(rotor.joint.axis)
    inertia = float(axis @ np.array(rotor.inertial.inertia) @ axis)
    radius = max((4 * inertia / (np.pi * ROTOR_DENSITY)) ** 0.2, least)
    red, green, blue = STICK_COLORS["rotor"]
    return Shape("cylinder", (radius, radius / 2), placed_along(axis, rotor.inertial.com), (red, green, blue, 1.0))


def placed_along(direction: Array, position: Vec3) -> Placement:
    """Return the placement at a position with the third axis along `direction`, shape (3,)."""
    return placed_at(np.array(position), frame_along(direction))


def placed_at(position: Array, rotation: Array) -> Placement:
    """Return the placement at a position, shape (3,), with a rotation, shape (3, 3)."""
    x, y, z = (tuple(row) for row in rotation.tolist())
    return Placement(tuple(position.tolist()), (x, y, z))


def frame_along(direction: Array) -> Array:
    """Return rotations, shape (..., 3, 3), whose third axis is along `direction`, shape (..., 3).

    A zero direction gives the upright frame.
    """
    length = np.linalg.norm(direction, axis=-1, keepdims=True)
    z = np.where(length > 1e-12, direction / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])
    # Any vector that is not nearly along z completes the frame.
    helper = np.where(np.abs(z[..., :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    y = np.cross(z, helper)
    y /= np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([np.cross(y, z), y, z], -1)
