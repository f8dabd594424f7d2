"""Nonlinear least squares by multiple shooting: parameters are common to all windows, initial states are not.

Initial states are eliminated (variable projection, Golub and Pereyra 1973; Jacobian by Kaufman 1975). At parameters x,
the initial state of each window is its best fit. Residuals and their derivatives are projected onto the complement of
the derivatives by the initial state. QR compresses the projections to a triangle with the same normal equations, and
SciPy's trust region minimises the sum of squares.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ce_gym.identify.differences import Differences
from ce_gym.identify.shooting import Shooting
from ce_gym.identify.windows import Windows

Array = NDArray[np.float64]
LARGEST_STEPS = 0.01, 0.3
"""Largest steps of initial positions and velocities that the data hardly determine, as of a sticking joint."""
DAMPINGS = 0.0, 0.03, 1.0, 30.0
"""Levenberg-Marquardt dampings, relative to the diagonal; all are tried, as full steps fail at sticking joints."""
RESTART_STEPS = 20
"""Largest number of steps of initial states after a restart."""
CONVERGED = 1e-5
"""Initial states have converged if a step reduces the sum of squares by a smaller share."""


class Problem:
    """Residuals of windows and their derivatives.

    Args:
        shooting: Simulates windows.
        windows: The windows.
        states: Guesses of initial states, shape (G, W, nq + nv), or (W, nq + nv) for one guess.
        noise: Standard deviation of each measurement, shape (n_measured,).

    Attributes:
        free: Indices of the fitted parameters; the others stay at their nominal values.
        states: Best initial states at the last parameters, shape (W, nq + nv).
        residual: Projected residuals over noise at the last parameters, shape (W, length, n_measured).
    """

    def __init__(self, shooting: Shooting, windows: Windows, states: Array, noise: Array) -> None:
        self.shooting, self.windows, self.noise = shooting, windows, noise.copy()
        self.guesses = states.copy().reshape(-1, *states.shape[-2:])
        self.states = self.guesses[0].copy()
        self.free = np.arange(len(shooting.parameters))
        self.scale = np.array([parameter.scale for parameter in shooting.parameters])
        self.measured = shooting.log.values[windows.rows]
        self.residual = np.zeros_like(self.measured)
        self._differences = Differences(shooting, windows)
        self.limbs = self._differences.limbs
        self._cache: tuple[bytes, Array, Array] | None = None
        self._improved = False

    def values(self, x: Array) -> Array:
        """Return all parameters in their units, shape (P,), for free parameters over their scales."""
        values = np.array([parameter.nominal for parameter in self.shooting.parameters])
        values[self.free] = x * self.scale[self.free]
        return values

    def update_noise(self, x: Array) -> None:
        """Set the noise to the standard deviation of the residuals at x, with the degrees of freedom of the fit."""
        self.residuals(x)
        freedom = self.measured.size - self.states.size - len(x)
        squares = (self.residual**2).mean(axis=(0, 1)) * self.measured.size / freedom
        self.noise = np.maximum(self.noise * np.sqrt(squares), 1e-12)
        self.clear_cache()

    def clear_cache(self) -> None:
        """Discard the last evaluation, after a change of the noise, the states or the free parameters."""
        self._cache = None

    def residuals(self, x: Array) -> Array:
        """Return compressed residuals at free parameters over their scales, for `least_squares`."""
        return self._cached(x)[0]

    def jacobian(self, x: Array) -> Array:
        """Return the derivatives of the compressed residuals by x, shape (m, len(x))."""
        return self._cached(x)[1]

    def full_jacobian(self, x: Array) -> Array:
        """Return the derivatives by all parameters over their scales, at free parameters x, shape (m, P)."""
        self.residuals(x)
        free, values = self.free, self.values(x)
        self.free = np.arange(len(values))
        J = self._evaluate(values / self.scale)[1]
        self.free = free
        return J

    def _cached(self, x: Array) -> tuple[Array, Array]:
        if self._cache is None or self._cache[0] != x.tobytes():
            self.improve_states(x, 3 if self._improved else 8)
            self._improved = True
            self._cache = (x.tobytes(), *self._evaluate(x))
        return self._cache[1:]

    def improve_states(self, x: Array, steps: int) -> None:
        """Improve initial states by Levenberg-Marquardt steps until they converge, or take guesses that fit better.

        Args:
            x: Free parameters over their scales.
            steps: Largest number of steps.
        """
        regularisation = np.repeat(1 / np.square(LARGEST_STEPS), (self.shooting.model.nq, self.shooting.model.nv))
        for _ in range(steps):
            readings, by_state, _ = self._differences(self.values(x), self.states)
            candidates = [self.states, *[self.states] * len(DAMPINGS), *self.guesses, *self._continued_states()]
            states = np.stack(candidates)
            for c in self.limbs.numbers:
                rows, r = self.limbs.states[c], self._weighted(self.measured - readings, c)
                J = by_state[c] / self._row_noise(c)
                JT = np.swapaxes(J, 1, 2)
                normal = JT @ J + np.diag(regularisation[rows])
                for k, damping in enumerate(DAMPINGS):
                    damped = normal * (1 + damping * np.eye(len(rows)))
                    states[1 + k][:, rows] += np.linalg.solve(damped, JT @ r)[..., 0]
            if self._take_best(x, states) < CONVERGED:
                break

    def restart_states(self, x: Array, guesses: Array) -> float:
        """Search initial states again from guesses (G, W, nq + nv), and take those that fit better than the present.

        The search at wrong parameters may have ended in a local minimum, with transmissions between wrong flanks.

        Returns:
            Relative decrease of the sum of squares.
        """
        candidates = [self.states]
        for guess in guesses:
            problem = Problem(self.shooting, self.windows, guess, self.noise)
            problem.free = self.free
            problem.improve_states(x, RESTART_STEPS)
            candidates.append(problem.states)
        self.clear_cache()
        return self._take_best(x, np.stack(candidates))

    def _continued_states(self) -> list[Array]:
        """Return initial states that continue the window before, in all coordinates and in the stretches alone.

        Only for elastic transmissions, whose rattling no cubic fits.
        """
        last, n, nq = self._differences.last, self.shooting.encoders.joints, self.shooting.model.nq
        if n == nq:
            return []
        ends = np.flatnonzero(self.windows.first[:-1] + self.windows.length == self.windows.first[1:])
        continued, stretches = self.states.copy(), self.states.copy()
        continued[ends + 1] = last[ends]
        stretches[:, n:nq], stretches[:, nq + n :] = continued[:, n:nq], continued[:, nq + n :]
        return [continued, stretches]

    def _take_best(self, x: Array, states: Array) -> float:
        """Take the best of several initial states (K, W, nq + nv), for each limb of each window.

        Returns:
            Relative decrease of the sum of squares from the first states to the best.
        """
        values = np.tile(self.values(x), (len(states), 1))
        readings, _ = self.shooting(values, states, self.windows.first, self.windows.length)
        windows, first_cost, best_cost = np.arange(len(self.states)), 0.0, 0.0
        for c in self.limbs.numbers:
            costs = (((readings - self.measured) / self.noise)[..., self.limbs.channels[c]] ** 2).sum((2, 3))
            rows = self.limbs.states[c]
            self.states[:, rows] = states[costs.argmin(axis=0), windows][:, rows]
            first_cost += costs[0].sum()
            best_cost += costs.min(axis=0).sum()
        return (first_cost - best_cost) / first_cost if first_cost > 0 else 0.0

    def _evaluate(self, x: Array) -> tuple[Array, Array]:
        """Return compressed residuals (m,) and their derivatives (m, len(x))."""
        readings, by_state, by_parameter = self._differences(self.values(x), self.states, self.free)
        blocks, P = [], len(x)
        common = self.limbs.parameters(-1, self.free)
        for c in self.limbs.numbers:
            noise = self._row_noise(c)
            columns = np.concatenate([by_parameter[c] / noise, self._weighted(readings - self.measured, c)], axis=2)
            Q = np.linalg.qr(by_state[c] / noise)[0]
            columns = columns - Q @ (np.swapaxes(Q, 1, 2) @ columns)
            self.residual[..., self.limbs.channels[c]] = columns[..., -1].reshape(*readings.shape[:2], -1)
            R: Array = np.linalg.qr(columns.reshape(-1, columns.shape[2]), mode="r")  # type: ignore[assignment]
            block = np.zeros((len(R), P + 1))
            places = np.searchsorted(self.free, np.concatenate([self.limbs.parameters(c, self.free), common]))
            block[:, places], block[:, P] = R[:, :-1], R[:, -1]
            blocks.append(block)
        stacked = np.vstack(blocks)
        return stacked[:, P], stacked[:, :P]

    def _weighted(self, difference: Array, c: int) -> Array:
        """Return a limb's differences over their noise, shape (W, L n, 1)."""
        return (difference / self.noise)[..., self.limbs.channels[c]].reshape(len(difference), -1, 1)

    def _row_noise(self, c: int) -> Array:
        """Return the noise of a limb's measurements row by row, shape (L n, 1)."""
        return np.tile(self.noise[self.limbs.channels[c]], self.windows.length)[:, None]


def solve(problem: Problem, x: Array, tolerance: float) -> Array:
    """Return the best free parameters over their scales, by SciPy's `least_squares` within bounds.

    Args:
        problem: The residuals.
        x: Starting point.
        tolerance: Smallest relative decrease of the sum of squares.
    """
    from scipy.optimize import least_squares

    low = np.array([parameter.low for parameter in problem.shooting.parameters])
    high = np.array([parameter.high for parameter in problem.shooting.parameters])
    bounds = tuple((bound / problem.scale)[problem.free] for bound in (low, high))
    options = {"method": "trf", "x_scale": "jac", "ftol": tolerance, "xtol": 1e-6, "gtol": 1e-9}
    return least_squares(problem.residuals, np.clip(x, *bounds), problem.jacobian, bounds, **options).x  # type: ignore[arg-type]
