"""What data can tell of figures: the covariance of estimates, and a line for each that they say little of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ce_gym.identify.figures import Figure

Array = NDArray[np.float64]
UNKNOWN = 0.3
"""A figure whose standard deviation is more than this share of it is not known."""
LOOSE = 0.03
"""Of two figures that are correlated, one that is known worse than this is worth a line."""
CORRELATED = 0.95


def inseparable(J: Array, x: Array, figures: Sequence[Figure], correlation: float) -> tuple[Array, tuple[str, ...]]:
    """Return covariance and lines.

    Args:
        J: Derivatives of residuals of unit variance, shape (m, P).
        x: Estimates over their scales, shape (P,).
        figures: What they are.
        correlation: Of residuals in time, see `correlation_time`.
    """
    _, s, V = np.linalg.svd(J, full_matrices=False)
    s = np.maximum(s, 1e-12 * max(s[0], 1e-300))
    covariance = correlation * (V.T / s**2) @ V
    std = np.sqrt(np.diag(covariance))
    share = std / np.maximum(np.abs(x), 0.1)
    together = covariance / np.outer(std, std)
    lines, told = [], set()
    for i, j in _pairs(together):
        if max(share[i], share[j]) > LOOSE:
            known = _one_known(covariance, x, i, j)
            lines.append(
                f"the data cannot separate {figures[i].name} from {figures[j].name}: correlation "
                f"{together[i, j]:+.4f}, known to {100 * share[i]:.3g} % and {100 * share[j]:.3g} %{known}"
            )
            told |= {i, j}
    for i, figure in enumerate(figures):
        if share[i] > UNKNOWN and i not in told:
            lines.append(f"the data say little of {figure.name}: known to {100 * share[i]:.3g} %")
    return covariance, tuple(lines)


def _pairs(together: Array) -> list[tuple[int, int]]:
    """Return pairs of correlated figures, each figure with the one it is most correlated with."""
    off = np.abs(together - np.eye(len(together)))
    found = {tuple(sorted((i, int(off[i].argmax())))) for i in range(len(off)) if off[i].max() > CORRELATED}
    return sorted(found)  # type: ignore[arg-type]


def _one_known(covariance: Array, x: Array, i: int, j: int) -> str:
    """Return how well that combination of two figures is known that is known best."""
    both = [i, j]
    values, vectors = np.linalg.eigh(covariance[np.ix_(both, both)])
    size = abs(vectors[:, 0] @ x[both])
    return (
        f", {vectors[0, 0]:+.2f} and {vectors[1, 0]:+.2f} of them to {100 * np.sqrt(values[0]) / max(size, 0.1):.3g} %"
    )
