# pyright: reportMissingImports=false
"""skrl's PPO on a native batch, through skrl's own wrapper."""

import gymnasium
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer

envs = gymnasium.make_vec(
    "ce_gym:ce_gym/MiniCheetahStand-v0", 64, vectorization_mode="vector_entry_point", autoreset_mode="SameStep"
)
env = wrap_env(envs)
n_seen, n_actions = env.observation_space.shape[0], env.action_space.shape[0]
spaces = {"observation_space": env.observation_space, "action_space": env.action_space, "device": env.device}


def layers(n_outputs):
    """Two hidden layers."""
    hidden = torch.nn.Linear(n_seen, 64), torch.nn.ELU(), torch.nn.Linear(64, 64), torch.nn.ELU()
    return torch.nn.Sequential(*hidden, torch.nn.Linear(64, n_outputs))


class Actor(GaussianMixin, Model):
    """Mean and standard deviation of actions."""

    def __init__(self):
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self)
        self.net, self.log_std = layers(n_actions), torch.nn.Parameter(torch.full((n_actions,), -1.0))

    def compute(self, inputs, role):
        """Return mean and logarithm of the standard deviation, and no further outputs."""
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Critic(DeterministicMixin, Model):
    """Value."""

    def __init__(self):
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.net = layers(1)

    def compute(self, inputs, role):
        """Return values, and no further outputs."""
        return self.net(inputs["observations"]), {}


memory = RandomMemory(memory_size=64, num_envs=env.num_envs, device=env.device)
chosen = PPO_CFG(rollouts=64, learning_epochs=5, mini_batches=4, discount_factor=0.98, learning_rate=1e-3)
chosen.experiment.write_interval = chosen.experiment.checkpoint_interval = 0
agent = PPO(models={"policy": Actor(), "value": Critic()}, memory=memory, cfg=chosen, **spaces)
SequentialTrainer(
    env=env, agents=agent, cfg={"timesteps": 15_000, "disable_progressbar": True, "headless": True}
).train()
