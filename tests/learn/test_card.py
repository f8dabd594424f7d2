"""Cards of policies, policies as small safe files, and where they are found."""

import json
import shlex
import shutil

import numpy as np
import pytest

import ce_gym
from ce_gym.__main__ import _parser, main
from ce_gym.learn import train
from ce_gym.learn.commands.train import make_jobs
from ce_gym.learn.evaluation.card import card, command, portable, short_name
from ce_gym.learn.evaluation.evaluation import report
from ce_gym.policies import PolicyError, load_policy, locate_policy

ROBOT_ENV = next(iter(ce_gym.environment_ids()))
SMALL = ["num_envs=32", "rollout=8", "minibatches=2", "epochs=1", "hidden=[32, 16]", "steps=1000", "training={}"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Folder of a training run, hardly begun."""
    out = tmp_path_factory.mktemp("run")
    train(ROBOT_ENV, out=out, settings=SMALL)
    return out


@pytest.fixture
def shelf(tmp_path, monkeypatch):
    """Where shipped policies lie, for one test."""
    monkeypatch.setattr("ce_gym.policies.places.assets_folder", lambda: tmp_path)
    return tmp_path / "policies"


def job_of(line):
    """The training run of a printed command line."""
    words = shlex.split(line)
    assert words[:4] == ["python", "-m", "ce_gym", "train"]
    (job,) = make_jobs(_parser().parse_args(words[3:]))
    return job


@pytest.mark.slow
def test_a_shipped_policy_is_found_by_name(run, shelf, monkeypatch, capsys):
    assert main(["card", str(run), "--ship", "--episodes", "2", "--sim2sim-episodes", "0", "--levels", "none"]) == 0
    folder = shelf / "mini_cheetah_velocity_exact"
    assert {file.name for file in folder.iterdir()} == {"policy.npz", "card.md", "curve.png"}
    assert ce_gym.shipped_policies() == ["mini_cheetah_velocity_exact"]
    obs = np.random.default_rng(0).standard_normal((64, 48)).astype(np.float32)
    expected = load_policy(run / "policy.npz").predict(obs)[0]
    for name in ("mini_cheetah_velocity_exact", "mini_cheetah_velocity", folder, folder / "policy.npz"):
        np.testing.assert_array_equal(load_policy(name).predict(obs)[0], expected)
    assert sum(file.stat().st_size for file in folder.iterdir()) < 200_000
    text = (folder / "card.md").read_text()
    assert str(run) not in text
    assert "Not evaluated: not requested" in text
    capsys.readouterr()
    assert main(["evaluate", "mini_cheetah_velocity", "--episodes", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["effort"]["motors"]


def test_the_command_on_the_card_makes_the_same_job(run):
    record = load_policy(run).record
    job = job_of(command(record))
    assert (job.env_id, job.seed, job.resume) == (record["env"], record["seed"], None)
    assert json.loads(json.dumps(job.settings.as_dict())) == record["settings"]
    kwargs = {"transmission": "none", "obs_mode": "dict", "critic": ["contact_forces", "rotor_speeds"]}
    kwargs |= {"terrain": "stairs", "randomise": {"friction": [0.5, 1.2]}, "heading": True, "dt": 5e-3}
    assert job_of(command(record | {"env_kwargs": kwargs})).env_kwargs == kwargs


def test_a_run_that_a_deadline_ended_is_repeated_that_long(run):
    record = load_policy(run).record
    assert job_of(command(record | {"steps": 512})).settings.steps == 512


def test_what_no_command_repeats_is_said(run):
    with pytest.raises(PolicyError, match=r"resumed from x\.zip"):
        command(load_policy(run).record | {"resumed_from": "x.zip"})


def test_a_card_says_what_was_measured(run):
    record = load_policy(run).record
    figures = {"forward_error": 0.123, "lateral_error": 0.2, "yaw_rate_error": 0.3, "falls": 0.456, "reward": 7.0}
    figures |= {"episodes": 12, "velocity_error": 0.321, "commanded": True, "episode_length": 10.0}
    pushes = {"command": [0.5, 0, 0], "speeds": [1.0], "directions": [0.0], "survived": [[0.25]], "envelope": [None]}
    simulations = {"ce_gym, exact": figures, "MuJoCo, rotors as bodies": figures | {"falls": 0.02}}
    verdict = {"MuJoCo, rotors as bodies": {"passed": True, "error_ratio": 1.1, "yaw_ratio": 1.2}}
    sim2sim = {"simulations": simulations, "verdict": verdict}
    suites = {"standing": figures | {"falls": 0.789}}
    result = {"seed": 98765, "levels": {"exact": figures}, "effort": {}, "pushes": pushes, "sim2sim": sim2sim}
    result |= {"suites": suites, "finer": figures | {"forward_error": 0.234}}
    curve = [{"steps": 1, "seconds": 98.7, "reward": 1.0, "length": 1.0}]
    text = card(record, result, curve, short_name(record))
    measured = (
        "0.123",
        "`exact`, sub-steps of 1 ms | 0.234",
        "45.6%",
        "78.9%",
        "98765",
        "25%",
        "2.0%",
        "passed: 1.10 and 1.20 times",
    )
    for words in (*measured, "99 s", ROBOT_ENV, "[32, 16]", "curve.png"):
        assert words in text, words
    assert "## Motors" not in text


def test_a_card_of_a_policy_without_commands_has_the_task_s_own_figures(run):
    record = load_policy(run).record
    figures = {"metrics/longest_flight": 0.4321, "reward/flight": 0.9876, "forward_error": 0.123, "reward": 7.0}
    figures |= {"falls": 0.456, "timed_out": 0.5, "diverged": 0.0, "episode_length": 2.5, "episodes": 12, "seed": 1}
    figures["commanded"] = False
    result = {"seed": 1, "levels": {"exact": figures}, "finer": figures, "effort": {}, "sim2sim_missing": "no commands"}
    text = card(record, result, [], short_name(record))
    assert "| longest flight | falls" in text
    for words, there in (("0.432", True), ("45.6%", True), ("no commands", True), ("0.123", False), ("Pushes", False)):
        assert (words in text) == there, words
    said = report(figures)
    assert "longest flight" in said
    assert "speed error" not in said
    assert "forward speed error" in report({**figures, "commanded": True, "lateral_error": 0.0, "yaw_rate_error": 0.0}
                                           | {"velocity_error": 0.0})  # fmt: skip


def test_no_path_of_this_machine_is_shipped(run):
    record = portable(load_policy(run).record | {"resumed_from": "/home/somebody/runs/policy.zip"})
    assert record["resumed_from"] == "policy.zip"


def test_what_is_not_there_is_told_with_what_is(shelf, run, tmp_path):
    shutil.copytree(run, tmp_path / "copy")
    assert locate_policy(tmp_path / "copy") == tmp_path / "copy" / "policy.npz"
    (shelf / "dog_walk_none").mkdir(parents=True)
    (shelf / "dog_walk_none" / "policy.npz").touch()
    for name, hint in (
        ("cat_walk", "`python -m ce_gym list`"),
        (str(tmp_path), "a run in this folder, such as .*copy"),
    ):
        with pytest.raises(PolicyError, match=f"no such policy; expected .*{hint}") as caught:
            locate_policy(name)
        assert "\n" not in str(caught.value)
