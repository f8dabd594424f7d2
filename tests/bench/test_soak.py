"""The soak finds what it looks for, and nothing where nothing is wrong."""

import argparse
import itertools
import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym.bench.soak import benchmark as soak
from ce_gym.bench.soak import substeps
from ce_gym.envs.runtime.batch import TaskBatch

IDS = ["ce_gym/MiniCheetahVelocity-v0", "ce_gym/MiniCheetahRun-v0"]


def arguments(**changes) -> argparse.Namespace:
    return argparse.Namespace(
        **{"minutes": 0.05, "env": IDS, "steps": 80, "seed": 0, "interrupts": None, "substeps": None, **changes}
    )


def test_a_few_seconds_of_it():
    report = soak.run(arguments())
    assert [r.met for r in report.requirements] == [True] * 4, report.as_text()
    rows = report.tables[0].rows
    assert [row[0] for row in rows] == IDS
    assert all(row[1] >= 3 * 80 * 64 and row[2] > 64 and row[3] == row[4] > 0 for row in rows)


def test_it_notices_failures_that_are_not_flagged(monkeypatch: pytest.MonkeyPatch):
    step = TaskBatch.step

    def silent(self, *given):
        outcome = step(self, *given)
        outcome.diverged[:] = False
        return outcome

    monkeypatch.setattr(TaskBatch, "step", silent)
    report = soak.run(arguments(minutes=0.0, env=IDS[:1]))
    assert [r.met for r in report.requirements][:2] == [False, False]


def test_it_notices_a_process_that_grows(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(soak, "WARM_UP", 0)
    clock = itertools.count()  # seconds that pass at every look, however busy the machine is
    monkeypatch.setattr(soak, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    memory = iter([100.0, 100.0 + soak.GROWTH + 1])
    monkeypatch.setattr(soak, "resident_memory", lambda: next(memory, 200.0))
    report = soak.run(arguments(minutes=0.1, env=IDS[:1], steps=20))
    assert not report.requirements[2].met


def test_it_notices_files_that_stay_open(monkeypatch: pytest.MonkeyPatch):
    clock, files = itertools.count(), itertools.count()
    monkeypatch.setattr(soak, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    monkeypatch.setattr(soak, "open_files", lambda: next(files))
    report = soak.run(arguments(minutes=0.1, env=IDS[:1], steps=20))
    assert not report.requirements[3].met


def shares(case: substeps.Case) -> substeps.Case:
    case.run(1, np.random.default_rng(0))
    return case


def test_random_sub_steps_of_a_robot():
    case = shares(substeps.Case(TRIPOD, "exact", "float64", "position"))
    assert case.steps == substeps.NUM_ENVS * substeps.DRAWS * substeps.N_SUBSTEPS
    assert (case.diverged, case.complaints) == (0, [])
    assert all(r.met for r in substeps.reported([case], 1).requirements)


def test_random_sub_steps_notice_neighbours_and_failures_that_are_not_flagged(monkeypatch: pytest.MonkeyPatch):
    """A robot that is moved where its twin is not, and robots that are too fast and nobody says so."""
    monkeypatch.setattr(substeps, "DRAWS", 2)
    monkeypatch.setattr(substeps.Simulator, "diverged", property(lambda sim: np.zeros(sim.num_envs, bool)))
    monkeypatch.setattr(substeps, "WATCHED", np.arange(1, 16, 4))
    case = shares(substeps.Case(TRIPOD, "exact", "float64", "position"))
    said = " ".join(case.complaints)
    assert "q of robots depends on their neighbours" in said
    assert "are not flagged" in said
    assert not substeps.reported([case], 1).requirements[0].met


def test_interrupted_calls(tmp_path):
    """In a process of its own, for Ctrl-C is sent to it. How soon a long call answers depends on the machine."""
    file = tmp_path / "report.json"
    command = [sys.executable, "-m", "ce_gym.bench", "soak", "--interrupts", "32", "--json", str(file)]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr
    report = json.loads(file.read_text())
    whole, long = report["requirements"]
    assert whole["met"], report["remarks"]
    assert long["measured"].endswith("as it was")
    rows = report["tables"][0]["rows"]
    assert sum(row[1] + row[2] for row in rows) == 32
