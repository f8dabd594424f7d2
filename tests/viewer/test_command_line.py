"""`view` and `play` with the real robot: rollouts and policies become pages."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.request
import webbrowser
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from stander import write_small

import ce_gym
from ce_gym import Terrain
from ce_gym.__main__ import main
from ce_gym.dynamics import Model
from ce_gym.viewer import Rollout
from ce_gym.viewer.rollouts.ground_patch import MOST, around

pytest.importorskip("meshcat")

ROBOT = "mini_cheetah"


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seconds of a robot that stands; its legs move a little, so that all tracks are written."""
    model = Model(ROBOT)
    times = 0.02 * np.arange(1000)
    q = np.tile(model.standing_q, (1000, 1))
    q[:, 7:] += 0.1 * np.sin(times)[:, None]
    q[:, 0] = 0.3 * times
    forces = np.random.default_rng(0).normal(0, 20, (1000, len(model.contact_names), 3))
    torques = np.sin(times)[:, None] * np.ones(len(model.joint_links))
    rollout = Rollout(ROBOT, "exact", 0.02, times, q, np.zeros((1000, model.nv)), forces, np.ones((1000, 3)), torques)
    return rollout.save(tmp_path_factory.mktemp("rollout") / "stand.npz")


@pytest.fixture
def stander(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a policy, in the present folder."""
    monkeypatch.chdir(tmp_path)
    return write_small(tmp_path / "stander" / "policy.npz", env_kwargs={"transmission": "none"}).parent


def test_view_writes_beside_the_rollout_or_where_it_is_told(
    standing: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", str(standing)]) == 0
    path, target = standing.with_suffix(".html"), tmp_path / "two.html"
    assert capsys.readouterr().out == f"{path}\n"
    assert path.stat().st_size < 6e6
    assert main(["view", str(standing), str(standing), "--overlay", "--title", "Twins", "--html", str(target)]) == 0
    assert "<title>Twins</title>" in target.read_text(encoding="utf-8")
    assert target.stat().st_size < 6e6


def test_ground_and_a_ghost_are_small(standing: Path, tmp_path: Path) -> None:
    """Random heights along the whole path, nearly as many as are kept."""
    rollout = Rollout.load(standing)
    rough = around(Terrain.rough(seed=0, amplitude=0.05, cell=0.05, size=40.0), rollout.q[:, :2])
    assert rough.heights.size > 0.7 * MOST
    twins = [replace(rollout, ground=rough).save(tmp_path / f"{name}.npz") for name in ("one", "two")]
    target = tmp_path / "two.html"
    assert main(["view", *map(str, twins), "--overlay", "--html", str(target)]) == 0
    assert target.stat().st_size < 6e6
    assert twins[0].stat().st_size < standing.stat().st_size + 2 * MOST + 1000


@pytest.mark.parametrize(("display", "asked", "opened"), [("", True, 0), (":0", True, 1), (":0", False, 0)])
@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="a display is always there")
def test_browser_opens_only_if_asked_and_possible(
    standing: Path, monkeypatch: pytest.MonkeyPatch, display: str, asked: bool, opened: int
) -> None:
    calls: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda url, new: calls.append(url))
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert main(["view", str(standing), "--open" if asked else "--no-open"]) == 0
    assert [url.startswith("file://") for url in calls] == [True] * opened


@pytest.mark.slow
def test_list_and_inspect_name_the_robot(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    text = capsys.readouterr().out
    assert all(word in text for word in ("list", "inspect", "view", "play", "bench"))
    assert main(["list"]) == 0
    listed = capsys.readouterr().out.split()
    assert {ROBOT, "ce_gym/MiniCheetahVelocity-v0", "mini_cheetah_velocity_exact"} <= set(listed)
    assert main(["inspect", ROBOT]) == 0
    assert "FL_knee_rotor" in capsys.readouterr().out
    assert main(["bench", "--help"]) == 0
    assert "ce_gym.bench" in capsys.readouterr().out


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT to send")
def test_live_ends_with_ctrl_c_and_leaves_nothing(standing: Path) -> None:
    command = [sys.executable, "-m", "ce_gym", "view", str(standing), "--live"]
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a test run in the background ignores Ctrl-C
    options = {"stdout": subprocess.PIPE, "text": True, "start_new_session": True, "preexec_fn": heed}
    with subprocess.Popen(command, **options) as process:
        guard = threading.Timer(60, process.kill)
        guard.daemon = True
        guard.start()
        assert process.stdout is not None
        url = process.stdout.readline().split()[2]
        with urllib.request.urlopen(url, timeout=10) as answer:
            assert b"MeshCat.Viewer" in answer.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20) == 0
    with pytest.raises(urllib.error.URLError, match="refused"):
        urllib.request.urlopen(url, timeout=5)
    with pytest.raises(ProcessLookupError):  # its whole session is gone
        os.killpg(process.pid, 0)


def test_view_simulates_a_policy(stander: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", "stander"]) == 0
    assert capsys.readouterr().out == "stander.html\n"
    assert not list(stander.glob("*.html"))


@pytest.mark.slow
def test_play_shows_levels_as_ghosts_of_the_same_start(stander: Path, capsys: pytest.CaptureFixture[str]) -> None:
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


def test_play_shows_many_robots(stander: Path) -> None:
    assert main(["play", "stander", "--robots", "9", "--seed", "3", "--command", "0.1", "0", "0", "0"]) == 0
    text = Path("stander.html").read_text(encoding="utf-8")
    assert ">seed 3</label>" in text
    assert ">and 5 more</label>" in text


def test_play_takes_an_archive_of_stable_baselines3(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    from ce_gym.adapters.sb3 import make_sb3_vec_env

    monkeypatch.chdir(tmp_path)
    env = "ce_gym/MiniCheetahVelocity-v0"
    sb3.PPO("MlpPolicy", make_sb3_vec_env(env, 1), device="cpu").save("walk.zip")
    assert main(["play", "walk.zip"]) == 2
    assert "no record of its environment; name the environment with --env ID" in capsys.readouterr().err
    assert main(["play", "walk.zip", "--env", env, "--command", "0.1", "0", "0", "0"]) == 0
    assert list(tmp_path.glob("*.html"))


def test_environments_of_other_modules_are_inspected_and_play(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command line names the module that registers them; the policy's file alone does not import it."""
    robot = ce_gym.load_robot(ROBOT).source
    (tmp_path / "my_dogs.py").write_text(f"import ce_gym\nce_gym.register_robot({robot!r}, name='my_dog')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    write_small(tmp_path / "dog" / "policy.npz", env="ce_gym/MyDogVelocity-v0")
    try:
        assert main(["play", "dog"]) == 2
        assert "not registered" in capsys.readouterr().err
        named = "my_dogs:ce_gym/MyDogVelocity-v0"
        with monkeypatch.context() as quick:  # the report itself takes a minute
            quick.setattr("ce_gym.diagnostics.scene.scene_report", lambda name, **_: str(gymnasium.spec(name).id))
            assert main(["inspect", named]) == 0
        assert capsys.readouterr().out == "ce_gym/MyDogVelocity-v0\n"
        assert main(["play", "dog", "--env", named, "--command", "0.1", "0", "0", "0"]) == 0
        assert Path("dog.html").exists()
    finally:
        sys.modules.pop("my_dogs", None)
        for name in [name for name in gymnasium.registry if "MyDog" in name]:
            del gymnasium.registry[name]
