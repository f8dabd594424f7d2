"""Study of contacts: impulse and peak force of a landing at every level, beside the rigid limit."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.exactness.mechanisms import on_soles
from ce_gym.bench.exactness.protocol import (
    CONTACT_STEP,
    FALL,
    FEET,
    INERTIAS,
    LOSS_TIME,
    RATIOS,
    STIFFNESSES,
    WINDOW,
    Array,
)
from ce_gym.bench.exactness.scaling import scaled
from ce_gym.bench.exactness.tables import table
from ce_gym.bench.measure.report import Cell, Report, Requirement
from ce_gym.dynamics.model import Model
from ce_gym.model.mechanism import LEVELS
from ce_gym.sim.simulator import Simulator
from ce_gym.viewer.console import shown

COLUMNS = (
    "robot", "level", "ratio", "inertia", "stiffness [N/m]", "impulse [N s]", "rigid limit [N s]", "over rigid",
    "over rigid, motors free",
    "impulse over exact", "peak force [N]", "peak over exact", "root of effective mass over exact", "momentum error",
)  # fmt: skip
DESIGNS = tuple(product(RATIOS, INERTIAS))
BAR, BALANCE = 0.01, 1e-3
"""How near the impulse has to come to the rigid limit on the stiffest ground, and momentum to its balance."""


@dataclass(frozen=True)
class Landing:
    """What a landing does, each of shape (n_designs,).

    Attributes:
        impulse: Of all feet up to the end of compression [N s].
        peak: Highest total force [N].
        imbalance: Change of vertical momentum less impulse and weight, over the impulse, at the end.
        compressed: Whether every foot came to a stop.
    """

    impulse: Array
    peak: Array
    imbalance: Array
    compressed: NDArray[np.bool_]


class Faller:
    """A robot at one level, in every design at a time.

    Args:
        name: Of the robot.
        level: Transmission level.
        step: [s].
        control: "position" holds the standing pose, "torque" lets go of it.
    """

    def __init__(self, name: str, level: str, step: float = CONTACT_STEP, control: str = "position") -> None:
        self.level, robot = level, on_soles(name)
        self.models = {one: Model(robot, one) for one in LEVELS}
        self.model = self.models[level]
        smooth = replace(robot.material, friction=0.0, bristle=0.0)
        known = {"contacts": "all", "material": smooth, "normal_law": "kelvin_voigt", "outputs": ("contact_forces",)}
        self.target = self.model.standing_q[7:] * (control == "position")
        self.ratio, self.inertia = np.array(DESIGNS).T[..., None]
        designs = {"ratio": self.ratio, "rotor_inertia": self.inertia} if level != "none" else {}
        known["parameters"] = (*designs, "stiffness", "damping")
        self.sim = Simulator(self.model, len(DESIGNS), step, control=control, **known)
        for parameter, value in designs.items():
            self.sim.set_parameter(parameter, value)

    def mass_matrix(self, q: Array) -> Array:
        """Return the mass matrix of every design, shape (n_designs, nv, nv); q of shape (n_designs, nq)."""
        of_levels = {level: model.mass_matrix(q) for level, model in self.models.items()}
        return scaled(self.level, of_levels, self.ratio[..., None], self.inertia[..., None])

    def rigid_impulse(self) -> Array:
        """Return the impulse of each foot that stops them all at once, shape (n_designs, n_feet) [N s]."""
        q = np.tile(self.model.standing_q, (len(DESIGNS), 1))
        J = feet_jacobian(self.model, self.model.standing_q)
        yielding = J @ np.linalg.solve(self.mass_matrix(q), np.broadcast_to(J.T, (len(q), *J.T.shape)))
        unit = np.full((len(q), len(J), 1), FALL)
        return np.asarray(np.linalg.solve(yielding, unit), dtype=float)[..., 0]

    def land(self, stiffness: float, damping: float) -> Landing:
        """Fall on a ground."""
        sim, model = self.sim, self.model
        sim.set_parameter("stiffness", stiffness)
        sim.set_parameter("damping", damping)
        q = model.standing_q.copy()
        q[2] -= lowest(model, q)
        v = np.zeros(model.nv)
        v[5] = -FALL
        sim.set_state(q, v)
        before = self._momentum()
        n = round(WINDOW * np.sqrt(STIFFNESSES[0] / stiffness) / sim.dt)
        force, qs, vs = (np.empty((n, *x.shape)) for x in (sim.q[:, 0], sim.q, sim.v))
        for i in range(n):
            sim.step(self.target)
            force[i] = sim.contact_forces[..., 2].sum(-1)
            qs[i], vs[i] = sim.q, sim.v
        stopped = np.logical_or.accumulate(model.contact_points(qs, vs)[1][..., 2] >= 0, axis=0).all(-1)
        last = np.where(stopped.any(0), stopped.argmax(0), n - 1)
        gathered = np.cumsum(force, axis=0) * sim.dt
        impulse = gathered[last, np.arange(len(DESIGNS))]
        weight = model.total_mass * 9.81 * n * sim.dt
        imbalance = (self._momentum() - before - gathered[-1] + weight) / gathered[-1]
        return Landing(impulse, force.max(0), imbalance, np.asarray(stopped.any(0)))

    def _momentum(self) -> Array:
        """Return the vertical momentum [N s]; the base has not turned much, but its axes have."""
        q, v = self.sim.q, self.sim.v
        momentum = np.einsum("nij,nj->ni", self.mass_matrix(q), v)[:, 3:6]
        w, x, y, z = q[:, 3:7].T
        up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)], axis=-1)
        return (up * momentum).sum(-1)


def feet_jacobian(model: Model, q: Array) -> Array:
    """Return the Jacobian of the feet's heights, shape (n_feet, nv)."""
    unit = np.eye(model.nv)
    return model.contact_points(np.tile(q, (model.nv, 1)), unit)[1][..., 2].T


def lowest(model: Model, q: Array) -> float:
    """Return how high the lowest foot is above the ground [m]."""
    radii = np.array([contact.radius for contact in model.robot.contacts])
    return float((model.contact_points(q, np.zeros(model.nv))[0][:, 2] - radii).min())


def run(arguments: argparse.Namespace, out: Path) -> Report:
    """Run the study and write its table; `quick` takes one robot, two levels and the two stiffest grounds."""
    robots = ("mini_cheetah",) if arguments.quick else tuple(FEET)
    rows: list[tuple[Cell, ...]] = []
    for name in robots:
        levels = ("exact", "armature") if arguments.quick else LEVELS
        rows += _rows(name, levels, STIFFNESSES[-2:] if arguments.quick else STIFFNESSES)
    landings = table("Landings", COLUMNS, rows)
    landings.write_csv(out / "contacts.csv")
    report = Report(
        "exactness contacts", [replace(landings, rows=tuple(r for r in landings.rows if r[2] == r[3] == 1.0))]
    )
    report.requirements += _requirements(rows)
    if not arguments.quick:
        from ce_gym.bench.exactness import plots

        report.remarks.append(_halved())
        plots.contacts(landings, out)
    return report


def _rows(name: str, levels: tuple[str, ...], stiffnesses: tuple[float, ...]) -> list[tuple[Cell, ...]]:
    """Return the rows of one robot, exact first, so that all others have their reference."""
    rows: list[tuple[Cell, ...]] = []
    exact: dict[float, tuple[Array, Array, Array]] = {}
    for level in shown(levels, name):
        faller = Faller(name, level)
        free = Faller(name, level, control="torque")
        rigid = faller.rigid_impulse()
        if (rigid <= 0).any():
            raise RuntimeError(f"{name}, {level}: a foot would have to pull; expected a landing on all feet")
        whole = rigid.sum(-1)
        for k in stiffnesses:
            struck, sprung, loose = faller.land(k, LOSS_TIME * k), faller.land(k, 0.0), free.land(k, LOSS_TIME * k)
            reference = exact.setdefault(k, (struck.impulse, sprung.peak, whole))
            figures = (
                struck.impulse, whole, struck.impulse / whole, loose.impulse / whole, struck.impulse / reference[0],
                sprung.peak,
                sprung.peak / reference[1], np.sqrt(whole / reference[2]),
                np.maximum(np.abs(struck.imbalance), np.abs(loose.imbalance)),
            )  # fmt: skip
            for i, (ratio, inertia) in enumerate(DESIGNS):
                rows.append((name, level, ratio, inertia, k, *(float(x[i]) for x in figures)))
    return rows


def _requirements(rows: list[tuple[Cell, ...]]) -> list[Requirement]:
    own = [r for r in rows if r[2] == r[3] == 1.0 and r[4] == STIFFNESSES[-1]]
    held, free = (max(abs(float(r[i]) - 1) for r in own) for i in (7, 8))  # type: ignore[arg-type]
    balance = max(float(r[13]) for r in rows)  # type: ignore[arg-type]
    claim = f"impulse within {BAR:.0%} of the rigid limit at 5e7 N/m"
    return [
        Requirement(f"{claim}, motors hold the pose", f"{held:.2%} at most", held <= BAR),
        Requirement(f"{claim}, motors free", f"{free:.2%} at most", free <= BAR),
        Requirement(f"momentum balanced to {BALANCE:.1%}", f"{balance:.2e} at most", balance <= BALANCE),
    ]


def _halved() -> str:
    """Make a row again at half the step, and say what that changes."""
    own, k = DESIGNS.index((1.0, 1.0)), STIFFNESSES[-2]
    pair = [Faller("mini_cheetah", "exact", step) for step in (CONTACT_STEP, CONTACT_STEP / 2)]
    impulses, peaks = zip(
        *((f.land(k, LOSS_TIME * k).impulse[own], f.land(k, 0.0).peak[own]) for f in pair), strict=True
    )
    changes = (impulses[1] / impulses[0] - 1, peaks[1] / peaks[0] - 1)
    return f"Half the step, mini_cheetah, exact, {k:.0e} N/m: impulse {changes[0]:+.1e}, peak force {changes[1]:+.1e}"
