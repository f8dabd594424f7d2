"""Motors whose torque follows its command with a finite bandwidth, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from elastic_robots import LINK, RATIO, ROTOR, differential, turntable

import ce_gym
from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.model import Motor, Robot
from ce_gym.model.description import Gains

BANDWIDTH = 20.0
KP, KD = 30.0, 1.0
INERTIA = LINK + RATIO**2 * ROTOR


def table(torque: float = np.inf) -> Robot:
    """A geared joint without gravity whose motor's torque lags."""
    gains = Gains((("table", KP),), (("table", KD),))
    return replace(turntable(1.0), elastic=(), motors=(Motor("rotor", torque, bandwidth=BANDWIDTH),), gains=gains)


def run(robot: Robot, target: list[float], dt: float, steps: int, control: str) -> dict[str, np.ndarray]:
    """Angles and torques of motors over steps from rest."""
    model = Model(robot)
    options = StepOptions(control=control, motors="limited")  # type: ignore[arg-type]
    function = step_function(model.mechanism, options, ("motor_torque",))
    state = {"q": ca.DM.zeros(model.nq), "v": ca.DM.zeros(model.nv), "lagging_torque": ca.DM.zeros(len(robot.motors))}
    found: dict[str, list[np.ndarray]] = {"q": [], "motor_torque": []}
    for _ in range(steps):
        after = function(**state, diverged=0, target=target, dt=dt)
        state = {name: after[f"{name}_next"] for name in state}
        found["q"].append(state["q"].full().ravel())
        found["motor_torque"].append(after["motor_torque"].full().ravel())
    return {name: np.array(values) for name, values in found.items()}


def test_a_torque_rises_as_a_lag_of_first_order():
    """Each step covers `h / (T + h)` of the remaining difference: `1 - exp(-t / T)` to first order."""
    dt, asked = 1e-3, 0.8
    torque = run(table(), [asked], dt, 60, "torque")["motor_torque"][:, 0]
    lag, k = 1 / (2 * np.pi * BANDWIDTH), np.arange(1, 61)
    np.testing.assert_allclose(torque, asked / RATIO * (1 - (1 + dt / lag) ** -k), rtol=1e-12)
    np.testing.assert_allclose(torque, asked / RATIO * (1 - np.exp(-k * dt / lag)), atol=0.05 * asked / RATIO)


def test_it_stays_within_the_torque_limit():
    torque = run(table(torque=0.05), [0.8], 1e-3, 60, "torque")["motor_torque"][:, 0]
    assert torque.max() == pytest.approx(0.05, rel=1e-12)
    assert (np.diff(torque) >= 0).all()


def test_position_control_through_it_is_that_of_the_linear_system():
    """`J y'' = u, T u' = kp (r - y) - kd y' - u`, which rings; errors of first order in the step."""
    lag, target, every = 1 / (2 * np.pi * BANDWIDTH), 0.4, 2e-3
    A = np.array([[0, 1, 0], [0, 0, 1 / INERTIA], [-KP / lag, -KD / lag, -1 / lag]])
    values, vectors = np.linalg.eig(A)
    start = np.linalg.solve(vectors, np.array([-target, 0, 0], dtype=complex))
    times = every * np.arange(1, 101)
    expected = target + (vectors[0] * start * np.exp(np.outer(times, values))).sum(1).real
    assert expected.max() > 1.1 * target
    errors = []
    for n in (1, 2, 4):
        angles = run(table(), [target], every / n, 100 * n, "position")["q"][n - 1 :: n, 0]
        errors.append(np.abs(angles - expected).max())
    assert errors[0] < 0.1 * target
    assert 1.7 < errors[0] / errors[1] < 2.3
    assert 1.7 < errors[1] / errors[2] < 2.3


def test_the_command_is_that_of_the_end_of_the_step():
    """However stiff: the torque covers its share of the way to the command at the end of the step."""
    model = Model(table())
    options = StepOptions(control="position", motors="limited")
    function = step_function(model.mechanism, options, ("motor_torque",))
    before, target, dt = -0.3, 0.4, 0.05
    after = function(q=0.1, v=-2.0, lagging_torque=before, diverged=0, target=target, dt=dt)
    q, v = float(after["q_next"]), float(after["v_next"])
    part = dt / (1 / (2 * np.pi * BANDWIDTH) + dt)
    expected = before + part * ((KP * (target - q) - KD * v) / RATIO - before)
    assert float(after["motor_torque"]) == pytest.approx(expected, rel=1e-10)
    assert float(after["lagging_torque_next"]) == float(after["motor_torque"])


def test_motors_of_a_differential_lag_each_by_itself():
    """Two rotors on two joints, of two bandwidths: torques at the joints rise with the torques of the motors."""
    robot = differential()
    robot = replace(robot, motors=(Motor("sum", bandwidth=10.0), Motor("difference", bandwidth=40.0)))
    asked, dt = np.array([0.9, -0.5]), 1e-3
    torque = run(robot, list(asked), dt, 20, "torque")["motor_torque"]
    W = np.array([[3.0, 4.0], [3.0, -4.0]])
    k = np.arange(1, 21)[:, None]
    lags = 1 / (2 * np.pi * np.array([10.0, 40.0]))
    np.testing.assert_allclose(torque, np.linalg.solve(W.T, asked) * (1 - (1 + dt / lags) ** -k), rtol=1e-12)


def test_explicit_methods_are_refused():
    with pytest.raises(ValueError, match="method='rk4'; expected an implicit one"):
        ce_gym.Simulator(Model(table()), method="rk4", motors="limited")
