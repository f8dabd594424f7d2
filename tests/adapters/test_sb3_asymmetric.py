"""Dictionaries of observations reach Stable-Baselines3, and the critic sees more than the actor."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from point_mass import ID
from stable_baselines3 import PPO

import ce_gym
from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.adapters.sb3_asymmetric import AsymmetricPolicy

ROBOT_ENV = next(iter(ce_gym.environment_ids()))
SMALL = {"n_steps": 16, "batch_size": 128, "n_epochs": 4, "learning_rate": 1e-2, "gamma": 0.9, "device": "cpu"}


@pytest.fixture(autouse=True)
def _one_thread():
    """Torch's threads on networks of this size only get in each other's way."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def toy(num_envs=16, **kwargs):
    return make_sb3_vec_env(ID, num_envs, seed=1, obs_mode="dict", **kwargs)


def test_an_ended_episode_shows_its_last_dictionary():
    envs = toy(4, horizon=3)
    obs = envs.reset()
    assert {key: rows.shape for key, rows in obs.items()} == {"policy": (4, 2), "critic": (4, 3)}
    commands = obs["policy"][:, 1]
    for _ in range(3):
        obs, _, dones, infos = envs.step(np.ones((4, 1), np.float32))
    assert dones.all()
    last = infos[2]["terminal_observation"]
    assert last["policy"][1] == commands[2] != commands[0]
    assert last["policy"][0] == pytest.approx(0.6)
    assert last["critic"][2] == pytest.approx(1.0)
    assert obs["critic"][2, 2] == 0.0


def test_the_learners_own_policy_for_dictionaries_trains():
    PPO("MultiInputPolicy", toy(horizon=10), **SMALL, seed=0).learn(1000)


def test_it_learns_and_is_saved(tmp_path):
    model = PPO(AsymmetricPolicy, toy(64), policy_kwargs={"net_arch": [16]}, **SMALL, seed=0)
    model.learn(30_000)
    model.save(tmp_path / "policy.zip")
    saved = PPO.load(tmp_path / "policy.zip", device="cpu")
    envs = toy(64)
    obs, errors = envs.reset(), []
    for _ in range(49):
        action, _ = saved.predict(obs, deterministic=True)
        np.testing.assert_array_equal(action, model.predict(obs, deterministic=True)[0])
        obs, _, _, _ = envs.step(action)
        errors.append(np.abs(obs["policy"][:, 0] - obs["policy"][:, 1]))
    assert np.mean(errors[10:]) < 0.15  # an untrained one is off by half a unit


def test_each_sees_its_own_part():
    model = PPO(AsymmetricPolicy, toy(), policy_kwargs={"net_arch": {"pi": [8], "vf": [32, 4]}}, **SMALL, seed=0)
    policy = model.policy
    assert policy.mlp_extractor.policy_net[0].in_features == 2
    assert policy.mlp_extractor.value_net[0].in_features == 3
    one = {"policy": torch.zeros(1, 2), "critic": torch.zeros(1, 3)}
    other_critic, other_actor = one | {"critic": torch.ones(1, 3)}, one | {"policy": torch.ones(1, 2)}
    for given, changes in ((other_critic, (False, True)), (other_actor, (True, False))):
        mean = [policy.get_distribution(obs).distribution.mean for obs in (one, given)]
        value = [policy.predict_values(obs) for obs in (one, given)]
        assert (not torch.equal(*mean), not torch.equal(*value)) == changes
        forward = policy(given, deterministic=True)
        torch.testing.assert_close((forward[0], forward[1]), (mean[1], value[1]))


def test_every_layer_is_initialised_and_learns():
    model = PPO(AsymmetricPolicy, toy(), **SMALL, seed=0)
    before = {name: p.detach().clone() for name, p in model.policy.named_parameters()}
    assert before["mlp_extractor.value_net.0.bias"].abs().max() == 0.0  # Stable-Baselines3's own initialisation
    model.learn(16 * 16)
    assert all(not torch.equal(p, before[name]) for name, p in model.policy.named_parameters())


def test_a_vector_is_refused_in_one_line():
    with pytest.raises(ValueError, match="obs_mode='dict'"):
        PPO(AsymmetricPolicy, make_sb3_vec_env(ID, 4), device="cpu")


def test_a_robots_critic_sees_contact_forces():
    envs = make_sb3_vec_env(ROBOT_ENV, 32, obs_mode="dict", critic=("contact_forces", "base_height"))
    actor, critic = (envs.observation_space[key].shape[0] for key in ("policy", "critic"))
    assert critic == actor + len(envs.get_attr("contact_names")[0]) + 1
    model = PPO(AsymmetricPolicy, envs, n_steps=8, batch_size=64, n_epochs=1, device="cpu", seed=0)
    model.learn(8 * 32)
    assert np.isfinite(model.rollout_buffer.returns).all()
