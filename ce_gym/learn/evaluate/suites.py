"""Evaluate policies with special commands: jumping commands, standing, turning in place, walking backwards, pushes.

All suites use one kernel, because this file sets commands and pushes from outside.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np

from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.console import Table, markdown
from ce_gym.learn.evaluate.episodes import UNDISTURBED, play, without_curricula
from ce_gym.policies import Policy, PolicyError

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
    env_id = policy.record["env"]
    ranges = policy.record["policy_spec"].get("command", {}).get("range")
    if ranges is None:
        raise PolicyError(f"suites: {env_id} has no commanded velocities; expected a task with them")
    arguments = without_curricula(env_id, kwargs) | UNDISTURBED
    result = {}
    for name, suite in SUITES.items():
        with closing(make_sb3_vec_env(env_id, episodes, seed, **arguments)) as envs:
            result[name] = play(policy, envs, Driver(suite, envs.envs.unwrapped, np.array(ranges), seed))
    return result


class Driver:
    """Sets the commands of a suite and applies its pushes.

    Args:
        suite: The suite.
        native: The environments.
        ranges: Lower and upper bound of forward [m/s], sideways [m/s] and turning [rad/s] commands, shape (3, 2).
        seed: Seed of commands and pushes.
    """

    def __init__(self, suite: Suite, native: Any, ranges: np.ndarray, seed: int) -> None:
        self.suite, self.native, self.rng = suite, native, np.random.default_rng(seed)
        ranges = ranges * np.array(suite.moving)[:, None]
        if suite.backwards:
            ranges[0] = np.minimum(ranges[0, 0] * np.array([1.0, 0.5]), 0.0)
        self.low, self.high = ranges.T

    def __call__(self, step: int) -> None:
        """Set the command and apply the push of a step, if one is due."""
        n, dt = self.native.num_envs, self.native.metadata["render_fps"] ** -1
        if step % round(self.suite.period / dt) == 0:
            self.native.set_command(self.rng.uniform(self.low, self.high, (n, 3)))
        since = step - round(SETTLE / dt)
        if self.suite.push and since >= 0 and since % round(self.suite.push_period / dt) == 0:
            v = self.native.batch.rows("v")
            v[:, 3:5] += self.rng.uniform(-self.suite.push, self.suite.push, (n, 2))
            self.native.batch.write("v", v)


def suite_table(result: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a Markdown table with one line per suite."""
    keys = (("forward_error", ".3f"), ("lateral_error", ".3f"), ("yaw_rate_error", ".3f"), ("falls", ".1%"))
    rows: Table = [["suite", "forward [m/s]", "sideways [m/s]", "yaw rate [rad/s]", "falls"]]
    for name, figures in result.items():
        rows.append([f"{name}: {SUITES[name].about}", *(f"{figures[key]:{form}}" for key, form in keys)])
    return markdown(rows)


def level_table(levels: list[dict[str, Any]]) -> str:
    """Return a Markdown table with one line per terrain level."""
    rows: Table = [["level", "forward [m/s]", "velocity [m/s]", "falls", "episodes"]]
    for row in levels:
        figures = (f"{row['forward_error']:.3f}", f"{row['velocity_error']:.3f}", f"{row['falls']:.1%}")
        rows.append([str(row["level"]), *figures, str(row["episodes"])])
    return markdown(rows)
