"""What data can tell of figures: the covariance of estimates, figures to hold, and lines for what is known badly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.identify.figures import Figure

Array = NDArray[np.float64]
UNKNOWN = 0.3
"""A figure whose standard deviation is more than this share of it, or of its scale, is held."""
LOOSE = 0.03
"""Of two figures that are correlated, one that is known worse than this is worth a line."""
CORRELATED = 0.95


@dataclass(frozen=True)
class Held:
    """A figure that stays what the robot's file has, since data cannot tell it.

    Attributes:
        figure: The figure.
        share: Its standard deviation where nothing is held, over it or its scale.
        taken: Figures that data cannot tell it from, and how much of each stands for one of it, in their units.
    """

    figure: Figure
    share: float
    taken: tuple[tuple[Figure, float], ...]

    def line(self, intervals: Mapping[str, Sequence[float]]) -> str:
        """Return which is held and why, and what combination the others' estimates and intervals are of."""
        nominal = f"{self.figure.nominal:g}"
        line = f"{self.figure.name} is held at {nominal}, as in the robot's file: the data "
        if not self.taken:
            return line + f"know it to {100 * self.share:.3g} % only"
        own = self.figure.name if nominal == "0" else f"({self.figure.name} - {nominal})"
        sums = []
        for figure, much in self.taken:
            low, high = intervals[figure.name]
            is_that = f"{figure.name} {'-' if much < 0 else '+'} {abs(much):.4g} {own}"
            sums.append(f"{is_that} is {(low + high) / 2:.5g}, {low:.5g} to {high:.5g}")
        return line + f"cannot separate it from {' and '.join(f.name for f, _ in self.taken)}; {'; '.join(sums)}"


def covariance_of(J: Array, correlation: float) -> Array:
    """Return the covariance of estimates.

    Args:
        J: Derivatives of residuals of unit variance, shape (m, P).
        correlation: Of residuals in time, see `correlation_time`.
    """
    _, s, V = np.linalg.svd(J, full_matrices=False)
    s = np.maximum(s, 1e-12 * max(s[0], 1e-300))
    return correlation * (V.T / s**2) @ V


def hold(
    J: Array, x: Array, figures: Sequence[Figure], correlation: float
) -> tuple[list[Held], NDArray[np.int64], Array]:
    """Choose figures to hold: of those that are not known, again and again the one that data feel least.

    Args:
        J: Derivatives of residuals of unit variance, shape (m, P).
        x: Estimates over their scales, shape (P,).
        figures: What they are.
        correlation: Of residuals in time.

    Returns:
        What is held; places of the others; their estimates given what is held.
    """
    held: list[Held] = []
    left, x = np.arange(len(x)), x.copy()
    felt = np.linalg.norm(J, axis=0)
    while len(left) > 1:
        covariance = covariance_of(J[:, left], correlation)
        share = np.sqrt(np.diag(covariance)) / np.maximum(np.abs(x[left]), 1.0)
        unknown = np.flatnonzero(share > UNKNOWN)
        if not len(unknown):
            break
        worst = int(unknown[felt[left[unknown]].argmin()])
        figure = figures[int(left[worst])]
        slopes = covariance[:, worst] / covariance[worst, worst]
        together = np.abs(_correlations(covariance)[worst]) > CORRELATED
        taken = tuple(
            (figures[int(i)], float(-slope * figures[int(i)].scale / figure.scale))
            for i, slope, tied in zip(left, slopes, together, strict=True)
            if tied and i != left[worst]
        )
        held.append(Held(figure, float(share[worst]), taken))
        x[left] += slopes * (figure.nominal / figure.scale - x[left[worst]])
        left = np.delete(left, worst)
    return held, left, x[left]


def known_badly(covariance: Array, x: Array, figures: Sequence[Figure]) -> list[str]:
    """Return a line for each pair that is known badly because it is correlated, and for single figures."""
    share = np.sqrt(np.diag(covariance)) / np.maximum(np.abs(x), 0.1)
    together = _correlations(covariance)
    lines, told = [], set()
    for i, j in _pairs(together):
        if max(share[i], share[j]) > LOOSE:
            lines.append(
                f"the data hardly separate {figures[i].name} from {figures[j].name}: correlation "
                f"{together[i, j]:+.4f}, known to {100 * share[i]:.3g} % and {100 * share[j]:.3g} %"
            )
            told |= {i, j}
    for i, figure in enumerate(figures):
        if share[i] > UNKNOWN and i not in told:
            lines.append(f"the data say little of {figure.name}: known to {100 * share[i]:.3g} %")
    return lines


def correlation_time(residual: Array) -> float:
    """Return by how much correlation in time makes the variance of a mean larger: 1 + 2 sum of autocorrelations.

    Over lags up to the first that white noise would have (Sokal 1997), at least 1.

    Args:
        residual: Shape (W, L, n).
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


def _correlations(covariance: Array) -> Array:
    std = np.sqrt(np.diag(covariance))
    return covariance / np.outer(std, std)


def _pairs(together: Array) -> list[tuple[int, int]]:
    """Return pairs of correlated figures, each figure with the one it is most correlated with."""
    off = np.abs(together - np.eye(len(together)))
    found = {tuple(sorted((i, int(off[i].argmax())))) for i in range(len(off)) if off[i].max() > CORRELATED}
    return sorted(found)  # type: ignore[arg-type]
