"""Steps that adapt: error delivered against error asked, and time against that of the best fixed step.

Every scene of the accuracy benchmark runs with `method="adaptive"` at tolerances from 0.1 down, an interval being the
time for which targets are held. Its error is that of the other curves. Time is compared at the error delivered, with
the extrapolated method, whose steps the adaptive one makes, and with the best of all methods, at the best fixed step.
"""

from __future__ import annotations

import argparse
import csv
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ce_gym.bench.accuracy.curves import (
    MARGIN,
    NUM_ENVS,
    OUR_STEPS,
    Curve,
    Delivered,
    Measured,
    Point,
    Side,
    our_sides,
    reference,
    rms_error,
    time_to,
)
from ce_gym.bench.accuracy.ours import Ours
from ce_gym.bench.accuracy.scenarios import HOLD, SCENES, Array, Scene, Way
from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.bench.measure.timing import Competitor, interleaved
from ce_gym.viewer.console import shown

TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
STEPS = (*OUR_STEPS, 500)
MEDIAN, WORST, TIME = 3.0, 30.0, 1.3
"""What error delivered over error asked may be, and time over that of the best fixed step."""
QUICK_SCENES, QUICK_TOLERANCES, QUICK_STEPS = ("tumble", "slide"), (1e-2, 1e-4), (1, 5, 20, 100)
NAME = ("ce_gym", "exact", "adaptive")
COLUMNS = (
    "scene", "asked", "delivered", "delivered / asked", "steps", "refused", "missed", "time [us]",
    "/ best fixed, extrapolated", "/ best fixed, any method", "counts",
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--out", type=Path, default=Path("adaptive"), help="folder for picture, CSV and table")
    parser.add_argument("--scenes", nargs="+", choices=tuple(SCENES), help="all by default")
    parser.add_argument("--rounds", type=int, default=3, help="how often each point is timed")
    parser.add_argument("--quick", action="store_true", help="two scenes, few steps, one round")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    from ce_gym.bench.accuracy import plots as accuracy_plots

    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    tolerances, steps, rounds = TOLERANCES, STEPS, arguments.rounds
    if arguments.quick:
        tolerances, steps, rounds = QUICK_TOLERANCES, QUICK_STEPS, 1
    found: list[Delivered] = []
    for name in shown(arguments.scenes or (QUICK_SCENES if arguments.quick else SCENES), "scenes"):
        found += measure(SCENES[name](), tolerances, steps, rounds)
        write_csv(out / "adaptive.csv", found)
    table = Table("Adaptive steps, one robot and one simulated second", COLUMNS, tuple(map(row, found)))
    (out / "adaptive.md").write_text(table.as_markdown() + "\n", encoding="utf-8")
    picture = accuracy_plots.draw_adaptive(found, out)
    report = Report("adaptive", [table], requirements(found))
    report.remarks.append(
        f"A row counts if most steps were shorter than the longest, {1e3 * HOLD:.0f} ms, and the error is not below "
        f"{MARGIN:.0f} times what the reference is known to. Written: {picture}, {out}/adaptive.csv, {out}/adaptive.md"
    )
    return report


def measure(scene: Scene, tolerances: Sequence[float], steps: Sequence[int], rounds: int) -> list[Delivered]:
    """Measure a scene at all tolerances, and our methods at all fixed steps, taking turns."""
    _, limit, known = reference(scene)
    batch = Ours(scene, Way("adaptive", scene.exact), NUM_ENVS)
    fixed = (w for w in scene.ours if (w.level, w.dtype) == (scene.exact, "float64") and w.method != "adaptive")
    exact = replace(scene, ours=tuple(fixed))
    sides = our_sides(exact, steps, limit)
    sides += [Side(NAME, asked, partial(batch.run, 1, asked), NUM_ENVS, limit) for asked in tolerances]
    paths: dict[Side, Array] = {}
    counts: dict[Side, tuple[float, float, float]] = {}

    def runner(side: Side) -> Callable[[], None]:
        def work() -> None:
            paths[side] = side.run()
            if side.name == NAME:
                names = ("steps_taken", "retries", "steps_missed")
                counts[side] = tuple(float(batch.arrays[name].mean()) for name in names)  # type: ignore[assignment]

        return work

    timings = interleaved({str(i): Competitor(runner(s)) for i, s in enumerate(sides)}, rounds, time.thread_time)
    seconds = {side: timings[str(i)].best / (side.robots * scene.duration) for i, side in enumerate(sides)}
    errors = {side: rms_error(scene, paths[side], limit) for side in sides}
    for name in dict.fromkeys(side.name for side in sides if side.name != NAME):
        points = [Point(s.dt, seconds[s], errors[s], errors[s]) for s in sides if s.name == name]
        known.curves.append(Curve(*name, tuple(points)))
    return [
        delivered(known, asked, errors[side], seconds[side], counts[side])
        for asked, side in zip(tolerances, [side for side in sides if side.name == NAME], strict=True)
    ]


def delivered(
    known: Measured, asked: float, error: float, seconds: float, counts: tuple[float, float, float]
) -> Delivered:
    """Return how one tolerance compares with the fixed steps whose curves are known."""
    floor = MARGIN * known.known(known.curves[0])
    at = max(error, floor)
    times = {curve.method: time_to(curve, known.errors(curve), at) for curve in known.curves}
    reached = [seconds for seconds in times.values() if seconds is not None]
    decided = counts[0] > 1.5 * known.scene.holds and error >= floor
    best = min(reached, default=None)
    return Delivered(known.scene.name, asked, error, seconds, times["extrapolated"], best, *counts, decided)


def row(d: Delivered) -> tuple[Cell, ...]:
    """Return a row of the table."""
    best = d.seconds / d.best if d.best else None
    steps = (round(d.taken), round(d.refused, 1), round(d.missed, 1))
    seconds = 1e6 * d.seconds
    return (d.scene, f"{d.asked:.0e}", d.error, d.ratio, *steps, seconds, d.slower, best, "yes" if d.counts else "no")


def requirements(found: Sequence[Delivered]) -> list[Requirement]:
    """Return whether errors are what was asked for, and in what time."""
    counted = [d for d in found if d.counts]
    ratios = np.array([d.ratio for d in counted] or [math.nan])
    worst = counted[int(np.argmax(ratios))] if counted else None
    slower = [d for d in counted if d.slower is not None]
    slow = [d for d in slower if (d.slower or 0.0) > TIME]
    where = f" ({worst.scene} at {worst.asked:.0e})" if worst else ""
    names = f": {', '.join(f'{d.scene} {d.asked:.0e} {d.slower:.2f}' for d in slow)}" if slow else ""
    return [
        Requirement(
            f"error delivered / asked, median at most {MEDIAN:.0f}",
            f"{np.median(ratios):.2f} of {len(counted)}",
            float(np.median(ratios)) <= MEDIAN,
        ),
        Requirement(
            f"error delivered / asked, worst at most {WORST:.0f}",
            f"{np.max(ratios):.1f}{where}; least {np.min(ratios):.2g}",
            float(np.max(ratios)) <= WORST,
        ),
        Requirement(
            f"time at most {TIME} times that of the best fixed extrapolated step at that error",
            f"{len(slower) - len(slow)} of {len(slower)}, median "
            f"{np.median([d.slower or 0.0 for d in slower] or [math.nan]):.2f}{names}",
            not slow,
        ),
    ]


def write_csv(path: Path, found: Sequence[Delivered]) -> None:
    """Write every row."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows(row(d) for d in found)
