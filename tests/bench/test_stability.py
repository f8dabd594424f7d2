"""The stability benchmark from end to end on its smallest run, and what its picture and its bars are made of."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ce_gym.bench import __main__ as command
from ce_gym.bench.stability import benchmark as stability
from ce_gym.bench.stability import grid as stability_grid
from ce_gym.bench.stability import plots as stability_plots

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")


def flat_map(dt: float, **changes) -> stability_grid.Map:
    """A map without a fault, but for the changes."""
    shape = stability_grid.SHAPE
    figures = {"finite": np.ones(shape, bool), "chatter": np.full(shape, 1e-9), "gain": np.zeros(shape)}
    return stability_grid.Map(**({"dt": dt, "excess": np.full(shape, -0.1)} | figures | changes))


@pytest.mark.parametrize(
    ("name", "value", "bar"), [("finite", False, 0), ("chatter", 2e-6, 1), ("excess", 1e-6, 2), ("gain", 1e-6, 3)]
)
def test_one_bad_cell_misses_its_bar(name: str, value: float, bar: int):
    good = flat_map(0.001)
    report = stability.report_of({"robot": [good]})
    assert [r.met for r in report.requirements] == [True] * 4
    cells = getattr(good, name).copy()
    cells[2, 1] = value
    report = stability.report_of({"robot": [good, flat_map(0.002, **{name: cells})]})
    assert [r.met for r in report.requirements] == [i != bar for i in range(4)]
    assert "39 of 40" in report.requirements[bar].measured


def test_picture(tmp_path: Path):
    pytest.importorskip("matplotlib")
    lost = np.ones(stability_grid.SHAPE, bool)
    lost[0, 0] = False
    file = tmp_path / "pictures" / "map.png"
    stability_plots.draw({"a": [flat_map(0.001), flat_map(0.01, finite=lost)], "b": [flat_map(0.001)] * 2}, file)
    assert file.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_command(tmp_path: Path, capsys):
    file = tmp_path / "stability.json"
    assert command.main(["stability", "--quick", "--json", str(file)]) == 0
    assert "mini_cheetah" in capsys.readouterr().out
    written = json.loads(file.read_text())
    rows = written["tables"][0]["rows"]
    assert len(rows) == 2 * len(stability_grid.STIFFNESSES)
    assert [r["met"] for r in written["requirements"]][:3] == [True, True, True]
