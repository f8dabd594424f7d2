"""Stability: every time step, stiffness and slip speed on every robot; tests of others; endurance; and a map of it all.

The parts are in grid.py (the map), cases.py (tests of small mechanisms), robots.py (endurance) and plots.py.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import numpy as np

from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.bench.stability import grid
from ce_gym.bench.stability import plots as stability_plots
from ce_gym.bench.stability import robots as stability_robots
from ce_gym.bench.stability.cases import CASES
from ce_gym.dynamics.model import Model
from ce_gym.model.mechanism import LEVELS
from ce_gym.viewer.console import shown

ROBOTS = ("mini_cheetah", "mit_humanoid", "tello", "jvrc1")
PATIENCE, COLLAPSE, STANDING, FUZZ = 120.0, 3.0, 600.0, 1_000_000
"""Longest time to come to rest [s], time of a collapse [s], time of standing [s], robot-steps of random torques."""
RETRY = 6
"""Halvings of a step for those whom random torques break."""
PARTS = ("map", "cases", "robots")
DRIFT = 1e-3
"""Largest drift of a robot that stands [m]."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robot", nargs="+", default=list(ROBOTS), metavar="NAME", help="robots with a floating base")
    parser.add_argument(
        "--dt", type=float, nargs="+", default=list(grid.STEPS), metavar="S", help="time steps of the map"
    )
    parser.add_argument("--quick", action="store_true", help="one robot, two time steps, short waits: a minute")
    parser.add_argument("--skip", nargs="+", default=[], choices=PARTS, help="parts to leave out")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="also draw the map to a PNG file")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    quick = arguments.quick
    robots = arguments.robot[:1] if quick else arguments.robot
    models = {name: Model(name) for name in robots}
    report = Report("stability")
    if "map" not in arguments.skip:
        steps = (0.002, 0.01) if quick else arguments.dt
        patience, collapse = (30.0, 1.0) if quick else (PATIENCE, COLLAPSE)
        maps: dict[str, list[grid.Map]] = {name: [] for name in models}
        for name, dt in shown(list(itertools.product(models, steps)), "map"):
            maps[name].append(grid.measure(models[name], dt, patience, collapse))
        report_map(report, maps)
        if arguments.picture:
            stability_plots.draw(maps, arguments.picture)
    if "cases" not in arguments.skip:
        report_cases(report)
    if "robots" not in arguments.skip:
        standing, fuzz = (60.0, 100_000) if quick else (STANDING, FUZZ)
        report_robots(report, models, standing, fuzz)
    return report


def report_map(report: Report, maps: dict[str, list[grid.Map]]) -> None:
    """Add one row for each robot, time step and stiffness, worst of all slip speeds, and the bars."""
    rows: list[tuple[Cell, ...]] = []
    for name, steps in maps.items():
        for m in steps:
            for i, k in enumerate(grid.STIFFNESSES):
                figures = (float(m.chatter[i].max()), max(0.0, float(m.gain[i].max())), float(m.excess[i].max()))
                rows.append((name, 1e3 * m.dt, f"{k:.0e}", bool(m.finite[i].all()), *figures))
    columns = ("robot", "dt [ms]", "k [N/m]", "finite", "speed at rest", "energy gained", "kinetic and potential")
    report.tables.append(Table("Map, worst of slip speeds 0.1 mm/s to 100 mm/s", columns, tuple(rows)))
    every = [m for steps in maps.values() for m in steps]
    finite, chatter, gain, excess = (
        np.array([getattr(m, name) for m in every]) for name in ("finite", "chatter", "gain", "excess")
    )
    n = finite.size
    met = report.requirements.append
    met(Requirement("map: every cell finite", f"{int(finite.sum())} of {n}", bool(finite.all())))
    silent = int((chatter <= grid.SILENCE).sum())
    met(
        Requirement(
            f"map: rms speed at rest <= {grid.SILENCE:g}", f"{silent} of {n}, worst {chatter.max():.1e}", silent == n
        )
    )
    below = int((excess <= grid.ROUNDING).sum())
    text = f"{below} of {n}, highest {excess.max():.1e} of the energy lost"
    met(Requirement("map: kinetic and potential energy never above the start, without motors", text, below == n))
    passive = int((gain <= grid.ROUNDING).sum())
    text = f"{passive} of {n}, worst {gain.max():.1e} of the energy lost"
    met(Requirement("map: energy with springs and bristles never rises, without motors", text, passive == n))
    report.remarks.append(
        "Speed at rest: rms over all coordinates and 100 steps in a row [m/s and rad/s], once below the bar or when "
        "the time is up. Energy gained: largest rise above the lowest so far, springs included; kinetic and potential: "
        "highest above the start; both as shares of the energy that a robot loses when it collapses. What is gained at "
        "coarse steps is in stiff springs that a corner dips into within a step; they do not give it back."
    )


def report_cases(report: Report) -> None:
    """Add the tests of small mechanisms."""
    cases = [case() for case in shown(CASES, "cases")]
    rows = tuple((c.source, c.name, c.required, c.measured, c.met) for c in cases)
    report.tables.append(Table("Cases", ("test of", "case", "required", "measured", "met"), rows))
    report.requirements += [Requirement(f"{c.name}: {c.required}", c.measured, c.met) for c in cases]


def report_robots(report: Report, models: dict[str, Model], standing: float, fuzz: int) -> None:
    """Add the endurance of whole robots."""
    rows: list[tuple[Cell, ...]] = []
    lost, given_up, spun, drift, quiet = 0, 0, 0, 0.0, 0.0
    for name, model in shown(models.items(), "robots"):
        stood = stability_robots.stand(model, standing)
        diverged, energy = stability_robots.spin(model)
        levels = [Model(model.robot, level) for level in LEVELS]
        falls = [stability_robots.fuzz(level, fuzz) for level in levels]
        again = [stability_robots.fuzz(m, fuzz, retry=RETRY) if n else 0 for m, n in zip(levels, falls, strict=True)]
        precision = stability_robots.precisions(model)
        endurance = (1e3 * stood.drift, stood.turn, stood.speed, diverged, energy, sum(falls), sum(again))
        rows.append((name, *endurance, *precision))
        lost, given_up, spun = lost + sum(falls), given_up + sum(again), spun + diverged
        drift, quiet = max(drift, stood.drift), max(quiet, stood.speed)
    columns = (
        *("robot", "drift [mm]", "turn [rad]", "speed", "lost in a spin", "highest energy", "lost to torques"),
        *("with retries", "f32 - f64, 1 s", "30 s", "speed in f32"),
    )
    title = (
        f"Robots: {standing:g} s of standing; base at 50 rad/s, 1 ms; {fuzz:,} random robot-steps a level; precision"
    )
    report.tables.append(Table(title, columns, tuple(rows)))
    report.requirements += [
        Requirement(f"standing for {standing:g} s: drift <= 1 mm", f"{1e3 * drift:.1e} mm", drift <= DRIFT),
        Requirement(
            f"standing for {standing:g} s: rms speed <= {grid.SILENCE:g}", f"{quiet:.1e}", quiet <= grid.SILENCE
        ),
        Requirement("base at 50 rad/s for 10 s: all finite", f"{spun} lost", spun == 0),
        Requirement("random torques up to the limits: none lost", f"{lost}", lost == 0),
        Requirement(f"the same with up to {RETRY} halvings of a step that fails", f"{given_up}", given_up == 0),
    ]
