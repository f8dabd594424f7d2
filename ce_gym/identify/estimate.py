"""`identify`: figures of a robot from a log, how well they are known, and what the data cannot tell."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ce_gym.compile.system import usable_cores
from ce_gym.dynamics.forces.scene import target_names
from ce_gym.dynamics.model import Model
from ce_gym.identify.figures import Figure, default_kinds, sought
from ce_gym.identify.fit import Problem, Windows, correlation_time, noise_of, solve
from ce_gym.identify.held import held_model, limbs_of
from ce_gym.identify.log import Log, LogError
from ce_gym.identify.separable import inseparable
from ce_gym.identify.shots import Settings, Shots
from ce_gym.model import Robot, RobotError, load_robot
from ce_gym.model.errors import unknown

Array = NDArray[np.float64]
LARGEST_ANGLE = 12.6
"""Of a joint [rad], two turns: what is larger is in degrees."""
NORMAL_95 = 1.959964
"""95 % of a normal distribution are within so many standard deviations."""


@dataclass(frozen=True)
class Identified:
    """What a log says of a robot.

    Attributes:
        robot: The robot as the log has it, before.
        figures: What was sought.
        values: Estimates, in the units of the figures, shape (P,).
        std: Their standard deviations, shape (P,).
        covariance: Of the estimates, shape (P, P).
        cannot_tell: A line for each direction in which the data say too little.
        noise: Standard deviation of what is left of each measurement, in its unit, shape (n_measured,).
        correlation: By how much correlation of it in time makes variances larger; they are.
        held_out: Root mean square error of each measurement in windows that were not fitted, shape (n_measured,).
        held_out_before: The same with the figures as they were.
        curves: Times [s], measured, simulated before and after, of windows held out, shapes (W, L), (W, L, n) thrice.
        log: The log.
        processor_time: Of all of it [s].
    """

    robot: Robot
    figures: tuple[Figure, ...]
    values: Array
    std: Array
    covariance: Array
    cannot_tell: tuple[str, ...]
    noise: Array
    correlation: float
    held_out: Array
    held_out_before: Array
    curves: tuple[Array, Array, Array, Array]
    log: Log
    processor_time: float

    @property
    def intervals(self) -> Array:
        """95 % confidence intervals, shape (P, 2)."""
        return np.stack([self.values - NORMAL_95 * self.std, self.values + NORMAL_95 * self.std], axis=1)

    def __getitem__(self, name: str) -> float:
        """Return the estimate of a figure by its name."""
        return float(self.values[[figure.name for figure in self.figures].index(name)])


def identify(
    robot: Robot | str | Path,
    log: Log,
    *,
    control: str = "position",
    transmission: str = "exact",
    kinds: Sequence[str] | None = None,
    fixed: Sequence[str] = (),
    window: float = 0.5,
    substep: float = 1e-3,
    method: str = "extrapolated",
    longest_delay: float = 0.03,
    held_out: float = 0.2,
) -> Identified:
    """Estimate figures of a robot from a log of its commands and encoders; the robot hangs in the air, its base held.

    Args:
        robot: A description, a name or a path.
        log: What was commanded and measured.
        control: What commands mean: "position", "torque", "motor_position" or "motor_torque", as for `Simulator`.
        transmission: Level of the simulation; not "elastic".
        kinds: What is sought, some of `ce_gym.identify.figures.KINDS`; by default spin inertia, friction, links'
            moments of inertia and the delay.
        fixed: Names of figures that are known, such as "rotor_inertia:HR_hip_rotor".
        window: Length of the pieces that are simulated from initial states of their own [s].
        substep: Longest sub-step of the simulation [s].
        method: Of stepping, see `Simulator`.
        longest_delay: [s]
        held_out: Share of the log, at its end, that is not fitted.

    Raises:
        LogError: The log does not fit the robot.
        RobotError: There are no such figures or level, or SciPy is missing.

    Source: multiple shooting by Bock 1983; variable projection by Golub and Pereyra 1973.
    """
    began = time.process_time()
    if importlib.util.find_spec("scipy") is None:
        raise RobotError("identify needs SciPy; pip install 'ce_gym[identify]'")
    described = robot if isinstance(robot, Robot) else load_robot(robot)
    _check_names(described, log)
    model = held_model(described, [*log.commanded, *(name for _, name in log.measured)], transmission)
    figures = sought(model.robot, kinds or default_kinds(model.robot), fixed, longest_delay)
    log = _ordered(model, log, control)
    shots = Shots(model, log, figures, Settings(control, substep, method, usable_cores()))
    fitted, kept = _windows(log, window, longest_delay, held_out)
    problem = _problem(shots, fitted, _noise_of_encoders(log))
    scale = problem.scale
    low, high = (np.array([getattr(f, side) for f in figures]) / scale for side in ("low", "high"))
    x = np.array([figure.start for figure in figures]) / scale
    start = x.copy()
    for _ in range(2):  # the second time with the noise that the first one found
        x = solve(problem, x, low, high).x
        problem.noise = np.maximum(noise_of(problem), 1e-12)
        problem.forget()
    J = problem.jacobian(x)
    correlation = correlation_time(problem.residual)
    covariance, lines = inseparable(J, x, figures, correlation)
    covariance = covariance * np.outer(scale, scale)
    curves, errors = _held_out(shots, kept, problem.noise, (start, x))
    std = np.sqrt(np.diag(covariance))
    return Identified(
        robot=described,
        figures=tuple(figures),
        values=x * scale,
        std=std,
        covariance=covariance,
        cannot_tell=lines,
        noise=problem.noise,
        correlation=correlation,
        held_out=errors[1],
        held_out_before=errors[0],
        curves=curves,
        log=log,
        processor_time=time.process_time() - began,
    )


def _check_names(robot: Robot, log: Log) -> None:
    """Refuse names that the robot does not have, and angles that are no joint's in radians or that never change."""
    names = tuple(body.name for body in robot.bodies)
    rotors = {rotor.name for rotor in robot.rotors()}
    for name in (*log.commanded, *(name for _, name in log.measured)):
        if name not in names:
            raise unknown(str(log.source), "column", name, names, "a joint, by the link that it moves, or a rotor")
    for (kind, name), column in zip(log.measured, log.values.T, strict=True):
        if kind == "angle" and name not in rotors and (most := np.abs(column).max()) > LARGEST_ANGLE:
            raise LogError(f"{log.source}: angle:{name}: up to {most:.4g}: expected radians, {LARGEST_ANGLE:g} at most")
    if not np.ptp(log.values, axis=0).any():
        raise LogError(f"{log.source}: nothing that was measured ever changes: expected a robot that moves")


def _ordered(model: Model, log: Log, control: str) -> Log:
    """Return a log with its commands in the order of the simulator's targets."""
    names = target_names(model.mechanism, control)  # type: ignore[arg-type]
    for name in names:
        if name not in log.commanded:
            raise LogError(f"{log.source}: no column command:{name}: expected one for each of {', '.join(names)}")
    for name in log.commanded:
        if name not in names:
            expected = f"a target of {control!r} control: {', '.join(names)}"
            raise LogError(f"{log.source}: column command:{name}: expected {expected}")
    columns = [log.commanded.index(name) for name in names]
    return replace(log, commanded=names, commands=log.commands[:, columns])


def _windows(log: Log, window: float, longest_delay: float, held_out: float) -> tuple[Windows, Windows]:
    """Return windows to fit and windows to judge by, at the end of the log."""
    length, first = max(8, round(window / log.dt)), int(np.ceil(longest_delay / log.dt)) + 1
    starts = np.arange(first, len(log.values) - length, length)
    kept = max(1, round(held_out * len(starts)))
    if len(starts) - kept < 4:
        raise LogError(f"{log.source}: {len(log.values)} rows: expected at least {first + 7 * length} for such windows")
    return Windows(starts[:-kept], length), Windows(starts[-kept:], length)


def _problem(shots: Shots, windows: Windows, noise: Array) -> Problem:
    robot, log = shots.model.robot, shots.log
    limb = limbs_of(robot)
    of_states = [limb[name] for name in robot.independent] * 2
    return Problem(shots, windows, [limb[n] for _, n in log.measured], of_states, _states(shots, windows), noise)


def _states(shots: Shots, windows: Windows) -> Array:
    """Return a first guess of states, shape (W, nq + nv): parabolas through the angles at the start of each window."""
    n = min(windows.length, max(6, round(0.02 / shots.log.dt)))
    rows = windows.first[:, None] + np.arange(n)
    powers = np.vander(np.arange(n) * shots.log.dt, 3, increasing=True)
    fit = np.einsum("pt,wtn->wpn", np.linalg.pinv(powers), shots.log.values[rows])
    q = shots.encoders.positions(fit[:, 0])
    ahead = shots.encoders.positions(fit[:, 0] + 1e-3 * fit[:, 1])
    return np.hstack([q, (ahead - q) / 1e-3])


def _noise_of_encoders(log: Log) -> Array:
    """Return a first guess of noise: what third differences have, of which smooth motion has little."""
    return np.maximum(np.diff(log.values, 3, axis=0).std(axis=0) / np.sqrt(20.0), 1e-9)


def _held_out(
    shots: Shots, windows: Windows, noise: Array, both: Sequence[Array]
) -> tuple[tuple[Array, Array, Array, Array], list[Array]]:
    """Return curves, and errors with the figures before and after; initial states are fitted in either case."""
    read, errors = [], []
    problem = _problem(shots, windows, noise)
    for x in both:
        problem.states = _states(shots, windows)
        for _ in range(4):
            problem._improve_states(x)
        values = (x * problem.scale)[None]
        read.append(shots(values, problem.states[None], windows.first, windows.length)[0])
        errors.append(np.sqrt(((read[-1] - problem.measured) ** 2).mean(axis=(0, 1))))
    times = (windows.first[:, None] + np.arange(windows.length + 1)) * shots.log.dt
    return (times, problem.measured, *read), errors  # type: ignore[return-value]
