"""The fast learner: it learns, repeats itself, goes on where it stopped, and shares the reference's ways."""

import csv
import json
import os
import shlex
import signal
import sys
import threading
import time
import warnings
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from callbacks import FallCost
from card import command
from evaluate import evaluate
from evaluate import main as evaluate_main
from fast_ppo import FastPPO, main, train
from job import Job, acting_environment, jobs, parser
from point_mass import ID
from ppo import train as reference_train
from progress import fall_cost, read_curve
from settings import SettingsError, config_file, load_settings

from ce_gym.policies import PolicyError, load_policy

SMALL = ["num_envs=64", "rollout=16", "hidden=[16]", "epochs=4", "minibatches=2", "learning_rate=1e-2", "target_kl=0"]
SMALL += ["gamma=0.9", "training={}"]
FAST = ["--episodes", "8", "--threads", "1", "--set", *SMALL]
ROBOT = "ce_gym/MiniCheetahVelocity-v0"


def job(out, steps, env=ID, settings=(), **changes):
    chosen = load_settings(config_file(env), [*SMALL, f"steps={steps}", *settings])
    return Job(env, chosen, out, **({"env_kwargs": {}} | changes))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return train(job(tmp_path_factory.mktemp("run"), 30_000))


def parameters(policy):
    with np.load(policy.with_suffix(".learner.npz"), allow_pickle=False) as arrays:
        return arrays["theta"]


@pytest.mark.slow
def test_it_learns_as_the_reference_does(trained, tmp_path):
    reference = reference_train(job(tmp_path, 30_000, tensorboard=False))
    ours, theirs = (evaluate(run.model, ID, episodes=32) for run in (trained, reference))
    assert ours["forward_error"] < 0.1
    assert ours["reward"] == pytest.approx(theirs["reward"], abs=1.0)  # of 50
    assert ours["falls"] == 0.0


@pytest.mark.parametrize("learn", [train, reference_train])
def test_without_a_target_the_rate_falls_linearly(learn, tmp_path):
    learn(job(tmp_path, 10 * 1024, tensorboard=False))
    with (tmp_path / "progress.csv").open(newline="") as lines:
        found = [row["train/learning_rate"] for row in csv.DictReader(lines)]
    rates = [float(rate) for rate in found if rate]  # the reference logs an update with the next rollout
    assert len(rates) >= 9
    np.testing.assert_allclose(np.diff(rates), -1e-3, rtol=1e-4)
    assert 0 <= rates[-1] <= 1e-3 * (1 + 1e-6)


def test_the_policy_file_is_the_trained_policy(trained):
    obs = np.random.default_rng(0).standard_normal((16, 2)).astype(np.float32)
    saved = load_policy(trained.policy.parent)
    np.testing.assert_array_equal(saved.predict(obs)[0], trained.model.predict(obs)[0])
    written = json.loads(trained.policy.with_suffix(".json").read_text())
    assert written == saved.record == json.loads(json.dumps(trained.record))
    assert evaluate_main([str(trained.policy), "--episodes", "4"]) == 0


def test_the_record_has_the_keys_of_the_reference(trained, tmp_path):
    reference = reference_train(job(tmp_path, 1000, tensorboard=False))
    assert set(reference.record) <= set(trained.record)
    assert trained.record["steps"] >= 30_000
    assert trained.record["finished"]
    log = (trained.policy.parent / "progress.csv").read_text().splitlines()[0].split(",")
    assert {"reward/speed", "metrics/velocity_error", "rollout/ep_rew_mean", "train/approx_kl"} <= set(log)


def test_the_command_on_its_card_repeats_it(trained):
    record = load_policy(trained.policy).record
    words = shlex.split(command(record))
    assert words[:2] == ["python", "train/fast_ppo.py"]
    (again,) = jobs(parser().parse_args(words[2:]), folder="-fast")
    assert json.loads(json.dumps(again.settings.as_dict())) == record["settings"]
    assert again.out.name.endswith("-fast")


@pytest.mark.slow
@pytest.mark.parametrize("learn", [train, reference_train])
def test_what_is_for_training_only_is_no_part_of_the_policy(learn, tmp_path):
    given = {"dt": 0.004, "max_episode_steps": 7}
    settings = ["num_envs=16", f"training={json.dumps(given)}"]
    record = load_policy(learn(job(tmp_path, 2 * 256, ROBOT, settings, tensorboard=False)).policy).record
    assert read_curve(tmp_path / "curve.csv")[-1]["length"] <= 7
    assert (record["env_kwargs"], record["policy_spec"]["physics_dt"]) == ({}, 0.005)
    (again,) = jobs(parser().parse_args(shlex.split(command(record))[2:]))
    assert again.settings.training == record["settings"]["training"] == given


def test_training_does_not_change_what_a_policy_sees(tmp_path):
    other = SimpleNamespace(single_observation_space=gymnasium.spaces.Box(-1, 1, (5,)))
    with pytest.raises(SettingsError, match=r"training: single_observation_space is .*expected"):
        acting_environment(job(tmp_path, 1, settings=["training={history: 2}"]), other)


def test_checkpoints_are_policies(trained):
    folder = trained.policy.parent / "checkpoints"
    checkpoints = sorted(path for path in folder.glob("*.npz") if not path.name.endswith(".learner.npz"))
    assert len(checkpoints) >= 5
    assert load_policy(checkpoints[0]).record["steps"] < 30_000
    assert not list(folder.parent.rglob(".*"))


@pytest.mark.parametrize("threads", [1, 3])
def test_a_seed_gives_the_same_bits_on_any_number_of_threads(threads, tmp_path):
    first, second = (train(job(tmp_path / str(n), 5000, seed=5, threads=n)).policy for n in (2, threads))
    np.testing.assert_array_equal(parameters(first), parameters(second))


def test_seeds_differ(tmp_path):
    first, second = (train(job(tmp_path / str(seed), 2000, seed=seed)).policy for seed in (0, 1))
    assert not np.array_equal(parameters(first), parameters(second))


@pytest.mark.slow
def test_interrupted_and_resumed_is_as_if_it_never_stopped(tmp_path):
    """On a robot, whose environments can be restored: the same bits, of the policy and of all that is reported."""
    options = {"env": ROBOT, "settings": ["num_envs=16", "rollout=24", "target_kl=0.01", "final_entropy=0"]}
    whole = train(job(tmp_path / "whole", 6 * 384, **options))
    part = _stopped_after(3, job(tmp_path / "part", 6 * 384, **options))
    assert part.record["steps"] == 3 * 384
    assert not part.record["finished"]
    rest = train(job(tmp_path / "rest", 6 * 384, resume=part.policy, **options))
    np.testing.assert_array_equal(parameters(whole.policy), parameters(rest.policy))
    curves = [read_curve(run.policy.parent / "curve.csv") for run in (whole, rest)]
    assert [{**row, "seconds": 0} for row in curves[0]] == [{**row, "seconds": 0} for row in curves[1]]
    assert rest.record["resumed_from"] == str(part.policy)


def _stopped_after(iterations, task):
    """Train, and press Ctrl-C in an iteration; it is finished first."""
    iterate, count = FastPPO.iterate, iter(range(1, 1000))

    def interrupting(learner):
        if next(count) == iterations:
            os.kill(os.getpid(), signal.SIGINT)
        return iterate(learner)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FastPPO, "iterate", interrupting)
        result = train(task)
    assert result.interrupted
    return result


def test_environments_that_cannot_be_restored_begin_anew(trained, tmp_path):
    again = train(job(tmp_path, 36_000, resume=trained.policy))
    assert 36_000 <= again.record["steps"] < 38_000
    assert evaluate(again.model, ID, episodes=16)["forward_error"] < 0.2
    before = read_curve(trained.policy.parent / "curve.csv")
    assert read_curve(tmp_path / "curve.csv")[: len(before)] == before


def test_ctrl_c_says_how_to_go_on(tmp_path, capsys):
    before = signal.getsignal(signal.SIGINT)

    def interrupt_once_training_runs() -> None:
        while signal.getsignal(signal.SIGINT) is before:
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt_once_training_runs, daemon=True).start()
    assert main(["--env", ID, "--steps", "1e9", "--out", str(tmp_path), *FAST]) == 130
    said = capsys.readouterr().out
    assert f"python train/fast_ppo.py --resume {tmp_path / 'policy.npz'}" in said


def test_the_deadline_stops_training_and_saves(tmp_path):
    result = train(job(tmp_path, 10**9, seconds=0.5))
    assert 0 < result.record["steps"] < 10**9
    assert result.policy.exists()


def test_a_critic_may_see_more(tmp_path):
    result = train(job(tmp_path, 30_000, env_kwargs={"obs_mode": "dict"}))
    assert evaluate(result.model, ID, episodes=16, obs_mode="dict")["forward_error"] < 0.2


def test_a_fall_costs_what_it_shall_and_reaching_the_end_of_time_nothing(tmp_path):
    """Two learners alike but for that: their rewards differ by the cost, where an episode failed, and nowhere else."""
    wide = job(tmp_path, 30_000, settings=["initial_std=5", "rollout=120"])
    rewards, fallen = [], []
    for cost in (0.0, 7.0):
        envs = gymnasium.make_vec(ID, num_envs=64, vectorization_mode="vector_entry_point")
        learner, step = FastPPO(envs, wide), envs.step

        def watched(actions, step=step):
            *seen, terminated, truncated, infos = step(actions)
            fallen.append(terminated & ~truncated)
            return *seen, terminated, truncated, infos

        envs.step = watched
        learner.collect(cost)
        rewards.append(learner.rewards)
        assert (learner.dones & ~np.array(fallen[-120:])).any()  # time was up for some
    fallen = np.array(fallen[:120])
    assert 5 < fallen.sum() < 500
    np.testing.assert_allclose(rewards[0] - rewards[1], 7.0 * fallen, atol=1e-5)


def test_the_reference_counts_falls_alike():
    callback = FallCost(4.0, steps=1000)
    callback.num_timesteps = 450
    callback._on_rollout_start()
    ends = [{"TimeLimit.truncated": late, "diverged": lost} for late, lost in [(0, 0), (1, 0), (0, 1), (0, 0)]]
    callback.locals = {"rewards": np.ones(4), "dones": np.array([1, 1, 1, 0]), "infos": ends}
    callback._on_step()
    np.testing.assert_allclose(callback.locals["rewards"], [-1, 1, 1, 1])


def test_falls_cost_nothing_at_first():
    assert [fall_cost(4.0, done) for done in (0.0, 0.3, 0.45, 0.6, 1.0)] == pytest.approx([0, 0, 2, 4, 4])


def test_episodes_do_not_all_end_together(tmp_path):
    envs = gymnasium.make_vec(ID, num_envs=64, vectorization_mode="vector_entry_point")
    FastPPO(envs, job(tmp_path, 100))
    assert len(set(envs.unwrapped.elapsed_steps.tolist())) > 20
    assert 0 <= envs.unwrapped.elapsed_steps.min() <= envs.unwrapped.elapsed_steps.max() < 50


def test_the_noise_ends_where_it_shall(tmp_path):
    result = train(job(tmp_path, 30_000, settings=["final_std=0.05"]))
    with np.load(result.policy.with_suffix(".learner.npz")) as arrays:
        facts, theta = json.loads(str(arrays["facts"])), arrays["theta"]
    assert facts["sizes"] == [[2, 16, 1], [2, 16, 1]]
    actor = (2 + 1) * 16 + (16 + 1) * 16
    assert np.exp(theta[actor]) == pytest.approx(0.05, rel=0.2)  # the last update may still change it


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--env", ID, "--set", "gamma=x"], "gamma: 'x'"),
        (["--env", "nobody/Nothing-v0"], "nobody"),
        (["--resume", "missing.npz"], "missing.npz"),
        ([], "--env: missing"),
    ],
)
def test_bad_input_is_one_line(argv, words, tmp_path, capsys):
    assert main([*argv, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err.strip()
    assert words in error
    assert "\n" not in error
    assert error.startswith("fast_ppo.py: ")


def test_what_cannot_be_gone_on_from_is_one_line(trained, tmp_path):
    with pytest.raises(PolicyError, match=r"has layers \[2, 16, 1\], Tanh; expected \[2, 8, 1\], Tanh"):
        train(job(tmp_path, 60_000, settings=["hidden=[8]"], resume=trained.policy))
    for name in ("policy.npz", "policy.json"):
        (tmp_path / name).write_bytes((trained.policy.parent / name).read_bytes())
    with pytest.raises(PolicyError, match=r"policy\.learner\.npz: no such file"):
        train(job(tmp_path / "out", 60_000, resume=tmp_path / "policy.npz"))
    whole = (trained.policy.parent / "policy.learner.npz").read_bytes()
    (tmp_path / "policy.learner.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(PolicyError, match=r"policy\.learner\.npz: cannot be gone on from"):
        train(job(tmp_path / "out", 60_000, resume=tmp_path / "policy.npz"))


def test_training_warns_of_nothing(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train(job(tmp_path, 1500))


def test_without_its_extra_it_says_so_in_one_line(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    for name in ("networks", "loops", "fast_ppo"):
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(SystemExit, match=r"^2$"):
        import fast_ppo  # noqa: F401
    assert capsys.readouterr().err == ('fast_ppo.py: needs numba, which is not installed: pip install "ce_gym[fast]"\n')
