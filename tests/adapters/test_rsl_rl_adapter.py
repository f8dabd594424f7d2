"""The rsl_rl adapter has the interface that its runner relies on."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rsl_rl")
import torch
from gymnasium.vector import AutoresetMode
from point_mass import ID, PointMassVectorEnv

import ce_gym
from ce_gym.adapters.rsl_rl import RslRlVecEnv, make_rsl_rl_vec_env

ROBOT_ENV = next(iter(ce_gym.environment_ids()))
NONE, FULL = torch.zeros(4, 1), torch.ones(4, 1)


@pytest.fixture
def envs():
    return make_rsl_rl_vec_env(ID, 4, seed=3, horizon=6)


def test_what_the_runner_reads(envs):
    assert (envs.num_envs, envs.num_actions, envs.max_episode_length) == (4, 1, 6)
    obs = envs.get_observations()
    assert obs.batch_size == torch.Size([4])
    assert {key: tuple(rows.shape) for key, rows in obs.items()} == {"policy": (4, 2)}
    assert envs.cfg["env"] == ID


def test_a_dictionary_is_groups():
    envs = make_rsl_rl_vec_env(ID, 4, obs_mode="dict")
    obs, *_ = envs.step(FULL)
    assert {key: rows.shape[1] for key, rows in obs.items()} == {"policy": 2, "critic": 3}


def test_time_out_is_told_apart_from_a_failure(envs):
    for _ in range(5):
        _, _, dones, extras = envs.step(FULL)
        assert not dones.any()
        assert not extras["log"]
    envs.envs.unwrapped.speed[0] = 5.0  # falls in the very step in which time runs out
    obs, rewards, dones, extras = envs.step(FULL)
    assert (rewards.dtype, dones.dtype) == (torch.float32, torch.bool)
    assert dones.all()
    assert extras["time_outs"].tolist() == [False, True, True, True]
    assert (obs["policy"][:, 0] == 0).all()  # the next episode has begun
    assert extras["log"]["/episode/length"] == 6
    assert envs.get_observations() is obs


def test_logs_are_means_of_ended_episodes_only(envs):
    envs.episode_length_buf = torch.tensor([5, 0, 0, 0])
    _, rewards, dones, extras = envs.step(NONE)
    assert dones.tolist() == [True, False, False, False]
    assert extras["log"]["/episode/return"] == pytest.approx(rewards[0].item())


def test_episode_lengths_can_be_spread(envs):
    envs.episode_length_buf = torch.tensor([5, 4, 0, 5])
    assert envs.episode_length_buf.tolist() == [5, 4, 0, 5]
    assert envs.step(NONE)[2].tolist() == [True, False, False, True]
    assert envs.episode_length_buf.tolist() == [0, 5, 1, 0]


def test_lengths_of_a_robots_episodes_can_be_spread():
    envs = make_rsl_rl_vec_env(ROBOT_ENV, 3, obs_mode="dict", critic=("base_height",))
    obs = envs.get_observations()
    kept = obs["policy"].clone()
    envs.episode_length_buf = torch.tensor([0, envs.max_episode_length - 1, 7])
    _, _, dones, extras = envs.step(torch.zeros(3, envs.num_actions))
    assert dones.tolist() == extras["time_outs"].tolist() == [False, True, False]
    assert envs.episode_length_buf.tolist() == [1, 0, 8]
    assert torch.equal(obs["policy"], kept)  # fresh arrays at every step


def test_it_refuses_an_environment_that_resets_one_step_later():
    with pytest.raises(ValueError, match="SAME_STEP"):
        RslRlVecEnv(PointMassVectorEnv(2, autoreset_mode=AutoresetMode.NEXT_STEP))


def test_same_seed_gives_the_same_start():
    first, again, other = (make_rsl_rl_vec_env(ID, 4, seed=s).get_observations()["policy"] for s in (1, 1, 2))
    assert torch.equal(first, again)
    assert not np.array_equal(first, other)
