"""Derivatives of encoder readings by parameters and initial states: finite differences in one batch.

Limbs of a robot with a fixed base are independent, so one candidate perturbs a parameter or state of every limb.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ce_gym.identify.base_fixed import limbs_of
from ce_gym.identify.shooting import Shooting
from ce_gym.identify.windows import Windows

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
STEP = 1e-4
"""Step of a parameter, relative to its scale."""
STATE_STEPS = 1e-5, 1e-3
"""Steps of initial positions [rad or m] and velocities."""
NONE = np.array([], dtype=np.int64)


class Limbs:
    """Measurements, states and parameters of each limb.

    Args:
        shooting: Log, model and parameters.

    Attributes:
        numbers: Numbers of the measured limbs.
        channels: Indices of the measurements of each limb.
        states: Indices of the coordinates of each limb in [q; v].
    """

    def __init__(self, shooting: Shooting) -> None:
        limb = limbs_of(shooting.model.robot)
        of_channels = np.array([limb[name] for _, name in shooting.log.measured])
        of_states = np.array([limb[name] for name in shooting.model.robot.independent] * 2)
        self._of_parameters = np.array([parameter.limb for parameter in shooting.parameters])
        self.numbers = sorted(set(of_channels.tolist()))
        self.channels = {c: np.flatnonzero(of_channels == c) for c in self.numbers}
        self.states = {c: np.flatnonzero(of_states == c) for c in self.numbers}

    def parameters(self, c: int, free: Indices) -> Indices:
        """Return the free parameters that act on limb c alone; with c = -1, those that act on all limbs."""
        return free[self._of_parameters[free] == c]


class Differences:
    """Readings of windows and their finite differences.

    Args:
        shooting: Simulates windows.
        windows: The windows.

    Attributes:
        last: With elastic transmissions, states one row after each window of the last call, shape (W, nq + nv).
    """

    def __init__(self, shooting: Shooting, windows: Windows) -> None:
        self.shooting, self.windows, self.limbs = shooting, windows, Limbs(shooting)
        self._extra_rows = int(shooting.encoders.joints < shooting.model.nq)
        self.last = np.zeros((0, shooting.model.nq + shooting.model.nv))
        self._scale = np.array([parameter.scale for parameter in shooting.parameters])
        self._steps = np.repeat(STATE_STEPS, (shooting.model.nq, shooting.model.nv))

    def __call__(
        self, values: Array, states: Array, free: Indices = NONE
    ) -> tuple[Array, dict[int, Array], dict[int, Array]]:
        """Return readings and their derivatives by states and by parameters of each limb.

        Args:
            values: Parameters, shape (P,).
            states: Initial states, shape (W, nq + nv).
            free: Indices of the parameters for derivatives.

        Returns:
            Readings, shape (W, L, n), and for each limb with its n_limb measurements: derivatives by its states, shape
            (W, L n_limb, k), and derivatives by parameters over their scales. Parameters of the limb alone come first,
            then parameters of all limbs.
        """
        numbers, common = self.limbs.numbers, self.limbs.parameters(-1, free)
        single = {c: self.limbs.parameters(c, free) for c in numbers}
        n_states = max(len(rows) for rows in self.limbs.states.values())
        n_single = max(len(places) for places in single.values())
        perturbed = np.tile(values, (1 + n_states + n_single + len(common), 1))
        perturbed_states = np.tile(states, (len(perturbed), 1, 1))
        for c in numbers:
            for k, row in enumerate(self.limbs.states[c]):
                perturbed_states[1 + k, :, row] += self._steps[row]
            for k, i in enumerate(single[c]):
                perturbed[1 + n_states + k, i] += STEP * self._scale[i]
        for k, i in enumerate(common):
            perturbed[1 + n_states + n_single + k, i] += STEP * self._scale[i]
        length = self.windows.length
        readings, last = self.shooting(perturbed, perturbed_states, self.windows.first, length + self._extra_rows)
        readings, self.last = readings[:, :, :length], last[0]
        by_state, by_parameter = {}, {}
        for c in numbers:
            change = (readings[1:] - readings[0])[..., self.limbs.channels[c]]
            change = np.moveaxis(change.reshape(len(change), len(states), -1), 0, -1)
            rows = self.limbs.states[c]
            by_state[c] = change[..., : len(rows)] / self._steps[rows]
            of_limb = change[..., n_states : n_states + len(single[c])]
            by_parameter[c] = np.concatenate([of_limb, change[..., n_states + n_single :]], axis=2) / STEP
        return readings[0], by_state, by_parameter
