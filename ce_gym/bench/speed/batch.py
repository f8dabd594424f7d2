"""Time of a sub-step against the number of robots in a batch, as a table and as a picture."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from ce_gym.bench.measure.report import Cell, Table
from ce_gym.bench.measure.timing import Competitor, interleaved
from ce_gym.bench.speed import stepping
from ce_gym.compile.system import usable_cores
from ce_gym.dynamics.model import Model
from ce_gym.model import Robot
from ce_gym.model.errors import RobotError

MUJOCO_LARGEST = 4096
"""Largest batch that MuJoCo is timed with; beyond it only takes longer."""
COLORS = {"ours, float64": "#0072B2", "ours, float32": "#56B4E9", "MuJoCo, exact": "#D55E00"}
COLORS["MuJoCo, armature"] = "#E69F00"


def measure(robot: Robot, sizes: Sequence[int], dt: float, rounds: int) -> Table:
    """Time batches of one robot; a column for each side, microseconds for one robot's sub-step."""
    cores = usable_cores()
    columns: list[str] = []
    rows: list[tuple[Cell, ...]] = []
    for size in sizes:
        sides = _sides(robot, size, cores, dt)
        columns = columns or list(sides)
        timings = interleaved(sides, rounds, time.perf_counter)
        rows.append((size, *[1e6 * timings[name].best if name in timings else None for name in columns]))
    what = f"{robot.name} exact, {stepping.SUBSTEPS} sub-steps a call"
    title = f"Microseconds for one robot's sub-step against the batch: {what}"
    return Table(title, ("robots", *columns), tuple(rows))


def _sides(robot: Robot, size: int, cores: int, dt: float) -> dict[str, Competitor]:
    sides: dict[str, Competitor] = {}
    model = Model(robot, transmission="exact")
    for threads in sorted({1, cores}):
        for dtype in ("float64", "float32"):
            sides[f"ours, {dtype}, {_cores(threads)}"] = stepping.ours(model, dtype, size, threads, dt)
        for level in ("exact", "armature") if size <= MUJOCO_LARGEST else ():
            try:
                batch = stepping.mujoco_batch(robot, level, size, threads, dt)
            except (RobotError, ValueError):
                continue
            sides[f"MuJoCo, {level}, {_cores(threads)}"] = stepping.theirs(batch, robot)
    return sides


def draw(table: Table, out: Path) -> Path:
    """Draw the table: log-log, dashed for one core, solid for all."""
    import matplotlib

    matplotlib.use("Agg")  # pictures go to files, whether or not there is a display
    from matplotlib import pyplot as plt

    figure, panel = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    for column, name in enumerate(table.columns[1:], start=1):
        points = [(row[0], row[column]) for row in table.rows if row[column] is not None]
        side, one = name.rsplit(", ", 1)[0], name.endswith("one core")
        panel.plot(*zip(*points, strict=True), "o--" if one else "o-", color=COLORS[side], label=name, markersize=4)
    panel.set(xscale="log", yscale="log", xlabel="robots in the batch", ylabel="time of one robot's sub-step [µs]")
    panel.set_title(table.title.split(": ")[1], fontsize=10)
    panel.grid(which="major", color="#e4e4e4", linewidth=0.6)
    panel.spines[["top", "right"]].set_visible(False)
    figure.legend(frameon=False, fontsize=8, ncols=2, loc="outside lower center")
    path = out / "batch.png"
    figure.savefig(path, dpi=160)
    plt.close(figure)
    return path


def _cores(threads: int) -> str:
    return "one core" if threads == 1 else f"{threads} cores"
