"""Tasks on a height map of one's own: from an array, a file or a picture; bad ones are refused in one line."""

from __future__ import annotations

import json
from typing import Any

import gymnasium
import numpy as np
import pytest
from tripod import TRIPOD

import ce_gym
from ce_gym.envs.runtime.batch import kernel_key
from ce_gym.envs.runtime.setup import make_program

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")

CELL = 0.1
HEIGHTS = np.random.default_rng(0).uniform(0.0, 0.05, (60, 40))
"""Six metres along x, four along y."""


def begun(terrain, n: int = 64) -> tuple[np.ndarray, ce_gym.Terrain]:
    """Positions of the base at the start of episodes, and the ground."""
    given = {"robot": TRIPOD, "terrain": terrain, "episode_length": 5, "max_episode_steps": 5}
    envs: Any = gymnasium.make_vec("ce_gym/MiniCheetahVelocity-v0", num_envs=n, **given).unwrapped
    envs.reset(seed=0)
    return envs.state()["q"], envs.batch.program.task.terrain["field"]


@pytest.fixture
def file(tmp_path):
    np.save(tmp_path / "hill.npy", HEIGHTS)
    return str(tmp_path / "hill.npy")


def test_the_middle_of_a_map_is_the_origin_and_it_is_level_beyond(tmp_path):
    """A plane, which the surface meets exactly."""
    x, y = (CELL * (np.arange(n) - (n - 1) / 2) for n in HEIGHTS.shape)
    np.save(tmp_path / "plane.npy", 0.1 * x[:, None] + 0.3 * y[None, :])
    field = ce_gym.Terrain.from_file(tmp_path / "plane.npy", CELL)
    np.testing.assert_allclose(field.at([0.0, 2.0, -2.0], [0.0, 1.0, 1.0])[:, 0], [0.0, 0.5, 0.1], atol=1e-12)
    assert np.abs(field.at([-50.0, 50.0], [0.0, 0.0])[:, 1]).max() < 1e-12


@pytest.mark.parametrize(("depth", "kind"), [(255, np.uint8), (65535, np.uint16)])
def test_a_picture_is_seen_from_above(tmp_path, file, depth, kind):
    image = pytest.importorskip("PIL.Image")
    pixels = np.round(HEIGHTS / 0.05 * depth).astype(kind)
    image.fromarray(pixels.T[::-1].copy()).save(tmp_path / "hill.png")
    shown = ce_gym.Terrain.from_file(tmp_path / "hill.png", CELL, height=0.05)
    expected = ce_gym.Terrain.from_file(file, CELL)
    np.testing.assert_allclose(shown.heights, expected.heights, atol=0.05 / depth)
    assert shown.origin == expected.origin


@pytest.mark.slow
def test_episodes_begin_on_the_map_and_inside_of_it(file):
    q, field = begun({"kind": "map", "file": file, "cell": CELL})
    for along, half in ((q[:, 0], 3.05 - 1.0), (q[:, 1], 2.05 - 1.0)):
        assert 0.9 * half < np.abs(along).max() <= half
    above = q[:, 2] - field.at(q[:, 0], q[:, 1])[:, 0]
    standing = begun({"kind": "map", "field": ce_gym.Terrain(np.zeros((9, 9)), 1.0)})[0][:, 2]
    assert np.abs(above - standing).max() < 0.08, "of the heights around, and of the noise of joints"


@pytest.mark.slow
def test_where_they_begin_can_be_chosen():
    q, _ = begun({"kind": "map", "field": ce_gym.Terrain(HEIGHTS, CELL), "begin": [[1.0, 1.2], [2, 2]]})
    assert q[:, 0].min() >= 1.0
    assert q[:, 0].max() <= 1.2
    np.testing.assert_array_equal(q[:, 1], 2.0)


def test_a_terrain_is_a_map_and_another_one_needs_no_other_kernel():
    programs = [make_program(TRIPOD, "velocity", terrain=ce_gym.Terrain(h, CELL)) for h in (HEIGHTS, 2 * HEIGHTS)]
    assert kernel_key(programs[0]) == kernel_key(programs[1])
    np.testing.assert_array_equal(programs[1].task.terrain["field"].heights, 2 * HEIGHTS)


@pytest.mark.slow
def test_heights_in_any_order_of_memory_are_one_terrain():
    model, ends = ce_gym.Model("mini_cheetah"), []
    for heights in (HEIGHTS, np.asfortranarray(HEIGHTS)):
        sim = ce_gym.Simulator(model, 1, terrain=ce_gym.Terrain(heights, CELL, (-3.0, -2.0)))
        sim.step(model.standing_q[7:], 20)
        ends.append(sim.q.tobytes())
    assert ends[0] == ends[1]


@pytest.mark.parametrize(
    ("terrain", "said"),
    [
        ({}, "either a `field` or a `file`"),
        (
            {"file": "no.npy"},
            r"terrain\['file'\]='no.npy'; expected a file .*, looked for in '/.*' and beside a policy.*copy",
        ),
        ({"file": "/dev/zero"}, r"file'\]='/dev/zero'; expected a file with a height map; copy"),
        ({"file": "text.png"}, "cannot identify image file"),
        ({"file": "text.npy"}, "expected an array of heights"),
        ({"file": "row.npy"}, r"an array \(rows, columns\) of numbers"),
        ({"file": "words.npy"}, "expected an array of heights"),
        ({"file": "huge.npy"}, "expected at most 16777216"),
        ({"file": "hill.npy", "cell": 0}, "cell=0; expected a length above 0 m"),
        ({"file": "hill.npy", "height": "1"}, "height='1'; expected a length"),
        ({"file": "hill.npy", "levels": 3}, r"terrain\['levels'\]=3; expected one of field, file"),
        ({"file": "hill.npy", "begin": [[1, 0], [0, 0]]}, r"two pairs \(low, high\)"),
        ({"file": "hill.npy", "begin": [[90, 99], [0, 0]]}, r"begin'\].*; expected x within the map"),
        ({"file": "hill.npy", "begin": []}, r"two pairs \(low, high\)"),
        ({"file": "hill.npy", "begin": [[0, [1]], [0, 0]]}, r"two pairs \(low, high\)"),
        ({"field": [[0.0]]}, "expected a Terrain"),
        ({"field": ce_gym.Terrain.flat(), "cell": 1.0}, "`cell` and `height` with a `file` only"),
    ],
)
def test_what_is_no_map_is_refused_in_one_line(tmp_path, monkeypatch, terrain, said):
    monkeypatch.chdir(tmp_path)
    for name in ("text.png", "text.npy"):
        (tmp_path / name).write_text("not a map")
    arrays = {"row": HEIGHTS[0], "words": np.array([["a"]], dtype=object), "hill": HEIGHTS}
    for name, array in (arrays | {"huge": np.zeros((1, 2**24 + 1), np.uint8)}).items():
        np.save(tmp_path / f"{name}.npy", array)
    if terrain.get("file") == "text.png":
        pytest.importorskip("PIL")
    with pytest.raises(ValueError, match=said) as caught:
        make_program(TRIPOD, "velocity", terrain={"kind": "map", **terrain})
    assert "\n" not in str(caught.value)


def test_a_map_on_the_command_line(file):
    from ce_gym.policies.arguments import env_argument

    name, value = env_argument(f"terrain={json.dumps({'kind': 'map', 'file': file, 'cell': CELL})}")
    assert make_program(TRIPOD, "velocity", **{name: value}).task.terrain["field"].heights.shape == (62, 42)
