"""Train a policy with PPO, with collection and learning as compiled loops over plain arrays.

Algorithm, arguments and settings files are the same as in train/ppo.py, which takes four times the CPU time. Writes
`policy.npz` (weights and record), `policy.json` (the record), `policy.learner.npz` (state of the learner as arrays and
JSON), `progress.csv`, `curve.csv` and `checkpoints/`. On one machine a seed gives the same bits on any number of
threads, also if training is interrupted and resumed.

    python train/fast_ppo.py --env ce_gym/MiniCheetahVelocity-v0
    python train/fast_ppo.py --resume runs/mini_cheetah_velocity-fast --steps 20e6
"""

from __future__ import annotations

import json
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from ce_gym.learn.networks.perceptron import (
    FIGURES,
    KINDS,
    actor_gradient,
    critic_gradient,
    layers_of,
    make_work,
    outputs,
    parameter_count,
    start_layers,
)
from ce_gym.learn.networks.updates import adam, estimate_advantages, sample_actions
from ce_gym.learn.runs.job import Job, Trained
from ce_gym.learn.runs.progress import RecentEpisodes, adapted_rate, fall_cost, geometric, linear, spread_episodes
from ce_gym.learn.runs.settings import Settings as Settings  # of this learner
from ce_gym.learn.runs.training import run_learner
from ce_gym.policies import Actor

SHARES = 8
"""Parts of a minibatch for the threads; fixed, so that results do not depend on the number of threads."""

F = np.float32


class FastPPO:
    """Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347) with generalised advantage estimation.

    Args:
        envs: A vector environment in SAME_STEP autoreset mode.
        job: The training run.

    Attributes:
        theta: All parameters: the actor's, the logarithms of the standard deviations, the critic's.
        steps: Environment steps done.
        rate: Learning rate.
        step_seconds, collect_seconds: Time spent inside the environment, and in collection as a whole [s].
    """

    def __init__(self, envs: VectorEnv, job: Job) -> None:
        self.envs, self.settings, self.threads = envs, job.settings, job.threads
        s, n = job.settings, job.settings.num_envs
        seen: Any = envs.single_observation_space
        self.two_views = isinstance(seen, gymnasium.spaces.Dict)
        sizes = [view.shape[0] for view in ((seen["policy"], seen["critic"]) if self.two_views else (seen, seen))]
        self.n_actions = (envs.single_action_space.shape or (0,))[0]
        self.actor_sizes = np.array([sizes[0], *s.hidden, self.n_actions])
        self.critic_sizes = np.array([sizes[1], *s.hidden, 1])
        self.kind = KINDS.index(s.activation)
        self.rng = np.random.default_rng(job.seed)
        count = parameter_count(self.actor_sizes) + self.n_actions + parameter_count(self.critic_sizes)
        self.theta = np.zeros(count, F)
        self.moments = np.zeros((2, self.theta.size), F)
        self.gradients = np.zeros((SHARES, self.theta.size), F)
        self._start_parameters()
        self.steps, self.updates, self.rate = 0, 0, s.learning_rate
        self.episodes = RecentEpisodes(n)
        self.step_seconds = self.collect_seconds = 0.0
        self.pool = ThreadPoolExecutor(max(job.threads, 1))
        self.work = [make_work(np.maximum(self.actor_sizes, self.critic_sizes)) for _ in range(SHARES)]
        shape = (s.rollout, n)
        self.seen = [np.zeros((*shape, size), F) for size in (sizes if self.two_views else sizes[:1])]
        self.actions = np.zeros((*shape, self.n_actions), F)
        self.log_probs, self.rewards, self.values, self.advantages = (np.zeros(shape, F) for _ in range(4))
        self.dones = np.zeros(shape, bool)
        self.observed = self._views(envs.reset(seed=job.seed)[0])
        spread_episodes(envs.unwrapped, self.rng)

    def parts(self, vector: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Return views of actor, logarithms of standard deviations, and critic in a vector of parameters."""
        end = parameter_count(self.actor_sizes)
        return vector[:end], vector[end : end + self.n_actions], vector[end + self.n_actions :]

    def _start_parameters(self) -> None:
        """Set orthogonal weights, small in the last layer of the actor, and zero biases, as usual for PPO."""
        actor, log_std, critic = self.parts(self.theta)
        for vector, sizes, last in ((actor, self.actor_sizes, 0.01), (critic, self.critic_sizes, 1.0)):
            start_layers(vector, sizes, last, self.rng)
        log_std[:] = np.log(self.settings.initial_std)

    def _views(self, observations: Any) -> list[NDArray[np.float32]]:
        """Return the observations of the actor, and of the critic if it has others."""
        views = [observations["policy"], observations["critic"]] if self.two_views else [observations]
        return [np.ascontiguousarray(view, F) for view in views]

    def iterate(self) -> dict[str, float]:
        """Collect a rollout and learn from it; return statistics for the log."""
        s, done = self.settings, min(self.steps / self.settings.steps, 1.0)
        if s.final_std:
            self.parts(self.theta)[1][:] = np.log(geometric(s.initial_std, s.final_std, done))
        if not s.target_kl:
            self.rate = linear(s.learning_rate, 0.0, done)
        start = time.perf_counter()
        self.collect(fall_cost(s.fall_cost, done))
        self.collect_seconds += time.perf_counter() - start
        figures = self.learn(linear(s.entropy, s.final_entropy, done))
        if s.target_kl:
            self.rate = adapted_rate(self.rate, figures["train/approx_kl"], s.target_kl)
        return figures

    def collect(self, cost: float) -> None:
        """Collect one rollout, subtract `cost` from the reward of each fall, and estimate advantages."""
        s = self.settings
        actor, log_std, critic = self.parts(self.theta)
        means, clipped = np.zeros((s.num_envs, self.n_actions), F), np.zeros((s.num_envs, self.n_actions), F)
        timed_out: list[tuple[int, NDArray, NDArray]] = []
        for t in range(s.rollout):
            for view, rows in zip(self.seen, self.observed, strict=True):
                view[t] = rows
            self._run(actor, self.actor_sizes, self.observed[0], means)
            noise = self.rng.standard_normal(means.shape, F)
            sample_actions(means, noise, log_std, self.actions[t], clipped, self.log_probs[t])
            start = time.perf_counter()
            observations, self.rewards[t], terminated, truncated, infos = self.envs.step(clipped)
            self.step_seconds += time.perf_counter() - start
            self.observed, self.dones[t] = self._views(observations), terminated | truncated
            self.rewards[t] -= F(cost) * (terminated & ~truncated)
            if self.dones[t].any():
                self.episodes.add(self.dones[t], infos)
                late = np.flatnonzero(truncated & ~terminated)
                if len(late):
                    timed_out.append((t, late, self._views(infos["final_obs"])[-1][late]))
        self.steps += self.dones.size
        self._estimate(critic, timed_out)

    def _estimate(self, critic: NDArray, timed_out: list[tuple[int, NDArray, NDArray]]) -> None:
        """Estimate values and advantages.

        Args:
            critic: Parameters of the critic.
            timed_out: For each step with time-outs: the step, the environments, and their last observations. The
                critic's value of this observation replaces the rewards after the time limit.
        """
        s, known = self.settings, self.seen[-1]
        self._run(critic, self.critic_sizes, known.reshape(-1, known.shape[2]), self.values.reshape(-1, 1))
        for t, rows, observations in timed_out:
            worth = np.zeros((len(rows), 1), F)
            self._run(critic, self.critic_sizes, observations, worth)
            self.rewards[t, rows] += F(s.gamma) * worth[:, 0]
        last = np.zeros((s.num_envs, 1), F)
        self._run(critic, self.critic_sizes, self.observed[-1], last)
        estimate_advantages(
            self.rewards, self.values, last[:, 0], self.dones, F(s.gamma), F(s.gae_lambda), self.advantages
        )

    def _run(self, theta: NDArray, sizes: NDArray, observations: NDArray, result: NDArray) -> None:
        """Run a network, on several threads if the batch is large; the number of threads does not change the bits."""
        parts = self.threads if len(observations) * len(theta) > 4e6 else 1
        edges = [len(observations) * i // parts for i in range(parts + 1)]

        def work(i: int) -> None:
            rows = slice(edges[i], edges[i + 1])
            outputs(theta, sizes, self.kind, observations[rows], result[rows], self.work[i % SHARES])

        if parts == 1:
            work(0)
        else:
            list(self.pool.map(work, range(min(parts, SHARES))))

    def learn(self, entropy: float) -> dict[str, float]:
        """Update the parameters with random minibatches of the rollout; return statistics of the last epoch."""
        s, n = self.settings, self.dones.size
        returns = (self.advantages + self.values).reshape(n)
        size, figures = -(-n // s.minibatches), []
        for _ in range(s.epochs):
            order = self.rng.permutation(n)
            figures = [self._update(order[i : i + size], returns, F(entropy)) for i in range(0, n, size)]
        means = self.average(np.mean(figures, axis=0)).tolist()
        result = {f"train/{name}": mean for name, mean in zip(FIGURES, means, strict=True)}
        spread = float(np.var(returns))
        unexplained = float(np.var(self.advantages)) / spread if spread else np.nan
        std = float(np.exp(self.parts(self.theta)[1]).mean())
        return result | {
            "train/explained_variance": 1 - unexplained,
            "train/std": std,
            "train/learning_rate": self.rate,
        }

    def _update(self, rows: NDArray, returns: NDArray, entropy: np.float32) -> NDArray:
        """Make one step of Adam on a minibatch; return `FIGURES`."""
        s, n = self.settings, self.dones.size
        seen, known = self.seen[0].reshape(n, -1), self.seen[-1].reshape(n, -1)
        advantages = self.advantages.reshape(n)
        samples = (seen, self.actions.reshape(n, -1), self.log_probs.reshape(n), advantages)
        chosen = advantages[rows]
        scaling = (chosen.mean(), F(1) / (chosen.std(ddof=1) + F(1e-8)), F(1 / len(rows)))
        actor, log_std, critic = self.parts(self.theta)
        figures = np.zeros((SHARES, len(FIGURES)), F)
        self.gradients[:] = 0

        def work(i: int, part: NDArray) -> None:
            by_actor, by_log_std, by_critic = self.parts(self.gradients[i])
            options = (scaling, F(s.clip), entropy)
            actor_gradient(
                actor, log_std, self.actor_sizes, self.kind, samples, part, *options, by_actor, by_log_std, figures[i],
                self.work[i],
            )  # fmt: skip
            critic_gradient(
                critic, self.critic_sizes, self.kind, (known, returns), part, scaling[2], F(s.value), by_critic,
                figures[i], self.work[i],
            )  # fmt: skip

        list((self.pool.map if self.threads > 1 else map)(work, range(SHARES), np.array_split(rows, SHARES)))
        self.updates += 1
        gradient = self.average(self.gradients.sum(axis=0))
        adam(self.theta, gradient, self.moments[0], self.moments[1], self.updates, self.rate, s.max_grad_norm)
        return figures.sum(axis=0)

    def average(self, values: NDArray) -> NDArray:
        """Return the mean over all processes that learn this policy; here there is one."""
        return values

    def actor(self) -> Actor:
        """Return copies of the layers from observations to mean actions."""
        layers = layers_of(self.parts(self.theta)[0], self.actor_sizes)
        return Actor(tuple((weight.T.copy(), bias.copy()) for weight, bias in layers), self.settings.activation)

    def learned(self) -> dict[str, NDArray]:
        """Return the state of the learner as arrays, without the environments."""
        facts = {
            "steps": self.steps, "updates": self.updates, "rate": self.rate, "rng": self.rng.bit_generator.state,
            "sizes": [self.actor_sizes.tolist(), self.critic_sizes.tolist()], "activation": self.settings.activation,
            "episodes": self.episodes.names,
        }  # fmt: skip
        return {"facts": np.array(json.dumps(facts)), "theta": self.theta, "moments": self.moments}

    def state(self) -> dict[str, NDArray]:
        """Return the state of learner and environments as arrays; see `restore`."""
        native: Any = self.envs.unwrapped
        views = {f"observed_{i}": view for i, view in enumerate(self.observed)}
        state = self.learned() | views | {"episodes": self.episodes.rows()}
        if hasattr(native, "snapshot"):
            state |= {f"env/{name}": array for name, array in native.snapshot().items()}
        return state

    def restore(self, state: dict[str, NDArray]) -> None:
        """Continue from a state; environments are reset if they have no snapshots or their number differs.

        Raises:
            ValueError: If the state has another network.
        """
        facts = json.loads(str(state["facts"]))
        mine = [self.actor_sizes.tolist(), self.critic_sizes.tolist(), self.settings.activation]
        if [*facts["sizes"], facts["activation"]] != mine:
            raise ValueError(f"has layers {facts['sizes'][0]}, {facts['activation']}; expected {mine[0]}, {mine[2]}")
        self.theta[:], self.moments[:] = state["theta"], state["moments"]
        self.steps, self.updates, self.rate = facts["steps"], facts["updates"], facts["rate"]
        self.rng.bit_generator.state = facts["rng"]
        environments = {name.removeprefix("env/"): array for name, array in state.items() if name.startswith("env/")}
        if environments and len(state["observed_0"]) == self.settings.num_envs:
            native: Any = self.envs.unwrapped
            native.restore(environments)
            self.observed = [state[f"observed_{i}"] for i in range(len(self.observed))]
            self.episodes.restore(facts["episodes"], state["episodes"])


def train(job: Job) -> Trained:
    """Train, and save the policy even if Ctrl-C ends training early.

    Raises:
        PolicyError: If the policy to resume does not fit the environment or the settings.
    """
    return run_learner(FastPPO, job)
