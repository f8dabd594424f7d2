"""Tables, machine description and timing arithmetic."""

import json

import numpy as np
import pytest

from ce_gym.bench.measure.report import Report, Requirement, Table, cell_text
from ce_gym.bench.measure.timing import Competitor, Timing, interleaved, ratio


@pytest.mark.parametrize(
    ("cell", "text"),
    [(None, ""), (True, "yes"), (1234567, "1,234,567"), (0.123456, "0.1235"), (6543210.0, "6,543,210"), ("x", "x")],
)
def test_cells(cell, text):
    assert cell_text(cell) == text


def test_missed_requirements_are_said():
    report = Report("x", requirements=[Requirement("fast", "3", True), Requirement("small", "9", False)])
    text = report.as_text()
    assert "met     fast: 3" in text
    assert "MISSED  small: 9" in text
    assert json.loads(report.as_json())["requirements"][1] == {"claim": "small", "measured": "9", "met": False}


def test_competitors_take_turns():
    order, now = [], iter(range(1000))
    competitors = {"a": Competitor(lambda: order.append("a"), work=2), "b": Competitor(lambda: order.append("b"))}
    timings = interleaved(competitors, rounds=3, clock=lambda: float(next(now)))
    assert order == ["a", "b"] * 4  # one untimed turn each
    assert timings["a"].seconds == (0.5, 0.5, 0.5)
    assert timings["b"].best == timings["b"].median == 1.0


def test_ratio_takes_the_smaller_estimate():
    compared = ratio(Timing((4.0, 6.0, 10.0)), Timing((2.0, 1.0, 2.0)))
    assert (compared.of_best, compared.median, compared.lowest, compared.highest) == (4.0, 5.0, 2.0, 6.0)
    assert compared.cautious == 4.0


def test_figures_of_numpy_are_written():
    report = Report("a", [Table("t", ("x", "y"), ((np.float64(0.5), np.int64(3)),))], [])
    report.requirements.append(Requirement("one", "two", np.bool_(True)))
    written = json.loads(report.as_json())
    assert written["tables"][0]["rows"] == [[0.5, 3]]
    assert written["requirements"][0]["met"] is True
