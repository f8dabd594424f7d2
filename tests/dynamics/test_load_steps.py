"""Load-dependent friction from step to step: its load in a first step, and in steps of several stages."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from test_drive_friction import GRAVITY, LENGTH, MASS, RATIO, pendulum

from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.model import DriveFriction, Motor, load_robot

DRIVE = DriveFriction(efficiency=0.7, backdriving_efficiency=0.5, load_motor=0.1)


@pytest.mark.parametrize("method", ["euler", "extrapolated"])
def test_a_first_step_from_motion_applies_no_impulse(method: str):
    """With unknown loads of the motors, a step of 10 us changes velocities as little as with known loads."""
    robot = load_robot("mit_humanoid_leg")
    model = Model(replace(robot, motors=tuple(replace(motor, drive_friction=DRIVE) for motor in robot.motors)))
    function = step_function(model.mechanism, StepOptions(control="torque", motors="limited", method=method))
    v = np.array([1.0, -1.0, 1.5, -2.0, 1.5])
    target = model.bias_force(model.standing_q, np.zeros(5)) + np.array([1.0, 1.0, 1.0, -3.0, 1.0])
    given = {"q": model.standing_q, "v": v, "diverged": 0, "target": target, "dt": 1e-5}
    first = function(**given, motor_load=np.zeros(11))
    known = function(**given, motor_load=first["motor_load_next"])
    assert np.abs(first["v_next"].full().ravel() - v).max() < 2e-3
    np.testing.assert_allclose(first["v_next"], known["v_next"], atol=1e-5)
    np.testing.assert_allclose(first["motor_load_next"], known["motor_load_next"], atol=0.05)


def lifted(method: str, dt: float) -> float:
    """Angle of a pendulum that a motor has lifted for 0.2 s [rad]."""
    robot = pendulum(Motor("rotor", friction=0.005, damping=1e-4, drive_friction=DRIVE), 0.02)
    function = step_function(Model(robot).mechanism, StepOptions(control="torque", motors="limited", method=method))
    load = -MASS * GRAVITY * LENGTH * np.sin(0.3) / RATIO
    state = {"q": ca.DM(0.3), "v": ca.DM(2.0), "motor_load": ca.DM([4.0 / RATIO, load, 1.0])}
    for _ in range(round(0.2 / dt)):
        after = function(**state, diverged=0, target=4.0, dt=dt)
        state = {name: after[f"{name}_next"] for name in state}
    return float(state["q"])


@pytest.mark.parametrize(("method", "order"), [("euler", 1), ("extrapolated", 2)])
def test_methods_keep_their_order_under_load(method: str, order: int):
    angles = [lifted(method, dt) for dt in (0.01, 0.005, 0.0025)]
    assert (angles[0] - angles[1]) / (angles[1] - angles[2]) == pytest.approx(2**order, rel=0.05)
