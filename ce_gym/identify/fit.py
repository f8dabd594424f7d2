"""Least squares by multiple shooting: figures are common to all windows, initial states are each window's own.

Initial states are eliminated (variable projection, Golub and Pereyra 1973; Jacobian by Kaufman 1975): at figures x each
window's state is what fits it best, and residuals and their derivatives are projected onto what no initial state can
explain. What is left is compressed to a triangle, R of QR, which has the same normal equations; SciPy's trust region
minimises it. Derivatives are differences over the batch. Limbs do not feel each other, so that a figure, or a
coordinate, of each can be changed in the same candidate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.identify.shots import Shots

Array = NDArray[np.float64]
STEP = 1e-4
"""Of differences in figures, relative to their scale."""
STATE_STEPS = 1e-5, 1e-3
"""Of differences in initial positions [rad or m] and velocities."""
LARGEST_STEPS = 0.01, 0.3
"""Of initial positions and velocities that data hardly tell, as of a joint that sticks."""


@dataclass(frozen=True)
class Windows:
    """Windows of a log.

    Attributes:
        first: Rows where they start, shape (W,).
        length: [rows]
    """

    first: NDArray[np.int64]
    length: int


class Problem:
    """Residuals of windows and their derivatives.

    Args:
        shots: Simulates windows.
        windows: Which.
        limb_of_channel: Number of the limb that each measured quantity is on.
        limb_of_state: The same for each row of [q; v].
        states: First guess of initial states, shape (W, nq + nv).
        noise: Standard deviation of each measured quantity, shape (n_measured,).
    """

    def __init__(
        self,
        shots: Shots,
        windows: Windows,
        limb_of_channel: Sequence[int],
        limb_of_state: Sequence[int],
        states: Array,
        noise: Array,
    ) -> None:
        self.shots, self.windows, self.states, self.noise = shots, windows, states.copy(), noise.copy()
        self.guess = states.copy()
        self.scale = np.array([figure.scale for figure in shots.figures])
        rows = windows.first[:, None] + np.arange(windows.length + 1)
        self.measured = shots.log.values[rows]
        self.limbs = sorted(set(limb_of_channel))
        self.channels = {c: np.flatnonzero(np.array(limb_of_channel) == c) for c in self.limbs}
        self.state_rows = {c: np.flatnonzero(np.array(limb_of_state) == c) for c in self.limbs}
        of_figures = np.array([figure.limb for figure in shots.figures])
        self.own = {c: np.flatnonzero(of_figures == c) for c in self.limbs}
        self.common = np.flatnonzero(of_figures == -1)
        self.residual = np.zeros_like(self.measured)
        self._known: tuple[bytes, Array, Array] | None = None
        self._settled = False

    @property
    def freedom(self) -> int:
        """Measurements less what is fitted to them."""
        return self.measured.size - self.states.size - len(self.scale)

    def forget(self) -> None:
        """Evaluate anew where it was evaluated last, as when the noise is known better."""
        self._known = None

    def residuals(self, x: Array) -> Array:
        """Return compressed residuals at figures over their scales, for `least_squares`."""
        return self._at(x)[0]

    def jacobian(self, x: Array) -> Array:
        """Return their derivatives, shape (m, P)."""
        return self._at(x)[1]

    def _at(self, x: Array) -> tuple[Array, Array]:
        if self._known is None or self._known[0] != x.tobytes():
            self._start_again(x)
            for _ in range(3 if self._settled else 8):
                self._improve_states(x)
            self._settled = True
            self._known = (x.tobytes(), *self._evaluate(x))
        return self._known[1:]

    def _start_again(self, x: Array) -> None:
        """Put limbs back to the first guess in windows where that fits better than where other figures led them."""
        states = np.stack([self.states, self.guess])
        read = self.shots(np.tile(x * self.scale, (2, 1)), states, self.windows.first, self.windows.length)
        for c in self.limbs:
            costs = (((read - self.measured) / self.noise)[..., self.channels[c]] ** 2).sum((2, 3))
            back = np.ix_(np.flatnonzero(costs[1] < costs[0]), self.state_rows[c])
            self.states[back] = self.guess[back]

    def _improve_states(self, x: Array) -> None:
        """Make a step of Levenberg and Marquardt's for each limb of each window, where it is for the better."""
        base, by_state, _ = self._simulate(x, figures=False)
        new, nq = self.states.copy(), self.shots.model.nq
        damping = np.repeat(1 / np.square(LARGEST_STEPS), (nq, self.shots.model.nv))
        for c in self.limbs:
            J, rows = by_state[c], self.state_rows[c]
            r = ((self.measured - base) / self.noise)[..., self.channels[c]].reshape(len(base), -1, 1)
            JT = np.swapaxes(J, 1, 2)
            new[:, rows] += np.linalg.solve(JT @ J + np.diag(damping[rows]), JT @ r)[..., 0]
        after = self.shots((x * self.scale)[None], new[None], self.windows.first, self.windows.length)[0]
        for c in self.limbs:
            costs = [
                (((z - self.measured) / self.noise)[..., self.channels[c]] ** 2).sum((1, 2)) for z in (base, after)
            ]
            better = np.flatnonzero(costs[1] < costs[0])
            self.states[np.ix_(better, self.state_rows[c])] = new[np.ix_(better, self.state_rows[c])]

    def _evaluate(self, x: Array) -> tuple[Array, Array]:
        base, by_state, by_figure = self._simulate(x, figures=True)
        blocks, P = [], len(x)
        for c in self.limbs:
            chosen = self.channels[c]
            r = ((base - self.measured) / self.noise)[..., chosen].reshape(len(base), -1, 1)
            mine = np.concatenate([self.own[c], self.common])
            both = np.concatenate([by_figure[c], r], axis=2)
            Q = np.linalg.qr(by_state[c])[0]
            both = both - Q @ (np.swapaxes(Q, 1, 2) @ both)
            self.residual[..., chosen] = both[..., -1].reshape(*base.shape[:2], -1)
            R: Array = np.linalg.qr(both.reshape(-1, both.shape[2]), mode="r")  # type: ignore[assignment]
            block = np.zeros((len(R), P + 1))
            block[:, mine], block[:, P] = R[:, :-1], R[:, -1]
            blocks.append(block)
        stacked = np.vstack(blocks)
        return stacked[:, P], stacked[:, :P]

    def _simulate(self, x: Array, figures: bool) -> tuple[Array, dict[int, Array], dict[int, Array]]:
        """Return readings (W, L, n), and their weighted derivatives by states and figures of each limb (W, rows, k)."""
        n_states = max(len(rows) for rows in self.state_rows.values())
        n_own = max(len(rows) for rows in self.own.values()) if figures else 0
        n_common = len(self.common) if figures else 0
        values = np.tile(x * self.scale, (1 + n_states + n_own + n_common, 1))
        states = np.tile(self.states, (len(values), 1, 1))
        nq, steps = self.shots.model.nq, np.repeat(STATE_STEPS, (self.shots.model.nq, self.shots.model.nv))
        for c in self.limbs:
            for k, row in enumerate(self.state_rows[c]):
                states[1 + k, :, row] += steps[row]
            for k, row in enumerate(self.own[c][:n_own]):
                values[1 + n_states + k, row] += STEP * self.scale[row]
        for k in range(n_common):
            values[1 + n_states + n_own + k, self.common[k]] += STEP * self.scale[self.common[k]]
        assert nq == self.shots.model.nv
        read = self.shots(values, states, self.windows.first, self.windows.length)
        by_state, by_figure = {}, {}
        for c in self.limbs:
            change = ((read[1:] - read[0]) / self.noise)[..., self.channels[c]]
            change = np.moveaxis(change.reshape(len(change), len(self.states), -1), 0, -1)
            rows = self.state_rows[c]
            by_state[c] = change[..., : len(rows)] / steps[rows]
            own = change[..., n_states : n_states + (len(self.own[c]) if figures else 0)]
            by_figure[c] = np.concatenate([own, change[..., n_states + n_own :]], axis=2) / STEP
        return read[0], by_state, by_figure


def solve(problem: Problem, x: Array, low: Array, high: Array) -> Any:
    """Return the result of SciPy's `least_squares`, from x and between bounds, all over the figures' scales."""
    from scipy.optimize import least_squares

    return least_squares(
        problem.residuals,
        x,
        problem.jacobian,  # type: ignore[arg-type]
        (low, high),
        method="trf",
        x_scale="jac",
        ftol=1e-7,
        xtol=1e-6,
        gtol=1e-9,
    )


def noise_of(problem: Problem) -> Array:
    """Return the standard deviation of what is left of each measured quantity, in its unit."""
    share = problem.freedom / problem.measured.size
    return problem.noise * np.sqrt((problem.residual**2).mean(axis=(0, 1)) / share)


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
