"""Guessed contacts: spheres, soles and wheels for feet, boxes for the trunk, each with its basis in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ce_gym.dynamics.standing import Standing
from ce_gym.model.description import ContactSphere, Robot
from ce_gym.model.formats.contact_shapes import rims_of, spheres_of
from ce_gym.model.formats.placement import compose, rotation_from_rpy, vec3
from ce_gym.model.frames import Placement, Vec3
from ce_gym.new_robot.legs import Foot
from ce_gym.new_robot.solids import Floats, Solid, Solids, extremes

SOLE_BANDS = (0.002, 0.01)
"""Points of a foot up to this height above its lowest point belong to the sole: the second for uneven soles [m]."""
EVEN = 0.6
"""A sole is uneven if the first band has less than this share of the length or width of the second."""
SMALL = 0.15
"""A foot is a ball if its sole is smaller than this share of the leg's length."""
ROUND = 0.1
"""A turning foot is a wheel if its middle is off its axis by less than this share of its radius."""
TRUNK_RADIUS = 0.05
"""Radius of the sphere of a trunk without shapes [m]."""


@dataclass(frozen=True)
class GuessedContact:
    """A contact as an entry of a YAML file.

    Attributes:
        name: Name of the contact.
        body: Body that carries the contact.
        group: "foot" or "torso".
        kind: "sphere", "box" or "cylinder" (a wheel).
        position: In the frame of the body [m].
        radius: Of a sphere [m].
        size: Of a box or a cylinder, as in `Shape` [m].
        rpy: Angles of a cylinder [rad].
        basis: Basis of the guess in words.
        reliable: Whether a shape of the file is the basis.
    """

    name: str
    body: str
    group: str
    kind: str
    position: Vec3
    radius: float = 0.0
    size: tuple[float, ...] = ()
    rpy: Vec3 = (0.0, 0.0, 0.0)
    basis: str = ""
    reliable: bool = True

    def spheres(self) -> list[ContactSphere]:
        """Return the contact spheres that the reader of YAML files makes of this entry."""
        if self.kind == "sphere":
            return [ContactSphere(self.name, self.body, self.position, self.radius, self.group)]
        pose = Placement(self.position, rotation_from_rpy(*self.rpy))
        parts = rims_of(self.size) if self.kind == "cylinder" else list(spheres_of(self.kind, self.size))
        spheres = []
        for suffix, centre, radius in parts:
            at = compose(pose, Placement(vec3(centre))).position
            spheres.append(ContactSphere(f"{self.name}{suffix}", self.body, at, radius, self.group))
        if self.kind == "box":
            return spheres
        axis = vec3(np.array(pose.rotation)[:, 2])
        return [replace(sphere, rim=self.size[0], axis=axis) for sphere in spheres]


def is_wheel(robot: Robot, foot: Foot, solids: Solids, standing: Standing) -> bool:
    """Whether a foot is a round body that turns without limit about a horizontal axis through its middle."""
    joint = robot.body(foot.body).joint
    if joint.type != "revolute" or joint.position[1] - joint.position[0] < 2 * np.pi:
        return False
    axis = np.array(joint.axis)
    if abs((standing.R[foot.body] @ axis)[2]) > 0.5:
        return False
    shapes, _ = _shapes(foot, solids)
    if not shapes:
        return False
    middle, radius, _ = _round_about(axis, shapes)
    return bool(np.linalg.norm(middle - axis * (axis @ middle)) < ROUND * radius)


def _shapes(foot: Foot, solids: Solids) -> tuple[list[Solid], str]:
    """Return the shapes of the links that are named like a foot, else of the whole body, and their kind in words."""
    if foot.links:
        shapes, tag = solids.of_body(foot.body, foot.links)
        if shapes:
            return shapes, f"{tag} {' and '.join(dict.fromkeys(shape.kind for shape in shapes))} of {shapes[0].link!r}"
    shapes, tag = solids.of_body(foot.body)
    kinds = " and ".join(dict.fromkeys(shape.kind for shape in shapes))
    return shapes, f"{tag} {kinds} of {foot.body!r}"


def _round_about(axis: Floats, shapes: Sequence[Solid]) -> tuple[Floats, float, float]:
    """Return centre (3,), radius and width [m] of the cylinder about an axis' direction around shapes."""
    across = np.linalg.svd(axis[None])[2][1:]
    low, high = extremes(shapes, np.vstack([across, axis]))
    middle = (low + high) / 2
    return np.vstack([across, axis]).T @ middle, float((high - low)[:2].max() / 2), float((high - low)[2])


def foot_contacts(robot: Robot, foot: Foot, solids: Solids, standing: Standing, wheel: bool) -> list[GuessedContact]:
    """Return the contacts of a foot in the standing pose.

    Args:
        robot: The robot.
        foot: The foot.
        solids: The robot's shapes.
        standing: The standing pose.
        wheel: Whether the foot is a wheel.
    """
    shapes, basis = _shapes(foot, solids)
    name, leg_length = foot.frame or foot.body, np.linalg.norm(standing.p[foot.body] - standing.p[foot.limb])
    if wheel:
        axis = np.array(robot.body(foot.body).joint.axis)
        axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
        middle, radius, width = _round_about(axis, shapes)
        rpy = (0.0, float(np.arctan2(np.hypot(axis[0], axis[1]), axis[2])), float(np.arctan2(axis[1], axis[0])))
        size = (round(radius, 5), round(width, 5))
        text = f"a wheel: the {basis} around the axis of its joint, which has no stops"
        return [GuessedContact(name, foot.body, "foot", "cylinder", rounded(middle), 0.0, size, rounded(rpy), text)]
    if not shapes:
        at, text = _without_shapes(robot, foot, standing)
        return [GuessedContact(name, foot.body, "foot", "sphere", rounded(at), 0.0, (), basis=text, reliable=False)]
    corners = sole(shapes, standing.R[foot.body])
    span = np.ptp(corners @ standing.R[foot.body][:2].T, axis=0).max()
    if span < SMALL * leg_length:
        centre, radius = ball(shapes, standing.R[foot.body])
        text = f"the lowest part of the {basis}"
        return [GuessedContact(name, foot.body, "foot", "sphere", rounded(centre), round(radius, 5), basis=text)]
    text = f"corners of the sole of the {basis}"
    return [
        GuessedContact(f"{name}_{i + 1}", foot.body, "foot", "sphere", rounded(corner), basis=text)
        for i, corner in enumerate(corners)
    ]


def _without_shapes(robot: Robot, foot: Foot, standing: Standing) -> tuple[Floats, str]:
    """Return the place of a foot without shapes: the origin of its frame; without a frame, the centre of mass."""
    frames = {frame.name: np.array(frame.placement.position) for frame in robot.frames if frame.body == foot.body}
    if foot.frame in frames:
        return frames[foot.frame], f"no readable shape: the origin of frame {foot.frame!r}"
    if frames:
        heights = {name: float((standing.R[foot.body] @ at)[2]) for name, at in frames.items()}
        lowest = min(heights, key=heights.__getitem__)
        return frames[lowest], f"no readable shape: the origin of frame {lowest!r}, the lowest of this link"
    return np.array(robot.body(foot.body).inertial.com), "no readable shape, no frame: the link's centre of mass"


def sole(shapes: Sequence[Solid], rotation: Floats) -> Floats:
    """Return up to four outermost points of the lowest part of a foot, in its frame, shape (n, 3) [m].

    Args:
        shapes: The shapes of the foot.
        rotation: Foot to world, shape (3, 3).
    """
    points = np.concatenate([shape.points - shape.radius * rotation[2] for shape in shapes])
    height = points @ rotation[2]
    bands = [points[height <= height.min() + band] for band in SOLE_BANDS]
    spans = [np.ptp(band @ rotation[:2].T, axis=0) for band in bands]
    even = (spans[0] >= EVEN * spans[1]).all()
    low, span = bands[0 if even else 1], spans[0 if even else 1].clip(1e-6)
    flat = low @ rotation[:2].T
    middle = (flat.max(0) + flat.min(0)) / 2
    outermost = [int(np.argmax((flat - middle) / span @ d)) for d in ([1, 1], [1, -1], [-1, 1], [-1, -1])]
    corners = low[list(dict.fromkeys(outermost))]
    apart = [i for i, corner in enumerate(corners) if (np.linalg.norm(corners[:i] - corner, axis=1) > 0.005).all()]
    return corners[apart]


def ball(shapes: Sequence[Solid], rotation: Floats) -> tuple[Floats, float]:
    """Return centre [m] and radius [m] of a ball in place of a small foot.

    That is the lowest sphere or capsule's end of the file. For other shapes, the ball touches the lowest points, and is
    as long as the lowest part of the foot.

    Args:
        shapes: The shapes of the foot.
        rotation: Foot to world, shape (3, 3).
    """
    heights = [float((shape.points @ rotation[2]).min()) - shape.radius for shape in shapes]
    lowest = shapes[int(np.argmin(heights))]
    if lowest.radius:
        return lowest.points[int(np.argmin(lowest.points @ rotation[2]))], lowest.radius
    points = lowest.points @ rotation.T
    low = points[points[:, 2] <= points[:, 2].min() + SOLE_BANDS[1]]
    radius = float(np.ptp(low[:, 0])) / 2
    middle = (low.max(0) + low.min(0)) / 2
    return np.array([middle[0], middle[1], points[:, 2].min() + radius]) @ rotation, radius


def trunk_contacts(robot: Robot, trunk: Sequence[str], solids: Solids) -> Iterator[GuessedContact]:
    """Iterate over a box around the shapes of each body of the trunk, in its own axes."""
    for i, body in enumerate(trunk):
        shapes, tag = solids.of_body(body)
        name = "torso" if i == 0 else f"torso_{i + 1}"
        if not shapes:
            if i == 0:
                text = "no readable shape: a sphere at the centre of mass"
                at = rounded(np.array(robot.body(body).inertial.com))
                yield GuessedContact(name, body, "torso", "sphere", at, TRUNK_RADIUS, basis=text, reliable=False)
            continue
        low, high = extremes(shapes, np.eye(3))
        size = tuple(round(float(x), 4) for x in high - low)
        links = list(dict.fromkeys(shape.link for shape in shapes))
        more = f" and {len(links) - 3} more" if len(links) > 3 else ""
        text = f"the box around the {tag} shapes of {', '.join(links[:3])}{more}"
        yield GuessedContact(name, body, "torso", "box", rounded((low + high) / 2), 0.0, size, basis=text)


def rounded(x: Sequence[float] | Floats) -> Vec3:
    """Return three numbers, rounded to a micrometre or microradian."""
    a, b, c = (round(float(value), 6) + 0.0 for value in x)
    return (a, b, c)
