"""Train a policy with analytic gradients: rewards differentiated through physics, contacts and transmissions.

Short-horizon actor-critic (Xu et al. 2022, arXiv:2204.07137). Robots act for a window of control steps. The gradient of
rewards, and of the critic's value at the end of the window, is propagated through `env.unwrapped.differentiable()` to
the weights of the policy. Settings files are in train/config/shac. `env_args` in a settings file changes the task,
`training` changes training only, such as softer ground.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from ce_gym.learn.learners.learner import Learner, space_sizes
from ce_gym.learn.networks.perceptron import back_through, padded, squared_error_gradient
from ce_gym.learn.networks.updates import adam
from ce_gym.learn.runs.job import Job, Trained
from ce_gym.learn.runs.loop import run_learner
from ce_gym.learn.runs.progress import fall_cost, geometric
from ce_gym.learn.runs.settings import CONFIG_FOLDER, ActorCriticSettings
from ce_gym.model.options import number, option, positive
from ce_gym.policies import PolicyError

F = np.float32


@dataclass(frozen=True)
class Settings(ActorCriticSettings):
    """Settings of SHAC.

    A rollout is a window that is differentiated as a whole. Minibatches and epochs belong to updates of the critic.

    Attributes:
        activation: Activation, also after the policy's last layer, so that Tanh limits actions.
        learning_rate: Learning rate of policy and critic until the last part of training.
        decay: Length of the last part, as a fraction of training; there the learning rate falls linearly to 0.
        target_memory: Weight of the old target critic in each update of the target critic.
        max_adjoint: The gradient of each robot is clipped to this norm between control steps.
    """

    folder: ClassVar[Path] = CONFIG_FOLDER / "shac"

    decay: float = option(number(1e-3, 1))
    target_memory: float = option(number(0, 1))
    max_adjoint: float = option(positive())


class SHAC(Learner):
    """Short-horizon actor-critic.

    Args:
        envs: A vector environment of ce_gym in SAME_STEP autoreset mode.
        job: The training run.

    Raises:
        PolicyError: If the critic has an observation of its own.

    Attributes:
        critic_updates: Number of Adam steps of the critic; `updates` counts the steps of the policy.
    """

    arrays = (*Learner.arrays, "target")
    numbers = (*Learner.numbers, "critic_updates")

    def __init__(self, envs: VectorEnv, job: Job) -> None:
        s, native, (seen, _, n_actions) = job.settings, envs.unwrapped, space_sizes(envs)
        if isinstance(envs.single_observation_space, gymnasium.spaces.Dict):
            raise PolicyError(
                f"{job.env_id}: obs_mode: dict; expected vector: in SHAC the critic sees what the policy sees"
            )
        self.differentiable = native.differentiable(s.max_adjoint)  # type: ignore[attr-defined]
        # The last layer is a constant identity, so that an activation follows the layer of the actions.
        super().__init__(envs, job, [seen, *s.hidden, n_actions, n_actions], [seen, *s.hidden, 1])
        self.target, self.critic_updates = self.value.theta.copy(), 0
        self.target_value = self.value._replace(theta=self.target)
        self.seen, self.after = (np.zeros((*self.dones.shape, seen), F) for _ in range(2))
        self.terminated = np.zeros(self.dones.shape, bool)

    def start_parameters(self) -> None:
        """Set orthogonal weights, small in the layer of the actions, and zero biases."""
        self.policy._replace(sizes=self.policy.sizes[:-1]).start(0.1, self.rng)
        self.value.start(1.0, self.rng)
        self.policy.layers()[-1][0][:] = np.eye(self.policy.sizes[-1])

    def collect(self, done: float) -> None:
        """Act for a window."""
        s = self.settings
        std = F(geometric(s.initial_std, s.final_std, done))
        for t in range(s.rollout):
            self.seen[t] = self.observed[0]
            actions = self.run(self.policy, self.seen[t])
            actions += std * self.rng.standard_normal(actions.shape, F)
            self.terminated[t], _, infos = self.step(self.differentiable, t, actions)
            self.after[t] = self.observed[0]
            if self.dones[t].any():
                self.after[t][self.dones[t]] = infos["final_obs"][self.dones[t]]

    def learn(self, done: float) -> dict[str, float]:
        """Update policy and critic with the window; return statistics for the log."""
        s = self.settings
        rate = s.learning_rate * min(1.0, (1 - done) / s.decay)
        figures = self._learn_policy(rate) | self._learn_critic(rate, fall_cost(s.fall_cost, done))
        return figures | {"train/learning_rate": rate}

    def _learn_policy(self, rate: float) -> dict[str, float]:
        """Make one step of gradient ascent on discounted rewards of the window plus the target critic's final values.

        The value after a fall is 0. Discounts start again with each episode.
        """
        s, (steps, n) = self.settings, self.dones.shape
        weight = np.ones((steps, n), F)
        for t in range(1, steps):
            weight[t] = np.where(self.dones[t - 1], F(1), F(s.gamma) * weight[t - 1])
        worth = weight * F(s.gamma) * ~self.terminated
        worth[:-1] *= self.dones[:-1]
        gradient, by_seen = np.zeros_like(self.policy.theta), None
        for t in range(steps - 1, -1, -1):
            final = self._value_gradient(self.after[t], worth[t])
            by_action = self.differentiable.backward(final if by_seen is None else by_seen, weight[t], final)
            by_seen = np.empty_like(self.seen[t])
            back_through(self.policy, self.seen[t], by_action, gradient, by_seen, self.work[0])
        last = padded(self.policy.sizes[-1])
        gradient[-last * (last + 1) :] = 0
        self.updates += 1
        moments = self.parts(self.moments)[0]
        adam(self.policy.theta, gradient / F(-n), moments, self.updates, rate, s.max_grad_norm)
        return {"train/gradient_norm": float(np.linalg.norm(gradient)) / n}

    def _value_gradient(self, observations: NDArray, weight: NDArray) -> NDArray:
        """Return the gradient of weighted values with respect to observations; rows with weight 0 stay 0."""
        result, rows = np.zeros_like(observations), np.flatnonzero(weight)
        if len(rows):
            gradient, unused = np.empty_like(observations[rows]), np.zeros_like(self.target)
            by_value, seen = np.ascontiguousarray(weight[rows, None]), observations[rows]
            back_through(self.target_value, seen, by_value, unused, gradient, self.work[0])
            result[rows] = gradient
        return result

    def _learn_critic(self, rate: float, cost: float) -> dict[str, float]:
        """Fit values to TD(lambda) returns of the target critic; `cost` is subtracted from the reward of a fall."""
        s, moments = self.settings, self.parts(self.moments)[2]
        rewards = self.rewards - F(cost) * self.terminated
        _, returns, explained = self.estimate(self.target_value, self.seen, rewards)
        seen, targets, losses = self.seen.reshape(len(returns), -1), returns[:, None], []
        for minibatches in self.epochs():
            for rows in minibatches:
                gradient, weight = np.zeros_like(self.target), F(1 / len(rows))
                loss = squared_error_gradient(self.value, seen, targets, rows, weight, gradient, self.work[0])
                losses.append(weight * loss)
                self.critic_updates += 1
                adam(self.value.theta, gradient, moments, self.critic_updates, rate, s.max_grad_norm)
        self.target += F(1 - s.target_memory) * (self.value.theta - self.target)
        return {"train/value_loss": float(np.mean(losses)), "train/explained_variance": explained}


def train(job: Job) -> Trained:
    """Train, and save the policy even if Ctrl-C ends training early; see `run_learner`."""
    return run_learner(SHAC, job)
