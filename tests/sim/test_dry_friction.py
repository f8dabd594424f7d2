"""Dry friction of motors in compiled kernels, in both precisions: a leg is held for ten minutes, or falls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ce_gym import Model, Simulator
from ce_gym.model import load_robot

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
    """At 0.99 of what friction has nothing moves in ten minutes; at 1.01 the leg falls."""
    sim = Simulator(held_leg(0.99), 1, DT, dtype, control="torque", motors="limited", outputs=())
    start = sim.q.copy()
    sim.step(np.zeros(5), 60_000)
    np.testing.assert_array_equal(sim.q, start)
    assert np.abs(sim.v).max() < 1e-4
    sim = Simulator(held_leg(1.01), 1, DT, dtype, control="torque", motors="limited", outputs=())
    sim.step(np.zeros(5), 100)
    assert np.abs(sim.q - start).max() > 1e-3
