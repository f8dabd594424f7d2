"""Train a policy with PPO, with collection and learning as compiled loops over plain arrays.

On one machine a seed gives the same bits on any number of threads, also if training is interrupted and resumed.
"""

from __future__ import annotations

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from ce_gym.learn.learners.learner import SHARES, Learner, space_sizes
from ce_gym.learn.networks.perceptron import FIGURES, actor_gradient, squared_error_gradient
from ce_gym.learn.networks.updates import adam, sample_actions
from ce_gym.learn.runs.job import Job, Trained
from ce_gym.learn.runs.loop import run_learner
from ce_gym.learn.runs.progress import adapted_rate, fall_cost, geometric, linear
from ce_gym.learn.runs.settings import Settings as Settings  # of this learner

F = np.float32


class PPO(Learner):
    """Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347) with generalised advantage estimation.

    Args:
        envs: A vector environment in SAME_STEP autoreset mode.
        job: The training run.

    Attributes:
        theta: All parameters: the actor's, the logarithms of the standard deviations, the critic's.
        rate: Learning rate.
    """

    numbers = (*Learner.numbers, "rate")

    def __init__(self, envs: VectorEnv, job: Job) -> None:
        s, (seen, known, n_actions) = job.settings, space_sizes(envs)
        super().__init__(envs, job, [seen, *s.hidden, n_actions], [known, *s.hidden, 1], n_actions)
        self.log_std = self.parts(self.theta)[1]
        self.log_std[:] = np.log(s.initial_std)
        self.gradients = np.zeros((SHARES, self.theta.size), F)
        self.rate = s.learning_rate
        self.seen = [np.zeros((*self.dones.shape, view.shape[1]), F) for view in self.observed]
        self.actions = np.zeros((*self.dones.shape, n_actions), F)
        self.log_probs = np.zeros(self.dones.shape, F)

    def collect(self, done: float) -> None:
        """Collect one rollout; falls have a cost."""
        s, cost = self.settings, F(fall_cost(self.settings.fall_cost, done))
        if s.final_std:
            self.log_std[:] = np.log(geometric(s.initial_std, s.final_std, done))
        clipped = np.zeros_like(self.actions[0])
        for t in range(s.rollout):
            for view, rows in zip(self.seen, self.observed, strict=True):
                view[t] = rows
            means = self.run(self.policy, self.observed[0])
            noise = self.rng.standard_normal(means.shape, F)
            sample_actions(means, noise, self.log_std, self.actions[t], clipped, self.log_probs[t])
            terminated, truncated, _ = self.step(self.envs, t, clipped)
            self.rewards[t] -= cost * (terminated & ~truncated)

    def learn(self, done: float) -> dict[str, float]:
        """Update the parameters with random minibatches of the rollout; return statistics of the last epoch."""
        s = self.settings
        if not s.target_kl:
            self.rate = linear(s.learning_rate, 0.0, done)
        entropy = F(linear(s.entropy, s.final_entropy, done))
        advantages, returns, explained = self.estimate(self.value, self.seen[-1], self.rewards)
        figures: list[NDArray] = []
        for minibatches in self.epochs():
            figures = [self._update(rows, advantages, returns, entropy) for rows in minibatches]
        means = dict(zip((*FIGURES, "value_loss"), np.mean(figures, axis=0).tolist(), strict=True))
        if s.target_kl:
            self.rate = adapted_rate(self.rate, means["approx_kl"], s.target_kl)
        means |= {
            "explained_variance": explained,
            "std": float(np.exp(self.log_std).mean()),
            "learning_rate": self.rate,
        }
        return {f"train/{name}": mean for name, mean in means.items()}

    def _update(self, rows: NDArray, advantages: NDArray, returns: NDArray, entropy: np.float32) -> NDArray:
        """Make one step of Adam on a minibatch; return `FIGURES` and the value loss."""
        s, n, weight = self.settings, self.dones.size, F(1 / len(rows))
        seen, known = self.seen[0].reshape(n, -1), self.seen[-1].reshape(n, -1)
        samples = (seen, self.actions.reshape(n, -1), self.log_probs.reshape(n), advantages)
        chosen = advantages[rows]
        scaling = (chosen.mean(), F(1) / (chosen.std(ddof=1) + F(1e-8)), weight)
        figures = np.zeros((SHARES, len(FIGURES) + 1), F)
        self.gradients[:] = 0

        def work(i: int, part: NDArray) -> None:
            by_actor, by_log_std, by_critic = self.parts(self.gradients[i])
            actor_gradient(
                self.policy, self.log_std, samples, part, scaling, F(s.clip), entropy, by_actor, by_log_std,
                figures[i], self.work[i],
            )  # fmt: skip
            loss = squared_error_gradient(
                self.value, known, returns[:, None], part, F(s.value) * weight, by_critic, self.work[i]
            )
            figures[i, -1] = weight * loss

        list((self.pool.map if self.threads > 1 else map)(work, range(SHARES), np.array_split(rows, SHARES)))
        self.updates += 1
        adam(self.theta, self.gradients.sum(axis=0), self.moments, self.updates, self.rate, s.max_grad_norm)
        return figures.sum(axis=0)


def train(job: Job) -> Trained:
    """Train, and save the policy even if Ctrl-C ends training early; see `run_learner`."""
    return run_learner(PPO, job)
