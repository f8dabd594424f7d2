"""Time against error: work-precision curves of ours, MuJoCo's and Drake's methods, in flight, in loops and in contact.

For every scene each method runs at steps from 20 ms down; its error is plotted against its time on one core. In smooth
scenes the truth is what two independent codes agree on. In contact every code has a law of its own, and each is held
against its own limit. Writes a picture, a CSV file and a Markdown table.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

from ce_gym.bench.accuracy import drake_peer
from ce_gym.bench.accuracy.coulomb import PUSHES, distance_table
from ce_gym.bench.accuracy.curves import OUR_STEPS, PEER_STEPS, Comparison, Measured, comparisons, measure
from ce_gym.bench.accuracy.scenarios import SCENES
from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.viewer.console import shown

REQUIRED = 20.0
"""How many times as long as ours a peer has to take at every error that both reach."""
PEERS = ("MuJoCo", "Drake")
QUICK_SCENES, QUICK_STEPS = ("tumble", "belt_leg", "drop_3cm", "slide"), (1, 5, 20, 100)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--out", type=Path, default=Path("accuracy"), help="folder for picture, CSV and table")
    parser.add_argument("--scenes", nargs="+", choices=tuple(SCENES), help="all by default")
    parser.add_argument("--peers", nargs="+", choices=PEERS, default=PEERS, help="all that are installed by default")
    parser.add_argument("--rounds", type=int, default=3, help="how often each point is timed")
    parser.add_argument("--quick", action="store_true", help="four scenes, few steps, one round")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    from ce_gym.bench.accuracy import plots as accuracy_plots

    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    ours, theirs, rounds = OUR_STEPS, PEER_STEPS, arguments.rounds
    if arguments.quick:
        ours, theirs, rounds = QUICK_STEPS, QUICK_STEPS, 1
    peers = [peer for peer in arguments.peers if peer != "Drake" or drake_peer.available()]
    theirs = theirs if "MuJoCo" in peers else ()
    measured, more = [], []
    if "Drake" in peers:
        from ce_gym.bench.accuracy.drake_peer.sides import sides as drake_sides

        more = [drake_sides]
    for name in shown(arguments.scenes or (QUICK_SCENES if arguments.quick else SCENES), "scenes"):
        measured.append(measure(SCENES[name](), ours, theirs, rounds, more))
        write_csv(out / "accuracy.csv", measured)
    beside = {peer: [m for m in measured if any(curve.code == peer for curve in m.curves)] for peer in peers}
    tables = [table for peer, scenes in beside.items() if scenes for table in peer_tables(scenes, peer)]
    if any(m.scene.name in PUSHES for m in measured):
        tables.append(distance_table())
    (out / "accuracy.md").write_text("\n\n".join(table.as_markdown() for table in tables) + "\n", encoding="utf-8")
    picture = accuracy_plots.draw(measured, out)
    report = Report("accuracy", tables, [requirement(m, peer) for peer, scenes in beside.items() for m in scenes])
    report.remarks.append(
        "Time: CPU time of one core for one robot and one simulated second, best of the rounds; both sides take "
        "turns. Smooth scenes: error against the truth; ours at the exact level, MuJoCo at any. Contact: every code "
        "against its own limit, so MuJoCo may leave out the rotors. No entry: not reached at any step tried."
    )
    if set(arguments.peers) > set(peers):
        report.remarks.append(drake_peer.SKIPPED)
    report.remarks.append(f"Written: {picture}, {out}/accuracy.csv, {out}/accuracy.md")
    return report


def peer_tables(measured: list[Measured], code: str) -> list[Table]:
    """Return what there is to say about a peer: times, and how well it is known what it is held against."""
    known = reference_table(measured) if code == "MuJoCo" else limit_table(measured, code)
    return [table for table in (time_table(measured, code), known) if table.rows]


def time_table(measured: list[Measured], code: str = "MuJoCo") -> Table:
    """Return the least times at every decade of error, ours and a peer's."""
    rows: list[tuple[Cell, ...]] = []
    for m in measured:
        for c in comparisons(m, code):
            ours, theirs = (None if t is None else 1e6 * t for t in (c.ours, c.theirs))
            peer = (theirs, c.peer or "not reached")
            rows.append((m.scene.name, f"{c.error:.0e}", ours, c.method, *peer, c.ratio, c.double_ratio))
    title = f"Time for a simulated second at equal error, one robot, one core, beside {code}"
    columns = ("scene", "error", "ours [us]", "ours", f"{code} [us]", code, "ratio", "in double precision")
    return Table(title, columns, tuple(rows))


def reference_table(measured: list[Measured]) -> Table:
    """Return how far two codes agree on the truth, and how well MuJoCo's own limits are known."""
    rows: list[tuple[Cell, ...]] = []
    for m in measured:
        second = "MuJoCo's matrices, null space of its Jacobian" if m.scene.smooth else "our law again, explicit"
        theirs = [value for (code, _), value in m.limits.items() if code == "MuJoCo"]
        first = "rk8" if m.scene.smooth else "extrapolated, 5 us"
        rows.append((m.scene.name, first, second, m.agreement, min(theirs), max(theirs)))
    columns = ("scene", "ours", "the other", "they differ by", "MuJoCo's limits known to", "at worst")
    return Table("References", columns, tuple(rows))


def limit_table(measured: list[Measured], code: str) -> Table:
    """Return how well each limit of a peer in contact is known."""
    rows = [(m.scene.name, name, value) for m in measured for (of, name), value in m.limits.items() if of == code]
    return Table(f"{code}'s own limits in contact", ("scene", "limit", "known to"), tuple(rows))


def requirement(m: Measured, code: str = "MuJoCo") -> Requirement:
    """Return whether a peer takes long enough at every error that both reach."""
    both = [c for c in comparisons(m, code) if c.ratio is not None]
    claim = f"{m.scene.name}: {code} / ce_gym, time at equal error, at least {REQUIRED:.0f}"
    if not both:
        return Requirement(claim, "no decade that both reach", None)
    worst: Comparison = min(both, key=lambda c: c.ratio or 0.0)
    double = min((c.double_ratio for c in both if c.double_ratio is not None), default=0.0)
    text = f"{worst.ratio:.1f} at {worst.error:.0e}, the least of {len(both)}; {double:.1f} in double precision"
    return Requirement(claim, text, (worst.ratio or 0.0) >= REQUIRED)


def write_csv(path: Path, measured: list[Measured]) -> None:
    """Write every point: both errors and the time."""
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
