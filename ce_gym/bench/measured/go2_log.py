"""Joint log of a real Go2 identified at two transmission levels and with MuJoCo, by the same optimiser.

The first two thirds of the log are fitted. The last third is replayed from its first state, open loop.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.measure.report import Report, Requirement, Table
from ce_gym.bench.measured.data import interval, load
from ce_gym.bench.measured.go2_peer import PeerShooting
from ce_gym.console import progress
from ce_gym.identify import Identified, Log, Parameter, identify
from ce_gym.identify.base_fixed import base_fixed_model
from ce_gym.identify.shooting import Shooting
from ce_gym.identify.windows import Windows, smoothed_states
from ce_gym.model import Robot, load_robot

Array = NDArray[np.float64]
LEGS, JOINTS = ("FL", "FR", "RL", "RR"), ("hip", "thigh", "calf")
KP, KD = 20.0, 1.5
"""Gains of the position controllers [N m/rad, N m s/rad], as published with the log."""
SUBSTEP = 0.0025
HELD_OUT = 1 / 3
BLOCK = 0.5
"""Length of the blocks of the bootstrap [s]."""
SIMULATIONS: dict[str, tuple[str, type[Shooting]]] = {
    "ce_gym, exact": ("exact", Shooting),
    "ce_gym, armature": ("armature", Shooting),
    "MuJoCo": ("armature", PeerShooting),
}
FRICTION: dict[str, tuple[str, ...]] = {
    "viscous": ("rotor_inertia", "motor_damping", "delay"),
    "viscous and dry": ("rotor_inertia", "motor_damping", "motor_friction", "delay"),
}
"""Kinds of fitted parameters."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark: none."""


def run(arguments: argparse.Namespace) -> Report:
    """Fit all simulations with all friction models."""
    robot, log = go2(), read_go2_log()
    cases = [(friction, name) for friction in FRICTION for name in SIMULATIONS]
    fits = {case: fit(robot, log, *case) for case in progress(cases, "fits")}
    errors = tuple(
        (friction, name, 1e3 * rms(e), limits(e, log.dt), *(1e3 * rms(e[:, j::3]) for j in range(3)))
        for (friction, name), (_, e) in fits.items()
    )
    columns = ("fitted friction", "simulation", "rms [mrad]", "interval", *(f"{joint} [mrad]" for joint in JOINTS))
    best = {name: fits["viscous and dry", name] for name in SIMULATIONS}
    results = {name: result for name, (result, _) in best.items()}
    tables = [Table("Go2 in air, last third of the log", columns, errors), estimates(results)]
    ours, armature, peer = (error for _, error in best.values())
    requirements = [compare("ce_gym at exact is at most that of MuJoCo", ours, peer, log.dt)]
    requirements += [compare("ce_gym at exact is at most that at armature", ours, armature, log.dt)]
    return Report("go2_log", tables, requirements)


def go2() -> Robot:
    """Return the robot with the gains of the log."""
    robot = load_robot("go2")
    names = [f"{leg}_{joint}" for leg in LEGS for joint in JOINTS]
    gains = {"kp": tuple((name, KP) for name in names), "kd": tuple((name, KD) for name in names)}
    return replace(robot, gains=replace(robot.gains, **gains))


def read_go2_log() -> Log:
    """Return the log, its columns named by the links of the robot."""
    data = load("go2_joint_log.npz")
    names = tuple(f"{leg}_{joint}" for leg in LEGS for joint in JOINTS)
    time, position, target = (data[key].astype(np.float64) for key in ("time", "position", "target"))
    dt = float((time[-1] - time[0]) / (len(time) - 1))
    return Log(dt, names, target, tuple(("angle", name) for name in names), position, "go2_joint_log.npz")


def fit(robot: Robot, log: Log, friction: str, name: str) -> tuple[Identified, Array]:
    """Return the estimates of a friction model in a simulation, and the errors of the replay."""
    level, simulate = SIMULATIONS[name]
    options = {"transmission": level, "held_out": HELD_OUT, "substep": SUBSTEP, "simulate": simulate}
    result = identify(robot, log, kinds=FRICTION[friction], **options)  # type: ignore[arg-type]
    return result, replay(robot, log, name, result.parameters, result.values)


def replay(robot: Robot, log: Log, name: str, parameters: Sequence[Parameter], values: Array) -> Array:
    """Return the errors of a simulation of the held-out rows from their first state [rad], shape (T, n_joints)."""
    level, simulate = SIMULATIONS[name]
    shooting = simulate(base_fixed_model(robot, log.commanded, level), log, parameters, SUBSTEP)
    length = round(HELD_OUT * len(log.values))
    window = Windows(np.array([len(log.values) - length]), length)
    readings, _ = shooting(values[None], smoothed_states(shooting, window)[None], window.first, length)
    return readings[0, 0] - log.values[-length:]


def rms(error: Array) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.square(error).mean()))


def blocks(error: Array, dt: float) -> Array:
    """Return mean squares of blocks of rows, shape (n_blocks,)."""
    rows = round(BLOCK / dt)
    n = len(error) // rows
    return np.square(error[: n * rows]).reshape(n, -1).mean(axis=1)


def limits(error: Array, dt: float) -> str:
    """Return the 95 % bootstrap interval of the root mean square over blocks of rows [mrad], as text."""
    low, high = interval(lambda x: 1e3 * np.sqrt(x.mean()), blocks(error, dt))
    return f"{low:.2f} to {high:.2f}"


def compare(claim: str, ours: Array, theirs: Array, dt: float) -> Requirement:
    """Return the comparison of two root mean square errors, with the interval of their ratio."""
    ratio = rms(ours) / rms(theirs)
    low, high = interval(lambda x, y: np.sqrt(x.mean() / y.mean()), blocks(ours, dt), blocks(theirs, dt))
    return Requirement(f"rms error of {claim}", f"ratio {ratio:.3f}, {low:.3f} to {high:.3f}", ratio <= 1.0)


def estimates(results: dict[str, Identified]) -> Table:
    """Return the table of estimates with their 95 % intervals, without parameters that no simulation determines."""
    rows = []
    for k, parameter in enumerate(next(iter(results.values())).parameters):
        values = [(r.values[k], r.intervals[k, 1] - r.values[k]) for r in results.values()]
        if any(margin for _, margin in values):
            cells = (f"{value:.4f} ± {margin:.4f}" if margin else "not identifiable" for value, margin in values)
            rows.append((parameter.name, parameter.unit, *cells))
    return Table("Estimates at the rotors, viscous and dry friction", ("parameter", "unit", *results), tuple(rows))
