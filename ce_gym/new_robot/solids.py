"""The shapes of a robot's links as points, and the standing pose that `new` places them in."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.dynamics.standing import Standing, standing_pose
from ce_gym.model.description import Pose, Robot, Shape
from ce_gym.model.formats.contact_shapes import spheres_of
from ce_gym.model.frames import Placement
from ce_gym.viewer.meshes.triangles import Triangles, read_meshes
from ce_gym.viewer.meshes.visuals import LinkShape, Tag, link_shapes

Floats = NDArray[np.float64]

RIM = 16
"""Points on each rim of a cylinder."""


@dataclass(frozen=True, eq=False)
class Solid:
    """A shape of a link: all points within a radius of the convex hull of some points.

    Attributes:
        link: Name of the link.
        kind: "box", "cylinder", "capsule", "sphere" or "mesh".
        points: In the frame of the body that carries the link [m], shape (n, 3).
        radius: Radius [m].
    """

    link: str
    kind: str
    points: Floats
    radius: float = 0.0


class Solids:
    """The shapes of a robot by body: collision shapes where a set of links has some, otherwise visual shapes.

    Args:
        robot: A robot that was read from a file.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._solids: dict[LinkShape, Solid | None] = {}

    def of_body(self, body: str, links: Iterable[str] | None = None) -> tuple[list[Solid], Tag]:
        """Return the shapes of a body and their kind; no shapes if the file has none.

        Args:
            body: Name of the body.
            links: Links of the body to which shapes are restricted; None for all.
        """
        tag: Tag
        for tag in ("collision", "visual"):
            shapes = [shape for shape in link_shapes(self._robot, tag) if shape.body == body]
            if links is not None:
                shapes = [shape for shape in shapes if shape.link in links]
            solids = [solid for shape in shapes if (solid := self._solid(shape))]
            if solids:
                return solids, tag
        return [], "visual"

    def _solid(self, shape: LinkShape) -> Solid | None:
        if shape not in self._solids:
            items = read_meshes([shape.item])
            self._solids[shape] = solid_of(shape.link, items[0]) if items else None
        return self._solids[shape]


def solid_of(link: str, item: Shape | Triangles) -> Solid:
    """Return a primitive or mesh, given in the frame of its body, as a solid."""
    if isinstance(item, Triangles):
        return Solid(link, "mesh", _placed(item.placement, item.vertices))
    spheres = list(spheres_of(item.type, item.size, rim=RIM))
    return Solid(
        link, item.type, _placed(item.placement, np.array([centre for _, centre, _ in spheres])), spheres[0][2]
    )


def _placed(placement: Placement, points: Floats) -> Floats:
    return points @ np.array(placement.rotation).T + np.array(placement.position)


def extremes(solids: Iterable[Solid], rotation: Floats) -> tuple[Floats, Floats]:
    """Return the smallest and largest coordinates of solids after a rotation [m], shape (3,) each."""
    turned = [(solid.points @ rotation.T, solid.radius) for solid in solids]
    low = np.min([points.min(0) - radius for points, radius in turned], axis=0)
    return low, np.max([points.max(0) + radius for points, radius in turned], axis=0)


def place(robot: Robot, angles: dict[str, float]) -> Standing:
    """Place the bodies of a robot at joint angles [rad or m], whatever their limits, with the base at the origin.

    Raises:
        RobotError: Closed loops cannot be assembled, or the robot is impossible.
    """
    bodies = tuple(replace(body, joint=replace(body.joint, position=(-np.inf, np.inf))) for body in robot.bodies)
    pose = Pose(0.0, tuple(angles.items()), robot.pose.balls)
    return standing_pose(Model(replace(robot, bodies=bodies, contacts=(), pose=pose)).mechanism)
