"""Train a policy with analytic gradients: rewards differentiated through physics, contacts and transmissions.

Short-horizon actor-critic (Xu et al. 2022, arXiv:2204.07137). Robots act for a window of control steps. The gradient of
rewards, and of the critic's value at the end of the window, is propagated through `env.unwrapped.differentiable()` to
the weights of the policy. Command line and files are the same as in train/fast_ppo.py; settings are in
train/config/shac. `env_args` in a settings file changes the task, `training` changes training only, such as softer
ground.

    python train/shac.py --env ce_gym/MiniCheetahVelocity-v0
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from ce_gym.learn.networks.pathwise import back_through
from ce_gym.learn.networks.perceptron import (
    KINDS,
    critic_gradient,
    layers_of,
    make_work,
    outputs,
    padded,
    parameter_count,
    start_layers,
)
from ce_gym.learn.networks.updates import adam, estimate_advantages
from ce_gym.learn.runs.job import Job, Trained
from ce_gym.learn.runs.progress import RecentEpisodes, fall_cost, geometric, spread_episodes
from ce_gym.learn.runs.settings import CONFIG_FOLDER, ActorCriticSettings
from ce_gym.learn.runs.training import run_learner
from ce_gym.model.options import number, option, positive
from ce_gym.policies import Actor

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


class SHAC:
    """Short-horizon actor-critic.

    Args:
        envs: A vector environment of ce_gym in SAME_STEP autoreset mode.
        job: The training run.

    Attributes:
        theta: Parameters of the policy, then of the critic.
        steps: Environment steps done.
        step_seconds, collect_seconds: Time inside the environment, and in collection including it [s].
    """

    def __init__(self, envs: VectorEnv, job: Job) -> None:
        self.envs, self.settings, s = envs, job.settings, job.settings
        native: Any = envs.unwrapped
        self.differentiable = native.differentiable(s.max_adjoint)
        spaces: Any = envs.single_observation_space, envs.single_action_space
        size, self.n_actions = (space.shape[0] for space in spaces)
        # The last layer is a constant identity, so that an activation follows the layer of the actions.
        self.actor_sizes = np.array([size, *s.hidden, self.n_actions, self.n_actions])
        self.critic_sizes = np.array([size, *s.hidden, 1])
        self.kind, self.rng = KINDS.index(s.activation), np.random.default_rng(job.seed)
        self.n_actor, self.n_critic = parameter_count(self.actor_sizes), parameter_count(self.critic_sizes)
        self.theta = np.zeros(self.n_actor + self.n_critic, F)
        self.policy, self.value = self.theta[: self.n_actor], self.theta[self.n_actor :]
        self.moments = np.zeros((2, self.theta.size), F)
        self._start_parameters()
        self.target = self.value.copy()
        self.steps, self.updates, self.critic_updates = 0, 0, 0
        self.episodes = RecentEpisodes(s.num_envs)
        self.step_seconds = self.collect_seconds = 0.0
        self.work = make_work(np.maximum(self.actor_sizes[:-1], self.critic_sizes))
        shape = (s.rollout, s.num_envs)
        self.seen, self.after = (np.zeros((*shape, size), F) for _ in range(2))
        self.rewards, self.values, self.advantages = (np.zeros(shape, F) for _ in range(3))
        self.terminated, self.dones = (np.zeros(shape, bool) for _ in range(2))
        self.observed = np.ascontiguousarray(envs.reset(seed=job.seed)[0], F)
        spread_episodes(native, self.rng)

    def _start_parameters(self) -> None:
        """Set orthogonal weights, small in the layer of the actions, and zero biases."""
        for theta, sizes, last in ((self.policy, self.actor_sizes[:-1], 0.1), (self.value, self.critic_sizes, 1.0)):
            start_layers(theta, sizes, last, self.rng)
        layers_of(self.policy, self.actor_sizes)[-1][0][:] = np.eye(self.n_actions)

    def iterate(self) -> dict[str, float]:
        """Act for a window and learn from it; return statistics for the log."""
        s, done = self.settings, min(self.steps / self.settings.steps, 1.0)
        rate = s.learning_rate * min(1.0, (1 - done) / s.decay)
        start = time.perf_counter()
        self.collect(F(geometric(s.initial_std, s.final_std, done)))
        self.collect_seconds += time.perf_counter() - start
        figures = self.learn_actor(rate) | self.learn_critic(rate, fall_cost(s.fall_cost, done))
        self.steps += self.dones.size
        return figures | {"train/learning_rate": rate}

    def collect(self, std: np.float32) -> None:
        """Act for a window."""
        for t in range(self.settings.rollout):
            self.seen[t] = self.observed
            actions = self._run(self.policy, self.actor_sizes, self.seen[t])
            actions += std * self.rng.standard_normal(actions.shape, F)
            start = time.perf_counter()
            self.observed, self.rewards[t], over, late, infos = self.differentiable.step(actions)
            self.step_seconds += time.perf_counter() - start
            self.after[t], self.terminated[t], self.dones[t] = self.observed, over, over | late
            if self.dones[t].any():
                self.episodes.add(self.dones[t], infos)
                self.after[t][self.dones[t]] = infos["final_obs"][self.dones[t]]

    def learn_actor(self, rate: float) -> dict[str, float]:
        """Make one step of gradient ascent on discounted rewards of the window plus the target critic's final values.

        The value after a fall is 0. Discounts start again with each episode.
        """
        s, (steps, n) = self.settings, self.dones.shape
        weight = np.ones((steps, n), F)
        for t in range(1, steps):
            weight[t] = np.where(self.dones[t - 1], F(1), F(s.gamma) * weight[t - 1])
        worth = weight * F(s.gamma) * ~self.terminated
        worth[:-1] *= self.dones[:-1]
        gradient, by_seen = np.zeros_like(self.policy), None
        for t in range(steps - 1, -1, -1):
            final = self._value_gradient(self.after[t], worth[t])
            by_action = self.differentiable.backward(final if by_seen is None else by_seen, weight[t], final)
            by_seen = np.empty_like(self.seen[t])
            back_through(
                self.policy, self.actor_sizes, self.kind, self.seen[t], by_action, gradient, by_seen, self.work
            )
        last = padded(self.n_actions)
        gradient[-last * (last + 1) :] = 0
        self.updates += 1
        first, second = self.moments[:, : self.n_actor]
        adam(self.policy, gradient / F(-n), first, second, self.updates, rate, s.max_grad_norm)
        return {"train/gradient_norm": float(np.linalg.norm(gradient)) / n}

    def _value_gradient(self, observations: NDArray, weight: NDArray) -> NDArray:
        """Return the gradient of weighted values with respect to observations; rows with weight 0 stay 0."""
        result, rows = np.zeros_like(observations), np.flatnonzero(weight)
        if len(rows):
            gradient, unused = np.empty_like(observations[rows]), np.zeros_like(self.target)
            by_value, seen = np.ascontiguousarray(weight[rows, None]), observations[rows]
            back_through(self.target, self.critic_sizes, self.kind, seen, by_value, unused, gradient, self.work)
            result[rows] = gradient
        return result

    def learn_critic(self, rate: float, cost: float) -> dict[str, float]:
        """Fit values to TD(lambda) targets of the target critic; `cost` is subtracted from the reward of a fall."""
        s, n = self.settings, self.dones.size
        seen, rewards = self.seen.reshape(n, -1), self.rewards.copy()
        self.values[:] = self._run(self.target, self.critic_sizes, seen).reshape(self.values.shape)
        rewards[self.terminated] -= F(cost)
        late = self.dones & ~self.terminated  # the value of the last observation replaces rewards after the time limit
        if late.any():
            rewards[late] += F(s.gamma) * self._run(self.target, self.critic_sizes, self.after[late])[:, 0]
        last = self._run(self.target, self.critic_sizes, self.after[-1])[:, 0]
        estimate_advantages(rewards, self.values, last, self.dones, F(s.gamma), F(s.gae_lambda), self.advantages)
        returns, size = (self.advantages + self.values).reshape(n), -(-n // s.minibatches)
        figures, (first, second) = np.zeros(4, F), self.moments[:, self.n_actor :]
        for _ in range(s.epochs):
            order = self.rng.permutation(n)
            for i in range(0, n, size):
                rows, gradient = order[i : i + size], np.zeros_like(self.value)
                samples, options = (seen, returns), (F(1 / len(rows)), F(1), gradient, figures, self.work)
                critic_gradient(self.value, self.critic_sizes, self.kind, samples, rows, *options)
                self.critic_updates += 1
                adam(self.value, gradient, first, second, self.critic_updates, rate, s.max_grad_norm)
        self.target += F(1 - s.target_memory) * (self.value - self.target)
        spread = float(np.var(returns))
        unexplained = float(np.var(self.advantages)) / spread if spread else np.nan
        loss = float(figures[1]) / s.epochs / s.minibatches
        return {"train/value_loss": loss, "train/explained_variance": 1 - unexplained}

    def _run(self, theta: NDArray, sizes: NDArray, observations: NDArray) -> NDArray:
        result = np.empty((len(observations), sizes[-1]), F)
        outputs(theta, sizes, self.kind, observations, result, self.work)
        return result

    def actor(self) -> Actor:
        """Return copies of the layers from observations to mean actions."""
        layers = layers_of(self.policy, self.actor_sizes)
        return Actor(tuple((weight.T.copy(), bias.copy()) for weight, bias in layers), self.settings.activation)

    def state(self) -> dict[str, NDArray]:
        """Return the state of learner and environments as arrays; see `restore`."""
        native: Any = self.envs.unwrapped
        facts = {
            "steps": self.steps, "updates": [self.updates, self.critic_updates], "rng": self.rng.bit_generator.state,
            "sizes": [self.actor_sizes.tolist(), self.critic_sizes.tolist()], "activation": self.settings.activation,
            "episodes": self.episodes.names,
        }  # fmt: skip
        state = {"facts": np.array(json.dumps(facts)), "theta": self.theta, "moments": self.moments}
        state |= {"target": self.target, "observed": self.observed, "episodes": self.episodes.rows()}
        return state | {f"env/{name}": array for name, array in native.snapshot().items()}

    def restore(self, state: dict[str, NDArray]) -> None:
        """Continue from a state; environments are reset if their number differs.

        Raises:
            ValueError: If the state has another network.
        """
        facts = json.loads(str(state["facts"]))
        native: Any = self.envs.unwrapped
        mine = [self.actor_sizes.tolist(), self.critic_sizes.tolist(), self.settings.activation]
        if [*facts["sizes"], facts["activation"]] != mine:
            raise ValueError(f"has layers {facts['sizes'][0]}, {facts['activation']}; expected {mine[0]}, {mine[2]}")
        self.theta[:], self.moments[:], self.target[:] = (state[name] for name in ("theta", "moments", "target"))
        self.steps, (self.updates, self.critic_updates) = facts["steps"], facts["updates"]
        self.rng.bit_generator.state = facts["rng"]
        if len(state["observed"]) == self.settings.num_envs:
            native.restore({name.removeprefix("env/"): x for name, x in state.items() if name.startswith("env/")})
            self.observed = state["observed"]
            self.episodes.restore(facts["episodes"], state["episodes"])


def train(job: Job) -> Trained:
    """Train, and save the policy even if Ctrl-C ends training early; see `run_learner`."""
    return run_learner(SHAC, job)
