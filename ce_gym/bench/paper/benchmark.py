"""The figures of the constraint-embedding paper, drawn again with our counts beside the paper's library and Pinocchio.

Chignoli, Adrian, Kim, Wensing, "A Propagation Perspective on Recursive Forward Dynamics for Systems with Kinematic
Loops", arXiv:2311.13732. An instruction is one scalar operation of a CasADi function, the paper's own measure; counts
of others are on file in `data/`, ours are taken as this runs. Writes one CSV and at least one PNG for each figure.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterable, Sequence
from itertools import groupby, pairwise
from pathlib import Path

from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.bench.paper import counts as paper_counts
from ce_gym.bench.paper import tracking
from ce_gym.bench.paper.counts import ChainCount, RobotCount, crossover, increments

LARGEST_SPREAD = 4
"""Increments per unit of depth may differ by this many instructions, as those of the paper's library do (+-2)."""
LARGEST_SHARE = 0.45
"""Most instructions we may take on a robot, as a multiple of the library's."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--out", type=Path, default=Path("paper_figures"), help="folder for pictures and CSV files")
    parser.add_argument("--branches", type=int, nargs="+", default=[1, 2, 4, 6], help="branches of the scaling chains")
    parser.add_argument("--depth", type=int, default=10, help="largest depth of the scaling chains")
    parser.add_argument("--chain-depths", type=int, nargs="+", default=[5, 10, 20, 40], help="parallel chains' depths")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    from ce_gym.bench.paper import plots as paper_plots

    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    report = Report("paper")
    branched = paper_counts.branched_counts(arguments.branches, arguments.depth)
    parallel = paper_counts.parallel_counts(arguments.chain_depths)
    robots = paper_counts.robot_counts()
    write_chains(out / "depth.csv", branched)
    write_chains(out / "locality.csv", parallel)
    write_robots(out / "approximation.csv", robots)
    depth_table(report, branched)
    locality_table(report, parallel)
    approximation_table(report, robots)
    follow = tracking.run(argparse.Namespace(robot="mit_humanoid_leg"))
    report.tables += follow.tables
    report.requirements += follow.requirements
    figures = [paper_plots.draw_depth(chain, list(rows), out) for chain, rows in _by_chain(branched)]
    figures += [
        paper_plots.draw_locality(parallel, out),
        paper_plots.draw_approximation(robots, out),
        paper_plots.draw_tracking("mit_humanoid_leg", "knee_link", out),
    ]
    report.remarks.append(
        "Ours take independent positions only and solve closed loops for the others; the library takes all positions."
    )
    report.remarks.append("\n".join(["Written:", *(f"  {path}" for path in figures), f"  {out}/*.csv"]))
    return report


def depth_table(report: Report, counts: Sequence[ChainCount]) -> None:
    """Add instructions per unit of depth, and require them to be constant."""
    rows: list[tuple[Cell, ...]] = []
    for chain, of_chain in _by_chain(counts):
        for branches, group in groupby(of_chain, key=lambda c: c.reference.branches):
            points = list(group)
            if len(points) < 3:
                continue
            ours = {name: increments([p.ours[name] for p in points]) for name in points[0].ours}
            library = increments([p.reference.ce_aba for p in points])
            last, proximal = points[-1].ours["exact"], points[-1].reference.proximal
            means: list[Cell] = [_mean(ours[name]) if name in ours else None for name in paper_counts.VARIANTS]
            rows.append((chain, branches, *means, _mean(library), proximal / last if proximal else None))
            spread = max(ours["exact"]) - min(ours["exact"])
            claim = f"{chain}, branches: {branches}: exact is linear, increments differ by at most {LARGEST_SPREAD}"
            report.requirements.append(Requirement(claim, str(spread), spread <= LARGEST_SPREAD))
    columns = ("chain", "branches", *(f"{name}, per unit" for name in paper_counts.VARIANTS))
    columns += ("library CE-ABA, per unit", "proximal / exact at largest depth")
    report.tables.append(Table("Instructions for one unit more of depth", columns, tuple(rows)))


def locality_table(report: Report, counts: Sequence[ChainCount]) -> None:
    """Add the loop sizes at which the proximal method becomes cheaper, and require them to grow with depth."""
    rows: list[tuple[Cell, ...]] = []
    for chain, of_chain in _by_chain(counts):
        found: list[float] = []
        for depth, group in groupby(of_chain, key=lambda c: c.reference.depth):
            points = [p for p in group if p.reference.proximal]
            sizes = [p.reference.loop_size or 0 for p in points]
            proximal = [p.reference.proximal or 0 for p in points]
            ours = crossover(sizes, [p.ours["exact"] for p in points], proximal)
            library = crossover(sizes, [p.reference.ce_aba for p in points], proximal)
            rows.append((chain, depth, _size(ours, sizes), _size(library, sizes)))
            found.append(ours if ours is not None else float("inf"))
        claim = f"{chain}: the crossover with the proximal method moves to larger loops with depth"
        measured = ", ".join("none" if x == float("inf") else f"{x:.1f}" for x in found)
        grows = all(a <= b for a, b in pairwise(found))
        report.requirements.append(Requirement(claim, measured, grows))
    columns = ("chain", "depth", "ours exact: proximal is cheaper from loop size", "library CE-ABA")
    report.tables.append(Table("Locality: crossover with the proximal method", columns, tuple(rows)))


def approximation_table(report: Report, counts: Iterable[RobotCount]) -> None:
    """Add what leaving out transmissions saves, and require exactness to cost less than in the paper's library."""
    rows: list[tuple[Cell, ...]] = []
    for c in counts:
        exact, reference = c.ours["exact"], c.reference
        ours = saving(exact, c.ours.get("none"))
        theirs = saving(reference.ce_aba, reference.approximate)
        rows.append((c.robot, exact, c.ours.get("none"), ours, reference.ce_aba, theirs, reference.paper_saving))
        share = exact / reference.ce_aba
        claim = f"{c.robot}: exact takes at most {LARGEST_SHARE} of the library's CE-ABA"
        report.requirements.append(Requirement(claim, f"{share:.3f}", share <= LARGEST_SHARE))
    columns = ("robot", "exact", "none", "saved [%]", "library CE-ABA", "saved [%]", "saved, as printed [%]")
    report.tables.append(Table("What leaving out the transmissions saves", columns, tuple(rows)))


def saving(exact: int, approximate: int | None) -> float | None:
    """Return how much less the approximation takes [%]."""
    return None if approximate is None else 100.0 * (1.0 - approximate / exact)


def write_chains(path: Path, counts: Sequence[ChainCount]) -> None:
    """Write all counts of chains, ours and others', one system a line."""
    keys = list(vars(counts[0].reference)) if counts else []
    header = [*keys, *(f"ours_{name}" for name in paper_counts.VARIANTS)]
    write_csv(path, header, ([*vars(c.reference).values(), *_ours(c.ours)] for c in counts))


def write_robots(path: Path, counts: Sequence[RobotCount]) -> None:
    """Write all counts of robots, ours and others', one robot a line."""
    keys = list(vars(counts[0].reference)) if counts else []
    header = ["robot", *keys, *(f"ours_{name}" for name in paper_counts.VARIANTS)]
    write_csv(path, header, ([c.robot, *vars(c.reference).values(), *_ours(c.ours)] for c in counts))


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV file; None becomes an empty cell."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def _by_chain(counts: Sequence[ChainCount]) -> list[tuple[str, list[ChainCount]]]:
    return [(chain, list(group)) for chain, group in groupby(counts, key=lambda c: c.reference.chain)]


def _ours(ours: dict[str, int]) -> list[int | None]:
    return [ours.get(name) for name in paper_counts.VARIANTS]


def _mean(values: Sequence[int]) -> float:
    return sum(values) / len(values)


def _size(found: float | None, sizes: Sequence[int]) -> Cell:
    return f"{found:.1f}" if found is not None else f"none up to {sizes[-1]}"
