"""The stability benchmark from end to end on its smallest run, and what its picture and its bars are made of."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ce_gym.bench import __main__ as command
from ce_gym.bench.measure.report import Report
from ce_gym.bench.stability import benchmark as stability
from ce_gym.bench.stability import grid as stability_grid
from ce_gym.bench.stability import plots as stability_plots

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")


def flat_map(dt: float, **changes) -> stability_grid.Map:
    """A map without a fault, but for the changes."""
    shape = stability_grid.SHAPE
    figures = {"finite": np.ones(shape, bool), "chatter": np.full(shape, 1e-9), "gain": np.zeros(shape)}
    figures |= {"source": np.full(shape, "motion"), "when": np.zeros(shape)}
    return stability_grid.Map(**({"dt": dt, "settled": 1.0, "excess": np.full(shape, -0.1)} | figures | changes))


@pytest.mark.parametrize(
    ("name", "value", "bar"), [("finite", False, 0), ("chatter", 2e-6, 1), ("excess", 1e-6, 2), ("gain", 1e-6, 3)]
)
def test_one_bad_cell_misses_its_bar(name: str, value: float, bar: int):
    good = flat_map(0.001)
    report = Report("stability")
    stability.report_map(report, {"robot": [good]})
    assert [r.met for r in report.requirements] == [True] * 5
    cells = getattr(good, name).copy()
    cells[2, 1] = value
    report = Report("stability")
    stability.report_map(report, {"robot": [good, flat_map(0.002, **{name: cells})]})
    assert [r.met for r in report.requirements] == [i != bar for i in range(4)] + [name != "gain"]
    assert "39 of 40" in report.requirements[bar].measured


def test_cells_in_which_energy_rises_are_listed_with_what_adds_most():
    """Those that are lost have no energy; the bar counts steps below 5 ms only."""
    gain, finite = np.zeros(stability_grid.SHAPE), np.ones(stability_grid.SHAPE, bool)
    gain[2, 1], gain[0, 0], finite[0, 0] = 1e-6, 1.0, False
    source = np.full(stability_grid.SHAPE, "stops")
    fine, coarse = (flat_map(dt, gain=gain, finite=finite, source=source) for dt in (0.002, 0.005))
    report = Report("stability")
    stability.report_map(report, {"robot": [fine, coarse]})
    cells = report.tables[1].rows
    assert cells == tuple(("robot", dt, "1e+05", 10.0, 1e-6, "stops", 0.0) for dt in (2.0, 5.0))
    assert report.requirements[-1].measured == "19 of 20, 1 by stops"


def test_joints_can_be_damped_otherwise():
    robot = stability.load_robot("mini_cheetah")
    other = stability.damped(robot, 0.7)
    assert {other.body(name).joint.damping for name in robot.independent} == {0.7}
    assert stability.damped(robot, None) is robot


def test_picture(tmp_path: Path):
    pytest.importorskip("matplotlib")
    lost = np.ones(stability_grid.SHAPE, bool)
    lost[0, 0] = False
    file = tmp_path / "pictures" / "map.png"
    stability_plots.draw({"a": [flat_map(0.001), flat_map(0.01, finite=lost)], "b": [flat_map(0.001)] * 2}, file)
    assert file.read_bytes().startswith(b"\x89PNG")


def test_command(tmp_path: Path, capsys):
    file = tmp_path / "stability.json"
    assert command.main(["stability", "--quick", "--skip", "cases", "robots", "beside", "--json", str(file)]) == 0
    assert "mini_cheetah" in capsys.readouterr().out
    written = json.loads(file.read_text())
    rows = written["tables"][0]["rows"]
    assert len(rows) == 2 * len(stability_grid.STIFFNESSES)
    assert [r["met"] for r in written["requirements"]][:3] == [True, True, True]


@pytest.fixture
def resting():
    pytest.importorskip("mujoco")
    from ce_gym.bench.stability import resting

    return resting


def test_what_comes_to_rest(resting):
    still, drifting = np.zeros((60, 3)), 0.02 * resting.HOLD * np.arange(60)[:, None] * np.ones(3)
    assert resting.rest(still).still
    assert resting.rest(drifting).speed == pytest.approx(0.02)
    assert not resting.rest(drifting).still
    assert not resting.rest(np.nan * still).finite


def test_legs_are_held_against_each_other_and_not_let_go(resting):
    scene = resting.resting("shanks", 2.0)
    assert scene.holds == 100
    np.testing.assert_array_equal(scene.drive[30], scene.drive[-1])
    assert np.abs(scene.drive[-1] - scene.drive[0]).max() > 0.5


@pytest.mark.slow
def test_cells_beside_mujoco(resting):
    """A cell of ours that moves where one of MuJoCo's is at rest is named."""
    table, behind = resting.measure(("shanks",), (4,), 2.0)
    ways = [row[1] for row in table.rows]
    assert len(ways) == len(set(ways)) == 3 + 4 * 3  # levels and stiff equalities, four integrators
    assert behind == []
    assert all("lost" not in row[2] for row in table.rows[:3])
