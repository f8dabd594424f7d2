"""Study of designs: gear ratio and rotor size chosen on every level, judged on exact; and jumps, seen in flight."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ce_gym.bench.exactness.gait import Gait
from ce_gym.bench.exactness.jumps import Jump, Jumpers
from ce_gym.bench.exactness.protocol import (
    FLIGHT_SEEDS,
    INERTIA_GRID,
    POSE_NOISE,
    PROGRAMS,
    RAMP_NOISE,
    RAMPS,
    RATIO_GRID,
    SEEDS,
    Array,
)
from ce_gym.bench.exactness.tables import spread, table
from ce_gym.bench.measure.report import Cell, Report
from ce_gym.model.mechanism import LEVELS
from ce_gym.viewer.console import shown

OBJECTIVES = {"jump [m]": 1.0, "landing [N]": -1.0, "transport [-]": -1.0}
"""What a design is chosen for, and whether more (1) or less (-1) is better."""
SURFACE = ("robot", "level", "ratio", "inertia", *OBJECTIVES)
CHOICE = (
    "robot", "objective", "level", "ratio", "inertia", "shift of ratio [steps]", "shift of inertia [steps]", "promised",
    "exact value", "best exact", "regret", "scatter p5", "scatter p95",
)  # fmt: skip
FLIGHT = (
    "robot",
    "level",
    "apex p5 [m]",
    "apex [m]",
    "apex p95 [m]",
    "pitch p5 [deg]",
    "pitch [deg]",
    "pitch p95 [deg]",
)
"""Apex and pitch: of `exact` themselves, of others the differences from it."""


@dataclass(frozen=True)
class Surface:
    """What every design of the grid does on a level: an objective each, shape (n_ratios, n_inertias)."""

    values: dict[str, Array]

    def best(self, objective: str) -> tuple[int, int]:
        """Return the cell of the best design."""
        values = OBJECTIVES[objective] * self.values[objective]
        i, j = np.unravel_index(np.nanargmax(values), values.shape)
        return int(i), int(j)


def run(arguments: argparse.Namespace, out: Path) -> Report:
    """Run the study and write its tables; `quick` takes the smaller robot, two levels and every third design."""
    quick = arguments.quick
    robots, levels = (tuple(PROGRAMS)[:1], ("exact", "armature")) if quick else (tuple(PROGRAMS), LEVELS)
    every = 3 if quick else 1
    grid = RATIO_GRID[::every], INERTIA_GRID[::every]
    surface, choice, flight = [], [], []
    for name in robots:
        surfaces = {level: measure(name, level, *grid) for level in shown(levels, name)}
        surface += _surface_rows(name, surfaces, grid)
        choice += _choice_rows(name, surfaces, grid, arguments.seed)
        flight += _flight_rows(name, levels, arguments.seed)
    tables = {
        "surface": table("Surface", SURFACE, surface),
        "choice": table("Designs chosen on a level, judged on exact", CHOICE, choice),
        "flight": table("Jumps at the robot's own design, differences from exact", FLIGHT, flight),
    }
    for key, one in tables.items():
        one.write_csv(out / f"designs_{key}.csv")
    if not quick:
        from ce_gym.bench.exactness import plots

        plots.designs(tables, out)
    return Report("exactness designs", [tables["choice"], tables["flight"]])


def measure(name: str, level: str, ratios: Array, inertias: Array) -> Surface:
    """Jump, land and run with every design of a grid."""
    shape = len(ratios), len(inertias), len(RAMPS)
    ratio, inertia, ramp = (
        x.ravel() for x in np.broadcast_arrays(ratios[:, None, None], inertias[None, :, None], np.array(RAMPS))
    )
    jumpers = Jumpers(name, level, ratio, inertia)
    jump = jumpers.jump(ramp).apex.reshape(shape)
    landing = jumpers.land().reshape(shape)[..., 0]
    transport = Gait(name).cost(level, ratios[:, None], inertias[None, :])
    values = (jump.max(-1), landing, transport)
    return Surface(dict(zip(OBJECTIVES, values, strict=True)))


def _surface_rows(name: str, surfaces: dict[str, Surface], grid: tuple[Array, Array]) -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = []
    for level, surface in surfaces.items():
        for i, j in np.ndindex(len(grid[0]), len(grid[1])):
            figures = (float(surface.values[objective][i, j]) for objective in OBJECTIVES)
            rows.append((name, level, float(grid[0][i]), float(grid[1][j]), *figures))
    return rows


def _choice_rows(
    name: str, surfaces: dict[str, Surface], grid: tuple[Array, Array], seed: int
) -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = []
    exact = surfaces["exact"]
    for objective, sign in OBJECTIVES.items():
        i, j = exact.best(objective)
        best = float(exact.values[objective][i, j])
        scatter = _scatter(name, objective, float(grid[0][i]), float(grid[1][j]), seed)
        for level, surface in surfaces.items():
            a, b = surface.best(objective)
            judged = float(exact.values[objective][a, b])
            regret = sign * (best - judged) / abs(best)
            promised = float(surface.values[objective][a, b])
            where = (float(grid[0][a]), float(grid[1][b]), a - i, b - j)
            rows.append((name, objective, level, *where, promised, judged, best, regret, *scatter))
    return rows


def _scatter(name: str, objective: str, ratio: float, inertia: float, seed: int) -> tuple[float | None, float | None]:
    """Return percentiles 5 and 95 of the exact value of a design over small changes of the motion; none for running."""
    if objective.startswith("transport"):
        return None, None
    jumpers = Jumpers(name, "exact", np.full(SEEDS * len(RAMPS), ratio), np.full(SEEDS * len(RAMPS), inertia))
    noise, factor = _noise(jumpers, SEEDS, seed)
    ramps = np.outer(factor, RAMPS).ravel()
    noise = np.repeat(noise, len(RAMPS), axis=0)
    if objective.startswith("jump"):
        values = jumpers.jump(ramps, noise).apex.reshape(SEEDS, -1).max(-1)
    else:
        values = jumpers.land(noise).reshape(SEEDS, -1)[:, 0]
    low, _, high = spread(values)
    return low, high


def _flight_rows(name: str, levels: tuple[str, ...], seed: int) -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = []
    one, exact = np.ones(FLIGHT_SEEDS), None
    for level in levels:
        jumpers = Jumpers(name, level, one, one)
        noise, factor = _noise(jumpers, FLIGHT_SEEDS, seed)
        jump = jumpers.jump(factor * RAMPS[1], noise)
        shown_jump = jump if exact is None else Jump(jump.apex - exact.apex, jump.pitch - exact.pitch)
        exact = exact or jump
        rows.append((name, level, *spread(shown_jump.apex), *spread(np.rad2deg(shown_jump.pitch))))
    return rows


def _noise(jumpers: Jumpers, count: int, seed: int) -> tuple[Array, Array]:
    """Return changes of poses (count, n_joints) [rad] and factors on ramps (count,)."""
    rng = np.random.default_rng(seed)
    noise = rng.uniform(-POSE_NOISE, POSE_NOISE, (count, len(jumpers.model.joint_links)))
    return noise, rng.uniform(1 - RAMP_NOISE, 1 + RAMP_NOISE, count)
