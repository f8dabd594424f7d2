"""Parameters, rollouts and saved state of a learner whose networks are plain arrays."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from ce_gym.learn.networks.perceptron import KINDS, Network, make_work, outputs, parameter_count
from ce_gym.learn.networks.updates import estimate_advantages
from ce_gym.learn.runs.job import Job
from ce_gym.learn.runs.progress import RecentEpisodes, spread_episodes
from ce_gym.policies import Actor

SHARES = 8
"""Largest number of threads; also the parts of a minibatch of PPO, fixed so that bits do not depend on the threads."""

F = np.float32


def space_sizes(envs: VectorEnv) -> tuple[int, int, int]:
    """Return the sizes of the actor's observation, the critic's observation, and the action."""
    seen, actions = envs.single_observation_space, envs.single_action_space
    views = (seen["policy"], seen["critic"]) if isinstance(seen, gymnasium.spaces.Dict) else (seen, seen)
    policy, critic, action = (int((space.shape or (0,))[0]) for space in (*views, actions))
    return policy, critic, action


class Learner:
    """Learner with an actor, and optionally a critic.

    A subclass has the methods `collect(done)` and `learn(done)`, where `done` is the finished fraction of training.

    Args:
        envs: A vector environment in SAME_STEP autoreset mode.
        job: The training run.
        policy: Sizes of the actor's layers, the observation first.
        value: Sizes of the critic's layers; without a critic, nothing.
        others: Number of parameters that belong to no network.

    Attributes:
        theta: All parameters: the actor's, the others, the critic's.
        policy, value: The networks of actor and critic, views of theta.
        moments: State of Adam, shape (2, n_parameters).
        observed: Observations of the actor, and of the critic if they differ, each (num_envs, size).
        rewards, dones, late: Of the rollout: rewards, whether an episode ended, and whether because of its time limit,
            each (rollout, num_envs).
        final: For each step in which the time limit ended episodes, their last observations for the critic.
        steps: Environment steps done.
        updates: Number of Adam steps.
        step_seconds, collect_seconds: Time inside the environment, and in collection including it [s].
    """

    arrays: tuple[str, ...] = ("theta", "moments")
    numbers: tuple[str, ...] = ("steps", "updates")
    """Attributes that are saved."""

    def __init__(
        self, envs: VectorEnv, job: Job, policy: Sequence[int], value: Sequence[int] = (), others: int = 0
    ) -> None:
        self.envs, self.settings, self.threads = envs, job.settings, min(job.threads, SHARES)
        self.rng = np.random.default_rng(job.seed)
        self.edges = np.cumsum([parameter_count(policy), others])
        self.theta = np.zeros(self.edges[-1] + parameter_count(value), F)
        self.moments = np.zeros((2, self.theta.size), F)
        (of_policy, _, of_value), kind = self.parts(self.theta), KINDS.index(job.settings.activation)
        self.policy = Network(of_policy, np.array(policy), kind)
        self.value = Network(of_value, np.array(value, int), kind)
        self.start_parameters()
        self.steps = self.updates = 0
        self.step_seconds = self.collect_seconds = 0.0
        self.episodes = RecentEpisodes(job.settings.num_envs)
        self.pool = ThreadPoolExecutor(self.threads)
        self.work = [make_work(*filter(len, (policy, value))) for _ in range(SHARES)]
        self.rewards = np.zeros((job.settings.rollout, job.settings.num_envs), F)
        self.dones, self.late = (np.zeros(self.rewards.shape, bool) for _ in range(2))
        self.final: list[NDArray[np.float32]] = []
        self.observed = self._views(envs.reset(seed=job.seed)[0])
        spread_episodes(envs.unwrapped, self.rng)

    def parts(self, vector: NDArray) -> list[NDArray]:
        """Return views of the actor, the other parameters and the critic in an array (..., n_parameters)."""
        return np.split(vector, self.edges, axis=-1)

    def start_parameters(self) -> None:
        """Set orthogonal weights, small in the last layer of the actor, and zero biases, as usual for PPO."""
        self.policy.start(0.01, self.rng)
        self.value.start(1.0, self.rng)

    def _views(self, observations: Any) -> list[NDArray[np.float32]]:
        """Return `observed`."""
        views = [observations["policy"], observations["critic"]] if isinstance(observations, dict) else [observations]
        return [np.ascontiguousarray(view, F) for view in views]

    def iterate(self) -> dict[str, float]:
        """Collect a rollout and learn from it; return statistics for the log."""
        done, start = min(self.steps / self.settings.steps, 1.0), time.perf_counter()
        self.final = []
        self.collect(done)
        self.collect_seconds += time.perf_counter() - start
        self.steps += self.dones.size
        return self.learn(done)

    def collect(self, done: float) -> None:
        """Collect one rollout."""
        raise NotImplementedError

    def learn(self, done: float) -> dict[str, float]:
        """Update the parameters with the rollout; return statistics for the log."""
        raise NotImplementedError

    def step(self, envs: Any, t: int, actions: NDArray) -> tuple[NDArray, NDArray, dict[str, Any]]:
        """Make step t of a rollout in `envs`; return terminations, truncations and infos."""
        start = time.perf_counter()
        observations, self.rewards[t], terminated, truncated, infos = envs.step(actions)
        self.step_seconds += time.perf_counter() - start
        self.observed, self.dones[t] = self._views(observations), terminated | truncated
        self.late[t] = truncated & ~terminated
        if self.dones[t].any():
            self.episodes.add(self.dones[t], infos)
        if self.late[t].any():
            self.final.append(self._views(infos["final_obs"])[-1][self.late[t]])
        return terminated, truncated, infos

    def run(self, network: Network, observations: NDArray) -> NDArray[np.float32]:
        """Return the outputs of a network for observations (n, size), on several threads if the batch is large."""
        result = np.empty((len(observations), network.sizes[-1]), F)
        parts = self.threads if len(observations) * len(network.theta) > 4e6 else 1
        edges = [len(observations) * i // parts for i in range(parts + 1)]

        def work(i: int) -> None:
            rows = slice(edges[i], edges[i + 1])
            outputs(network, observations[rows], result[rows], self.work[i])

        list((self.pool.map if parts > 1 else map)(work, range(parts)))
        return result

    def estimate(self, critic: Network, seen: NDArray, rewards: NDArray) -> tuple[NDArray, NDArray, float]:
        """Estimate advantages and TD(lambda) returns of the rollout.

        The value of an episode's last observation replaces the rewards after the time limit.

        Args:
            critic: The critic.
            seen: Observations of the critic, shape (rollout, num_envs, size).
            rewards: Rewards, shape (rollout, num_envs).

        Returns:
            Advantages and returns, each (rollout * num_envs,), and the explained variance of the returns.
        """
        s, rewards = self.settings, rewards.copy()
        values = self.run(critic, seen.reshape(-1, seen.shape[-1])).reshape(rewards.shape)
        if self.final:
            rewards[self.late] += F(s.gamma) * self.run(critic, np.concatenate(self.final))[:, 0]
        last, advantages = self.run(critic, self.observed[-1])[:, 0], np.empty_like(values)
        estimate_advantages(rewards, values, last, self.dones, F(s.gamma), F(s.gae_lambda), advantages)
        returns = advantages + values
        spread = float(np.var(returns))
        explained = 1 - float(np.var(advantages)) / spread if spread else np.nan
        return advantages.reshape(-1), returns.reshape(-1), explained

    def epochs(self) -> Iterator[list[NDArray[np.intp]]]:
        """Return for each epoch the indices of random minibatches of the rollout."""
        n = self.dones.size
        size = -(-n // self.settings.minibatches)
        for _ in range(self.settings.epochs):
            order = self.rng.permutation(n)
            yield [order[i : i + size] for i in range(0, n, size)]

    def actor(self) -> Actor:
        """Return copies of the layers from observations to mean actions."""
        layers = self.policy.layers()
        return Actor(tuple((weight.T.copy(), bias.copy()) for weight, bias in layers), self.settings.activation)

    def state(self) -> dict[str, NDArray]:
        """Return the state of learner and environments as arrays; see `restore`."""
        native: Any = self.envs.unwrapped
        facts = {name: getattr(self, name) for name in self.numbers} | {
            "rng": self.rng.bit_generator.state,
            "sizes": [network.sizes.tolist() for network in (self.policy, self.value)],
            "activation": self.settings.activation,
            "episodes": self.episodes.names,
        }
        state = {"facts": np.array(json.dumps(facts)), "episodes": self.episodes.rows()}
        state |= {name: getattr(self, name) for name in self.arrays}
        state |= {f"observed_{i}": view for i, view in enumerate(self.observed)}
        if hasattr(native, "snapshot"):
            state |= {f"env/{name}": array for name, array in native.snapshot().items()}
        return state

    def restore(self, state: dict[str, NDArray]) -> None:
        """Continue from a state; environments are reset if they have no snapshots or their number differs.

        Raises:
            ValueError: If the state has another network.
        """
        facts, s = json.loads(str(state["facts"])), self.settings
        sizes = [network.sizes.tolist() for network in (self.policy, self.value)]
        if (facts["sizes"], facts["activation"]) != (sizes, s.activation):
            saved = f"{facts['sizes'][0]}, {facts['activation']}"
            raise ValueError(f"has layers {saved}; expected {sizes[0]}, {s.activation}")
        for name in self.arrays:
            getattr(self, name)[:] = state[name]
        for name in self.numbers:
            setattr(self, name, facts[name])
        self.rng.bit_generator.state = facts["rng"]
        environments = {name.removeprefix("env/"): array for name, array in state.items() if name.startswith("env/")}
        if environments and len(state["observed_0"]) == s.num_envs:
            native: Any = self.envs.unwrapped
            native.restore(environments)
            self.observed = [state[f"observed_{i}"] for i in range(len(self.observed))]
            self.episodes.restore(facts["episodes"], state["episodes"])
