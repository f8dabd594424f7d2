"""Picture of the stability map."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ce_gym.bench.stability.grid import ROUNDING, SILENCE, STIFFNESSES, Map


def draw(maps: dict[str, list[Map]], file: Path) -> None:
    """Draw one column for each robot: speed at rest above, gain of energy below, at the worst slip speed."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = (
        ("speed at rest [m/s, rad/s]", "chatter", 1e-16, 1e-2, SILENCE),
        ("energy gained without motors / lost", "gain", 1e-16, 1e2, ROUNDING),
    )
    figure, axes = plt.subplots(2, len(maps), figsize=(2.2 + 2.7 * len(maps), 6.4), squeeze=False, layout="constrained")
    for row, (title, name, low, high, bar) in enumerate(rows):
        for column, (robot, steps) in enumerate(maps.items()):
            ax = axes[row, column]
            values = np.array([getattr(m, name).max(axis=1) for m in steps]).T  # stiffness by step
            limits = {"vmin": np.log10(low), "vmax": np.log10(high)}
            logarithm = np.log10(np.clip(values, low, high))
            picture = ax.imshow(logarithm, origin="lower", aspect="auto", cmap="viridis_r", **limits)
            for (i, j), value in np.ndenumerate(values):
                finite = bool(steps[j].finite[i].all())
                text = ("0" if value <= 0 else f"{value:.0e}".replace("e-0", "e-")) if finite else "lost"
                dark = np.log10(max(value, low)) > np.log10(low) + 0.55 * np.log10(high / low)
                weight = "bold" if value > bar else "normal"
                ax.text(
                    j, i, text, ha="center", va="center", fontsize=7, color="white" if dark else "black", weight=weight
                )
            ax.set_xticks(range(len(steps)), [f"{1e3 * m.dt:g}" for m in steps])
            ax.set_yticks(range(len(STIFFNESSES)), [f"$10^{np.log10(k):.0f}$" for k in STIFFNESSES])
            if row == 0:
                ax.set_title(robot)
            if row == 1:
                ax.set_xlabel("time step [ms]")
            if column == 0:
                ax.set_ylabel("ground stiffness [N/m]")
        figure.colorbar(picture, ax=axes[row].tolist(), label=f"log10 of {title}", pad=0.01)
    figure.suptitle("Worst of four slip speeds, 0.1 mm/s to 100 mm/s; bold: above the bar")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=110)
    plt.close(figure)
