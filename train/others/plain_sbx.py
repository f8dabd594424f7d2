# pyright: reportMissingImports=false
"""PPO of SBX, Stable-Baselines3 in JAX, as it is, on a native batch; its own adaptive learning rate if asked for."""

from __future__ import annotations

import math
from typing import Any

import flax.linen
import numpy as np
from job import Job, Trained
from others.keeping import Keeper
from ppo import ppo_arguments
from sbx import PPO

from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.policies import Actor


def train(job: Job) -> Trained:
    """Train by the job's settings as far as this learner has them; JAX takes as many threads as it likes."""
    s, options = job.settings, {"dtype": "float32", "num_threads": job.threads, **job.env_kwargs}
    envs = make_sb3_vec_env(job.env_id, s.num_envs, job.seed, **{**options, **s.training})
    network = {
        "net_arch": list(s.hidden),
        "activation_fn": getattr(flax.linen, s.activation.lower()),
        "log_std_init": math.log(s.initial_std),
        "ortho_init": True,
    }
    adapted = {"target_kl": s.target_kl, "learning_rate": s.learning_rate} if s.target_kl else {}
    model = PPO("MlpPolicy", envs, policy_kwargs=network, seed=job.seed, **{**ppo_arguments(s), **adapted})
    native: Any = envs.envs
    keeper = Keeper(job, native.unwrapped, lambda: actor(model, s.activation), ("sbx-rl", "jax"))
    keeper.watch(native, "step", model, "train")
    model.learn(s.steps)
    envs.close()
    return keeper.end()


def actor(model: PPO, activation: str) -> Actor:
    """Return the layers of the actor."""
    layers = model.policy.actor_state.params["params"]
    names = sorted((name for name in layers if name.startswith("Dense_")), key=lambda name: int(name[6:]))
    return Actor(tuple((np.array(layers[x]["kernel"]).T, np.array(layers[x]["bias"])) for x in names), activation)
