"""Figures: errors and falls by transmission level, and the learning curve."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ce_gym.files import PICTURE, written

INK, MUTED, LINE = "#22262b", "#6b7280", "#2a6f97"


def _figure(columns: int, width: float, height: float) -> tuple[Any, Any]:
    """Return a figure of a size [inch], and its axes side by side."""
    from matplotlib import rcParams
    from matplotlib.figure import Figure

    rcParams.update({"font.size": 9, "axes.titlesize": 10, "axes.edgecolor": MUTED})
    rcParams.update(dict.fromkeys(("axes.labelcolor", "text.color", "xtick.color", "ytick.color"), INK))
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(1, columns)


def draw_transfer(result: dict[str, Any], file: Path) -> None:
    """Draw heat maps of velocity error and falls, with training levels as rows and evaluation levels as columns.

    Args:
        result: Result of `transfer.evaluate_policies`.
        file: PNG file to write.
    """
    summary = result["summary"]
    trained, evaluated = list(summary), list(next(iter(summary.values())))
    figure, axes = _figure(2, 9.6, 1.9 + 0.62 * len(trained))
    panels = (("velocity error [m/s]", "velocity_error", ".3f", 1.0), ("falls [%]", "falls", ".1f", 100.0))
    for ax, (title, key, form, unit) in zip(axes, panels, strict=True):
        cells = [[summary[row][column][key] for column in evaluated] for row in trained]
        values = unit * np.array([[cell["mean"] for cell in row] for row in cells])
        low = 0.0 if key == "falls" else float(values.min()) * 0.85
        top = max(float(values.max()) * 1.15, 1.0 if key == "falls" else 1e-9)
        picture = ax.pcolormesh(values, cmap="YlGnBu", vmin=low, vmax=top, edgecolor="white", linewidth=2)
        for (i, j), value in np.ndenumerate(values):
            half = cells[i][j]["ci95"]
            text = format(value, form) + ("" if half is None else f"\n± {unit * half:{form}}")
            color = "white" if value > low + 0.5 * (top - low) else INK
            weight = "bold" if trained[i] == evaluated[j] else "normal"
            ax.text(j + 0.5, i + 0.5, text, ha="center", va="center", color=color, weight=weight)
        ax.set_xticks(np.arange(len(evaluated)) + 0.5, evaluated)
        ax.set_yticks(np.arange(len(trained)) + 0.5, trained)
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
        ax.set(title=title, xlabel="evaluated at", ylim=(len(trained), 0))
        figure.colorbar(picture, ax=ax, shrink=0.9, pad=0.02).outline.set_visible(False)
    axes[0].set_ylabel("trained at")
    seeds = max(cell["falls"]["n"] for row in summary.values() for cell in row.values())
    over = "one seed" if seeds == 1 else f"mean of {seeds} seeds ± 95 % confidence"
    heading = f"{result['env']}: {over}, {result['episodes']} episodes each; bold: level of training"
    figure.suptitle(heading, fontsize=10)
    with written(file, PICTURE) as temporary:
        figure.savefig(temporary, dpi=130)


def draw_curve(rows: list[dict[str, float]], title: str, file: Path) -> None:
    """Draw reward and length of episodes over the steps of training.

    Args:
        rows: Rows of the learning curve.
        title: Heading.
        file: PNG file to write.
    """
    from PIL import Image

    figure, axes = _figure(2, 8.0, 2.6)
    steps = np.array([row["steps"] for row in rows]) / 1e6
    for ax, key, label in zip(axes, ("reward", "length"), ("reward", "control steps"), strict=True):
        values = [row[key] for row in rows]
        ax.plot(steps, values, color=LINE, linewidth=1.6)
        ax.set(title=f"{label} per episode", xlabel="environment steps [million]")
        ax.set_xlim(left=0.0)
        ax.set_ylim(bottom=min(0.0, *values))
        ax.grid(color="#e5e7eb", linewidth=0.8)
        ax.spines[["top", "right"]].set_visible(False)
    figure.suptitle(title, fontsize=10)
    with written(file, PICTURE) as temporary:
        figure.savefig(temporary, dpi=80)
        with Image.open(temporary) as picture:  # few colours: a quarter of the size
            small = picture.convert("RGB").quantize(32)
        small.save(temporary, "PNG", optimize=True)
