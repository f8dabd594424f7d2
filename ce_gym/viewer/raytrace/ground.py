"""Intersections of rays with the ground: a plane or a height field."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.sim.terrain import Terrain
from ce_gym.viewer.raytrace.rays import Array, Embree, Floats
from ce_gym.viewer.rollouts.ground_patch import MARGIN, around, reach, surface

BLOCK = 2.0  # edge of the squares of the world that share a piece of the field [m]
MOST = 1 << 15  # heights of a piece


class _Piece(NamedTuple):
    """The ground around one block."""

    scene: Any  # of `Embree.scene`, with the origin in the middle of the block
    middle: Array  # of the block [m], shape (2,)
    slopes: Floats  # of the surface at the vertices, shape (n, 2)
    triangles: NDArray[np.int32]
    reach: float  # distance from the block to the border of the piece [m]
    lowest: float  # smallest height [m]


class GroundHits(NamedTuple):
    """The points where rays hit the ground.

    Attributes:
        distance: [m], infinite without a hit, shape (n,).
        normals: Shape (n, 3).
        away: Distance of the point from the middle over the radius of the drawn ground, shape (n,).
    """

    distance: Floats
    normals: Floats
    away: Floats


class Plane:
    """The plane z = 0, with the interface of `Field`."""

    terrain = None

    def lowest(self, place: ArrayLike) -> float:
        """Return 0."""
        return 0.0

    def meet(self, centre: ArrayLike, start: ArrayLike, rays: Floats) -> GroundHits:
        """Return the hits of rays; see `Field.meet`."""
        down = rays[:, 2] < -1e-3
        distance = np.where(down, np.asarray(start, float)[2] / np.where(down, -rays[:, 2], 1.0), np.inf)
        normals = np.broadcast_to(np.array([0, 0, 1], np.float32), rays.shape)
        return GroundHits(distance.astype(np.float32), normals, np.zeros(len(rays), np.float32))


class Field:
    """A height field, of which only the surroundings of a place are built.

    The mesh depends on the block of the world at that place only, not on earlier calls.

    Args:
        embree: The ray tracer.
        terrain: The whole field.
    """

    def __init__(self, embree: Embree, terrain: Terrain) -> None:
        self._embree, self.terrain = embree, terrain
        self._built: tuple[tuple[int, int], _Piece] | None = None

    def lowest(self, place: ArrayLike) -> float:
        """Return the smallest height around a place (x, y) [m]."""
        return self._around(place).lowest

    def meet(self, centre: ArrayLike, start: ArrayLike, rays: Floats) -> GroundHits:
        """Return the points where rays hit the ground.

        Args:
            centre: Middle of the drawn ground [m], shape (3,).
            start: Start of all rays, relative to the centre [m], shape (3,).
            rays: Unit vectors, shape (n, 3).
        """
        centre, start = np.asarray(centre, float), np.asarray(start, float)
        piece = self._around(centre[:2])
        origin = start + centre - [*piece.middle, 0.0]
        hits = self._embree.meet(piece.scene, np.broadcast_to(origin.astype(np.float32), rays.shape), rays)
        hit = hits["primID"] >= 0
        distance = np.where(hit, hits["tfar"], np.inf).astype(np.float32)
        u, v = hits["u"][hit, None], hits["v"][hit, None]
        a, b, c = piece.slopes[piece.triangles[hits["primID"][hit]]].swapaxes(0, 1)
        normals = np.tile(np.array([0, 0, 1], np.float32), (len(rays), 1))
        normals[hit, :2] = -((1 - u - v) * a + u * b + v * c)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        spots = start[:2].astype(np.float32) + np.where(hit, distance, 0)[:, None] * rays[:, :2]
        away = (np.linalg.norm(spots, axis=1) / piece.reach).astype(np.float32)
        distance[away > 1] = np.inf
        return GroundHits(distance, normals, away)

    def _around(self, place: ArrayLike) -> _Piece:
        row, column = np.floor(np.asarray(place, float) / BLOCK).astype(int).tolist()
        if self._built is None or self._built[0] != (row, column):
            self._built = (row, column), self._build(BLOCK * np.array([row, column]))
        return self._built[1]

    def _build(self, corner: Array) -> _Piece:
        block = corner + [[0.0, 0.0], [BLOCK, BLOCK]]
        ground = around(self.terrain, block, MARGIN, MOST)
        x, y, heights = surface(ground)
        middle = block.mean(0)
        spots = np.meshgrid(x - middle[0], y - middle[1], indexing="ij")
        vertices = np.stack([*spots, heights[..., 0]], -1).reshape(-1, 3)
        a = (np.arange(len(x) - 1)[:, None] * len(y) + np.arange(len(y) - 1)).ravel()
        b = a + len(y)
        triangles = np.stack([a, b, b + 1, a, b + 1, a + 1], -1).reshape(-1, 3).astype(np.int32)
        slopes = heights[..., 1:].reshape(-1, 2).astype(np.float32)
        scene = self._embree.scene(vertices, triangles)
        return _Piece(scene, middle, slopes, triangles, reach(ground, block), float(heights[..., 0].min()))
