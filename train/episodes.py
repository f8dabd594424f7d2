"""Whole episodes of a policy's mean action in parallel, and their statistics.

Every environment of a batch plays exactly one episode, so that short episodes do not count more often than long ones.
Uses public names of ce_gym only, and no name of a robot or task.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.adapters.sb3 import SB3VecEnv
from ce_gym.policies import Policy

if TYPE_CHECKING:
    from stable_baselines3 import PPO

LEVEL = "metrics/terrain_level"
"""What an episode says of the level of the terrain that it was on."""

Array = NDArray[np.float64]


def play(model: PPO | Policy, envs: SB3VecEnv, drive: Callable[[int], None] | None = None) -> dict[str, Any]:
    """Step until every environment has ended its first episode.

    Args:
        model: The policy.
        envs: The environments, seeded.
        drive: Called before each step with its number, to give commands or pushes.

    Returns:
        See `evaluate.evaluate`; `levels` of the terrain only where there are several.
    """
    native: Any = envs.envs.unwrapped
    n, ended, step = envs.num_envs, {}, 0
    sums, counts, running = np.zeros((n, 4)), np.zeros(n, int), np.ones(n, bool)
    obs = envs.reset()
    while running.any():
        command = native.state()["command"]  # the one the observation shows
        action, _ = model.predict(obs, deterministic=True)  # type: ignore[arg-type]
        if drive:
            drive(step)
        obs, _, dones, infos = envs.step(action)
        going = running & ~dones  # an environment that is done shows its next episode already
        sums[going] += magnitudes((planar_velocity(native.state()["v"]) - command)[going])
        counts += going
        ended |= {i: infos[i] for i in np.flatnonzero(running & dones)}
        running &= ~dones
        step += 1
    return _summary(sums, counts, [ended[i] for i in range(n)], 1.0 / native.metadata["render_fps"])


def planar_velocity(v: Array) -> Array:
    """Forward and lateral speed [m/s] and yaw rate [rad/s] of the base, shape (n, 3); `v` has angular part first."""
    return np.stack([v[:, 3], v[:, 4], v[:, 2]], axis=1)


def magnitudes(errors: Array) -> Array:
    """Return how large differences of velocities (n, 3) are, each entry and the horizontal length, shape (n, 4)."""
    return np.column_stack([np.abs(errors), np.hypot(errors[:, 0], errors[:, 1])])


def tracking(errors: Array) -> dict[str, float]:
    """Means of how far velocities (n, 3) are from those commanded, by name; not a number if there are none."""
    return _by_name(magnitudes(errors).sum(axis=0), len(errors))


def _by_name(sums: Array, count: int) -> dict[str, float]:
    means = (sums / count if count else np.full(4, np.nan)).tolist()
    return dict(zip(("forward_error", "lateral_error", "yaw_rate_error", "velocity_error"), means, strict=True))


def _summary(sums: Array, counts: NDArray, ended: list[dict[str, Any]], period: float) -> dict[str, Any]:
    """Means over steps (errors) and over episodes (the rest)."""
    episodes = [info["episode"] for info in ended]
    mean = {key: float(np.mean([episode[key] for episode in episodes])) for key in episodes[0] if key != "t"}
    timed_out = np.array([info["TimeLimit.truncated"] for info in ended])
    diverged = np.array([info["diverged"] for info in ended])
    falls = ~timed_out & ~diverged
    result = {
        **_by_name(sums.sum(axis=0), int(counts.sum())),
        "falls": float(np.mean(falls)),
        "timed_out": float(np.mean(timed_out & ~diverged)),
        "diverged": float(np.mean(diverged)),
        "episode_length": mean.pop("l") * period,
        "reward": mean.pop("r"),
        "episodes": len(ended),
        **mean,
    }
    if LEVEL in mean:
        result["levels"] = _by_level(np.array([round(e[LEVEL]) for e in episodes]), sums, counts, falls)
    return result


def _by_level(level: NDArray, sums: Array, counts: NDArray, falls: NDArray) -> list[dict[str, Any]]:
    """Errors and falls of the episodes on each level of the terrain, the lowest first."""
    rows = []
    for number in np.unique(level).tolist():
        on = level == number
        errors = _by_name(sums[on].sum(axis=0), int(counts[on].sum()))
        rows.append({"level": number, **errors, "falls": float(falls[on].mean()), "episodes": int(on.sum())})
    return rows
