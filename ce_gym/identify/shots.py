"""Short simulations, "shots", of windows of a log: many candidates for the figures times many windows, in one batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.laws.scene_parameters import parameter_defaults
from ce_gym.dynamics.model import Model
from ce_gym.identify.figures import NO_PARAMETERS, OF_ENCODERS, Figure
from ce_gym.identify.log import Log, LogError
from ce_gym.sim.simulator import Simulator

Array = NDArray[np.float64]
LARGEST_BATCH = 4096
"""Robots that are simulated at once."""
LEAST_STRETCH = 1e-3
"""How much less than joints transmissions stretch where encoders do not tell which of them it is."""


@dataclass(frozen=True)
class Settings:
    """How shots are simulated.

    Attributes:
        control: What commands mean, as for `Simulator`.
        substep: Longest sub-step [s].
        method: Of stepping.
        threads: Threads.
    """

    control: str = "position"
    substep: float = 1e-3
    method: str = "extrapolated"
    threads: int = 1


class Encoders:
    """What is measured, as a function of positions and velocities.

    Args:
        model: The robot.
        log: Whose columns say what is measured.

    Attributes:
        tell_stretches: Whether they tell how far transmissions stretch, if any does.

    Raises:
        LogError: A column is of nothing that the robot has, or angles do not tell where all joints are.
    """

    def __init__(self, model: Model, log: Log) -> None:
        robot = model.robot
        rows = {name: (q.start, v.start) for name, (q, v) in robot.spanning_rows.items() if len(q) == 1}
        for kind, name in log.measured:
            if name not in rows:
                raise LogError(f"{log.source}: column {kind}:{name}: expected a joint or a rotor of {robot.name}")
        self.model, self.joints = model, len(model.joint_links)
        self._angle = [k for k, (kind, _) in enumerate(log.measured) if kind == "angle"]
        self._speed = [k for k, (kind, _) in enumerate(log.measured) if kind == "speed"]
        self._rows = [rows[name][kind == "speed"] for kind, name in log.measured]
        self.size = len(log.measured)
        still, rng = np.zeros(model.nv), np.random.default_rng(0)
        around = np.array(model.standing_q) + np.vstack([np.zeros(model.nq), 1e-3 * rng.normal(size=(3, model.nq))])
        self._rates = [robot.spanning_rows[name][1].start for _, name in log.measured]
        G = model.explicit_constraint(around, np.broadcast_to(still, (4, model.nv)))[0][:, self._rates]
        self._linear = bool(np.abs(G - G[0]).max() < 1e-12)
        self._G, self._q0 = G[0], model.standing_q
        self._z0 = self._exact(model.standing_q, still)
        self.tell_stretches = bool(np.linalg.matrix_rank(G[0][self._angle]) == model.nv)
        by_angles = G[0][self._angle][:, : self.joints]
        if np.linalg.matrix_rank(by_angles) < self.joints:
            lost = np.abs(np.linalg.svd(by_angles)[2][-1]).argmax()
            raise LogError(f"{log.source}: no column tells where {model.joint_links[lost]} is: expected its angle")

    def _exact(self, q: Array, v: Array) -> Array:
        positions, velocities = self.model.spanning(q, v)
        z = np.empty((*q.shape[:-1], self.size))
        for k, row in enumerate(self._rows):
            z[..., k] = (velocities if k in self._speed else positions)[..., row]
        return z

    def __call__(self, q: Array, v: Array) -> Array:
        """Return what is measured at positions (..., nq) and velocities (..., nv), shape (..., size)."""
        if not self._linear:
            return self._exact(q, v)
        z = np.empty((*q.shape[:-1], self.size))
        z[..., self._angle] = (q - self._q0) @ self._G[self._angle].T
        z[..., self._speed] = v @ self._G[self._speed].T
        return z + self._z0

    def positions(self, z: Array) -> Array:
        """Return positions (W, nq) at which angles are as measured (W, size), least squares.

        Transmissions stretch where encoders of joints and of rotors tell so, else next to nothing.
        """
        share = np.where(np.arange(self.model.nq) < self.joints, 1.0, LEAST_STRETCH)
        still, q = np.zeros((len(z), self.model.nv)), np.tile(self.model.standing_q, (len(z), 1))
        for _ in range(1 if self._linear else 8):
            missing = (z - self(q, still))[:, self._angle]
            if self._linear:
                q += missing @ np.linalg.pinv(self._G[self._angle] * share).T * share
                continue
            G = self.model.explicit_constraint(q, still)[0][:, [self._rates[k] for k in self._angle]]
            q += share * (np.linalg.pinv(G * share) @ missing[..., None])[..., 0]
        return q


class Shots:
    """Simulates windows of a log.

    Args:
        model: The robot as the log has it.
        log: Commands, in the order of the simulator's targets, and measurements.
        figures: What differs from candidate to candidate.
        settings: How to simulate.
    """

    def __init__(self, model: Model, log: Log, figures: Sequence[Figure], settings: Settings) -> None:
        self.model, self.log, self.figures, self.settings = model, log, list(figures), settings
        self.encoders = Encoders(model, log)
        self.parameters = tuple(dict.fromkeys(f.parameter for f in figures if f.kind not in NO_PARAMETERS))
        self.substeps = max(1, round(np.ceil(log.dt / settings.substep - 1e-9)))
        self._sims: dict[int, Simulator] = {}
        order = self._simulator(1).target_names
        angles = [name if kind == "angle" else "" for kind, name in log.measured]
        zeros = [(k, angles.index(f.of)) for k, f in enumerate(figures) if f.kind == OF_ENCODERS]
        self._zeros = np.array(zeros, dtype=np.int64).reshape(-1, 2)
        self._sum = np.vstack([np.zeros(len(order)), np.cumsum(log.commands, axis=0)])  # integral over time, in rows

    def _simulator(self, n: int) -> Simulator:
        if n not in self._sims:
            s = self.settings
            scene = {"control": s.control, "motors": "limited" if self.model.robot.motors else "ideal"}
            fast = {"method": s.method, "num_threads": s.threads, "outputs": (), "contacts": ()}
            step = self.log.dt / self.substeps
            self._sims[n] = Simulator(self.model, n, step, parameters=self.parameters, **scene, **fast)
        return self._sims[n]

    def __call__(self, values: Array, states: Array, first: NDArray[np.int64], length: int) -> Array:
        """Return what encoders would read.

        Args:
            values: Of the figures, for each candidate, shape (C, P).
            states: Positions and velocities at the start of each window, shape (C, W, nq + nv).
            first: Row of the log where each window starts, shape (W,).
            length: Of windows [rows].

        Returns:
            Shape (C, W, length, n_measured).
        """
        return self.run(values, states, first, length)[0]

    def run(self, values: Array, states: Array, first: NDArray[np.int64], length: int) -> tuple[Array, Array]:
        """Return what a call does, and states at the last row, shape (C, W, nq + nv); arguments as there."""
        most = max(1, LARGEST_BATCH // len(values))
        pieces = range(0, len(first), most)
        parts = [self._batch(values, states[:, i : i + most], first[i : i + most], length) for i in pieces]
        read, last = zip(*parts, strict=True)
        return np.concatenate(read, axis=1), np.concatenate(last, axis=1)

    def _batch(self, values: Array, states: Array, first: NDArray[np.int64], length: int) -> tuple[Array, Array]:
        C, W, nq = len(values), len(first), self.model.nq
        sim, steps = self._simulator(C * W), self.substeps
        for name in self.parameters:
            mine = [(k, figure) for k, figure in enumerate(self.figures) if figure.parameter == name]
            column = np.zeros((C, len(self._default(name))))
            column[:] = self._default(name)
            for k, figure in mine:
                column[:, figure.entry] = values[:, k]
            sim.set_parameter(name, np.repeat(column, W, axis=0))
        flat = states.reshape(C * W, -1)
        sim.set_state(flat[:, :nq], flat[:, nq:])
        late = [k for k, figure in enumerate(self.figures) if figure.kind == "delay"]
        delay = np.repeat(values[:, late[0]] if late else np.zeros(C), W) / self.log.dt
        at = np.tile(first, C) - delay
        read, before = [self.encoders(flat[:, :nq], flat[:, nq:])], self._integral(at)
        for k in range((length - 1) * steps):
            after = self._integral(at + (k + 1) / steps)
            sim.step((after - before) * steps)
            before = after
            if (k + 1) % steps == 0:
                read.append(self.encoders(sim.q, sim.v))
        shown = np.stack(read, axis=1).reshape(C, W, length, -1)
        for figure, column in self._zeros:
            shown[..., column] += values[:, figure, None, None]
        return shown, np.hstack([sim.q, sim.v]).reshape(C, W, -1)

    def zeros(self, values: Array) -> Array:
        """Return what encoders read too much at figures (P,), shape (n_measured,)."""
        found = np.zeros(self.encoders.size)
        found[self._zeros[:, 1]] = values[self._zeros[:, 0]]
        return found

    def _default(self, name: str) -> Array:
        return parameter_defaults(self.model.robot, self.model.robot.material, (name,))[name]

    def _integral(self, at: Array) -> Array:
        """Return the integral of the commands up to times (R,), in rows, shape (R, n_commands)."""
        at = np.clip(at, 0.0, len(self._sum) - 1.0)
        row = np.minimum(at.astype(np.int64), len(self._sum) - 2)
        return self._sum[row] + (at - row)[:, None] * (self._sum[row + 1] - self._sum[row])
