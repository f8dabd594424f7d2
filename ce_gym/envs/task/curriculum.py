"""Curricula: terrain level and command range of each robot, which change from episode to episode with its success.

The level of a robot depends only on its seed and its actions. Seeding an environment resets the level.

    terrain     one level up after walking half a tile along the commands,
                one level down below half of the commanded distance
    commands    a wider range above a mean tracking of 80 %, a narrower range below 40 %

Both rules refer to episodes of full length, so the time after a fall counts as failed.
"""

from __future__ import annotations

import math

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.task.sampling import Sampler
from ce_gym.envs.task.tasks import Task
from ce_gym.envs.terms.context import TermContext
from ce_gym.envs.terms.rewards import track_linear_velocity

RANGE_STEP = 0.1
"""Share of the full command range by which the range of a robot grows or shrinks."""
GROW_ABOVE, SHRINK_BELOW = 0.8, 0.4
"""Mean tracking above which the range grows, and below which it shrinks."""


class Curriculum:
    """The curricula of a task.

    Args:
        task: The task.

    Attributes:
        sizes: Sizes of the state by name: terrain `level`; distance `walked` along the commands, and commanded [m];
            growth steps of the command range, `grown`; sum of the tracking reward, `tracked`.
    """

    def __init__(self, task: Task) -> None:
        self.task, self.duration = task, task.episode_length * task.dt * task.n_substeps
        self.on_field = task.terrain["kind"] != "flat"
        self.climbing = self.on_field and task.terrain.get("curriculum", False)
        self.widening = task.command_curriculum < 1
        self.sizes = {"level": 1} if self.on_field else {}
        self.sizes |= {"walked": 2} if self.climbing else {}
        self.sizes |= {"grown": 1, "tracked": 1} if self.widening else {}

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the metrics that report the curricula."""
        return ("terrain_level",) * self.on_field + ("times_grown",) * self.widening

    def progress(self, s: TermContext, state: dict[str, SX]) -> dict[str, SX]:
        """Return the distances and the tracking of the episode after a control step, by name of the state."""
        after = {}
        if self.climbing:
            speed = ca.norm_2(s.command[:2])
            along = ca.dot(s.command[:2], s.base_linear_velocity[:2]) / ca.fmax(speed, 1e-6)
            after["walked"] = state["walked"] + s.control_dt * ca.vertcat(along, speed)
        if self.widening:
            after["tracked"] = state["tracked"] + track_linear_velocity(s)
        return after

    def next_level(self, state: dict[str, SX], sampler: Sampler, control_dt: float) -> SX:
        """Return the terrain level of the next episode."""
        count = self.task.terrain.get("levels", 1)
        random_level = ca.floor(sampler.uniform(0, count))
        if not self.climbing:
            return random_level
        walked, commanded = state["walked"][0], state["walked"][1]
        remaining_time = ca.fmax(0, self.duration - control_dt * state["clock"])
        up = walked > self.task.terrain["size"] / 2
        down = walked < (commanded + remaining_time * ca.norm_2(state["command"][:2])) / 2
        level = ca.fmax(0, state["level"] + ca.if_else(up, 1, ca.if_else(down, -1, 0)))
        return ca.if_else(level > count - 1, random_level, level)  # robots that solve the last level

    def next_times_grown(self, state: dict[str, SX]) -> SX:
        """Return the growth steps of the command range in the next episode."""
        mean = state["tracked"] / self.task.episode_length
        change = ca.if_else(mean > GROW_ABOVE, 1, ca.if_else(mean < SHRINK_BELOW, -1, 0))
        largest = math.ceil(round((1 - self.task.command_curriculum) / RANGE_STEP, 6))
        return ca.fmax(0, ca.fmin(largest, state["grown"] + change))

    def range_share(self, grown: SX) -> SX:
        """Return the share of the full command range after `grown` growth steps."""
        return ca.fmin(1, self.task.command_curriculum + RANGE_STEP * grown)
