"""Figures of README and docs that name a commit, and what has changed since in the code that they were measured on.

A figure names its command and its commit, "`python -m ce_gym.bench speed` at 1a2b3c4". It is stale when files have
changed since that the benchmark runs: model, physics and compiler, and environments where it steps them.
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
    report.failed = any(row[-1] for row in rows)
    return report


def figures(root: Path) -> Iterator[Figure]:
    """Yield every such figure of README and docs."""
    for path in (root / "README.md", *sorted((root / "docs").glob("*.md"))):
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            for benchmark, commit in FIGURE.findall(line):
                yield Figure(path.relative_to(root).as_posix(), number, benchmark, commit)


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
