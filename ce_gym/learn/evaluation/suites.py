"""Evaluate policies with special commands: jumping commands, standing, turning in place, walking backwards, pushes.

All suites use one kernel, because this file sets commands and pushes from outside.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ce_gym.learn.evaluation.episodes import UNDISTURBED, command_ranges, open_environments, play, without_curricula
from ce_gym.policies import Policy

SETTLE = 1.0
"""Time before the first push [s]."""


@dataclass(frozen=True)
class Suite:
    """Commands and pushes of an episode.

    Attributes:
        about: Description.
        moving: Whether forward, sideways and turning commands are drawn; otherwise they are 0.
        backwards: Whether forward commands are drawn from the lower half of the negative range.
        period: Time between commands [s].
        push: Largest change of the base's horizontal velocity along each axis [m/s].
        push_period: Time between pushes [s].
    """

    about: str
    moving: tuple[bool, bool, bool] = (True, True, True)
    backwards: bool = False
    period: float = 5.0
    push: float = 0.0
    push_period: float = 2.5


SUITES: Mapping[str, Suite] = {
    "jumping": Suite("new commands every second", period=1.0),
    "standing": Suite("commands to stand", (False, False, False)),
    "turning": Suite("turning in place", (False, False, True)),
    "backwards": Suite("straight backwards, at half the largest speed or more", (True, False, False), backwards=True),
    "pushes": Suite("pushed every 2.5 s, by up to 0.5 m/s each way", push=0.5),
}


def evaluate_suites(policy: Policy, episodes: int, seed: int, **kwargs: Any) -> dict[str, dict[str, Any]]:
    """Play one episode of each suite in each of `episodes` environments, and return the statistics by suite.

    Args:
        policy: Policy with its record.
        episodes: Episodes of each suite.
        seed: Seed of the first environment, of commands and of pushes.
        **kwargs: Arguments of the environment, such as `transmission`.

    Raises:
        PolicyError: If the task of the policy has no commands.
    """
    env_id, ranges = policy.record["env"], command_ranges(policy, "suites")
    arguments = without_curricula(env_id, kwargs) | UNDISTURBED
    result = {}
    for name, suite in SUITES.items():
        with open_environments(env_id, episodes, seed, **arguments) as (envs, obs):
            drive = driver(suite, envs.unwrapped, ranges, seed)
            result[name] = play(policy, envs, obs, drive, name)
    return result


def driver(suite: Suite, native: Any, ranges: np.ndarray, seed: int) -> Callable[[int], None]:
    """Return a function that sets the command of a step and applies its push, if they are due.

    Args:
        suite: The suite.
        native: The environments.
        ranges: Lower and upper bound of forward [m/s], sideways [m/s] and turning [rad/s] commands, shape (3, 2).
        seed: Seed of commands and pushes.
    """
    n, rate, rng = native.num_envs, native.metadata["render_fps"], np.random.default_rng(seed)
    ranges = ranges * np.array(suite.moving)[:, None]
    if suite.backwards:
        ranges[0] = np.minimum(ranges[0, 0] * np.array([1.0, 0.5]), 0.0)

    def drive(step: int) -> None:
        if step % round(suite.period * rate) == 0:
            native.set_command(rng.uniform(ranges[:, 0], ranges[:, 1], (n, 3)))
        since = step - round(SETTLE * rate)
        if suite.push and since >= 0 and since % round(suite.push_period * rate) == 0:
            v = native.batch.rows("v")
            v[:, 3:5] += rng.uniform(-suite.push, suite.push, (n, 2))
            native.batch.write("v", v)

    return drive
