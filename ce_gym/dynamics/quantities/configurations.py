"""Random and neutral positions of a robot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.coordinates import Layout
from ce_gym.model.description import Joint, Robot

Array = NDArray[np.float64]


def neutral_positions(layout: Layout) -> Array:
    """Return positions with zero joints and without rotations, shape (nq,)."""
    q = np.zeros(layout.nq)
    q[[i for i, _ in layout.turns]] = 1.0
    return q


def random_positions(robot: Robot, rng: np.random.Generator) -> Array:
    """Return positions within limits, shape (nq,): see `Model.random_configuration`; loops need not close."""
    layout = robot.layout
    q = neutral_positions(layout)
    if layout.floating:
        q[:3] = rng.uniform(-1.0, 1.0, 3)
        q[3:7] = _unit(rng.normal(size=4))
    for name, (i, _) in zip(robot.balls, layout.ball_turns, strict=True):
        half = rng.uniform(0.0, min(np.pi, robot.body(name).joint.position[1])) / 2
        q[i : i + 4] = [np.cos(half), *(np.sin(half) * _unit(rng.normal(size=3)))]
    for i, name in enumerate(robot.independent, start=layout.joints_q):
        q[i] = rng.uniform(*joint_range(robot.body(name).joint, robot.standing_q[i]))
    return q


def joint_range(joint: Joint, standing: float) -> tuple[float, float]:
    """Return the limits of a joint [rad or m]; without a limit, half a turn or 1 m beyond the standing pose.

    For a ball joint, the limits of each component of its rotation vector.
    """
    lower, upper = joint.position
    if joint.type == "ball":
        return -min(np.pi, upper), min(np.pi, upper)
    reach = 1.0 if joint.type == "prismatic" else np.pi
    lower = lower if np.isfinite(lower) else min(standing, upper) - reach
    return lower, upper if np.isfinite(upper) else max(standing, lower) + reach


def _unit(x: Array) -> Array:
    return x / np.linalg.norm(x)
