"""The picture of all robots, docs/images/robots.png: each that has environments stands, with its name under it."""

from __future__ import annotations

import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import ce_gym
from ce_gym.envs.custom import missing
from ce_gym.model import load_robot, robots
from ce_gym.viewer.raytrace.picture import Picture

COLUMNS, SIZE = 5, 300
"""Robots in a row; width and height of each [pixels]."""
FILE = Path(__file__).parent / "images" / "robots.png"


def main() -> None:
    """Draw every robot of the package that tasks can have."""
    warnings.simplefilter("ignore", ce_gym.InertiaWarning)
    names = [name for name in robots() if not missing(load_robot(name))]
    rows = -(-len(names) // COLUMNS)
    figure, axes = plt.subplots(rows, COLUMNS, figsize=(COLUMNS * SIZE / 150, rows * SIZE / 150), dpi=150)
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, name in zip(axes.flat, names, strict=False):
        model = ce_gym.Model(name)
        picture = Picture(model, model.standing_q, width=SIZE, height=SIZE)
        ax.imshow(np.asarray(picture.draw(model.standing_q)))
        ax.text(0.5, 0.03, name, transform=ax.transAxes, ha="center", fontsize=7)
    figure.subplots_adjust(0, 0, 1, 1, 0.01, 0.01)
    figure.savefig(FILE)


if __name__ == "__main__":
    main()
