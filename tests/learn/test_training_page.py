"""`--page` of `train`: a process that ends with training, and a policy that it can show meanwhile."""

import socket
import time
import urllib.parse

import pytest
from point_mass import ID
from toy import FAST, job

from ce_gym.__main__ import main
from ce_gym.learn.runs import loop
from ce_gym.learn.training import run_job
from ce_gym.viewer.watch.process import TrainingPage


@pytest.mark.parametrize("algo", ["ppo", "sb3"])
def test_the_current_policy_is_written_during_training(algo, tmp_path, monkeypatch):
    """At once, and then every five seconds."""
    steps, clock = [], [100.0]

    def record_steps(learner, record, path):
        if path.parent == tmp_path:
            steps.append(record["steps"])
        return save(learner, record, path)

    save = loop.save
    monkeypatch.setattr(loop, "save", record_steps)
    monkeypatch.setattr(time, "monotonic", lambda: clock.__setitem__(0, clock[0] + 1.1) or clock[0])
    trained = run_job(job(tmp_path, 10_000, algo=algo))
    assert steps[0] == 1024
    assert len(steps) >= 4
    assert steps[-1] == trained.record["steps"]
    assert not [file for file in tmp_path.iterdir() if file.name.startswith(".")]


def test_the_page_ends_with_training_and_leaves_nothing(tmp_path, capfd):
    pytest.importorskip("meshcat")
    told, out = "", tmp_path / "one"
    with TrainingPage([out], ID):
        while "watch at" not in told:
            told += capfd.readouterr().out
            time.sleep(0.05)
        port = urllib.parse.urlsplit(told.split()[-1]).port
        socket.create_connection(("127.0.0.1", port), timeout=60).close()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", port), timeout=60)
    assert not out.exists()


def test_the_command_line_asks_for_it(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(TrainingPage, "__enter__", lambda page: asked.append((page._folders, page._env_id)))
    monkeypatch.setattr(TrainingPage, "__exit__", lambda *_: None)
    command = ["train", ID, "--steps", "1000", "--out", str(tmp_path), *FAST]
    assert main([*command, "--page"]) == 0
    assert asked == [([tmp_path], ID)]
