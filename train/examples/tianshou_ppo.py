# pyright: reportMissingImports=false
"""Tianshou's PPO on several single environments, by its own high-level interface."""

from tianshou.highlevel.config import OnPolicyTrainingConfig
from tianshou.highlevel.env import EnvFactoryRegistered, VectorEnvType
from tianshou.highlevel.experiment import ExperimentConfig, PPOExperimentBuilder
from tianshou.highlevel.params.algorithm_params import PPOParams

factory = EnvFactoryRegistered(task="ce_gym:ce_gym/MiniCheetahStand-v0", venv_type=VectorEnvType.DUMMY)
training = OnPolicyTrainingConfig(
    max_epochs=250, epoch_num_steps=4096, num_training_envs=16, num_test_envs=1, test_step_num_episodes=1,
    buffer_size=4096, collection_step_num_env_steps=2048, batch_size=512, update_step_num_repetitions=5,
)  # fmt: skip
quiet = ExperimentConfig(persistence_enabled=False, watch=False)
builder = PPOExperimentBuilder(factory, quiet, training).with_ppo_params(PPOParams(gamma=0.98, lr=1e-3))
builder.with_actor_factory_default((64, 64)).with_critic_factory_default((64, 64)).build().run()
