"""Stability of standing and collapsing robots, by time step, ground stiffness and slip speed.

Small mechanisms with a known motion are tests: `tests/sim/test_published_cases.py` and `tests/sim/test_stability.py`.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import numpy as np

from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.bench.stability import grid, plots
from ce_gym.console import progress
from ce_gym.dynamics.model import Model

ROBOTS = ("mini_cheetah", "mit_humanoid", "tello", "jvrc1")
PATIENCE, COLLAPSE = 120.0, 3.0
"""Longest time to come to rest, and time of a collapse [s]."""
QUICK_STEPS, QUICK_PATIENCE, QUICK_COLLAPSE = (0.002, 0.01), 30.0, 1.0
COLUMNS = ("robot", "dt [ms]", "k [N/m]", "finite", "speed at rest", "energy gained", "kinetic and potential")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robot", nargs="+", default=list(ROBOTS), metavar="NAME", help="robots with a floating base")
    parser.add_argument("--dt", type=float, nargs="+", default=list(grid.STEPS), metavar="S", help="time steps [s]")
    parser.add_argument("--quick", action="store_true", help="one robot, two time steps, short waits: a minute")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="also draw the map to a PNG file")


def run(arguments: argparse.Namespace) -> Report:
    """Measure all robots at all time steps."""
    names: list[str] = arguments.robot[:1] if arguments.quick else arguments.robot
    steps = QUICK_STEPS if arguments.quick else arguments.dt
    patience, collapse = (QUICK_PATIENCE, QUICK_COLLAPSE) if arguments.quick else (PATIENCE, COLLAPSE)
    models = {name: Model(name) for name in names}
    maps: dict[str, list[grid.Map]] = {name: [] for name in names}
    for name, dt in progress(list(itertools.product(names, steps)), "map"):
        maps[name].append(grid.measure(models[name], dt, patience, collapse))
    if arguments.picture:
        plots.draw(maps, arguments.picture)
    return report_of(maps)


def report_of(maps: dict[str, list[grid.Map]]) -> Report:
    """Return one row for each robot, time step and stiffness, with the worst slip speed, and the requirements."""
    rows: list[tuple[Cell, ...]] = []
    for name, steps in maps.items():
        for m in steps:
            for i, k in enumerate(grid.STIFFNESSES):
                figures = (float(m.chatter[i].max()), max(0.0, float(m.gain[i].max())), float(m.excess[i].max()))
                rows.append((name, 1e3 * m.dt, f"{k:.0e}", bool(m.finite[i].all()), *figures))
    every = [m for steps in maps.values() for m in steps]
    figures_of = {name: np.array([getattr(m, name) for m in every]) for name in ("finite", "chatter", "gain", "excess")}
    report = Report("stability", [Table("Map, worst of slip speeds 0.1 mm/s to 100 mm/s", COLUMNS, tuple(rows))])
    report.requirements += [
        _requirement("every cell finite", figures_of["finite"], ""),
        _at_most(f"rms speed at rest <= {grid.SILENCE:g}", figures_of["chatter"], grid.SILENCE, ""),
        _at_most(
            "kinetic and potential energy never above the start, without motors",
            figures_of["excess"],
            grid.ROUNDING,
            " of the energy lost",
        ),
        _at_most(
            "energy with springs and bristles never rises, without motors",
            figures_of["gain"],
            grid.ROUNDING,
            " of the energy lost",
        ),
    ]
    report.remarks.append(
        "Speed at rest: rms over all coordinates and 100 steps in a row [m/s and rad/s], once below the bar or when "
        "the time is up. Energy gained: largest rise above the lowest so far, springs included; kinetic and potential: "
        "highest above the start; both as shares of the energy that a robot loses when it collapses."
    )
    return report


def _at_most(claim: str, figures: np.ndarray, bound: float, unit: str) -> Requirement:
    """Return the requirement that the value in every cell is at most `bound`."""
    return _requirement(claim, figures <= bound, f", worst {figures.max():.1e}{unit}")


def _requirement(claim: str, met: np.ndarray, worst: str) -> Requirement:
    """Return the requirement that a condition holds in every cell."""
    return Requirement(f"map: {claim}", f"{int(met.sum())} of {met.size}{worst}", bool(met.all()))
