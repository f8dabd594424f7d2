"""Train on one level, evaluate on all: the figures of the summary."""

import json

import numpy as np
import pytest
from point_mass import ID
from toy import FAST

from ce_gym.__main__ import main
from ce_gym.learn.evaluation.episodes import ERRORS
from ce_gym.learn.evaluation.transfer import interval, summary, table, transfer
from ce_gym.model.mechanism import LEVELS
from ce_gym.policies import Policy, read_actor, write_npz


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two levels with two seeds each."""
    folder = tmp_path_factory.mktemp("study")
    words = ["train", ID, *FAST, "--steps", "600", "--transmission", "exact", "none", "--seeds", "0", "1"]
    assert main([*words, "--out", str(folder)]) == 0
    return folder


def test_policies_of_a_study_are_summarized(runs, tmp_path):
    assert main(["transfer", str(runs), "--episodes", "4", "--out", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "transfer.json").read_text())
    assert [entry["transmission"] for entry in result["policies"]] == ["exact", "exact", "none", "none"]
    assert tuple(result["summary"]["none"]) == LEVELS
    errors = [entry["results"]["armature"]["forward_error"] for entry in result["policies"][:2]]
    assert result["summary"]["exact"]["armature"]["forward_error"]["mean"] == pytest.approx(np.mean(errors))
    assert "| none       | none *" in (tmp_path / "transfer.md").read_text()
    assert (tmp_path / "transfer.png").read_bytes()[:4] == b"\x89PNG"


def test_policies_of_different_tasks_are_not_compared(runs, tmp_path, capsys):
    actor, record = read_actor(runs / "none" / "seed_0" / "policy.npz")
    record["policy_spec"] |= {"robot": "another", "task": "velocity"}
    write_npz(actor, record, tmp_path / "policy.npz")
    assert main(["transfer", str(runs / "exact" / "seed_0"), str(tmp_path), "--episodes", "2"]) == 2
    assert "expected the robot and task of the others" in capsys.readouterr().err


def test_the_interval_covers_the_mean_of_samples_as_often_as_it_says():
    rng = np.random.default_rng(0)
    for n in (2, 3, 5, 40):
        found = [interval(x) for x in rng.normal(3.0, 0.7, (4000, n))]
        covered = np.mean([abs(x["mean"] - 3.0) < x["ci95"] for x in found])
        assert covered == pytest.approx(0.95, abs=0.012), n
    assert interval([0.25]) == {"mean": 0.25, "ci95": None, "n": 1}


def test_a_policy_of_the_elastic_level_is_evaluated_there_too(monkeypatch):
    monkeypatch.setattr(
        "ce_gym.learn.evaluation.transfer.evaluate",
        lambda *_, transmission, **__: dict.fromkeys((*ERRORS, "falls", "episode_length", "reward"), len(transmission)),
    )
    record = {"env": ID, "env_kwargs": {"transmission": "exact"}, "transmission": "elastic"}
    results = transfer(Policy(lambda rows: rows, record), record)
    assert tuple(results) == (*LEVELS, "elastic")
    text = table(summary([{"transmission": "elastic", "results": results}]))
    assert "| elastic    | elastic *    | 7.000" in text
    assert "| elastic    | none         | 4.000" in text


def test_a_single_seed_has_no_interval():
    figures = dict.fromkeys(("forward_error", "lateral_error", "yaw_rate_error", "velocity_error"), 0.5)
    figures |= {"falls": 0.25, "episode_length": 2.0, "reward": 1.0}
    entry = {"transmission": "armature", "results": dict.fromkeys(LEVELS, figures)}
    text = table(summary([entry]))
    assert "±" not in text
    assert "25.0%" in text
    assert "armature *" in text
    assert "± 0.000" in table(summary([entry, entry]))
