"""Intersections of rays with a height field, for pictures."""

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
    """The ground about one block."""

    scene: Any  # around the middle of the block
    middle: Array  # of the block [m], shape (2,)
    slopes: Floats  # of the surface at the vertices, shape (n, 2)
    triangles: NDArray[np.int32]
    reach: float  # how far it goes to every side of the block [m]
    lowest: float  # [m]


class Met(NamedTuple):
    """Where rays meet the ground.

    Attributes:
        distance: [m], infinite where they do not, shape (n,).
        normals: Shape (n, 3).
        away: How far that is from the middle, as a share of how far the ground is drawn, shape (n,).
    """

    distance: Floats
    normals: Floats
    away: Floats


class Field:
    """Ground that is not flat, of which only what is around a place is built.

    The mesh depends on the block of the world around that place only, not on earlier calls.

    Args:
        embree: Sends rays.
        terrain: The whole field.
    """

    def __init__(self, embree: Embree, terrain: Terrain) -> None:
        self._embree, self.terrain = embree, terrain
        self._built: tuple[tuple[int, int], _Piece] | None = None

    def lowest(self, place: ArrayLike) -> float:
        """Return a height that nothing around a place (x, y) [m] is below [m]."""
        return self._around(place).lowest

    def meet(self, centre: ArrayLike, start: ArrayLike, rays: Floats) -> Met:
        """Return where rays meet the ground.

        Args:
            centre: Around which place it is drawn [m], shape (3,).
            start: Of all rays, against the centre [m], shape (3,).
            rays: Unit vectors, shape (n, 3).
        """
        centre, start = np.asarray(centre, float), np.asarray(start, float)
        piece = self._around(centre[:2])
        here = start + centre - [*piece.middle, 0.0]
        found = self._embree.meet(piece.scene, np.broadcast_to(here.astype(np.float32), rays.shape), rays)
        hit = found["primID"] >= 0
        distance = np.where(hit, found["tfar"], np.inf).astype(np.float32)
        u, v = found["u"][hit, None], found["v"][hit, None]
        a, b, c = piece.slopes[piece.triangles[found["primID"][hit]]].swapaxes(0, 1)
        normals = np.tile(np.array([0, 0, 1], np.float32), (len(rays), 1))
        normals[hit, :2] = -((1 - u - v) * a + u * b + v * c)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        spots = start[:2].astype(np.float32) + np.where(hit, distance, 0)[:, None] * rays[:, :2]
        away = (np.linalg.norm(spots, axis=1) / piece.reach).astype(np.float32)
        distance[away > 1] = np.inf
        return Met(distance, normals, away)

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
