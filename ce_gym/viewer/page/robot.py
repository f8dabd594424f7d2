"""A robot as scene nodes: one nested group for each body, its shapes inside.

Groups nest as bodies do, so that a revolute joint moves its group by a rotation alone. This keeps animations small, and
links keep their length between frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.model.description import Body, Robot, Shape
from ce_gym.model.errors import listed_names
from ce_gym.model.frames import Placement
from ce_gym.viewer.errors import ViewerError
from ce_gym.viewer.meshes.triangles import MOST, Triangles
from ce_gym.viewer.page import three
from ce_gym.viewer.page.belts import Part, belt_parts
from ce_gym.viewer.page.fallback_shapes import DARK, LIGHT, rotor_discs, shapes_of
from ce_gym.viewer.page.three import Color, Command

if TYPE_CHECKING:
    from ce_gym.dynamics.model import Model

Array = NDArray[np.float64]

_GEOMETRIES = {"box": three.box, "sphere": three.sphere, "cylinder": three.cylinder, "capsule": three.capsule}


def body_paths(robot: Robot, root: str) -> dict[str, str]:
    """Return the scene path of each body below `root`, by name, in the robot's order."""
    paths: dict[str, str] = {}
    for body in robot.bodies:
        parent = root if body.parent is None else paths[body.parent]
        paths[body.name] = f"{parent}/{body.name.replace('/', '_')}"
    return paths


def pose_bodies(model: Model, q: ArrayLike) -> tuple[Array, Array]:
    """Return the poses of a robot's bodies, in the robot's order.

    Args:
        model: The robot.
        q: Positions, shape (F, nq).

    Returns:
        Origins in the world [m], shape (F, n_bodies, 3), and rotations body to world, shape (F, n_bodies, 3, 3).
    """
    order = [model.body_names.index(body.name) for body in model.robot.bodies]
    positions, rotations = model.body_poses(np.asarray(q, float))
    return positions[:, order], rotations[:, order]


def joint_poses(robot: Robot, positions: Array, rotations: Array) -> Iterator[tuple[str, Array, Array]]:
    """Yield the name of each body with its positions, shape (F, 3), and rotations against its parent.

    Args:
        robot: The robot.
        positions: See `pose_bodies`.
        rotations: See `pose_bodies`.
    """
    index = {body.name: i for i, body in enumerate(robot.bodies)}
    for i, body in enumerate(robot.bodies):
        position, rotation = positions[:, i], rotations[:, i]
        if body.parent is not None:
            # R_p^T (x - x_p) and R_p^T R
            to_parent = np.swapaxes(rotations[:, index[body.parent]], -1, -2)
            offset = position - positions[:, index[body.parent]]
            position, rotation = (to_parent @ offset[..., None])[..., 0], to_parent @ rotation
        yield body.name, position, rotation


class Extent(NamedTuple):
    """A box around a posed robot, along the world's axes.

    Attributes:
        low: Its corner with the smallest coordinates [m], shape (3,).
        high: Its opposite corner [m], shape (3,).
    """

    low: Array
    high: Array

    @property
    def radius(self) -> float:
        """Radius of a ball around the robot [m]."""
        return max(float(np.linalg.norm(self.high - self.low)) / 2, 0.05)

    @property
    def middle(self) -> Array:
        """Middle of the box [m], shape (3,)."""
        return (self.low + self.high) / 2


def extent(robot: Robot, positions: Array, rotations: Array) -> Extent:
    """Return the box around a robot's shapes and body origins.

    Args:
        robot: The robot.
        positions: Of the bodies in the world, in the robot's order [m], shape (n_bodies, 3).
        rotations: Body to world, shape (n_bodies, 3, 3).
    """
    low, high = positions.min(0), positions.max(0)
    shapes = shapes_of(robot)
    for body, position, rotation in zip(robot.bodies, positions, rotations, strict=True):
        for shape in shapes[body.name]:
            to_world = rotation @ np.array(shape.placement.rotation)
            corners = position + rotation @ np.array(shape.placement.position) + _corners(shape, to_world)
            low, high = np.minimum(low, corners.min(0)), np.maximum(high, corners.max(0))
    return Extent(low, high)


def _corners(shape: Shape | Triangles, rotation: Array) -> Array:
    """Return points of a shape against its middle with the shape's extreme coordinates [m], shape (n, 3)."""
    if isinstance(shape, Triangles):
        return shape.vertices @ rotation.T
    radius = shape.size[0]
    if shape.type == "sphere":
        return np.array([[-radius] * 3, [radius] * 3])
    if shape.type == "box":
        half = np.array(shape.size) / 2
    else:
        half = np.array([radius, radius, shape.size[1] / 2 + (radius if shape.type == "capsule" else 0.0)])
    reach = np.abs(rotation) @ half
    return np.array([-reach, reach])


def placed_scans(scans: Sequence[Mapping[str, Any]], robot: Robot, root: str) -> list[dict[str, Any]]:
    """Return scans (see `Rollout.scan`) with the scene path of their link as `path`.

    Raises:
        ViewerError: The robot does not have a link of that name.
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
        robot: The robot; without meshes and shapes it is drawn as a stick figure.
        root: Scene path of the whole robot.
        tint: Colour of everything, in place of the shapes' own.
        opacity: Factor on the opacity of everything, 0..1.
        triangles: Most triangles of all meshes together.
    """
    paths, shapes, inside = body_paths(robot, root), shapes_of(robot, triangles), belt_parts(robot)
    for name, disc in rotor_discs(robot).items():
        inside.setdefault(name, []).append(Part(disc, ()))
    for body in robot.bodies:
        for index, shape in enumerate(shapes[body.name]):
            color = tint or shape.color
            path = f"{paths[body.name]}/{body.kind}_{index}"
            yield shape_command(path, shape, color, opacity * shape.color[3])
            if body.kind == "rotor" and isinstance(shape, Shape) and shape.type == "cylinder":
                yield _spoke_command(f"{path}_spoke", shape, color, opacity)
        if body.name in inside:
            path = f"{paths[body.name]}/inside"
            for index, part in enumerate(inside[body.name]):
                yield from _part_commands(f"{path}/part_{index}", part, robot, paths, tint or part.shape.color, opacity)
            yield three.set_property(path, "visible", False)


def mark_commands(robot: Robot, root: str, marks: Mapping[str, Sequence[Shape]]) -> Iterator[Command]:
    """Draw further shapes on bodies, given by name of the body."""
    paths = body_paths(robot, root)
    for name, shapes in marks.items():
        for index, shape in enumerate(shapes):
            yield shape_command(f"{paths[name]}/mark_{index}", shape, shape.color[:3], shape.color[3])


def _part_commands(
    path: str, part: Part, robot: Robot, paths: dict[str, str], color: Color, opacity: float
) -> Iterator[Command]:
    """Draw a rotor, pulley or strand, visible through transparent links."""
    command = shape_command(path, part.shape, color, opacity)
    if part.links:  # belts.js moves the part
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
    """Return the data from which belts.js computes a joint's angle."""
    rest = three.quaternions(np.array(body.placement.rotation)).tolist()
    return {"path": path, "rest": rest, "axis": list(body.joint.axis), "sign": sign}


def shape_command(path: str, shape: Shape | Triangles, color: Color, opacity: float) -> Command:
    """Draw a shape in the frame of a path."""
    matrix = _matrix(shape.placement)
    if isinstance(shape, Triangles):
        return three.mesh(path, three.triangles(shape.vertices, shape.faces), color, matrix, opacity=opacity, flat=True)
    if shape.type in ("cylinder", "capsule"):
        matrix = matrix @ three.Y_TO_Z
    return three.mesh(path, _GEOMETRIES[shape.type](*shape.size), color, matrix, opacity=opacity)


def _spoke_command(path: str, shape: Shape, color: Color, opacity: float) -> Command:
    """Draw a bar across both faces of a rotor's disc, which makes its spin visible."""
    radius, length = shape.size
    bar = three.box(1.7 * radius, 0.3 * radius, 1.04 * length)
    contrast = DARK if sum(color[:3]) > 1.5 else LIGHT
    return three.mesh(path, bar, contrast, _matrix(shape.placement), opacity=opacity)


def _matrix(placement: Placement) -> Array:
    return three.transform(placement.position, placement.rotation)
