"""The command line, with the real robot: rollouts become pages, mistakes become one line and exit code 2."""

from __future__ import annotations

import importlib.util
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

import numpy as np
import pytest

from ce_gym import Terrain
from ce_gym.__main__ import main
from ce_gym.viewer import Rollout
from ce_gym.viewer.rollouts.ground_patch import MOST, around

pytest.importorskip("meshcat")

ROBOT = "mini_cheetah"


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seconds of a robot that stands, its legs moving a little so that nothing is left out."""
    from ce_gym.dynamics import Model

    model = Model(ROBOT)
    times = 0.02 * np.arange(1000)
    q = np.tile(model.standing_q, (1000, 1))
    q[:, 7:] += 0.1 * np.sin(times)[:, None]
    q[:, 0] = 0.3 * times
    forces = np.random.default_rng(0).normal(0, 20, (1000, len(model.contact_names), 3))
    torques = np.sin(times)[:, None] * np.ones(len(model.joint_links))
    rollout = Rollout(ROBOT, "exact", 0.02, times, q, np.zeros((1000, model.nv)), forces, np.ones((1000, 3)), torques)
    return rollout.save(tmp_path_factory.mktemp("rollout") / "stand.npz")


def test_view_writes_beside_the_rollout(standing: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(standing)]) == 0
    path = standing.with_suffix(".html")
    assert capsys.readouterr().out == f"{path}\n"
    assert path.stat().st_size < 6e6


def test_view_writes_where_it_is_told(standing: Path, tmp_path: Path) -> None:
    target = tmp_path / "two.html"
    assert main(["view", str(standing), str(standing), "--overlay", "--title", "Twins", "--html", str(target)]) == 0
    assert "<title>Twins</title>" in target.read_text(encoding="utf-8")
    assert target.stat().st_size < 6e6


def test_ground_and_a_ghost_are_small(standing: Path, tmp_path: Path) -> None:
    """The worst ground: random heights over the whole of the path, as many as are kept."""
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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["view", "nowhere.npz"], "nowhere.npz: no such file"),
        (["view", __file__], "test_command_line.py: cannot be read as a rollout"),
        (["inspect", "nobody"], "nobody"),
        (["play", "nowhere"], "nowhere: no such policy; expected a file (policy.zip"),
        (["play", __file__], "no such policy"),
        (["inspect", ROBOT, "--transmission", "sloppy"], "sloppy"),
    ],
)
def test_mistakes_are_one_line(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    error = capsys.readouterr().err
    errors = [line for line in error.splitlines() if not line.startswith("ce_gym: warning")]
    assert len(errors) == 1
    assert errors[0].startswith("ce_gym: ")
    assert message in errors[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["vieuw"], "'vieuw'"),
        (["view"], "ROLLOUT"),
        (["list", "--all"], "--all"),
        (["play", "x", "--transmission", "sloppy"], "'sloppy'"),
        (["play", "x", "--robots", "0"], "'0'; expected a whole number, at least 1"),
        (["play", "x", "--html", "a", "--live"], "not allowed with"),
    ],
)
def test_wrong_arguments_are_one_line(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith("ce_gym: ")
    assert message in error
    assert "--help" in error


@pytest.mark.parametrize("command", ["list", "inspect", "view", "play"])
def test_help_says_what_it_does(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([command, "--help"])
    assert caught.value.code == 0
    out = capsys.readouterr().out
    assert out.startswith(f"usage: python -m ce_gym {command}")
    assert max(len(line) for line in out.splitlines()) <= 120


def test_unknown_signal(standing: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(standing), "--plot", "torq", "temperature"]) == 2
    assert "no signal 'temperature' to plot; expected one of forward speed [m/s], " in capsys.readouterr().err


def test_unknown_robot_in_a_rollout(standing: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rollout = Rollout("nobody", "exact", 0.1, np.zeros(1), np.zeros((1, 7)), np.zeros((1, 6)))
    assert main(["view", str(rollout.save(tmp_path / "x.npz"))]) == 2
    assert "nobody" in capsys.readouterr().err


def test_missing_meshcat(standing: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main(["view", str(standing)]) == 2
    assert 'pip install "ce_gym[viewer]"' in capsys.readouterr().err


def test_unwritable_target(standing: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(standing), "--html", str(tmp_path / "no" / "x.html")]) == 2
    assert "No such file or directory" in capsys.readouterr().err


def test_no_arguments_say_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    out = capsys.readouterr().out
    assert all(word in out for word in ("list", "inspect", "view", "play", "bench"))


@pytest.mark.slow
def test_list_and_inspect_name_the_robot(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    listed = capsys.readouterr().out.split()
    assert {ROBOT, "ce_gym/MiniCheetahVelocity-v0", "mini_cheetah_velocity_exact"} <= set(listed)
    assert main(["inspect", ROBOT]) == 0
    assert "FL_knee_rotor" in capsys.readouterr().out


def test_bench_is_handed_its_own_options(capsys: pytest.CaptureFixture[str]) -> None:
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
