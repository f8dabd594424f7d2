"""Logs to plan with: what a robot in the air would do under chirps, with the noise of its encoders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.forces.scene import target_names
from ce_gym.dynamics.model import Model
from ce_gym.identify.figures import Figure, sought
from ce_gym.identify.held import held_model
from ce_gym.identify.log import Log
from ce_gym.identify.shots import Settings, Shots
from ce_gym.model import Robot, load_robot
from ce_gym.model.errors import unknown_name

Array = NDArray[np.float64]
ENCODERS = "joints", "rotors", "both"
"""Where encoders can be."""


def chirps(n: int, seconds: float, dt: float, low: float = 0.2, high: float = 4.0, period: float = 10.0) -> Array:
    """Return sweeps of frequency, one for each of n joints and different for each, of amplitude 1.

    Args:
        n: Number of joints.
        seconds: How long.
        dt: Time from row to row [s].
        low: Frequency at one end of a sweep [Hz].
        high: At the other [Hz].
        period: Length of a sweep [s]; then it goes back.

    Returns:
        Shape (T, n).
    """
    t = np.arange(round(seconds / dt)) * dt
    columns = []
    for i in range(n):
        place = np.abs((t / period * (1 + 0.13 * (i % 7)) + 0.37 * i) % 2 - 1)
        columns.append(np.sin(2 * np.pi * np.cumsum(low * (high / low) ** place) * dt + 1.7 * i))
    return np.stack(columns, axis=1)


def simulate_log(
    robot: Robot | str | Path,
    seconds: float = 60.0,
    dt: float = 0.005,
    *,
    amplitude: float = 0.3,
    control: str = "position",
    transmission: str = "exact",
    planted: Mapping[str, float] | None = None,
    noise: float = 5e-4,
    resolution: float = 0.0,
    substep: float = 2.5e-4,
    high: float = 6.0,
    seed: int = 0,
    encoders: str = "joints",
) -> Log:
    """Return the log of a robot that hangs in the air and follows chirps, simulated.

    Args:
        robot: A description, a name or a path.
        seconds: Length of the log.
        dt: Time from row to row [s].
        amplitude: Of chirps about the standing pose [rad or m]; of torques if that is what is controlled [N m or N].
        control: "position" or "torque" for joints, "motor_position" or "motor_torque" for motors.
        transmission: Level.
        planted: Figures by name, such as {"rotor_inertia:HR_hip_rotor": 1.3, "delay": 0.004}.
        noise: Of encoders, each where it is [rad or m].
        resolution: Of encoders [rad or m]; 0 for none.
        substep: Of the simulation [s], shorter than one would identify with.
        high: Highest frequency [Hz].
        seed: Of the noise.
        encoders: "joints", "rotors" or "both".
    """
    described = robot if isinstance(robot, Robot) else load_robot(robot)
    model = held_model(described, [body.name for body in described.bodies], transmission)
    names = target_names(model.mechanism, control)  # type: ignore[arg-type]
    commands = amplitude * chirps(len(names), seconds, dt, high=high)
    if control == "position":
        commands += model.standing_q[: len(names)]
    elif control == "motor_position":
        q_span = model.spanning(model.standing_q, np.zeros(model.nv))[0]
        commands += q_span[[model.robot.spanning_rows[name][0].start for name in names]]
    measured = encoders_at(model, encoders)
    log = Log(dt, names, commands, measured, np.zeros((len(commands), len(measured))), "simulated log")
    figures = _planted(model.robot, planted or {}, measured)
    shots = Shots(model, log, figures, Settings(control, substep))
    values, state = np.array([[f.start for f in figures]]), np.r_[model.standing_q, np.zeros(model.nv)][None, None]
    exact = shots(values, state, np.array([0]), len(commands))[0, 0]
    read = exact + np.random.default_rng(seed).normal(0.0, noise, exact.shape)
    read = np.round(read / resolution) * resolution if resolution else read
    return Log(dt, names, commands, measured, read, "simulated log")


def encoders_at(model: Model, where: str) -> tuple[tuple[str, str], ...]:
    """Return what encoders measure, as `Log.measured`.

    Args:
        model: The robot.
        where: One of `ENCODERS`.
    """
    if where not in ENCODERS:
        raise unknown_name("simulate_log", "encoders", where, ENCODERS, "where encoders are")
    rotors = tuple(rotor.name for rotor in model.robot.rotors())
    names = {"joints": model.joint_links, "rotors": rotors, "both": (*model.joint_links, *rotors)}[where]
    return tuple(("angle", name) for name in names)


def _planted(robot: Robot, planted: Mapping[str, float], measured: Sequence[tuple[str, str]]) -> list[Figure]:
    kinds = tuple(dict.fromkeys(name.split(":")[0] for name in planted))
    known = {figure.name: figure for figure in sought(robot, kinds, measured=measured)} if kinds else {}
    for name in planted:
        if name not in known:
            raise unknown_name("simulate_log", "planted", name, known, "the name of a figure")
    return [replace(known[name], start=value) for name, value in planted.items()]
