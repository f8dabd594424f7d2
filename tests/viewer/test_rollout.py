"""Rollout files: a round trip, and errors of one line."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from hopper import make_rollout

from ce_gym import Terrain
from ce_gym.viewer import Recorder, Rollout, RolloutError

GROUND = {"cell": 0.1, "origin": [0, 0], "low": 0.0, "step": 0.0}
ARRAYS = ("times", "q", "v", "contact_forces", "commands", "torques", "signals")


def test_round_trip(tmp_path: Path) -> None:
    signals = np.arange(100.0).reshape(50, 2)
    more = {"signals": signals, "signal_names": ["a", "b"], "torques": signals[:, :1]}
    rollout = make_rollout(contact_names=["foot"], **more)
    loaded = Rollout.load(rollout.save(tmp_path / "walk.npz"))
    for name in ARRAYS:
        np.testing.assert_allclose(getattr(loaded, name), getattr(rollout, name), rtol=1e-6, err_msg=name)
    for name in ("robot", "transmission", "dt", "label", "info", "contact_names", "signal_names"):
        assert getattr(loaded, name) == getattr(rollout, name)


def test_forces_and_commands_may_be_left_out(tmp_path: Path) -> None:
    path = make_rollout(1000, contact_forces=None, commands=None).save(tmp_path / "walk.rollout")  # keeps its name
    loaded = Rollout.load(path)
    assert loaded.contact_forces.shape == (1000, 0, 3)
    assert loaded.commands.shape == (1000, 0)
    values = sum(getattr(loaded, name).size for name in ARRAYS)
    assert path.stat().st_size < 4 * values + 8 * len(loaded) + 4000


def test_ground_is_kept(tmp_path: Path) -> None:
    ground = Terrain.rough(seed=0, amplitude=0.05, size=4.0)
    path = make_rollout(ground=ground).save(tmp_path / "walk.npz")
    loaded = Rollout.load(path).ground
    assert loaded is not None
    assert (loaded.cell, loaded.origin) == (ground.cell, ground.origin)
    np.testing.assert_allclose(loaded.heights, ground.heights, atol=0.1 / 65535)
    assert (
        path.stat().st_size < make_rollout().save(tmp_path / "flat.npz").stat().st_size + 2 * ground.heights.size + 500
    )


def test_a_recorder_keeps_the_ground_around_the_path() -> None:
    terrain = Terrain.rough(seed=0, amplitude=0.05, size=60.0)
    recorder, path = Recorder("hopper", "exact", 0.1, terrain=terrain), np.linspace([5.0, -3.0], [9.0, -3.0], 20)
    for k, place in enumerate(path):
        recorder.add(0.1 * k, [*place, 0.3, 1, 0, 0, 0], np.zeros(6))
    ground = recorder.rollout().ground
    assert ground is not None
    assert ground.heights.size < 0.3 * terrain.heights.size
    np.testing.assert_allclose(ground.at(*path.T), terrain.at(*path.T), atol=1e-12)


def test_recorder_copies_what_it_is_given() -> None:
    recorder, q = Recorder("hopper", "exact", 0.1, label="a", info={"k": "1"}), np.zeros(2)
    for k in range(3):
        q[:] = k
        recorder.add(0.1 * k, q, q, [[0, 0, k]], [k])
    rollout = recorder.rollout()
    assert len(recorder) == len(rollout) == 3
    np.testing.assert_array_equal(rollout.q[:, 0], [0, 1, 2])
    np.testing.assert_array_equal(rollout.contact_forces[:, 0, 2], [0, 1, 2])
    np.testing.assert_array_equal(rollout.commands[:, 0], [0, 1, 2])
    assert rollout.duration == pytest.approx(0.2)
    assert (rollout.label, rollout.info) == ("a", {"k": "1"})


def test_recorder_refuses_nothing_and_changing_shapes() -> None:
    recorder = Recorder("hopper", "exact", 0.1)
    with pytest.raises(RolloutError, match="nothing was recorded"):
        recorder.rollout()
    recorder.add(0.0, [1, 2], [1])
    recorder.add(0.1, [1, 2, 3], [1])
    with pytest.raises(RolloutError, match="q changes shape"):
        recorder.rollout()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"q": np.zeros((49, 6))}, "q has shape"),
        ({"q": np.zeros(50)}, "q has shape"),
        ({"v": np.full((50, 6), np.nan)}, "v has a number that is not finite in frame 0"),
        ({"contact_forces": np.zeros((50, 1, 2))}, "contact_forces has shape"),
        ({"contact_names": ["a", "b"]}, "contact_names has 2 names; contact_forces has 1 contacts"),
        ({"signals": np.zeros((50, 2)), "signal_names": ["a"]}, "signal_names has 1 names; signals has 2 columns"),
        ({"torques": np.zeros((49, 2))}, "torques has shape"),
        ({"times": np.zeros(50)}, "times does not increase"),
        ({"dt": 0.0}, "dt is 0.0"),
        ({"dt": float("nan")}, "dt is nan"),
        ({"times": np.zeros(0)}, "times is empty"),
    ],
)
def test_bad_values(changes: dict, message: str) -> None:
    with pytest.raises(RolloutError, match=message):
        make_rollout(**changes)


def rewritten(
    path: Path, header: dict | None = None, text: str | None = None, drop: tuple[str, ...] = (), **arrays: np.ndarray
) -> Path:
    """Save a good rollout, then write it again with changes."""
    make_rollout().save(path)
    with np.load(path) as archive:
        content = {name: archive[name] for name in archive.files if name not in drop}
    if header is not None:
        content["header"] = np.array(json.dumps({**json.loads(str(content["header"])), **header}))
    if text is not None:
        content["header"] = np.array(text)
    with path.open("wb") as file:
        np.savez(file, **{**content, **arrays}, allow_pickle=True)
    return path


def damaged(path: Path, frames: int = 500) -> bytearray:
    """The bytes of a good rollout, zeros among its compressed numbers."""
    content = bytearray(make_rollout(frames).save(path).read_bytes())
    middle = len(content) // 2
    content[middle : middle + 64] = bytes(64)
    return content


HEIGHTS = np.zeros((3, 3), np.uint16)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"drop": ("q",)}, "has no q; expected times, q, v"),
        ({"q": np.array([{}], object)}, "cannot be read"),
        ({"drop": ("header",)}, "not a ce_gym rollout; expected an npz with an entry 'header'"),
        ({"header": {"version": 2}}, "version is 2; expected 3"),
        ({"header": {"format": "other"}}, "expected a header"),
        ({"header": {"robot": 3}}, "header key 'robot' is 3; expected str"),
        ({"header": {"dt": "x"}}, "header key 'dt' is 'x'; expected a number"),
        ({"text": "{"}, "expected a header"),
        ({"header": {"ground": {"cell": 0.1}}}, "ground is damaged"),
        ({"header": {"ground": GROUND}, "ground": np.zeros((3, 3))}, "type float64; expected uint16"),
        ({"header": {"ground": GROUND | {"cell": -1}}, "ground": HEIGHTS}, "ground is damaged .cell=-1"),
        ({"q": np.full((50, 6), np.inf)}, "q has a number that is not finite"),
        ({"q": np.array("text")}, "q is not an array of numbers"),
    ],
)
def test_bad_content(tmp_path: Path, changes: dict, message: str) -> None:
    assert_refused(rewritten(tmp_path / "walk.npz", **changes), message)


def test_bad_files(tmp_path: Path) -> None:
    path, array = tmp_path / "walk.npz", io.BytesIO()
    assert_refused(path, "no such file")
    assert_refused(tmp_path, "cannot be read")
    np.save(array, np.zeros(3))
    good = make_rollout().save(path).read_bytes()
    for content in (b"", b"hello", good[: len(good) // 2], damaged(path), array.getvalue()):
        path.write_bytes(content)
        assert_refused(path, "cannot be read")


def assert_refused(path: Path, message: str) -> None:
    with pytest.raises(RolloutError, match=message) as caught:
        Rollout.load(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
