"""The benchmark of what scenes cost: its links side by side, its folded legs, and what it says."""

from __future__ import annotations

import argparse
import os

import numpy as np
import pytest

from ce_gym.bench.measure import processes
from ce_gym.bench.measure.timing import Timing
from ce_gym.bench.speed import pressed, released, surroundings
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


def test_elastic_drives_beside_exact_ones():
    """Standing, under random targets and walking."""
    parser = argparse.ArgumentParser()
    surroundings.add_arguments(parser)
    report = surroundings.run(parser.parse_args(["--num-envs", "8", "--rounds", "2", "--parts", "drives"]))
    (table,) = report.tables
    assert [row[0].split(", ")[1] for row in table.rows[:4]] == [
        "standing",
        "random targets",
        "random targets",
        "walking",
    ]
    assert len(report.requirements) == 8
    assert all(row[2] > 0 and 0.3 < row[3] < 30 for row in table.rows)


def test_the_fastest_process_of_each_round_counts():
    one, other = ({"case": {"with": Timing(seconds)}} for seconds in ((3.0, 1.0), (2.0, 5.0)))
    assert processes.fastest([one, other]) == {"case": {"with": Timing((2.0, 1.0))}}


def test_several_processes_measure_one_after_the_other():
    own = {"case": {"process": Timing((float(os.getpid()),))}}
    assert processes.in_processes(_measured, 1) == own
    assert processes.in_processes(_measured, 2) != own


def _measured() -> processes.Timings:
    return {"case": {"process": Timing((float(os.getpid()),))}}


def test_links_pressed_on_each_other_are_less_than_a_millimetre_in_each_other():
    """As deep as their force over the stiffness, by the poses; two pairs of a robot whose gains press hardest."""
    parser = argparse.ArgumentParser()
    surroundings.add_arguments(parser)
    report = surroundings.run(parser.parse_args(["--robot", "mit_humanoid", "--parts", "depth"]))
    (table,), stiffness = report.tables, Model("mit_humanoid").robot.material.stiffness
    shanks = [row for row in table.rows if "knee" in str(row[0])]
    assert len(shanks) == len(pressed.OVERLAPS)
    for _, asked, depth, deepest, force in shanks:
        assert 0.02 < float(depth) <= float(deepest) <= 1.0  # [mm]; asked for five times as much and more
        assert float(depth) < 0.1 * 10 * float(asked)
        assert 1e-3 * float(depth) * stiffness == pytest.approx(float(force), rel=1e-6)
    assert report.requirements
    assert all(requirement.met for requirement in report.requirements)


def test_targets_are_as_deep_as_asked(model: Model):
    pair = surroundings.neighbours(model)[0]
    q = model.standing_q.copy()
    assert pressed.depth(model, q, pair) < 0
    q[model.robot.layout.joints_q :] = pressed.folded(model, pair, 0.01)
    assert 0.01 <= pressed.depth(model, q, pair) < 0.013
    with pytest.raises(ValueError, match="do not meet"):
        pressed.folded(model, pair, 1.0)


def test_energy_before_robots_are_let_go_is_what_the_simulator_counts(model: Model):
    """After a step so short that nothing has moved; springs of links in each other are most of it."""
    pairs = surroundings.neighbours(model)
    q, v = released.folded_states(model, pairs)
    q, v = q[:12], v[:12]  # each pair, each depth
    sim = Simulator(
        model, 12, dt=1e-7, control="torque", contacts=(), self_collisions=pairs, outputs=("energy",),
        parameters=("gravity",),
    )  # fmt: skip
    sim.set_parameter("gravity", 0.0)
    sim.set_state(q, v)
    sim.step(np.zeros(12))
    found = released.energy(model, q, v, pairs)
    assert found == pytest.approx(sim.energy, rel=2e-4)
    assert (found[2::3] > 3 * model.energy(q, v)[0][2::3]).all()  # those that are 2 cm deep


def test_robots_let_go_gain_nothing(model: Model):
    report = released.let_go(model, surroundings.neighbours(model), steps=40)
    (table,) = report.tables
    assert [row[0] for row in table.rows] == ["the start", "the first step"]
    assert all(requirement.met for requirement in report.requirements)
