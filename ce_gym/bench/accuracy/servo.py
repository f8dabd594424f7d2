"""A real servo on a pendulum: recorded angles against friction models M1 to M6, as published and fitted here.

Logs and figures are those of github.com/Rhoban/bam (Duclusaud and others, ICRA 2025): files of a servo whose firmware
turns an error of angle into a voltage, with a mass on a rod, processed to steps of 5 ms. Nothing is compared with the
log on the way: a run starts where the log does and goes by its goals alone. Errors are means of the absolute
difference of angles, as the authors give them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ce_gym.bench.measure.report import Cell, Report, Table
from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.model import Body, DriveFriction, Inertial, Joint, LinearConstraint, Motor, Placement, Robot

Array: TypeAlias = NDArray[np.float64]
FIGURES = {
    "kt": 0.4, "R": 3.0, "armature": 0.002, "q_offset": 0.0, "friction_base": 0.01, "friction_viscous": 0.005,
    "friction_stribeck": 0.01, "dtheta_stribeck": 1.0, "alpha": 1.5, "load_friction_motor": 0.1,
    "load_friction_external": 0.1, "load_friction_motor_stribeck": 0.05, "load_friction_external_stribeck": 0.05,
    "load_friction_motor_quad": 0.005, "load_friction_external_quad": 0.005,
}  # fmt: skip
"""What the authors' files call them, in SI units at the output, and where a fit begins."""
SHARED = {"load_friction_base": "load_friction_{}", "load_friction_stribeck": "load_friction_{}_stribeck"}
"""Figures of M3 and M4 that are one for the motor and the load."""
USED = {"m1": 6, "m2": 9, "m5": 13, "m6": 15}
"""How many of `FIGURES` a model has, of those that can be fitted; the others are 0."""
GRAVITY = 9.80665
COUNTS, DIVISOR, PWM_LIMIT = 4096, 256, 885
"""Of the firmware of a Dynamixel XL330: counts of a turn, and what scales its gain to a share of the voltage."""


@dataclass(frozen=True)
class Logs:
    """Logs of equal steps, one column each.

    Attributes:
        dt: Length of a step [s].
        mass, length, gain, volts: Of each [kg, m, -, V], shape (n,).
        goals, angles: [rad], shape (steps, n).
        enabled: Whether the motor is on, shape (steps, n).
    """

    dt: float
    mass: Array
    length: Array
    gain: Array
    volts: Array
    goals: Array
    angles: Array
    enabled: Array

    def only(self, chosen: NDArray[np.bool_]) -> Logs:
        """Return some of them."""
        each = {name: getattr(self, name)[chosen] for name in ("mass", "length", "gain", "volts")}
        return Logs(self.dt, **each, **{n: getattr(self, n)[:, chosen] for n in ("goals", "angles", "enabled")})

    def torque(self, f: Mapping[str, Array], step: int, q: Array, v: Array) -> Array:
        """Return what windings give in a step at angles and speeds [N m]."""
        scale = COUNTS / (2 * np.pi) / (DIVISOR * PWM_LIMIT)
        duty = np.clip((self.goals[step] - q) * self.gain * scale, -1.0, 1.0)
        return f["kt"] / f["R"] * (duty * self.volts - f["kt"] * v) * self.enabled[step]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("logs", type=Path, help="folder of processed logs of an XL330")
    parser.add_argument("figures", type=Path, nargs="+", help="files of published figures, such as m6.json")
    parser.add_argument(
        "--held-out", type=float, nargs="+", default=[200.0, 800.0], help="gains of logs kept from fits"
    )


def run(arguments: argparse.Namespace) -> Report:
    """Measure published figures and figures fitted to the other logs, on the logs that are held out."""
    logs = read_logs(arguments.logs)
    held = np.isin(logs.gain, arguments.held_out)
    rows: list[tuple[Cell, ...]] = []
    for file in arguments.figures:
        published = read_figures(file)
        rows.append((file.stem, "published", *errors(logs, published, held)))
        if file.stem in USED:
            rows.append((file.stem, "fitted here", *errors(logs, fit(logs.only(~held), file.stem), held)))
    columns = (
        "model",
        "figures",
        "held out [mrad]",
        "the rest [mrad]",
        "held out, authors' scheme",
        "the rest, likewise",
    )
    title = f"Mean error of angle, {held.sum()} logs held out of {held.size}, steps of {1e3 * logs.dt:g} ms"
    return Report("servo", [Table(title, columns, tuple(rows))])


def read_logs(folder: Path) -> Logs:
    """Read all logs of a folder, the longest common part of each."""
    read = [json.loads(file.read_text()) for file in sorted(folder.glob("*.json"))]
    if not read:
        raise ValueError(f"{folder} has no logs; expected files of processed logs, *.json")
    steps = min(len(log["entries"]) for log in read)

    def each(name: str) -> Array:
        return np.array([[float(entry[name]) for entry in log["entries"][:steps]] for log in read]).T

    heads = {key: np.array([float(log[name]) for log in read]) for key, name in _HEADS.items()}
    moving = {"goals": each("goal_position"), "angles": each("position"), "enabled": each("torque_enable")}
    return Logs(float(read[0].get("dt", 0.005)), **heads, **moving)


_HEADS = {"mass": "mass", "length": "length", "gain": "kp", "volts": "vin"}


def read_figures(file: Path) -> dict[str, float]:
    """Read published figures; what a model does not have is 0."""
    given = json.loads(file.read_text())
    for name, both in SHARED.items():
        given |= {both.format(side): given[name] for side in ("motor", "external") if name in given}
    return {name: float(given.get(name, float(name in ("dtheta_stribeck", "alpha")))) for name in FIGURES}


def errors(logs: Logs, figures: Mapping[str, float], held: NDArray[np.bool_]) -> tuple[float, ...]:
    """Return mean errors of held out logs and of the others by our step, and both by the authors' scheme [mrad]."""
    found: list[float] = []
    for angles in (by_our_step(logs, figures), by_their_scheme(logs, as_columns([figures]))[:, 0]):
        off = 1e3 * np.abs(angles - logs.angles)
        found += [float(off[:, held].mean()), float(off[:, ~held].mean())]
    return tuple(found)


def as_columns(candidates: Sequence[Mapping[str, float]]) -> dict[str, Array]:
    """Return figures of candidates by name, shape (candidates, 1)."""
    return {name: np.array([[figures[name]] for figures in candidates]) for name in FIGURES}


def by_their_scheme(logs: Logs, f: Mapping[str, Array]) -> Array:
    """Return angles by the authors' scheme, explicit but for stopping, shape (steps, candidates, n_logs)."""
    q, v, angles = logs.angles[0] + 0 * f["kt"], 0 * (logs.angles[0] + f["kt"]), []
    inertia = logs.mass * logs.length**2 + f["armature"]
    for step in range(len(logs.goals)):
        angles.append(q)
        turned = q + f["q_offset"]
        motor, other = logs.torque(f, step, q, v), -logs.mass * GRAVITY * logs.length * np.sin(turned)
        stopping = inertia / logs.dt * v + motor + other
        most = largest_friction(f, motor, other, v) + f["friction_viscous"] * np.abs(v)
        a = (motor + other - np.sign(stopping) * np.minimum(np.abs(stopping), most)) / inertia
        v = v + a * logs.dt
        q = q + v * logs.dt
    return np.array(angles)


def largest_friction(f: Mapping[str, Array], motor: Array, other: Array, v: Array) -> Array:
    """Return the dry friction of M6 [N m]."""
    square = np.where(
        np.abs(motor) > np.abs(other),
        f["load_friction_external_quad"] * other**2,
        f["load_friction_motor_quad"] * motor**2,
    )
    loads = [
        np.abs(f[f"load_friction_external{kind}"] * other - f[f"load_friction_motor{kind}"] * motor)
        for kind in ("", "_stribeck")
    ]
    at_rest = f["friction_stribeck"] + loads[1] + square * (motor * other < 0)
    return f["friction_base"] + loads[0] + at_rest * np.exp(-(np.abs(v / f["dtheta_stribeck"]) ** f["alpha"]))


def by_our_step(logs: Logs, figures: Mapping[str, float]) -> Array:
    """Return angles by steps of this package, shape (steps, n_logs); logs of one mass and length."""
    if np.ptp(logs.mass) or np.ptp(logs.length):
        raise ValueError("logs of several masses or lengths; expected those of one")
    robot = pendulum(float(logs.mass[0]), float(logs.length[0]), figures)
    step = step_function(Model(robot).mechanism, StepOptions(control="torque", motors="limited"))
    n = len(logs.gain)
    many, f = step.map(n), {name: np.array(value) for name, value in figures.items()}
    state = {name: np.zeros((step.size1_in(name), n)) for name in step.name_in() if name in ("q", "v", "carried")}
    state["q"] += logs.angles[0] + figures["q_offset"]
    angles = []
    for i in range(len(logs.goals)):
        angles.append(state["q"][0] - figures["q_offset"])
        torque = logs.torque(f, i, angles[-1], state["v"][0])
        after: Any = many(**state, diverged=0, target=torque, dt=logs.dt)
        state = {name: after[f"{name}_next"].full() for name in state}
    return np.array(angles)


def pendulum(mass: float, length: float, figures: Mapping[str, float]) -> Robot:
    """Return a mass on a rod that a servo turns; ratio 1, so that figures at the output are those of the rotor."""
    f, small, armature = figures, 1e-12, figures["armature"]
    drive = DriveFriction(
        f["friction_stribeck"], f["dtheta_stribeck"], f["alpha"], f["load_friction_motor"],
        f["load_friction_external"], f["load_friction_motor_stribeck"], f["load_friction_external_stribeck"],
        f["load_friction_motor_quad"], f["load_friction_external_quad"],
    )  # fmt: skip
    motor = Motor("rotor", friction=f["friction_base"], damping=f["friction_viscous"], drive_friction=drive)
    hinge = Joint("revolute", (0.0, 1.0, 0.0))
    hanging = Inertial(mass, (0.0, 0.0, -length), ((small, 0, 0), (0, small, 0), (0, 0, small)))
    spinning = Inertial(0.01, (0.0, 0.0, 0.0), ((armature, 0, 0), (0, armature, 0), (0, 0, armature)))
    bodies = (
        Body("rod", "link", None, Placement(), hinge, hanging),
        Body("rotor", "rotor", None, Placement(), hinge, spinning),
    )
    gear = LinearConstraint("gear", (("rotor", 1.0), ("rod", -1.0)))
    return Robot("servo", bodies, (gear,), ("rod",), motors=(motor,), gravity=(0.0, 0.0, -GRAVITY))


def fit(logs: Logs, model: str) -> dict[str, float]:
    """Return figures of a model that fit logs, by least squares of angles with outliers weighing less.

    Figures go by their logarithm, the offset by itself; derivatives are differences, all candidates at once.
    """
    names = [*FIGURES][: USED[model]]
    rest = {name: float(name in ("dtheta_stribeck", "alpha")) for name in FIGURES}

    def figures(x: Array) -> dict[str, float]:
        return rest | {name: x[i] if name == "q_offset" else float(np.exp(x[i])) for i, name in enumerate(names)}

    def residuals(xs: Sequence[Array]) -> Array:
        angles = by_their_scheme(logs, as_columns([figures(x) for x in xs]))
        return (angles - logs.angles[:, None]).transpose(1, 0, 2)[:, ::4].reshape(len(xs), -1)

    def jacobian(x: Array) -> Array:
        h = 1e-5
        ahead = residuals([x, *(x + h * np.eye(len(x)))])
        return (ahead[1:] - ahead[0]).T / h

    start = np.array([FIGURES[name] if name == "q_offset" else np.log(FIGURES[name]) for name in names])
    low, high = start - np.log(1e4), start + np.log(30.0)
    options: dict[str, Any] = {"jac": jacobian, "loss": "soft_l1", "f_scale": 0.03, "max_nfev": 60}
    found = least_squares(lambda x: residuals([x])[0], start, bounds=(low, high), **options)
    return figures(found.x)
