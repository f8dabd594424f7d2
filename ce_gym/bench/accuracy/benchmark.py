"""Time against error: work-precision curves of methods of ce_gym, MuJoCo and Drake, in flight, in loops, in contact.

Each method runs every scene with steps of at most 20 ms; its error is compared with its time on one core. In smooth
scenes the reference solution is one on which two independent codes agree. In contact each code has its own contact law,
so the error of a code is the distance from its own limit for short steps.
"""

from __future__ import annotations

import argparse
import csv
import statistics
from collections.abc import Sequence
from pathlib import Path

from ce_gym.bench.accuracy import drake_peer
from ce_gym.bench.accuracy.curves import (
    MARGIN,
    OUR_STEPS,
    PEER_STEPS,
    Comparison,
    Measured,
    comparisons,
    measure,
    time_to,
)
from ce_gym.bench.accuracy.scenarios import SCENES
from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.console import progress

REQUIRED = 20.0
"""Required ratio of times, peer to ce_gym, at every error that both reach."""
LARGEST_MEDIAN = 3.0
"""Largest allowed median of the adaptive method's error over scenes and tolerances, divided by the tolerance."""
PEERS = ("MuJoCo", "Drake")
QUICK_SCENES, QUICK_STEPS = ("tumble", "belt_leg", "drop_3cm", "slide"), (1, 5, 20, 100)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--scenes", nargs="+", choices=tuple(SCENES), help="all by default")
    parser.add_argument("--peers", nargs="+", choices=PEERS, default=PEERS, help="all that are installed by default")
    parser.add_argument("--rounds", type=int, default=3, help="how often each point is timed")
    parser.add_argument("--quick", action="store_true", help="four scenes, few steps, one round")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="also draw the curves to a PNG file")
    parser.add_argument("--points", type=Path, metavar="FILE", help="also write all points to a CSV file")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    names, our_steps, peer_steps, rounds = arguments.scenes or SCENES, OUR_STEPS, PEER_STEPS, arguments.rounds
    if arguments.quick:
        names, our_steps, peer_steps, rounds = arguments.scenes or QUICK_SCENES, QUICK_STEPS, QUICK_STEPS, 1
    peers = [peer for peer in arguments.peers if peer != "Drake" or drake_peer.available()]
    more = []
    if "Drake" in peers:
        from ce_gym.bench.accuracy.drake_peer.sides import sides as drake_sides

        more = [drake_sides]
    mujoco_steps = peer_steps if "MuJoCo" in peers else ()
    measured = [measure(SCENES[name](), our_steps, mujoco_steps, rounds, more) for name in progress(names, "scenes")]
    report = Report("accuracy")
    for peer in peers:
        scenes = [m for m in measured if any(curve.code == peer for curve in m.curves)]
        if scenes:
            report.tables += [time_table(scenes, peer), reference_table(scenes, peer)]
        report.requirements += [requirement(m, peer) for m in scenes]
    add_tolerances(measured, report)
    report.remarks.append(
        "Time: CPU time of one core for one robot and one simulated second, best of the rounds; both sides take "
        "turns. Smooth scenes: error against the truth; ours at the exact level, MuJoCo at any. Contact: every code "
        "against its own limit, so MuJoCo may leave out the rotors. No entry: not reached at any step tried."
    )
    if set(arguments.peers) > set(peers):
        report.remarks.append(drake_peer.SKIPPED)
    if arguments.picture:
        from ce_gym.bench.accuracy import plots

        plots.draw(measured, arguments.picture)
    if arguments.points:
        write_points(arguments.points, measured)
    return report


def time_table(measured: list[Measured], code: str) -> Table:
    """Return the shortest times of ce_gym and of a peer at every decade of error."""
    rows: list[tuple[Cell, ...]] = []
    for m in measured:
        for c in comparisons(m, code):
            ours, theirs = (None if t is None else 1e6 * t for t in (c.ours, c.theirs))
            peer = (theirs, c.peer or "not reached")
            rows.append((m.scene.name, f"{c.error:.0e}", ours, c.method, *peer, c.ratio, c.double_ratio))
    title = f"Time for a simulated second at equal error, one robot, one core, beside {code}"
    columns = ("scene", "error", "ours [us]", "ours", f"{code} [us]", code, "ratio", "in double precision")
    return Table(title, columns, tuple(rows))


def reference_table(measured: list[Measured], code: str) -> Table:
    """Return the difference of the two reference codes, and the accuracy of the limits of a peer's methods."""
    rows: list[tuple[Cell, ...]] = []
    for m in measured:
        second = "MuJoCo's matrices, null space of its Jacobian" if m.scene.smooth else "our law again, explicit"
        known = [value for (of, _), value in m.limits.items() if of == code]
        ends = (min(known), max(known)) if known else (None, None)
        rows.append((m.scene.name, second, m.agreement, *ends))
    columns = ("scene", "second code", "differs from ours by", f"{code}'s limits known to", "at worst")
    return Table(f"References beside {code}", columns, tuple(rows))


def requirement(m: Measured, code: str = "MuJoCo") -> Requirement:
    """Return the requirement on the ratio of times at every error that both reach."""
    both = [c for c in comparisons(m, code) if c.ratio is not None]
    claim = f"{m.scene.name}: {code} / ce_gym, time at equal error, at least {REQUIRED:.0f}"
    if not both:
        return Requirement(claim, "no decade that both reach", None)
    worst: Comparison = min(both, key=lambda c: c.ratio or 0.0)
    double = min((c.double_ratio for c in both if c.double_ratio is not None), default=0.0)
    text = f"{worst.ratio:.1f} at {worst.error:.0e}, the least of {len(both)}; {double:.1f} in double precision"
    return Requirement(claim, text, (worst.ratio or 0.0) >= REQUIRED)


def add_tolerances(measured: Sequence[Measured], report: Report) -> None:
    """Add errors and times of the adaptive method at each tolerance, compared with fixed steps, to the report."""
    rows = [row for m in measured for row in tolerance_rows(m)]
    if not rows:
        return
    columns = ("scene", "tolerance", "error", "error / tolerance", "time [us]", "/ best fixed step, extrapolated")
    report.tables.append(Table("Adaptive steps in double precision, for one simulated second", columns, tuple(rows)))
    ratios = [row[3] for row in rows]
    median = statistics.median(ratios)
    claim = f"adaptive steps: error / tolerance, median at most {LARGEST_MEDIAN:.0f}"
    text = f"{median:.2f} of {len(ratios)}, largest {max(ratios):.1f}"
    report.requirements.append(Requirement(claim, text, median <= LARGEST_MEDIAN))


def tolerance_rows(m: Measured) -> list[tuple[str, float, float, float, float, float | None]]:
    """Return a row for each tolerance, if one step per hold is not enough and the references are accurate enough."""
    ours = {curve.method: curve for curve in m.curves if curve.code == "ce_gym" and curve.level == m.scene.exact}
    if not {"adaptive", "extrapolated"} <= ours.keys():
        return []
    fixed, adaptive, rows = ours["extrapolated"], ours["adaptive"], []
    smallest = MARGIN * m.known(adaptive)
    for point in adaptive.points:
        tolerance, error = point.dt, m.error(point)
        if tolerance < m.error(fixed.points[0]) and error >= smallest:
            best = time_to(fixed, m.errors(fixed), error)
            slower = point.seconds / best if best else None
            rows.append((m.scene.name, tolerance, error, error / tolerance, 1e6 * point.seconds, slower))
    return rows


def write_points(path: Path, measured: list[Measured]) -> None:
    """Write both errors and the time of every point."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(
            ["scene", "code", "level", "method", "dt [s]", "time per simulated second [s]"]
            + ["error against the truth", "error against its own limit"]
        )
        for m in measured:
            for curve in m.curves:
                for p in curve.points:
                    figures = [f"{x:.6g}" for x in (p.dt, p.seconds, p.truth, p.own)]
                    writer.writerow([m.scene.name, curve.code, curve.level, curve.method, *figures])
