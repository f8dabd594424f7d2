"""Windows of a log, and model-free guesses of their initial states and of the encoder noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.identify.log import Log, LogError
from ce_gym.identify.shooting import Shooting
from ce_gym.model.errors import file_error

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
SETTLING = 0.03
"""Simulated time until elastic transmissions have settled under their load [s]."""
SPANS = 0.02, 0.01, 0.005
"""Half widths of the fits of initial states [s]: long ones for smooth motion, short ones for rattling transmissions."""
PARTS = 5
"""Number of short windows in a window."""


@dataclass(frozen=True)
class Windows:
    """Disjoint windows of a log.

    Attributes:
        first: First row of each window, shape (W,).
        length: Number of rows of a window, a multiple of `PARTS`.
    """

    first: Indices
    length: int

    def parts(self) -> Windows:
        """Return the windows cut into `PARTS` short windows each."""
        length = self.length // PARTS
        return Windows((self.first[:, None] + length * np.arange(PARTS)).ravel(), length)

    @property
    def rows(self) -> Indices:
        """Rows of each window, shape (W, length)."""
        return self.first[:, None] + np.arange(self.length)


def split_log(log: Log, window: float, longest_delay: float, held_out: float) -> tuple[Windows, Windows]:
    """Return windows to fit, and windows for validation at the end of the log.

    Args:
        log: The log.
        window: Approximate length of a window [s].
        longest_delay: Earliest start of a window [s].
        held_out: Share of windows for validation.

    Raises:
        LogError: The log is too short.
    """
    length = PARTS * max(4, round(window / log.dt / PARTS))
    first = int(np.ceil(longest_delay / log.dt)) + 1
    starts = np.arange(first, len(log.values) - length, length)
    n = max(1, round(held_out * len(starts)))
    if len(starts) - n < 4:
        expected = f"at least {first + 7 * length} for windows of {window:g} s"
        raise file_error(log.source, f"{len(log.values)} rows", expected, LogError)
    return Windows(starts[:-n], length), Windows(starts[-n:], length)


def smoothed_states(
    shooting: Shooting, windows: Windows, span: float = SPANS[0], offsets: Array | float = 0.0
) -> Array:
    """Return guesses of initial states from cubic fits through the angles around the start of each window.

    Args:
        shooting: The log and its encoders.
        windows: The windows.
        span: Half width of the fit [s]; shifted at the ends of the log.
        offsets: Offsets of the encoders, shape (n_measured,).

    Returns:
        Shape (W, nq + nv).
    """
    log, last = shooting.log, len(shooting.log.values) - 1
    n = min(max(3, round(span / log.dt)), last // 2)
    rows = np.clip(windows.first, n, last - n)[:, None] + np.arange(-n, n + 1)
    powers = ((rows - windows.first[:, None]) * log.dt)[..., None] ** np.arange(4)
    coefficients = np.linalg.pinv(powers) @ (log.values[rows] - offsets)
    q = shooting.encoders.positions(coefficients[:, 0])
    q_later = shooting.encoders.positions(coefficients[:, 0] + 1e-3 * coefficients[:, 1])
    return np.hstack([q, (q_later - q) / 1e-3])


def guess_states(shooting: Shooting, windows: Windows, values: Array) -> Array:
    """Return guesses of initial states at parameters (P,), shape (G, W, nq + nv); several for elastic transmissions.

    A transmission that rattles in its backlash reverses within milliseconds. A cubic over 40 ms misses its speed, and
    the search then ends in a local minimum. With rows of 5 ms all spans are equal, so one guess is enough.
    """
    elastic = shooting.encoders.joints < shooting.model.nq
    spans = SPANS if elastic and SPANS[1] > 3 * shooting.log.dt else SPANS[:1]
    offsets = shooting.encoder_offsets(values)
    guesses = [smoothed_states(shooting, windows, span, offsets) for span in spans]
    return np.stack([settle_stretches(shooting, windows, states, values) for states in guesses])


def settle_stretches(shooting: Shooting, windows: Windows, states: Array, values: Array) -> Array:
    """Return initial states whose stretches come from a short simulation, unless the encoders determine them."""
    n, nq = shooting.encoders.joints, shooting.model.nq
    if shooting.encoders.observe_stretches:
        return states
    lead = int(min(windows.first.min(), round(SETTLING / shooting.log.dt)))
    earlier = Windows(windows.first - lead, lead + 1)
    start = smoothed_states(shooting, earlier)
    _, last = shooting(values[None], start[None], earlier.first, earlier.length)
    settled = states.copy()
    settled[:, n:nq], settled[:, nq + n :] = last[0, :, n:nq], last[0, :, nq + n :]
    return settled


def encoder_noise(log: Log) -> Array:
    """Return a guess of the noise from third differences, which are small for smooth motion, shape (n_measured,)."""
    return np.maximum(np.diff(log.values, 3, axis=0).std(axis=0) / np.sqrt(20.0), 1e-9)
