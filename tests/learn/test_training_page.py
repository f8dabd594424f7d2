"""`--page` of `train`: a process that ends with training, and a policy that it can show meanwhile."""

import socket
import time
import urllib.parse

import pytest
from point_mass import ID
from toy import FAST, job

from ce_gym.__main__ import main
from ce_gym.learn.learners.ppo import train as fast_train
from ce_gym.learn.learners.sb3 import train as reference_train
from ce_gym.learn.runs import page as training_page
from ce_gym.learn.runs.page import PRESENT, Present, TrainingPage
from ce_gym.policies import load_policy


@pytest.mark.parametrize("train", [fast_train, reference_train])
def test_learners_write_their_present_policy_if_asked(train, tmp_path):
    trained = train(job(tmp_path / "with", 3000, page=True))
    present = load_policy(tmp_path / "with" / PRESENT)
    assert present.record["env"] == trained.record["env"]
    assert present.record["steps"] < trained.record["steps"]
    assert not present.record["finished"]
    train(job(tmp_path / "without", 3000))
    assert not (tmp_path / "without" / PRESENT).exists()


def test_it_is_written_now_and_then(monkeypatch, tmp_path):
    clock, written = [0.0], []
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    present = Present(written.append, tmp_path, enabled=True)
    for clock[0] in (1.0, 2.0, 1.0 + training_page.PERIOD, 2.0 + training_page.PERIOD):
        present.keep()
    assert written == [tmp_path / PRESENT / "policy"] * 2


def test_a_full_disk_does_not_end_training(tmp_path, capsys):
    def fail(path):
        raise OSError(28, "No space left on device")

    Present(fail, tmp_path, enabled=True).keep()
    assert "No space left on device; training continues" in capsys.readouterr().err


def test_the_page_ends_with_training_and_leaves_nothing(tmp_path, capfd):
    pytest.importorskip("meshcat")
    told, (out, run) = "", (tmp_path / "one", tmp_path / "one" / PRESENT)
    with TrainingPage([out], ID):
        while "watch at" not in told:
            told += capfd.readouterr().out
            time.sleep(0.05)
        run.mkdir(parents=True)
        port = urllib.parse.urlsplit(told.split()[-1]).port
        socket.create_connection(("127.0.0.1", port), timeout=60).close()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", port), timeout=60)
    assert out.exists()
    assert not run.exists()


def test_the_command_line_asks_for_it(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(
        "ce_gym.learn.runs.page.TrainingPage.__enter__", lambda page: asked.append((page._folders, page._env_id))
    )
    monkeypatch.setattr("ce_gym.learn.runs.page.TrainingPage.__exit__", lambda *_: None)
    command = ["train", ID, "--steps", "1000", "--out", str(tmp_path), *FAST]
    assert main([*command, "--page"]) == 0
    assert asked == [([tmp_path], ID)]
    assert (tmp_path / PRESENT / "policy.npz").exists()
