"""The compiled PPO alone: the same bits on any number of threads and when resumed, costs of falls, noise."""

import json
import os
import signal
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from point_mass import ID
from toy import job, parameters

from ce_gym.learn.evaluation.evaluation import evaluate
from ce_gym.learn.learners.ppo import PPO, train
from ce_gym.learn.networks.perceptron import parameter_count
from ce_gym.learn.runs.job import acting_environment
from ce_gym.learn.runs.progress import fall_cost, read_curve
from ce_gym.learn.runs.settings import SettingsError
from ce_gym.policies import PolicyError

ROBOT = "ce_gym/MiniCheetahVelocity-v0"


def test_training_does_not_change_what_a_policy_sees(tmp_path):
    other = SimpleNamespace(single_observation_space=gymnasium.spaces.Box(-1, 1, (5,)))
    with pytest.raises(SettingsError, match=r"training: single_observation_space is .*expected"):
        acting_environment(job(tmp_path, 1, settings=["training={history: 2}"]), other)


def test_a_seed_gives_the_same_bits_on_any_number_of_threads(tmp_path):
    runs = [(5, 2), (5, 1), (5, 3), (0, 2)]
    policies = [train(job(tmp_path / f"{i}", 3000, seed=s, threads=n)).policy for i, (s, n) in enumerate(runs)]
    first, *same, other = map(parameters, policies)
    for found in same:
        np.testing.assert_array_equal(first, found)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize("threads", [1, 3, 20])
def test_every_observation_of_a_large_batch_has_its_output(tmp_path, threads):
    """Also on more threads than a minibatch has parts."""
    envs = gymnasium.make_vec(ID, num_envs=64, vectorization_mode="vector_entry_point")
    learner = PPO(envs, job(tmp_path, 100, settings=["hidden=[64]"], threads=threads))
    observations = np.random.default_rng(threads).standard_normal((2003, 2)).astype(np.float32)
    assert observations.shape[0] * len(learner.policy.theta) > 4e6
    found = learner.run(learner.policy, observations)
    np.testing.assert_allclose(found, learner.actor()(observations), atol=1e-6)


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
    iterate, count = PPO.iterate, iter(range(1, 1000))

    def interrupting(learner):
        if next(count) == iterations:
            os.kill(os.getpid(), signal.SIGINT)
        return iterate(learner)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PPO, "iterate", interrupting)
        result = train(task)
    assert result.interrupted
    return result


def test_a_critic_may_see_more_and_the_noise_ends_at_its_setting(tmp_path):
    result = train(job(tmp_path, 30_000, settings=["final_std=0.05"], env_kwargs={"obs_mode": "dict"}))
    assert evaluate(result.model, ID, episodes=16, obs_mode="dict")["forward_error"] < 0.2
    with np.load(result.policy.with_suffix(".learner.npz")) as arrays:
        facts, theta = json.loads(str(arrays["facts"])), arrays["theta"]
    assert facts["sizes"] == [[2, 16, 1], [3, 16, 1]]
    log_std = theta[parameter_count(facts["sizes"][0])]
    assert np.exp(log_std) == pytest.approx(0.05, rel=0.2)  # the last update may still change it


def test_a_fall_has_its_cost_and_a_time_out_has_none(tmp_path):
    """Two learners that differ in the cost alone: their rewards differ by it where an episode failed."""
    rewards, fallen = [], []
    for cost in (0, 7):
        envs = gymnasium.make_vec(ID, num_envs=64, vectorization_mode="vector_entry_point")
        task = job(tmp_path, 30_000, settings=["initial_std=5", "rollout=120", f"fall_cost={cost}"])
        learner, step = PPO(envs, task), envs.step

        def watched(actions, step=step):
            *seen, terminated, truncated, infos = step(actions)
            fallen.append(terminated & ~truncated)
            return *seen, terminated, truncated, infos

        envs.step = watched
        learner.collect(1.0)
        rewards.append(learner.rewards)
        assert (learner.dones & ~np.array(fallen[-120:])).any()  # time was up for some
    fallen = np.array(fallen[:120])
    assert 5 < fallen.sum() < 500
    np.testing.assert_allclose(rewards[0] - rewards[1], 7.0 * fallen, atol=1e-5)


def test_falls_cost_nothing_at_first():
    assert [fall_cost(4.0, done) for done in (0.0, 0.3, 0.45, 0.6, 1.0)] == pytest.approx([0, 0, 2, 4, 4])


def test_episodes_do_not_all_end_together(tmp_path):
    envs = gymnasium.make_vec(ID, num_envs=64, vectorization_mode="vector_entry_point")
    PPO(envs, job(tmp_path, 100))
    assert len(set(envs.unwrapped.elapsed_steps.tolist())) > 20
    assert 0 <= envs.unwrapped.elapsed_steps.min() <= envs.unwrapped.elapsed_steps.max() < 50


def test_a_policy_that_cannot_be_resumed_is_refused_in_one_line(tmp_path):
    trained = train(job(tmp_path / "run", 1024)).policy
    with pytest.raises(PolicyError, match=r"has layers \[2, 16, 1\], Tanh; expected \[2, 8, 1\], Tanh"):
        train(job(tmp_path, 2048, settings=["hidden=[8]"], resume=trained))
    state = trained.with_suffix(".learner.npz")
    whole = state.read_bytes()
    state.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(PolicyError, match=r"policy\.learner\.npz: training cannot continue"):
        train(job(tmp_path / "out", 2048, resume=trained))
    state.unlink()
    with pytest.raises(PolicyError, match=r"policy\.learner\.npz: no such file"):
        train(job(tmp_path / "out", 2048, resume=trained))
