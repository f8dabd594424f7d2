"""What a log says of a robot: the result of `identify`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.identify.figures import Figure
from ce_gym.identify.log import Log
from ce_gym.identify.separable import Held
from ce_gym.model import Robot

Array = NDArray[np.float64]
NORMAL_95 = 1.959964
"""95 % of a normal distribution are within so many standard deviations."""


@dataclass(frozen=True)
class Identified:
    """What a log says of a robot.

    Attributes:
        robot: The robot as the log has it, before.
        figures: What was sought.
        values: Estimates, in the units of the figures, shape (P,).
        std: Their standard deviations, shape (P,); 0 for what is held.
        covariance: Of the estimates, shape (P, P); 0 for what is held.
        held: Figures that stay what the robot's file has, since the data cannot tell them, and what stands for them.
        cannot_tell: A line for each of these, and for what is known badly.
        noise: Standard deviation of what is left of each measurement, in its unit, shape (n_measured,).
        correlation: By how much correlation of it in time makes variances larger; they are.
        held_out: Root mean square error of each measurement in windows that were not fitted, shape (n_measured,).
        held_out_before: The same with the figures as they were.
        curves: Times [s], measured, simulated before and after, of windows held out, shapes (W, L), (W, L, n) thrice.
        log: The log.
        processor_time: Of all of it [s].
    """

    robot: Robot
    figures: tuple[Figure, ...]
    values: Array
    std: Array
    covariance: Array
    held: tuple[Held, ...]
    cannot_tell: tuple[str, ...]
    noise: Array
    correlation: float
    held_out: Array
    held_out_before: Array
    curves: tuple[Array, Array, Array, Array]
    log: Log
    processor_time: float

    @property
    def sought(self) -> list[int]:
        """Places of the figures that are not held."""
        held = [which.figure.name for which in self.held]
        return [i for i, figure in enumerate(self.figures) if figure.name not in held]

    @property
    def intervals(self) -> Array:
        """95 % confidence intervals, shape (P, 2)."""
        return np.stack([self.values - NORMAL_95 * self.std, self.values + NORMAL_95 * self.std], axis=1)

    def __getitem__(self, name: str) -> float:
        """Return the estimate of a figure by its name."""
        return float(self.values[[figure.name for figure in self.figures].index(name)])
