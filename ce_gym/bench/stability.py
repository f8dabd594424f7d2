"""Drop a robot and let it stand: is it finite, settled and silent, over time steps and ground stiffnesses.

Regularised friction lets a robot creep, so "at rest" is a small speed, not none; chatter is what the velocity still
does from one step to the next.
"""

from __future__ import annotations

import argparse
import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.report import Cell, Report, Requirement, Table
from ce_gym.dynamics.model import Model
from ce_gym.model import load_robot
from ce_gym.sim import Simulator

Array = NDArray[np.float64]

STEPS = (0.0005, 0.001, 0.002, 0.005, 0.01)
STIFFNESSES = (1e4, 1e5, 1e6)
DROP = 0.1
"""How far above the standing pose robots are let go [m]."""

FALL, REST = 4.5, 0.5
"""How long they fall and settle, and how long they are watched [s]; soft gains let a robot sway for seconds."""

LARGEST_SPEED = 0.02
"""Root mean square speed that counts as rest [rad/s and m/s]."""

LARGEST_CHATTER = 1e-3
"""Root mean square change of velocity in a step that counts as silence [rad/s and m/s]."""


@dataclass(frozen=True)
class Outcome:
    """What became of the robots.

    Attributes:
        finite: Whether none diverged.
        height: Lowest base origin at the end, as a fraction of the standing pose's [-].
        rise: Highest base origin, as a fraction of that at the start [-]; more than one is energy from nowhere.
        speed: Root mean square of the velocities at rest [rad/s and m/s].
        chatter: Root mean square of their change in a step [rad/s and m/s].
    """

    finite: bool
    height: float
    rise: float
    speed: float
    chatter: float

    @property
    def stable(self) -> bool:
        """Whether the robots are finite, upright, at rest and silent."""
        quiet = self.speed <= LARGEST_SPEED and self.chatter <= LARGEST_CHATTER
        return self.finite and self.height >= 0.5 and self.rise <= 1.0 + 1e-3 and quiet


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robot", default="mini_cheetah", help="name or path of a robot with a floating base")
    parser.add_argument("--transmission", default="exact", help="transmission level")
    parser.add_argument("--dtype", default="float64", choices=("float64", "float32"))
    parser.add_argument("--contacts", default="all", help='"all", or a group of contact spheres such as "foot"')
    parser.add_argument("--dt", type=float, nargs="+", default=list(STEPS), help="time steps [s]")
    parser.add_argument(
        "--stiffness", type=float, nargs="+", default=list(STIFFNESSES), help="ground stiffnesses [N/m]"
    )


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    model = Model(load_robot(arguments.robot), transmission=arguments.transmission)
    own = model.robot.material
    rows: list[tuple[Cell, ...]] = []
    stable = 0
    for dt in arguments.dt:
        for k in arguments.stiffness:
            material = dataclasses.replace(own, stiffness=k, damping=k * own.damping / own.stiffness)
            sim = Simulator(
                model, num_envs=16, dt=dt, dtype=arguments.dtype, contacts=arguments.contacts, material=material
            )
            o = drop(sim)
            stable += o.stable
            rows.append((1e3 * dt, f"{k:.0e}", o.finite, o.height, o.rise, o.speed, o.chatter, o.stable))
    columns = ("dt [ms]", "k [N/m]", "finite", "height", "rise", "speed at rest", "chatter", "stable")
    title = (
        f"{model.robot.name} {arguments.transmission} {arguments.dtype}, dropped {DROP} m, {FALL + REST} s, 16 robots"
    )
    report = Report("stability", [Table(title, columns, tuple(rows))])
    claim = "drop and stand: finite, settles, no chatter"
    report.requirements.append(Requirement(claim, f"{stable} of {len(rows)} scenes", stable == len(rows)))
    report.remarks.append(
        f"Rest: rms speed <= {LARGEST_SPEED}; silence: rms change in a step <= {LARGEST_CHATTER} (rad/s and m/s). "
        "Height and rise are fractions of the standing and of the starting height. Damping grows with stiffness."
    )
    return report


def drop(sim: Simulator, seed: int = 0) -> Outcome:
    """Let robots fall from random attitudes near the standing pose, which they then hold."""
    model, rng = sim.model, np.random.default_rng(seed)
    q = np.tile(model.standing_q, (sim.num_envs, 1))
    target = q[:, 7:].copy()
    q[:, 2] += DROP
    q[:, 4:7] = rng.uniform(-0.05, 0.05, (sim.num_envs, 3))
    q[:, 3] = np.sqrt(1.0 - np.sum(q[:, 4:7] ** 2, axis=1))
    q[:, 7:] += rng.uniform(-0.1, 0.1, target.shape)
    sim.set_state(q, np.zeros(model.nv))
    rise, chunk = 1.0, max(1, round(0.01 / sim.dt))
    for _ in range(round(FALL / (chunk * sim.dt))):
        sim.step(target, n_substeps=chunk)
        rise = max(rise, float((sim.q[:, 2] / q[:, 2]).max()))
    watched = []
    for _ in range(round(REST / sim.dt)):
        sim.step(target)
        watched.append(sim.v)
    v = np.array(watched, dtype=np.float64)
    height = float(sim.q[:, 2].min()) / model.robot.pose.height
    finite = not bool(sim.diverged.any()) and bool(np.isfinite(v).all())
    return Outcome(finite, height, rise, _rms(v), _rms(np.diff(v, axis=0)))


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))
