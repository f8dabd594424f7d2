"""Kinds of terrain: heights of square tiles, each around a platform on which a robot starts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

PLATFORM = 1.0
"""Half the side of the level square in the middle of a tile [m]."""
BORDER = 0.5
"""Width of the level rim of a tile [m]."""


@dataclass(frozen=True)
class Tiles:
    """All grid points of a field; arrays have one entry for each point.

    Attributes:
        size: Side of a tile [m].
        difficulty: Difficulty of the tile, from 0 to 1.
        side: 1 on a pyramid, -1 in a pit.
        x, y: Position relative to the middle of the tile [m].
    """

    size: float
    difficulty: NDArray
    side: NDArray
    x: NDArray
    y: NDArray

    @property
    def from_middle(self) -> NDArray:
        """The larger distance along x or y."""
        return np.maximum(np.abs(self.x), np.abs(self.y))

    @property
    def run(self) -> NDArray:
        """Distance inwards from the rim, at most up to the platform [m]."""
        return np.maximum(self.size / 2 - BORDER - np.maximum(self.from_middle, PLATFORM), 0.0)

    @property
    def course(self) -> NDArray:
        """Whether a point lies between platform and rim."""
        return (self.from_middle > PLATFORM) & (self.from_middle < self.size / 2 - BORDER)


Parameters = Mapping[str, Any]


def _flat(tiles: Tiles, parameters: Parameters) -> NDArray:
    return np.zeros_like(tiles.difficulty)


def _slope(tiles: Tiles, parameters: Parameters) -> NDArray:
    return tiles.side * np.tan(parameters["angle"] * tiles.difficulty) * tiles.run


def _rough(tiles: Tiles, parameters: Parameters) -> NDArray:
    draw = np.random.default_rng(parameters["seed"]).uniform(-1.0, 1.0, tiles.difficulty.shape)
    return parameters["amplitude"] * tiles.difficulty * draw


def _stairs(tiles: Tiles, parameters: Parameters) -> NDArray:
    return tiles.side * parameters["rise"] * tiles.difficulty * np.ceil(tiles.run / parameters["tread"] - 1e-9)


def _boxes(tiles: Tiles, parameters: Parameters) -> NDArray:
    """Squares side by side with random heights."""
    row, column = (np.floor(along / parameters["side"] + 1e-9).astype(int) for along in (tiles.x, tiles.y))
    count = math.ceil(tiles.size / parameters["side"]) + 2
    heights = np.random.default_rng(parameters["seed"]).uniform(-1.0, 1.0, (count, count))
    return parameters["height"] * tiles.difficulty * tiles.course * heights[row % count, column % count]


def _gaps(tiles: Tiles, parameters: Parameters) -> NDArray:
    """Trenches around the platform, one after each stretch of land; their width grows with difficulty."""
    gap = parameters["gap"] * tiles.difficulty
    along = np.mod(tiles.from_middle - PLATFORM, parameters["land"] + gap)
    return np.where(tiles.course & (along > parameters["land"]), -parameters["depth"], 0.0)


def _stones(tiles: Tiles, parameters: Parameters) -> NDArray:
    """Square stepping stones with gaps along x and along y."""
    gap = parameters["gap"] * tiles.difficulty
    in_gap = [np.mod(along, parameters["stone"] + gap) > parameters["stone"] for along in (tiles.x, tiles.y)]
    return np.where(tiles.course & (in_gap[0] | in_gap[1]), -parameters["depth"], 0.0)


KINDS: dict[str, Callable[[Tiles, Parameters], NDArray]] = {
    "flat": _flat,
    "slope": _slope,
    "rough": _rough,
    "stairs": _stairs,
    "boxes": _boxes,
    "gaps": _gaps,
    "stones": _stones,
}
"""Heights of all grid points of a field, by kind; the lowest level of each kind is flat."""
