"""Digests: the same twice, and another one as soon as one bit of the physics is."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ce_gym.bench import __main__ as command
from ce_gym.bench.digests.benchmark import row
from ce_gym.bench.digests.cases import Case
from ce_gym.model.load import assets_folder

ROBOT = "four_bar"
INERTIA = 0.042673


@pytest.fixture
def changed(tmp_path: Path) -> str:
    """A copy of the robot in which one moment of inertia is larger by some bits; one bit can vanish in a rounding."""
    for kind in ("yaml", "urdf"):
        text = (assets_folder() / ROBOT / f"{ROBOT}.{kind}").read_text()
        assert kind == "yaml" or f'izz="{INERTIA}"' in text
        more = text.replace(f'izz="{INERTIA}"', f'izz="{INERTIA * (1 + 1e-14)!r}"')
        (tmp_path / f"{ROBOT}.{kind}").write_text(more)
    return str(tmp_path / f"{ROBOT}.yaml")


@pytest.mark.parametrize("kind", ["model", "simulator"])
def test_the_smallest_change_of_the_physics_is_another_digest(kind: str, changed: str) -> None:
    first, again, other = (row(Case(kind, name, "exact")) for name in (ROBOT, ROBOT, changed))
    assert first == again
    assert any(first[name]["digest"] != other[name]["digest"] for name in first)


def test_the_command_says_which_rows_differ_and_by_how_much(
    tmp_path: Path, changed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file, options = tmp_path / "record.json", ["digests", "--robots", ROBOT, "--only", "model"]
    assert command.main([*options, "--out", str(file)]) == 0
    assert command.main([*options, "--against", str(file)]) == 0
    assert "0 of 4 differ" in capsys.readouterr().out
    record = json.loads(file.read_text())
    record["rows"]["model four_bar exact float64"] = row(Case("model", changed, "exact"))
    file.write_text(json.dumps(record))
    assert command.main([*options, "--against", str(file)]) == 1
    out = capsys.readouterr().out
    assert "1 of 4 differ" in out
    lines = [line for line in out.splitlines() if line.startswith("model four_bar")]
    assert any(0 < float(line.split()[-2]) < 1e-12 for line in lines)


def test_what_is_no_record_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "other.json"
    file.write_text('{"rows": {"model": {"q": 1}}}')
    with pytest.raises(SystemExit) as caught:
        command.main(["digests", "--against", str(file)])
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "other.json" in error
