"""Both PPO learners: they learn, save, resume, stop on request, and survive a full disk."""

import csv
import errno
import json
import os
import shlex
import signal
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from point_mass import ID
from saved import load_learner
from toy import FAST, job, jobs

from ce_gym.__main__ import main
from ce_gym.learn.evaluation.card import command
from ce_gym.learn.evaluation.evaluation import evaluate
from ce_gym.learn.runs.progress import read_curve
from ce_gym.learn.training import run_job
from ce_gym.policies import load_policy

LEARNERS = ("ppo", "sb3")
BRIEF = ["num_envs=16", "epochs=1", "target_kl=0.01"]
ROBOT = "ce_gym/MiniCheetahVelocity-v0"


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A training run of each learner."""
    return {name: run_job(job(tmp_path_factory.mktemp(name), 30_000, algo=name)) for name in LEARNERS}


@pytest.fixture(params=LEARNERS)
def name(request):
    return request.param


@pytest.fixture
def learn(name):
    return lambda run: run_job(run.replace(algo=name))


@pytest.fixture
def trained(runs, name):
    return runs[name]


def test_it_learns(runs):
    results = {name: evaluate(trained.model, ID, episodes=32) for name, trained in runs.items()}
    for result in results.values():
        assert result["forward_error"] < 0.1  # half a unit without learning
        assert result["falls"] == 0.0
        assert result["episode_length"] == pytest.approx(1.0)  # 50 steps of 20 ms
    assert results["ppo"]["reward"] == pytest.approx(results["sb3"]["reward"], abs=1.0)  # of 50


def test_the_policy_file_is_the_trained_policy(trained):
    obs = np.random.default_rng(0).standard_normal((16, 2)).astype(np.float32)
    policy, folder = trained.policy, trained.policy.parent
    saved = load_learner(policy)[0] if policy.suffix == ".zip" else load_policy(folder)
    actions, expected = (model.predict(obs, deterministic=True)[0] for model in (saved, trained.model))
    np.testing.assert_allclose(actions, expected, atol=1e-6)
    written = json.loads(policy.with_suffix(".json").read_text())
    assert written == load_policy(folder).record == json.loads(json.dumps(trained.record))
    assert main(["evaluate", str(policy), "--episodes", "4"]) == 0


def test_the_record_says_what_was_trained(runs):
    for trained in runs.values():
        record = trained.record
        assert (record["env"], record["transmission"]) == (ID, "exact")
        assert (record["observation_size"], record["action_size"]) == (2, 1)
        assert tuple(record["settings"]["hidden"]) == (16,)
        assert record["steps"] >= 30_000
        assert record["finished"]
    assert set(runs["sb3"].record) == set(runs["ppo"].record)


def test_the_command_on_its_card_repeats_it(trained, name):
    record = load_policy(trained.policy).record
    words = shlex.split(command(record))
    assert words[:4] == ["python", "-m", "ce_gym", "train"]
    (again,) = jobs(*words[4:])
    assert (again.algo, again.env_id, again.seed) == (name, ID, 0)
    assert json.loads(json.dumps(again.settings.as_dict())) == record["settings"]


def test_logs_and_curve_tell_how_learning_went(trained):
    folder = trained.policy.parent
    header = (folder / "progress.csv").read_text().splitlines()[0].split(",")
    assert {"reward/speed", "metrics/velocity_error", "rollout/ep_rew_mean", "train/approx_kl"} <= set(header)
    curve = read_curve(folder / "progress.csv")
    assert (curve[-1]["steps"], curve[-1]["length"]) == (trained.record["steps"], 50)
    assert curve[-1]["reward"] > curve[0]["reward"] + 5


def test_checkpoints_are_policies(trained):
    found = (trained.policy.parent / "checkpoints").glob(f"*{trained.policy.suffix}")
    checkpoints = sorted(path for path in found if not path.name.endswith(".learner.npz"))
    assert len(checkpoints) >= 5
    assert load_policy(checkpoints[0]).record["steps"] < 30_000
    assert not list(trained.policy.parent.rglob(".*"))


def test_a_resumed_run_goes_on(learn, trained, tmp_path):
    """With the earlier learning curve; environments that cannot be restored begin anew."""
    before = read_curve(trained.policy.parent / "progress.csv")
    again = learn(job(tmp_path, 36_000, resume=trained.policy))
    curve = read_curve(tmp_path / "progress.csv")
    assert curve[: len(before)] == before
    assert curve[-1]["steps"] == again.record["steps"]
    assert 36_000 <= again.record["steps"] < 37_000
    assert np.all(np.diff([row["seconds"] for row in curve]) >= 0)  # to hundredths of a second
    assert curve[-1]["seconds"] > before[-1]["seconds"]
    assert again.record["resumed_from"] == str(trained.policy)
    assert evaluate(again.model, ID, episodes=16)["forward_error"] < 0.2


def logged_steps(folder):
    with (folder / "progress.csv").open(newline="") as lines:
        return [float(row["time/total_timesteps"]) for row in csv.DictReader(lines)]


def test_a_run_that_is_resumed_in_its_folder_keeps_its_log(learn, tmp_path):
    policy = learn(job(tmp_path, 4096)).policy
    before = logged_steps(tmp_path)
    assert before[-1] == 4096
    assert learn(job(tmp_path, 6144, resume=policy)).record["steps"] == 6144
    assert logged_steps(tmp_path) == [*before, 5120, 6144]
    checkpoint = tmp_path / "checkpoints" / f"policy_2048{policy.suffix}"
    learn(job(tmp_path, 3072, resume=checkpoint))
    assert logged_steps(tmp_path) == [steps for steps in before if steps <= 2048] + [3072]


def test_without_a_target_the_rate_falls_linearly(learn, tmp_path):
    learn(job(tmp_path, 10 * 1024))
    with (tmp_path / "progress.csv").open(newline="") as lines:
        found = [row["train/learning_rate"] for row in csv.DictReader(lines)]
    rates = [float(rate) for rate in found if rate]  # the reference logs an update with the next rollout
    assert len(rates) >= 9
    np.testing.assert_allclose(np.diff(rates), -1e-3, rtol=1e-4)
    assert 0 <= rates[-1] <= 1e-3 * (1 + 1e-6)


@pytest.mark.slow
def test_what_is_for_training_only_is_no_part_of_the_policy(learn, tmp_path):
    given = {"dt": 0.004, "max_episode_steps": 7}
    settings = ["num_envs=16", f"training={json.dumps(given)}"]
    record = load_policy(learn(job(tmp_path, 2 * 256, ROBOT, settings)).policy).record
    assert read_curve(tmp_path / "progress.csv")[-1]["length"] <= 7
    assert (record["env_kwargs"], record["policy_spec"]["physics_dt"]) == ({}, 0.005)
    (again,) = jobs(*shlex.split(command(record))[4:])
    assert again.settings.training == record["settings"]["training"] == given


def test_training_warns_of_nothing(learn, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        learn(job(tmp_path, 1500))


def test_the_deadline_stops_training_and_saves(learn, tmp_path):
    result = learn(job(tmp_path, 10**9, seconds=0.5))
    assert 0 < result.record["steps"] < 10**9
    assert not result.interrupted
    assert result.policy.exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_saves_a_policy_and_says_how_to_go_on(name, number, tmp_path, capsys):
    before = signal.getsignal(number)

    def interrupt_once_training_runs() -> None:
        while not (tmp_path / "progress.csv").exists():
            time.sleep(0.02)
        os.kill(os.getpid(), number)

    threading.Thread(target=interrupt_once_training_runs, daemon=True).start()
    assert main(["train", ID, "--algo", name, "--steps", "1e9", "--out", str(tmp_path), *FAST]) == 130
    (policy,) = (tmp_path / file for file in ("policy.zip", "policy.npz") if (tmp_path / file).exists())
    assert f"python -m ce_gym train --resume {policy} --out {tmp_path}" in capsys.readouterr().out
    assert load_policy(policy).record["steps"] > 0
    assert signal.getsignal(number) is before


class FullDisk:
    """Makes writing files whose path has a word in it fail."""

    def __init__(self, monkeypatch, word: str) -> None:
        self.write = Path.write_bytes
        self.word = word
        monkeypatch.setattr(Path, "write_bytes", lambda path, data: self._write_bytes(path, data))

    def _write_bytes(self, path: Path, data: bytes) -> int:
        if self.word not in str(path):
            return self.write(path, data)
        self.write(path, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, "No space left on device", str(path))


def test_training_goes_on_if_there_is_no_room_for_a_checkpoint(learn, tmp_path, capsys, monkeypatch):
    FullDisk(monkeypatch, "checkpoints")
    result = learn(job(tmp_path, 2048, settings=BRIEF))
    assert load_policy(result.policy).record["steps"] >= 2048
    told = [line for line in capsys.readouterr().err.splitlines() if "No space left on device" in line]
    assert len(told) >= 3
    assert all("training continues" in line for line in told)
    assert not [path for path in (tmp_path / "checkpoints").glob("*") if path.is_file()]


def test_a_policy_that_has_no_room_goes_elsewhere(learn, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    FullDisk(monkeypatch, "/run/")
    result = learn(job(tmp_path / "run", 512, settings=BRIEF))
    assert load_policy(result.policy).record["steps"] >= 512
    assert result.policy.parent.parent == tmp_path
    assert f"saving to {result.policy.parent}" in capsys.readouterr().err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_training_goes_on_if_there_is_no_room_for_its_log(learn, tmp_path, capsys):
    (tmp_path / "progress.csv").symlink_to("/dev/full")
    assert learn(job(tmp_path, 2048, settings=BRIEF)).policy.exists()
    assert "No space left on device; training continues" in capsys.readouterr().err
