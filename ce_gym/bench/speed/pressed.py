"""How deep links that press each other apart are in each other: position control asks them into the same place.

In the air and without gravity, so that what presses is the control of the joints alone, with the robot's own gains and
limits, on contacts of the robot's own stiffness.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.self_contact import distance
from ce_gym.model.checks.collisions import capsules_of
from ce_gym.sim import Simulator

OVERLAPS = (0.005, 0.01, 0.02)
"""How far links would be in each other where their joints are asked to [m]."""
JUDGED, MOST = 0.02, 1e-3
"""At this overlap they may be so deep in each other at rest [m]."""
SETTLED = 600
"""Sub-steps until they are at rest."""
PATIENCE = 1600
"""Steps of 0.005 rad that are made to find a pose in which two links meet."""

Pairs = Sequence[tuple[str, str]]


def pressed_together(model: Model, pairs: Pairs) -> Report:
    """Press each pair on each other, one in each robot, and report how deep they are in each other."""
    report, cases = Report("pressed"), [(pair, overlap) for pair in pairs for overlap in OVERLAPS]
    sim = Simulator(model, len(cases), num_threads=1, contacts=(), self_collisions=list(pairs), parameters=("gravity",))
    sim.set_parameter("gravity", np.zeros(3))
    targets = np.array([folded(model, pair, overlap) for pair, overlap in cases])
    sim.set_state(np.tile(model.standing_q, (len(cases), 1)), np.zeros(model.nv))
    deepest = np.zeros(len(cases))
    for _ in range(SETTLED):
        sim.step(targets, 1)
        now = np.array([depth(model, q, pair) for q, (pair, _) in zip(sim.q, cases, strict=True)])
        deepest = np.maximum(deepest, now)
    rows: list[tuple[Cell, ...]] = []
    for i, (pair, overlap) in enumerate(cases):
        force = float(sim.pair_forces[i, list(sim.pairs).index(pair)])
        figures = 100 * overlap, 1e3 * float(now[i]), 1e3 * float(deepest[i])
        rows.append((f"{pair[0]}, {pair[1]}", *figures, force))
        if overlap == JUDGED and force:  # stops of joints may keep links apart
            claim = (
                f"{pair[0]} and {pair[1]}, asked {100 * overlap:g} cm into each other: at most {1e3 * MOST:g} mm deep"
            )
            report.requirements.append(Requirement(claim, f"{1e3 * now[i]:.2f} mm", bool(now[i] <= MOST)))
    columns = ("links", "asked into each other [cm]", "depth at rest [mm]", "deepest [mm]", "force at rest [N]")
    report.tables.append(Table(f"Links of {model.robot.name} pressed on each other", columns, tuple(rows)))
    return report


def with_parents(model: Model, pairs: Pairs) -> list[tuple[str, str]]:
    """Return pairs of links, and pairs of the links that carry them, if those differ and are capsules."""
    parents = {body.name: body.parent for body in model.robot.bodies}
    above = [(str(parents[one]), str(parents[other])) for one, other in pairs]
    return [*pairs, *[pair for pair in above if pair[0] != pair[1] and all(capsules_of(model.robot, x) for x in pair)]]


def depth(model: Model, q: NDArray, pair: Sequence[str]) -> float:
    """Return how far the first capsules of two links are in each other [m], negative if they are apart."""
    positions, rotations = model.body_poses(q)
    names = model.body_names
    placed = SimpleNamespace(p=dict(zip(names, positions, strict=True)), R=dict(zip(names, rotations, strict=True)))
    one, other = (capsules_of(model.robot, link)[0] for link in pair)
    return -distance(placed, one, other)  # type: ignore[arg-type]  # poses are all it takes of a stance


def folded(model: Model, pair: Sequence[str], overlap: float) -> NDArray:
    """Return targets of joints at which two links are that deep in each other [m], from standing the steepest way.

    Raises:
        ValueError: If there are none near the standing pose.
    """
    first = model.robot.layout.joints_q
    joints = model.standing_q[first:].copy()

    def at(joints: NDArray) -> float:
        return depth(model, np.concatenate([model.standing_q[:first], joints]), pair)

    for _ in range(PATIENCE):
        here = at(joints)
        if here >= overlap:
            return joints
        slope = np.array([(at(joints + step) - here) / 1e-4 for step in 1e-4 * np.eye(len(joints))])
        joints = joints + 0.005 * slope / np.abs(slope).max()
    raise ValueError(f"{model.robot.name}: {pair[0]} and {pair[1]} do not meet; expected links that can")
