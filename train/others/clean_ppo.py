"""PPO in eager torch, one file in the manner of CleanRL's `ppo_continuous_action.py`, on a native batch.

The learner that people write themselves: no library between the environment and torch, nothing compiled.
"""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from job import Job, Trained
from others.keeping import Keeper
from torch import Tensor, nn
from torch.distributions import Normal

from ce_gym.policies import Actor


class Agent(nn.Module):
    """Mean and spread of actions, and the value."""

    def __init__(self, seen: int, actions: int, hidden: tuple[int, ...], activation: str, std: float) -> None:
        super().__init__()
        self.mean = layers((seen, *hidden, actions), activation, 0.01)
        self.value = layers((seen, *hidden, 1), activation, 1.0)
        self.log_std = nn.Parameter(torch.full((actions,), math.log(std)))

    def spread(self, seen: Tensor) -> Normal:
        """The distribution of actions."""
        return Normal(self.mean(seen), self.log_std.exp())


def layers(sizes: tuple[int, ...], activation: str, last: float) -> nn.Sequential:
    """Dense layers, orthogonal at first, the last one with another gain."""
    modules: list[nn.Module] = []
    for i in range(len(sizes) - 1):
        linear = nn.Linear(sizes[i], sizes[i + 1])
        nn.init.orthogonal_(linear.weight, last if i == len(sizes) - 2 else math.sqrt(2))
        nn.init.zeros_(linear.bias)
        modules += [linear, getattr(nn, activation)()]
    return nn.Sequential(*modules[:-1])


class CleanPPO:
    """The learner; `settings` as of train/ppo.py."""

    def __init__(self, envs: VectorEnv, job: Job) -> None:
        torch.manual_seed(job.seed)
        self.envs, self.s = envs, job.settings
        seen, actions = (space.shape or (0,) for space in (envs.single_observation_space, envs.single_action_space))
        self.agent = Agent(seen[0], actions[0], self.s.hidden, self.s.activation, self.s.initial_std)
        self.optimizer = torch.optim.Adam(self.agent.parameters(), lr=self.s.learning_rate, eps=1e-5)
        self.seen = envs.reset(seed=job.seed)[0]

    @torch.no_grad()
    def collect(self) -> list[Tensor]:
        """Act for a rollout; return observations, actions, their log-probabilities, advantages and returns, flat."""
        rows: list[tuple[Tensor, ...]] = []
        for _ in range(self.s.rollout):
            seen = torch.as_tensor(self.seen, dtype=torch.float32)
            spread = self.agent.spread(seen)
            action = spread.sample()
            self.seen, rewards, failed, late, infos = self.envs.step(action.clamp(-1, 1).numpy())
            reward = torch.as_tensor(np.float32(rewards))
            done, late = failed | late, late & ~failed
            if late.any():  # time is up: what would have come is worth what the critic says
                final = torch.as_tensor(np.stack(infos["final_obs"][late]), dtype=torch.float32)
                reward[torch.as_tensor(late)] += self.s.gamma * self.agent.value(final).flatten()
            log_prob, value = spread.log_prob(action).sum(1), self.agent.value(seen).flatten()
            rows.append((seen, action, log_prob, value, reward, torch.as_tensor(np.float32(done))))
        seen, actions, log_probs, values, rewards, done = (torch.stack(column) for column in zip(*rows, strict=True))
        following = self.agent.value(torch.as_tensor(self.seen, dtype=torch.float32)).flatten()
        advantages, carried = torch.zeros_like(values), torch.zeros_like(following)
        for t in reversed(range(self.s.rollout)):
            error = rewards[t] + self.s.gamma * following * (1 - done[t]) - values[t]
            carried = error + self.s.gamma * self.s.gae_lambda * (1 - done[t]) * carried
            advantages[t], following = carried, values[t]
        return [x.flatten(0, 1) for x in (seen, actions, log_probs, advantages, advantages + values)]

    def update(self, samples: list[Tensor], remaining: float) -> None:
        """Epochs of minibatches (Schulman et al. 2017, arXiv:1707.06347, eq. 7 and 9)."""
        self.optimizer.param_groups[0]["lr"] = self.s.learning_rate * remaining
        count = len(samples[0])
        for _ in range(self.s.epochs):
            for rows in torch.randperm(count).split(-(-count // self.s.minibatches)):
                self._step(*(x[rows] for x in samples))

    def _step(self, seen: Tensor, actions: Tensor, before: Tensor, advantages: Tensor, returns: Tensor) -> None:
        spread = self.agent.spread(seen)
        ratio = (spread.log_prob(actions).sum(1) - before).exp()
        gain = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        limited = ratio.clamp(1 - self.s.clip, 1 + self.s.clip)
        policy = -torch.min(gain * ratio, gain * limited).mean()
        value = (self.agent.value(seen).flatten() - returns).square().mean()
        loss = policy + self.s.value * value - self.s.entropy * spread.entropy().sum(1).mean()
        self.optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.agent.parameters(), self.s.max_grad_norm)
        self.optimizer.step()

    def actor(self) -> Actor:
        """The present policy, without noise."""
        linear = [module for module in self.agent.mean if isinstance(module, nn.Linear)]
        weights = tuple((x.weight.detach().numpy().copy(), x.bias.detach().numpy().copy()) for x in linear)
        return Actor(weights, self.s.activation)


def train(job: Job) -> Trained:
    """Train by the job's settings as far as this learner has them; `job.threads` are for physics and torch alike."""
    torch.set_num_threads(job.threads)
    mode, options = gymnasium.VectorizeMode.VECTOR_ENTRY_POINT, {"dtype": "float32", "num_threads": job.threads}
    options |= {"autoreset_mode": AutoresetMode.SAME_STEP, **job.env_kwargs, **job.settings.training}
    envs = gymnasium.make_vec(job.env_id, job.settings.num_envs, vectorization_mode=mode, **options)
    learner = CleanPPO(envs, job)
    keeper = Keeper(job, envs.unwrapped, learner.actor, ("torch",))
    keeper.watch(envs, "step", learner, "update")
    while keeper.remaining:
        learner.update(learner.collect(), keeper.remaining)
    envs.close()
    return keeper.end()
