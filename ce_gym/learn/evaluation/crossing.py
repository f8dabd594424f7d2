"""Count the robots that walk straight across a stretch of ground without a fall.

All robots walk at one speed along the world's y-axis, a line that stays on one level if the ground has tiles. The
commanded yaw rate steers each robot towards a point ahead on its line.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.learn.evaluation.episodes import (
    UNDISTURBED,
    command_ranges,
    open_environments,
    run_policy,
    without_curricula,
)
from ce_gym.policies import Policy

Array = NDArray[np.float64]

GAIN = 2.0
"""Commanded yaw rate divided by the heading error [1/s]."""
AHEAD = 1.0
"""Distance of the target point ahead on the line [m]."""
PATIENCE = 2.0
"""Time limit, as a multiple of the time at the commanded speed."""


def cross(
    policy: Policy, episodes: int, seed: int, *, distance: float = 8.0, speed: float = 0.5, **kwargs: Any
) -> dict[str, Any]:
    """Let each robot walk straight once, and count the robots that cover a distance without a fall.

    Curricula are disabled. On tiles, robots walk towards the middle of the field. The default distance is that between
    the middles of neighbouring tiles; on stairs robots walk from the top of a pyramid to the bottom of a pit, or up.

    Args:
        policy: Policy with its record.
        episodes: Number of robots.
        seed: Seed of the first environment.
        distance: Distance along the line [m].
        speed: Commanded forward speed [m/s].
        **kwargs: Arguments of the environment, such as `transmission`.

    Returns:
        - crossed, fell: Fractions of the robots; all others reached the time limit.
        - episodes, distance, speed: The arguments.
        - levels: crossed, fell and episodes for each terrain level, if the ground has levels.

    Raises:
        PolicyError: If the task of the policy has no commands.
    """
    env_id, spec = policy.record["env"], policy.record["policy_spec"]
    command_ranges(policy, "crossing")
    steps = math.ceil(PATIENCE * distance / speed / spec["control_dt"])
    arguments = without_curricula(env_id, kwargs) | UNDISTURBED | {"max_episode_steps": steps + 1}
    with open_environments(env_id, episodes, seed, **arguments) as (envs, obs):
        native: Any = envs.unwrapped
        start = native.batch.rows("q")[:, :2].astype(float)
        side = np.where(start[:, 1] > _middle(arguments.get("terrain")), -1.0, 1.0)
        level = np.rint(native.batch.rows("level")[:, 0]).astype(int) if "level" in native.batch.schema else None
        crossed, fell = np.zeros((2, episodes), bool)

        def steer(_step: int) -> None:
            q = native.batch.rows("q").astype(float)
            crossed[:] |= ~fell & (side * (q[:, 1] - start[:, 1]) >= distance)
            native.set_command(steering_command(q, start[:, 0], side, speed))

        for step in run_policy(policy, envs, obs, steer, steps, "crossing"):
            fell |= step.done & ~crossed
            if (crossed | fell).all():
                break

    def shares(robots: Any = slice(None)) -> dict[str, Any]:
        counts = {"crossed": float(crossed[robots].mean()), "fell": float(fell[robots].mean())}
        return {**counts, "episodes": len(crossed[robots])}

    result = {**shares(), "distance": distance, "speed": speed}
    if level is not None:
        result["levels"] = [{"level": number, **shares(level == number)} for number in np.unique(level).tolist()]
    return result


def steering_command(q: Array, line: Array, side: Array, speed: float) -> Array:
    """Return commands that keep robots on lines along y, shape (n, 3).

    Args:
        q: Positions with the quaternion (w, x, y, z) from column 3, shape (n, nq).
        line: x of each robot's line [m], shape (n,).
        side: Direction of each robot, 1 along y and -1 against y, shape (n,).
        speed: Forward speed [m/s].
    """
    w, x, y, z = q[:, 3:7].T
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    error = np.arctan2(side * AHEAD, line - q[:, 0]) - heading
    turn = np.clip(GAIN * np.arctan2(np.sin(error), np.cos(error)), -1.0, 1.0)
    return np.column_stack([np.full(len(q), speed), np.zeros(len(q)), turn])


def _middle(terrain: Any) -> float:
    """Return y of the middle of a field of tiles [m]; 0 for other ground."""
    terrain = terrain if isinstance(terrain, Mapping) else {}
    return terrain.get("size", 8.0) * terrain.get("columns", 4) / 2 if terrain.get("kind") not in (None, "map") else 0.0
