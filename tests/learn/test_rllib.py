"""RLlib steps our environments natively and learns on them; runs where Ray is installed (docs/how-to/learners.md)."""

import numpy as np
import pytest

pytest.importorskip("ray")
import torch
from rllib import actor_of, algorithm, set_initial_std, train

import ce_gym
from ce_gym.envs.vector import LeggedVectorEnv
from ce_gym.learn.runs.settings import SettingsError, config_file, load_settings

ROBOT_ENV = next(iter(ce_gym.environment_ids()))
SMALL = ["num_envs=8", "rollout=16", "minibatches=2", "epochs=1", "hidden=[8, 4]", "training={}"]


@pytest.mark.slow
def test_it_steps_natively_and_the_actor_is_its_own():
    settings = load_settings(config_file(ROBOT_ENV), SMALL)
    algo = algorithm(ROBOT_ENV, settings, runners=0, num_threads=1)
    set_initial_std(algo, 0.25)
    runner = algo.env_runner
    assert isinstance(runner.env.unwrapped, LeggedVectorEnv)
    before = actor_of(algo, "Tanh")
    np.testing.assert_allclose(runner.module.get_state()["pi.log_std"], np.log(0.25), rtol=1e-5)
    assert train(algo, 200, 60.0) >= 200
    actor = actor_of(algo, "Tanh")
    assert not torch.equal(before.layers[0][0], actor.layers[0][0])
    obs = np.random.default_rng(0).standard_normal((5, 48)).astype(np.float32)
    module = algo.get_module()
    mean = module.forward_inference({"obs": torch.from_numpy(obs)})["action_dist_inputs"][:, :12].detach().numpy()
    np.testing.assert_allclose(actor(obs), np.clip(mean, -1, 1), atol=1e-6)
    algo.stop()


def test_environments_must_divide():
    with pytest.raises(SettingsError, match="multiple of the 3 env runners"):
        algorithm(ROBOT_ENV, load_settings(config_file(ROBOT_ENV), SMALL), runners=3)
