"""Dry friction of motors in compiled kernels, in both precisions: a leg is held for ten minutes, or falls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ce_gym import Model, Simulator
from ce_gym.model import DriveFriction, Elasticity, load_robot

DT = 0.01


def held_leg(share: float) -> Model:
    """A leg with belts whose motors have a share of what holds it in its standing pose, and nothing else."""
    robot = load_robot("mit_humanoid_leg")
    model = Model(robot)
    needed = np.linalg.solve(model.actuator_matrix(model.standing_q).T, model.bias_force(model.standing_q, np.zeros(5)))
    motors = tuple(
        replace(motor, friction=abs(torque) / share) for motor, torque in zip(robot.motors, needed, strict=True)
    )
    return Model(replace(robot, motors=motors))


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_leg_is_held_to_the_bit(dtype: str):
    """At 0.99 of the dry friction nothing moves in ten minutes; at 1.01 the leg falls."""
    sim = Simulator(held_leg(0.99), 1, DT, dtype, control="torque", motors="limited", outputs=())
    start = sim.q.copy()
    sim.step(np.zeros(5), 60_000)
    np.testing.assert_array_equal(sim.q, start)
    assert not sim.v.any()
    sim = Simulator(held_leg(1.01), 1, DT, dtype, control="torque", motors="limited", outputs=())
    sim.step(np.zeros(5), 100)
    assert np.abs(sim.q - start).max() > 1e-3


@pytest.mark.parametrize("method", ["euler", "extrapolated", "adaptive"])
@pytest.mark.parametrize("share", [0.3, 0.99])
def test_a_stretching_leg_comes_to_rest_and_stays(share: float, method: str):
    """Rotors stand; joints settle on their springs, and then nothing moves in a minute.

    With extrapolation `v` keeps the difference between the equilibria of a whole step and of its halves.
    """
    robot = held_leg(share).robot
    stretches = tuple(Elasticity(motor.rotor, 20.0, 0.05) for motor in robot.motors)
    model = Model(replace(robot, elastic=stretches), transmission="elastic")
    sim = Simulator(model, 1, DT, control="torque", motors="limited", method=method, outputs=())
    sim.step(np.zeros(5), 1000)
    settled = sim.q
    sim.step(np.zeros(5), 6000)
    np.testing.assert_allclose(sim.q, settled, rtol=0, atol=1e-10)
    assert np.abs(sim.v).max() < (1e-11 if method == "euler" else 2e-5)
    assert np.abs(model.actuator_matrix(sim.q[0]) @ sim.v[0]).max() < 1e-12


def loaded_leg(share: float) -> tuple[Model, np.ndarray]:
    """That leg with friction in proportion to what its gears and belts carry, and torques of half of what holds it."""
    robot = load_robot("mit_humanoid_leg")
    model = Model(robot)
    half = 0.5 * model.bias_force(model.standing_q, np.zeros(5))
    friction = DriveFriction(load_motor=1 / (3 * share), load_external=1 / (3 * share))
    motors = tuple(replace(motor, drive_friction=friction) for motor in robot.motors)
    return Model(replace(robot, motors=motors)), half


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_leg_is_held_by_friction_under_load(dtype: str):
    """Motors carry half of the load and friction the other half: the same bounds, from the first step."""
    model, half = loaded_leg(0.99)
    sim = Simulator(model, 1, DT, dtype, control="torque", motors="limited", outputs=())
    start = sim.q.copy()
    sim.step(half, 60_000)
    np.testing.assert_array_equal(sim.q, start)
    assert not sim.v.any()
    model, half = loaded_leg(1.01)
    sim = Simulator(model, 1, DT, dtype, control="torque", motors="limited", outputs=())
    sim.step(half, 100)
    assert np.abs(sim.q - start).max() > 1e-3


@pytest.mark.parametrize("method", ["euler", "extrapolated", "adaptive"])
def test_robots_with_friction_under_load_keep_to_themselves(method: str):
    """In a batch, whose tiles iterate together, each robot moves as alone, bit for bit: held, slipping, driven."""
    model, half = loaded_leg(0.99)
    rng = np.random.default_rng(0)
    targets = half * rng.uniform(0.0, 2.5, (8, 5))
    speeds = rng.uniform(-1.0, 1.0, (8, 5)) * (np.arange(8) % 2)[:, None]

    def moved(chosen: list[int]) -> np.ndarray:
        sim = Simulator(model, len(chosen), DT, control="torque", motors="limited", method=method, outputs=())
        for _ in range(2):  # the second time after a state was set: nothing is left of the first
            before = sim.q.copy()
            sim.set_state(np.tile(model.standing_q, (len(chosen), 1)), speeds[chosen])
            for _ in range(40):
                sim.step(targets[chosen])
        np.testing.assert_array_equal(sim.q, before)
        return sim.q.copy()

    together = moved(list(range(8)))
    for i in range(8):
        np.testing.assert_array_equal(together[i], moved([i])[0])
