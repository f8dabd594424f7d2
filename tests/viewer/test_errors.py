"""Errors of the command line for the viewer: one line, and exit code 2."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from stander import write_small

from ce_gym.__main__ import main
from ce_gym.dynamics import Model
from ce_gym.viewer import Rollout

pytest.importorskip("meshcat")

LOGS = {
    "no_steps": b"a,b\n1,2\n",
    "binary": b"\x00\xff\n\n",
    "letters": b"time/total_timesteps,time/time_elapsed\n1,x\n",
    "wide": b"a" + b",a" * 600 + b"\n",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rollout, policies and logs, good and bad."""
    folder, model = tmp_path_factory.mktemp("errors"), Model("mini_cheetah")
    rollout = Rollout("mini_cheetah", "exact", 0.1, np.zeros(1), model.standing_q[None], np.zeros((1, model.nv)))
    rollout.save(folder / "stand.npz")
    Rollout("nobody", "exact", 0.1, np.zeros(1), np.zeros((1, 7)), np.zeros((1, 6))).save(folder / "nobody.npz")
    (folder / "text.txt").write_text("text")
    for name, env in (("good", {}), ("cart", {"env": "CartPole-v1"}), ("trap", {"env": "trap:test/Nothing-v0"})):
        write_small(folder / name / "policy.npz", **env)
    write_small(folder / "unregistered" / "policy.npz", env="test/Nothing-v0")
    (folder / "damaged").mkdir()
    (folder / "damaged" / "policy.npz").write_bytes(b"nothing")
    for name, content in LOGS.items():
        (folder / name).mkdir()
        (folder / name / "progress.csv").write_bytes(content)
    return folder


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("view nowhere.npz", "nowhere.npz: no such file"),
        ("view text.txt", "text.txt: cannot be read as a rollout"),
        ("view nobody.npz", "nobody"),
        ("view damaged", "damaged"),
        ("view stand.npz --plot forward temperature", "no signal 'temperature' to plot; expected one of forward speed"),
        ("view stand.npz --html no/x.html", "no such folder"),
        ("view", "FILE"),
        ("view nowhere.urdf", "nowhere.urdf: cannot be read"),
        ("view mini_cheetah stand.npz", "mini_cheetah: 2 files; expected a robot alone"),
        ("view mini_cheetah --html x.html", "mini_cheetah: --html is for rollouts and policies"),
        ("view mini_cheetah --env-arg terrain=stairs", "mini_cheetah: --env-arg is for rollouts and policies"),
        ("vieuw", "'vieuw'"),
        ("list --all", "--all"),
        ("inspect nobody", "nobody"),
        ("inspect mini_cheetah --transmission sloppy", "sloppy"),
        ("inspect no_module:ce_gym/MyDogVelocity-v0", "environment 'no_module:ce_gym/MyDogVelocity-v0'"),
        ("inspect ce_gym/NoDogVelocity-v0", "environment 'ce_gym/NoDogVelocity-v0'"),
        ("play nowhere", "nowhere: no such policy; expected a file (policy.zip"),
        ("play text.txt", "no such policy"),
        ("play cart", "environment 'CartPole-v1': "),
        ("play unregistered", "environment 'test/Nothing-v0': not registered; expected one of this package's"),
        ("play trap", "if you trust it, name it yourself: --env trap:test/Nothing-v0"),
        ("play good --transmission sloppy", "'sloppy'"),
        ("play good --robots 0", "'0'; expected a whole number, at least 1"),
        ("play good --html a --live", "not allowed with"),
        ("play good --robots 2 --transmission exact none", "--robots 2: expected 1, or one level"),
        ("play good --robots 2 --video two.gif", "--video with 2 robots: expected one"),
        ("play good --video hop.avi", "hop.avi: expected a name that ends in .mp4, .webm, .gif"),
        ("play good --video no/hop.gif", "no such folder"),
        ("play good --video hop.gif --size 95 64", "size 95 x 64: expected even numbers from 16 to 4096"),
        ("watch nothing", "nothing: no such folder"),
        ("watch damaged", "no progress.csv in it or in its subfolders"),
        ("watch no_steps", "progress.csv: expected a column time/total_timesteps"),
        ("watch binary", "progress.csv: expected a CSV file of numbers"),
        ("watch letters", "progress.csv: expected a CSV file of numbers"),
        ("watch wide", "progress.csv: 601 columns; expected at most 500"),
    ],
)
def test_mistakes_are_one_line(
    command: str, message: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.delenv("DISPLAY", raising=False)
    try:
        code = main(command.split())
    except SystemExit as ended:
        code = ended.code
    assert code == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("ce_gym: warning")]
    assert line.startswith("ce_gym: ")
    assert message in line


@pytest.mark.parametrize("command", ["view stand.npz", "play good", "live good", "watch wide"])
def test_a_missing_meshcat_is_reported_before_anything_is_computed(
    command: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr("ce_gym.viewer.rollouts.driving.drive_many", lambda *_, **__: pytest.fail("simulated"))
    assert main(command.split()) == 2
    assert 'needs meshcat, which is not installed: pip install "ce_gym[viewer]"' in capsys.readouterr().err


@pytest.mark.parametrize("command", ["list", "inspect", "view", "play", "live", "watch"])
def test_help_fits_a_terminal(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    out = capsys.readouterr().out
    assert out.startswith(f"usage: python -m ce_gym {command}")
    assert max(len(line) for line in out.splitlines()) <= 120
