"""Policies that drive robots through commands, and their rollouts on the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from stander import ENV, write_small

import ce_gym
from ce_gym.__main__ import main
from ce_gym.policies import find_policy
from ce_gym.viewer import Rollout, drive
from ce_gym.viewer.rollouts.driving import walk


def test_a_policy_is_run_where_it_was_trained(tmp_path: Path) -> None:
    (rollout,) = walk(write_small(tmp_path / "stander" / "policy.npz", env_kwargs={"transmission": "none"}))
    assert (rollout.robot, rollout.transmission, rollout.label) == ("mini_cheetah", "none", "stander")
    np.testing.assert_allclose(np.unique(rollout.commands[:, 0]), [0.0, 0.5, 0.8, 1.0], rtol=1e-6)
    assert len(rollout) == 850
    assert np.ptp(rollout.q[:, 2]) < 0.2


def test_a_robot_is_told_what_the_script_says() -> None:
    script = [(0.2, (0.0, 0.0, 0.0)), (0.2, (0.7, -0.1, 0.3))]
    rollout = drive(lambda obs: np.zeros((1, 12), np.float32), ENV, script, transmission="armature")
    assert (len(rollout), rollout.transmission) == (20, "armature")
    np.testing.assert_allclose(rollout.commands[[0, 9]], 0.0)
    np.testing.assert_allclose(rollout.commands[[10, 19]], [[0.7, -0.1, 0.3]] * 2, rtol=1e-6)


def test_recording_ends_with_a_fall() -> None:
    rng = np.random.default_rng(0)
    rollout = drive(lambda obs: rng.normal(0, 0.8, (1, 12)).astype(np.float32), ENV, [(20.0, (1.0, 0.0, 0.0))])
    assert 1 < len(rollout) < 1000


def test_view_writes_a_page_of_a_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("meshcat")
    folder = write_small(tmp_path / "stander" / "policy.npz", env_kwargs={"transmission": "none"}).parent
    monkeypatch.chdir(tmp_path)
    assert main(["view", str(folder)]) == 0
    assert capsys.readouterr().out == "stander.html\n"
    assert not list(folder.glob("*.html"))


def test_bytes_that_are_no_policy_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "policy.npz").write_bytes(b"nothing")
    assert main(["view", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_rollouts_are_still_rollouts(tmp_path: Path) -> None:
    q = np.tile(ce_gym.Model("mini_cheetah").standing_q, (3, 1))
    rollout = Rollout(
        "mini_cheetah", "exact", 0.02, 0.02 * np.arange(3), q, np.zeros((3, 18)), np.zeros((3, 0, 3)), np.zeros((3, 3))
    )
    assert len(Rollout.load(rollout.save(tmp_path / "walk.npz"))) == 3
    assert find_policy(tmp_path / "walk.npz") is None
