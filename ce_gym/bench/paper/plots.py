"""Pictures of the paper's figures: depth, locality, cost of approximation, tracking torque. Needs matplotlib.

One colour means one algorithm throughout; the palette is that of Okabe and Ito, which colour-blind readers can tell
apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle, groupby
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from ce_gym.bench.paper import tracking
from ce_gym.bench.paper.counts import ChainCount, RobotCount, crossover
from ce_gym.dynamics.model import Model
from ce_gym.model import load_robot

matplotlib.use("Agg")  # pictures go to files, whether or not there is a display
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

BLUE, SKY, GREEN, ORANGE, RED, GREY = "#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00", "#777777"
STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.titlesize": 10.0,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "lines.markersize": 4.0,
}
OURS = {
    "exact": ("ours, exact", BLUE, "o-"),
    "general": ("ours, exact, every rotor a body", SKY, "s-"),
    "armature": ("ours, armature", GREEN, "^-"),
    "none": ("ours, rotors deleted", GREY, "v-"),
}
OTHERS = {
    "ce_aba": ("paper's library, CE-ABA", ORANGE, "D--"),
    "proximal": ("Pinocchio, proximal and sparse", RED, "x--"),
}
DEPTH_COLORS = (GREEN, BLUE, ORANGE, RED)
LOCALITY_STYLES = {
    "ours, exact": ("o", "-", 1.8),
    "Pinocchio, proximal and sparse": ("x", "--", 1.1),
    "paper's library, CE-ABA": ("", ":", 1.1),
}
"""Marker, line and its width."""
TITLES = {
    "link_and_rotor": "Links with geared rotors",
    "belt_pair": "Link pairs with parallel belts",
    "four_bar": "Four-bars",
    "transmission_parallel": "Tied by a transmission (explicit)",
    "rod_parallel": "Tied by a connecting rod (implicit)",
}


def draw_depth(chain: str, counts: Sequence[ChainCount], out: Path) -> Path:
    """Draw instructions against depth, one panel for each number of branches; returns the file."""
    groups = [(n, list(group)) for n, group in groupby(counts, key=lambda c: c.reference.branches)]
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(
            1, len(groups), figsize=(2.4 + 2.4 * len(groups), 3.9), sharey=True, squeeze=False, layout="constrained"
        )
        for panel, (branches, points) in zip(panels[0], groups, strict=True):
            depths = [p.reference.depth for p in points]
            for rank, name in enumerate(points[0].ours):  # the first is drawn on top
                label, color, style = OURS[name]
                panel.plot(depths, [p.ours[name] for p in points], style, color=color, label=label, zorder=9 - rank)
            for name, (label, color, style) in OTHERS.items():
                panel.plot(depths, [getattr(p.reference, name) for p in points], style, color=color, label=label)
            panel.set_title(f"{branches} branch" + ("es" if branches != 1 else ""))
            panel.set_xlabel("depth [units]")
            _log_axes(panel, [tick for tick in (1, 2, 3, 5, 7, 10) if tick <= max(depths)])
        panels[0][0].set_ylabel("instructions")
        figure.suptitle(f"{TITLES[chain]}: forward dynamics against depth", fontweight="bold")
        _legend_below(figure, panels[0][0])
        return _save(figure, out / f"depth_{chain}.png")


def draw_locality(counts: Sequence[ChainCount], out: Path) -> Path:
    """Draw instructions against loop size, one panel for each kind of tie, one colour for each depth."""
    chains = [(chain, list(group)) for chain, group in groupby(counts, key=lambda c: c.reference.chain)]
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(
            1,
            max(1, len(chains)),
            figsize=(1.2 + 4.3 * len(chains), 4.6),
            sharex=True,
            sharey=True,
            squeeze=False,
            layout="constrained",
        )
        for panel, (chain, of_chain) in zip(panels[0], chains, strict=True):
            by_depth = groupby(of_chain, key=lambda c: c.reference.depth)
            for color, (_, group) in zip(cycle(DEPTH_COLORS), by_depth, strict=False):
                _draw_loop_sizes(panel, list(group), color)
            panel.set_title(TITLES[chain])
            panel.set_xlabel("loop size [bodies]")
            _log_axes(panel, (2, 3, 5, 10, 20, 40))
        panels[0][0].set_ylabel("instructions")
        figure.suptitle("Locality: two parallel chains with one loop of growing size", fontweight="bold")
        _locality_legend(figure, [depth for depth, _ in groupby(chains[0][1], key=lambda c: c.reference.depth)])
        return _save(figure, out / "locality.png")


def _draw_loop_sizes(panel: Axes, points: list[ChainCount], color: str) -> None:
    sizes = [p.reference.loop_size or 0 for p in points]
    ours = [p.ours["exact"] for p in points]
    proximal = [p.reference.proximal or 0 for p in points]
    library = [p.reference.ce_aba for p in points]
    for values, (marker, line, width) in zip((ours, proximal, library), LOCALITY_STYLES.values(), strict=True):
        panel.plot(sizes, values, marker=marker, linestyle=line, color=color, linewidth=width)
    size = crossover(sizes, ours, proximal)
    if size is not None and size > sizes[0]:
        height = np.exp(np.interp(np.log(size), np.log(sizes), np.log(ours)))
        panel.plot(size, height, "o", markersize=11, markerfacecolor="none", markeredgecolor=color)
        panel.annotate(
            f"{size:.0f}", (size, height), (9, -11), textcoords="offset points", color=color, fontweight="bold"
        )


def _locality_legend(figure: Figure, depths: Sequence[int]) -> None:
    """Colours say how deep the chains are, lines say whose algorithm it is, circles where the cheaper one changes."""

    def line(label: str, **style: Any) -> Line2D:
        return Line2D([], [], label=label, **{"color": "black", **style})

    handles = [line(f"depth {d}", color=c, linewidth=4) for c, d in zip(cycle(DEPTH_COLORS), depths, strict=False)]
    for label, (marker, linestyle, width) in LOCALITY_STYLES.items():
        handles.append(line(label, marker=marker, linestyle=linestyle, linewidth=width))
    circle = {"marker": "o", "markersize": 10, "markerfacecolor": "none", "linestyle": ""}
    handles.append(line("ours and proximal cross", **circle))
    figure.legend(handles=handles, loc="outside lower center", ncols=4)


def draw_approximation(counts: Sequence[RobotCount], out: Path) -> Path:
    """Draw how many instructions leaving out the rotors saves, ours beside the library's and the printed figures."""
    counts = [c for c in counts if c.reference.approximate is not None]
    series = {
        "ours, armature instead of exact": (GREEN, [100 * (1 - c.ours["armature"] / c.ours["exact"]) for c in counts]),
        "ours, rotors deleted": (BLUE, [100 * (1 - c.ours["none"] / c.ours["exact"]) for c in counts]),
        "paper's library 45fa7c4, rotors deleted": (ORANGE, [_library_saving(c) for c in counts]),
        "the same as printed in the paper": (GREY, [c.reference.paper_saving or np.nan for c in counts]),
    }
    with plt.rc_context(STYLE):
        figure, panel = plt.subplots(figsize=(4.6 + 1.4 * len(counts), 3.8), layout="constrained")
        _grouped_bars(panel, series, [c.robot.replace("_", " ") for c in counts], "{:.1f}")
        panel.set_ylabel("instructions saved [%]")
        figure.suptitle("What leaving out the rotors saves in forward dynamics", fontweight="bold")
        _legend_below(figure, panel, columns=2)
        return _save(figure, out / "approximation.png")


def _library_saving(c: RobotCount) -> float:
    return 100 * (1 - c.reference.approximate / c.reference.ce_aba) if c.reference.approximate else np.nan


def draw_tracking(robot: str, joint: str, out: Path) -> Path:
    """Draw the torque of one joint in the paper's tracking experiment and the errors of all joints; also writes CSV."""
    joints, exact, errors = tracking.torque_errors(robot)
    column = joints.index(joint)
    times = np.arange(tracking.SAMPLES) * tracking.STEP
    traces = {"exact": exact[:, column]}
    for level, name in tracking.SIMPLIFIED.items():
        model = Model(load_robot(robot), transmission=level, locked_rotors=False)
        traces[name] = model.inverse_dynamics(*tracking.sinusoid(model.nv))[:, column]
    header = ",".join(["time [s]", *(f"{name} {joint} [N m]" for name in traces)])
    table = np.column_stack([times, *traces.values()])
    np.savetxt(out / "tracking.csv", table, fmt="%.9g", delimiter=",", header=header, comments="")
    colors = {"exact": BLUE, "unconstrained": GREY, "approximate": GREEN}
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(
            1, 2, figsize=(10.4, 3.8), layout="constrained", gridspec_kw={"width_ratios": [1.3, 1]}
        )
        shown = times <= 2.0 / tracking.FREQUENCY
        for name, trace in traces.items():
            left.plot(times[shown], trace[shown], color=colors[name], label=name)
        left.set(xlabel="time [s]", ylabel="torque [N m]", title=f"{_short(joint)}, two periods")
        series = {name: (colors[name], list(errors[level])) for level, name in tracking.SIMPLIFIED.items()}
        _grouped_bars(right, series, [_short(name) for name in joints], "{:.2f}")
        right.set(ylabel="rms torque error [N m]", title="error of each joint")
        figure.suptitle("Tracking torque: what simplified transmissions get wrong", fontweight="bold")
        _legend_below(figure, left)
        return _save(figure, out / "tracking.png")


def _grouped_bars(panel: Axes, series: dict[str, tuple[str, list[float]]], labels: Sequence[str], number: str) -> None:
    width = 0.8 / len(series)
    for i, (name, (color, heights)) in enumerate(series.items()):
        places = np.arange(len(labels)) + (i - (len(series) - 1) / 2) * width
        bars = panel.bar(places, heights, 0.92 * width, color=color, label=name)
        texts = [number.format(h) if np.isfinite(h) else "" for h in heights]
        panel.bar_label(bars, texts, padding=1.5, fontsize=7.5)
    panel.set_xticks(range(len(labels)), labels)
    panel.set_xlim(-0.6, len(labels) - 0.4)
    panel.grid(axis="x", visible=False)


def _log_axes(panel: Axes, ticks: Sequence[int]) -> None:
    """Make both axes logarithmic: linear growth has slope one, cubic growth three."""
    panel.set_xscale("log")
    panel.set_xticks(ticks, [str(tick) for tick in ticks])
    panel.xaxis.set_minor_formatter(NullFormatter())
    panel.xaxis.minorticks_off()
    panel.set_yscale("log")
    panel.yaxis.set_minor_formatter(NullFormatter())
    panel.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:,.0f}"))


def _legend_below(figure: Figure, panel: Axes, columns: int = 3) -> None:
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(columns, len(labels)))


def _short(joint: str) -> str:
    return joint.removesuffix("_link").replace("_", " ")


def _save(figure: Figure, path: Path) -> Path:
    figure.savefig(path, dpi=160)
    plt.close(figure)
    return path
