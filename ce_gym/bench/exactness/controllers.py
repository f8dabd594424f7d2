"""Study of controllers: what each loses that knows a leg at a simplified level only."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from ce_gym.bench.exactness.legs import feedforward
from ce_gym.bench.exactness.legs.loops import follow, tasks
from ce_gym.bench.exactness.legs.signals import centres
from ce_gym.bench.exactness.legs.stable_gain import largest_bandwidth
from ce_gym.bench.exactness.mechanisms import leg_on_stand
from ce_gym.bench.exactness.protocol import BANDWIDTHS, LEGS, Leg
from ce_gym.bench.exactness.tables import spread, table
from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.bench.paper.tracking import FREQUENCY, PUBLISHED
from ce_gym.dynamics.model import Model
from ce_gym.model.mechanism import LEVELS
from ce_gym.viewer.console import shown

CONTROLLERS = ("joints", "foot")
TRACKING = (
    "mechanism", "controller", "signal", "frequency [Hz]", "level", "bandwidth [Hz]", "error p5", "error [rad or m]",
    "error p95", "torque error [N m]", "share p5", "share", "share p95",
)  # fmt: skip
GAIN = ("mechanism", "controller", "level", "bandwidth p5 [Hz]", "bandwidth [Hz]", "bandwidth p95 [Hz]", "of exact")


def run(arguments: argparse.Namespace, out: Path) -> Report:
    """Run the study and write its tables; `quick` takes one leg, half a second of each motion, few frequencies."""
    quick, seed = arguments.quick, arguments.seed
    legs = dict(list(LEGS.items())[:1]) if quick else LEGS
    tables = {
        "feedforward": table("Without feedback", feedforward.COLUMNS, _map(quick, seed)),
        "gain": table("Largest stable bandwidth", GAIN, _gains(legs, seed, 2 if quick else None)),
        "tracking": table("Closed loop", TRACKING, _tracking(legs, seed, 500 if quick else None)),
    }
    for name, one in tables.items():
        one.write_csv(out / f"controllers_{name}.csv")
    shown_rows = tuple(r for r in tables["tracking"].rows if r[5] == BANDWIDTHS[1] and r[4] != "exact")
    report = Report("exactness controllers", [tables["gain"], Table("Closed loop, 8 Hz", TRACKING, shown_rows)])
    report.requirements += _published(tables["feedforward"])
    if not quick:
        from ce_gym.bench.exactness import plots

        plots.controllers(tables, out)
    return report


def _map(quick: bool, seed: int) -> list[tuple[Cell, ...]]:
    return feedforward.as_published((FREQUENCY,)) if quick else feedforward.rows(seed)


def _gains(legs: dict[str, Leg], seed: int, poses: int | None) -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = []
    for name, leg in shown(list(legs.items()), "gains"):
        poses_of_leg = centres(Model(leg_on_stand(leg)), seed, amplitude=0.0)[0][:poses]
        for controller in CONTROLLERS:
            found = {level: largest_bandwidth(leg, level, controller, poses_of_leg) for level in LEVELS}
            for level, hz in found.items():
                rows.append((name, controller, level, *spread(hz), float(np.median(hz / found["exact"]))))
    return rows


def _tracking(legs: dict[str, Leg], seed: int, samples: int | None) -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = []
    for name, leg in legs.items():
        for task in tasks(leg, seed):
            result = follow(leg, task, samples=samples)
            for index in np.ndindex(*result.error.shape[:3]):
                band, level, gain = index
                where = (name, task.controller, task.signal, task.frequencies[band], LEVELS[level], BANDWIDTHS[gain])
                error, wrong, torque = (x[index] for x in (result.error, result.torque_error, result.torque))
                if torque.any():  # this band was counted
                    rows.append((*where, *spread(error), float(np.median(wrong)), *spread(wrong / torque)))
    return rows


def _published(points: Table) -> list[Requirement]:
    """Return whether the points that the paper gives are on the map."""
    found = {(r[1], r[3]): r[5] for r in points.rows if r[0] == "mit_humanoid_leg, as published" and r[2] == FREQUENCY}
    requirements = []
    for (level, joint), expected in PUBLISHED.items():
        measured = float(found[level, joint])  # type: ignore[arg-type]
        claim = f"{joint} rms at {level}, the paper's experiment gives {expected} N m"
        requirements.append(Requirement(claim, f"{measured:.4f}", abs(measured - expected) <= 5e-5))
    return requirements
