"""Figures of README and docs: behind which something else is computed since their commit, and which do not name one.

A figure names its command and its commit, "`python -m ce_gym.bench speed` at 1a2b3c4". It is stale when what the
command depends on does something else than at that commit (`depends.py`). What nobody claims of today's code, a study
or a training of hours, says "written at 1a2b3c4" and is a record: listed, never stale. Tables of figures whose section
names neither are listed, too: nobody can say whether they are stale.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ce_gym.bench.measure.report import Report, Table
from ce_gym.bench.page import depends

FIGURE = re.compile(r"`(?:python )?(?:-m ce_gym\.bench (\w+)|(train/\w+\.py))[^`]*`,? at ([0-9a-f]{7,40})\b")
RECORD = re.compile(r"\bwritten at ([0-9a-f]{7,40})\b", re.IGNORECASE)
COMMIT = re.compile(r"\b(?:at|commit) `?[0-9a-f]{7,40}\b")
COMMAND = re.compile(r"`(?:python |make |train/|tests/|docs/)[^`]+`|^(?:python|make) ", re.MULTILINE)
"""What a section calls the command that its figures come from."""
NUMBER = re.compile(r"[-−+±<>≈~*\[(]*\d")
NAMED = 3
"""Files that are named behind a figure."""
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
        command: Name of the benchmark, or file of the script; empty for a record.
        commit: Commit that it was measured at.
    """

    page: str
    line: int
    command: str
    commit: str


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add no options: there is nothing to choose."""


def run(arguments: argparse.Namespace) -> Report:
    """List the figures; fails if one is stale."""
    report, found = Report("stale"), list(figures(depends.ROOT))
    rows = []
    for f in found:
        if f.command:
            different = changed(f)
            named = ", ".join(name.removeprefix("ce_gym/") for name in different[:NAMED])
            more = f" and {len(different) - NAMED} more" if len(different) > NAMED else ""
            rows.append((f.page, f.line, f.command, f.commit, named + more))
    columns = ("page", "line", "command", "measured at", "does something else since")
    report.tables.append(Table("Figures that name a commit", columns, tuple(rows)))
    records = tuple((f.page, f.line, f.commit) for f in found if not f.command)
    report.tables.append(Table("Records of what was found then", ("page", "line", "written at"), records))
    unknown = [(t.page, t.line, t.columns[:60]) for t in measurements(depends.ROOT) if not t.commit]
    report.tables.append(Table("Tables whose commit is not recorded", ("page", "line", "columns"), tuple(unknown)))
    report.failed = any(row[-1] for row in rows)
    return report


def figures(root: Path) -> Iterator[Figure]:
    """Yield every such figure and record of README and docs."""
    for path in pages(root):
        page = path.relative_to(root).as_posix()
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            yield from (Figure(page, number, name or script, commit) for name, script, commit in FIGURE.findall(line))
            yield from (Figure(page, number, "", commit) for commit in RECORD.findall(line))


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


def changed(figure: Figure) -> list[str]:
    """Return the files that a figure depends on and that do something else than at its commit.

    Raises:
        SystemExit: If this is no repository that knows the commit.
    """
    named = figure.command
    try:
        return depends.changed(named if named.endswith(".py") else depends.benchmark_file(named), figure.commit)
    except LookupError:
        known = f"expected a commit of the repository at {depends.ROOT}"
        raise SystemExit(f"ce_gym.bench: {figure.page}:{figure.line}: commit {figure.commit}: {known}") from None
