"""Push walking robots from several directions at several speeds, and count those that do not fall.

A push is an instantaneous change of the base's horizontal velocity, like the environment's own pushes. Robots with the
same direction and speed are pushed at different phases of their gait.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ce_gym.learn.evaluation.episodes import UNDISTURBED, UNLIMITED, open_environments, run_policy
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
    arguments = {**kwargs, **UNDISTURBED, "max_episode_steps": UNLIMITED}
    with open_environments(policy.record["env"], len(angle), seed, **arguments) as (envs, obs):
        native: Any = envs.unwrapped
        standing = np.ones(len(angle), bool)

        def apply_pushes(step: int) -> None:
            native.set_command(command)
            due = standing & (when == step)
            if due.any():
                v = native.batch.rows("v")
                v[:, 3:5] += push
                native.batch.write("v", v, due)

        wait = round(WAIT / dt)
        outcomes = run_policy(policy, envs, obs, apply_pushes, int(when.max()) + wait, "pushes")
        for number, step in enumerate(outcomes):
            standing &= ~(step.done & (number < when + wait))
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
