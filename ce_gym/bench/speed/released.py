"""Robots whose links are folded into each other, let go: nothing may make their energy more than it was at the start.

In the air, without gravity, motors and damping, so that springs between links, stops of joints and inertia are all
there is. Steps damp; what they may not do is to gain.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.measure.report import Report, Requirement, Table
from ce_gym.bench.speed.pressed import OVERLAPS, depth, folded
from ce_gym.dynamics.model import Model
from ce_gym.sim import Simulator

ROBOTS, STEPS = 256, 10_000
SPEED = 1.0
"""Joints turn at up to so much at the start, either way [rad/s]."""
MOST = 1e-3
"""Largest share by which energy may exceed that of the start."""
NOTHING = ("gravity", "damping", "joint_damping", "joint_friction")
"""Parameters that are 0."""


def let_go(model: Model, pairs: Sequence[tuple[str, str]], steps: int = STEPS) -> Report:
    """Release robots, folded at one pair each, and report the most energy that any of them has after any step."""
    sim = Simulator(
        model, ROBOTS, control="torque", contacts=(), self_collisions=list(pairs), parameters=NOTHING,
        outputs=("energy",), num_threads=1,
    )  # fmt: skip
    for name in NOTHING:
        sim.set_parameter(name, 0.0)
    q, v = folded_states(model, pairs)
    sim.set_state(q, v)
    start = energy(model, q, v, pairs)
    still = np.zeros(len(model.joint_links))
    sim.step(still)
    first = most = sim.energy
    for _ in range(1, steps):
        sim.step(still)
        most = np.maximum(most, sim.energy)
    report, rows, lost = Report("released"), [], np.where(sim.diverged, np.inf, 0.0)
    for when, before in (("the start", start), ("the first step", first)):
        excess = 100 * float(np.max(most / before - 1 + lost))
        rows.append((when, float(before.min()), float(before.max()), excess, float(np.median(sim.energy / before))))
        claim = f"energy at most {100 * MOST:g} % above that of {when}"
        report.requirements.append(Requirement(claim, f"{excess:+.3f} %", excess <= 100 * MOST))
    columns = ("of", "energy, least [J]", "most [J]", "most above that later [%]", "left at the end, median [-]")
    title = f"{ROBOTS} {model.robot.name} with {len(pairs)} pairs of links let go: {steps} steps of {sim.dt:g} s"
    report.tables.append(Table(title, columns, tuple(rows)))
    return report


def folded_states(model: Model, pairs: Sequence[tuple[str, str]]) -> tuple[NDArray, NDArray]:
    """Return positions (n, nq), each with one pair up to 2 cm in each other, and velocities (n, nv) of the joints."""
    poses = [folded(model, pair, overlap) for pair in pairs for overlap in OVERLAPS]
    layout, rng = model.robot.layout, np.random.default_rng(0)
    q, v = np.tile(model.standing_q, (ROBOTS, 1)), np.zeros((ROBOTS, model.nv))
    q[:, layout.joints_q :] = np.resize(poses, (ROBOTS, len(poses[0])))
    v[:, layout.joints_v :] = rng.uniform(-SPEED, SPEED, (ROBOTS, model.nv - layout.joints_v))
    return q, v


def energy(model: Model, q: NDArray, v: NDArray, pairs: Sequence[tuple[str, str]]) -> NDArray:
    """Return kinetic energy and that of the springs between links [J], shape (n,), by the poses."""
    into = np.array([[max(depth(model, row, pair), 0.0) for pair in pairs] for row in q])
    return model.energy(q, v)[0] + 0.5 * model.robot.material.stiffness * np.sum(into**2, axis=1)
