"""Suites of commands and pushes on which policies are judged, and the seed, which follows from the weights.

Suites: commands that jump, standing, turning in place, going backwards, pushes.
One kernel serves all suites: commands and pushes are given from outside. Uses public names of ce_gym only, and no name
of a robot or task.
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from console import Table, markdown
from episodes import play

from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.policies import Actor, Policy, PolicyError

EVALUATION_SEED = 1_000_000
"""Far from training seeds; for what has no weights that could be read."""

SETTLE = 1.0
"""Time before the first push [s]."""


@dataclass(frozen=True)
class Suite:
    """What robots are asked to do in an episode.

    Attributes:
        about: In words.
        moving: Which of forward, sideways and turning commands are drawn, the others are 0.
        backwards: Whether forward commands are from the lower half of what is below 0.
        period: Time between commands [s].
        push: Largest change of the base's horizontal velocity, each way [m/s].
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


def weights_seed(model: Any) -> int:
    """Return the first 32 bits of the SHA-256 of a policy's weights, float32 layer by layer, weight before bias."""
    actor = getattr(model, "act", None)
    if not isinstance(actor, Actor):
        return EVALUATION_SEED
    digest = hashlib.sha256()
    for layer in actor.layers:
        for array in layer:
            digest.update(np.ascontiguousarray(array, "<f4").tobytes())
    return int.from_bytes(digest.digest()[:4], "big")


def everywhere(env_id: str, kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments of an environment without curricula: any level of its ground, all of its commands."""
    module, _, name = env_id.rpartition(":")
    if module:  # as `gymnasium.make` does it
        importlib.import_module(module)
    registered = gymnasium.registry[name].kwargs if name in gymnasium.registry else {}
    given, changed = {**registered, **kwargs}, {}
    terrain = given.get("terrain", "flat")
    terrain = dict(terrain) if isinstance(terrain, Mapping) else {"kind": terrain}
    if terrain.get("kind") not in ("flat", "map"):
        changed["terrain"] = terrain | {"curriculum": False}
    if "command_curriculum" in given:
        changed["command_curriculum"] = 1.0
    return {**kwargs, **changed}


def judge_suites(policy: Policy, episodes: int, seed: int, **kwargs: Any) -> dict[str, dict[str, Any]]:
    """Play one episode of each suite in each of `episodes` environments, and return the figures by suite.

    Args:
        policy: With its record.
        episodes: Episodes of each suite.
        seed: Of the first environment, of commands and of pushes.
        **kwargs: Given to the environment, such as `transmission`.

    Raises:
        PolicyError: If the task of the policy has no commands.
    """
    ranges = policy.record["policy_spec"].get("command", {}).get("range")
    if ranges is None:
        raise PolicyError(f"suites: {policy.record['env']} has no commanded velocities; expected a task with them")
    still = {"push_period": 0.0, "command_period": 1e6, "heading": False}
    made = {**everywhere(policy.record["env"], kwargs), **still}
    result = {}
    for name, suite in SUITES.items():
        envs = make_sb3_vec_env(policy.record["env"], episodes, seed, **made)
        try:
            result[name] = play(policy, envs, Driver(suite, envs.envs.unwrapped, np.array(ranges), seed))
        finally:
            envs.close()
    return result


class Driver:
    """Gives the commands and pushes of a suite.

    Args:
        suite: What to ask for.
        native: The environments.
        ranges: Lower and upper bound of forward [m/s], sideways [m/s] and turning [rad/s] commands, shape (3, 2).
        seed: Of what is drawn.
    """

    def __init__(self, suite: Suite, native: Any, ranges: np.ndarray, seed: int) -> None:
        self.suite, self.native, self.rng = suite, native, np.random.default_rng(seed)
        ranges = ranges * np.array(suite.moving)[:, None]
        if suite.backwards:
            ranges[0] = np.minimum(ranges[0, 0] * np.array([1.0, 0.5]), 0.0)
        self.low, self.high = ranges.T

    def __call__(self, step: int) -> None:
        """Do what is due before a step."""
        n, dt = self.native.num_envs, self.native.metadata["render_fps"] ** -1
        if step % round(self.suite.period / dt) == 0:
            self.native.set_command(self.rng.uniform(self.low, self.high, (n, 3)))
        since = step - round(SETTLE / dt)
        if self.suite.push and since >= 0 and since % round(self.suite.push_period / dt) == 0:
            v = self.native.batch.rows("v")
            v[:, 3:5] += self.rng.uniform(-self.suite.push, self.suite.push, (n, 2))
            self.native.batch.write("v", v)


def suite_table(result: Mapping[str, Mapping[str, Any]]) -> str:
    """One line per suite, as Markdown."""
    titles = ["asked for", "forward [m/s]", "sideways [m/s]", "yaw rate [rad/s]", "falls"]
    keys = (("forward_error", ".3f"), ("lateral_error", ".3f"), ("yaw_rate_error", ".3f"), ("falls", ".1%"))
    rows: Table = [titles]
    for name, figures in result.items():
        rows.append([f"{name}: {SUITES[name].about}", *(f"{figures[key]:{form}}" for key, form in keys)])
    return markdown(rows)


def level_table(levels: list[dict[str, Any]]) -> str:
    """One line per level of the terrain, as Markdown."""
    rows: Table = [["level", "forward [m/s]", "velocity [m/s]", "falls", "episodes"]]
    for row in levels:
        figures = (f"{row['forward_error']:.3f}", f"{row['velocity_error']:.3f}", f"{row['falls']:.1%}")
        rows.append([str(row["level"]), *figures, str(row["episodes"])])
    return markdown(rows)
