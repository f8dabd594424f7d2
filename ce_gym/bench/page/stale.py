"""Figures of README and docs: which have changed code behind them since their commit, and which do not name one.

A figure names its command and its commit, "`python -m ce_gym.bench speed` at 1a2b3c4". It is stale when files have
changed since that the benchmark runs: model, physics and compiler, and environments where it steps them. Tables of
figures whose section names no commit are listed, too: nobody can say whether they are stale.
"""

from __future__ import annotations

import argparse
import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ce_gym.bench.measure.report import Report, Table

ROOT = Path(__file__).resolve().parents[3]
PHYSICS = ("ce_gym/model", "ce_gym/dynamics", "ce_gym/compile", "ce_gym/sim")
STEPS = (*PHYSICS, "ce_gym/envs")
STEPPING = ("throughput", "derivatives", "soak", "gradients")
"""Benchmarks that step environments."""

FIGURE = re.compile(r"`python -m ce_gym\.bench (\w+)[^`]*`,? at ([0-9a-f]{7,40})\b")


COMMIT = re.compile(r"\b(?:at|commit) `?[0-9a-f]{7,40}\b")
COMMAND = re.compile(r"`(?:python |make |train/|tests/|docs/)[^`]+`|^(?:python|make) ", re.MULTILINE)
"""What a section calls the command that its figures come from."""
NUMBER = re.compile(r"[-−+±<>≈~*\[(]*\d")
MEASURED = 0.4
"""Share of a table's cells, its first column left out, that are numbers if it is one of figures."""


@dataclass(frozen=True)
class Measurements:
    """A table of figures.

    Attributes:
        page: File, relative to the repository.
        line: Where the table begins.
        columns: Its head.
        command: Whether its section, or the page before the first, names a command.
        commit: Likewise a commit.
    """

    page: str
    line: int
    columns: str
    command: bool
    commit: bool


@dataclass(frozen=True)
class Figure:
    """A figure that names where it comes from.

    Attributes:
        page: File, relative to the repository.
        line: Line in it.
        benchmark: Name of the benchmark.
        commit: Commit that it was measured at.
    """

    page: str
    line: int
    benchmark: str
    commit: str


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add no options: there is nothing to choose."""


def run(arguments: argparse.Namespace) -> Report:
    """List the figures; fails if one is stale."""
    report = Report("stale")
    rows = [(f.page, f.line, f.benchmark, f.commit, changed(f)) for f in figures(ROOT)]
    columns = ("page", "line", "benchmark", "measured at", "files changed since")
    report.tables.append(Table("Figures that name a commit", columns, tuple(rows)))
    unknown = [(t.page, t.line, t.columns[:60]) for t in measurements(ROOT) if not t.commit]
    report.tables.append(Table("Tables whose commit is not recorded", ("page", "line", "columns"), tuple(unknown)))
    report.failed = any(row[-1] for row in rows)
    return report


def figures(root: Path) -> Iterator[Figure]:
    """Yield every such figure of README and docs."""
    for path in pages(root):
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            for benchmark, commit in FIGURE.findall(line):
                yield Figure(path.relative_to(root).as_posix(), number, benchmark, commit)


def measurements(root: Path) -> Iterator[Measurements]:
    """Yield every table of figures of README and docs."""
    for path in pages(root):
        lines = path.read_text(encoding="utf-8").splitlines()
        heads = [*(i for i, line in enumerate(lines) if line.startswith("## ")), len(lines)]
        for i, line in enumerate(lines):
            if not line.startswith("|") or lines[i - 1].startswith("|"):
                continue
            end = next((j for j in range(i, len(lines)) if not lines[j].startswith("|")), len(lines))
            cells = [cell.strip() for row in lines[i + 2 : end] for cell in row.strip("|").split("|")[1:]]
            if sum(bool(NUMBER.match(cell)) for cell in cells) < MEASURED * max(1, len(cells)):
                continue
            start = max((head for head in heads if head < i), default=0)
            end = next(head for head in heads if head > i)
            section = "\n".join([*lines[: heads[0]], *lines[start:end]])
            named = (bool(pattern.search(section)) for pattern in (COMMAND, COMMIT))
            yield Measurements(path.relative_to(root).as_posix(), i + 1, line, *named)


def pages(root: Path) -> tuple[Path, ...]:
    """Return README and the pages of the docs.

    Raises:
        SystemExit: They are not there: this is an installed package.
    """
    if not (root / "README.md").exists() or not (root / ".git").exists():
        raise SystemExit(f"ce_gym.bench stale: {root}: expected a clone of the repository, with its README and docs")
    return root / "README.md", *sorted((root / "docs").glob("*.md"))


def rooms(benchmark: str) -> tuple[str, ...]:
    """Return the folders whose code a benchmark's figures depend on."""
    return STEPS if benchmark in STEPPING else PHYSICS


def changed(figure: Figure) -> int:
    """Return how many files of the figure's rooms differ from its commit.

    Raises:
        SystemExit: If this is no repository that knows the commit.
    """
    command = ["git", "-C", str(ROOT), "diff", "--name-only", figure.commit, "--", *rooms(figure.benchmark)]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    if finished.returncode:
        known = f"expected a commit of the repository at {ROOT}"
        raise SystemExit(f"ce_gym.bench: {figure.page}:{figure.line}: commit {figure.commit}: {known}")
    return len(finished.stdout.splitlines())
