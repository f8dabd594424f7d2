"""Pictures of the studies, drawn from their tables. Needs matplotlib; one colour means one level throughout."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from ce_gym.bench.exactness.protocol import BANDWIDTHS, INERTIA_GRID, RATIO_GRID, RATIOS, STIFFNESSES
from ce_gym.bench.measure.report import Cell, Table
from ce_gym.bench.paper.plots import BLUE, GREEN, GREY, ORANGE, RED, STYLE, plt
from ce_gym.bench.paper.tracking import FREQUENCY, PUBLISHED

COLORS = {"exact": BLUE, "coupled": GREEN, "armature": ORANGE, "none": RED}
MARKERS = {"exact": "*", "coupled": "D", "armature": "o", "none": "v"}
AGAINST = "frequency [Hz]"
PUBLISHED_LEG = "mit_humanoid_leg"
Rows = list[dict[str, Cell]]


def chosen(table: Table, **where: Cell) -> Rows:
    """Return the rows of a table whose cells are as said; words of a heading before its unit are its name."""
    names = {column.split(" [")[0]: column for column in table.columns}
    rows: Rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    return [row for row in rows if all(row[names[name]] == value for name, value in where.items())]


def _panels(names: list[Cell], rows: int, height: float) -> tuple[Any, Any]:
    """Return a figure with a column of panels for each name."""
    size = (1 + 3.6 * len(names), height)
    figure, panels = plt.subplots(rows, len(names), figsize=size, layout="constrained", squeeze=False)
    for panel, name in zip(panels[0], names, strict=True):
        panel.set_title(str(name))
    return figure, panels


def controllers(tables: Mapping[str, Table], out: Path) -> Path:
    """Draw torque errors without feedback, and torque and tracking errors of computed torque at 8 Hz."""
    free, loop = tables["feedforward"], tables["tracking"]
    legs = list(dict.fromkeys(row[0] for row in loop.rows))
    with plt.rc_context(STYLE):
        figure, panels = _panels(legs, rows=3, height=8.2)
        for column, leg in zip(panels.T, legs, strict=True):
            for level in ("coupled", "armature", "none"):
                _worst_joint(column[0], chosen(free, mechanism=leg, level=level), level)
                rows = chosen(loop, mechanism=leg, level=level, controller="joints", signal="chirp")
                _band(column[1], [row for row in rows if row["bandwidth [Hz]"] == BANDWIDTHS[1]], "share", level)
            for level in COLORS:
                rows = chosen(loop, mechanism=leg, level=level, controller="joints", signal="chirp")
                _band(
                    column[2],
                    [row for row in rows if row["bandwidth [Hz]"] == BANDWIDTHS[1]],
                    "error",
                    level,
                    "[rad or m]",
                )
            for panel in column:
                panel.set_yscale("log")
            column[2].set_xlabel(AGAINST)
        for (level, _), point in PUBLISHED.items() if PUBLISHED_LEG in legs else ():
            at = panels[0][legs.index(PUBLISHED_LEG)]
            at.plot(FREQUENCY, point, "*", color=COLORS[level], markersize=11, markeredgecolor="black")
        for row, name in enumerate(
            ("no feedback: rms torque error,\nworst joint [N m]", "torque error / exact torque", "tracking error [rad]")
        ):
            panels[row][0].set_ylabel(name)
        figure.legend(*panels[2][0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        figure.suptitle(
            "Chirps of all joints: what a controller loses that knows a simplified level (stars: the paper)",
            fontweight="bold",
        )
        return _saved(figure, out / "exactness_controllers.png")


def contacts(table: Table, out: Path) -> Path:
    """Draw impulses over their rigid limits against stiffness, and peak forces over exact against the gear ratio."""
    robots = list(dict.fromkeys(row[0] for row in table.rows))
    with plt.rc_context(STYLE):
        figure, panels = _panels(robots, rows=2, height=6.0)
        for column, robot in zip(panels.T, robots, strict=True):
            for level, color in COLORS.items():
                own = [r for r in chosen(table, robot=robot, level=level, inertia=1.0) if r["ratio"] == 1.0]
                marker = MARKERS[level]
                column[0].plot(
                    [r["stiffness [N/m]"] for r in own],
                    [r["over rigid"] for r in own],
                    marker + "-",
                    color=color,
                    label=level,
                )
                free = [r["over rigid, motors free"] for r in own]
                column[0].plot([r["stiffness [N/m]"] for r in own], free, ":", color=color)
                if level == "exact":
                    continue
                rows = chosen(table, robot=robot, level=level, inertia=1.0, stiffness=STIFFNESSES[-2])
                x = [r["ratio"] for r in rows]
                column[1].plot(x, [r["peak over exact"] for r in rows], marker, color=color)
                column[1].plot(x, [r["root of effective mass over exact"] for r in rows], "-", color=color)
            column[0].set(xscale="log", yscale="log", xlabel="stiffness of the ground [N/m]")
            column[1].set(xscale="log", yscale="log", xlabel="factor on the gear ratios")
            column[1].xaxis.set_ticks(RATIOS, [f"{ratio:g}" for ratio in RATIOS])
            column[1].xaxis.set_minor_formatter(NullFormatter())
            column[0].axhline(1.0, color=GREY, linewidth=0.8)
            column[1].axhline(1.0, color=GREY, linewidth=0.8)
        panels[0][0].set_ylabel("impulse / rigid limit of the level\n(dotted: motors let go)")
        panels[1][0].set_ylabel("peak force / exact, at 5e6 N/m\n(lines: roots of rigid effective masses)")
        panels[0][0].legend()
        figure.suptitle("Landings at 1 m/s", fontweight="bold")
        return _saved(figure, out / "exactness_contacts.png")


def designs(tables: Mapping[str, Table], out: Path) -> Path:
    """Draw the exact surface of every objective, and where each level's best design lies on it."""
    choice = tables["choice"]
    robots, objectives = (list(dict.fromkeys(row[i] for row in choice.rows)) for i in (0, 1))
    with plt.rc_context({**STYLE, "axes.grid": False}):
        size = (1 + 3.9 * len(objectives), 0.8 + 3.2 * len(robots))
        figure, panels = plt.subplots(len(robots), len(objectives), figsize=size, layout="constrained", squeeze=False)
        for robot, line in zip(robots, panels, strict=True):
            for objective, panel in zip(objectives, line, strict=True):
                rows = chosen(tables["surface"], robot=robot, level="exact")
                values = np.array([row[str(objective)] for row in rows]).reshape(-1, len(INERTIA_GRID))
                wide = values.min() > 0 and values.max() > 8 * values.min()
                heights = (np.geomspace if wide else np.linspace)(values.min(), values.max(), 16)
                norm = LogNorm() if wide else None
                shape = panel.contourf(RATIO_GRID, INERTIA_GRID, values.T, heights, cmap="Greys", norm=norm)
                figure.colorbar(shape, ax=panel, format="%.3g")
                for i, row in enumerate(chosen(choice, robot=robot, objective=objective)):
                    level = str(row["level"])
                    look = {
                        "color": COLORS[level],
                        "markeredgecolor": "white",
                        "markersize": 8 + 3 * i,
                        "zorder": 9 - i,
                    }
                    panel.plot(row["ratio"], row["inertia"], MARKERS[level], label=level, clip_on=False, **look)
                panel.set(xscale="log", yscale="log", title=f"{robot}: {objective}", xlabel="ratio", ylabel="inertia")
                for axis, ticks in ((panel.xaxis, (0.4, 1.0, 2.5)), (panel.yaxis, (0.25, 1.0, 4.0))):
                    axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
                    axis.set_minor_formatter(NullFormatter())
        figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        figure.suptitle("Exact surfaces, and the design that each level would choose", fontweight="bold")
        return _saved(figure, out / "exactness_designs.png")


def _worst_joint(panel: Axes, rows: Rows, level: str) -> None:
    frequencies = sorted({float(row[AGAINST]) for row in rows})  # type: ignore[arg-type]
    worst = [max(float(r["error [N m]"]) for r in rows if r[AGAINST] == f) for f in frequencies]  # type: ignore[arg-type]
    panel.plot(frequencies, worst, MARKERS[level] + "-", color=COLORS[level], label=level)


def _band(panel: Axes, rows: Rows, name: str, level: str, unit: str = "") -> None:
    x = [row[AGAINST] for row in rows]
    low, middle, high = (
        [row[f"{key}"] for row in rows] for key in (f"{name} p5", f"{name} {unit}".strip(), f"{name} p95")
    )
    panel.plot(x, middle, MARKERS[level] + "-", color=COLORS[level], label=level)  # type: ignore[arg-type]
    panel.fill_between(x, low, high, color=COLORS[level], alpha=0.2, linewidth=0)  # type: ignore[arg-type]


def _saved(figure: Figure, path: Path) -> Path:
    figure.savefig(path, dpi=90)
    plt.close(figure)
    return path
