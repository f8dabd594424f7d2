"""PPO of Stable-Baselines3 as it is, on a native batch: no threads, no schedules but the falling learning rate."""

from __future__ import annotations

from typing import Any

import torch
from job import Job, Trained
from others.keeping import Keeper
from stable_baselines3 import PPO
from stable_baselines3.common.utils import LinearSchedule

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
    model = PPO("MlpPolicy", envs, policy_kwargs=network, seed=job.seed, device="cpu", **arguments(s))
    native: Any = envs.envs
    keeper = Keeper(job, native.unwrapped, lambda: actor(model.policy, s.activation), ("stable_baselines3", "torch"))
    keeper.watch(native, "step", model, "train")
    model.learn(s.steps)
    envs.close()
    return keeper.end()


def arguments(s: Any) -> dict[str, Any]:
    """Return our settings in the form that PPO of Stable-Baselines3, and of SBX, takes."""
    return {
        "learning_rate": LinearSchedule(s.learning_rate, 0.0, 1.0),
        "n_steps": s.rollout,
        "batch_size": -(-s.num_envs * s.rollout // s.minibatches),
        "n_epochs": s.epochs,
        "gamma": s.gamma,
        "gae_lambda": s.gae_lambda,
        "clip_range": s.clip,
        "ent_coef": s.entropy,
        "vf_coef": s.value,
        "max_grad_norm": s.max_grad_norm,
    }


def actor(policy: Any, activation: str) -> Actor:
    """Return the layers of the actor."""
    modules = [*policy.mlp_extractor.policy_net.modules(), policy.action_net]
    linear = [module for module in modules if isinstance(module, torch.nn.Linear)]
    return Actor(tuple((x.weight.detach().numpy().copy(), x.bias.detach().numpy().copy()) for x in linear), activation)
