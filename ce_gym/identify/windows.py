"""Windows of a log, and what can be said of them without a model's figures: states where they start, and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.identify.log import Log, LogError
from ce_gym.identify.shots import Shots

Array = NDArray[np.float64]
SETTLING = 0.03
"""How long transmissions are given until they stretch as their load has them [s]."""
PARTS = 5
"""Windows of the first search are so many times shorter."""


@dataclass(frozen=True)
class Windows:
    """Windows of a log.

    Attributes:
        first: Rows where they start, shape (W,).
        length: [rows], a multiple of `PARTS`; no row is in two windows, or its noise would count twice.
    """

    first: NDArray[np.int64]
    length: int

    def parts(self) -> Windows:
        """Return the windows cut into shorter ones, `PARTS` each."""
        length = self.length // PARTS
        return Windows((self.first[:, None] + length * np.arange(PARTS)).ravel(), length)

    @property
    def rows(self) -> NDArray[np.int64]:
        """Rows of each window, shape (W, length)."""
        return self.first[:, None] + np.arange(self.length)


def cut(log: Log, window: float, longest_delay: float, held_out: float) -> tuple[Windows, Windows]:
    """Return windows to fit and windows to judge by, at the end of the log.

    Args:
        log: The log.
        window: How long they are [s], about.
        longest_delay: No window starts earlier [s].
        held_out: Share to judge by.

    Raises:
        LogError: It is too short for that.
    """
    length = PARTS * max(4, round(window / log.dt / PARTS))
    first = int(np.ceil(longest_delay / log.dt)) + 1
    starts = np.arange(first, len(log.values) - length, length)
    kept = max(1, round(held_out * len(starts)))
    if len(starts) - kept < 4:
        raise LogError(f"{log.source}: {len(log.values)} rows: expected at least {first + 7 * length} for such windows")
    return Windows(starts[:-kept], length), Windows(starts[-kept:], length)


def first_states(shots: Shots, windows: Windows) -> Array:
    """Return a first guess of states, shape (W, nq + nv): cubics through the angles about the start of each window.

    Near an end of the log they go through what there is on the other side.
    """
    log, last = shots.log, len(shots.log.values) - 1
    n = min(max(3, round(0.02 / log.dt)), last // 2)
    rows = np.clip(windows.first, n, last - n)[:, None] + np.arange(-n, n + 1)
    powers = ((rows - windows.first[:, None]) * log.dt)[..., None] ** np.arange(4)
    fit = np.linalg.pinv(powers) @ log.values[rows]
    q = shots.encoders.positions(fit[:, 0])
    ahead = shots.encoders.positions(fit[:, 0] + 1e-3 * fit[:, 1])
    return np.hstack([q, (ahead - q) / 1e-3])


def with_stretches(shots: Shots, windows: Windows, states: Array, values: Array) -> Array:
    """Return states with stretches that encoders do not tell as they are at figures (P,) once they have settled."""
    n = shots.encoders.joints
    if shots.encoders.tell_stretches:
        return states
    lead = int(min(windows.first.min(), round(SETTLING / shots.log.dt)))
    earlier = Windows(windows.first - lead, lead + 1)
    _, last = shots.run(values[None], first_states(shots, earlier)[None], earlier.first, earlier.length)
    settled, nq = states.copy(), shots.model.nq
    settled[:, n:nq], settled[:, nq + n :] = last[0, :, n:nq], last[0, :, nq + n :]
    return settled


def noise_of_encoders(log: Log) -> Array:
    """Return a first guess of noise: what third differences have, of which smooth motion has little."""
    return np.maximum(np.diff(log.values, 3, axis=0).std(axis=0) / np.sqrt(20.0), 1e-9)
