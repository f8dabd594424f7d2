"""Push walking robots from several directions at several speeds, and count those that do not fall.

A push is an instantaneous change of the base's horizontal velocity, like the environment's own pushes. Robots with the
same direction and speed are pushed at different phases of their gait.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from typing import Any

import numpy as np

from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.learn.evaluate.episodes import UNDISTURBED, run_policy
from ce_gym.policies import Policy

SPEEDS = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
"""Changes of velocity [m/s]; 0 gives the fraction without a push."""

SETTLE, SPREAD, WAIT = 2.0, 0.8, 3.0
"""Time before the first push, between the first and last push of a cell, and observed after each push [s]."""

SAFE = 0.9
"""Fraction of robots that must stay on their feet for a push to count as survived."""


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
        policy: Policy with its record.
        speeds: Changes of velocity [m/s], one per column of the result.
        directions: Number of directions, evenly spaced, counter-clockwise from "forward".
        repeats: Robots for each direction and speed.
        seed: Seed of the first robot.
        **kwargs: Arguments of the environment.

    Returns:
        - command: Command of all robots [m/s, rad/s].
        - speeds, directions: Speeds [m/s] and directions [deg] of the pushes; 0 is forward, 90 is left.
        - survived: Fraction without a fall within `WAIT` of the push, by direction (row) and speed (column).
        - envelope: For each direction, the largest speed [m/s] up to which at least `SAFE` survive every push, or None.
    """
    spec = policy.record["policy_spec"]
    dt = spec["control_dt"]
    angles = np.arange(directions) * 360.0 / directions
    angle, speed, repeat = (x.ravel() for x in np.meshgrid(angles, speeds, np.arange(repeats), indexing="ij"))
    when = np.round((SETTLE + SPREAD * repeat / repeats) / dt).astype(int)
    push = speed[:, None] * np.stack([np.cos(np.radians(angle)), np.sin(np.radians(angle))], axis=1)
    command = [spec["command"]["range"][0][1] / 2, 0.0, 0.0]
    arguments = {**kwargs, **UNDISTURBED, "max_episode_steps": 10**9}
    with closing(make_sb3_vec_env(policy.record["env"], len(angle), seed, **arguments)) as envs:
        native: Any = envs.envs.unwrapped
        standing = np.ones(len(angle), bool)

        def apply_pushes(step: int) -> None:
            native.set_command(command)
            due = standing & (when == step)
            if due.any():
                v = native.batch.rows("v")
                v[:, 3:5] += push
                native.batch.write("v", v, due)

        wait = round(WAIT / dt)
        outcomes = run_policy(policy, envs, envs.reset(), apply_pushes, int(when.max()) + wait)
        for step, (dones, _) in enumerate(outcomes):
            standing &= ~(dones & (step < when + wait))
    survived = standing.reshape(directions, len(speeds), repeats).mean(axis=2)
    return {
        "command": command,
        "speeds": [float(x) for x in speeds],
        "directions": angles.tolist(),
        "survived": survived.tolist(),
        "envelope": [_largest(speeds, row) for row in survived],
    }


def _largest(speeds: Sequence[float], survived: Any) -> float | None:
    """Return the largest speed below the first speed at which too few robots survive."""
    safe = [float(speed) for speed, ok in zip(speeds, np.logical_and.accumulate(survived >= SAFE), strict=True) if ok]
    return safe[-1] if safe else None


def push_table(result: dict[str, Any]) -> str:
    """Return one line per direction: the fraction that stays on its feet, by the change of velocity."""
    lines = ["pushed towards" + "".join(f"{speed:>8.1f}" for speed in result["speeds"]) + "  m/s     survives"]
    for angle, row, largest in zip(result["directions"], result["survived"], result["envelope"], strict=True):
        limit = "nothing" if largest is None else f"{largest:.1f} m/s"
        lines.append(f"{direction_name(angle):<14}" + "".join(f"{x:>8.0%}" for x in row) + f"{limit:>17}")
    walking = result["command"][0]
    return "\n".join(
        [*lines, f"share on its feet {WAIT:g} s after a push, walking at {walking:g} m/s; survives: >= {SAFE:.0%}"]
    )


def direction_name(angle: float) -> str:
    """Return a direction in words, or in degrees if it has no name."""
    names = {0: "forward", 45: "forward left", 90: "left", 135: "back left", 180: "back", 225: "back right"}
    names |= {270: "right", 315: "forward right"}
    return names.get(round(angle), f"{angle:.0f} deg")
