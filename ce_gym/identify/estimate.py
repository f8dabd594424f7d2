"""`identify`: estimates of a robot's parameters from a log, with their uncertainty."""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ce_gym.compile.system import usable_cores
from ce_gym.dynamics.forces.scene import target_names
from ce_gym.dynamics.model import Model
from ce_gym.identify.base_fixed import base_fixed_model
from ce_gym.identify.fit import Problem, solve
from ce_gym.identify.identifiability import (
    NORMAL_95,
    Unidentifiable,
    correlation_time,
    covariance_of,
    find_unidentifiable,
    select_identifiable,
    uncertainty_warnings,
    unidentifiable_warnings,
)
from ce_gym.identify.log import Log, LogError
from ce_gym.identify.parameters import default_kinds, select_parameters
from ce_gym.identify.result import Identified
from ce_gym.identify.shooting import METHOD, Shooting
from ce_gym.identify.windows import PARTS, Windows, encoder_noise, guess_states, split_log
from ce_gym.model import Robot, RobotError, load_robot
from ce_gym.model.errors import file_error, unknown_name

Array = NDArray[np.float64]
LARGEST_ANGLE = 12.6
"""Largest angle of a joint [rad], two turns: larger numbers are degrees."""
LARGEST_SPEED = 300.0
"""Largest speed of a joint [rad/s]."""
OVER = 100.0
"""Largest commanded torque of a joint over its largest torque; motors may be commanded more than they give."""
UNITS = {
    "angle": "radians or metres, not degrees",
    "speed": "rad/s or m/s, not degrees or turns",
    "torque": "N m or N, not a thousandth of them",
}
"""Unit of each kind of column of a joint, and units that are mistaken for it."""
RESTARTS, GAIN = 4, 1e-4
"""Largest number of restarts of initial states, and the relative gain that makes another one worthwhile."""
LARGEST_RESIDUAL = 2.0
"""The fit is bad if a residual exceeds the encoder's noise by this factor."""


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
    method: str = METHOD,
    longest_delay: float = 0.03,
    held_out: float = 0.2,
    simulate: type[Shooting] = Shooting,
) -> Identified:
    """Estimate parameters of a robot with a fixed base and its feet in the air, from a log of commands and encoders.

    Args:
        robot: A description, a name or a path.
        log: Commands and measurements.
        control: Meaning of commands: "position", "torque", "motor_position" or "motor_torque", as in `Simulator`.
        transmission: Transmission level of the simulation.
        kinds: Kinds of parameters, some of `ce_gym.identify.parameters.KINDS`. The default is spin inertia, friction,
            moments of inertia of links, delay and, for elastic transmissions, their parameters.
        fixed: Names of known parameters, such as "rotor_inertia:HR_hip_rotor".
        window: Length of the windows, each of which is simulated from its own initial state [s].
        substep: Longest sub-step of the simulation [s].
        method: Time-stepping method, as in `Simulator`.
        longest_delay: Upper bound of the delay [s].
        held_out: Share of the log, at its end, that validates the fit.
        simulate: Class that simulates windows of the log; a subclass can use another simulator.

    Raises:
        LogError: The log does not fit the robot.
        RobotError: There is no such kind, parameter or level, or SciPy is missing.

    Source: multiple shooting by Bock 1983; variable projection by Golub and Pereyra 1973.
    """
    start_time = time.process_time()
    if importlib.util.find_spec("scipy") is None:
        raise RobotError("identify needs SciPy; pip install 'ce_gym[identify]'")
    described = robot if isinstance(robot, Robot) else load_robot(robot)
    log = log.of_links(described.links_by_joint)
    _check_names(described, log)
    _check_units(described, log, control)
    model = base_fixed_model(described, [*log.commanded, *(name for _, name in log.measured)], transmission)
    kinds = kinds or default_kinds(model.robot, log.measured)
    parameters = select_parameters(model.robot, kinds, fixed, longest_delay, log.measured)
    log = _sort_commands(model, log, control)
    options = {"control": control, "method": method, "num_threads": usable_cores()}
    shooting = simulate(model, log, parameters, substep, **options)
    fit_windows, validation_windows = split_log(log, window, longest_delay, held_out)
    problem, x = _fit(shooting, fit_windows)
    values, correlation = problem.values(x), correlation_time(problem.residual)
    covariance, unidentifiable, warnings = _uncertainty(problem, x, correlation)
    curves, errors = _validate(shooting, validation_windows, problem.noise, values)
    return Identified(
        robot=described,
        parameters=tuple(parameters),
        values=values,
        covariance=covariance,
        unidentifiable=tuple(unidentifiable),
        warnings=(*_residual_warnings(log, problem.noise), *warnings),
        noise=problem.noise,
        correlation=correlation,
        held_out=errors[1],
        held_out_before=errors[0],
        curves=curves,
        log=log,
        processor_time=time.process_time() - start_time,
    )


def _fit(shooting: Shooting, windows: Windows) -> tuple[Problem, Array]:
    """Return the problem, with identifiable parameters free, and its solution over scales.

    The search begins with short windows. Their errors stay small, so joints stick and slip as in the log, and they give
    starting values of parameters, states and noise.
    """
    x = np.array([parameter.start / parameter.scale for parameter in shooting.parameters])
    parts, start = windows.parts(), np.array([parameter.start for parameter in shooting.parameters])
    short = Problem(shooting, parts, guess_states(shooting, parts, start), encoder_noise(shooting.log))
    x = solve(short, x, 1e-3)
    for _ in range(RESTARTS):
        short.update_noise(x)
        values = short.values(x)
        if short.restart_states(x, guess_states(shooting, parts, values)) < GAIN:
            break
        x = solve(short, x, 1e-4)
    short.update_noise(x)
    problem = Problem(shooting, windows, short.states[::PARTS], short.noise)
    while True:
        x = solve(problem, x, 1e-6)
        problem.update_noise(x)
        parameters = [shooting.parameters[i] for i in problem.free]
        correlation = correlation_time(problem.residual)
        identifiable, x = select_identifiable(problem.jacobian(x), x, parameters, correlation)
        if len(identifiable) == len(parameters):
            return problem, x
        problem.free = problem.free[identifiable]
        problem.clear_cache()


def _uncertainty(problem: Problem, x: Array, correlation: float) -> tuple[Array, list[Unidentifiable], list[str]]:
    """Return the covariance of all parameters (P, P), unidentifiable parameters, and warnings.

    Args:
        problem: The fitted problem.
        x: Its solution, free parameters over their scales.
        correlation: Factor for the correlation of residuals in time.
    """
    parameters, free, scale = problem.shooting.parameters, problem.free, problem.scale[problem.free]
    J, values = problem.full_jacobian(x), problem.values(x)
    scaled = covariance_of(J[:, free], correlation)
    covariance = np.zeros((len(parameters), len(parameters)))
    covariance[np.ix_(free, free)] = scaled * np.outer(scale, scale)
    margins = NORMAL_95 * np.sqrt(np.diag(covariance))
    intervals = {p.name: (v - m, v + m) for p, v, m in zip(parameters, values, margins, strict=True)}
    unidentifiable = find_unidentifiable(J, values / problem.scale, free, parameters, correlation)
    warnings = unidentifiable_warnings(unidentifiable, intervals)
    warnings += uncertainty_warnings(scaled, x, [parameters[i] for i in free])
    return covariance, unidentifiable, warnings


def _validate(
    shooting: Shooting, windows: Windows, noise: Array, values: Array
) -> tuple[tuple[Array, Array, Array, Array], list[Array]]:
    """Return curves as in `Identified`, and errors before and after; initial states are fitted in either case."""
    start = np.array([parameter.start for parameter in shooting.parameters])
    measured, curves, errors = shooting.log.values[windows.rows], [], []
    for candidate in (start, values):
        states = guess_states(shooting, windows.parts(), candidate)
        for pieces in (windows.parts(), windows):
            problem = Problem(shooting, pieces, states, noise)
            problem.improve_states(candidate / problem.scale, 4)
            states = problem.states[::PARTS]
        readings, _ = shooting(candidate[None], problem.states[None], windows.first, windows.length)
        curves.append(readings[0])
        errors.append(np.sqrt(((curves[-1] - measured) ** 2).mean(axis=(0, 1))))
    return (windows.rows * shooting.log.dt, measured, *curves), errors  # type: ignore[return-value]


def _residual_warnings(log: Log, noise: Array) -> list[str]:
    """Return a line on the worst measurement if its residual is much larger than the noise of its encoder."""
    ratios = noise / encoder_noise(log)
    worst = int(ratios.argmax())
    if ratios[worst] < LARGEST_RESIDUAL:
        return []
    column = ":".join(log.measured[worst])
    reason = "the model lacks a parameter, or the search ended in a local minimum; intervals are not valid"
    return [f"the residual of {column} is {ratios[worst]:.3g} times its noise: {reason}"]


def _check_names(robot: Robot, log: Log) -> None:
    """Check that the robot has all names in a log, and that the robot moves."""
    names = tuple(body.name for body in robot.bodies)
    for name in (*log.commanded, *(name for _, name in log.measured)):
        if name not in names:
            raise unknown_name(str(log.source), "column", name, names, "a joint or a rotor")
    if not np.ptp(log.values, axis=0).any():
        raise file_error(log.source, "all measurements are constant", "a robot that moves", LogError)


def _check_units(robot: Robot, log: Log, control: str) -> None:
    """Check the units of the columns of joints by the sizes of their numbers; rotors may turn far and fast."""
    rotors = {rotor.name for rotor in robot.rotors()}
    commanded = "torque" if control.endswith("torque") else "angle"
    columns = [("command", commanded, name) for name in log.commanded]
    columns += [(kind, kind, name) for kind, name in log.measured]
    for (column, kind, name), values in zip(columns, np.hstack([log.commands, log.values]).T, strict=True):
        if name in rotors:
            continue
        torque = OVER * (robot.body(name).joint.torque or math.inf)
        most = {"angle": LARGEST_ANGLE, "speed": LARGEST_SPEED, "torque": torque}[kind]
        if (largest := np.abs(values).max()) > most:
            expected = f"{UNITS[kind]}, {most:g} at most"
            raise file_error(log.source, f"{column}:{name}: up to {largest:.4g}", expected, LogError)


def _sort_commands(model: Model, log: Log, control: str) -> Log:
    """Return a log with its commands in the order of the simulator's targets."""
    names = target_names(model.mechanism, control)  # type: ignore[arg-type]
    listed = ", ".join(names)
    for name in names:
        if name not in log.commanded:
            raise file_error(log.source, f"no column command:{name}", f"one for each of {listed}", LogError)
    for name in log.commanded:
        if name not in names:
            expected = f"a target of {control!r} control: {listed}"
            raise file_error(log.source, f"column command:{name}", expected, LogError)
    columns = [log.commanded.index(name) for name in names]
    return replace(log, commanded=names, commands=log.commands[:, columns])
