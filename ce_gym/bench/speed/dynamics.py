# pyright: reportAttributeAccessIssue=false
"""Time of functions of `Model` from Python, from `@njit` code and in batches, beside Pinocchio from Python.

Pinocchio has the robot at level `armature`, as a tree; calls are made in a Python loop, on one core. All sides run
alternately.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import pinocchio as pin  # type: ignore[import-not-found]
from numba import njit

from ce_gym.bench.measure.report import Report, Requirement, Table
from ce_gym.bench.measure.timing import Competitor, interleaved
from ce_gym.bench.peers import pinocchio
from ce_gym.bench.speed import competitors
from ce_gym.dynamics.model import Model
from ce_gym.model import load_robot
from ce_gym.numba import quantity

LEVELS = ("exact", "armature")
CALLS, ROBOTS = 256, 1024
"""Calls for one robot in each round; robots of a batch."""
Pin = Callable[[pin.Model, pin.Data, np.ndarray, np.ndarray, np.ndarray], object]
QUANTITIES: dict[str, tuple[str, Pin]] = {
    "forward dynamics": ("forward_dynamics", pin.aba),
    "inverse dynamics": ("inverse_dynamics", pin.rnea),
    "mass matrix": ("mass_matrix", lambda model, data, q, v, x: pin.crba(model, data, q)),
    "frame Jacobian": (
        "frame_jacobian:{frame}",
        lambda model, data, q, v, x: pin.computeFrameJacobian(
            model, data, q, model.nframes - 1, pin.LOCAL_WORLD_ALIGNED
        ),
    ),
    "centroidal momentum matrix": (
        "centroidal_momentum_matrix",
        lambda model, data, q, v, x: pin.computeCentroidalMap(model, data, q),
    ),
}
"""Name of each quantity in `Model.casadi_function`, and Pinocchio's function."""
LARGEST = {"Python": 5.0, "njit": 1.5, "batch": 0.2}
"""Largest times of forward dynamics for one robot [us]."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robot", default="mini_cheetah", help="name or path of a robot without loops")
    parser.add_argument("--rounds", type=int, default=9, help="how often each side is timed")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    robot = load_robot(arguments.robot)
    peer = pinocchio.load(robot)
    add_frame(peer)
    sides: dict[str, Competitor] = {}
    for level in LEVELS:
        model = Model(robot, level)
        states = [competitors.random_states(model, ROBOTS)[name] for name in ("q", "v", "tau")]
        for what, (name, _) in QUANTITIES.items():
            sides |= {
                f"{what}, {level}, {way}": side for way, side in ours(model, name.format(frame=peer.names[-1]), states)
            }
    sides |= {f"{what}, Pinocchio": theirs(peer, states, call) for what, (_, call) in QUANTITIES.items()}
    best = {name: 1e6 * timing.best for name, timing in interleaved(sides, arguments.rounds, time.thread_time).items()}
    report = Report("dynamics")
    rows = [
        (what, level, *(best[f"{what}, {level}, {way}"] for way in LARGEST), best[f"{what}, Pinocchio"])
        for what in QUANTITIES
        for level in LEVELS
    ]
    columns = ("quantity", "level", "Python [us]", "njit [us]", f"{ROBOTS} robots [us each]", "Pinocchio [us]")
    report.tables.append(Table(f"Dynamics of {robot.name}, double precision", columns, tuple(rows)))
    for way, most in LARGEST.items():
        measured = best[f"forward dynamics, exact, {way}"]
        claim = f"forward dynamics, exact, {way}, at most {most:g} us for one robot"
        report.requirements.append(Requirement(claim, f"{measured:.3g} us", measured <= most))
    return report


def add_frame(peer: pinocchio.Peer) -> None:
    """Add the frame of the last joint, of which the Jacobian is timed."""
    peer.model.addBodyFrame(peer.names[-1], peer.model.njoints - 1, pin.SE3.Identity(), 0)


def ours(model: Model, name: str, states: list[np.ndarray]) -> list[tuple[str, Competitor]]:
    """Return calls for single robots from Python and from `@njit` code, and for a batch from Python."""
    function, n_inputs = quantity(model, name), model.casadi_function(name).n_in()
    batch = states[:n_inputs]
    rows = list(zip(*[array[:CALLS] for array in batch], strict=True))

    def from_python() -> None:
        for row in rows:
            model.evaluate(name, *row)

    @njit
    def of_positions(q, v, tau):
        for k in range(CALLS):
            function(q[k])

    @njit
    def of_all(q, v, tau):
        for k in range(CALLS):
            function(q[k], v[k], tau[k])

    loop = of_positions if n_inputs == 1 else of_all
    return [
        ("Python", Competitor(from_python, CALLS)),
        ("njit", Competitor(lambda: loop(*states), CALLS)),
        ("batch", Competitor(lambda: model.evaluate(name, *batch), ROBOTS)),
    ]


def theirs(peer: pinocchio.Peer, states: list[np.ndarray], call: Pin) -> Competitor:
    """Return calls of a function of Pinocchio for single robots from Python."""
    model, data = peer.model, peer.model.createData()
    rows = [
        (peer.positions(q), peer.velocities(v), peer.velocities(x))
        for q, v, x in zip(*[array[:CALLS] for array in states], strict=True)
    ]

    def from_python() -> None:
        for q, v, x in rows:
            call(model, data, q, v, x)

    return Competitor(from_python, CALLS)
