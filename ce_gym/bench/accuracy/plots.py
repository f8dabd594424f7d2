"""Picture of the accuracy benchmark: error against time, one panel for each scene. Needs matplotlib.

Lines of ce_gym are blue and green, dotted in single precision. MuJoCo is orange and red, Drake is yellow. The palette
is by Okabe and Ito.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import matplotlib

from ce_gym.bench.accuracy.curves import MARGIN, Curve, Measured
from ce_gym.bench.accuracy.scenarios import SINGLE

matplotlib.use("Agg")  # works without a display
from matplotlib import pyplot as plt

BLUE, SKY, GREEN, ORANGE, RED, GREY = "#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00", "#777777"
STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "legend.frameon": False,
}
COLUMNS = 4
OURS = {
    "euler": ("ce_gym, Euler", SKY, "o-"),
    "euler, secant": ("ce_gym, Euler, secant friction", GREEN, "v-"),
    "extrapolated": ("ce_gym, extrapolated", BLUE, "s-"),
    "extrapolated, secant": ("ce_gym, extrapolated, secant friction", GREEN, "s-"),
    "adaptive": ("ce_gym, steps that adapt", BLUE, "*-"),
    "adaptive, secant": ("ce_gym, steps that adapt, secant friction", GREEN, "*-"),
    "rk4": ("ce_gym, RK4", "black", "D-"),
}
APPROXIMATE = ("ce_gym, armature or coupled, Euler", GREY, "o-")
COLORS = {"": ORANGE, "exact": "#CC79A7", "stiff": RED}
"""Colours of MuJoCo: without rotors; rotors or loops with default constraints; with stiff constraints."""
VARIANTS = {"": "without rotor bodies", "exact": "with rotor bodies", "stiff": "the same, stiff"}
DRAKE, DRAKE_MARKERS = "#B8A000", {"discrete": "P", "fixed steps": "X", "error control": "*"}
"""Yellow, dark enough for thin lines."""
MARKERS = {"Euler": "o", "implicitfast": "^", "discrete": "s", "RK4": "D"}


def draw(measured: list[Measured], file: Path) -> None:
    """Draw all scenes."""
    rows = math.ceil(len(measured) / COLUMNS)
    columns = min(COLUMNS, len(measured))
    style: dict[Any, Any] = {**STYLE, "lines.linewidth": 1.2, "lines.markersize": 3.5}
    with plt.rc_context(style):
        size = (1.0 + 3.9 * columns, 1.6 + 3.1 * rows)
        figure, panels = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
        handles = {}
        for panel, m in zip(panels.flat, measured, strict=False):
            for curve in m.curves:
                label, look = _look(curve, m.scene.exact)
                points = [(p.seconds, m.error(p)) for p in curve.points if 0 < m.error(p) < math.inf]
                if points:
                    x, y = zip(*points, strict=True)
                    (handles[label],) = panel.plot([1e6 * t for t in x], y, label=label, **look)
            floor = MARGIN * m.known(next(c for c in m.curves if c.level == m.scene.exact))
            panel.axhline(floor, color=GREY, linewidth=0.8, linestyle=":")
            panel.set(xscale="log", yscale="log", title=m.scene.title, ylim=(floor / 3, None))
        for panel in list(panels.flat)[len(measured) :]:
            panel.set_visible(False)
        for panel in panels[:, 0]:
            panel.set_ylabel("rms error [m, rad]")
        for column in range(columns):
            last = max(r for r in range(rows) if r * columns + column < len(measured))
            panels[last][column].set_xlabel("time for one simulated second [us]")
        figure.suptitle("Error against time, one robot on one core (left and below is better)", fontweight="bold")
        ordered = dict(sorted(handles.items()))
        figure.legend(list(ordered.values()), list(ordered), loc="outside lower center", ncols=4)
        file.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(file, dpi=90)
        plt.close(figure)


def _look(curve: Curve, exact: str) -> tuple[str, dict[str, Any]]:
    """Return label and line style of a curve."""
    if curve.code == "ce_gym":
        method = curve.method.removesuffix(f", {SINGLE}")
        label, color, line = OURS[method] if curve.level == exact else APPROXIMATE
        style = "--" if curve.level != exact else "-" if method == curve.method else ":"
        return label, {"color": color, "marker": line[0], "linestyle": style, "zorder": 5}
    if curve.code == "Drake":
        marker = DRAKE_MARKERS[curve.method]
        return f"Drake, {curve.method}", {"color": DRAKE, "marker": marker, "linestyle": ":", "markerfacecolor": "none"}
    kind = "stiff" if "stiff" in curve.level else "exact" if curve.level.split(",")[0] in ("exact", exact) else ""
    marker = MARKERS[curve.method]
    label = f"MuJoCo {curve.method}, {VARIANTS[kind]}"
    return label, {"color": COLORS[kind], "marker": marker, "linestyle": "--", "markerfacecolor": "none"}
