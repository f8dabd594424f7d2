"""The benchmarks of speed, accuracy and stability, one after the other, as one page with their CSV and JSON.

Each runs in a process of its own, so that none finds memory or kernels of another; what a machine lacks, and what needs
files of others that were not given, is named as skipped. `--quick` takes under ten minutes, everything up to two hours.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ce_gym.bench.measure import machine
from ce_gym.bench.measure.report import Report, Requirement, Table
from ce_gym.bench.page.chapter import Chapter, page_html
from ce_gym.viewer.console import shown


@dataclass(frozen=True)
class Part:
    """A benchmark of the page.

    Attributes:
        name: Its name, and a study of it if it has several.
        out: Whether it writes files into a folder `--out`.
        quick: Arguments of the short run; None if it is left out there.
        full: Arguments of the long one.
        files: Name of the option with the files of others that it needs.
    """

    name: str
    out: bool = False
    quick: tuple[str, ...] | None = ()
    full: tuple[str, ...] = ()
    files: str = ""

    @property
    def file(self) -> str:
        """What names of its files begin with."""
        return self.name.replace(" ", "_")

    def command(self, given: Sequence[str], quick: bool) -> list[str]:
        """Return the arguments of `python -m ce_gym.bench`, but for where to write."""
        return [*self.name.split(), *given, *((self.quick or ()) if quick else self.full)]


FEW = ("--rounds", "3")
PARTS = (
    Part("instructions"),
    Part("tracking"),
    Part("paper", out=True, quick=None),
    Part("speed", out=True, quick=("--quick",)),
    Part("beside", quick=("--robots", "mini_cheetah", "tello", *FEW)),
    Part("growth", quick=("--joints", "2", "5", "10", "20", "--robots", "1", "64", "4096", *FEW)),
    Part("throughput", quick=FEW),
    Part("surroundings", quick=("--parts", "spheres", "pairs", "--rounds", "10")),
    Part("derivatives", quick=FEW),
    Part("gradients", quick=None),
    Part("friction"),
    Part("stability", quick=("--quick",)),
    Part("accuracy", out=True, quick=("--quick",)),
    Part("adaptive", out=True, quick=("--quick",)),
    Part("exactness controllers", out=True, quick=("--quick",)),
    Part("exactness contacts", out=True, quick=("--quick",)),
    Part("exactness designs", out=True, quick=("--quick",)),
    Part("identification", quick=("--trials", "3"), full=("--trials", "50")),
    Part("servo", files="servo"),
    Part("files", files="files"),
    Part("soak", quick=("--minutes", "0.5", "--env", "ce_gym/MiniCheetahVelocity-v0"), full=("--minutes", "5")),
    Part("fuzz", quick=("--minutes", "0.3")),
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
    parser.add_argument("--servo", nargs="+", default=[], metavar="PATH", help="logs and figures, as of `servo`")
    parser.add_argument("--files", nargs=1, default=[], metavar="FOLDER", help="robot files of others, as of `files`")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmarks, and write `index.md` and `index.html`."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    wanted = [part for part in PARTS if part.name in arguments.only and not (arguments.quick and part.quick is None)]
    report, chapters = Report("all"), list[Chapter]()
    rows = []
    for part in shown(wanted, "benchmarks"):
        start = time.perf_counter()
        given = getattr(arguments, part.files) if part.files else []
        lacking = bool(part.files) and not given
        command = part.command(given, arguments.quick)
        said = f"skipped: no --{part.files}" if lacking else _one(part, command, arguments.out)
        found = Report(part.name) if lacking else read(arguments.out / f"{part.file}.json")
        rows.append((part.name, round((time.perf_counter() - start) / 60.0, 1), said or _bars(found.requirements)))
        report.requirements += [Requirement(f"{part.name}: {r.claim}", r.measured, r.met) for r in found.requirements]
        chapters.append(Chapter(" ".join(command), said, found, arguments.out / part.file))
    report.tables.append(Table("Benchmarks", ("benchmark", "minutes", "bars"), tuple(rows)))
    _write_tables(arguments.out, wanted)
    title, facts, summary = f"Benchmarks at {commit()}", machine.describe(), report.tables[0]
    head = [f"# {title}", "", *(f"- {key}: {value}" for key, value in facts.items()), "", summary.as_markdown(), ""]
    page = arguments.out / "index.md"
    page.write_text("\n".join([*head, *(chapter.as_markdown() for chapter in chapters)]), encoding="utf-8")
    page.with_suffix(".html").write_text(page_html(title, facts, summary, chapters), encoding="utf-8")
    report.remarks.append(f"Written to {page} and .html; beside it JSON and tables of each, and further files.")
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


def _write_tables(out: Path, parts: Sequence[Part]) -> None:
    """Write every table as CSV."""
    for part in parts:
        for i, table in enumerate(read(out / f"{part.file}.json").tables, start=1):
            table.write_csv(out / f"{part.file}_{i}.csv")


def _one(part: Part, command: Sequence[str], out: Path) -> str:
    """Run one, its text in a file; returns what went wrong, nothing if all went well."""
    record = out / f"{part.file}.json"
    record.unlink(missing_ok=True)
    folder = ["--out", str(out / part.file)] if part.out else []
    line = [sys.executable, "-m", "ce_gym.bench", *command, *folder, "--json", str(record)]
    with (out / f"{part.file}.txt").open("w", encoding="utf-8") as text:
        finished = subprocess.run(line, stdout=text, stderr=subprocess.PIPE, text=True, check=False)
    if record.exists():
        return ""
    last = (finished.stderr.strip().splitlines() or ["without a word"])[-1]
    return f"skipped: {last}" if finished.returncode == MISSING else f"failed: {last}"


def _bars(requirements: list[Requirement]) -> str:
    """Return how many bars were met."""
    judged = [bar.met for bar in requirements if bar.met is not None]
    nothing = f", {len(requirements) - len(judged)} with nothing to judge" if len(judged) < len(requirements) else ""
    return f"{sum(judged)} of {len(judged)} met{nothing}" if requirements else "none asked for"
