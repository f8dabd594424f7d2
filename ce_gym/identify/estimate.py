"""`identify`: figures of a robot from a log, how well they are known, and what the data cannot tell."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ce_gym.compile.system import usable_cores
from ce_gym.dynamics.forces.scene import target_names
from ce_gym.dynamics.model import Model
from ce_gym.identify.figures import default_kinds, sought
from ce_gym.identify.fit import Problem, solve
from ce_gym.identify.found import NORMAL_95, Identified
from ce_gym.identify.held import held_model
from ce_gym.identify.log import Log, LogError
from ce_gym.identify.separable import correlation_time, covariance_of, held_of, hold, known_badly, lines_of
from ce_gym.identify.shots import Settings, Shots
from ce_gym.identify.windows import PARTS, Windows, cut, guesses, noise_of_encoders
from ce_gym.model import Robot, RobotError, load_robot
from ce_gym.model.errors import unknown_name

Array = NDArray[np.float64]
LARGEST_ANGLE = 12.6
"""Of a joint [rad], two turns: what is larger is in degrees."""

ROUNDS, GAIN = 4, 1e-4
"""How often initial states are begun anew at most, and the gain that is worth it again."""
UNFIT = 2.0
"""What is left of a measurement is so many times its noise where figures do not fit."""


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
        transmission: Level of the simulation.
        kinds: What is sought, some of `ce_gym.identify.figures.KINDS`; by default spin inertia, friction, links'
            moments of inertia and the delay; figures of transmissions, too, where they stretch.
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
    wanted = kinds or default_kinds(model.robot, log.measured)
    figures = sought(model.robot, wanted, fixed, longest_delay, log.measured)
    log = _ordered(model, log, control)
    shots = Shots(model, log, figures, Settings(control, substep, method, usable_cores()))
    fitted, kept = cut(log, window, longest_delay, held_out)
    problem, x = _search(shots, fitted)
    free, scale = problem.free, problem.scale[problem.free]
    correlation = correlation_time(problem.residual)
    J = problem.jacobian_of_all(x)
    known = covariance_of(J[:, free], correlation)
    covariance = np.zeros((len(figures), len(figures)))
    covariance[np.ix_(free, free)] = known * np.outer(scale, scale)
    values, std = problem.values(x), np.sqrt(np.diag(covariance))
    held = held_of(J, values / problem.scale, free, figures, correlation)
    ends = {f.name: (v - NORMAL_95 * s, v + NORMAL_95 * s) for f, v, s in zip(figures, values, std, strict=True)}
    before = np.array([figure.start for figure in figures])
    curves, errors = _held_out(shots, kept, problem.noise, (before, values))
    return Identified(
        robot=described,
        figures=tuple(figures),
        values=values,
        std=std,
        covariance=covariance,
        held=tuple(held),
        cannot_tell=(
            *_fits_badly(log, problem.noise),
            *lines_of(held, ends),
            *known_badly(known, x, [figures[i] for i in free]),
        ),
        noise=problem.noise,
        correlation=correlation,
        held_out=errors[1],
        held_out_before=errors[0],
        curves=curves,
        log=log,
        processor_time=time.process_time() - began,
    )


def _search(shots: Shots, windows: Windows) -> tuple[Problem, Array]:
    """Return a problem, whose free figures are those that are not held, and these over their scales as they fit best.

    In short windows errors stay small and so does what friction makes of them, stick or slip: there the search goes
    first, for figures, states and noise to begin with.
    """
    x = np.array([figure.start / figure.scale for figure in shots.figures])
    parts, start = windows.parts(), np.array([figure.start for figure in shots.figures])
    short = Problem(shots, parts, guesses(shots, parts, start), noise_of_encoders(shots.log))
    x = solve(short, x, 1e-3)
    for _ in range(ROUNDS):
        short.weigh(x)
        values = short.values(x)
        if short.begin_anew(x, guesses(shots, parts, values)) < GAIN:
            break
        x = solve(short, x, 1e-4)
    short.weigh(x)
    problem = Problem(shots, windows, short.states[::PARTS], short.noise)
    while True:
        x = solve(problem, x, 1e-6)
        problem.weigh(x)
        figures, correlation = [shots.figures[i] for i in problem.free], correlation_time(problem.residual)
        left, x = hold(problem.jacobian(x), x, figures, correlation)
        if len(left) == len(figures):
            return problem, x
        problem.free = problem.free[left]
        problem.forget()


def _held_out(
    shots: Shots, windows: Windows, noise: Array, both: Sequence[Array]
) -> tuple[tuple[Array, Array, Array, Array], list[Array]]:
    """Return curves, and errors with the figures before and after; initial states are fitted in either case."""
    read, errors = [], []
    for values in both:
        states = guesses(shots, windows.parts(), values)
        for pieces in (windows.parts(), windows):
            problem = Problem(shots, pieces, states, noise)
            problem.improve_states(values / problem.scale, 4)
            states = problem.states[::PARTS]
        read.append(shots(values[None], problem.states[None], windows.first, windows.length)[0])
        errors.append(np.sqrt(((read[-1] - problem.measured) ** 2).mean(axis=(0, 1))))
    times = windows.rows * shots.log.dt
    return (times, problem.measured, *read), errors  # type: ignore[return-value]


def _fits_badly(log: Log, left: Array) -> list[str]:
    """Return a line if what is left of a measurement is much more than its encoder's noise."""
    times = left / noise_of_encoders(log)
    worst = int(times.argmax())
    if times[worst] < UNFIT:
        return []
    why = "the robot has something that is not sought, or the search did not find it; intervals do not hold"
    return [f"what is left of {':'.join(log.measured[worst])} is {times[worst]:.3g} times its noise: {why}"]


def _check_names(robot: Robot, log: Log) -> None:
    """Refuse names that the robot does not have, and angles that are no joint's in radians or that never change."""
    names = tuple(body.name for body in robot.bodies)
    rotors = {rotor.name for rotor in robot.rotors()}
    for name in (*log.commanded, *(name for _, name in log.measured)):
        if name not in names:
            raise unknown_name(str(log.source), "column", name, names, "a joint, by the link that it moves, or a rotor")
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
