"""Convex contact shapes of a robot that ground between their corners could rise into."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from ce_gym.dynamics.hulls import MOST_POINTS, RISE, Hull, hull_of
from ce_gym.model.description import Robot
from ce_gym.model.frames import Vec3
from ce_gym.sim.terrain.field import Terrain


def hulls_on(robot: Robot, contacts: Sequence[str], terrain: Terrain | None) -> tuple[Hull, ...]:
    """Return the convex shapes among the contacts of a scene that need points between their corners.

    Corners of one shape are the contacts of a primitive, or points of group "foot" on one link with one radius, such as
    a sole. Points of group "foot" on the base are legs, with nothing between them. Points are half a cell apart, or as
    far as the curvature of the ground lets it rise by half of `RISE` between two points. A shape needs no points if the
    ground rises less between any two corners.

    Args:
        robot: The robot.
        contacts: Names of the contacts of the scene, in order.
        terrain: The ground; None if it is flat.
    """
    if terrain is None:
        return ()
    shapes, hulls = _shapes(robot, contacts), []
    bend = _curvature(terrain) if shapes else 0.0
    for (body, shape, radius), corners in shapes.items():
        length = float(np.linalg.norm(np.ptp(np.array(list(corners.values())), axis=0)))
        if bend * length**2 / 4 <= RISE:
            continue
        spacing = max(terrain.cell / 2, (4 * RISE / bend) ** 0.5)
        hull = hull_of(body, radius, corners, spacing)
        hulls += [hull] if hull.regions else []
        if hull.spacing > max(spacing, 2 * terrain.cell):
            warnings.warn(
                f"{robot.name}: {MOST_POINTS} points on contact shape {shape or 'foot'!r} of {body} are more than two "
                f"cells of {terrain.cell:g} m apart; narrower ridges pass between them. Use a longer cell.",
                stacklevel=4,
            )
    return tuple(hulls)


def _curvature(terrain: Terrain) -> float:
    """Return a bound of the second derivative of a surface in any direction [1/m]."""
    z = terrain.heights
    along_x, along_y = np.abs(np.diff(z, 2, axis=0)).max(), np.abs(np.diff(z, 2, axis=1)).max()
    return float(max(along_x, along_y) + np.abs(np.diff(np.diff(z, axis=0), axis=1)).max()) / terrain.cell**2


def _shapes(robot: Robot, contacts: Sequence[str]) -> dict[tuple[str, str, float], dict[int, Vec3]]:
    """Return the corners of each convex shape by their places among the contacts."""
    spheres = {sphere.name: sphere for sphere in robot.contacts}
    shapes: dict[tuple[str, str, float], dict[int, Vec3]] = {}
    for i, name in enumerate(contacts):
        sphere = spheres[name]
        if not sphere.rim and (sphere.shape or (sphere.group == "foot" and sphere.body != robot.bodies[0].name)):
            shapes.setdefault((sphere.body, sphere.shape, sphere.radius), {})[i] = sphere.position
    return {key: corners for key, corners in shapes.items() if len(set(corners.values())) > 1}
