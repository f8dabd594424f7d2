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
SHIFTED = 0.3
"""What is held goes into an estimate that it shifts by more than this share of the estimate's standard deviation."""


@dataclass(frozen=True)
class Held:
    """A figure that stays what the robot's file has, since data cannot tell it.

    Attributes:
        figure: The figure.
        share: Its standard deviation where nothing is held, over it or its scale.
        taken: Figures that are found and whose estimates it shifts, and how much of each stands for one of it, in
            their units.
    """

    figure: Figure
    share: float
    taken: tuple[tuple[Figure, float], ...]


def lines_of(held: Sequence[Held], intervals: Mapping[str, Sequence[float]]) -> list[str]:
    """Return which figures are held and why, and what combinations the others' estimates and intervals are of.

    Args:
        held: All that is held: what is found may stand for several at once.
        intervals: Of what is found, by name.
    """
    sums: dict[str, str] = {}
    for which in held:
        nominal = f"{which.figure.nominal:g}"
        own = which.figure.name if nominal == "0" else f"({which.figure.name} - {nominal})"
        for figure, much in which.taken:
            so_far = sums.get(figure.name, figure.name)
            sums[figure.name] = f"{so_far} {'-' if much < 0 else '+'} {abs(much):.4g} {own}"
    lines = []
    for which in held:
        why, names = f"know it to {100 * which.share:.3g} % only", [figure.name for figure, _ in which.taken]
        if names:
            said = [f"{sums[name]} is {_interval_text(*intervals[name])}" for name in names]
            why = f"cannot separate it from {' and '.join(names)}; {'; '.join(said)}"
        nominal = f"{which.figure.nominal:g}"
        lines.append(f"{which.figure.name} is held at {nominal}, as in the robot's file: the data {why}")
    return lines


def _interval_text(low: float, high: float) -> str:
    return f"{(low + high) / 2:.5g}, {low:.5g} to {high:.5g}"


def covariance_of(J: Array, correlation: float) -> Array:
    """Return the covariance of estimates.

    Args:
        J: Derivatives of residuals of unit variance, shape (m, P).
        correlation: Of residuals in time, see `correlation_time`.
    """
    _, s, V = np.linalg.svd(J, full_matrices=False)
    s = np.maximum(s, 1e-12 * max(s[0], 1e-300))
    return correlation * (V.T / s**2) @ V


def hold(J: Array, x: Array, figures: Sequence[Figure], correlation: float) -> tuple[NDArray[np.int64], Array]:
    """Choose figures to hold: of those that are not known, again and again the one that data feel least.

    Args:
        J: Derivatives of residuals of unit variance, shape (m, P).
        x: Estimates over their scales, shape (P,).
        figures: What they are.
        correlation: Of residuals in time.

    Returns:
        Places of those that are not held; their estimates given what is.
    """
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
        x[left] += slopes * (figure.nominal / figure.scale - x[left[worst]])
        left = np.delete(left, worst)
    return left, x[left]


def held_of(J: Array, x: Array, left: NDArray[np.int64], figures: Sequence[Figure], correlation: float) -> list[Held]:
    """Return what is held, and which estimates it shifts, all that is held at once.

    Estimates are, to first order, the figures plus the least-squares solution of J_left Y = J_held times what is held
    wrongly. How wrong that may be is what data leave open, but its own size or scale at most.

    Args:
        J: Derivatives of residuals of unit variance by all figures, held ones too, shape (m, P).
        x: All figures over their scales, shape (P,).
        left: Places of those that are not held.
        figures: What they are.
        correlation: Of residuals in time.
    """
    places, size = np.setdiff1d(np.arange(len(x)), left), np.maximum(np.abs(x), 1.0)
    unsure, std = (np.sqrt(np.diag(covariance_of(J[:, these], correlation))) for these in (np.arange(len(x)), left))
    Y = np.linalg.lstsq(J[:, left], J[:, places], rcond=None)[0]
    shifts = np.abs(Y) * np.minimum(unsure, size)[places] > SHIFTED * std[:, None]
    held = []
    for k, place in enumerate(places):
        figure = figures[int(place)]
        others = [(figures[int(left[i])], float(Y[i, k])) for i in np.flatnonzero(shifts[:, k])]
        taken = tuple((other, much * other.scale / figure.scale) for other, much in others)
        held.append(Held(figure, float(unsure[place] / size[place]), taken))
    return held


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
