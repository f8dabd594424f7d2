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
SPANS = 0.02, 0.01, 0.005
"""Half of what a first guess looks at [s]: a smooth motion is known best from long ones, one that rattles by short."""
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


def first_states(shots: Shots, windows: Windows, span: float = SPANS[0], zeros: Array | float = 0.0) -> Array:
    """Return a first guess of states, shape (W, nq + nv): cubics through the angles about the start of each window.

    Near an end of the log they go through what there is on the other side.

    Args:
        shots: What is simulated.
        windows: Which.
        span: How long before and after the start they look [s].
        zeros: What encoders read too much, shape (n_measured,).
    """
    log, last = shots.log, len(shots.log.values) - 1
    n = min(max(3, round(span / log.dt)), last // 2)
    rows = np.clip(windows.first, n, last - n)[:, None] + np.arange(-n, n + 1)
    powers = ((rows - windows.first[:, None]) * log.dt)[..., None] ** np.arange(4)
    fit = np.linalg.pinv(powers) @ (log.values[rows] - zeros)
    q = shots.encoders.positions(fit[:, 0])
    ahead = shots.encoders.positions(fit[:, 0] + 1e-3 * fit[:, 1])
    return np.hstack([q, (ahead - q) / 1e-3])


def guesses(shots: Shots, windows: Windows, values: Array) -> Array:
    """Return first guesses of states at figures (P,), shape (G, W, nq + nv): several where transmissions stretch.

    What rattles on its flanks turns back within milliseconds: a cubic over 40 ms has its mean and not its speed, and
    a search from there ends between other flanks. With 5 ms rows all spans are three rows, and one guess is enough.
    """
    rattles = shots.encoders.joints < shots.model.nq
    spans = SPANS if rattles and SPANS[1] > 3 * shots.log.dt else SPANS[:1]
    zeros = shots.zeros(values)
    each = [first_states(shots, windows, span, zeros) for span in spans]
    return np.stack([with_stretches(shots, windows, states, values) for states in each])


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
