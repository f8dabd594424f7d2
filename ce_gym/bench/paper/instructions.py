"""Number of instructions of forward dynamics at each transmission level, compared with the paper's library.

An instruction is one scalar operation of a CasADi function, `Function.n_instructions()`, as in the paper.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.dynamics.model import Model
from ce_gym.model import LinearConstraint, load_robot, robots
from ce_gym.model.mechanism import LEVELS, is_axisymmetric

FUNCTIONS = ("forward_dynamics", "inverse_dynamics", "mass_matrix")
LARGEST_RATIO = {"gears": 1.03, "belts or differentials": 1.10}
"""Largest allowed ratio of instructions, `exact` to `armature`, by kind of transmission."""


@dataclass(frozen=True)
class LibraryCount:
    """Instructions of the paper's C++ library, generalized_rbda at commit 45fa7c4, built with CasADi 3.8.2.

    Counted as in its file Benchmarking/src/approximateBenchmark.cpp.

    Attributes:
        exact: Cluster-tree articulated-body algorithm.
        approximate: Articulated-body algorithm without rotors; None if the library has no such model.
    """

    exact: int
    approximate: int | None


LIBRARY = {
    "mini_cheetah": LibraryCount(11133, 7222),
    "mit_humanoid": LibraryCount(21115, 12334),
    "mit_humanoid_leg": LibraryCount(2931, None),
    "jvrc1": LibraryCount(27534, 14941),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robot", nargs="+", default=[], help="names or paths; without, every robot of the package")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    report = Report("instructions")
    rows: list[tuple[Cell, ...]] = []
    for name in arguments.robot or robots():
        robot = load_robot(name)
        counts = {level: _counts(Model(robot, transmission=level)) for level in LEVELS}
        for level in LEVELS:
            rows.append((robot.name, level, *counts[level], counts[level][0] / counts["armature"][0]))
        if robot.name in LIBRARY:
            library = LIBRARY[robot.name]
            share = library.exact / library.approximate if library.approximate else None
            rows.append((robot.name, "the paper's library", library.exact, None, None, share))
        if not all(is_axisymmetric(rotor) for rotor in robot.rotors()):
            report.remarks.append(f"{robot.name}: not all rotors are symmetric about their axes, so no bar is set.")
            continue
        cost = counts["exact"][0] / counts["armature"][0]
        gears = all(isinstance(c, LinearConstraint) and len(c.bodies) == 2 for c in robot.constraints)
        kind = "gears" if gears else "belts or differentials"
        claim = f"{robot.name} ({kind}): exact / armature, forward dynamics, at most {LARGEST_RATIO[kind]}"
        report.requirements.append(Requirement(claim, f"{cost:.4f}", cost <= LARGEST_RATIO[kind]))
    columns = ("robot", "transmission", *(name.replace("_", " ") for name in FUNCTIONS), "forward / armature")
    report.tables.append(Table("Instructions", columns, tuple(rows)))
    report.remarks.append(
        "The paper's library: generalized_rbda 45fa7c4 with CasADi 3.8.2; its ratio is to its model without rotors."
    )
    return report


def _counts(model: Model) -> list[int]:
    return [model.n_instructions(name) for name in FUNCTIONS]
