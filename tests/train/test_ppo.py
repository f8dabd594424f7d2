"""Training, resuming, judging and stopping, on a toy task that takes a second or two."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from callbacks import AdaptiveLearningRate
from evaluate import evaluate
from evaluate import main as evaluate_main
from job import Job
from point_mass import ID
from ppo import main, train
from progress import read_curve
from saved import load_learner
from settings import config_file, load_settings
from stable_baselines3 import PPO
from transfer import main as transfer_main

from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.model.mechanism import LEVELS

ROOT = Path(__file__).parents[2]
SMALL = [
    "num_envs=64",
    "rollout=16",
    "hidden=[16]",
    "epochs=4",
    "minibatches=2",
    "learning_rate=1e-2",
    "target_kl=0",
    "gamma=0.9",
]
FAST = ["--no-tensorboard", "--episodes", "8", "--threads", "1", "--set", *SMALL]


def job(out, steps, **changes):
    settings = load_settings(config_file(ID), [*SMALL, f"steps={steps}"])
    return Job(ID, settings, out, env_kwargs={}, tensorboard=False, **changes)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return train(job(tmp_path_factory.mktemp("run"), 30_000))


@pytest.mark.slow
def test_it_learns(trained):
    untrained = PPO("MlpPolicy", make_sb3_vec_env(ID, 1), device="cpu", seed=0)
    before = evaluate(untrained, ID, episodes=32)
    after = evaluate(trained.model, ID, episodes=32)
    assert after["forward_error"] < 0.3 * before["forward_error"]
    assert after["falls"] == 0.0
    assert after["episode_length"] == pytest.approx(1.0)  # 50 steps of 20 ms


def test_the_record_says_what_was_trained(trained):
    model, record = load_learner(trained.policy)
    assert model.num_timesteps == record["steps"] >= 30_000
    assert (record["env"], record["transmission"], record["observation_size"], record["action_size"]) == (
        ID,
        "exact",
        2,
        1,
    )
    assert record["settings"]["hidden"] == [16]


def test_the_saved_policy_acts_as_the_trained_one(trained):
    obs = np.random.default_rng(0).standard_normal((16, 2)).astype(np.float32)
    saved, _ = load_learner(trained.policy)
    expected, _ = trained.model.predict(obs, deterministic=True)
    np.testing.assert_array_equal(saved.predict(obs, deterministic=True)[0], expected)


def test_checkpoints_are_policies(trained):
    checkpoints = sorted((trained.policy.parent / "checkpoints").glob("*.zip"))
    assert len(checkpoints) >= 5
    assert load_learner(checkpoints[0])[1]["steps"] < 30_000
    assert not list(trained.policy.parent.rglob(".*"))


def test_the_curve_ends_where_training_ends(trained):
    curve = read_curve(trained.policy.parent / "curve.csv")
    assert curve[-1]["steps"] == trained.record["steps"]
    assert curve[-1]["length"] == 50
    assert curve[-1]["reward"] > curve[0]["reward"] + 5


def test_a_damaged_curve_is_one_line(tmp_path):
    (tmp_path / "curve.csv").write_text("steps,seconds\n1,2\n")
    with pytest.raises(ValueError, match="expected the columns steps, seconds, reward, length"):
        read_curve(tmp_path / "curve.csv")
    assert read_curve(tmp_path / "none.csv") == []


def test_the_log_has_every_reward_term(trained):
    header = (trained.policy.parent / "progress.csv").read_text().splitlines()[0].split(",")
    assert {"reward/speed", "metrics/velocity_error", "rollout/ep_rew_mean", "train/approx_kl"} <= set(header)


def test_resume_goes_on_counting(trained, tmp_path):
    before = read_curve(trained.policy.parent / "curve.csv")
    again = train(job(tmp_path, 36_000, resume=trained.policy))
    curve = read_curve(tmp_path / "curve.csv")
    assert curve[: len(before)] == before
    assert curve[-1]["steps"] == again.record["steps"]
    assert np.all(np.diff([row["seconds"] for row in curve]) >= 0)  # to hundredths of a second
    assert curve[-1]["seconds"] > before[-1]["seconds"]
    assert 36_000 <= again.model.num_timesteps < 37_000
    assert again.record["resumed_from"] == str(trained.policy)
    assert evaluate(again.model, ID, episodes=16)["forward_error"] < 0.2


def test_resume_with_nothing_left_keeps_the_policy(trained, tmp_path):
    assert train(job(tmp_path, 1000, resume=trained.policy)).model.num_timesteps == trained.model.num_timesteps


def test_resume_takes_the_environment_from_the_record(trained, tmp_path, capsys):
    code = main(["--resume", str(trained.policy), "--steps", "31e3", "--out", str(tmp_path), *FAST])
    assert code == 0
    assert "forward speed error" in capsys.readouterr().out
    assert load_learner(tmp_path / "policy.zip")[1]["env"] == ID


def test_the_deadline_stops_training_and_saves(tmp_path):
    result = train(job(tmp_path, 10**9, seconds=1.0))
    assert 0 < result.model.num_timesteps < 10**9
    assert not result.interrupted
    assert result.policy.exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_a_usable_policy(number, tmp_path, capsys):
    before = signal.getsignal(number)

    def interrupt_once_training_runs() -> None:
        while signal.getsignal(number) is before:
            time.sleep(0.02)
        os.kill(os.getpid(), number)

    threading.Thread(target=interrupt_once_training_runs, daemon=True).start()
    code = main(["--env", ID, "--steps", "1e9", "--out", str(tmp_path), *FAST])
    assert code == 130
    assert "--resume" in capsys.readouterr().out
    assert load_learner(tmp_path / "policy.zip")[0].num_timesteps > 0
    assert signal.getsignal(number) is before


def test_several_seeds_write_several_policies(tmp_path):
    assert main(["--env", ID, "--steps", "600", "--seeds", "0", "1", "--out", str(tmp_path), *FAST]) == 0
    first, second = (load_learner(tmp_path / f"seed_{seed}" / "policy.zip")[0] for seed in (0, 1))
    weights = [model.policy.state_dict()["action_net.weight"] for model in (first, second)]
    assert not np.array_equal(*weights)


def test_same_seed_trains_the_same_policy(tmp_path):
    policies = [train(job(tmp_path / str(i), 2000, seed=5)).model.policy.state_dict() for i in range(2)]
    for key, value in policies[0].items():
        assert np.array_equal(value, policies[1][key]), key


def test_levels_reach_the_environment(trained, capsys):
    assert transfer_main([str(trained.policy), "--episodes", "8", "--json"]) == 0
    results = json.loads(capsys.readouterr().out)["policies"][0]["results"]
    assert tuple(results) == LEVELS
    assert results["exact"] == results["coupled"]  # the toy does not tell these two apart
    assert results["exact"]["reward"] != results["none"]["reward"]
    assert transfer_main([str(trained.policy), "--episodes", "8"]) == 0
    assert "exact *" in capsys.readouterr().out


def test_evaluation_is_repeatable(trained):
    assert evaluate(trained.model, ID, episodes=8) == evaluate(trained.model, ID, episodes=8)


def test_evaluation_measures_speed_itself(trained):
    """The toy reports its own error; the evaluation's, measured from the state, must agree with it."""
    result = evaluate(trained.model, ID, episodes=32)
    # The toy counts the 50th step of each episode, whose state the evaluation no longer sees.
    assert result["forward_error"] == pytest.approx(result["metrics/velocity_error"], rel=0.05)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--env", ID, "--set", "gamma=x"], "gamma: 'x'"),
        (["--env", "nobody/Nothing-v0"], "nobody"),
        (["--env", ID, "--set", "activation=Nope"], "Nope"),
        (["--resume", "missing.zip"], "missing.zip"),
        ([], "--env: missing"),
    ],
)
def test_bad_input_is_one_line(argv, words, tmp_path, capsys):
    assert main([*argv, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err.strip()
    assert words in error
    assert "\n" not in error


def test_a_damaged_policy_is_one_line(tmp_path, capsys):
    (tmp_path / "policy.zip").write_bytes(b"not a zip")
    (tmp_path / "policy.json").write_text("{}")
    assert evaluate_main([str(tmp_path / "policy.zip")]) == 2
    assert "\n" not in capsys.readouterr().err.strip()


@pytest.mark.parametrize(("kl", "factor"), [(0.05, 1 / 1.5), (0.001, 1.5), (0.01, 1.0)])
def test_learning_rate_follows_the_divergence(kl, factor):
    callback = AdaptiveLearningRate(0.01)
    optimizer = SimpleNamespace(param_groups=[{"lr": 1e-3}])
    logger = SimpleNamespace(name_to_value={"train/approx_kl": kl})
    callback.model = SimpleNamespace(policy=SimpleNamespace(optimizer=optimizer), logger=logger, lr_schedule=None)
    callback._on_rollout_start()
    assert callback.model.lr_schedule(1.0) == pytest.approx(1e-3 * factor)


HELP = """
import runpy, sys

for script in sys.argv[1:]:
    sys.argv = [script, "--help"]
    sys.path[0] = script.rpartition("/")[0]
    try:
        runpy.run_path(script, run_name="__main__")
    except SystemExit as end:
        assert not end.code, (script, end.code)
"""


@pytest.mark.slow
def test_every_script_explains_itself():
    """All in one process, which imports the learner once."""
    names = ("ppo", "evaluate", "transfer", "demo", "export", "sim2sim", "card")
    command = [sys.executable, "-c", HELP, *((ROOT / "train" / f"{name}.py").as_posix() for name in names)]
    run = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert run.returncode == 0, run.stderr
    for name in names:
        assert f"usage: {name}.py" in run.stdout


def test_training_warns_of_nothing(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train(job(tmp_path, 1500))
