"""Gradients through contact: how far they are from the slope of what was smoothed, and how much they scatter.

Robots that land and slide are asked for joint targets shifted by `x` along a random direction; `J(x)` is their forward
velocity some time later. With x from a normal distribution of width `sigma`, the slope of the mean of J has two
formulas (Suh et al. 2022, arXiv:2202.00817),

    E[J'(x)]      with the gradients of `StepDerivatives`,
    E[J(x) x] / sigma^2      with values only,

which agree unless J jumps. Both are integrals over one variable, taken on a fine grid, so that neither is a draw.
"""

from __future__ import annotations

import argparse
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.measure.report import Report, Table
from ce_gym.dynamics.model import Model
from ce_gym.sim.derivatives import StepDerivatives
from ce_gym.sim.simulator import Simulator
from ce_gym.viewer.console import shown

STARTS, POINTS = 8, 129
"""Different robots, and places x of each, up to four times the width either way."""
SIGMA = 0.05
"""Width of the shift of joint targets [rad]."""
PARAMETERS = ("stiffness", "damping", "friction")
"""Of the contacts, as factors of the robot's own."""
COLUMNS = ("bias [%]", "scatter, gradient [%]", "scatter, differences [%]")


@dataclass(frozen=True)
class Case:
    """Length of a sub-step [s], horizon [s], and factors of `PARAMETERS`."""

    dt: float = 0.005
    horizon: float = 0.1
    stiffness: float = 1.0
    damping: float = 1.0
    friction: float = 1.0


CASES = (
    Case(), Case(dt=0.001), Case(dt=0.01), Case(horizon=0.05), Case(horizon=0.2), Case(horizon=0.4),
    Case(stiffness=0.1), Case(stiffness=10.0), Case(damping=0.1), Case(damping=0.0), Case(friction=0.0),
    Case(damping=0.0, friction=0.0),
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robot", default="mini_cheetah", help="name or file of a robot with feet")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="also draw J and its gradients")


class Landing:
    """Robots that land: one start in `POINTS` copies each, targets shifted along a direction of its own.

    Args:
        robot: Name or file.

    Attributes:
        x: Shifts [rad], shape (POINTS,).
    """

    def __init__(self, robot: str) -> None:
        self.model, self.x = Model(robot), SIGMA * np.linspace(-4, 4, POINTS)
        rng, n = np.random.default_rng(0), len(self.model.joint_links)
        q, v = np.tile(self.model.standing_q, (STARTS, 1)), rng.normal(0, 0.3, (STARTS, self.model.nv))
        q[:, 7:] += rng.normal(0, 0.1, (STARTS, n))
        q[:, 2] += rng.uniform(0, 0.03, STARTS)
        v[:, 3] += 0.5
        direction = rng.normal(size=(STARTS, n))
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        self.direction = np.repeat(direction, POINTS, axis=0)
        target = self.model.standing_q[7:] + rng.normal(0, 0.1, (STARTS, n))
        self.target = np.repeat(target, POINTS, axis=0) + np.tile(self.x, STARTS)[:, None] * self.direction
        self.start = np.repeat(q, POINTS, axis=0), np.repeat(v, POINTS, axis=0)

    def __call__(self, case: Case) -> tuple[NDArray, NDArray]:
        """Return J [m/s] and its gradient [m/s/rad], shape (STARTS, POINTS) each."""
        n, material = len(self.target), self.model.robot.material
        sim = Simulator(self.model, n, case.dt, contacts="foot", parameters=PARAMETERS, outputs=(), num_threads=1)
        for name in PARAMETERS:
            sim.set_parameter(name, getattr(case, name) * getattr(material, name))
        sim.set_state(*self.start)
        derivatives = StepDerivatives(sim)
        derivatives.step(self.target, round(case.horizon / case.dt))
        value = sim.v[:, 3]
        by_value = np.zeros_like(sim.v)
        by_value[:, 3] = 1.0
        _, targets, _ = derivatives.backward({"v": by_value})
        slope = (sum(targets) * self.direction).sum(axis=1)
        return value.reshape(STARTS, POINTS), slope.reshape(STARTS, POINTS)


def judged(x: NDArray, value: NDArray, slope: NDArray) -> tuple[float, float, float]:
    """Return the bias of the mean gradient, and how single gradients and single differences scatter about it.

    Relative to the slope of the smoothed objective, root mean squares over starts; a difference is
    `(J(x) - J(-x)) x / (2 sigma^2)`.
    """
    density = np.exp(-((x / SIGMA) ** 2) / 2)
    density /= density.sum()
    difference = (value - value[:, ::-1]) * x / (2 * SIGMA**2)
    first, zeroth = slope @ density, difference @ density
    scale = np.sqrt(np.mean(zeroth**2))
    around = [e - (e @ density)[:, None] for e in (slope, difference)]
    scatter = [np.sqrt(np.mean(e**2 @ density)) / scale for e in around]
    return float(np.sqrt(np.mean((first - zeroth) ** 2)) / scale), float(scatter[0]), float(scatter[1])


def run(arguments: argparse.Namespace) -> Report:
    """Change one figure at a time."""
    landing, rows, curves = Landing(arguments.robot), [], {}
    for case in shown(CASES, "gradients"):
        curves[case] = landing(case)
        rows.append((*astuple(case), *(round(100 * figure, 1) for figure in judged(landing.x, *curves[case]))))
    columns = (*(field.name for field in fields(Case)), *COLUMNS)
    if arguments.plot:
        draw(landing.x, {_title(case): curve for case, curve in curves.items()}, arguments.plot)
    return Report("gradients", tables=[Table(f"Gradients through contact, {arguments.robot}", columns, tuple(rows))])


def _title(case: Case) -> str:
    changed = [f"{f.name} {getattr(case, f.name):g}" for f in fields(Case) if getattr(case, f.name) != f.default]
    return ", ".join(changed) or "as it is"


DRAWN = ("as it is", "damping 0.1", "damping 0, friction 0")
"""Cases of the picture, by their titles."""


def draw(x: NDArray, curves: dict[str, Any], file: Path) -> None:
    """Draw J and its gradients of the first start, one column for each case."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    curves = {title: curve for title, curve in curves.items() if title in DRAWN}
    size = {"figsize": (3.6 * len(curves), 5), "layout": "constrained"}
    figure, axes = plt.subplots(2, len(curves), sharex=True, squeeze=False, **size)
    for column, (title, (value, slope)) in enumerate(curves.items()):
        above, below = axes[:, column]
        above.plot(x, value[0])
        below.plot(x, slope[0], ".", markersize=3, label="gradient")
        below.plot(x, np.gradient(value[0], x), linewidth=0.8, label="difference of neighbours")
        above.set_title(title)
        below.set_xlabel("shift of targets [rad]")
    axes[0, 0].set_ylabel("forward velocity [m/s]")
    axes[1, 0].set_ylabel("its slope [m/s/rad]")
    axes[1, 0].legend()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=110)
    plt.close(figure)
