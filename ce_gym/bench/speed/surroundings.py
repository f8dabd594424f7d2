"""What scenes cost: spheres that are seldom near, links that push each other apart, height and range scans, in turn.

        "--parts",
        nargs="+",
        default=("spheres", "pairs", *SCANS),
        choices=("spheres", "pairs", *SCANS, "drives", *UNTIMED),

Sub-steps are compared with those on the feet alone, by the same targets; links stand apart, move about, or are pressed
on each other in most robots. Environment steps are compared with those of the same task that does not look.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.measure.processes import Timings, in_processes
from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.bench.measure.timing import Competitor, interleaved, ratio
from ce_gym.bench.speed.drives import Case, drives
from ce_gym.bench.speed.pressed import pressed_together, with_parents
from ce_gym.bench.speed.released import let_go
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.self_contact import distance
from ce_gym.envs.task.tasks import VELOCITY
from ce_gym.model.checks.collisions import capsules_of
from ce_gym.sim import Simulator

DTYPES = ("float64", "float32")
SUBSTEPS = 10
"""For which a target is held."""
TARGETS = 4
SETTLED = 100
"""Sub-steps before what is timed."""
FOLDED_SHARE = 0.7
"""Share of the robots whose links are pressed on each other."""
FURTHER = 2.0
"""How many times as far from standing targets are as where links begin to touch: the ground holds feet back."""
JITTER = 0.2
"""Of targets that move about, either way [rad]."""
MOST = {"spheres": 1.1, "pairs": 1.5, "height_scan": 1.25, "drives": 1.4}
"""How many times as long a step may take; a scan that is 20 % of a step makes it 1.25 times as long as without."""
SCANS: Mapping[str, dict[str, Any]] = {
    "height_scan": {},
    "range_scan": {"position": [0.2, 0.0, 0.05], "rays": [3, 7], "reach": 1.0, "steps": 16},
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robot", default="mini_cheetah", help="name or path of a robot with feet")
    parser.add_argument("--env", default="ce_gym/MiniCheetahVelocity-v0", help="id of an environment of it")
    parser.add_argument(
        "--parts",
        nargs="+",
        default=("spheres", "pairs", *SCANS),
        choices=("spheres", "pairs", *SCANS, "drives", *UNTIMED),
    )
    parser.add_argument("--policy", default="mini_cheetah_velocity", help="that walks in it on elastic drives")
    parser.add_argument("--num-envs", type=int, default=512, help="robots in a batch")
    parser.add_argument("--rounds", type=int, default=100, help="how often each is timed")
    parser.add_argument("--processes", type=int, default=1, help="in how many processes; the fastest counts")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    report, model = Report("surroundings"), Model(arguments.robot)
    for part in [part for part in arguments.parts if part in UNTIMED]:
        found = UNTIMED[part](model)
        report.tables += found.tables
        report.requirements += found.requirements
    if not set(arguments.parts) - set(UNTIMED):
        return report
    rows: list[tuple[Cell, ...]] = []
    for dtype in DTYPES:
        for case, timings in in_processes(partial(timed, arguments, dtype), arguments.processes).items():
            (part, name), compared = case.split(": ", 1), ratio(timings["with"], timings["without"])
            rows.append((name, dtype, 1e6 * timings["without"].best, compared.of_best, compared.median))
            if part in MOST:
                claim = f"{name}, {dtype}: at most {MOST[part]} times as long"
                report.requirements.append(Requirement(claim, str(compared), compared.cautious <= MOST[part]))
    columns = ("scene", "precision", "step without [us]", "times that, least", "median")
    report.tables.append(Table(f"Steps of {model.robot.name} with more in their scene", columns, tuple(rows)))
    return report


def timed(arguments: argparse.Namespace, dtype: str) -> Timings:
    """Time all cases in one precision; each is called by its part and its name."""
    model, n, cases = Model(arguments.robot), arguments.num_envs, dict[str, Case]()
    if "spheres" in arguments.parts:
        cases |= spheres(model, n, dtype)
    if "pairs" in arguments.parts:
        cases |= pairs(model, n, dtype)
    if "drives" in arguments.parts:
        cases |= drives(model, arguments.env, arguments.policy, n, dtype)
    for scan in [part for part in arguments.parts if part in SCANS]:
        cases[f"{scan}, rough ground"] = (scan, looking(arguments.env, scan, n, dtype))
    clock = time.thread_time
    return {f"{part}: {name}": interleaved(sides, arguments.rounds, clock) for name, (part, sides) in cases.items()}


def spheres(model: Model, num_envs: int, dtype: str) -> dict[str, Case]:
    """All contact spheres, those that are no feet seldom near, standing."""
    groups = sorted({sphere.group for sphere in model.robot.contacts} - {"foot"})
    sims = _beside(model, num_envs, dtype, contacts="all", seldom=groups)
    targets = np.tile(model.standing_q[model.robot.layout.joints_q :], (num_envs, 1))
    name = f"{len(model.robot.contacts)} spheres, seldom near but the feet"
    return {name: ("spheres", {side: stepping(sim, [targets] * TARGETS) for side, sim in sims.items()})}


def pairs(model: Model, num_envs: int, dtype: str) -> dict[str, Case]:
    """Pairs of links that carry feet: apart, apart in motion, and pressed on each other in most robots."""
    beside = neighbours(model)
    standing = np.tile(model.standing_q[model.robot.layout.joints_q :], (num_envs, 1))
    rng, folded = np.random.default_rng(0), [folded_targets(model, pair) for pair in beside]
    standing = np.tile(standing, (TARGETS, 1, 1))
    moving = standing + rng.uniform(-JITTER, JITTER, standing.shape)
    pressed = standing + rng.uniform(-0.02, 0.02, standing.shape)
    for i in np.flatnonzero(rng.uniform(size=num_envs) < FOLDED_SHARE):
        pressed[:, i] += folded[i % len(folded)] - standing[:, i]
    cases: dict[str, Case] = {}
    for name, targets in (("apart", standing), ("apart, in motion", moving), ("70 % folded", pressed)):
        sims = _beside(model, num_envs, dtype, contacts="foot", self_collisions=beside)
        sides = {side: stepping(sim, list(targets)) for side, sim in sims.items()}
        cases[f"feet, {len(beside)} pairs of links, {name}"] = ("pairs", sides)
    return cases


def looking(env: str, scan: str, num_envs: int, dtype: str) -> dict[str, Competitor]:
    """Environments on rough ground with and without a scan."""
    sides: dict[str, Competitor] = {}
    for side, more in (("without", {}), ("with", {scan: SCANS[scan]})):
        seen: dict[str, dict[str, Any]] = {name: {} for name in VELOCITY.observations} | more
        envs = gymnasium.make_vec(env, num_envs, terrain="rough", dtype=dtype, num_threads=1, observations=seen)
        envs.reset(seed=0)
        shape, rng = envs.action_space.shape or (), np.random.default_rng(0)
        actions = rng.uniform(-0.3, 0.3, (8, *shape)).astype(np.float32)
        sides[side] = Competitor(lambda e=envs, a=actions: [e.step(row) for row in a], num_envs * len(actions))
    return sides


def stepping(sim: Simulator, targets: Sequence[NDArray]) -> Competitor:
    """Sub-steps of robots that have settled, with one target after the other."""
    sim.set_state(np.tile(sim.model.standing_q, (sim.num_envs, 1)), np.zeros(sim.model.nv))
    sim.step(targets[0], n_substeps=SETTLED)

    def run() -> None:
        for each in targets:
            sim.step(each, n_substeps=SUBSTEPS)

    return Competitor(run, sim.num_envs * SUBSTEPS * len(targets))


def neighbours(model: Model) -> list[tuple[str, str]]:
    """Return pairs of links with feet that stand next to each other, going round."""
    feet = list(dict.fromkeys(sphere.body for sphere in model.robot.contacts if sphere.group == "foot"))
    positions, _ = model.body_poses(model.standing_q)
    places = np.array([positions[model.body_names.index(link)][:2] for link in feet])
    way = places - places.mean(axis=0)
    ring = [feet[i] for i in np.argsort(np.arctan2(way[:, 1], way[:, 0]))]
    around = list(zip(ring, [*ring[1:], ring[0]], strict=True))
    return around if len(ring) > 2 else around[:1]


def folded_targets(model: Model, pair: Sequence[str]) -> NDArray:
    """Return targets of joints that press two links on each other, from standing along the steepest way."""
    first, one, other = model.robot.layout.joints_q, *(capsules_of(model.robot, link)[0] for link in pair)

    def apart(joints: NDArray) -> float:
        positions, rotations = model.body_poses(np.concatenate([model.standing_q[:first], joints]))
        placed = SimpleNamespace(
            p=dict(zip(model.body_names, positions, strict=True)),
            R=dict(zip(model.body_names, rotations, strict=True)),
        )
        return distance(placed, one, other)  # type: ignore[arg-type]  # poses are all it takes of a stance

    joints = model.standing_q[first:].copy()
    for _ in range(100):
        here = apart(joints)
        if here < 0:
            return model.standing_q[first:] + FURTHER * (joints - model.standing_q[first:])
        slope = np.array([(apart(joints + step) - here) / 1e-4 for step in 1e-4 * np.eye(len(joints))])
        joints = joints - 0.02 * slope / np.abs(slope).max()
    raise ValueError(f"{model.robot.name}: {pair[0]} and {pair[1]} do not meet; expected links that can")


UNTIMED: Mapping[str, Callable[[Model], Report]] = {
    "depth": lambda model: pressed_together(model, with_parents(model, neighbours(model)[:2])),
    "energy": lambda model: let_go(model, neighbours(model)),
}
"""Parts in which nothing is timed."""


def _beside(model: Model, num_envs: int, dtype: str, **scene: Any) -> dict[str, Simulator]:
    """A scene, and the same robots on their feet alone."""
    without = Simulator(model, num_envs, dtype=dtype, num_threads=1, contacts="foot")
    return {"without": without, "with": Simulator(model, num_envs, dtype=dtype, num_threads=1, **scene)}
