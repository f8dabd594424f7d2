"""Least squares by multiple shooting: figures are common to all windows, initial states are each window's own.

Initial states are eliminated (variable projection, Golub and Pereyra 1973; Jacobian by Kaufman 1975): at figures x each
window's state is what fits it best, and residuals and their derivatives are projected onto what no initial state can
explain. What is left is compressed to a triangle, R of QR, which has the same normal equations; SciPy's trust region
minimises it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ce_gym.identify.differences import Differences
from ce_gym.identify.shots import Shots
from ce_gym.identify.windows import Windows

Array = NDArray[np.float64]
LARGEST_STEPS = 0.01, 0.3
"""Of initial positions and velocities that data hardly tell, as of a joint that sticks."""
DAMPINGS = 0.0, 0.03, 1.0, 30.0
"""Of Levenberg and Marquardt's steps, relative to the diagonal: where joints stick and slip, full steps often fail."""
ANEW = 20
"""Most steps of initial states that begin anew."""
SETTLED = 1e-5
"""Steps of initial states that help less than that, relative to the sum of squares, are the last."""


class Problem:
    """Residuals of windows and their derivatives.

    Args:
        shots: Simulates windows.
        windows: Which.
        states: First guesses of initial states, shape (G, W, nq + nv) or (W, nq + nv) for one.
        noise: Standard deviation of each measured quantity, shape (n_measured,).

    Attributes:
        free: Places of the figures that are fitted; the others are what the robot's file has.
        residual: What is left at the last figures, over the noise, projected, shape (W, length, n_measured).
    """

    def __init__(self, shots: Shots, windows: Windows, states: Array, noise: Array) -> None:
        self.shots, self.windows, self.noise = shots, windows, noise.copy()
        self.guesses = states.copy().reshape(-1, *states.shape[-2:])
        self.states, self.free = self.guesses[0].copy(), np.arange(len(shots.figures))
        self.scale = np.array([figure.scale for figure in shots.figures])
        self.measured = shots.log.values[windows.rows]
        self.residual = np.zeros_like(self.measured)
        self._differences = Differences(shots, windows)
        self.limbs = self._differences.limbs
        self._known: tuple[bytes, Array, Array] | None = None
        self._settled = False

    def values(self, x: Array) -> Array:
        """Return all figures in their units, shape (P,), at free ones over their scales."""
        values = np.array([figure.nominal for figure in self.shots.figures])
        values[self.free] = x * self.scale[self.free]
        return values

    def weigh(self, x: Array) -> None:
        """Take the noise from what is left at x, over measurements less what is fitted to them."""
        self.residuals(x)
        freedom = self.measured.size - self.states.size - len(x)
        squares = (self.residual**2).mean(axis=(0, 1)) * self.measured.size / freedom
        self.noise = np.maximum(self.noise * np.sqrt(squares), 1e-12)
        self.forget()

    def forget(self) -> None:
        """Evaluate anew where it was evaluated last, as when other figures are free."""
        self._known = None

    def residuals(self, x: Array) -> Array:
        """Return compressed residuals at free figures over their scales, for `least_squares`."""
        return self._at(x)[0]

    def jacobian(self, x: Array) -> Array:
        """Return their derivatives, shape (m, len(x))."""
        return self._at(x)[1]

    def jacobian_of_all(self, x: Array) -> Array:
        """Return derivatives by all figures, those that are not free too, at free figures x, shape (m, P)."""
        self.residuals(x)
        free, values = self.free, self.values(x)
        self.free = np.arange(len(values))
        J = self._evaluate(values / self.scale)[1]
        self.free = free
        return J

    def _at(self, x: Array) -> tuple[Array, Array]:
        if self._known is None or self._known[0] != x.tobytes():
            self.improve_states(x, 3 if self._settled else 8)
            self._settled = True
            self._known = (x.tobytes(), *self._evaluate(x))
        return self._known[1:]

    def improve_states(self, x: Array, steps: int) -> None:
        """Make steps of Levenberg and Marquardt's while they help, or go back to a guess, each limb and window."""
        least = np.repeat(1 / np.square(LARGEST_STEPS), (self.shots.model.nq, self.shots.model.nv))
        for _ in range(steps):
            base, by_state = self._differences.by_states(self.values(x), self.states)
            new = np.stack([self.states, *[self.states] * len(DAMPINGS), *self.guesses, *self._going_on()])
            for c in self.limbs.numbers:
                rows, r = self.limbs.states[c], self._weighed(self.measured - base, c)
                J = by_state[c] / self._noise_of(c)
                JT = np.swapaxes(J, 1, 2)
                normal = JT @ J + np.diag(least[rows])
                for k, damping in enumerate(DAMPINGS):
                    damped = normal * (1 + damping * np.eye(len(rows)))
                    new[1 + k][:, rows] += np.linalg.solve(damped, JT @ r)[..., 0]
            if self._choose(x, new) < SETTLED:
                break

    def begin_anew(self, x: Array, guesses: Array) -> float:
        """Search initial states again from guesses (G, W, nq + nv), and keep those that fit better than the present.

        States that were found while figures were far off can be between other flanks than the robot was.

        Returns:
            By how much the sum of squares has become less, relative to itself.
        """
        new = [self.states]
        for guess in guesses:
            again = Problem(self.shots, self.windows, guess, self.noise)
            again.free = self.free
            again.improve_states(x, ANEW)
            new.append(again.states)
        self.forget()
        return self._choose(x, np.stack(new))

    def _going_on(self) -> list[Array]:
        """Return states as the window before ends, and with its stretches alone: flanks that rattle are no cubics."""
        last, n, nq = self._differences.last, self.shots.encoders.joints, self.shots.model.nq
        if n == nq:
            return []
        after = np.flatnonzero(self.windows.first[:-1] + self.windows.length == self.windows.first[1:])
        whole, stretches = self.states.copy(), self.states.copy()
        whole[after + 1] = last[after]
        stretches[:, n:nq], stretches[:, nq + n :] = whole[:, n:nq], whole[:, nq + n :]
        return [whole, stretches]

    def _choose(self, x: Array, states: Array) -> float:
        """Take from several states (K, W, nq + nv) those that fit best, for each limb of each window.

        Returns:
            How much better than the first they fit, relative to that.
        """
        values = np.tile(self.values(x), (len(states), 1))
        read = self.shots(values, states, self.windows.first, self.windows.length)
        windows, before, after = np.arange(len(self.states)), 0.0, 0.0
        for c in self.limbs.numbers:
            costs = (((read - self.measured) / self.noise)[..., self.limbs.channels[c]] ** 2).sum((2, 3))
            rows = self.limbs.states[c]
            self.states[:, rows] = states[costs.argmin(axis=0), windows][:, rows]
            before, after = before + costs[0].sum(), after + costs.min(axis=0).sum()
        return (before - after) / before if before > 0 else 0.0

    def _evaluate(self, x: Array) -> tuple[Array, Array]:
        base, by_state, by_figure = self._differences.by_all(self.values(x), self.states, self.free)
        blocks, P = [], len(x)
        common = self.limbs.own(-1, self.free)
        for c in self.limbs.numbers:
            noise = self._noise_of(c)
            both = np.concatenate([by_figure[c] / noise, self._weighed(base - self.measured, c)], axis=2)
            Q = np.linalg.qr(by_state[c] / noise)[0]
            both = both - Q @ (np.swapaxes(Q, 1, 2) @ both)
            self.residual[..., self.limbs.channels[c]] = both[..., -1].reshape(*base.shape[:2], -1)
            R: Array = np.linalg.qr(both.reshape(-1, both.shape[2]), mode="r")  # type: ignore[assignment]
            block = np.zeros((len(R), P + 1))
            mine = np.searchsorted(self.free, np.concatenate([self.limbs.own(c, self.free), common]))
            block[:, mine], block[:, P] = R[:, :-1], R[:, -1]
            blocks.append(block)
        stacked = np.vstack(blocks)
        return stacked[:, P], stacked[:, :P]

    def _weighed(self, difference: Array, c: int) -> Array:
        """Return a limb's differences over their noise, shape (W, L n, 1)."""
        return (difference / self.noise)[..., self.limbs.channels[c]].reshape(len(difference), -1, 1)

    def _noise_of(self, c: int) -> Array:
        """Return the noise of a limb's measurements row by row, shape (L n, 1)."""
        return np.tile(self.noise[self.limbs.channels[c]], self.windows.length)[:, None]


def solve(problem: Problem, x: Array, tolerance: float) -> Array:
    """Return free figures over their scales that fit best, by SciPy's `least_squares` from x and between bounds.

    Args:
        problem: What is fitted.
        x: Where to begin.
        tolerance: It ends where the sum of squares, relative to itself, changes less.
    """
    from scipy.optimize import least_squares

    low, high = (np.array([getattr(f, side) for f in problem.shots.figures]) for side in ("low", "high"))
    bounds = tuple((bound / problem.scale)[problem.free] for bound in (low, high))
    options = {"method": "trf", "x_scale": "jac", "ftol": tolerance, "xtol": 1e-6, "gtol": 1e-9}
    return least_squares(problem.residuals, np.clip(x, *bounds), problem.jacobian, bounds, **options).x  # type: ignore[arg-type]
