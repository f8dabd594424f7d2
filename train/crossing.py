"""How many robots cross a stretch of ground: all walk straight at one speed, and those that get there are counted.

They are steered as by hand: the yaw rate is commanded towards a point ahead on a line along the world's y-axis, which
on ground of tiles stays on one level. Uses public names of ce_gym only, and no name of a robot or task.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from console import Table, markdown
from numpy.typing import NDArray
from suites import everywhere

from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.policies import Policy, PolicyError

Array = NDArray[np.float64]

GAIN = 2.0
"""Commanded yaw rate over the error of the heading [1/s]."""
AHEAD = 1.0
"""Robots head for a point of their line that is so far ahead [m]."""
PATIENCE = 2.0
"""Robots have so many times as long as they would need at the commanded speed."""


def cross(
    policy: Policy, episodes: int, seed: int, *, distance: float = 8.0, speed: float = 0.5, **kwargs: Any
) -> dict[str, Any]:
    """Let robots walk straight, each once, and count those that come so far without a fall.

    Curricula are left out. On tiles robots walk towards the middle of the field; from the middle of a tile 8 m away
    is the middle of the next, on stairs the bottom of a pit from the top of a pyramid or the other way round.

    Args:
        policy: With its record.
        episodes: Robots.
        seed: Of the first environment.
        distance: How far along the line they have to come [m].
        speed: Commanded forward [m/s].
        **kwargs: Given to the environment, such as `transmission`.

    Returns:
        crossed, fell: shares of the robots, those that do neither run out of time; episodes, distance, speed; levels,
        where the ground has some: the same of each.

    Raises:
        PolicyError: If the task of the policy has no commands.
    """
    record = policy.record
    if "command" not in record["policy_spec"]:
        raise PolicyError(f"crossing: {record['env']} has no commanded velocities; expected a task with them")
    arguments = everywhere(record["env"], kwargs)
    steps = math.ceil(PATIENCE * distance / speed / record["policy_spec"]["control_dt"])
    arguments |= {"push_period": 0.0, "command_period": 1e6, "heading": False, "max_episode_steps": steps + 1}
    envs = make_sb3_vec_env(record["env"], episodes, seed, **arguments)
    try:
        crossed, fell, level = _walk(policy, envs, steps, distance, speed, _middle(arguments.get("terrain")))
    finally:
        envs.close()
    result = {**_shares(crossed, fell), "distance": distance, "speed": speed}
    if level.size:
        found = [(number, level == number) for number in np.unique(level).tolist()]
        result["levels"] = [{"level": number, **_shares(crossed[on], fell[on])} for number, on in found]
    return result


def _walk(policy: Policy, envs: Any, steps: int, distance: float, speed: float, middle: float) -> tuple[NDArray, ...]:
    """Return who crossed, who fell, and the level of each, from 0; none where the ground has no levels."""
    native: Any = envs.envs.unwrapped
    observation: Any = envs.reset()
    start = native.batch.rows("q")[:, :2].astype(float)
    side = np.where(start[:, 1] > middle, -1.0, 1.0)
    level = np.empty(0, int)
    if "level" in native.batch.schema:
        level = np.rint(native.batch.rows("level")[:, 0]).astype(int)
    crossed, fell = np.zeros(envs.num_envs, bool), np.zeros(envs.num_envs, bool)
    for _ in range(steps):
        q = native.batch.rows("q").astype(float)
        crossed |= ~fell & (side * (q[:, 1] - start[:, 1]) >= distance)
        if (crossed | fell).all():
            break
        native.set_command(steered(q, start[:, 0], side, speed))
        observation, _, dones, _ = envs.step(policy.predict(observation)[0])
        fell |= dones & ~crossed
    return crossed, fell, level


def steered(q: Array, line: Array, side: Array, speed: float) -> Array:
    """Return commands that keep robots on lines along y, shape (n, 3).

    Args:
        q: Positions, a quaternion (w, x, y, z) from column 3 on, shape (n, nq).
        line: x of each robot's line [m], shape (n,).
        side: 1 for those that walk along y, -1 for those that walk against it, shape (n,).
        speed: [m/s]
    """
    w, x, y, z = q[:, 3:7].T
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    error = np.arctan2(side * AHEAD, line - q[:, 0]) - heading
    turn = np.clip(GAIN * np.arctan2(np.sin(error), np.cos(error)), -1.0, 1.0)
    return np.column_stack([np.full(len(q), speed), np.zeros(len(q)), turn])


def _middle(terrain: Any) -> float:
    """Middle of a field of tiles along y [m]; of other ground the origin."""
    terrain = terrain if isinstance(terrain, Mapping) else {}
    return terrain.get("size", 8.0) * terrain.get("columns", 4) / 2 if terrain.get("kind") not in (None, "map") else 0.0


def _shares(crossed: NDArray, fell: NDArray) -> dict[str, Any]:
    return {"crossed": float(crossed.mean()), "fell": float(fell.mean()), "episodes": len(crossed)}


def crossing_table(result: Mapping[str, Any]) -> str:
    """One line per level of the ground and one for all of them, as Markdown."""
    rows: Table = [["level", f"crossed {result['distance']:g} m at {result['speed']:g} m/s", "fell", "robots"]]
    for row in [*result.get("levels", ()), {"level": "all", **result}]:
        rows.append([str(row["level"]), f"{row['crossed']:.1%}", f"{row['fell']:.1%}", str(row["episodes"])])
    return markdown(rows)
