"""Curves for other programs: TensorBoard reads its events; stand-ins for wandb and trackio get the numbers."""

import csv
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from point_mass import ID
from toy import FAST, job

import ce_gym.learn
from ce_gym.__main__ import main
from ce_gym.learn.runs.logs import PROJECT
from ce_gym.learn.runs.progress import SECONDS, STEPS
from ce_gym.learn.training import run_job


def written_rows(folder) -> list[dict[str, float]]:
    with (folder / "progress.csv").open(newline="") as lines:
        return [{name: float(cell) for name, cell in row.items()} for row in csv.DictReader(lines)]


def test_tensorboard_reads_what_the_log_has(tmp_path):
    reader = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    assert main(["train", ID, "--out", str(tmp_path), *FAST, "steps=8192", "--logs", "tensorboard"]) == 0
    events = reader.EventAccumulator(str(tmp_path)).Reload()
    rows = written_rows(tmp_path)
    assert set(events.Tags()["scalars"]) == set(rows[0])
    for name in rows[0]:
        scalars = events.Scalars(name)
        assert [event.step for event in scalars] == [row[STEPS] for row in rows]
        np.testing.assert_allclose([event.value for event in scalars], [row[name] for row in rows], rtol=1e-6)


class Tracker(SimpleNamespace):
    """A module with the functions of Weights & Biases that the log calls."""

    def __init__(self) -> None:
        self.calls, self.logged = [], []

    def init(self, project, name, config):
        self.calls.append((project, name, config["gamma"]))

    def log(self, figures, step):
        self.logged.append((step, figures))

    def finish(self):
        self.calls.append("finish")


@pytest.mark.parametrize("package", ["wandb", "trackio"])
def test_a_tracker_gets_settings_and_the_numbers_of_each_row(package, tmp_path, monkeypatch):
    tracker = Tracker()
    monkeypatch.setitem(sys.modules, package, tracker)
    run_job(job(tmp_path / "walk", 4096, logs=(package,)))
    rows = written_rows(tmp_path / "walk")
    assert tracker.calls == [(PROJECT, "walk", 0.9), "finish"]
    assert [step for step, _ in tracker.logged] == [row[STEPS] for row in rows]
    for (_, figures), row in zip(tracker.logged, rows, strict=True):
        assert figures == pytest.approx(row, abs=1e-3)


def test_a_package_that_is_missing_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert main(["train", ID, "--out", str(tmp_path), *FAST, "--logs", "wandb"]) == 2
    assert 'needs wandb, which is not installed: pip install "wandb"' in capsys.readouterr().err


def test_training_and_evaluation_in_python(tmp_path):
    settings = {"steps": 2048, "num_envs": 64, "hidden": [8], "training": {}}
    trained = ce_gym.learn.train(ID, out=tmp_path, settings=settings, seed=3, env_kwargs={"horizon": 20}, threads=1)
    assert (trained.record["seed"], trained.record["settings"]["hidden"]) == (3, (8,))
    longer = ce_gym.learn.train(resume=tmp_path, out=tmp_path, settings={"steps": 4096}, threads=1)
    assert longer.record["steps"] >= 4096
    assert longer.record["env_kwargs"] == {"horizon": 20}
    for arguments, seconds in (({}, 0.4), ({"horizon": 10}, 0.2)):
        result = ce_gym.learn.evaluate(tmp_path, episodes=4, seed=0, **arguments)
        assert (result["episodes"], result["episode_length"]) == (4, pytest.approx(seconds))
    assert written_rows(tmp_path)[-1][SECONDS] > 0
    with pytest.raises(ValueError, match=r"^settings: gamma=2; expected a number between 0 and 1"):
        ce_gym.learn.train(ID, settings={"gamma": 2})
