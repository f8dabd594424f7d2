"""Curricula: what a robot carries over from one episode to the next, and how it is judged.

Every robot has its own level, in its lane of the kernel's state, so that it depends on its seed and its actions and on
nothing else. Seeding an environment begins from the start.

    terrain     up a level if it walked half a tile along its commands, down if not half of what it was asked
    commands    a wider range if its mean tracking was above 80 %, a narrower one below 40 %

Both are counted over whole episodes of the task's length: a robot that falls has not done the rest.
"""

from __future__ import annotations

import math

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.task.sampling import Sampler
from ce_gym.envs.task.tasks import Task
from ce_gym.envs.terms.context import TermContext
from ce_gym.envs.terms.rewards import track_linear_velocity

WIDER = 0.1
"""How much of the whole range of commands is gained or lost at a time."""
WELL, BADLY = 0.8, 0.4
"""Mean tracking from which on the range grows, and below which it shrinks."""


class Curriculum:
    """The curricula of a task.

    Args:
        task: The task.

    Attributes:
        sizes: State that they need, by name; `level` of the terrain, how far a robot `walked` along its commands and
            was asked to [m], how often its range of commands has `grown`, and how well it `tracked` them, summed.
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
        """Metrics of how far robots have come."""
        return ("terrain_level",) * self.on_field + ("times_grown",) * self.widening

    def progress(self, s: TermContext, state: dict[str, SX]) -> dict[str, SX]:
        """Return what a control step adds to the account of an episode, by name of the state."""
        after = {}
        if self.climbing:
            asked = ca.norm_2(s.command[:2])
            along = ca.dot(s.command[:2], s.base_linear_velocity[:2]) / ca.fmax(asked, 1e-6)
            after["walked"] = state["walked"] + s.control_dt * ca.vertcat(along, asked)
        if self.widening:
            after["tracked"] = state["tracked"] + track_linear_velocity(s)
        return after

    def next_level(self, state: dict[str, SX], sampler: Sampler, control_dt: float) -> SX:
        """Return the level of the terrain on which the next episode begins."""
        count = self.task.terrain.get("levels", 1)
        anywhere = ca.floor(sampler.uniform(0, count))
        if not self.climbing:
            return anywhere
        walked, asked = state["walked"][0], state["walked"][1]
        left = ca.fmax(0, self.duration - control_dt * state["clock"])
        up = walked > self.task.terrain["size"] / 2
        down = walked < (asked + left * ca.norm_2(state["command"][:2])) / 2
        level = ca.fmax(0, state["level"] + ca.if_else(up, 1, ca.if_else(down, -1, 0)))
        return ca.if_else(level > count - 1, anywhere, level)  # what has passed the last is sent anywhere

    def next_times_grown(self, state: dict[str, SX]) -> SX:
        """Return how often the range of commands has grown when the next episode begins."""
        mean = state["tracked"] / self.task.episode_length
        change = ca.if_else(mean > WELL, 1, ca.if_else(mean < BADLY, -1, 0))
        most = math.ceil(round((1 - self.task.command_curriculum) / WIDER, 6))
        return ca.fmax(0, ca.fmin(most, state["grown"] + change))

    def range_share(self, grown: SX) -> SX:
        """Return the share of the range of commands that a robot gets."""
        return ca.fmin(1, self.task.command_curriculum + WIDER * grown)
