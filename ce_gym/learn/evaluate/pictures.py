"""Figures: errors and falls by transmission level, and the learning curve."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

INK, MUTED, LINE = "#22262b", "#6b7280", "#2a6f97"


def _plotting() -> Any:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update(
        {"font.size": 9, "axes.edgecolor": MUTED, "axes.labelcolor": INK, "text.color": INK, "xtick.color": INK,
         "ytick.color": INK, "axes.titlesize": 10}
    )  # fmt: skip
    return plt


def draw_transfer(result: dict[str, Any], file: Path) -> None:
    """Draw heat maps of velocity error and falls, with training levels as rows and evaluation levels as columns.

    Args:
        result: Result of `transfer.evaluate_policies`.
        file: PNG file to write.
    """
    plt = _plotting()
    summary = result["summary"]
    trained, evaluated = list(summary), list(next(iter(summary.values())))
    panels = (("velocity error [m/s]", "velocity_error", "{:.3f}", 1.0), ("falls [%]", "falls", "{:.1f}", 100.0))
    height = 1.9 + 0.62 * len(trained)
    figure, axes = plt.subplots(1, 2, figsize=(9.6, height), layout="constrained")
    for ax, (title, key, form, unit) in zip(axes, panels, strict=True):
        cells = [[summary[row][column][key] for column in evaluated] for row in trained]
        values = unit * np.array([[cell["mean"] for cell in row] for row in cells])
        top = max(float(values.max()) * 1.15, 1.0 if key == "falls" else 1e-9)
        low = 0.0 if key == "falls" else float(values.min()) * 0.85
        picture = ax.imshow(values, cmap="YlGnBu", vmin=low, vmax=top, aspect="auto")
        for (i, j), value in np.ndenumerate(values):
            half, own = cells[i][j]["ci95"], trained[i] == evaluated[j]
            text = form.format(value) + ("" if half is None else "\n± " + form.format(unit * half))
            color = "white" if value > low + 0.5 * (top - low) else INK
            ax.text(j, i, text, ha="center", va="center", color=color, weight="bold" if own else "normal")
        ax.set_xticks(range(len(evaluated)), evaluated)
        ax.set_yticks(range(len(trained)), trained)
        ax.set_xticks(np.arange(len(evaluated) - 1) + 0.5, minor=True)
        ax.set_yticks(np.arange(len(trained) - 1) + 0.5, minor=True)
        ax.grid(which="minor", color="white", linewidth=2)
        ax.tick_params(which="both", length=0)
        ax.spines[:].set_visible(False)
        ax.set_title(title)
        ax.set_xlabel("evaluated at")
        figure.colorbar(picture, ax=ax, shrink=0.9, pad=0.02).outline.set_visible(False)  # type: ignore[union-attr]
    axes[0].set_ylabel("trained at")
    seeds = max(cell["falls"]["n"] for row in summary.values() for cell in row.values())
    over = "one seed" if seeds == 1 else f"mean of {seeds} seeds ± 95 % confidence"
    heading = f"{result['env']}: {over}, {result['episodes']} episodes each; bold: level of training"
    figure.suptitle(heading, fontsize=10)
    figure.savefig(file, dpi=130)
    plt.close(figure)


def draw_curve(rows: list[dict[str, float]], title: str, file: Path) -> None:
    """Draw reward and length of episodes over the steps of training.

    Args:
        rows: Rows of `curve.csv`.
        title: Heading.
        file: PNG file to write.
    """
    plt = _plotting()
    steps = np.array([row["steps"] for row in rows]) / 1e6
    figure, axes = plt.subplots(1, 2, figsize=(8.0, 2.6), layout="constrained")
    for ax, key, label in zip(axes, ("reward", "length"), ("reward", "control steps"), strict=True):
        ax.plot(steps, [row[key] for row in rows], color=LINE, linewidth=1.6)
        ax.set_xlabel("environment steps [million]")
        ax.set_title(f"{label} per episode")
        ax.set_xlim(left=0.0)
        ax.set_ylim(bottom=min(0.0, *(row[key] for row in rows)))
        ax.grid(color="#e5e7eb", linewidth=0.8)
        ax.spines[["top", "right"]].set_visible(False)
    figure.suptitle(title, fontsize=10)
    figure.savefig(file, dpi=80)
    plt.close(figure)
