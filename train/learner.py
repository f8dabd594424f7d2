"""PPO of Stable-Baselines3 with updates on several threads, each with its own share of a minibatch.

Torch splits every matrix product among its threads and waits after each product. For small networks this is only a
third faster, and slower if another program uses a core. Here each thread computes the whole gradient of its share, and
the shares are added in a fixed order. There is one barrier per minibatch, and the same bits on any number of threads.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import explained_variance
from torch import Tensor
from torch.nn import functional

SHARES = 4
"""Shares of a minibatch; fixed, so that results do not depend on the number of threads."""


@dataclass(frozen=True)
class Samples:
    """Collected steps; every tensor has one row per step."""

    observations: Tensor | dict[str, Tensor]
    actions: Tensor
    log_probs: Tensor
    advantages: Tensor
    returns: Tensor

    def at(self, rows: Tensor) -> Samples:
        """Return the steps with the indices `rows`."""
        observations, *others = vars(self).values()
        chosen = (
            observations[rows] if isinstance(observations, Tensor) else {k: x[rows] for k, x in observations.items()}
        )
        return Samples(chosen, *(tensor[rows] for tensor in others))


@dataclass(frozen=True)
class Share:
    """Gradient and statistics of a share of a minibatch; `figures` are means over the share."""

    weight: float
    gradient: tuple[Tensor, ...]
    figures: Tensor


FIGURES = ("policy_gradient_loss", "value_loss", "entropy_loss", "approx_kl", "clip_fraction")


class ThreadedPPO(PPO):
    """PPO of Stable-Baselines3 with the same loss and threads of its own.

    Policies are saved and loaded in the same way as in `PPO`. Torch should use one thread.

    Attributes:
        threads: Number of threads in an update.
    """

    threads = 1

    def train(self) -> None:
        """Update the policy with the last rollout."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        samples, figures = self._samples(), []
        workers = [_replica(self.policy) for _ in range(SHARES)]
        with ThreadPoolExecutor(self.threads) as pool:
            each = pool.map if self.threads > 1 else map
            for _ in range(self.n_epochs):
                order = torch.from_numpy(np.random.permutation(len(samples.returns)))
                figures = [self._update(samples, rows, workers, each) for rows in order.split(self.batch_size)]
        self._n_updates += self.n_epochs
        self._log(torch.stack(figures).mean(0).tolist())

    def _samples(self) -> Samples:
        """Return the rollout buffer as tensors that share its memory."""
        buffer = self.rollout_buffer
        steps = buffer.buffer_size * buffer.n_envs

        def flat(a: np.ndarray) -> Tensor:
            return torch.from_numpy(a.reshape(steps, *a.shape[2:]))

        seen: Any = buffer.observations  # an array, or a dictionary of arrays
        observations = {key: flat(a) for key, a in seen.items()} if isinstance(seen, dict) else flat(seen)
        arrays = (buffer.actions, buffer.log_probs, buffer.advantages, buffer.returns)
        return Samples(observations, *(flat(a) for a in arrays))

    def _update(self, samples: Samples, rows: Tensor, workers: list[Any], each: Callable) -> Tensor:
        """Make one step of the optimiser on the samples `rows`; `each` is a map over shares. Return FIGURES."""
        advantages = samples.advantages[rows]
        centre, scale = advantages.mean(), advantages.std() + 1e-8
        parts = rows.chunk(SHARES)
        weights = [len(part) / len(rows) for part in parts]

        def work(worker: ActorCriticPolicy, part: Tensor, weight: float) -> Share:
            return self._share(worker, samples.at(part), centre, scale, weight)

        shares = list(each(work, workers, parts, weights))
        parameters = list(self.policy.parameters())
        for i, parameter in enumerate(parameters):
            parameter.grad = torch.stack([share.gradient[i] for share in shares]).sum(0)
        torch.nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
        self.policy.optimizer.step()
        return torch.stack([share.weight * share.figures for share in shares]).sum(0)

    def _share(self, policy: ActorCriticPolicy, s: Samples, centre: Tensor, scale: Tensor, weight: float) -> Share:
        """Return the weighted gradient of the loss on one share (Schulman et al. 2017, arXiv:1707.06347, eq. 7, 9)."""
        clip = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        advantages = (s.advantages - centre) / scale
        values, log_probs, entropy = policy.evaluate_actions(s.observations, s.actions)  # type: ignore[arg-type]
        log_ratio = log_probs - s.log_probs
        ratio = log_ratio.exp()
        policy_loss = -torch.min(advantages * ratio, advantages * ratio.clamp(1 - clip, 1 + clip)).mean()
        value_loss = functional.mse_loss(values.flatten(), s.returns)
        entropy_loss = log_probs.mean() if entropy is None else -entropy.mean()
        loss = policy_loss + self.ent_coef * entropy_loss + self.vf_coef * value_loss
        gradient = torch.autograd.grad(weight * loss, list(policy.parameters()))
        with torch.no_grad():
            kl = (ratio - 1 - log_ratio).mean()  # the estimator k3 of http://joschu.net/blog/kl-approx.html
            clipped = ((ratio - 1).abs() > clip).float().mean()
        return Share(weight, gradient, torch.stack([policy_loss, value_loss, entropy_loss, kl, clipped]).detach())

    def _log(self, figures: list[float]) -> None:
        """Log the same entries as Stable-Baselines3; losses are means over the last epoch, not over all epochs."""
        for name, value in zip(FIGURES, figures, strict=True):
            self.logger.record(f"train/{name}", value)
        buffer = self.rollout_buffer
        self.logger.record(
            "train/explained_variance", explained_variance(buffer.values.ravel(), buffer.returns.ravel())
        )
        if hasattr(self.policy, "log_std"):
            self.logger.record("train/std", self.policy.log_std.detach().exp().mean().item())  # type: ignore[union-attr]
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")


def _replica(policy: Any) -> Any:
    """Return a copy of a policy that shares its parameters; evaluating a policy changes its other attributes."""
    shared = {id(parameter): parameter for parameter in policy.parameters()}
    return copy.deepcopy(policy, shared | {id(policy.optimizer): None})
