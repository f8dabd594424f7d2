"""Pieces of ground: they are small, and wherever they are looked at they are the field they were cut from."""

from __future__ import annotations

import base64

import numpy as np
import pytest

from ce_gym import Terrain
from ce_gym.viewer.rollouts import ground_patch as ground

PATH = np.column_stack([np.linspace(-2, 4, 30), np.linspace(0, 3, 30)])


def places(low: float, high: float, count: int = 500) -> np.ndarray:
    return np.random.default_rng(1).uniform(low, high, (2, count))


@pytest.mark.parametrize(
    "terrain",
    [
        Terrain.rough(seed=0, amplitude=0.05, size=40.0),
        Terrain.rough(seed=0, amplitude=0.05, size=2.0),  # ends within the piece
        Terrain.slope(0.3, 0.7),  # goes on for ever
        Terrain.stairs(0.1, 0.3, 5, cell=0.05),
        Terrain.flat(),
    ],
)
def test_a_piece_is_the_field(terrain: Terrain) -> None:
    piece = ground.around(terrain, PATH)
    assert piece.heights.size <= ground.MOST
    far = ground.reach(piece, PATH)
    assert far >= 0.5 * ground.MARGIN
    x, y = PATH[np.random.default_rng(0).integers(0, 30, 500)].T + places(-far, far)
    np.testing.assert_allclose(piece.at(x, y), terrain.at(x, y), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("cell", "length"), [(0.02, 5.0), (0.1, 90.0), (0.01, 60.0)])
def test_a_piece_is_never_large(cell: float, length: float) -> None:
    terrain = Terrain.from_function(lambda x, y: 0.1 * np.sin(x + 0.5 * y), cell, 8.0)
    path = np.array([[0.0, 0.0], [length, 0.4 * length]])
    piece = ground.around(terrain, path)
    assert piece.heights.size <= ground.MOST
    assert ground.reach(piece, path) >= ground.LEAST_MARGIN
    x, y = places(-1.0, 1.0)
    np.testing.assert_allclose(piece.at(x, y)[:, 0], terrain.at(x, y)[:, 0], atol=0.02)


def test_what_the_page_gets_is_the_surface() -> None:
    """Heights halfway between two are their mean, and at one (1, 6, 1)/8 of three: what ground.js computes."""
    piece = ground.around(Terrain.rough(seed=3, amplitude=0.05, size=20.0), PATH)
    told = ground.as_json(piece)
    numbers = np.frombuffer(base64.b64decode(told["heights"]), "<u2").reshape(told["rows"], told["columns"])
    heights = told["low"] + told["step"] * numbers

    def refined(values: np.ndarray) -> np.ndarray:
        result = np.empty((2 * len(values) - 3, values.shape[1]))
        result[::2] = (values[1:] + values[:-1]) / 2
        result[1::2] = (values[:-2] + 6 * values[1:-1] + values[2:]) / 8
        return result

    x, y, surface = ground.surface(piece)
    assert surface.shape == (len(x), len(y), 3)
    np.testing.assert_allclose(refined(refined(heights).T).T, surface[..., 0], atol=told["step"])


def test_the_level_follows_slopes_and_not_stones() -> None:
    slope = Terrain.slope(0.3)
    np.testing.assert_allclose(ground.level(slope, PATH, 0.2), slope.at(*PATH.T)[:, 0], atol=1e-12)
    rough = Terrain.rough(seed=0, amplitude=0.05, size=20.0)
    assert np.std(ground.level(rough, PATH, 0.3)) < 0.5 * np.std(rough.at(*PATH.T)[:, 0])
    np.testing.assert_array_equal(ground.level(None, PATH, 0.3), np.zeros(30))


def test_no_hill_hides_the_robot() -> None:
    target, eye = np.array([0.0, 0.0, 0.3]), np.array([1.0, -1.5, 0.8])
    np.testing.assert_array_equal(ground.clear_view(Terrain.flat(), target, eye, 0.1), eye)
    np.testing.assert_array_equal(ground.clear_view(None, target, eye, 0.1), eye)
    hill = Terrain.from_function(lambda x, y: np.where(y < -0.9, 1.0, 0.0), 0.1, 10.0)
    lifted = ground.clear_view(hill, target, eye, 0.1)
    np.testing.assert_array_equal(lifted[:2], eye[:2])
    share = np.linspace(0.5, 1, 12)[:, None]
    x, y, z = (target + share * (lifted - target)).T
    assert (z - hill.at(x, y)[:, 0]).min() == pytest.approx(0.1)
