"""PPO of train/fast_ppo.py in several processes, each with its own environments; gradients are averaged.

Each process draws minibatches from its own rollout. The mean of the gradients equals the gradient over all samples,
except that each process scales its advantages to unit variance. All processes have the same parameters, bit for bit.
This is decentralised PPO (Wijmans et al. 2020, arXiv:1911.00357) without early ends of slow rollouts.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import torch
from fast_ppo import FastPPO
from gymnasium.vector import VectorEnv
from job import Job
from numpy.typing import NDArray
from settings import SettingsError
from torch import distributed


def share(job: Job, rank: int, count: int) -> Job:
    """Return one process's part of a training run, with its share of environments and steps and its own seed.

    Raises:
        SettingsError: If the environments cannot be divided among `count` processes.
    """
    s = job.settings
    if s.num_envs % count:
        raise SettingsError(f"num_envs: {s.num_envs}; expected a multiple of the {count} workers")
    seed = int(np.random.SeedSequence([job.seed, rank]).generate_state(1)[0]) >> 1
    return replace(job, seed=seed, settings=replace(s, num_envs=s.num_envs // count, steps=-(-s.steps // count)))


class AveragedPPO(FastPPO):
    """One of the processes in torch's default process group, which must be initialised.

    Args:
        envs: A vector environment in SAME_STEP autoreset mode.
        job: This process's part of the training run, see `share`.
    """

    def __init__(self, envs: VectorEnv, job: Job) -> None:
        super().__init__(envs, job)
        self.seed, self.count = job.seed, distributed.get_world_size()
        distributed.broadcast(torch.from_numpy(self.theta), 0)

    def average(self, values: NDArray) -> NDArray:
        """Average over all processes in place, and return the array."""
        distributed.all_reduce(torch.from_numpy(values))
        values /= self.count
        return values

    def learned(self) -> dict[str, NDArray]:
        """Return the state of the learner with the steps of all processes; any number of processes can continue."""
        state = super().learned()
        facts = json.loads(str(state["facts"]))
        return state | {"facts": np.array(json.dumps(facts | {"steps": facts["steps"] * self.count}))}

    def restore(self, state: dict[str, NDArray]) -> None:
        """Continue from a state; environments are reset, and each process draws its own random numbers."""
        super().restore({name: state[name] for name in ("facts", "theta", "moments")})
        self.rng = np.random.default_rng([self.seed, self.steps])
        self.steps //= self.count
