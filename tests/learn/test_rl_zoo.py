"""The settings for RL Zoo are understood by the learner and equal our own settings files."""

from pathlib import Path

import pytest
import yaml
from point_mass import ID
from stable_baselines3 import PPO
from torch import nn

import ce_gym
from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.learn.runs.settings import config_file, load_settings

ZOO = yaml.safe_load((Path(__file__).parents[2] / "train" / "rl_zoo.yml").read_text(encoding="utf-8"))
OF_THE_ZOO = ("n_envs", "n_timesteps")


@pytest.mark.parametrize("env_id", [key for key in ZOO if key != "default"])
def test_the_learner_takes_them(env_id):
    assert env_id in ce_gym.environment_ids()
    given = {key: value for key, value in ZOO[env_id].items() if key not in OF_THE_ZOO}
    network = eval(given.pop("policy_kwargs"), {"nn": nn})  # as the Zoo does
    schedule, rate = given.pop("learning_rate").split("_")
    assert schedule == "lin"
    envs = make_sb3_vec_env(ID, ZOO[env_id]["n_envs"])
    model = PPO(env=envs, learning_rate=float(rate), policy_kwargs=network, device="cpu", **given)
    ours = load_settings(config_file(env_id))
    assert (model.gamma, float(rate), ZOO[env_id]["n_timesteps"]) == (ours.gamma, ours.learning_rate, ours.steps)
    assert model.n_steps * envs.num_envs == ours.num_envs * ours.rollout
    assert model.batch_size * ours.minibatches == ours.num_envs * ours.rollout
    assert (model.n_epochs, model.ent_coef, model.gae_lambda) == (ours.epochs, ours.entropy, ours.gae_lambda)
    assert tuple(network["net_arch"]) == ours.hidden
    assert model.policy.log_std.exp().mean().item() == pytest.approx(ours.initial_std, rel=0.01)
