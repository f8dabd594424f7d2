"""Closed loops in time: they stay closed, iterations follow them, and singularities freeze a robot."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.model import Robot, load_robot, robots
from ce_gym.model.mechanism import LEVELS
from ce_gym.sim.simulator import Simulator

sys.path.insert(0, str(Path(__file__).parents[1] / "dynamics"))  # for dense.py
from dense import Dense
from linkages import four_bar, rod_leg, spatial_four_bar

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.InertiaWarning")

DT = 0.005


def turning(torque: float = 20.0) -> Robot:
    """The spatial crank-rocker, found by iteration, with friction at the crank so that its speed stays finite."""
    robot = spatial_four_bar()
    crank, *rest = robot.bodies
    crank = replace(crank, joint=replace(crank.joint, torque=torque, damping=0.2))
    return replace(robot, bodies=(crank, *rest))


LOOPS = ("four_bar", "six_bar", "planar_leg_linkage", "tello", "tello_with_arms", "g1", "spot", "cassie", "dr_legs")
ROBOTS = {name: lambda name=name: load_robot(name) for name in LOOPS}
ROBOTS["spatial four-bar"] = turning


def test_every_robot_with_loops_is_here():
    loops = {name for name in robots() if not all(tie.linear for tie in load_robot(name).constraints)}
    assert loops == set(LOOPS)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_loops_stay_closed(name: str):
    """60 s under random torque, 10 s of large robots: the gap that the kernel itself sees is at most 1e-10 m."""
    model = Model(ROBOTS[name]())
    simulator = Simulator(model, 8, DT, control="torque", outputs=("loop_gap", "nearness"))
    limit = np.array([min(model.robot.body(joint).joint.torque, 10.0) for joint in model.joint_links])
    rng, worst, start = np.random.default_rng(0), 0.0, simulator.q
    for _ in range(600 if model.nv < 10 else 100):
        simulator.step(rng.uniform(-0.3, 0.3, (8, len(limit))) * limit, 20)
        worst = max(worst, float(simulator.loop_gap.max()))
    assert not simulator.diverged.any()
    assert worst <= 1e-10
    assert np.abs(simulator.q - start).max() > 0.1  # it did move
    if len(model.guess):
        assert np.abs(simulator.q - start).max() > 2 * np.pi  # all the way round
        return
    for q_span, v_span in zip(*model.spanning(simulator.q, simulator.v), strict=True):  # seen without our kinematics
        assert np.abs(Dense(model.robot, q_span, v_span).constraints()[0]).max() <= 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("made", [four_bar, rod_leg])
def test_free_linkages_keep_their_energy(made, level: str):
    """A motor behind a loop, of one freedom and of two: without gravity and losses nothing changes the energy."""
    model = Model(made(gravity=(0.0, 0.0, 0.0)), level)
    v = np.random.default_rng(3).normal(0, 0.5, model.nv)
    v[-1] = 4.0
    sim = Simulator(model, 1, dt=1e-3, method="rk4", control="torque", outputs=())
    sim.set_state(model.standing_q, v)
    before = model.energy(sim.q[0], sim.v[0])[0]
    sim.step(np.zeros(len(model.joint_links)), 200)
    assert np.abs(sim.q[0] - model.standing_q)[-1] > 0.3
    assert model.energy(sim.q[0], sim.v[0])[0] == pytest.approx(before, rel=1e-6)


def test_iterations_follow_a_fast_crank():
    """At 20 rad/s the guess of one step to the next is good enough for rounding error."""
    model = Model(turning())
    simulator = Simulator(model, 1, DT, control="torque", outputs=("loop_gap",))
    simulator.set_state(model.standing_q, [20.0])
    for _ in range(50):
        simulator.step([0.0], 1)
        assert simulator.loop_gap[0] < 1e-12
    # the carried branch is the one that a walk from the reference pose finds
    turned = simulator.q[0] % (2 * np.pi)
    assert model.loop_gap(turned) < 1e-12


def test_a_singularity_freezes_the_robot():
    """Without its limits the parallelogram is driven flat: flagged and frozen at finite numbers, in a good position."""
    robot = load_robot("four_bar")
    crank, *rest = robot.bodies
    free = replace(crank, joint=replace(crank.joint, position=(-np.inf, np.inf)))
    model = Model(replace(robot, bodies=(free, *rest)))
    simulator = Simulator(model, 2, 2e-4, control="torque", outputs=("nearness",))  # no step passes the flat pose
    for _ in range(100):
        simulator.step([[-5.0], [0.0]], 60)
    assert simulator.diverged.tolist() == [True, False]
    assert 0 < simulator.q[0, 0] < 0.1  # it stopped before, at the last position that closes
    assert np.isfinite(simulator.q).all()
    assert np.isfinite(simulator.v).all()
    assert model.loop_gap(simulator.q[0]) < 1e-12
    simulator.reset()
    assert not simulator.diverged.any()


def flailing(robot: Robot) -> int:
    """Return how many of 256 robots without rotors diverge in 3 s under random torques of 1.5 times the limits."""
    model, rng = Model(robot, "none"), np.random.default_rng(0)
    simulator = Simulator(model, 256, DT, control="torque")
    limit = 1.5 * np.array([robot.body(joint).joint.torque for joint in model.joint_links])
    for _ in range(150):
        simulator.step(rng.uniform(-limit, limit, (256, len(limit))), 4)
    return int(simulator.diverged.sum())


@pytest.mark.slow
def test_stops_keep_loops_from_their_dead_centres():
    """Stops of feet or of cranks: without either, feet are thrown past the end of their rods' reach."""
    robot, unlimited = load_robot("tello"), (-np.inf, np.inf)
    bodies = tuple(
        replace(body, joint=replace(body.joint, position=unlimited))
        if "crank" in body.name or "foot" in body.name
        else body
        for body in robot.bodies
    )
    assert flailing(robot) == 0 < flailing(replace(robot, bodies=bodies))


def test_a_start_that_cannot_be_closed_is_refused():
    model = Model(replace(turning(), independent=("crank",)))
    simulator = Simulator(model, 2, DT, control="torque")
    simulator.set_state([[0.3], [1.0]], np.zeros((2, 1)))
    np.testing.assert_allclose(simulator.q, [[0.3], [1.0]])


def test_one_robot_does_not_depend_on_the_others():
    model = Model(turning())
    alone, together = (Simulator(model, n, DT, control="torque") for n in (1, 5))
    together.set_state(np.linspace(0.7, 1.1, 5)[:, None], np.zeros((5, 1)))
    for _ in range(20):
        alone.step([0.3], 5)
        together.step([0.3], 5)
    np.testing.assert_array_equal(alone.q[0], together.q[0])
