"""Tasks on a height map of one's own: from an array, a file or a picture; bad ones are refused in one line."""

from __future__ import annotations

import json
import random
import warnings
from pathlib import Path
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


PICTURES = [
    ("hill.png", "L"), ("hill.png", "P"), ("hill.png", "RGB"), ("hill.png", "LA"), ("hill.png", "RGBA"),
    ("hill.png", "I;16"), ("hill.tif", "L"), ("hill.tif", "I;16"), ("hill.tif", "I;16B"), ("hill.bmp", "L"),
    ("hill.gif", "P"), ("hill.pgm", "L"), ("hill.pgm", "I;16"), ("hill.ppm", "RGB"), ("hill.jpg", "L"),
    ("hill.webp", "RGB"),
]  # fmt: skip
"""Files of pictures, and kinds of pixels."""


def save_picture(path, kind):
    """Save the heights as a picture; return the value of white."""
    image = pytest.importorskip("PIL.Image")
    white = 65535 if kind.startswith("I") else 255
    pixels = np.round(HEIGHTS / HEIGHTS.max() * white).astype(">u2" if kind == "I;16B" else np.uint16)[:, ::-1].T.copy()
    picture = image.fromarray(pixels if white == 65535 else pixels.astype(np.uint8))
    options = {"lossless": True} if path.suffix == ".webp" else {"quality": 95} if path.suffix == ".jpg" else {}
    (picture if white == 65535 else picture.convert(kind)).save(path, **options)
    return white


@pytest.mark.parametrize(("name", "kind"), PICTURES)
def test_heights_of_every_kind_of_picture(tmp_path, name, kind):
    white = save_picture(tmp_path / name, kind)
    heights = ce_gym.Terrain.from_file(tmp_path / name, CELL, height=HEIGHTS.max()).heights[1:-1, 1:-1]
    error = 8 if name.endswith("jpg") else 1
    np.testing.assert_allclose(heights, HEIGHTS, atol=error * HEIGHTS.max() / white)


@pytest.mark.parametrize("kind", ["f4", "i4"])
def test_pictures_without_white_are_refused(tmp_path, kind):
    image = pytest.importorskip("PIL.Image")
    image.fromarray((1e6 * HEIGHTS).astype(kind)).save(tmp_path / "hill.tif")
    with pytest.raises(ValueError, match=r"hill.tif: pixels of kind .* have no white; expected 1, 8 or 16 bits"):
        ce_gym.Terrain.from_file(tmp_path / "hill.tif", CELL)


def test_damaged_maps_are_maps_or_one_line(tmp_path, file):
    """Bytes of pictures and arrays changed, cut and moved at random."""
    rng = random.Random(0)
    sources = [Path(file)]
    for number, (name, kind) in enumerate(PICTURES):
        sources.append((tmp_path / f"{number}_{name}").absolute())
        save_picture(sources[-1], kind)
    for source in sources * 8:
        data = bytearray(source.read_bytes())
        for _ in range(rng.choice((1, 2, 5, 40))):
            place = rng.randrange(min(len(data), rng.choice((40, 200, 10**6))))
            data[place] = rng.randrange(256)
        damaged = tmp_path / f"damaged{rng.choice([source.suffix, '.npy', '.png'])}"
        damaged.write_bytes(data[: rng.choice((len(data), rng.randrange(len(data))))])
        error, field = "", None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Pillow
            try:
                field = ce_gym.Terrain.from_file(damaged, CELL)
            except ValueError as refusal:
                error = str(refusal)
        assert "\n" not in error
        assert np.isfinite(field.heights).all() if field else "expected" in error


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ce_gym.Terrain.rough(0, 0.1, size=1e300), r"size=1e\+300, cell=0.1 needs inf GiB of memory"),
        (lambda: ce_gym.Terrain.rough(0, 0.1, cell=1e-9), "cell=1e-09 needs .* GiB of memory; expected at most"),
        (lambda: ce_gym.Terrain.rough(0, 1e308), "expected a length from 0 to 10000 m"),
        (lambda: ce_gym.Terrain.rough(-1, 0.1), "seed=-1; expected a whole number, at least 0"),
        (lambda: ce_gym.Terrain.stairs(0.1, 0.3, 10**12), "count=1000000000000 needs"),
        (lambda: ce_gym.Terrain.stairs(0.1, 0.3, 2.5), r"count=2.5; expected a whole number"),
        (lambda: ce_gym.Terrain(np.zeros((3, 3)) + 1j, 1.0), "heights='complex128'; expected an array of real numbers"),
        (lambda: make_program(TRIPOD, "velocity", terrain={"kind": "slope", "levels": 10**400}), "levels"),
        (
            lambda: make_program(TRIPOD, "velocity", terrain={"kind": "slope", "levels": 10**12}),
            "terrain has .* heights",
        ),
        (lambda: make_program(TRIPOD, "velocity", history=10**9), "history=1000000000; expected a whole number"),
        (lambda: ce_gym.Simulator(ce_gym.Model(TRIPOD), 10**30), "num_envs=1000000000000000000000000000000 needs"),
        (lambda: ce_gym.Simulator(ce_gym.Model(TRIPOD), 10**10), "num_envs=10000000000 needs .* GiB of memory"),
    ],
)
def test_sizes_are_estimated_before_memory_is_taken(make, words):
    with pytest.raises(ValueError, match=words):
        make()


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
