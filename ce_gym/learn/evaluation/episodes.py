"""Run a policy in a batch of environments, and compute the statistics of whole episodes.

Each environment of a batch plays exactly one episode, so that short episodes do not count more often than long ones.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from ce_gym.console import progress
from ce_gym.policies import Actor, Policy, PolicyError, registered

Array = NDArray[np.float64]

EVALUATION_SEED = 1_000_000
"""Seed for policies whose weights cannot be read; training uses small seeds."""

UNDISTURBED: dict[str, Any] = {"push_period": 0.0, "command_period": 1e6, "heading": False}
"""Arguments of an environment without pushes and new commands of its own."""

UNLIMITED = 10**9
"""`max_episode_steps` of an environment without time limit."""

LEVEL = "metrics/terrain_level"
"""Entry of an episode's statistics: the terrain level of the episode."""

ERRORS = ("forward_error", "lateral_error", "yaw_rate_error", "velocity_error")


class Predicts(Protocol):
    """A policy, or a learner of Stable-Baselines3."""

    def predict(self, observation: Any, /, *, deterministic: bool) -> tuple[Any, Any]:
        """Return actions (n, n_actions), and a state that is not used."""
        ...


def weights_seed(policy: Any) -> int:
    """Return the first 32 bits of the SHA-256 of a policy's weights, float32 layer by layer, weight before bias."""
    actor = getattr(policy, "act", None)
    if not isinstance(actor, Actor):
        return EVALUATION_SEED
    digest = hashlib.sha256()
    for layer in actor.layers:
        for array in layer:
            digest.update(np.ascontiguousarray(array, "<f4").tobytes())
    return int.from_bytes(digest.digest()[:4], "big")


def command_ranges(policy: Policy, what: str) -> Array:
    """Return the bounds of the commands of a policy's task, shape (3, 2) [m/s, m/s, rad/s].

    Raises:
        PolicyError: If the task has no commands; the message begins with `what`.
    """
    spec = policy.record["policy_spec"]
    ranges, blocks = spec.get("command", {}).get("range"), spec.get("observation", {}).get("blocks")
    if ranges is None or (blocks and not any("command" in block["name"] for block in blocks)):
        raise PolicyError(f"{what}: {policy.record['env']} has no commanded velocities; expected a task with them")
    return np.array(ranges)


def without_curricula(env_id: str, kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments of an environment that starts robots on all terrain levels, with the full command range."""
    arguments, changed = {**registered(env_id).kwargs, **kwargs}, {}
    terrain = arguments.get("terrain", "flat")
    terrain = dict(terrain) if isinstance(terrain, Mapping) else {"kind": terrain}
    if terrain.get("kind") not in ("flat", "map"):
        changed["terrain"] = terrain | {"curriculum": False}
    if "command_curriculum" in arguments:
        changed["command_curriculum"] = 1.0
    return {**kwargs, **changed}


@contextmanager
def open_environments(env_id: str, num_envs: int, seed: int, **kwargs: Any) -> Iterator[tuple[VectorEnv, Any]]:
    """Yield a vector environment after its reset, and its first observations; close it at the end.

    Args:
        env_id: Registered environment id.
        num_envs: Number of environments.
        seed: Seed of the first environment; environment i gets `seed + i`.
        **kwargs: Arguments of the environment, such as `transmission`.

    Raises:
        gymnasium.error.Error: If the id is unknown or has no native vector environment.
        ValueError: If an argument is wrong.
    """
    options = {"autoreset_mode": AutoresetMode.SAME_STEP, **kwargs}
    try:
        envs = gymnasium.make_vec(env_id, num_envs, vectorization_mode="vector_entry_point", **options)
    except (TypeError, ImportError) as error:  # an unknown argument or module
        raise ValueError(f"environment {env_id!r}: {error}") from error
    with closing(envs):
        yield envs, envs.reset(seed=seed)[0]


class Step(NamedTuple):
    """Result of a control step: whether each episode has ended, and whether at its time limit, shape (n,) each."""

    done: NDArray[np.bool_]
    timed_out: NDArray[np.bool_]
    infos: dict[str, Any]


def run_policy(
    policy: Predicts,
    envs: VectorEnv,
    obs: Any,
    before_step: Callable[[int], None] | None = None,
    steps: int | None = None,
    label: str = "episodes",
) -> Iterator[Step]:
    """Let a policy act with its mean action, and yield the result of each step.

    Args:
        policy: The policy.
        envs: The environments; one that is done has the state of its next episode.
        obs: Their first observations.
        before_step: Called before each step with its number, to set commands or apply pushes.
        steps: Number of steps; unlimited if None.
        label: Label of the progress bar.
    """
    numbers = itertools.count() if steps is None else range(steps)
    longest = getattr(envs.unwrapped, "max_episode_steps", None)
    for number in progress(numbers, label, longest if steps is None else steps):
        action, _ = policy.predict(obs, deterministic=True)
        if before_step:
            before_step(number)
        obs, _, terminated, truncated, infos = envs.step(action)
        yield Step(terminated | truncated, truncated & ~terminated, infos)


class TrackingErrors:
    """Magnitudes of forward, lateral, yaw rate and horizontal velocity errors, summed over the steps of each robot."""

    def __init__(self, num_envs: int) -> None:
        self.sums, self.counts = np.zeros((num_envs, 4)), np.zeros(num_envs, int)

    def add(self, v: Array, command: Array, counted: NDArray[np.bool_]) -> None:
        """Add a step of the robots in `counted` (n,), from velocities `v` (n, nv) and commands (n, 3)."""
        errors = (np.stack([v[:, 3], v[:, 4], v[:, 2]], axis=1) - command)[counted]
        self.sums[counted] += np.column_stack([np.abs(errors), np.hypot(errors[:, 0], errors[:, 1])])
        self.counts += counted

    def means(self, robots: Any = slice(None)) -> dict[str, float]:
        """Return the means over all steps of some robots by name; NaN if there are no steps."""
        count = int(self.counts[robots].sum())
        means = self.sums[robots].sum(axis=0) / count if count else np.full(4, np.nan)
        return dict(zip(ERRORS, means.tolist(), strict=True))


def play(
    policy: Predicts,
    envs: VectorEnv,
    obs: Any,
    before_step: Callable[[int], None] | None = None,
    label: str = "episodes",
) -> dict[str, Any]:
    """Play one episode in each environment and return statistics, see `evaluation.evaluate`.

    For the arguments, see `run_policy`.
    """
    native: Any = envs.unwrapped
    errors, running = TrackingErrors(envs.num_envs), np.ones(envs.num_envs, bool)
    statistics: dict[str, Array] = {}
    command = native.state()["command"]
    for step in run_policy(policy, envs, obs, before_step, label=label):
        state, ended = native.state(), running & step.done
        running &= ~ended
        errors.add(state["v"], command, running)
        if ended.any():
            for key, values in _episode_statistics(step).items():
                statistics.setdefault(key, np.zeros(envs.num_envs))[ended] = values[ended]
        if not running.any():
            break
        command = state["command"]  # shown in the next observation
    return _summary(errors, statistics, 1.0 / native.metadata["render_fps"])


def _episode_statistics(step: Step) -> dict[str, NDArray]:
    """Return statistics of episodes by name, shape (n,) each, valid where `done`.

    Environments of ce_gym report `episode_terms`; others report `episode`, by Gymnasium's `RecordEpisodeStatistics`.
    """
    diverged = step.infos.get("diverged", np.zeros(len(step.done), bool))
    flags = {"falls": ~step.timed_out & ~diverged, "timed_out": step.timed_out & ~diverged, "diverged": diverged}
    if "episode_terms" in step.infos:
        return flags | step.infos["episode_terms"]
    episode = step.infos["episode"]
    return {**flags, "return": episode["r"], "length": episode["l"]}


def _summary(errors: TrackingErrors, statistics: dict[str, Array], period: float) -> dict[str, Any]:
    """Return errors as means over steps of `period` [s], and statistics (n,) of episodes as means over episodes."""
    mean = {key: float(values.mean()) for key, values in statistics.items()}
    totals = {"episode_length": mean.pop("length") * period, "reward": mean.pop("return")}
    result = {**errors.means(), **totals, "episodes": len(errors.counts), **mean}
    if LEVEL in statistics:
        level, falls = np.rint(statistics[LEVEL]).astype(int), statistics["falls"]
        groups = [(number, level == number) for number in np.unique(level).tolist()]
        result["levels"] = [
            {"level": number, **errors.means(on), "falls": float(falls[on].mean()), "episodes": int(on.sum())}
            for number, on in groups
        ]
    return result
