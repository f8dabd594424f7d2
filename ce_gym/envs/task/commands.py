"""Velocity commands of a task, and headings to which the robot turns."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.task.curriculum import Curriculum
from ce_gym.envs.task.sampling import Sampler
from ce_gym.envs.task.tasks import Task

HEADING_GAIN = 0.5
"""Commanded yaw rate for each radian of heading error [1/s]."""


class Commands:
    """The commands of a task.

    Args:
        task: The task.
        curriculum: The curricula of the task.
    """

    def __init__(self, task: Task, curriculum: Curriculum) -> None:
        self.task, self.curriculum = task, curriculum

    def draw(self, sampler: Sampler, grown: SX | None) -> dict[str, SX]:
        """Return a new `command` in the current range of the robot, or zero to stand still; and a `heading`."""
        standing = sampler.unit() < self.task.standing_fraction
        moving = sampler.within(self.task.command_range)
        moving = moving if grown is None else self.curriculum.range_share(grown) * moving
        command = {"command": ca.if_else(standing, 0, moving)}
        return command | ({"heading": sampler.uniform(-np.pi, np.pi)} if self.task.heading else {})

    def steer(self, q: SX, command: dict[str, SX]) -> dict[str, SX]:
        """Return the commands with a yaw rate that turns the robot to its `heading`, if it has one."""
        if "heading" not in command:
            return command
        w, x, y, z = (q[3 + i] for i in range(4))
        turn = command["heading"] - ca.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        error = ca.atan2(ca.sin(turn), ca.cos(turn))
        low, high = self.task.command_range[2]
        rate = ca.fmax(low, ca.fmin(high, HEADING_GAIN * error))
        moving = ca.sumsqr(command["command"]) > 0
        return command | {"command": ca.vertcat(command["command"][:2], ca.if_else(moving, rate, 0))}
