"""`play`: policies shown as ghosts on several levels, or as many robots."""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from stander import write_small

import ce_gym
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


@pytest.mark.parametrize(
    ("env", "words"),
    [
        ("CartPole-v1", "environment 'CartPole-v1': "),
        ("test/Nothing-v0", "environment 'test/Nothing-v0': not registered; expected one of this package's"),
        ("trap:test/Nothing-v0", "if you trust it, name it yourself: --env trap:test/Nothing-v0"),
    ],
)
def test_unknown_environments_are_one_line(env, words, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["play", str(write_small(tmp_path / "policy.npz", env=env))]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_environments_of_other_modules_are_inspected_and_play(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command line names the module that registers them; without it the policy's file names no known one."""
    pytest.importorskip("meshcat")
    robot = ce_gym.load_robot("mini_cheetah").source
    (tmp_path / "my_dogs.py").write_text(f"import ce_gym\nce_gym.register_robot({robot!r}, name='my_dog')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    write_small(tmp_path / "dog" / "policy.npz", env="ce_gym/MyDogVelocity-v0")
    try:
        assert main(["play", "dog"]) == 2
        assert "not registered" in capsys.readouterr().err
        named = "my_dogs:ce_gym/MyDogVelocity-v0"
        with monkeypatch.context() as quick:  # the report itself has tests of its own, and takes a minute
            quick.setattr("ce_gym.diagnostics.scene.scene_report", lambda name, **_: str(gymnasium.spec(name).id))
            assert main(["inspect", named]) == 0
        assert capsys.readouterr().out == "ce_gym/MyDogVelocity-v0\n"
        assert main(["play", "dog", "--env", named, "--command", "0.1", "0", "0", "0"]) == 0
        assert Path("dog.html").exists()
    finally:
        sys.modules.pop("my_dogs", None)
        for name in [name for name in gymnasium.registry if "MyDog" in name]:
            del gymnasium.registry[name]


@pytest.mark.parametrize("name", ["no_module:ce_gym/MyDogVelocity-v0", "ce_gym/NoDogVelocity-v0"])
def test_inspect_of_nothing_is_one_line(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", name]) == 2
    error = capsys.readouterr().err
    assert f"environment '{name}'" in error
    assert error.count("\n") == 1


def test_a_missing_meshcat_is_told_before_anything_is_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setattr("ce_gym.viewer.rollouts.driving.drive_many", lambda *_, **__: pytest.fail("simulated"))
    assert main(["play", str(write_small(tmp_path / "policy.npz"))]) == 2
    assert "needs meshcat" in capsys.readouterr().err
