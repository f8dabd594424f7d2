"""Tests of stability that other projects publish, and some of our own, each with an analytic or physical bound.

MuJoCo: free bodies, a spinning body in contact, the depth of a resting block. SimBenchmark: a rolling ball, the
momentum of a robot in free fall, a humanoid under stiff position control. Drake: blocks that slide or hold on a slope.
Where they state a time step, ours is five times as long.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import small_mechanisms as mechanisms
from small_mechanisms import GRAVITY, GROUND, simulator

from ce_gym import Model, Robot, Simulator, load_robot

pytestmark = pytest.mark.slow
NO_TORQUE = np.zeros(0)


def kinetic_energy(sim: Simulator) -> np.ndarray:
    """Return kinetic energies [J], shape (num_envs,)."""
    return sim.model.energy(sim.q, sim.v)[0]


def linear_momentum(sim: Simulator) -> np.ndarray:
    """Return the momentum of the first robot in the world [kg m/s], shape (3,)."""
    base_rotation = sim.model.body_poses(sim.q[0])[1][0]
    return base_rotation @ (sim.model.mass_matrix(sim.q[0]) @ sim.v[0])[3:6]


def base_speed(sim: Simulator) -> float:
    """Return the speed of the origin of the first base [m/s]."""
    return float(np.linalg.norm(sim.v[0, 3:6]))


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def test_kinetic_energy_of_a_free_body_stays_bounded():
    """MuJoCo: a body spinning about its middle axis and one at 20 rad/s, 20 000 steps of 25 ms (theirs: 5 ms)."""
    sim = simulator(mechanisms.free_body(), 0.025, 2)
    sim.set_state(sim.model.standing_q, [[0.05, 5.0, 0.05, 0.0, 0.0, 0.0], [20.0, 0.2, 0.3, 0.0, 0.0, 0.0]])
    start = kinetic_energy(sim)
    for _ in range(200):
        sim.step(NO_TORQUE, 100)
        assert (kinetic_energy(sim) <= 1.01 * start).all()
    assert not sim.diverged.any()


def test_a_free_body_loses_little_energy_and_momentum():
    """MuJoCo: 5 s at 50 ms (theirs: 10 ms)."""
    sim = simulator(mechanisms.free_body(), 0.05)
    sim.set_state(sim.model.standing_q, [1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
    moments = np.diag((0.02, 0.03, 0.04))

    def angular_momentum() -> np.ndarray:
        return sim.model.body_poses(sim.q[0])[1][0] @ moments @ sim.v[0, :3]

    first_momentum, energies = angular_momentum(), [kinetic_energy(sim)[0]]
    for _ in range(100):
        sim.step(NO_TORQUE)
        energies.append(kinetic_energy(sim)[0])
    assert np.diff(energies).max() <= 1e-12 * energies[0]
    assert energies[-1] > 0.7 * energies[0]
    assert np.linalg.norm(angular_momentum() - first_momentum) < 0.05 * np.linalg.norm(first_momentum)


def test_a_spinning_egg_on_a_slope_does_not_speed_up():
    """MuJoCo: a long body dropped at 30 rad/s on a slope of 15 degrees, 5000 steps of 10 ms (theirs: 2 ms)."""
    sim = simulator(mechanisms.egg(math.radians(15)), 0.01)
    sim.set_state([0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 30.0, 0.0, 0.0, 0.0])
    for _ in range(5000):
        sim.step(NO_TORQUE)
        assert np.linalg.norm(sim.v[0, :3]) < 2 * 30.0
    assert not sim.diverged.any()


def test_a_block_rests_as_deep_as_its_springs_carry_it():
    """MuJoCo: at 10 ms, weight over stiffness."""
    sim = simulator(mechanisms.block(), 0.01)
    sim.step(NO_TORQUE, 3000)
    assert 0.05 - sim.q[0, 2] == pytest.approx(10.0 * GRAVITY / (4 * GROUND.stiffness), rel=1e-6)


def test_a_sliding_ball_comes_to_roll():
    """SimBenchmark: a ball set sliding at 1 m/s rolls at 5/7 m/s, and keeps that speed for 10 s at 5 ms."""
    sim = simulator(mechanisms.ball(), 0.005)
    resting = sim.model.standing_q - [0, 0, GRAVITY / GROUND.stiffness, 0, 0, 0, 0]
    sim.set_state(resting, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    sim.step(NO_TORQUE, 200)
    rolling_speed = base_speed(sim)
    assert rolling_speed == pytest.approx(5 / 7, rel=0.05)
    sim.step(NO_TORQUE, 2000)
    assert base_speed(sim) <= rolling_speed * (1 + 1e-6)
    assert 0.1 * np.linalg.norm(sim.v[0, :3]) == pytest.approx(base_speed(sim), rel=0.01)


def test_momentum_of_a_quadruped_in_free_fall_is_that_of_gravity():
    """SimBenchmark: for 1 s at 5 ms while it spreads its legs; weight times time within 2 %."""
    model = Model("mini_cheetah")
    sim = Simulator(model, 1, 0.005, contacts=(), outputs=())
    v = np.zeros(model.nv)
    v[:3] = 1.0, -2.0, 3.0
    sim.set_state(model.standing_q, v)
    before = linear_momentum(sim)
    sim.step(model.standing_q[7:] + 0.3, 200)
    weight = GRAVITY * model.total_mass
    np.testing.assert_allclose(linear_momentum(sim) - before, [0.0, 0.0, -weight], atol=0.02 * weight)


def test_a_humanoid_stands_under_stiff_position_control():
    """SimBenchmark: gains of 5e4 N m/rad, 20 s at 2.5 ms (theirs: 0.5 ms)."""
    robot = load_robot("jvrc1")
    names = [name for name, _ in robot.gains.kp]
    stiff = replace(robot.gains, kp=tuple((n, 5e4) for n in names), kd=tuple((n, 5e2) for n in names))
    model = Model(replace(robot, gains=stiff))
    sim = Simulator(model, 1, 0.0025, outputs=())
    sim.step(model.standing_q[7:], 8000)
    assert rms(sim.v) <= 1e-6
    assert sim.q[0, 2] > 0.95 * model.standing_q[2]


def distance_slid(pull: float, speed: float, time: float) -> float:
    """Return how far the sole of a block slides from its rest depth, at 4 ms [m].

    Args:
        pull: Constant horizontal acceleration [m/s^2].
        speed: At the start [m/s].
        time: [s].
    """
    sim = simulator(mechanisms.block(pull=pull), 0.004)
    q, v = sim.model.standing_q.copy(), np.zeros(6)
    q[2] -= sim.model.total_mass * GRAVITY / 4 / GROUND.stiffness
    v[3] = speed
    sim.set_state(q, v)
    start = sim.model.contact_points(q, v)[0][:, 0].mean()
    sim.step(NO_TORQUE, round(time / sim.dt))
    return float(sim.model.contact_points(sim.q[0], sim.v[0])[0][:, 0].mean() - start)


def test_a_block_slides_as_far_as_coulomb_says():
    """Drake, ours: pulled with 1.2 times its friction from rest; and set sliding at 1 m/s."""
    cone = GROUND.friction * GRAVITY
    assert distance_slid(1.2 * cone, 0.0, 0.1) == pytest.approx(0.2 * cone * 0.1**2 / 2, rel=0.05)
    assert distance_slid(0.0, 1.0, 1.0) == pytest.approx(1 / (2 * cone), rel=0.05)


def test_a_block_on_a_slope_does_not_creep():
    """Drake, ours: at 0.8 of what friction can hold."""
    sim = simulator(mechanisms.block(tilt=math.atan(0.4)), 0.004)
    sim.step(NO_TORQUE, 5000)
    before = sim.q[0, :2].copy()
    sim.step(NO_TORQUE, 2500)
    assert np.linalg.norm(sim.q[0, :2] - before) <= 10.0 * 1e-9


def largest_gain(robot: Robot, time: float, method: str) -> float:
    """Return how far an undamped mechanism rises above its energy at 1 ms, as a share of its potential energy.

    It is released with its first two joints at a right angle to gravity.
    """
    sim = simulator(robot, 0.001, method=method)
    n = len(robot.independent)
    q = np.zeros(n)
    q[:2] = math.pi / 2
    sim.set_state(q, np.zeros(n))
    start, lowest = (float(np.sum(sim.model.energy(x, np.zeros(n)))) for x in (q, np.zeros(n)))
    highest = -math.inf
    for _ in range(round(time / sim.dt)):
        sim.step(np.zeros(n))
        highest = max(highest, float(sim.energy[0]))
    assert not sim.diverged.any()
    return (highest - start) / (start - lowest)


@pytest.mark.parametrize("mass_ratio", [1e-4, 1e-2, 1.0, 1e2, 1e4])
def test_double_pendulums_of_any_mass_ratio_keep_their_energy(mass_ratio: float):
    robot = mechanisms.chain(2, mass_ratio)
    assert math.isfinite(largest_gain(robot, 5.0, "euler"))
    assert largest_gain(robot, 5.0, "extrapolated") <= 0.01


@pytest.mark.parametrize("n", [5, 10, 30])
def test_chains_keep_their_energy(n: int):
    robot = mechanisms.chain(n)
    assert math.isfinite(largest_gain(robot, 1.0, "euler"))
    assert largest_gain(robot, 1.0, "extrapolated") <= 0.01


@pytest.mark.parametrize("ratio", [1.0, 6.0, 30.0, 100.0, 300.0, -1.0, -30.0, -300.0])
def test_a_geared_pendulum_swings_with_its_reflected_inertia(ratio: float):
    """At a quarter of its period, steps of 2 ms."""
    sim = simulator(mechanisms.geared_pendulum(ratio), 0.002, outputs=())
    inertia = 1e-3 + 0.25 + 1e-5 * ratio**2
    rate = math.sqrt(GRAVITY * 0.5 / inertia)
    steps = round(math.pi / 2 / rate / sim.dt)
    sim.set_state([0.01], [0.0])
    sim.step([0.0], steps)
    assert sim.q[0, 0] == pytest.approx(0.01 * math.cos(rate * steps * sim.dt), abs=0.01 * 0.01)


def test_a_light_foot_on_stiff_ground_comes_to_rest():
    """A foot of 1 g under 2 kg on ground of 1e6 N/m, 3 s at 5 ms.

    It starts on the ground: in flight the controller, sampled with every step, would be unstable for so light a foot.
    """
    sim = simulator(mechanisms.leg_with_light_foot(1e-3), 0.005)
    sim.set_state([0.21, 0.0], [0.0, 0.0])
    for _ in range(600):
        sim.step([0.0, -200.0 * float(sim.q[0, 1]) - 20.0 * float(sim.v[0, 1])])
    assert rms(sim.v) <= 1e-6


def test_a_four_bar_linkage_stays_closed_for_a_thousand_turns():
    """At 50 rad/s, steps of 1 ms."""
    sim = simulator(mechanisms.four_bar(0.1, 0.3, 0.3, 0.25, damping=0.02), 0.001, outputs=("loop_gap",))
    for _ in range(4000):
        sim.step([1.0], 100)
        assert sim.loop_gap[0] <= 1e-10
        if abs(sim.q[0, 0]) >= 1000 * 2 * math.pi:
            break
    assert abs(sim.q[0, 0]) >= 1000 * 2 * math.pi


def test_a_four_bar_linkage_turns_through_a_transmission_angle_of_two_degrees():
    crank, coupler, rocker = 0.1, 0.3, 0.25
    ground = crank + math.sqrt(coupler**2 + rocker**2 - 2 * coupler * rocker * math.cos(math.radians(2)))
    sim = simulator(mechanisms.four_bar(crank, ground, coupler, rocker, damping=0.02), 0.001, outputs=("loop_gap",))
    sim.set_state([1.5], [5.0])
    before = float(sim.q[0, 0])
    for _ in range(2000):
        sim.step([0.1])
        assert sim.loop_gap[0] <= 1e-10
    assert abs(float(sim.q[0, 0]) - before) >= 2 * math.pi
