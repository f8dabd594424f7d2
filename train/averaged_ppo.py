"""PPO of train/fast_ppo.py by several processes: each has environments of its own, and gradients are averaged.

Every process draws minibatches from its own rollout; the mean of their gradients is what one process would have for
all samples, but that advantages are scaled to unit variance in each. All parameters stay the same, bit for bit. This is
decentralised PPO (Wijmans et al. 2020, arXiv:1911.00357) without its stragglers: robots of a batch take the same time.
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
    """Return one process's part of a training run: its environments, its steps, a seed of its own.

    Raises:
        SettingsError: If the environments cannot be divided among `count` processes.
    """
    s = job.settings
    if s.num_envs % count:
        raise SettingsError(f"num_envs: {s.num_envs}; expected a multiple of the {count} workers")
    seed = int(np.random.SeedSequence([job.seed, rank]).generate_state(1)[0]) >> 1
    return replace(job, seed=seed, settings=replace(s, num_envs=s.num_envs // count, steps=-(-s.steps // count)))


class AveragedPPO(FastPPO):
    """One of the processes; the others are those of torch's default process group, which has begun.

    Args:
        envs: A vector environment in SAME_STEP autoreset mode.
        job: Its part of the training run, see `share`.
    """

    def __init__(self, envs: VectorEnv, job: Job) -> None:
        super().__init__(envs, job)
        self.seed, self.count = job.seed, distributed.get_world_size()
        distributed.broadcast(torch.from_numpy(self.theta), 0)

    def average(self, values: NDArray) -> NDArray:
        """Average over all processes, in place."""
        distributed.all_reduce(torch.from_numpy(values))
        values /= self.count
        return values

    def learned(self) -> dict[str, NDArray]:
        """What `FastPPO` can go on from, and any number of processes; steps are those of all."""
        found = super().learned()
        facts = json.loads(str(found["facts"]))
        return found | {"facts": np.array(json.dumps(facts | {"steps": facts["steps"] * self.count}))}

    def restore(self, state: dict[str, NDArray]) -> None:
        """Go on from what was learnt; environments begin anew, and each process explores in its own way."""
        super().restore({name: state[name] for name in ("facts", "theta", "moments")})
        self.rng = np.random.default_rng([self.seed, self.steps])
        self.steps //= self.count
