"""Train on one level, evaluate on all: runs that are trained again, and the figures of the summary."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from point_mass import ID

from ce_gym.__main__ import main
from ce_gym.learn import study
from ce_gym.learn.evaluate.episodes import ERRORS
from ce_gym.learn.evaluate.transfer import interval, summary, table, transfer
from ce_gym.model.mechanism import LEVELS
from ce_gym.policies import Policy, load_policy, read_actor, write_npz

SMALL = ["transfer", "--train", "--env", ID, "--steps", "600", "--seeds", "0", "1", "--threads", "1", "--episodes", "4"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("transfer")
    assert main([*SMALL, "--levels", "exact", "none", "--runs", str(folder)]) == 0
    return folder


@pytest.fixture
def trainings(monkeypatch):
    """The training runs begun during a test: level and seed."""
    begun = []

    run_job = study.run_job

    def train(job):
        begun.append((job.env_kwargs["transmission"], job.seed, job.resume))
        return run_job(job)

    monkeypatch.setattr(study, "run_job", train)
    return begun


def write_finished(policy, finished):
    """Write into the record of a policy whether its training has finished."""
    actor, record = read_actor(policy)
    write_npz(actor, record | {"finished": finished}, policy)


def test_every_level_and_seed_is_trained_on_its_own(runs):
    for level in ("exact", "none"):
        for seed in (0, 1):
            record = load_policy(runs / level / f"seed_{seed}").record
            assert (record["transmission"], record["seed"]) == (level, seed)
    result = json.loads((runs / "transfer.json").read_text())
    assert [entry["transmission"] for entry in result["policies"]] == ["exact", "exact", "none", "none"]
    assert tuple(result["summary"]["none"]) == LEVELS
    one = [entry["results"]["armature"]["forward_error"] for entry in result["policies"][:2]]
    assert result["summary"]["exact"]["armature"]["forward_error"]["mean"] == pytest.approx(np.mean(one))
    assert "| none       | none *" in (runs / "transfer.md").read_text()
    assert (runs / "transfer.png").read_bytes()[:4] == b"\x89PNG"


def test_a_second_call_trains_only_what_is_missing(runs, trainings, tmp_path):
    arguments = [*SMALL, "--levels", "exact", "none", "coupled", "--runs", str(runs), "--out", str(tmp_path)]
    assert main(arguments) == 0
    assert trainings == [("coupled", 0, None), ("coupled", 1, None)]
    assert tuple(json.loads((tmp_path / "transfer.json").read_text())["summary"]) == ("exact", "coupled", "none")


def test_an_interrupted_run_is_gone_on_with(runs, trainings, monkeypatch):
    policy = runs / "exact" / "seed_1" / "policy.npz"
    write_finished(policy, False)
    assert main([*SMALL, "--levels", "exact", "--runs", str(runs)]) == 0
    assert trainings == [("exact", 1, policy)]
    assert load_policy(policy).record["finished"]
    monkeypatch.setattr(study, "run_job", lambda job: SimpleNamespace(interrupted=True))
    write_finished(policy, False)
    assert main([*SMALL, "--levels", "exact", "--runs", str(runs)]) == 130
    write_finished(policy, True)


def test_a_run_of_another_kind_is_not_overwritten(runs, trainings, capsys):
    assert main([*SMALL, "--levels", "exact", "--steps", "700", "--runs", str(runs)]) == 2
    error = capsys.readouterr().err.strip()
    assert "trained with steps = 600, requested 700" in error
    assert "\n" not in error
    assert not trainings


@pytest.mark.parametrize("argv", [[], ["--train"], ["some", "--train", "--env", ID]])
def test_bad_command_lines_are_refused(argv):
    with pytest.raises(SystemExit) as caught:
        main(["transfer", *argv])
    assert caught.value.code == 2


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
        "ce_gym.learn.evaluate.transfer.evaluate",
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
