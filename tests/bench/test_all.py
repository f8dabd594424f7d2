"""One page of every benchmark, and figures that name their command and commit."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ce_gym.bench import __main__ as command
from ce_gym.bench.measure.report import Report, Requirement, Table
from ce_gym.bench.page import all as everything
from ce_gym.bench.page import stale

ROOT = Path(__file__).parents[2]


def test_the_page_has_what_was_missed_and_what_was_skipped(tmp_path: Path, monkeypatch, capsys):
    told = {"instructions": "", "gpu": "skipped: no GPU was found"}

    def one(part, out, quick):
        if not told[part.name]:
            bars = [Requirement("at most 1", "2", False), Requirement("at least 1", "2", True)]
            report = Report(part.name, [Table("Counts", ("robot", "n"), (("leg", 3),))], bars)
            (out / f"{part.name}.json").write_text(report.as_json(), encoding="utf-8")
        return told[part.name]

    monkeypatch.setattr(everything, "_one", one)
    assert command.main(["all", "--out", str(tmp_path), "--only", "instructions", "gpu"]) == 0
    page = (tmp_path / "index.md").read_text()
    assert all(part in page for part in ("**missed**: at most 1: 2", "| leg | 3 |", "no GPU was found"))
    assert "1 of 2 met" in capsys.readouterr().out


def test_a_benchmark_runs_in_a_process_of_its_own(tmp_path: Path):
    part = next(part for part in everything.PARTS if part.name == "tracking")
    assert everything._one(part, tmp_path, quick=True) == ""
    assert [bar.met for bar in everything.read(tmp_path / "tracking.json").requirements] == [True, True]


def test_every_part_is_a_benchmark():
    assert {part.name for part in everything.PARTS} <= set(command.BENCHMARKS)


def test_figures_are_found_with_their_commits(tmp_path: Path):
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text("| x | 3 | `python -m ce_gym.bench speed --rounds 9` at 1a2b3c4 |\n")
    (tmp_path / "docs" / "a.md").write_text(
        "`python -m ce_gym.bench speed` times\n\n`python -m ce_gym.bench growth`, at 0123456:"
    )
    found = [(f.page, f.line, f.benchmark, f.commit) for f in stale.figures(tmp_path)]
    assert found == [("README.md", 1, "speed", "1a2b3c4"), ("docs/a.md", 3, "growth", "0123456")]


def test_every_row_of_measured_figures_has_a_command_that_exists():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    table = text.split("## Measured")[1].split("\n## ")[0].split("\n\n| what ")[1].split("\n\n")[0]
    rows = [line for line in table.splitlines()[2:] if line.startswith("|")]
    assert len(rows) > 8
    for row in rows:
        named = re.findall(r"`([^`]+)`", row.rstrip("| ").rsplit("|", 1)[1])
        assert named, row
        assert all(exists(name) for name in named), row


def exists(name: str) -> bool:
    """Whether a command of README is one."""
    if name.startswith("python -m ce_gym.bench "):
        return name.split()[3] in command.BENCHMARKS
    if name.startswith("make "):
        return f"\n{name.split()[1]}:" in (ROOT / "Makefile").read_text()
    return (ROOT / name.removeprefix("python ").split()[0]).exists()


@pytest.mark.parametrize("name", sorted({figure.benchmark for figure in stale.figures(ROOT)}))
def test_figures_name_benchmarks_that_exist(name: str):
    assert name in command.BENCHMARKS
