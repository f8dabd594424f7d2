"""PPO of rsl_rl as it is, on a native batch, by `train/rsl_rl_ppo.py`'s settings."""

from __future__ import annotations

import math

import torch
from job import Job, Trained
from others.keeping import Keeper
from rsl_rl.runners import OnPolicyRunner
from rsl_rl_ppo import actor_of, runner_settings

from ce_gym.adapters.rsl_rl import make_rsl_rl_vec_env


def train(job: Job) -> Trained:
    """Train by the job's settings as far as this learner has them; `job.threads` are for physics and torch alike."""
    torch.set_num_threads(job.threads)
    torch.manual_seed(job.seed)
    s, options = job.settings, {"dtype": "float32", "num_threads": job.threads, **job.env_kwargs}
    envs = make_rsl_rl_vec_env(job.env_id, s.num_envs, job.seed, "cpu", **{**options, **s.training})
    runner = OnPolicyRunner(envs, runner_settings(s, ("policy",), job.seed), None, device="cpu")
    keeper = Keeper(job, envs.envs.unwrapped, lambda: actor_of(runner, s.activation), ("rsl-rl-lib", "torch"))
    keeper.watch(envs.envs, "step", runner.alg, "update")
    runner.learn(math.ceil(s.steps / keeper.batch), init_at_random_ep_len=True)
    return keeper.end()
