"""A robot as scene nodes: one nested group for each body, its shapes inside.

Groups nest as bodies do, so that a revolute joint moves its group by a rotation alone: animations stay small and links
do not shrink between frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.description import Body, Robot, Shape
from ce_gym.model.errors import listed_names
from ce_gym.model.frames import Placement
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.meshes.triangles import MOST, Triangles
from ce_gym.viewer.page import animation, three
from ce_gym.viewer.page.belts import Part, belt_parts
from ce_gym.viewer.page.fallback_shapes import DARK, LIGHT, drawn_of, rotor_discs
from ce_gym.viewer.page.three import Color, Command

Array = NDArray[np.float64]


def body_paths(robot: Robot, root: str) -> dict[str, str]:
    """Return the scene path of each body below `root`, by name."""
    paths: dict[str, str] = {}
    for body in robot.bodies:
        parent = root if body.parent is None else paths[body.parent]
        paths[body.name] = f"{parent}/{body.name.replace('/', '_')}"
    return paths


def placed_scans(scans: Sequence[Mapping[str, Any]], robot: Robot, root: str) -> list[dict[str, Any]]:
    """Return scans, see `Rollout.scan`, with the scene path of each one's link as `path`.

    Raises:
        ViewerError: A link is none of the robot's.
    """
    paths = body_paths(robot, root)
    links = {"": next(iter(paths.values())), **paths}
    for scan in scans:
        if scan["link"] not in links:
            raise ViewerError(f"scan: link={scan['link']!r}; expected one of {listed_names(scan['link'], paths)}")
    return [{**scan, "path": links[scan["link"]]} for scan in scans]


def robot_commands(
    robot: Robot, root: str, *, tint: Color | None = None, opacity: float = 1.0, triangles: int = MOST
) -> Iterator[Command]:
    """Draw all bodies of a robot.

    Args:
        robot: What to draw. If no body has meshes or shapes, each is a small ball joined to its parent by a stick.
        root: Scene path of the whole robot.
        tint: One colour for everything, in place of the shapes' own.
        opacity: Factor on the opacity of everything, 0..1.
        triangles: How many all its meshes may have.
    """
    paths, shapes, inside = body_paths(robot, root), drawn_of(robot, triangles), belt_parts(robot)
    for name, disc in rotor_discs(robot).items():
        inside.setdefault(name, []).append(Part(disc, ()))
    for body in robot.bodies:
        for index, shape in enumerate(shapes[body.name]):
            color = tint or shape.color
            path = f"{paths[body.name]}/{body.kind}_{index}"
            yield _shape_command(path, shape, color, opacity * shape.color[3])
            if body.kind == "rotor" and isinstance(shape, Shape) and shape.type == "cylinder":
                yield _spoke_command(f"{path}_spoke", shape, color, opacity)
        if body.name in inside:
            path = f"{paths[body.name]}/inside"
            for index, part in enumerate(inside[body.name]):
                yield from _part_commands(f"{path}/part_{index}", part, robot, paths, tint, opacity)
            yield three.set_property(path, "visible", False)


def _part_commands(
    path: str, part: Part, robot: Robot, paths: dict[str, str], tint: Color | None, opacity: float
) -> Iterator[Command]:
    """Draw a rotor, pulley or strand, visible through transparent links."""
    color = tint or part.shape.color
    command = _shape_command(path, part.shape, color, opacity)
    if part.links:  # moved by belts.js
        length, width, height = part.shape.size if part.shape.type == "box" else (0.0, 0.0, 0.0)
        command["object"]["object"]["userData"] = {
            "belt": {
                "links": [_joint(robot.body(name), paths[name], sign) for name, sign in part.links],
                "axis": [] if part.axis is None else part.axis.tolist(),
                "reach": part.reach,
                **{"length": length, "width": width, "height": height},
            }
        }
    yield command
    if part.shape.type == "cylinder":
        yield _spoke_command(f"{path}/spoke", part.shape, color, opacity)


def _joint(body: Body, path: str, sign: int) -> Command:
    """Return what the page needs to find a joint's angle from the pose of the link that it moves."""
    rest = animation.quaternions(np.array(body.placement.rotation)).tolist()
    return {"path": path, "rest": rest, "axis": list(body.joint.axis), "sign": sign}


def _shape_command(path: str, shape: Shape | Triangles, color: Color, opacity: float) -> Command:
    matrix = _matrix(shape.placement)
    if isinstance(shape, Triangles):
        return three.mesh(path, three.triangles(shape.vertices, shape.faces), color, matrix, opacity=opacity, flat=True)
    if shape.type == "box":
        return three.mesh(path, three.box(*shape.size), color, matrix, opacity=opacity)
    if shape.type == "sphere":
        return three.mesh(path, three.sphere(*shape.size), color, matrix, opacity=opacity)
    make = three.cylinder if shape.type == "cylinder" else three.capsule
    return three.mesh(path, make(*shape.size), color, matrix @ three.Y_TO_Z, opacity=opacity)


def _spoke_command(path: str, shape: Shape, color: Color, opacity: float) -> Command:
    """Draw a bar across both faces of a rotor's disc, which makes its spin visible."""
    radius, length = shape.size
    bar = three.box(1.7 * radius, 0.3 * radius, 1.04 * length)
    contrast = DARK if sum(color[:3]) > 1.5 else LIGHT
    return three.mesh(path, bar, contrast, _matrix(shape.placement), opacity=opacity)


def _matrix(placement: Placement) -> Array:
    return three.transform(placement.position, placement.rotation)


def extent(robot: Robot, positions: Array, rotations: Array) -> tuple[Array, Array]:
    """Return the corners of a box around a posed robot [m].

    Args:
        robot: What is drawn.
        positions: Of the bodies in the world [m], shape (n_bodies, 3), in the robot's order.
        rotations: Shape (n_bodies, 3, 3).
    """
    low, high = positions.min(0), positions.max(0)
    shapes = drawn_of(robot)
    for body, position, rotation in zip(robot.bodies, positions, rotations, strict=True):
        for shape in shapes[body.name]:
            if isinstance(shape, Triangles):
                own = shape.vertices @ np.array(shape.placement.rotation).T + shape.placement.position
                corners = own @ rotation.T + position
                low, high = np.minimum(low, corners.min(0)), np.maximum(high, corners.max(0))
                continue
            centre = position + rotation @ np.array(shape.placement.position)
            reach = _half_edges(shape, rotation @ np.array(shape.placement.rotation))
            low, high = np.minimum(low, centre - reach), np.maximum(high, centre + reach)
    return low, high


def _half_edges(shape: Shape, rotation: Array) -> Array:
    """Return half the edges of a box around a shape, along the world's axes [m]."""
    if shape.type == "sphere":
        return np.full(3, shape.size[0])
    if shape.type == "box":
        half = np.array(shape.size) / 2
    else:
        ends = shape.size[0] if shape.type == "capsule" else 0.0
        half = np.array([shape.size[0], shape.size[0], shape.size[1] / 2 + ends])
    return np.abs(rotation) @ half
