"""Dependent coordinates without formula, by continuation from a known pose."""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ce_gym.compile import Call
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced

Array = NDArray[np.float64]

STEPS = 16
"""Steps from the known pose to a configuration."""
GUESS, GAP = "guess", "guess_gap"
"""Buffers of the dependent coordinates, not numbers behind a singularity, and of the gap of the loops there."""


class Continuation:
    """Follows guessed coordinates along a straight line from a pose to a configuration.

    Args:
        loops: Function (q, guess) -> dependent coordinates, gap, nearness.
        start: The pose, shape (nq,).
        guess: The dependent coordinates there, shape (n_guess,).
    """

    def __init__(self, loops: ca.Function, start: Array, guess: Array) -> None:
        self._loops, self._start, self._guess = loops, start, guess

    @cached_property
    def _begin(self) -> ca.Function:
        return traced("begin", {}, {"progress": SX(0), "guess": SX(self._guess)})

    @cached_property
    def _step(self) -> ca.Function:
        """Return the function of one step; behind a singularity, coordinates are not numbers."""
        q, progress, guess = SX.sym("q", len(self._start)), SX.sym("progress"), SX.sym("guess", len(self._guess))
        share = ca.fmin(progress + 1 / STEPS, 1.0)
        dependent, gap, nearness = self._loops(q + (1.0 - share) * (self._start - q), guess)
        dependent = ca.if_else(nearness > 0.0, dependent, np.nan)
        outputs = {"progress": share, "guess": dependent, "gap": gap}
        return traced("continuation", {"q": q, "progress": progress, "guess": guess}, outputs)

    def calls(self, q: str) -> list[Call]:
        """Return the calls that find `GUESS` and `GAP` for the positions in a buffer."""
        step = Call(self._step, (q, "guess_progress", GUESS), ("guess_progress", GUESS, GAP))
        return [Call(self._begin, (), ("guess_progress", GUESS)), *[step] * (STEPS + 1)]  # the last to the last digit

    def follow(self, q: Array) -> tuple[Array, Array]:
        """Return the dependent coordinates, shape (n, n_guess), and the gaps, shape (n,), at positions (n, nq)."""
        step, progress, guess = self._step.map(len(q)), np.zeros((1, len(q))), np.tile(self._guess, (len(q), 1)).T
        gap = np.zeros((1, len(q)))
        for _ in range(STEPS + 1):
            progress, guess, gap = (np.array(out.full()) for out in step.call([q.T, progress, guess]))
        return guess.T, gap[0]
