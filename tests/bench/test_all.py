"""One page of every benchmark, and figures that name their command and commit."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable
from pathlib import Path

import pytest

from ce_gym.bench import __main__ as command
from ce_gym.bench.measure.report import Report, Requirement, Table
from ce_gym.bench.page import all as everything
from ce_gym.bench.page import depends, stale
from ce_gym.bench.page.chapter import Chapter

ROOT = Path(__file__).parents[2]


def test_the_page_has_what_was_missed_and_what_was_skipped(tmp_path: Path, monkeypatch, capsys):
    told = {"instructions": "", "gpu": "skipped: no GPU was found"}

    def one(part, command, out):
        if not told[part.name]:
            bars = [Requirement("at most 1", "2", False), Requirement("at least 1", "2", True)]
            report = Report(part.name, [Table("Counts", ("robot", "n"), (("leg", 3),))], bars)
            (out / f"{part.name}.json").write_text(report.as_json(), encoding="utf-8")
            (out / part.name).mkdir()
            (out / part.name / "curves.png").touch()
        return told[part.name]

    monkeypatch.setattr(everything, "_one", one)
    assert command.main(["all", "--out", str(tmp_path), "--only", "instructions", "gpu"]) == 0
    page = (tmp_path / "index.md").read_text()
    assert all(
        part in page
        for part in ("**missed**: at most 1: 2", "| leg | 3 |", "no GPU was found", "![](instructions/curves.png)")
    )
    assert "1 of 2 met" in capsys.readouterr().out
    shown = (tmp_path / "index.html").read_text()
    parts = '<b class="missed">missed</b> at most 1: 2', "<td class=n>3</td>", "<p>skipped: no GPU was found</p>"
    parts += 'src="instructions/curves.png"', 'href="instructions_1.csv"', 'href="#instructions"', 'id="instructions"'
    assert [part for part in parts if part not in shown] == []


def test_a_page_says_what_others_wrote_and_does_not_run_it():
    table = Table("<b>", ("a", "b"), (("<i>", 1.5), ("x", None)))
    shown = Chapter("speed", "", Report("<speed>", [table], remarks=["a < b"]), Path("x")).as_html()
    assert [part for part in ("<i>", "<b>") if part in shown] == []
    wanted = "&lt;i&gt;", "a &lt; b", "<th class=n>b</th>", "<td class=n></td>", "<th>a</th>"
    assert [part for part in wanted if part not in shown] == []


def test_a_benchmark_runs_in_a_process_of_its_own(tmp_path: Path):
    part = next(part for part in everything.PARTS if part.name == "tracking")
    assert everything._one(part, part.command([], True), tmp_path) == ""
    assert [bar.met for bar in everything.read(tmp_path / "tracking.json").requirements] == [True, True]


def test_every_part_is_a_benchmark():
    assert {part.name.split()[0] for part in everything.PARTS} <= set(command.BENCHMARKS)


@pytest.mark.parametrize("part", everything.PARTS, ids=lambda part: part.file)
@pytest.mark.parametrize("quick", [True, False])
def test_every_part_takes_its_arguments(part: everything.Part, quick: bool, tmp_path: Path):
    """A part that is given what it does not know would be named as failed, hours later."""
    line = part.command(["given", "given"][: 2 if part.name == "servo" else bool(part.files)], quick)
    benchmark, parser = command.load(line[0]), argparse.ArgumentParser(exit_on_error=False)
    benchmark.add_arguments(parser)
    parser.parse_args([*line[1:], *(["--out", str(tmp_path)] if part.out else [])])


def test_what_needs_files_of_others_is_skipped_without_them(tmp_path: Path, capsys):
    assert command.main(["all", "--out", str(tmp_path), "--only", "servo", "files"]) == 0
    assert (tmp_path / "index.md").read_text().count("skipped: no --") == 4  # in the table and in each chapter
    assert "skipped: no --servo" in capsys.readouterr().out


def test_tables_are_written_as_csv(tmp_path: Path):
    assert command.main(["all", "--out", str(tmp_path), "--quick", "--only", "tracking"]) == 0
    lines = (tmp_path / "tracking_1.csv").read_text().splitlines()
    assert len(lines) > 2
    assert "`python -m ce_gym.bench tracking`" in (tmp_path / "index.md").read_text()


def test_figures_are_found_with_their_commits(tmp_path: Path):
    (tmp_path / "docs").mkdir()
    (tmp_path / ".git").touch()
    (tmp_path / "README.md").write_text("| x | 3 | `python -m ce_gym.bench speed --rounds 9` at 1a2b3c4 |\n")
    (tmp_path / "docs" / "a.md").write_text(
        "`python -m ce_gym.bench speed` times\n\n`python -m ce_gym.bench growth`, at 0123456:\n"
        "by `train/shac.py --seed 3` at 1234567; written at 89abcde, by `train/ppo.py`"
    )
    found = [(f.page, f.line, f.command, f.commit) for f in stale.figures(tmp_path)]
    assert found == [
        ("README.md", 1, "speed", "1a2b3c4"),
        ("docs/a.md", 3, "growth", "0123456"),
        ("docs/a.md", 4, "train/shac.py", "1234567"),
        ("docs/a.md", 4, "", "89abcde"),
    ]


def test_every_row_of_measured_figures_has_a_command_that_exists_and_a_commit():
    """But what tests hold, which need none."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    table = text.split("## Measured")[1].split("\n## ")[0].split("\n\n| what ")[1].split("\n\n")[0]
    rows = [line for line in table.splitlines()[2:] if line.startswith("|")]
    assert len(rows) > 8
    for row in rows:
        said = row.rstrip("| ").rsplit("|", 1)[1]
        named = re.findall(r"`([^`]+)`", said)
        assert named, row
        assert stale.COMMIT.search(said) or named == ["make test"], row
        assert all(exists(name) for name in named), row


def exists(name: str) -> bool:
    """Whether a command of README is one."""
    if name.startswith("python -m ce_gym.bench "):
        return name.split()[3] in command.BENCHMARKS
    if name.startswith("make "):
        return f"\n{name.split()[1]}:" in (ROOT / "Makefile").read_text()
    return (ROOT / name.removeprefix("python ").split()[0]).exists()


@pytest.mark.parametrize("name", sorted({figure.command for figure in stale.figures(ROOT) if figure.command}))
def test_figures_name_commands_that_exist(name: str):
    assert name in command.BENCHMARKS or (ROOT / name).exists()


def test_tables_of_figures_are_found_with_what_their_section_names(tmp_path: Path):
    (tmp_path / "docs").mkdir()
    (tmp_path / ".git").touch()
    (tmp_path / "docs" / "a.md").write_text("# Words\n\n| a | b |\n|---|---|\n| x | y 3 |\n")
    table = "| a | b |\n|---|---|\n| x | 3.5 |\n| y | ±4 |\n"
    by_script = "```sh\npython train/a.py\n```\n\nAt 1a2b3c4:\n\n"
    sections = "By `make speed`:\n\n", by_script, "At commit 1a2b3c4:\n\n"
    (tmp_path / "README.md").write_text("".join(f"## Section\n\n{said}{table}" for said in sections))
    found = list(stale.measurements(tmp_path))
    assert [(t.page, t.command, t.commit) for t in found] == [
        ("README.md", True, False),
        ("README.md", True, False),  # "At": what names a commit is "at" or "commit"
        ("README.md", False, True),
    ]
    assert [t.line for t in found] == [5, 17, 25]


def test_stale_outside_a_clone_is_one_line(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(depends, "ROOT", tmp_path)
    with pytest.raises(SystemExit, match="expected a clone of the repository"):
        stale.run(argparse.Namespace())


WITHOUT = {
    ("docs/numerics.md", "`Simulator(method=...)`"),  # orders of methods
    ("docs/scene.md", "name"),  # sizes of parameters
    ("docs/gpu.md", "what"),  # what is required, and not measured
    ("docs/terrain.md", "a step of 0.1 m, cell"),  # follows from the figures in it
    ("docs/scene.md", "scene"),  # of code that was tried and left out
}
"""Tables of numbers that no command measures."""


def test_tables_of_figures_have_commands():
    """In their section, or where their page begins; that of the studies of exactness has them in its protocol."""
    tables = [t for t in stale.measurements(ROOT) if not t.command and t.page != "docs/exactness.md"]
    assert names(tables) <= WITHOUT


def test_tables_of_figures_have_commits():
    """That they were measured at, or written at if they are records."""
    without = names(t for t in stale.measurements(ROOT) if not t.commit)
    assert without <= WITHOUT, f"`python -m ce_gym.bench stale` lists them: {without - WITHOUT}"


def names(tables: Iterable[stale.Measurements]) -> set[tuple[str, str]]:
    """Return page and first column of tables."""
    return {(t.page, t.columns.split("|")[1].strip()) for t in tables}
