"""Capsules of links, and pairs of links that may touch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, product

import numpy as np

from ce_gym.model.description import Body, Capsule, Robot, Shape
from ce_gym.model.frames import Vec3


def colliding(robot: Robot, pairs: Sequence[tuple[str, str]]) -> tuple[tuple[Capsule, Capsule], ...]:
    """Return the pairs of capsules of pairs of links, in their order."""
    capsules = ((capsules_of(robot, first), capsules_of(robot, second)) for first, second in pairs)
    return tuple(pair for first, second in capsules for pair in product(first, second))


def capsules_of(robot: Robot, link: str) -> tuple[Capsule, ...]:
    """Return the robot's capsules of a link, or the longest capsule inside one of the link's shapes."""
    named = tuple(capsule for capsule in robot.capsules if capsule.body == link)
    inside = [_inside(link, shape) for shape in robot.body(link).shapes]
    return named or tuple(sorted(inside, key=_length)[-1:])


def separate_links(robot: Robot) -> Iterator[tuple[str, str]]:
    """Iterate over pairs of links with capsules of which neither carries the other."""
    links = [body for body in robot.bodies if body.kind == "link" and capsules_of(robot, body.name)]
    for first, second in combinations(links, 2):
        if not adjacent(first, second):
            yield first.name, second.name


def adjacent(first: Body, second: Body) -> bool:
    """Whether two links are the same or one carries the other."""
    return first.name in (second.name, second.parent) or second.name == first.parent


def _inside(link: str, shape: Shape) -> Capsule:
    """Return the largest capsule inside a shape, along the longest edge of a box."""
    axis, half, radius = 2, 0.0, shape.size[0]
    if shape.type == "capsule":
        half = shape.size[1] / 2
    elif shape.type == "cylinder":
        radius = min(radius, shape.size[1] / 2)
        half = shape.size[1] / 2 - radius
    elif shape.type == "box":
        axis, radius = int(np.argmax(shape.size)), min(shape.size) / 2
        half = max(shape.size) / 2 - radius
    reach = half * np.array(shape.placement.rotation)[:, axis]
    start, end = (_tuple(np.array(shape.placement.position) + side * reach) for side in (-1.0, 1.0))
    return Capsule(link, start, end, radius)


def _length(capsule: Capsule) -> float:
    return float(np.linalg.norm(np.subtract(capsule.end, capsule.start))) + 2 * capsule.radius


def _tuple(x: np.ndarray) -> Vec3:
    return (float(x[0]), float(x[1]), float(x[2]))
