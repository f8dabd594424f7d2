"""Primitives that may touch the ground -> contact spheres.

| primitive        | spheres                                              | error on a plane                   |
|------------------|------------------------------------------------------|------------------------------------|
| sphere           | the sphere itself                                    | 0                                  |
| capsule          | one at each end                                      | 0                                  |
| box              | one at each of the eight corners                     | 0                                  |
| cylinder         | evenly on both rims, the first towards x             | up to `1 - cos(pi / n)` radii      |
| rolling cylinder | one on each rim, moving around the rim to the ground | 0, unless it stands on a face      |

A radius rounds the edges of boxes and cylinders without changing their size. Every sphere lies inside its primitive.
Ground that rises between two spheres of a height field has no effect.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

Sphere = tuple[str, NDArray[np.float64], float]
"""Suffix of the name, centre in the frame of the primitive [m], and radius [m]."""

DIAGONALS = np.array(list(product((1.0, -1.0), repeat=3)))
FACES = ("+x", "-x", "+y", "-y", "+z", "-z")
"""Sides of a primitive to which contacts can be restricted."""


def spheres_of(kind: str, size: tuple[float, ...], radius: float = 0.0, rim: int = 8) -> Iterator[Sphere]:
    """Iterate over the spheres of a primitive.

    Args:
        kind: "sphere", "capsule", "box" or "cylinder".
        size: Size as in `Shape`: full edge lengths; radius and length; radius [m].
        radius: Radius of the edges of boxes and cylinders [m].
        rim: Number of spheres on each rim of a cylinder.
    """
    if kind == "sphere":
        yield "", np.zeros(3), size[0]
    elif kind == "capsule":
        for end, side in (("_top", 0.5), ("_bottom", -0.5)):
            yield end, np.array([0.0, 0.0, side * size[1]]), size[0]
    elif kind == "box":
        yield from _numbered("_corner", DIAGONALS * (np.array(size) / 2 - radius), radius)
    elif kind == "cylinder":
        around = np.arange(rim) * (2 * np.pi / rim)
        circle, up = (size[0] - radius) * np.array([np.cos(around), np.sin(around)]), size[1] / 2 - radius
        circle[np.abs(circle) < 1e-12 * size[0]] = 0.0  # right angles
        points = [np.array([*xy, z]) for z in (up, -up) for xy in circle.T]
        yield from _numbered("_rim", np.array(points), radius)
    else:
        raise ValueError(f"{kind!r}; expected sphere, capsule, box or cylinder")


def rims_of(size: tuple[float, ...], radius: float = 0.0) -> list[Sphere]:
    """Return the rims of a rolling cylinder, as spheres at the centres of the rims; arguments as for `spheres_of`."""
    half = size[1] / 2 - radius
    return [*_numbered("_rim", np.array([[0.0, 0.0, half], [0.0, 0.0, -half]]), radius)]


def on_face(spheres: list[Sphere], face: str) -> list[Sphere]:
    """Return the outermost spheres on one side, such as "-z" for a sole; all for ""."""
    if not face:
        return spheres
    axis, sign = "xyz".index(face[1]), -1.0 if face[0] == "-" else 1.0
    reach = [sign * centre[axis] for _, centre, _ in spheres]
    return [sphere for sphere, far in zip(spheres, reach, strict=True) if far > max(reach) - 1e-9]


def points(name: str, places: NDArray[np.float64]) -> Iterator[Sphere]:
    """Iterate over points as numbered spheres of radius 0."""
    return _numbered(name, places, 0.0)


def _numbered(name: str, places: NDArray[np.float64], radius: float) -> Iterator[Sphere]:
    return ((f"{name}{i + 1}", place, radius) for i, place in enumerate(places))
