"""Covariance of estimates, parameters that the data cannot determine, and warnings about uncertain parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.identify.parameters import Parameter

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
NORMAL_95 = 1.959964
"""95 % of a normal distribution are within this number of standard deviations."""
LARGEST_RELATIVE_STD = 0.3
"""A parameter is unidentifiable if its standard deviation exceeds this share of its value, or of its scale."""
LOOSE = 0.03
"""Correlated parameters with a larger relative standard deviation cause a warning."""
CORRELATED = 0.95
LARGEST_SHIFT = 0.3
"""Smallest shift of an estimate by an unidentifiable parameter that is reported, over the standard deviation."""


@dataclass(frozen=True)
class Unidentifiable:
    """A parameter that stays at the value in the robot's file, because the data cannot determine it.

    Attributes:
        parameter: The parameter.
        relative_std: Standard deviation if all parameters were estimated, over the value or the scale.
        shifted: Estimated parameters whose estimates depend on this one, and their change per unit of this one.
    """

    parameter: Parameter
    relative_std: float
    shifted: tuple[tuple[Parameter, float], ...]


def covariance_of(J: Array, correlation: float) -> Array:
    """Return the covariance of estimates.

    Args:
        J: Derivatives of residuals of unit variance, shape (m, P).
        correlation: Factor for the correlation of residuals in time, see `correlation_time`.
    """
    _, s, V = np.linalg.svd(J, full_matrices=False)
    s = np.maximum(s, 1e-12 * max(s[0], 1e-300))
    return correlation * (V.T / s**2) @ V


def select_identifiable(
    J: Array, x: Array, parameters: Sequence[Parameter], correlation: float
) -> tuple[Indices, Array]:
    """Fix unidentifiable parameters at their nominal values, one after the other, beginning with the least sensitive.

    Args:
        J: Derivatives of residuals of unit variance, shape (m, P).
        x: Estimates over their scales, shape (P,).
        parameters: The parameters.
        correlation: Factor for the correlation of residuals in time.

    Returns:
        Indices of the identifiable parameters, and their estimates over scales with the others fixed.
    """
    free, x = np.arange(len(x)), x.copy()
    sensitivity = np.linalg.norm(J, axis=0)
    while len(free) > 1:
        covariance = covariance_of(J[:, free], correlation)
        relative_std = np.sqrt(np.diag(covariance)) / np.maximum(np.abs(x[free]), 1.0)
        uncertain = np.flatnonzero(relative_std > LARGEST_RELATIVE_STD)
        if not len(uncertain):
            break
        worst = int(uncertain[sensitivity[free[uncertain]].argmin()])
        parameter = parameters[int(free[worst])]
        slopes = covariance[:, worst] / covariance[worst, worst]
        x[free] += slopes * (parameter.nominal / parameter.scale - x[free[worst]])
        free = np.delete(free, worst)
    return free, x[free]


def find_unidentifiable(
    J: Array, x: Array, free: Indices, parameters: Sequence[Parameter], correlation: float
) -> list[Unidentifiable]:
    """Return the fixed parameters, and the estimates that depend on them.

    To first order, an error e of the fixed parameters shifts the estimates by Y e, the least-squares solution of
    J_free Y = J_fixed. The error is at most the standard deviation, and at most the value or scale.

    Args:
        J: Derivatives of residuals of unit variance by all parameters, shape (m, P).
        x: All parameters over their scales, shape (P,).
        free: Indices of the estimated parameters.
        parameters: All parameters.
        correlation: Factor for the correlation of residuals in time.
    """
    fixed, size = np.setdiff1d(np.arange(len(x)), free), np.maximum(np.abs(x), 1.0)
    std_all = np.sqrt(np.diag(covariance_of(J, correlation)))
    std_free = np.sqrt(np.diag(covariance_of(J[:, free], correlation)))
    Y = np.linalg.lstsq(J[:, free], J[:, fixed], rcond=None)[0]
    shifts = np.abs(Y) * np.minimum(std_all, size)[fixed] > LARGEST_SHIFT * std_free[:, None]
    items = []
    for k, i in enumerate(fixed):
        parameter = parameters[int(i)]
        slopes = [(parameters[int(free[row])], float(Y[row, k])) for row in np.flatnonzero(shifts[:, k])]
        shifted = tuple((other, slope * other.scale / parameter.scale) for other, slope in slopes)
        items.append(Unidentifiable(parameter, float(std_all[i] / size[i]), shifted))
    return items


def unidentifiable_warnings(items: Sequence[Unidentifiable], intervals: Mapping[str, Sequence[float]]) -> list[str]:
    """Return a line for each unidentifiable parameter, with the combinations that the data determine instead.

    Args:
        items: All unidentifiable parameters: an estimate may depend on several.
        intervals: Confidence intervals of the estimates, by name.
    """
    combinations: dict[str, str] = {}
    for item in items:
        nominal = f"{item.parameter.nominal:g}"
        deviation = item.parameter.name if nominal == "0" else f"({item.parameter.name} - {nominal})"
        for other, slope in item.shifted:
            terms = combinations.get(other.name, other.name)
            combinations[other.name] = f"{terms} {'-' if slope < 0 else '+'} {abs(slope):.4g} {deviation}"
    lines = []
    for item in items:
        reason, names = f"know it to {100 * item.relative_std:.3g} % only", [other.name for other, _ in item.shifted]
        if names:
            known = [f"{combinations[name]} is {_interval_text(*intervals[name])}" for name in names]
            reason = f"cannot separate it from {' and '.join(names)}; {'; '.join(known)}"
        nominal = f"{item.parameter.nominal:g}"
        lines.append(f"{item.parameter.name} is held at {nominal}, as in the robot's file: the data {reason}")
    return lines


def uncertainty_warnings(covariance: Array, x: Array, parameters: Sequence[Parameter]) -> list[str]:
    """Return a line for each pair of correlated, uncertain estimates, and for each other uncertain estimate.

    Args:
        covariance: Covariance of the estimates over their scales, shape (P, P).
        x: Estimates over their scales, shape (P,).
        parameters: The estimated parameters.
    """
    std = np.sqrt(np.diag(covariance))
    relative_std = std / np.maximum(np.abs(x), 0.1)
    correlations = covariance / np.outer(std, std)
    lines, in_pairs = [], set()
    for i, j in _correlated_pairs(correlations):
        if max(relative_std[i], relative_std[j]) > LOOSE:
            lines.append(
                f"the data hardly separate {parameters[i].name} from {parameters[j].name}: correlation "
                f"{correlations[i, j]:+.4f}, known to {100 * relative_std[i]:.3g} % and {100 * relative_std[j]:.3g} %"
            )
            in_pairs |= {i, j}
    for i, parameter in enumerate(parameters):
        if relative_std[i] > LARGEST_RELATIVE_STD and i not in in_pairs:
            lines.append(f"the data say little about {parameter.name}: known to {100 * relative_std[i]:.3g} %")
    return lines


def correlation_time(residual: Array) -> float:
    """Return the integrated autocorrelation time, the factor by which correlation increases the variance of a mean.

    1 + 2 sum of autocorrelations, up to the first lag that white noise could have (Sokal 1997); at least 1.

    Args:
        residual: Residuals of W windows with L rows, shape (W, L, n).
    """
    total, power = 1.0, float((residual**2).sum())
    if power == 0:
        return total
    for lag in range(1, residual.shape[1] // 2):
        rho = float((residual[:, :-lag] * residual[:, lag:]).sum()) / power
        if rho < 3 / np.sqrt(residual.size):
            break
        total += 2 * rho
    return total


def _interval_text(low: float, high: float) -> str:
    return f"{(low + high) / 2:.5g}, {low:.5g} to {high:.5g}"


def _correlated_pairs(correlations: Array) -> list[tuple[int, int]]:
    """Return each parameter with the one of largest correlation, if that exceeds `CORRELATED`."""
    off_diagonal = np.abs(correlations - np.eye(len(correlations)))
    partners = [int(row.argmax()) for row in off_diagonal]
    return sorted({(min(i, j), max(i, j)) for i, j in enumerate(partners) if off_diagonal[i, j] > CORRELATED})
