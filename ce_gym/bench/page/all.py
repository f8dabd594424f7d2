"""The benchmarks of speed, accuracy and stability, one after the other, as one page with their CSV and JSON.

Each runs in a process of its own, so that none finds memory or kernels of another; what a machine lacks is named as
skipped. `--quick` takes about ten minutes, everything up to two hours.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from ce_gym.bench.measure import machine
from ce_gym.bench.measure.report import Report, Requirement, Table
from ce_gym.viewer.console import shown


@dataclass(frozen=True)
class Part:
    """A benchmark of the page.

    Attributes:
        name: Its name.
        out: Whether it writes files into a folder `--out`.
        quick: Arguments of the short run; None if it is left out there.
    """

    name: str
    out: bool = False
    quick: tuple[str, ...] | None = ()


PARTS = (
    Part("instructions"),
    Part("tracking"),
    Part("speed", out=True, quick=("--quick",)),
    Part("growth", quick=("--joints", "2", "5", "10", "20", "--robots", "1", "64", "4096", "--rounds", "3")),
    Part("throughput", quick=("--rounds", "3")),
    Part("derivatives", quick=("--rounds", "3")),
    Part("friction"),
    Part("stability", out=True, quick=("--quick",)),
    Part("accuracy", out=True, quick=("--quick",)),
    Part("adaptive", out=True, quick=None),
    Part("gpu", quick=None),
)
MISSING = 2
"""Exit status of a benchmark for which something is not installed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    names = [part.name for part in PARTS]
    parser.add_argument("--out", type=Path, default=Path("report"), help="folder of the page and of everything else")
    parser.add_argument("--quick", action="store_true", help="short runs, without the longest")
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="NAME", help=", ".join(names))


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmarks, and write `index.md`."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    wanted = [part for part in PARTS if part.name in arguments.only and not (arguments.quick and part.quick is None)]
    report, pages = Report("all"), []
    rows = []
    for part in shown(wanted, "benchmarks"):
        start = time.perf_counter()
        said = _one(part, arguments.out, arguments.quick)
        found = read(arguments.out / f"{part.name}.json")
        rows.append((part.name, round((time.perf_counter() - start) / 60.0, 1), said or _bars(found.requirements)))
        report.requirements += [Requirement(f"{part.name}: {r.claim}", r.measured, r.met) for r in found.requirements]
        pages.append(chapter(part.name, said, found))
    report.tables.append(Table("Benchmarks", ("benchmark", "minutes", "bars"), tuple(rows)))
    head = [f"# Benchmarks at {commit()}", "", *(f"- {key}: {value}" for key, value in machine.describe().items())]
    page = arguments.out / "index.md"
    page.write_text("\n".join([*head, "", report.tables[0].as_markdown(), "", *pages]), encoding="utf-8")
    report.remarks.append(f"Written to {page}; beside it the JSON of each, and the files of those that write some.")
    return report


def commit() -> str:
    """Return the commit of the source, marked if files differ from it; "a release" outside of a repository."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=7", "--exclude=*"]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    return finished.stdout.strip() or "a release"


def read(path: Path) -> Report:
    """Return the report of a JSON file, an empty one if there is none."""
    if not path.exists():
        return Report(path.stem)
    content = json.loads(path.read_text(encoding="utf-8"))
    tables = [Table(t["title"], tuple(t["columns"]), tuple(map(tuple, t["rows"]))) for t in content["tables"]]
    bars = [Requirement(**requirement) for requirement in content["requirements"]]
    return Report(content["name"], tables, bars, content["remarks"], machine=content["machine"])


def chapter(name: str, said: str, found: Report) -> str:
    """Return what the page says of one benchmark: its command, its bars, met or missed alike, and its tables."""
    bars = [f"- {'met' if bar.met else '**missed**'}: {bar.claim}: {bar.measured}" for bar in found.requirements]
    tables = [part for table in found.tables for part in (table.as_markdown(), "")]
    remarks = [part for remark in found.remarks for part in (remark, "")]
    return "\n".join([f"## {name}", "", f"`python -m ce_gym.bench {name}`", "", said, *bars, "", *tables, *remarks])


def _one(part: Part, out: Path, quick: bool) -> str:
    """Run one, its text in a file; returns what went wrong, nothing if all went well."""
    record = out / f"{part.name}.json"
    record.unlink(missing_ok=True)
    arguments = [*(["--out", str(out / part.name)] if part.out else []), *(part.quick or () if quick else ())]
    command = [sys.executable, "-m", "ce_gym.bench", part.name, *arguments, "--json", str(record)]
    with (out / f"{part.name}.txt").open("w", encoding="utf-8") as text:
        finished = subprocess.run(command, stdout=text, stderr=subprocess.PIPE, text=True, check=False)
    if record.exists():
        return ""
    last = (finished.stderr.strip().splitlines() or ["without a word"])[-1]
    return f"skipped: {last}" if finished.returncode == MISSING else f"failed: {last}"


def _bars(requirements: list[Requirement]) -> str:
    """Return how many bars were met."""
    return f"{sum(bar.met for bar in requirements)} of {len(requirements)} met" if requirements else "none asked for"
