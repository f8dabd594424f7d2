"""Interquartile means over training runs, and their bootstrap intervals.

The conventions of Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice"
(arXiv:2108.13264): runs of one task on one arm are a stratum, strata are resampled with replacement each on its own,
and the interval is that between percentiles of what comes of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

REPEATS, LEVEL = 20_000, 0.95
"""Resamples, and the share of them that an interval holds."""


def interquartile_mean(x: Array) -> Array:
    """Return the mean without the smallest and the largest quarter along the last axis, shape (...,).

    Of n values floor(n / 4) are left out at each end; of three or fewer that is none.
    """
    n = x.shape[-1]
    return np.sort(x, axis=-1)[..., n // 4 : n - n // 4].mean(axis=-1)


def interval(
    statistic: Callable[[Sequence[Array]], Array], strata: Sequence[Array], seed: int = 0
) -> tuple[float, float, float]:
    """Return a statistic of samples, and the lower and the upper end of its interval, which is none of single runs.

    Args:
        statistic: Takes arrays (..., n_i), one for each stratum, to (...,).
        strata: Samples, shape (n_i,) each.
        seed: Of the resampling.
    """
    rng, found = np.random.default_rng(seed), float(statistic(strata))
    if min(len(x) for x in strata) < 2:
        return found, float("nan"), float("nan")
    drawn = [x[rng.integers(0, len(x), (REPEATS, len(x)))] for x in strata]
    low, high = np.percentile(statistic(drawn), [50 * (1 - LEVEL), 50 * (1 + LEVEL)])
    return found, float(low), float(high)


def of_one(strata: Sequence[Array]) -> Array:
    """Return the interquartile mean of the only stratum."""
    return interquartile_mean(strata[0])


def difference(strata: Sequence[Array]) -> Array:
    """Return how far the interquartile mean of the first stratum is above that of the second."""
    return interquartile_mean(strata[0]) - interquartile_mean(strata[1])
