"""PPO of Stable-Baselines3 as it is, on a native batch: no threads, no schedules but the falling learning rate."""

from __future__ import annotations

from typing import Any

import torch
from job import Job, Trained
from others.keeping import Keeper
from ppo import ppo_arguments
from stable_baselines3 import PPO

from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.policies import Actor


def train(job: Job) -> Trained:
    """Train by the job's settings as far as this learner has them; `job.threads` are for physics and torch alike."""
    torch.set_num_threads(job.threads)
    s, options = job.settings, {"dtype": "float32", "num_threads": job.threads, **job.env_kwargs}
    envs = make_sb3_vec_env(job.env_id, s.num_envs, job.seed, **{**options, **s.training})
    network = {
        "net_arch": list(s.hidden),
        "activation_fn": getattr(torch.nn, s.activation),
        "log_std_init": float(torch.tensor(s.initial_std).log()),
    }
    model = PPO("MlpPolicy", envs, policy_kwargs=network, seed=job.seed, device="cpu", **ppo_arguments(s))
    native: Any = envs.envs
    keeper = Keeper(job, native.unwrapped, lambda: actor(model.policy, s.activation), ("stable_baselines3", "torch"))
    keeper.watch(native, "step", model, "train")
    model.learn(s.steps)
    envs.close()
    return keeper.end()


def actor(policy: Any, activation: str) -> Actor:
    """Return the layers of the actor."""
    modules = [*policy.mlp_extractor.policy_net.modules(), policy.action_net]
    linear = [module for module in modules if isinstance(module, torch.nn.Linear)]
    return Actor(tuple((x.weight.detach().numpy().copy(), x.bias.detach().numpy().copy()) for x in linear), activation)
