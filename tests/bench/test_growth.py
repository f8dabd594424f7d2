"""The benchmark of growing work: its chains, its plate and the straightness that it asks for."""

from __future__ import annotations

import numpy as np
import pytest

from ce_gym.bench.measure.report import Report
from ce_gym.bench.speed import growth
from ce_gym.dynamics.model import Model
from ce_gym.sim import Simulator


def test_a_line_is_straight_and_a_parabola_is_less():
    x = [2, 5, 10, 20, 50, 100, 200]
    assert growth.straightness(x, [3 * n + 7 for n in x]) == pytest.approx(1.0, abs=1e-12)
    assert growth.straightness(x, [n * n for n in x]) < 0.95
    assert growth.straightness(x, [n**3 for n in x]) < 0.87


@pytest.mark.parametrize("n", [4, 9])
def test_spheres_of_the_plate_share_its_weight(n: int):
    sim = Simulator(Model(growth.plate(n)), 1, 0.005)
    sim.step(np.zeros((1, 0)), n_substeps=400)
    forces = sim.contact_forces[0, :, 2]
    assert forces.shape == (n,)
    assert forces.sum() == pytest.approx(growth.PLATE_MASS * 9.81, rel=1e-6)
    assert (forces > 0).all()


def test_instructions_of_a_chain_grow_by_the_same_with_every_joint():
    report = Report("growth")
    growth.joints([2, 3, 4], 1, report)
    counts = np.array([row[1:5] for row in report.tables[0].rows], int)
    assert (np.diff(counts, n=2, axis=0) == 0).all()
    assert all(row[5] > 0 for row in report.tables[0].rows)
