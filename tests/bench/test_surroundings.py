"""The benchmark of what scenes cost: its links side by side, its folded legs, and what it says."""

from __future__ import annotations

import argparse

import numpy as np
import pytest

from ce_gym.bench.speed import surroundings
from ce_gym.dynamics.model import Model
from ce_gym.sim import Simulator


@pytest.fixture(scope="module")
def model() -> Model:
    return Model("mini_cheetah")


def test_links_with_feet_are_paired_going_round(model: Model):
    found = {frozenset(link[:2] for link in pair) for pair in surroundings.neighbours(model)}
    assert found == {frozenset(pair) for pair in (("HR", "HL"), ("HL", "FL"), ("FL", "FR"), ("FR", "HR"))}


def test_folded_legs_press_on_each_other(model: Model):
    pair = next(p for p in surroundings.neighbours(model) if {link[:2] for link in p} == {"HR", "HL"})
    sim = Simulator(model, 8, contacts="foot", self_collisions=[pair])
    sim.step(np.tile(surroundings.folded_targets(model, pair), (8, 1)), n_substeps=100)
    assert (sim.pair_forces > 1.0).all()


def test_report():
    parser = argparse.ArgumentParser()
    surroundings.add_arguments(parser)
    report = surroundings.run(
        parser.parse_args(["--num-envs", "8", "--rounds", "2", "--parts", "pairs", "height_scan"])
    )
    (table,) = report.tables
    assert len(table.rows) == 8
    assert len(report.requirements) == 8
    assert all(row[2] > 0 and row[3] > 0 for row in table.rows)
