"""RLlib steps our environments natively and learns on them; runs where Ray is installed (docs/how-to/learners.md)."""

import numpy as np
import pytest

pytest.importorskip("ray")
import ray
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
    assert (before.layers[0][0] != actor.layers[0][0]).any()
    obs = np.random.default_rng(0).standard_normal((5, 48)).astype(np.float32)
    module = algo.get_module()
    mean = module.forward_inference({"obs": torch.from_numpy(obs)})["action_dist_inputs"][:, :12].detach().numpy()
    np.testing.assert_allclose(actor(obs), np.clip(mean, -1, 1), atol=1e-6)
    algo.stop()


def test_environments_must_divide():
    with pytest.raises(SettingsError, match="multiple of the 3 env runners"):
        algorithm(ROBOT_ENV, load_settings(config_file(ROBOT_ENV), SMALL), runners=3)


@pytest.mark.slow
def test_a_node_is_lost_and_training_goes_on_and_is_resumed(tmp_path):
    """Two nodes with one core each, so one env runner each; the second is removed in the middle."""
    from ray.cluster_utils import Cluster

    settings = load_settings(config_file(ROBOT_ENV), SMALL)
    ray.shutdown()
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    node = cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address)
    try:
        algo = algorithm(ROBOT_ENV, settings, runners=2, num_threads=1)
        before = train(algo, 500, 300.0)
        assert algo.env_runner_group.num_healthy_remote_workers() == 2
        cluster.remove_node(node)
        after = train(algo, before + 500, 300.0, tmp_path / "checkpoint")
        assert after >= before + 500
        assert algo.env_runner_group.num_healthy_remote_workers() == 1
        cluster.add_node(num_cpus=1)
        train(algo, after + 1000, 300.0)
        algo.save_to_path(str(tmp_path / "checkpoint"))
        kept = actor_of(algo, "Tanh")
        algo.stop()
        again = algorithm(ROBOT_ENV, settings, runners=1, num_threads=1)
        again.restore_from_path(str(tmp_path / "checkpoint"))
        np.testing.assert_array_equal(actor_of(again, "Tanh").layers[0][0], kept.layers[0][0])
        assert train(again, 1, 300.0) > after + 1000  # earlier steps count
        again.stop()
    finally:
        ray.shutdown()
        cluster.shutdown()
