"""Friction laws side by side: breakaway, slide, reversal, incline, ten minutes of standing, and what they cost.

A block of 10 kg on four corners, friction coefficient 0.5, against a rigid one under Coulomb's law; and a robot that
stands. Forces on the block are a tilted gravity, which pushes at its centre of mass; its position is that of its sole.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ce_gym.bench.measure.report import Report, Requirement, Table
from ce_gym.dynamics.model import Model
from ce_gym.model import Body, ContactMaterial, ContactSphere, Inertial, Joint, Placement, Robot, load_robot
from ce_gym.model.frames import Mat3
from ce_gym.sim import Simulator

MASS, SIZE, MU, G = 10.0, (0.2, 0.2, 0.1), 0.5, 9.81
LAWS = (
    ("secant, no bristle, 1 cm/s", "secant", 1e-2, 0.0),
    ("secant, no bristle, 1 mm/s", "secant", 1e-3, 0.0),
    ("tangent, no bristle, 1 mm/s", "tangent", 1e-3, 0.0),
    ("secant, bristle, 1 cm/s", "secant", 1e-2, 5e4),
    ("secant, bristle, 1 mm/s", "secant", 1e-3, 5e4),
    ("tangent, bristle, 1 cm/s", "tangent", 1e-2, 5e4),
    ("tangent, bristle, 1 mm/s (default)", "tangent", 1e-3, 5e4),
)
PUSH, PUSH_TIME = 1.2, 0.1
"""Breakaway: this share of the cone, for this long [s]."""
BACK_AND_FORTH, FREQUENCY = 1.5, 2.0
"""Reversal: amplitude as a share of the cone, and frequency [Hz], for one period."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the benchmark."""
    parser.add_argument("--dt", type=float, default=0.004, metavar="S", help="length of a sub-step [s], default 0.004")
    parser.add_argument("--robot", default="mini_cheetah", metavar="NAME", help="the robot that stands")


def block(material: ContactMaterial) -> Robot:
    """Return a free box with a contact point at each lower corner."""
    a, b, c = SIZE
    inertia = np.diag([b * b + c * c, a * a + c * c, a * a + b * b]) * MASS / 12
    tensor: Mat3 = tuple(tuple(float(x) for x in row) for row in inertia)  # type: ignore[assignment]
    body = Body("block", "link", None, Placement(), Joint("free"), Inertial(MASS, (0.0, 0.0, c / 2), tensor))
    corners = [(x * a / 2, y * b / 2, 0.0) for x, y in product((1, -1), repeat=2)]
    spheres = tuple(ContactSphere(f"corner_{i}", "block", corner, 0.0) for i, corner in enumerate(corners))
    return Robot("block", (body,), contacts=spheres, material=material)


@dataclass
class Slider:
    """The block, pushed along x."""

    friction: str
    material: ContactMaterial
    dt: float

    def __post_init__(self) -> None:
        model = Model(block(self.material))
        self.sim = Simulator(
            model, dt=self.dt, control="torque", friction=self.friction, parameters=("gravity",), outputs=()
        )

    def run(self, push: Callable[[float], float], duration: float, speed: float = 0.0) -> np.ndarray:
        """Return the block's x over time [m] under a push [N], from rest depth, at an initial speed [m/s]."""
        q, v = np.zeros(7), np.zeros(6)
        q[2], q[3] = -MASS * G / 4 / self.material.stiffness, 1.0
        v[3] = speed
        self.sim.set_state(q, v)
        path = [0.0]
        for i in range(round(duration / self.dt)):
            self.sim.set_parameter("gravity", [push((i + 1) * self.dt) / MASS, 0.0, -G])
            self.sim.step(np.zeros(0))
            path.append(float(self.sim.q[0, 0]))
        return np.array(path)


def reversal_exact(n: int, fine: int = 500) -> np.ndarray:
    """Return the path of a rigid block over one period of the push, by a fine integration of Coulomb's law [m].

    Args:
        n: Steps of the path, shape (n + 1,).
        fine: Parts that each step is integrated in.
    """
    dt, x, v = 1 / FREQUENCY / n / fine, 0.0, 0.0
    cone, path = MU * G, [0.0]
    for i in range(n * fine):
        if i % fine == 0 and i:
            path.append(x)
        drive = BACK_AND_FORTH * cone * np.sin(2 * np.pi * FREQUENCY * (i + 0.5) * dt)
        if v == 0.0 and abs(drive) <= cone:
            continue
        direction = np.sign(v) if v != 0.0 else np.sign(drive)
        new = v + dt * (drive - direction * cone)
        v = 0.0 if v * new < 0 else new
        x += dt * v
    return np.array([*path, x])


def run(arguments: argparse.Namespace) -> Report:
    """Measure every law."""
    rows, best = [], {}
    expected = reversal_exact(round(1 / FREQUENCY / arguments.dt))
    robot = load_robot(arguments.robot)
    for name, friction, slip_speed, bristle in LAWS:
        material = ContactMaterial(5e4, 300.0, MU, slip_speed, bristle)
        slider, cone = Slider(friction, material, arguments.dt), MU * MASS * G
        breakaway = slider.run(lambda _, cone=cone: PUSH * cone, PUSH_TIME)[-1] / (
            (PUSH - 1) * MU * G * PUSH_TIME**2 / 2
        )
        slide = slider.run(lambda _: 0.0, 0.6, speed=1.0)[-1] / (1 / (2 * MU * G))
        wave = slider.run(lambda t, cone=cone: BACK_AND_FORTH * cone * np.sin(2 * np.pi * FREQUENCY * t), 1 / FREQUENCY)
        incline = slider.run(lambda _, cone=cone: cone / 2, 10.0)
        creep = (incline[-1] - incline[len(incline) // 2]) * 1e3 / 5
        drift, cost = standing(robot, friction, slip_speed, bristle)
        reversal = 100 * np.sqrt(np.mean((wave - expected) ** 2)) / np.ptp(expected)
        row = (name, breakaway, slide, float(reversal), creep, drift * 1e3, cost * 1e6)
        rows.append(row)
        best[name] = row
    default = best[LAWS[-1][0]]
    columns = (
        "law",
        "breakaway / exact",
        "slide / exact",
        "reversal, rms error [% of travel]",
        "creep at half the cone [mm/s]",
        "drift in 10 min [mm]",
        "sub-step [us]",
    )
    requirements = [
        Requirement(
            "breakaway and slide distances within 5 %",
            f"{default[1]:.3f}, {default[2]:.3f}",
            abs(default[1] - 1) <= 0.05 and abs(default[2] - 1) <= 0.05,
        ),
        Requirement("standing drift in 10 minutes <= 1 mm", f"{default[5]:.2g} mm", default[5] <= 1.0),
    ]
    title = f"Friction at dt = {arguments.dt * 1e3:g} ms"
    return Report("friction", tables=[Table(title, columns, tuple(rows))], requirements=requirements)


def standing(robot: Robot, friction: str, slip_speed: float, bristle: float) -> tuple[float, float]:
    """Return how far a standing robot drifts in ten minutes after a minute of settling [m], and a sub-step's time [s].

    It starts 1 cm above the ground, turned a little, so that its feet are pressed against each other.
    """
    material = replace(robot.material, slip_speed=slip_speed, bristle=bristle)
    model, n, dt = Model(robot), 64, 0.005
    sim = Simulator(model, n, dt, contacts="foot", material=material, friction=friction, outputs=())
    rng = np.random.default_rng(0)
    q = np.tile(model.standing_q, (n, 1))
    q[:, 2] += 0.01
    q[:, 7:] += rng.uniform(-0.05, 0.05, (n, q.shape[1] - 7))
    sim.set_state(q, np.zeros(model.nv))
    target = model.standing_q[7:]
    sim.step(target, round(60 / dt))
    before, start, steps = sim.q[:, :2], time.perf_counter(), round(600 / dt)
    sim.step(target, steps)
    elapsed = time.perf_counter() - start
    return float(np.linalg.norm(sim.q[:, :2] - before, axis=1).max()), elapsed / steps / n
