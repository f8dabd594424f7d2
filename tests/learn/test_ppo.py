"""The learner of Stable-Baselines3 alone: seeds, schedules, costs of falls, its archive, and resuming bit for bit."""

import os
import pickle
import signal
import zipfile

import gymnasium
import numpy as np
import pytest
import torch
from point_mass import ID
from saved import load_learner
from toy import FAST, job

from ce_gym.__main__ import main
from ce_gym.learn.evaluation.evaluation import evaluate
from ce_gym.learn.learners.sb3 import SB3Learner, train
from ce_gym.policies import PolicyError, load_policy

ROBOT = "ce_gym/MiniCheetahVelocity-v0"
ADAPTED = ["num_envs=16", "epochs=1", "target_kl=0.01", "learning_rate=1e-3"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return train(job(tmp_path_factory.mktemp("run"), 512, settings=ADAPTED, algo="sb3")).policy


def learner(folder, *settings, **changes):
    task = job(folder, 1000, settings=settings, algo="sb3", **changes)
    envs = gymnasium.make_vec(
        ID, num_envs=task.settings.num_envs, vectorization_mode="vector_entry_point", **task.env_kwargs
    )
    return SB3Learner(envs, task)


def arrays_of(policy):
    """The state of the learner beside a policy; JSON as text."""
    with np.load(policy.with_suffix(".learner.npz"), allow_pickle=False) as arrays:
        return dict(arrays)


def test_seeds_differ_and_the_same_seed_trains_the_same_policy(tmp_path):
    runs = [train(job(tmp_path / f"{i}", 2000, seed=seed, algo="sb3")).policy for i, seed in enumerate((5, 5, 1))]
    first, again, other = ({k: x for k, x in arrays_of(run).items() if k.startswith("policy/")} for run in runs)
    for key, value in first.items():
        np.testing.assert_array_equal(value, again[key], err_msg=key)
    assert not np.array_equal(first["policy/action_net.weight"], other["policy/action_net.weight"])


def test_the_archive_is_that_of_stable_baselines3(trained):
    obs = np.random.default_rng(0).standard_normal((16, 2)).astype(np.float32)
    model, record = load_learner(trained)
    actions, expected = (policy.predict(obs, deterministic=True)[0] for policy in (load_policy(trained), model))
    np.testing.assert_allclose(actions, expected, atol=1e-6)
    assert model.num_timesteps == record["steps"] == 512
    assert record["learner"] == "sb3"
    assert {"stable_baselines3", "torch"} <= set(record["versions"])


def test_evaluation_is_repeatable_and_measures_speed_itself(trained):
    """The toy reports its own error; the evaluation's, measured from the state, must agree with it."""
    model = load_learner(trained)[0]
    result = evaluate(model, ID, episodes=32)
    assert result == evaluate(model, ID, episodes=32)
    # The toy counts the 50th step of each episode, whose state the evaluation no longer sees.
    assert result["forward_error"] == pytest.approx(result["metrics/velocity_error"], rel=0.05)


@pytest.mark.parametrize(("kl", "factor"), [(0.05, 1 / 1.5), (0.001, 1.5), (0.01, 1.0)])
def test_learning_rate_follows_the_divergence(kl, factor, tmp_path):
    ours = learner(tmp_path, *ADAPTED)
    ours.model.train = lambda: ours.model.logger.record("train/approx_kl", kl)
    ours.iterate()
    assert ours.rate == pytest.approx(1e-3 * factor)
    ours.iterate()
    assert ours.model.lr_schedule(1.0) == pytest.approx(1e-3 * factor)


def test_rate_entropy_noise_and_cost_of_falls_follow_their_schedules(tmp_path):
    settings = ["learning_rate=1e-2", "entropy=0.1", "final_entropy=0.2", "initial_std=0.4", "final_std=0.1"]
    ours = learner(tmp_path, *settings, "fall_cost=4")  # of 1000 steps
    ours.model.num_timesteps = 500
    ours.model.train = lambda: None
    ours.iterate()
    assert ours.model.lr_schedule(1.0) == pytest.approx(5e-3)
    assert ours.model.ent_coef == pytest.approx(0.15)
    assert ours.model.policy.log_std.exp().item() == pytest.approx(0.2)
    assert ours.episodes.fall_cost == pytest.approx(4 * 2 / 3)


def test_only_a_fall_has_a_cost(tmp_path):
    episodes = learner(tmp_path).episodes
    episodes.fall_cost = 2.0
    ends = [{"TimeLimit.truncated": late, "diverged": lost} for late, lost in [(0, 0), (1, 0), (0, 1), (0, 0)]]
    episodes.locals = {"rewards": np.ones(4), "dones": np.array([1, 1, 1, 0]), "infos": ends}
    episodes._on_step()
    np.testing.assert_allclose(episodes.locals["rewards"], [-1, 1, 1, 1])


def test_the_cost_of_falls_reaches_the_learner(tmp_path):
    """Two learners that differ in the cost alone: the rewards that they learn from differ where a robot fell."""
    rewards, falls = [], []
    for cost in (0.0, 7.0):
        ours = learner(tmp_path, "initial_std=5", "rollout=120")
        ours.episodes.fall_cost = cost
        step = ours.envs.step

        def watched(actions, step=step):
            *rest, terminated, truncated, infos = step(actions)
            falls.append(terminated & ~truncated & ~infos["diverged"])
            return *rest, terminated, truncated, infos

        ours.envs.step = watched
        ours.model.collect_rollouts(ours.adapter, ours.episodes, ours.model.rollout_buffer, 120)
        rewards.append(ours.model.rollout_buffer.rewards)
    assert 5 < np.sum(falls[:120]) < 500
    np.testing.assert_allclose(rewards[0] - rewards[1], 7.0 * np.array(falls[:120]), atol=1e-5)


def test_the_first_episodes_do_not_end_together(tmp_path):
    steps = learner(tmp_path).envs.unwrapped.elapsed_steps
    assert len(set(steps.tolist())) > 20
    assert 0 <= steps.min() <= steps.max() < 50


def test_a_critic_may_see_more(tmp_path):
    result = train(job(tmp_path, 30_000, env_kwargs={"obs_mode": "dict"}, algo="sb3"))
    assert evaluate(result.model, ID, episodes=16, obs_mode="dict")["forward_error"] < 0.2
    state = arrays_of(result.policy)
    assert state["policy/mlp_extractor.policy_net.0.weight"].shape == (16, 2)
    assert state["policy/mlp_extractor.value_net.0.weight"].shape == (16, 3)


@pytest.mark.slow
@pytest.mark.parametrize("obs_mode", ["vector", "dict"])
def test_interrupted_and_resumed_is_as_if_training_never_stopped(obs_mode, tmp_path):
    """On a robot, whose environments can be restored: the same bits, of the learner and of all environments."""
    options = {"env": ROBOT, "settings": ["num_envs=16", "rollout=24", "target_kl=0.01"], "algo": "sb3"}
    options["env_kwargs"] = {"obs_mode": obs_mode}
    whole = train(job(tmp_path / "whole", 6 * 384, **options))
    part = _stopped_after(3, job(tmp_path / "part", 6 * 384, **options))
    assert part.record["steps"] == 3 * 384
    assert not part.record["finished"]
    rest = train(job(tmp_path / "rest", 6 * 384, resume=part.policy, **options))
    expected, result = (arrays_of(run.policy) for run in (whole, rest))
    assert expected.keys() == result.keys()
    for name in expected.keys() - {"facts"}:  # has the wall times of episodes
        np.testing.assert_array_equal(expected[name], result[name], err_msg=name)
    assert {name.split("/")[0] for name in expected} >= {"policy", "optimizer", "env", "seen", "numpy", "torch"}
    assert rest.record["resumed_from"] == str(part.policy)


def _stopped_after(iterations, task):
    """Train, and press Ctrl-C in an iteration, which is finished first."""
    iterate, count = SB3Learner.iterate, iter(range(1, 1000))

    def interrupting(ours):
        if next(count) == iterations:
            os.kill(os.getpid(), signal.SIGINT)
        return iterate(ours)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SB3Learner, "iterate", interrupting)
        result = train(task)
    assert result.interrupted
    return result


def test_resuming_restores_all_that_learning_changes(trained, tmp_path):
    theirs, record = load_learner(trained)
    ours = learner(tmp_path, *ADAPTED, seed=3)
    ours.restore(arrays_of(trained))
    assert ours.steps == record["steps"] == 512
    assert ours.rate != 1e-3
    for key, value in theirs.policy.state_dict().items():
        assert torch.equal(ours.model.policy.state_dict()[key], value), key
    mine, other = (model.policy.optimizer.state_dict()["state"] for model in (ours.model, theirs))
    assert mine.keys() == other.keys() != set()
    for i, state in other.items():
        assert state["step"] > 0
        assert all(torch.equal(mine[i][key], state[key]) for key in state)


def test_resuming_goes_on_with_environment_and_settings_of_the_run(trained, tmp_path, capsys):
    brief = ["--episodes", "4", "--threads", "1", "--logs"]
    assert main(["train", "--resume", str(trained.parent), "--steps", "1024", "--out", str(tmp_path), *brief]) == 0
    assert "forward speed error" in capsys.readouterr().out
    record = load_policy(tmp_path).record
    assert (record["env"], record["learner"]) == (ID, "sb3")
    assert record["settings"] == load_policy(trained).record["settings"] | {"steps": 1024}


def test_nothing_is_left_to_learn(trained, tmp_path):
    done = train(job(tmp_path, 512, settings=ADAPTED, resume=trained, algo="sb3"))
    assert done.record["steps"] == 512
    state, before = arrays_of(done.policy), arrays_of(trained)
    np.testing.assert_array_equal(state["policy/action_net.weight"], before["policy/action_net.weight"])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("hidden=[8]", "expected .*8, 2"),
        ("hidden=[16, 16]", "expected .*16, 16"),
        ("activation=ReLU", "expected .*ReLU"),
    ],
)
def test_resuming_with_another_network_is_refused(trained, tmp_path, change, words):
    with pytest.raises(PolicyError, match=f"training cannot continue: has layers .*Tanh'.*{words}"):
        train(job(tmp_path / "out", 1024, settings=[*ADAPTED, change], resume=trained, algo="sb3"))
    assert not list(tmp_path.rglob("policy*"))


def test_resuming_runs_no_code_of_a_file(trained, tmp_path):
    """Pickled objects are not made: `PPO.load` and `np.load` with pickles would make these folders."""

    class Trap:
        def __init__(self, name):
            self.folder = tmp_path / name

        def __reduce__(self):
            return os.mkdir, (str(self.folder),)

    policy = tmp_path / "run" / "policy.zip"
    policy.parent.mkdir()
    for suffix in (".json", ".learner.npz"):
        policy.with_suffix(suffix).write_bytes(trained.with_suffix(suffix).read_bytes())
    with zipfile.ZipFile(trained) as old, zipfile.ZipFile(policy, "w") as new:
        for name in old.namelist():
            new.writestr(name, pickle.dumps(Trap("zip")) if name == "policy.optimizer.pth" else old.read(name))
    train(job(tmp_path / "out", 1024, settings=ADAPTED, resume=policy, algo="sb3"))
    np.savez(policy.with_suffix(".learner.npz"), **arrays_of(trained) | {"numpy": np.array([Trap("npz")], object)})
    with pytest.raises(PolicyError, match="training cannot continue"):
        train(job(tmp_path / "out", 1024, settings=ADAPTED, resume=policy, algo="sb3"))
    assert not (tmp_path / "zip").exists()
    assert not (tmp_path / "npz").exists()


def test_the_command_trains_every_seed(tmp_path):
    argv = ["train", ID, "--algo", "sb3", "--steps", "2000", "--seeds", "5", "1", "--out", str(tmp_path), *FAST]
    assert main(argv) == 0
    policies = [load_policy(tmp_path / f"seed_{seed}") for seed in (5, 1)]
    assert [policy.record["seed"] for policy in policies] == [5, 1]
