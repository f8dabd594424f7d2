"""Controllers that look every so often and hold their torques, against exact discrete-time systems."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from elastic_robots import LINK, RATIO, ROTOR, differential, turntable
from scipy.linalg import expm

import ce_gym
from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.laws.scene_laws import state_sizes
from ce_gym.dynamics.stepping.trace import iteration_function, step_function
from ce_gym.model import Motor, Robot
from ce_gym.model.description import Gains

KP, KD, TARGET = 30.0, 1.0, 0.4
INERTIA = LINK + RATIO**2 * ROTOR


def table(kp: float = KP, kd: float = KD) -> Robot:
    """A geared joint without gravity."""
    gains = Gains((("table", kp),), (("table", kd),))
    return replace(turntable(1.0), elastic=(), motors=(Motor("rotor"),), gains=gains)


def run(robot: Robot, target: list[float], dt: float, steps: int, control: str = "position", period: float = 0.0):
    """Angles and torques at the joints after each step, from rest."""
    model = Model(robot)
    options = StepOptions(control=control, control_period=period)  # type: ignore[arg-type]
    function = step_function(model.mechanism, options, ("torque",))
    state = {name: ca.DM.zeros(size) for name, size in state_sizes(model.mechanism, options).items()}
    angles, torques = [], []
    for _ in range(steps):
        after = function(**state, diverged=0, target=target, dt=dt)
        state = {name: after[f"{name}_next"] for name in state}
        angles.append(state["q"].full().ravel())
        torques.append(after["torque"].full().ravel())
    return np.array(angles), np.array(torques)


def held_exactly(kp: float, kd: float, period: float, samples: int) -> np.ndarray:
    """Angles at samples of `J y'' = u`, u held: the system in discrete time has no error."""
    A, b = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([0.0, 1 / INERTIA])
    whole = expm(np.block([[A, b[:, None]], [np.zeros((1, 3))]]) * period)
    x, angles = np.zeros(2), []
    for _ in range(samples):
        u = kp * (TARGET - x[0]) - kd * x[1]
        x = whole[:2, :2] @ x + whole[:2, 2] * u
        angles.append(x[0])
    return np.array(angles)


def test_a_sampled_controller_is_the_system_in_discrete_time():
    """The steps between samples only integrate; a constant torque turns a body exactly as it should."""
    period, samples = 0.008, 40
    expected = held_exactly(KP, KD, period, samples)
    assert np.abs(expected - run(table(), [TARGET], 1e-5, 800 * samples)[0][799::800, 0]).max() > 0.03
    for n in (4, 8, 16):
        angles, _ = run(table(), [TARGET], period / n, n * samples, period=period)
        np.testing.assert_allclose(angles[n - 1 :: n, 0], expected, atol=1e-9 * TARGET)


def test_torques_are_held_in_between():
    """Whatever the numbers of steps to a sample come to in binary; from the first step on."""
    for n in (1, 3, 7):
        _, torques = run(table(), [TARGET], 0.0007, 20 * n, period=n * 0.0007)
        rows = torques.reshape(20, n)
        np.testing.assert_array_equal(rows, np.repeat(rows[:, :1], n, axis=1))
        assert (np.diff(rows[:, 0]) != 0).all()
        assert rows[0, 0] == pytest.approx(KP * TARGET)


def test_gains_beyond_a_period_are_unstable_as_in_discrete_time():
    """`kd < 2 J / T` is where a damper alone ceases to be stable; a controller that never stops always is."""
    period = 0.01
    limit = 2 * INERTIA / period
    for share, grows in ((0.9, False), (1.1, True)):
        robot = table(1e-3, share * limit)
        _, torques = run(robot, [TARGET], period / 20, 4000, period=period)
        assert (np.abs(torques[-1, 0]) > 10 * np.abs(torques[0, 0])) == grows, share
        assert np.abs(run(robot, [TARGET], period / 20, 4000)[0]).max() < TARGET


def test_control_at_motors_is_that_at_joints_behind_a_gear():
    """Both controls are the same there, sampled or not."""
    at_joint, torque = run(table(), [TARGET], 0.001, 60, period=0.004)
    at_motor, same = run(table(), [TARGET * RATIO], 0.001, 60, "motor_position", 0.004)
    np.testing.assert_allclose(at_motor, at_joint, rtol=1e-10)
    np.testing.assert_allclose(same, torque, rtol=1e-9)


def test_a_differential_is_sampled_at_its_motors():
    _, torques = run(differential(), [0.3, 0.2], 0.001, 40, "motor_position", 0.004)
    rows = torques.reshape(10, 4, 2)
    np.testing.assert_allclose(rows, np.repeat(rows[:, :1], 4, axis=1), rtol=1e-12)
    assert (np.abs(np.diff(rows[:, 0], axis=0)) > 1e-6).all()


def test_without_a_period_nothing_is_traced():
    def text(**options: object) -> str:
        return iteration_function(Model(table()).mechanism, StepOptions(**options)).serialize()  # type: ignore[arg-type]

    assert text(control="torque", control_period=0.01) == text(control="torque")
    assert text(control_period=0.01) != text()


@pytest.mark.parametrize("method", ["euler", "extrapolated"])
def test_kernels_do_the_same(method):
    """In lanes, both precisions, and over resets: a controller looks at once after one."""
    robot = table()
    expected, _ = run(robot, [TARGET], 0.001, 40, period=0.004)
    for dtype, close in (("float64", 1e-12), ("float32", 2e-4)):
        sim = ce_gym.Simulator(Model(robot), 3, 0.001, dtype, method=method, control_period=0.004)
        for _ in range(2):
            sim.step([TARGET], 2)
            sim.reset()
            sim.step([TARGET], 40)
            if method == "euler":
                np.testing.assert_allclose(sim.q[:, 0], expected[-1, 0], rtol=close)
            sim.reset()
        sim.step([TARGET], 1)
        assert sim.torque[0, 0] == pytest.approx(KP * TARGET, rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"control_period": 0.0015}, "control_period=0.0015; expected 0, or a multiple of dt=0.001 s"),
        ({"control_period": -0.001}, "control_period=-0.001; expected a number, 0 or more"),
        ({"control_period": 0.002, "control": "torque"}, "expected 0, but for control of positions"),
        ({"control_period": 0.002, "method": "adaptive"}, "expected 0, but for control of positions"),
        (
            {"control_period": 0.002, "method": "rk4"},
            "the state has the torques that a sampled controller holds",
        ),
    ],
)
def test_what_cannot_be_is_refused(arguments, said):
    with pytest.raises(ValueError, match=said):
        ce_gym.Simulator(Model(table()), 1, 0.001, **arguments)
