"""Simulated logs of a robot under chirps with encoder noise, to plan an identification."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.forces.scene import target_names
from ce_gym.dynamics.model import Model
from ce_gym.identify.base_fixed import base_fixed_model
from ce_gym.identify.log import Log
from ce_gym.identify.parameters import Parameter, select_parameters
from ce_gym.identify.shooting import Shooting
from ce_gym.model import Robot, load_robot
from ce_gym.model.errors import unknown_name

Array = NDArray[np.float64]
ENCODERS = "joints", "rotors", "both"
"""Places of encoders."""


def chirps(n: int, seconds: float, dt: float, low: float = 0.2, high: float = 4.0, period: float = 10.0) -> Array:
    """Return chirps of amplitude 1, a different one for each of n joints.

    Args:
        n: Number of joints.
        seconds: Duration [s].
        dt: Time between rows [s].
        low: Lowest frequency [Hz].
        high: Highest frequency [Hz].
        period: Time from the lowest to the highest frequency [s], or back.

    Returns:
        Shape (T, n).
    """
    t = np.arange(round(seconds / dt)) * dt
    columns = []
    for i in range(n):
        exponent = np.abs((t / period * (1 + 0.13 * (i % 7)) + 0.37 * i) % 2 - 1)
        columns.append(np.sin(2 * np.pi * np.cumsum(low * (high / low) ** exponent) * dt + 1.7 * i))
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
    """Return the simulated log of a robot with a fixed base that follows chirps about the standing pose.

    Args:
        robot: A description, a name or a path.
        seconds: Duration of the log [s].
        dt: Time between rows [s].
        amplitude: Amplitude of the chirps [rad, m, N m or N].
        control: "position" or "torque" for joints, "motor_position" or "motor_torque" for motors.
        transmission: Transmission level.
        planted: True parameters by name, such as {"rotor_inertia:HR_hip_rotor": 1.3, "delay": 0.004}.
        noise: Standard deviation of the encoder noise [rad or m].
        resolution: Resolution of the encoders [rad or m]; 0 for none.
        substep: Sub-step of the simulation [s], shorter than in the identification.
        high: Highest frequency [Hz].
        seed: Seed of the noise.
        encoders: "joints", "rotors" or "both".
    """
    described = robot if isinstance(robot, Robot) else load_robot(robot)
    model = base_fixed_model(described, [body.name for body in described.bodies], transmission)
    names = target_names(model.mechanism, control)  # type: ignore[arg-type]
    commands = amplitude * chirps(len(names), seconds, dt, high=high)
    if control == "position":
        commands += model.standing_q[: len(names)]
    elif control == "motor_position":
        q_span = model.spanning(model.standing_q, np.zeros(model.nv))[0]
        commands += q_span[[model.robot.spanning_rows[name][0].start for name in names]]
    measured = encoders_at(model, encoders)
    log = Log(dt, names, commands, measured, np.zeros((len(commands), len(measured))), "simulated log")
    parameters = _planted_parameters(model.robot, planted or {}, measured)
    shooting = Shooting(model, log, parameters, substep, control=control)
    values, state = np.array([[p.start for p in parameters]]), np.r_[model.standing_q, np.zeros(model.nv)]
    exact = shooting(values, state[None, None], np.array([0]), len(commands))[0][0, 0]
    readings = exact + np.random.default_rng(seed).normal(0.0, noise, exact.shape)
    if resolution:
        readings = np.round(readings / resolution) * resolution
    return replace(log, values=readings)


def encoders_at(model: Model, where: str) -> tuple[tuple[str, str], ...]:
    """Return the measurements of encoders at `ENCODERS`, as `Log.measured`."""
    if where not in ENCODERS:
        raise unknown_name("simulate_log", "encoders", where, ENCODERS, "a place of encoders")
    rotors = tuple(rotor.name for rotor in model.robot.rotors())
    names = {"joints": model.joint_links, "rotors": rotors, "both": (*model.joint_links, *rotors)}[where]
    return tuple(("angle", name) for name in names)


def _planted_parameters(
    robot: Robot, planted: Mapping[str, float], measured: Sequence[tuple[str, str]]
) -> list[Parameter]:
    kinds = tuple(dict.fromkeys(name.split(":")[0] for name in planted))
    parameters = select_parameters(robot, kinds, measured=measured) if kinds else []
    by_name = {parameter.name: parameter for parameter in parameters}
    for name in planted:
        if name not in by_name:
            raise unknown_name("simulate_log", "planted", name, by_name, "the name of a parameter")
    return [replace(by_name[name], start=value) for name, value in planted.items()]
