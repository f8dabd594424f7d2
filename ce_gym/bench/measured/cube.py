"""Tosses of a real cube replayed by ce_gym and MuJoCo, each fitted to a training split by the same optimiser.

Every toss starts from its first measured state. Differential evolution fits the parameters of each engine with equal
numbers of evaluations. The variant of an engine with the smallest training error is compared on the test split.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.bench.measured.cube_engines import Candidates, Ours, Peer
from ce_gym.bench.measured.data import interval
from ce_gym.bench.measured.tosses import SIDE, Array, Tosses, corner_error, depths, errors, final, read_tosses
from ce_gym.console import progress

TRAINING, POPULATION, GENERATIONS = 100, 16, 12
ROUND = 0.008
"""Radius of rounded corners [m]."""
VARIANTS: dict[str, Ours | Peer] = {
    "ce_gym": Ours(0.0),
    "ce_gym, rounded corners": Ours(ROUND),
    "MuJoCo, box": Peer(None),
    "MuJoCo, box, pyramidal": Peer(None, "pyramidal"),
    "MuJoCo, rounded corners": Peer(ROUND),
    "MuJoCo, rounded corners, solimp": Peer(ROUND, impedance=True),
}
VELOCITY_ERROR = np.repeat([0.011, 0.084], 3)
"""Standard deviation of the first velocities [m/s, rad/s], by the poses at the last frames before contact."""
TIMES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
ENGINES = ("ce_gym", "MuJoCo")
TIME_COLUMNS = ("simulation", *(f"{t:g} s" for t in TIMES))
COLUMNS = (
    "simulation", "training error [mm]", "final position [mm]", "interval", "final rotation [deg]", "interval",
    "mean position [% of side]", "mean rotation [deg]", "deepest corner [mm]",
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--picture", type=Path, metavar="FILE", help="also draw errors over time to a PNG file")


def run(arguments: argparse.Namespace) -> Report:
    """Fit all variants and compare them on the test split."""
    tosses = read_tosses()
    order = np.random.default_rng(0).permutation(len(tosses.lengths))
    training, test = tosses.select(order[:TRAINING]), tosses.select(order[TRAINING:])
    fits = {name: fit(engine, training) for name, engine in progress(list(VARIANTS.items()), "fits")}
    poses = {name: VARIANTS[name](test, best)[0] for name, (best, _) in fits.items()}
    best = {engine: min((n for n in fits if n.startswith(engine)), key=lambda n: fits[n][1]) for engine in ENGINES}
    rows = [row(name, test, poses[name], 1e3 * fits[name][1]) for name in VARIANTS]
    rows.append(row("ce_gym, perturbed, against itself", *perturbed(test, best["ce_gym"], fits), None))
    depth = depths(test.poses)
    rows.append(("measured", *[None] * 7, deepest(depth)))
    parameters = tuple((n, ", ".join(f"{k} {v[0]:.3g}" for k, v in fits[n][0].items())) for n in VARIANTS)
    tables = [
        Table(f"Tossed cube, {len(test.lengths)} tosses of the test split", COLUMNS, tuple(rows)),
        Table("Median error over time, position [mm] and rotation [deg]", TIME_COLUMNS, over_time(test, poses, best)),
        Table("Fitted parameters [SI units]", ("simulation", "parameters"), parameters),
    ]
    if arguments.picture:
        draw(test, {name: poses[name] for name in best.values()}, arguments.picture)
    return Report("cube", tables, requirements(test, [poses[best[engine]] for engine in ENGINES], list(best.values())))


def fit(engine: Ours | Peer, tosses: Tosses) -> tuple[Candidates, float]:
    """Return the best parameters of an engine, and their error: the mean final corner error, one side at most [m].

    Source of the optimiser: Storn and Price 1997, in SciPy.
    """
    from scipy.optimize import differential_evolution

    names, bounds = list(engine.bounds), np.array(list(engine.bounds.values()))
    low, high = bounds[:, :1], bounds[:, 1:]
    logarithmic = low > 0

    def parameters(x: Array) -> Candidates:
        x = x.reshape(len(names), -1)
        ratio = np.where(logarithmic, high / np.where(logarithmic, low, 1.0), 1.0)
        return dict(zip(names, np.where(logarithmic, low * ratio**x, low + (high - low) * x), strict=True))

    def error(x: Array) -> Array:
        corners = corner_error(*errors(tosses, engine(tosses, parameters(x))))
        return np.minimum(final(tosses, corners), SIDE).mean(axis=-1)

    n = len(names)
    cells = np.argsort(np.random.default_rng(0).random((n, POPULATION)), axis=1).T  # a Latin hypercube
    options: dict[str, Any] = {
        "seed": 0,
        "maxiter": GENERATIONS,
        "init": (cells + 0.5) / POPULATION,
        "polish": False,
        "tol": 0.0,
    }
    result = differential_evolution(error, [(0.0, 1.0)] * n, vectorized=True, updating="deferred", **options)
    return parameters(result.x), float(result.fun)


def row(name: str, tosses: Tosses, poses: Array, training: float | None) -> tuple[Cell, ...]:
    """Return the row of a simulation in the first table."""
    position, rotation = errors(tosses, poses)
    cells: list[Cell] = [name, training]
    for error in (1e3 * final(tosses, position), np.degrees(final(tosses, rotation))):
        low, high = interval(np.median, error)
        cells += [float(np.median(error)), f"{low:.1f} to {high:.1f}"]
    means = 100 / SIDE * np.nanmean(position, axis=1).mean(), np.degrees(np.nanmean(rotation, axis=1).mean())
    return (*cells, *map(float, means), deepest(depths(poses)))


def deepest(depth: Array) -> float:
    """Return the median of the largest depth of a corner below its depth at rest [mm]."""
    return float(1e3 * np.median(depth.max(axis=1) - depth[:, -1]))


def perturbed(tosses: Tosses, name: str, fits: dict[str, tuple[Candidates, float]]) -> tuple[Tosses, Array]:
    """Return simulated tosses, and their simulation from velocities with the errors of the measured ones."""
    engine, parameters = VARIANTS[name], fits[name][0]
    noise = VELOCITY_ERROR * np.random.default_rng(1).normal(size=tosses.velocities.shape)
    simulated = replace(tosses, poses=engine(tosses, parameters)[0])
    return simulated, engine(replace(tosses, velocities=tosses.velocities + noise), parameters)[0]


def over_time(tosses: Tosses, poses: dict[str, Array], best: dict[str, str]) -> tuple[tuple[Cell, ...], ...]:
    """Return the rows of the table of errors over time."""
    frames = [round(t / tosses.dt) for t in TIMES]
    rows = []
    for name in best.values():
        position, rotation = errors(tosses, poses[name])
        medians = zip(np.nanmedian(position, axis=0)[frames], np.nanmedian(rotation, axis=0)[frames], strict=True)
        rows.append((name, *(f"{1e3 * p:.1f}, {np.degrees(r):.1f}" for p, r in medians)))
    return tuple(rows)


def requirements(tosses: Tosses, poses: Sequence[Array], names: Sequence[str]) -> list[Requirement]:
    """Return the comparisons of the median final errors of ce_gym and MuJoCo, with intervals of the ratios."""
    compared = []
    ours, theirs = (errors(tosses, each) for each in poses)
    for what, a, b in zip(("position", "rotation"), ours, theirs, strict=True):
        pair = final(tosses, a), final(tosses, b)
        ratio = float(np.median(pair[0]) / np.median(pair[1]))
        low, high = interval(lambda x, y: np.median(x) / np.median(y), *pair)
        claim = f"median final {what} error of {names[0]} is at most that of {names[1]}"
        compared.append(Requirement(claim, f"ratio {ratio:.2f}, {low:.2f} to {high:.2f}", ratio <= 1.0))
    return compared


def draw(tosses: Tosses, poses: dict[str, Array], file: Path) -> None:
    """Draw the quartiles of the errors over time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(8.0, 3.2), layout="constrained")
    frames = round(TIMES[-1] / tosses.dt)
    for name, colour in zip(poses, ("#0072B2", "#D55E00"), strict=True):
        for panel, error, scale in zip(panels, errors(tosses, poses[name]), (1e3, 180 / np.pi), strict=True):
            low, middle, high = scale * np.nanpercentile(error[:, :frames], [25, 50, 75], axis=0)
            t = tosses.dt * np.arange(frames)
            panel.plot(t, middle, color=colour, label=name)
            panel.fill_between(t, low, high, color=colour, alpha=0.15, linewidth=0)
    for panel, label in zip(panels, ("position error [mm]", "rotation error [deg]"), strict=True):
        panel.set(xlabel="time after the first frame [s]", ylabel=label, xlim=(0, TIMES[-1]), ylim=(0, None))
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].legend(frameon=False)
    figure.savefig(file, dpi=110)
    plt.close(figure)
