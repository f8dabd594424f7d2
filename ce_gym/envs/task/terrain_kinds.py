"""Kinds of ground: heights of the places of square tiles, each about a platform that a robot starts on."""

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
    """All places of a field.

    Attributes:
        size: Side of a tile [m].
        difficulty: Of the tile of each place, from 0 to 1.
        side: 1 where that is a pyramid, -1 where it is a pit.
        x, y: Where the place is from the middle of its tile [m].
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
        """How far a place is inside of the rim, at most as far as the platform [m]."""
        return np.maximum(self.size / 2 - BORDER - np.maximum(self.from_middle, PLATFORM), 0.0)

    @property
    def course(self) -> NDArray:
        """Whether a place is between platform and rim."""
        return (self.from_middle > PLATFORM) & (self.from_middle < self.size / 2 - BORDER)


Figures = Mapping[str, Any]


def _flat(tiles: Tiles, figures: Figures) -> NDArray:
    return np.zeros_like(tiles.difficulty)


def _slope(tiles: Tiles, figures: Figures) -> NDArray:
    return tiles.side * np.tan(figures["angle"] * tiles.difficulty) * tiles.run


def _rough(tiles: Tiles, figures: Figures) -> NDArray:
    draw = np.random.default_rng(figures["seed"]).uniform(-1.0, 1.0, tiles.difficulty.shape)
    return figures["amplitude"] * tiles.difficulty * draw


def _stairs(tiles: Tiles, figures: Figures) -> NDArray:
    return tiles.side * figures["rise"] * tiles.difficulty * np.ceil(tiles.run / figures["tread"] - 1e-9)


def _boxes(tiles: Tiles, figures: Figures) -> NDArray:
    """Squares side by side, each of a random height."""
    row, column = (np.floor(along / figures["side"] + 1e-9).astype(int) for along in (tiles.x, tiles.y))
    count = math.ceil(tiles.size / figures["side"]) + 2
    heights = np.random.default_rng(figures["seed"]).uniform(-1.0, 1.0, (count, count))
    return figures["height"] * tiles.difficulty * tiles.course * heights[row % count, column % count]


def _gaps(tiles: Tiles, figures: Figures) -> NDArray:
    """Trenches around the platform, one after each stretch of land; wider, not deeper, where it is difficult."""
    gap = figures["gap"] * tiles.difficulty
    along = np.mod(tiles.from_middle - PLATFORM, figures["land"] + gap)
    return np.where(tiles.course & (along > figures["land"]), -figures["depth"], 0.0)


def _stones(tiles: Tiles, figures: Figures) -> NDArray:
    """Squares to step on with gaps between, along x and along y."""
    gap = figures["gap"] * tiles.difficulty
    between = [np.mod(along, figures["stone"] + gap) > figures["stone"] for along in (tiles.x, tiles.y)]
    return np.where(tiles.course & (between[0] | between[1]), -figures["depth"], 0.0)


KINDS: dict[str, Callable[[Tiles, Figures], NDArray]] = {
    "flat": _flat,
    "slope": _slope,
    "rough": _rough,
    "stairs": _stairs,
    "boxes": _boxes,
    "gaps": _gaps,
    "stones": _stones,
}
"""Heights of all places of a field by kind; the lowest level of each is flat."""
