"""The result of `identify`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.identify.identifiability import NORMAL_95, Unidentifiable
from ce_gym.identify.log import Log
from ce_gym.identify.parameters import Parameter
from ce_gym.model import Robot

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Identified:
    """Estimated parameters of a robot.

    Attributes:
        robot: The robot before identification.
        parameters: The parameters, P in number.
        values: Estimates, in the units of the parameters, shape (P,).
        covariance: Covariance of the estimates, shape (P, P); 0 for unidentifiable parameters.
        unidentifiable: Parameters that stay at the value in the robot's file, because the data cannot determine them.
        warnings: Lines on a bad fit, on unidentifiable parameters and on uncertain ones.
        noise: Standard deviation of the residual of each measurement, in its unit, shape (n_measured,).
        correlation: Factor on all variances, from the correlation of residuals in time; `covariance` includes it.
        held_out: Root mean square error of each measurement in windows that were not fitted, shape (n_measured,).
        held_out_before: The same error before identification.
        curves: Times [s], measurements, simulations before and after identification, of windows that were not fitted;
            shapes (W, L) and three times (W, L, n_measured).
        log: The log.
        processor_time: Processor time of the identification [s].
    """

    robot: Robot
    parameters: tuple[Parameter, ...]
    values: Array
    covariance: Array
    unidentifiable: tuple[Unidentifiable, ...]
    warnings: tuple[str, ...]
    noise: Array
    correlation: float
    held_out: Array
    held_out_before: Array
    curves: tuple[Array, Array, Array, Array]
    log: Log
    processor_time: float

    @property
    def std(self) -> Array:
        """Standard deviations of the estimates, shape (P,); 0 for unidentifiable parameters."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def estimated(self) -> list[int]:
        """Indices of the identifiable parameters."""
        names = [item.parameter.name for item in self.unidentifiable]
        return [i for i, parameter in enumerate(self.parameters) if parameter.name not in names]

    @property
    def intervals(self) -> Array:
        """95 % confidence intervals, shape (P, 2)."""
        return np.stack([self.values - NORMAL_95 * self.std, self.values + NORMAL_95 * self.std], axis=1)

    def __getitem__(self, name: str) -> float:
        """Return the estimate of a parameter by its name."""
        return float(self.values[[parameter.name for parameter in self.parameters].index(name)])
