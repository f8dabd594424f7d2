"""`play`: policies shown as ghosts on several levels, or as many robots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from stander import write_small

from ce_gym.__main__ import main
from ce_gym.viewer import Rollout


def test_play_shows_levels_as_ghosts_of_the_same_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("meshcat")
    monkeypatch.chdir(tmp_path)
    write_small(tmp_path / "stander" / "policy.npz")
    command = ["play", "stander", "--transmission", "exact", "armature", "--command", "0.4", "0.5", "0", "0"]
    assert main([*command, "--save", "kept"]) == 0
    assert capsys.readouterr().out.split() == ["kept/stander_exact.npz", "kept/stander_armature.npz", "stander.html"]
    exact, armature = (Rollout.load(f"kept/stander_{level}.npz") for level in ("exact", "armature"))
    assert (exact.transmission, armature.transmission) == ("exact", "armature")
    assert (exact.label, armature.label) == ("exact", "armature")
    np.testing.assert_array_equal(exact.q[0], armature.q[0])
    assert not np.array_equal(exact.q[-1], armature.q[-1])
    assert len(exact) == 20
    assert np.abs(exact.torques[1:]).max() > 0
    text = Path("stander.html").read_text(encoding="utf-8")
    assert '"ghost": true' in text
    assert ">armature</label>" in text


def test_play_shows_many_robots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("meshcat")
    monkeypatch.chdir(tmp_path)
    write_small(tmp_path / "stander" / "policy.npz")
    assert main(["play", "stander", "--robots", "9", "--seed", "3", "--command", "0.1", "0", "0", "0"]) == 0
    text = Path("stander.html").read_text(encoding="utf-8")
    assert ">seed 3</label>" in text
    assert ">and 5 more</label>" in text


def test_play_refuses_robots_and_levels_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write_small(tmp_path / "policy.npz")
    assert main(["play", str(file), "--robots", "2", "--transmission", "exact", "none"]) == 2
    assert "--robots 2: expected 1, or one level" in capsys.readouterr().err


def test_unknown_environment_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["play", str(write_small(tmp_path / "policy.npz", env="CartPole-v1"))]) == 2
    error = capsys.readouterr().err
    assert "environment 'CartPole-v1'; expected one of this package's" in error
    assert error.count("\n") == 1


def test_a_missing_meshcat_is_told_before_anything_is_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setattr("ce_gym.viewer.rollouts.driving.drive_many", lambda *_, **__: pytest.fail("simulated"))
    assert main(["play", str(write_small(tmp_path / "policy.npz"))]) == 2
    assert "needs meshcat" in capsys.readouterr().err
