"""Derivatives of what encoders read, by figures and by initial states: differences over one batch.

Limbs do not feel each other, so that a figure, or a coordinate, of each can be changed in the same candidate.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ce_gym.identify.held import limbs_of
from ce_gym.identify.shots import Shots
from ce_gym.identify.windows import Windows

Array = NDArray[np.float64]
Places = NDArray[np.int64]
STEP = 1e-4
"""Of differences in figures, relative to their scale."""
STATE_STEPS = 1e-5, 1e-3
"""Of differences in initial positions [rad or m] and velocities."""


class Limbs:
    """What belongs to each limb.

    Args:
        shots: What is simulated.

    Attributes:
        numbers: Of limbs that are measured.
        channels: Places of its measurements, for each limb.
        states: Places of its coordinates in [q; v], for each limb.
    """

    def __init__(self, shots: Shots) -> None:
        limb = limbs_of(shots.model.robot)
        of_channels = np.array([limb[name] for _, name in shots.log.measured])
        of_states = np.array([limb[name] for name in shots.model.robot.independent] * 2)
        self._of_figures = np.array([figure.limb for figure in shots.figures])
        self.numbers = sorted(set(of_channels.tolist()))
        self.channels = {c: np.flatnonzero(of_channels == c) for c in self.numbers}
        self.states = {c: np.flatnonzero(of_states == c) for c in self.numbers}

    def own(self, c: int, free: Places) -> Places:
        """Return which of the figures that are free act on a limb alone; those of limb -1 act on all."""
        return free[self._of_figures[free] == c]


class Differences:
    """Takes differences.

    Args:
        shots: Simulates windows.
        windows: Which.

    Attributes:
        last: Where transmissions stretch, states a row after the windows that were simulated last, (W, nq + nv).
    """

    def __init__(self, shots: Shots, windows: Windows) -> None:
        self.shots, self.windows, self.limbs = shots, windows, Limbs(shots)
        self._more = int(shots.encoders.joints < shots.model.nq)
        self.last = np.zeros((0, shots.model.nq + shots.model.nv))
        self._scale = np.array([figure.scale for figure in shots.figures])
        self._steps = np.repeat(STATE_STEPS, (shots.model.nq, shots.model.nv))

    def by_states(self, values: Array, states: Array) -> tuple[Array, dict[int, Array]]:
        """Return readings (W, L, n) at figures (P,), and their derivatives by states of each limb (W, L n, k)."""
        read, by_state, _ = self.by_all(values, states, np.array([], dtype=np.int64))
        return read, by_state

    def by_all(self, values: Array, states: Array, free: Places) -> tuple[Array, dict[int, Array], dict[int, Array]]:
        """Return them by free figures, over their scales, too; each limb's own ones before those of all limbs."""
        numbers, common = self.limbs.numbers, self.limbs.own(-1, free)
        own = {c: self.limbs.own(c, free) for c in numbers}
        n_states = max(len(rows) for rows in self.limbs.states.values())
        n_own = max(len(mine) for mine in own.values())
        changed = np.tile(values, (1 + n_states + n_own + len(common), 1))
        moved = np.tile(states, (len(changed), 1, 1))
        for c in numbers:
            for k, row in enumerate(self.limbs.states[c]):
                moved[1 + k, :, row] += self._steps[row]
            for k, figure in enumerate(own[c]):
                changed[1 + n_states + k, figure] += STEP * self._scale[figure]
        for k, figure in enumerate(common):
            changed[1 + n_states + n_own + k, figure] += STEP * self._scale[figure]
        read, last = self.shots.run(changed, moved, self.windows.first, self.windows.length + self._more)
        read, self.last = read[:, :, : self.windows.length], last[0]
        by_state, by_figure = {}, {}
        for c in numbers:
            change = (read[1:] - read[0])[..., self.limbs.channels[c]]
            change = np.moveaxis(change.reshape(len(change), len(states), -1), 0, -1)
            rows = self.limbs.states[c]
            by_state[c] = change[..., : len(rows)] / self._steps[rows]
            mine = change[..., n_states : n_states + len(own[c])]
            by_figure[c] = np.concatenate([mine, change[..., n_states + n_own :]], axis=2) / STEP
        return read[0], by_state, by_figure
