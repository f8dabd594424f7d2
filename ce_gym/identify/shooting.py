"""Multiple shooting: simulations of windows of a log, many candidate parameters times many windows in one batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.laws.scene_parameters import parameter_defaults
from ce_gym.dynamics.model import Model
from ce_gym.identify.log import Log, LogError
from ce_gym.identify.parameters import OFFSET, Parameter
from ce_gym.model.errors import file_error
from ce_gym.sim.simulator import Simulator

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
METHOD = "extrapolated"
"""Default time-stepping method."""
LARGEST_BATCH = 4096
"""Largest number of robots in a batch."""
STRETCH_WEIGHT = 1e-3
"""Weight of stretches relative to joints where encoders do not determine both."""


class Encoders:
    """Readings of the encoders in a log, as a function of positions and velocities.

    Args:
        model: The robot.
        log: A log whose columns name the encoders.

    Attributes:
        joints: Number of joints; the positions of elastic transmissions' stretches follow.
        size: Number of encoders.
        observe_stretches: Whether the encoders determine the stretches.

    Raises:
        LogError: A column names no joint or rotor, or the angles do not determine all joints.
    """

    def __init__(self, model: Model, log: Log) -> None:
        robot = model.robot
        rows = {name: (q.start, v.start) for name, (q, v) in robot.spanning_rows.items() if len(q) == 1}
        for kind, name in log.measured:
            if name not in rows:
                raise file_error(log.source, f"column {kind}:{name}", f"a joint or a rotor of {robot.name}", LogError)
        self.model = model
        self.joints = len(model.joint_links)
        self.size = len(log.measured)
        self._angle = [k for k, (kind, _) in enumerate(log.measured) if kind == "angle"]
        self._speed = [k for k, (kind, _) in enumerate(log.measured) if kind == "speed"]
        self._rows = [rows[name][kind == "speed"] for kind, name in log.measured]
        self._speed_rows = [robot.spanning_rows[name][1].start for _, name in log.measured]
        zero, rng = np.zeros(model.nv), np.random.default_rng(0)
        offsets = np.vstack([np.zeros(model.nq), 1e-3 * rng.normal(size=(3, model.nq))])
        q = np.array(model.standing_q) + offsets
        G = model.explicit_constraint(q, np.broadcast_to(zero, (4, model.nv)))[0][:, self._speed_rows]
        self._linear = bool(np.abs(G - G[0]).max() < 1e-12)
        self._G = G[0]
        self._q0 = model.standing_q
        self._z0 = self._exact_readings(model.standing_q, zero)
        self.observe_stretches = bool(np.linalg.matrix_rank(G[0][self._angle]) == model.nv)
        by_joints = G[0][self._angle][:, : self.joints]
        if np.linalg.matrix_rank(by_joints) < self.joints:
            joint = model.joint_links[np.abs(np.linalg.svd(by_joints)[2][-1]).argmax()]
            raise file_error(log.source, f"no column determines the position of {joint}", "its angle", LogError)

    def _exact_readings(self, q: Array, v: Array) -> Array:
        positions, velocities = self.model.spanning(q, v)
        z = np.empty((*q.shape[:-1], self.size))
        for k, row in enumerate(self._rows):
            z[..., k] = (velocities if k in self._speed else positions)[..., row]
        return z

    def __call__(self, q: Array, v: Array) -> Array:
        """Return the readings at positions (..., nq) and velocities (..., nv), shape (..., size)."""
        if not self._linear:
            return self._exact_readings(q, v)
        z = np.empty((*q.shape[:-1], self.size))
        z[..., self._angle] = (q - self._q0) @ self._G[self._angle].T
        z[..., self._speed] = v @ self._G[self._speed].T
        return z + self._z0

    def positions(self, z: Array) -> Array:
        """Return the least-squares positions (W, nq) for readings (W, size), with the smallest possible stretches."""
        weight = np.where(np.arange(self.model.nq) < self.joints, 1.0, STRETCH_WEIGHT)
        zero, q = np.zeros((len(z), self.model.nv)), np.tile(self.model.standing_q, (len(z), 1))
        for _ in range(1 if self._linear else 8):
            residual = (z - self(q, zero))[:, self._angle]
            if self._linear:
                q += residual @ np.linalg.pinv(self._G[self._angle] * weight).T * weight
                continue
            G = self.model.explicit_constraint(q, zero)[0][:, [self._speed_rows[k] for k in self._angle]]
            q += weight * (np.linalg.pinv(G * weight) @ residual[..., None])[..., 0]
        return q


class Shooting:
    """Simulates windows of a log.

    Args:
        model: The robot in the log, with a fixed base.
        log: Commands, in the order of the simulator's targets, and measurements.
        parameters: Parameters of the candidates.
        substep: Longest sub-step of the simulation [s].
        **options: Further options of `Simulator`.
    """

    def __init__(self, model: Model, log: Log, parameters: Sequence[Parameter], substep: float, **options: Any) -> None:
        self.model, self.log, self.parameters = model, log, list(parameters)
        self.encoders = Encoders(model, log)
        self.simulator_parameters = tuple(dict.fromkeys(filter(None, (p.simulator_parameter for p in parameters))))
        self.substeps = max(1, round(np.ceil(log.dt / substep - 1e-9)))
        motors = "limited" if model.robot.motors else "ideal"
        self._options = {"method": METHOD, "motors": motors, "outputs": (), "contacts": (), **options}
        self._sims: dict[int, Simulator] = {}
        n_commands = len(self._simulator(1).target_names)
        angles = [name if kind == "angle" else "" for kind, name in log.measured]
        pairs = [(k, angles.index(p.element)) for k, p in enumerate(parameters) if p.kind == OFFSET]
        self._offsets = np.array(pairs, dtype=np.int64).reshape(-1, 2)  # parameter and encoder
        self._command_sums = np.vstack([np.zeros(n_commands), np.cumsum(log.commands, axis=0)])

    def _simulator(self, n: int) -> Simulator:
        if n not in self._sims:
            dt = self.log.dt / self.substeps
            self._sims[n] = Simulator(self.model, n, dt, parameters=self.simulator_parameters, **self._options)
        return self._sims[n]

    def __call__(self, values: Array, states: Array, first: Indices, length: int) -> tuple[Array, Array]:
        """Return simulated encoder readings, and the states at the last row.

        Args:
            values: Parameters of each candidate, shape (C, P).
            states: Positions and velocities at the start of each window, shape (C, W, nq + nv).
            first: First row of each window, shape (W,).
            length: Number of rows of a window.

        Returns:
            Shapes (C, W, length, n_measured) and (C, W, nq + nv).
        """
        n = max(1, LARGEST_BATCH // len(values))
        batches = [self._batch(values, states[:, i : i + n], first[i : i + n], length) for i in range(0, len(first), n)]
        readings, last = zip(*batches, strict=True)
        return np.concatenate(readings, axis=1), np.concatenate(last, axis=1)

    def _batch(self, values: Array, states: Array, first: Indices, length: int) -> tuple[Array, Array]:
        C, W, nq = len(values), len(first), self.model.nq
        sim = self._simulator(C * W)
        for name in self.simulator_parameters:
            default = parameter_defaults(self.model.robot, self.model.robot.material, (name,))[name]
            column = np.tile(default.astype(np.float64), (C, 1))
            for k, parameter in enumerate(self.parameters):
                if parameter.simulator_parameter == name:
                    column[:, parameter.entry] = values[:, k]
            sim.set_parameter(name, np.repeat(column, W, axis=0))
        flat = states.reshape(C * W, -1)
        sim.set_state(flat[:, :nq], flat[:, nq:])
        start = self.starts(values, first)
        readings, integral = [self.encoders(flat[:, :nq], flat[:, nq:])], self.integral(start)
        for k in range((length - 1) * self.substeps):
            next_integral = self.integral(start + (k + 1) / self.substeps)
            sim.step((next_integral - integral) * self.substeps)
            integral = next_integral
            if (k + 1) % self.substeps == 0:
                readings.append(self.encoders(sim.q, sim.v))
        z = np.stack(readings, axis=1).reshape(C, W, length, -1)
        for k, encoder in self._offsets:
            z[..., encoder] += values[:, k, None, None]
        return z, np.hstack([sim.q, sim.v]).reshape(C, W, -1)

    def encoder_offsets(self, values: Array) -> Array:
        """Return the offsets of all encoders at parameters (P,), shape (n_measured,)."""
        offsets = np.zeros(self.encoders.size)
        offsets[self._offsets[:, 1]] = values[self._offsets[:, 0]]
        return offsets

    def starts(self, values: Array, first: Indices) -> Array:
        """Return the fractional rows of the commands at the starts of windows, shape (C * W,): earlier by the delay."""
        delays = [values[:, k] for k, parameter in enumerate(self.parameters) if parameter.kind == "delay"]
        delay = delays[0] if delays else np.zeros(len(values))
        return np.tile(first, len(values)) - np.repeat(delay, len(first)) / self.log.dt

    def integral(self, rows: Array) -> Array:
        """Return the integral of the commands up to fractional rows (...), in units of dt, shape (..., n_commands)."""
        rows = np.clip(rows, 0.0, len(self._command_sums) - 1.0)
        whole = np.minimum(rows.astype(np.int64), len(self._command_sums) - 2)
        sums = self._command_sums
        return sums[whole] + (rows - whole)[..., None] * (sums[whole + 1] - sums[whole])
