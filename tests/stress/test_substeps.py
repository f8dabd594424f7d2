"""Random targets and torques on every robot, at every level and in both precisions: failures are flagged, and alone.

Each batch takes its share of the sub-steps at the default `dt`, in episodes that begin in the standing pose. Some of
its robots are made to diverge at the start of each; some, in the same vector registers, have a batch of their own that
is told the same, and must be the same bit for bit. All must be finite, and no other robot may diverge.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tripod import TRIPOD

from ce_gym.dynamics.model import Model
from ce_gym.model import load_robot, robots
from ce_gym.model.mechanism import LEVELS
from ce_gym.sim import Simulator

NUM_ENVS = 256
"""Robots in a batch."""
DRAWS, N_SUBSTEPS = 150, 4
"""Random targets in an episode, and sub-steps that each is held for."""
WATCHED, SPOILT = np.arange(0, 16, 4), np.arange(1, 16, 4)
"""Robots that have a batch of their own, and robots beside them that are made to diverge."""
TOO_FAST = 2e4
"""A speed at which a robot has diverged [rad/s or m/s]."""
NO_LIMIT = 20.0
"""Largest torque at joints that have no limit [N m or N]."""


@dataclass
class Case:
    """One robot at one level, in one precision, under one kind of control.

    Attributes:
        robot, level, dtype, control: Which.
        steps: Sub-steps of robots.
        diverged: Robots that diverged and were not made to.
        complaints: Errors found, one line each.
    """

    robot: str
    level: str
    dtype: str
    control: str
    steps: int = 0
    diverged: int = 0
    complaints: list[str] = field(default_factory=list)

    def run(self, share: float, rng: np.random.Generator) -> None:
        """Make at least `share` sub-steps of robots."""
        model = Model(self.robot, self.level)
        batch, alone = (Simulator(model, n, dtype=self.dtype, control=self.control) for n in (NUM_ENVS, len(WATCHED)))
        while self.steps < share:
            self.episode(batch, alone, rng)
            self.steps += NUM_ENVS * DRAWS * N_SUBSTEPS

    def episode(self, batch: Any, alone: Any, rng: np.random.Generator) -> None:
        """Make one episode."""
        model, spoilt = batch.model, np.isin(np.arange(NUM_ENVS), SPOILT)
        for sim in (batch, alone):
            sim.reset()
        batch.set_state(model.standing_q, np.full(model.nv, TOO_FAST), spoilt)
        for _ in range(DRAWS):
            targets = self.draw(model, rng)
            batch.step(targets, N_SUBSTEPS)
            alone.step(targets[WATCHED], N_SUBSTEPS)
            self.look(batch, alone)
        if not batch.diverged[spoilt].all():
            self.complaints.append(f"{self}: robots that are too fast are not flagged")
        self.diverged += int((batch.diverged & ~spoilt).sum())

    def draw(self, model: Any, rng: np.random.Generator) -> NDArray:
        """Draw targets anywhere between the stops, or torques up to the joints' limits, shape (NUM_ENVS, nj)."""
        joints = [model.robot.body(name).joint for name in model.joint_links]
        if self.control == "torque":
            most = np.array([joint.torque if math.isfinite(joint.torque) else NO_LIMIT for joint in joints])
            return rng.uniform(-most, most, (NUM_ENVS, len(joints)))
        low, high = np.clip([joint.position for joint in joints], -math.pi, math.pi).reshape(-1, 2).T
        return rng.uniform(low, high, (NUM_ENVS, len(joints)))

    def look(self, batch: Any, alone: Any) -> None:
        """Check the state after a call."""
        for name in ("q", "v", "torque", "contact_forces", "diverged"):
            whole, part = getattr(batch, name), getattr(alone, name)
            if not np.isfinite(whole).all():
                self.complaints.append(f"{self}: {name} is not finite")
            if whole[WATCHED].tobytes() != part.tobytes():
                self.complaints.append(f"{self}: {name} of robots depends on their neighbours")

    def __str__(self) -> str:
        return f"{self.robot} {self.level} {self.dtype} {self.control}"


def all_cases(names: Iterable[str]) -> list[Case]:
    """Return a case for each robot, level, precision and kind of control; robots without gains know torques only."""
    found = []
    for robot in names:
        controls = ("position", "torque") if load_robot(robot).gains.kp else ("torque",)
        found += [Case(robot, lvl, dtype, c) for lvl in LEVELS for dtype in ("float64", "float32") for c in controls]
    return found


def test_random_sub_steps_of_a_robot():
    case = Case(TRIPOD, "exact", "float64", "position")
    case.run(1, np.random.default_rng(0))
    assert case.steps == NUM_ENVS * DRAWS * N_SUBSTEPS
    assert (case.diverged, case.complaints) == (0, [])


@pytest.mark.stress
@pytest.mark.parametrize("case", all_cases(robots()), ids=str)
def test_random_sub_steps_of_all_robots(case: Case):
    case.run(1e6, np.random.default_rng(0))
    assert (case.diverged, case.complaints) == (0, [])
