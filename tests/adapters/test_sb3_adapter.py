"""The Stable-Baselines3 adapter has the interface that the learner relies on."""

import subprocess
import sys
import warnings

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from point_mass import ID, PointMassVectorEnv
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor

from ce_gym.adapters.sb3 import SB3VecEnv, make_sb3_vec_env

NONE = np.zeros((4, 1), np.float32)
FULL = np.ones((4, 1), np.float32)


@pytest.fixture
def envs():
    made = make_sb3_vec_env(ID, 4, seed=3, horizon=6)
    made.reset()
    return made


def test_spaces_are_those_of_one_environment(envs):
    assert envs.num_envs == 4
    assert envs.observation_space.shape == (2,)
    assert envs.action_space.shape == (1,)


def test_running_environments_share_one_empty_info(envs):
    _, rewards, dones, infos = envs.step(NONE)
    assert rewards.dtype == np.float32
    assert dones.dtype == bool
    assert infos[0] == {}
    assert all(info is infos[0] for info in infos)


def test_time_out_is_truncation_with_the_last_observation(envs):
    for _ in range(5):
        before, _, dones, _ = envs.step(FULL)
        assert not dones.any()
    obs, _, dones, infos = envs.step(FULL)
    assert dones.all()
    for i, info in enumerate(infos):
        assert info["TimeLimit.truncated"] is True
        assert info["terminal_observation"][0] == pytest.approx(before[i, 0] + 0.2, abs=1e-6)  # one more push
        assert obs[i, 0] == 0.0  # the next episode starts at rest
        assert info["episode"]["l"] == 6
        assert info["episode"]["reward/speed"] == pytest.approx(info["episode"]["r"])
        assert "t" in info["episode"]
    assert infos[0] is not infos[1]


def test_episode_entries_are_sums_but_metrics_are_means(envs):
    envs.envs.command[:] = 0.5
    for _ in range(6):
        _, _, _, infos = envs.step(NONE)
    episode = infos[0]["episode"]
    assert episode["r"] == pytest.approx(6 * 0.75)
    assert episode["metrics/velocity_error"] == pytest.approx(0.5)


def test_entries_of_gymnasiums_own_statistics_are_understood():
    wrapped = RecordEpisodeStatistics(PointMassVectorEnv(4, horizon=6, standard=True))
    envs = SB3VecEnv(wrapped)
    envs.reset()
    for _ in range(6):
        _, _, _, infos = envs.step(NONE)
    assert infos[0]["episode"]["l"] == 6


def test_a_fall_is_not_a_truncation():
    envs = make_sb3_vec_env(ID, 4, horizon=100)
    envs.reset()
    while True:
        _, _, dones, infos = envs.step(FULL)
        if dones.any():
            break
    assert dones.all()
    assert not any(info["TimeLimit.truncated"] for info in infos)


def test_only_ended_environments_get_their_own_info(envs):
    envs.envs.clock[2] = 5
    _, _, dones, infos = envs.step(NONE)
    assert dones.tolist() == [False, False, True, False]
    assert [bool(info) for info in infos] == [False, False, True, False]


def test_arrays_are_fresh_at_every_step(envs):
    first = envs.step(FULL)
    kept = [array.copy() for array in first[:3]]
    first[1][:] += 0.0
    second = envs.step(FULL)
    for array, copy, after in zip(first[:3], kept, second[:3], strict=True):
        assert not np.shares_memory(array, after)
        np.testing.assert_array_equal(array, copy)


def test_same_seed_gives_the_same_start(envs):
    envs.seed(11)
    first = envs.reset()
    envs.seed(11)
    np.testing.assert_array_equal(first, envs.reset())
    envs.seed(12)
    assert not np.array_equal(first, envs.reset())


def test_options_reach_the_next_reset_only(envs):
    envs.set_options({"command": (0.25, 0.0, 0.0)})
    assert np.all(envs.reset()[:, 1] == 0.25)
    assert not np.all(envs.reset()[:, 1] == 0.25)


def test_attributes_and_methods_of_the_batch(envs):
    assert envs.get_attr("horizon") == [6] * 4
    assert envs.get_attr("horizon", indices=[0, 2]) == [6] * 2
    envs.set_attr("horizon", 9)
    assert envs.get_attr("horizon", indices=0) == [9]
    assert envs.env_method("state")[0]["command"].shape == (4, 3)
    with pytest.raises(ValueError, match="indices"):
        envs.set_attr("horizon", 1, indices=[0])
    with pytest.raises(AttributeError):
        envs.get_attr("no_such_thing")


def test_it_refuses_an_environment_that_resets_one_step_later():
    with pytest.raises(ValueError, match="SAME_STEP"):
        SB3VecEnv(PointMassVectorEnv(2, autoreset_mode=AutoresetMode.NEXT_STEP))


def test_evaluation_needs_no_monitor_and_counts_whole_episodes(envs):
    assert envs.env_is_wrapped(Monitor) == [True] * 4
    assert envs.env_is_wrapped(VecMonitor, indices=[0]) == [False]
    model = PPO("MlpPolicy", envs, n_steps=8, batch_size=16, device="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, lengths = evaluate_policy(model, envs, n_eval_episodes=4, return_episode_rewards=True)
    assert lengths == [6] * 4


def test_the_learner_stores_what_it_saw(envs):
    """A reused observation buffer would fill the rollout with copies of the last step."""
    model = PPO("MlpPolicy", envs, n_steps=5, batch_size=20, n_epochs=1, device="cpu", seed=0)
    model.learn(20)
    stored = model.rollout_buffer.observations.reshape(4, 5, 2).swapaxes(0, 1)  # swapped and flattened by training
    actions = np.clip(model.rollout_buffer.actions.reshape(4, 5).swapaxes(0, 1), -1, 1)
    np.testing.assert_allclose(np.diff(stored[:, :, 0], axis=0), 0.2 * actions[:-1], atol=1e-6)


def test_the_package_does_not_import_the_learner():
    code = "import sys, ce_gym, ce_gym.adapters; assert not {'torch', 'stable_baselines3'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
