"""Find the fastest settings of MuJoCo with which robots stand as with 1 ms steps and a converged solver."""

from __future__ import annotations

import itertools
import time

import numpy as np

from ce_gym.bench.measure.timing import Competitor, interleaved
from ce_gym.bench.peers import stand
from ce_gym.export.mujoco_batch import Batch
from ce_gym.export.mujoco_coordinates import Coordinates
from ce_gym.export.mujoco_model import STIFF, Settings, compile_model
from ce_gym.model import Robot

SOLVERS = (("Newton", 100, 50), ("Newton", 4, 4), ("Newton", 3, 4), ("Newton", 2, 4), ("CG", 5, 4), ("PGS", 5, 4))
"""Solvers, with limits on iterations and on iterations of their line search."""

INTEGRATORS = ("Euler", "implicitfast", "discrete")
IMPEDANCES = (STIFF, None)
"""Impedances of the equality constraints of gears; None is MuJoCo's default."""

NUM_ENVS = 32


def candidates(timestep: float, level: str) -> list[Settings]:
    """Return the settings to try at a time step [s] and transmission level."""
    impedances = IMPEDANCES if level == "exact" else (None,)
    return [Settings(timestep, i, *s, solimp) for i, s, solimp in itertools.product(INTEGRATORS, SOLVERS, impedances)]


def watched(robot: Robot, level: str, settings: Settings, num_envs: int = NUM_ENVS) -> tuple[Batch, stand.Behaviour]:
    """Return a batch of standing robots, and their behaviour."""
    model = compile_model(robot, level, settings)
    batch = Batch(model, num_envs)
    return batch, stand.watch_mujoco(batch, robot, Coordinates.of(model, robot))


def fastest(robot: Robot, level: str, timestep: float) -> tuple[Settings, Batch, stand.Behaviour]:
    """Return the fastest settings with which robots stand, at `timestep` [s] or at a smaller step if necessary.

    Raises:
        RuntimeError: If robots fall with all settings.
    """
    _, reference = watched(robot, level, Settings(0.001, "Euler", solimp=STIFF), 16)
    for dt in (timestep, timestep / 2.5, timestep / 5.0):
        standing = {}
        for settings in candidates(dt, level):
            batch, behaviour = watched(robot, level, settings)
            if behaviour.like(reference):
                standing[settings] = (batch, behaviour)
        if standing:
            control = np.repeat(stand.targets(robot, NUM_ENVS, 10, seed=2), round(stand.HOLD / dt), axis=1)
            trials = {str(s): Competitor(lambda b=b, c=control: b.trajectory(c)) for s, (b, _) in standing.items()}
            timings = interleaved(trials, 3, clock=time.thread_time)
            best = min(standing, key=lambda s: timings[str(s)].best)
            return best, *standing[best]
    raise RuntimeError(f"MuJoCo does not stand with {robot.name} {level} at any setting tried")
