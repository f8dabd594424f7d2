"""Run a policy in a batch of environments, and compute the statistics of whole episodes.

Each environment of a batch plays exactly one episode, so that short episodes do not count more often than long ones.
"""

from __future__ import annotations

import hashlib
import importlib
import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ce_gym.adapters.sb3 import SB3VecEnv
from ce_gym.policies import Actor

Array = NDArray[np.float64]

EVALUATION_SEED = 1_000_000
"""Seed for policies whose weights cannot be read; training uses small seeds."""

UNDISTURBED: dict[str, Any] = {"push_period": 0.0, "command_period": 1e6, "heading": False}
"""Arguments of an environment without pushes and new commands of its own."""

LEVEL = "metrics/terrain_level"
"""Entry of an episode's statistics: the terrain level of the episode."""

ERRORS = ("forward_error", "lateral_error", "yaw_rate_error", "velocity_error")

COLUMNS = (
    ("forward [m/s]", "forward_error", ".3f"),
    ("lateral [m/s]", "lateral_error", ".3f"),
    ("yaw [rad/s]", "yaw_rate_error", ".3f"),
    ("velocity [m/s]", "velocity_error", ".3f"),
    ("falls", "falls", ".1%"),
    ("length [s]", "episode_length", ".1f"),
)
"""Columns of result tables: title, key in the results, format."""


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


def without_curricula(env_id: str, kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments of an environment that starts robots on all terrain levels, with the full command range."""
    module, _, name = env_id.rpartition(":")
    if module:  # as `gymnasium.make` does
        importlib.import_module(module)
    registered = gymnasium.registry[name].kwargs if name in gymnasium.registry else {}
    arguments, changed = {**registered, **kwargs}, {}
    terrain = arguments.get("terrain", "flat")
    terrain = dict(terrain) if isinstance(terrain, Mapping) else {"kind": terrain}
    if terrain.get("kind") not in ("flat", "map"):
        changed["terrain"] = terrain | {"curriculum": False}
    if "command_curriculum" in arguments:
        changed["command_curriculum"] = 1.0
    return {**kwargs, **changed}


def run_policy(
    policy: Predicts,
    envs: SB3VecEnv,
    obs: Any,
    before_step: Callable[[int], None] | None = None,
    steps: int | None = None,
) -> Iterator[tuple[NDArray[np.bool_], list[dict[str, Any]]]]:
    """Let a policy act with its mean action, and yield `dones` and `infos` after each step.

    Args:
        policy: The policy.
        envs: The environments.
        obs: First observations, the result of `envs.reset()`.
        before_step: Called before each step with its number, to set commands or apply pushes.
        steps: Number of steps; unlimited if None.
    """
    for step in itertools.count() if steps is None else range(steps):
        action, _ = policy.predict(obs, deterministic=True)
        if before_step:
            before_step(step)
        obs, _, dones, infos = envs.step(action)
        yield dones, infos


def play(policy: Predicts, envs: SB3VecEnv, before_step: Callable[[int], None] | None = None) -> dict[str, Any]:
    """Play one episode in each environment and return statistics.

    Args:
        policy: The policy.
        envs: The environments, seeded.
        before_step: See `run_policy`.

    Returns:
        See `evaluate.evaluate`; `levels` only if the terrain has several.
    """
    native: Any = envs.envs.unwrapped
    n = envs.num_envs
    sums, counts, running = np.zeros((n, 4)), np.zeros(n, int), np.ones(n, bool)
    last_infos: dict[int, dict[str, Any]] = {}
    obs = envs.reset()
    command = native.state()["command"]
    for dones, infos in run_policy(policy, envs, obs, before_step):
        state = native.state()
        continuing = running & ~dones  # an environment that is done has the state of its next episode
        sums[continuing] += magnitudes((planar_velocity(state["v"]) - command)[continuing])
        counts += continuing
        last_infos |= {i: infos[i] for i in np.flatnonzero(running & dones).tolist()}
        running &= ~dones
        if not running.any():
            break
        command = state["command"]  # shown in the next observation
    return _summary(sums, counts, [last_infos[i] for i in range(n)], 1.0 / native.metadata["render_fps"])


def planar_velocity(v: Array) -> Array:
    """Return forward and lateral speed [m/s] and yaw rate [rad/s] of the base, shape (n, 3), from `v` (n, nv)."""
    return np.stack([v[:, 3], v[:, 4], v[:, 2]], axis=1)


def magnitudes(errors: Array) -> Array:
    """Return absolute velocity errors (n, 3) and the horizontal length of each error, shape (n, 4)."""
    return np.column_stack([np.abs(errors), np.hypot(errors[:, 0], errors[:, 1])])


def tracking(errors: Array) -> dict[str, float]:
    """Return mean magnitudes of velocity errors (n, 3) by name; NaN if n is 0."""
    return _by_name(magnitudes(errors).sum(axis=0), len(errors))


def _by_name(sums: Array, count: int) -> dict[str, float]:
    means = (sums / count if count else np.full(4, np.nan)).tolist()
    return dict(zip(ERRORS, means, strict=True))


def _summary(sums: Array, counts: NDArray, infos: list[dict[str, Any]], period: float) -> dict[str, Any]:
    """Return errors as means over steps, and all other statistics as means over episodes.

    Args:
        sums: Sums of magnitudes of errors, shape (n, 4).
        counts: Number of summed steps, shape (n,).
        infos: Information of the last step of each episode.
        period: Length of a control step [s].
    """
    episodes = [info["episode"] for info in infos]
    mean = {key: float(np.mean([episode[key] for episode in episodes])) for key in episodes[0] if key != "t"}
    timed_out = np.array([info["TimeLimit.truncated"] for info in infos])
    diverged = np.array([info["diverged"] for info in infos])
    falls = ~timed_out & ~diverged
    result = {
        **_by_name(sums.sum(axis=0), int(counts.sum())),
        "falls": float(np.mean(falls)),
        "timed_out": float(np.mean(timed_out & ~diverged)),
        "diverged": float(np.mean(diverged)),
        "episode_length": mean.pop("l") * period,
        "reward": mean.pop("r"),
        "episodes": len(infos),
        **mean,
    }
    if LEVEL in mean:
        result["levels"] = _by_level(np.array([round(e[LEVEL]) for e in episodes]), sums, counts, falls)
    return result


def _by_level(level: NDArray, sums: Array, counts: NDArray, falls: NDArray) -> list[dict[str, Any]]:
    """Return errors and falls of the episodes on each terrain level, the lowest level first."""
    rows = []
    for number in np.unique(level).tolist():
        on = level == number
        errors = _by_name(sums[on].sum(axis=0), int(counts[on].sum()))
        rows.append({"level": number, **errors, "falls": float(falls[on].mean()), "episodes": int(on.sum())})
    return rows
