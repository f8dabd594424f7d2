"""Dependent coordinates without formula, by continuation from a known pose."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEPS = 16
"""Steps from the known pose to a configuration."""


def follow(loops: ca.Function, start: Array, guess: Array, q: Array) -> tuple[Array, float, float]:
    """Follow guessed coordinates along straight lines from a pose to configurations.

    Args:
        loops: Function (q, guess) -> dependent coordinates, gap, nearness.
        start: The pose, shape (nq,).
        guess: The dependent coordinates there, shape (n_guess,).
        q: Configurations, shape (n, nq).

    Returns:
        The dependent coordinates at `q`, shape (n, n_guess); the largest gap there; the smallest nearness on the way.
        The continuation stops where the nearness is not positive.
    """
    batched, dependent, worst, least = loops.map(len(q)), np.tile(guess, (len(q), 1)).T, np.inf, np.inf
    for share in (*np.linspace(0.0, 1.0, STEPS + 1)[1:], 1.0):  # twice at the end, to the last digit
        point = q + (1.0 - share) * (start - q)
        dependent, gap, nearness = (np.array(out.full()) for out in batched.call([point.T, dependent]))
        worst, least = float(gap.max()), min(least, float(nearness.min()))
        if not nearness.min() > 0.0:
            return dependent.T, worst, float(nearness.min())
    return dependent.T, worst, least
