"""How hard a walking robot can be pushed, and from where: the share that keeps on its feet.

A push is an instantaneous change of the base's horizontal velocity, like the environment's own pushes. Robots of one
cell of the grid are pushed at different moments of their gait. Uses public names of ce_gym only, and no name of a
robot or task.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.policies import Policy

SPEEDS = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
"""Changes of velocity [m/s]; 0 shows how many would have stayed on their feet anyway."""

SETTLE, SPREAD, WAIT = 2.0, 0.8, 3.0
"""Before the first push, between the first and the last of a cell, and after each until a robot counts as safe [s]."""

SAFE = 0.9
"""Share of robots that must stay on their feet for a push to count as survived."""


def push_envelope(
    policy: Policy,
    *,
    speeds: Sequence[float] = SPEEDS,
    directions: int = 8,
    repeats: int = 16,
    seed: int = 0,
    **kwargs: Any,
) -> dict[str, Any]:
    """Push robots that walk forward at half their largest commanded speed.

    Args:
        policy: With its record.
        speeds: Changes of velocity [m/s], one per column of the grid.
        directions: Number of directions, all round, from "forward" on to the left.
        repeats: Robots in each cell.
        seed: Of the first robot.
        **kwargs: Given to the environment.

    Returns:
        command [m/s, rad/s]; speeds [m/s]; directions [deg], in which robots are pushed, 0 forward, 90 left; survived:
        share of each direction (row) and speed (column) without a fall within `WAIT` of the push.
        envelope: for each direction, the largest speed up to which at least `SAFE` survive every push [m/s], None if
        not even the smallest.
    """
    spec = policy.record["policy_spec"]
    dt = spec["control_dt"]
    angles = np.arange(directions) * 360.0 / directions
    angle, speed, repeat = (x.ravel() for x in np.meshgrid(angles, speeds, np.arange(repeats), indexing="ij"))
    when = np.round((SETTLE + SPREAD * repeat / repeats) / dt).astype(int)
    push = speed[:, None] * np.stack([np.cos(np.radians(angle)), np.sin(np.radians(angle))], axis=1)
    command = [spec["command"]["range"][0][1] / 2, 0.0, 0.0]
    still = {"push_period": 0.0, "command_period": 1e6, "heading": False, "max_episode_steps": 10**9}
    envs = make_sb3_vec_env(policy.record["env"], len(angle), seed, **{**kwargs, **still})
    try:
        native: Any = envs.envs.unwrapped
        obs, standing = envs.reset(), np.ones(len(angle), bool)
        for step in range(int(when.max() + round(WAIT / dt))):
            native.set_command(command)
            due = standing & (when == step)
            if due.any():
                v = native.batch.rows("v")
                v[:, 3:5] += push
                native.batch.write("v", v, due)
            action, _ = policy.predict(obs)
            obs, _, dones, _ = envs.step(action)
            standing &= ~(dones & (step < when + round(WAIT / dt)))
    finally:
        envs.close()
    survived = standing.reshape(directions, len(speeds), repeats).mean(axis=2)
    return {
        "command": command,
        "speeds": [float(x) for x in speeds],
        "directions": angles.tolist(),
        "survived": survived.tolist(),
        "envelope": [_largest(speeds, row) for row in survived],
    }


def _largest(speeds: Sequence[float], survived: Any) -> float | None:
    """The last speed before the first at which too few survive."""
    safe = [float(speed) for speed, ok in zip(speeds, np.logical_and.accumulate(survived >= SAFE), strict=True) if ok]
    return safe[-1] if safe else None


def push_table(result: dict[str, Any]) -> str:
    """One line per direction: share that stays on its feet, by the change of velocity."""
    lines = ["pushed towards" + "".join(f"{speed:>8.1f}" for speed in result["speeds"]) + "  m/s     survives"]
    for angle, row, largest in zip(result["directions"], result["survived"], result["envelope"], strict=True):
        limit = "nothing" if largest is None else f"{largest:.1f} m/s"
        lines.append(f"{direction_name(angle):<14}" + "".join(f"{x:>8.0%}" for x in row) + f"{limit:>17}")
    walking = result["command"][0]
    return "\n".join(
        [*lines, f"share on its feet {WAIT:g} s after a push, walking at {walking:g} m/s; survives: >= {SAFE:.0%}"]
    )


def direction_name(angle: float) -> str:
    """A direction in words if it has some."""
    names = {0: "forward", 45: "forward left", 90: "left", 135: "back left", 180: "back", 225: "back right"}
    names |= {270: "right", 315: "forward right"}
    return names.get(round(angle), f"{angle:.0f} deg")
