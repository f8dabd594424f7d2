# pyright: reportAttributeAccessIssue=false
"""MuJoCo at its best: the fastest settings with which a robot still stands as it does at 1 ms with a converged solver.

(MuJoCo's compiled modules carry no types, hence the line above.)
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass

import mujoco
import numpy as np

from ce_gym.bench.measure.timing import Competitor, interleaved
from ce_gym.bench.peers import mujoco as mujoco_peer
from ce_gym.bench.peers import stand
from ce_gym.bench.peers.mujoco import Batch, Coordinates
from ce_gym.model import Robot

STIFF = ((0.9999, 0.9999, 0.001, 0.5, 2.0), None)
"""Impedances tried for the equalities that stand for gears; None is MuJoCo's default."""


@dataclass(frozen=True)
class Settings:
    """How MuJoCo is set up.

    Attributes:
        timestep: [s].
        integrator: Name in MJCF.
        solver: "Newton", "CG" or "PGS".
        iterations: Most iterations of the solver.
        line_search: Most iterations of its line search.
        solimp: Impedance of equalities, with the smallest time constant MuJoCo allows; None is its default for both.
    """

    timestep: float
    integrator: str = "implicitfast"
    solver: str = "Newton"
    iterations: int = 100
    line_search: int = 50
    solimp: tuple[float, ...] | None = None

    def __str__(self) -> str:
        gears = "" if self.solimp is None else ", stiff equalities"
        return f"{self.integrator}, {self.solver} {self.iterations}/{self.line_search}{gears}"


SOLVERS = (("Newton", 100, 50), ("Newton", 4, 4), ("Newton", 3, 4), ("Newton", 2, 4), ("CG", 5, 4), ("PGS", 5, 4))
"""Solvers tried, with most iterations and most iterations of their line search."""

INTEGRATORS = ("Euler", "implicitfast")
NUM_ENVS = 32


def candidates(timestep: float, level: str) -> list[Settings]:
    """Return the settings tried at a time step [s] and transmission level."""
    impedances = STIFF if level == "exact" else (None,)
    return [Settings(timestep, i, *s, solimp) for i, s, solimp in itertools.product(INTEGRATORS, SOLVERS, impedances)]


def compiled(robot: Robot, level: str, settings: Settings) -> mujoco.MjModel:
    """Compile a robot with settings, and without whatever the scene does not need."""
    solref = None if settings.solimp is None else (2.0 * settings.timestep, 1.0)
    model = mujoco_peer.load(
        robot, level, timestep=settings.timestep, integrator=settings.integrator, solref=solref, solimp=settings.solimp
    )
    model.opt.solver = getattr(mujoco.mjtSolver, f"mjSOL_{settings.solver.upper()}")
    model.opt.iterations, model.opt.ls_iterations = settings.iterations, settings.line_search
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    return model


def watched(robot: Robot, level: str, settings: Settings, num_envs: int = NUM_ENVS) -> tuple[Batch, stand.Behaviour]:
    """Return a batch that has stood for a while, and how it stood."""
    model = compiled(robot, level, settings)
    batch = Batch(model, num_envs)
    return batch, stand.watch_mujoco(batch, robot, Coordinates.of(model, robot))


def fastest(robot: Robot, level: str, timestep: float) -> tuple[Settings, Batch, stand.Behaviour]:
    """Return the fastest settings with which robots stand, at `timestep` [s] or, failing that, at smaller ones.

    Raises:
        RuntimeError: If they stand with none.
    """
    _, reference = watched(robot, level, Settings(0.001, "Euler", solimp=STIFF[0]), 16)
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
