"""Heat of motors, a battery that sags and cogging, against closed forms, a circuit's equations and balances."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from elastic_robots import RATIO, differential, turntable
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.forces.supply import LARGEST_RISE, warmed
from ce_gym.dynamics.laws.scene_laws import state_sizes
from ce_gym.dynamics.stepping.trace import iteration_function, step_function
from ce_gym.model import Battery, Heat, LinearConstraint, Motor, Robot
from ce_gym.model.drives import DriveFriction

COPPER, K = 3.93e-3, 0.1
HEAT = Heat(2.0, 20.0, 1.5, 3.0, warm=100.0, hot=125.0, ambient=30.0)
BATTERY = Battery(24.0, 0.4, 24.0, idle=12.0)


def table(stuck: float = 0.0, **figures: Any) -> Robot:
    """A geared joint without gravity with a limited motor, which may be stuck by friction."""
    battery = figures.pop("battery", None)
    motor = Motor("rotor", **{"torque": 1.0, "velocity": 100.0, "motor_constant": K, "friction": stuck} | figures)
    return replace(turntable(1.0), elastic=(), motors=(motor,), battery=battery)


def run(robot: Robot, target: list[float], dt: float, steps: int, outputs: tuple[str, ...] = (), **start: Any):
    """States and outputs after each step, by name; limited motors, controlled by joint torques."""
    parameters = tuple(start.pop("parameters", {}).items())
    model = Model(robot)
    options = StepOptions(control="torque", motors="limited", parameters=tuple(name for name, _ in parameters))
    function = step_function(model.mechanism, options, outputs)
    state = {name: ca.DM.zeros(size) for name, size in state_sizes(model.mechanism, options).items()}
    state |= {name: ca.DM(value) for name, value in start.items()}
    given = {"target": target} | ({"parameters": [x for _, x in parameters]} if parameters else {})
    found: dict[str, list[np.ndarray]] = {name: [] for name in (*state, *outputs)}
    for _ in range(steps):
        after = function(**state, diverged=0, **given, dt=dt)
        state = {name: after[f"{name}_next"] for name in state}
        for name in found:
            found[name].append((state[name] if name in state else after[name]).full().ravel())
    return {name: np.array(values) for name, values in found.items()}


def test_a_stuck_motor_warms_along_the_closed_form():
    """Two masses and a resistance that rises with the winding are a linear system; errors of first order."""
    torque, end = 0.4, 60.0
    loss = (torque / K) ** 2
    flow, out = 1 / HEAT.winding_to_housing, 1 / HEAT.housing_to_ambient
    A = np.array([[COPPER * loss - flow, flow], [flow, -flow - out]]) / [
        [HEAT.winding_capacity],
        [HEAT.housing_capacity],
    ]
    b = np.array([loss * (1 + COPPER * (HEAT.ambient - 20.0)) / HEAT.winding_capacity, 0.0])
    expected = np.linalg.solve(A, (expm(A * end) - np.eye(2)) @ b)
    assert expected[0] > 25
    errors = []
    for dt in (0.1, 0.05, 0.025):
        found = run(table(10.0, heat=HEAT), [torque * RATIO], dt, round(end / dt), ("winding_temperature",))
        errors.append(np.abs(found["motor_warmth"][-1] - expected).max())
        assert found["winding_temperature"][-1, 0] == pytest.approx(
            HEAT.ambient + found["motor_warmth"][-1, 0], rel=1e-12
        )
    assert errors[0] < 0.01 * expected[0]
    np.testing.assert_allclose(np.array(errors[:-1]) / errors[1:], 2.0, atol=0.1)


def test_heat_balances_in_every_step():
    """All lost power heats winding and housing or goes to the air, to rounding."""
    dt, torque = 0.01, 0.3
    found = run(table(heat=HEAT), [torque * RATIO], dt, 400, ("motor_torque",))
    (w, h), tau = found["motor_warmth"].T, found["motor_torque"][:, 0]
    assert tau.min() < 0.9 * tau.max()  # the motor comes to its torque-speed line
    lost = (tau / K) ** 2 * (1 + COPPER * (HEAT.ambient - 20.0 + w))
    stored = HEAT.winding_capacity * w + HEAT.housing_capacity * h
    np.testing.assert_allclose(np.diff(stored), dt * (lost - h / HEAT.housing_to_ambient)[1:], rtol=1e-10)


def test_a_winding_is_never_colder_than_the_air_at_any_figures_in_range():
    """Nor does a step heat it without bound, although the resistance that rises with the winding is implicit."""
    n, rng = 4000, np.random.default_rng(0)
    names = ("winding_capacity", "housing_capacity", "winding_to_housing", "housing_to_ambient")
    low = np.array([-3.0, -3.0, -4.0, -4.0, -12.0, -12.0, -5.0])
    figures = 10 ** rng.uniform(low, [12.0, 12.0, 12.0, 12.0, 12.0, 12.0, -1.0], (n, 7))
    figures[: n // 2, :6] = 10 ** rng.normal(np.log10([2.0, 20.0, 1.5, 3.0, 1e-3, 1.0]), 1.0, (n // 2, 6))
    warmth, ambient = rng.uniform(0, 200, (n, 2)), rng.uniform(-200, 1000, n)
    x = ca.SX.sym("x", 10)
    heat = Heat(**dict(zip(names, ca.vertsplit(x[:4]), strict=True)), ambient=x[9])
    after = warmed(Motor("rotor", motor_constant=x[4]), heat, x[7], x[8], x[5], x[6])
    step = ca.Function("step", [x], [ca.vertcat(*after)]).map(n)
    winding, housing = step(np.column_stack([figures, warmth, ambient]).T).full()
    highest = warmth.max(axis=1)
    assert (winding >= -1e-6).all()
    assert (housing >= -1e-6).all()
    assert (np.maximum(winding, housing) <= highest + 2 * LARGEST_RISE + 1e-6).all()


def test_a_hot_motor_holds_back_and_comes_to_the_temperature_at_which_it_does():
    """At full command for an hour: the heat of the remaining torque is the heat that flows out."""
    across = HEAT.winding_to_housing + HEAT.housing_to_ambient

    def excess(w: float) -> float:
        share = np.clip((HEAT.hot - HEAT.ambient - w) / (HEAT.hot - HEAT.warm), 0, 1)
        return (share / K) ** 2 * (1 + COPPER * (HEAT.ambient - 20 + w)) * across - w

    w = brentq(excess, 1.0, HEAT.hot - HEAT.ambient)
    assert HEAT.warm < HEAT.ambient + w < HEAT.hot
    found = run(table(10.0, heat=HEAT, stall=3.0), [5 * RATIO], 0.05, 12_000, ("motor_torque",))
    assert found["motor_warmth"][-1, 0] == pytest.approx(w, rel=1e-6)
    share = (HEAT.hot - HEAT.ambient - w) / (HEAT.hot - HEAT.warm)
    assert found["motor_torque"][0, 0] == pytest.approx(1.0)
    assert found["motor_torque"][-1, 0] == pytest.approx(share, rel=1e-6)
    beyond = run(table(10.0, heat=HEAT), [5 * RATIO], 0.01, 1, ("motor_torque",), motor_warmth=[HEAT.hot, 0])
    assert beyond["motor_torque"][0, 0] == 0


def test_a_warm_winding_has_more_resistance_on_its_line():
    """The voltage drives less current through it at standstill; the no-load speed stays."""
    warm = 1 + COPPER * (HEAT.ambient - 20.0 + 50.0)
    still = run(table(10.0, heat=HEAT), [5 * RATIO], 1e-6, 1, ("motor_torque",), motor_warmth=[50, 0])
    assert still["motor_torque"][0, 0] == pytest.approx(1 / warm, rel=1e-6)
    free = run(table(heat=HEAT), [5 * RATIO], 0.01, 2000, ("motor_speed",), motor_warmth=[50, 0])
    assert free["motor_speed"][-1, 0] == pytest.approx(100.0, rel=1e-6)


def circuit(torque: Any, speed: float, motors: int = 1, warm: float = 1.0) -> float:
    """Voltage [V] at which the battery delivers the power of the motors; torque as a function of the voltage."""

    def missing(voltage: float) -> float:
        tau = torque(voltage)
        power = motors * (tau * speed + warm * (tau / K) ** 2) + BATTERY.idle
        return voltage + BATTERY.resistance * power / voltage - BATTERY.voltage

    return brentq(missing, 0.5 * BATTERY.voltage, 1.5 * BATTERY.voltage)


@pytest.mark.parametrize("asked", [0.3, 5.0])
def test_a_stuck_motor_sags_the_battery_as_the_circuit_does(asked):
    """Within the line, and on it, where the voltage says how much is drawn: settled in a few steps, no swinging."""
    expected = circuit(lambda v: min(asked, v / BATTERY.nominal), 0.0)
    found = run(table(10.0, battery=BATTERY), [asked * RATIO], 0.001, 12, ("motor_torque", "battery_voltage"))
    voltage = found["battery_voltage"][:, 0]
    assert voltage[-1] == pytest.approx(expected, rel=1e-7)
    assert (np.diff(voltage) <= 1e-9).all()
    assert voltage[-1] < BATTERY.voltage - 0.35
    assert found["motor_torque"][-1, 0] == pytest.approx(min(asked, expected / BATTERY.nominal), rel=1e-7)


def test_motors_share_a_battery():
    """The other motor's current makes a motor weaker, by as much as the circuit equations say."""
    motors = [Motor(name, 1.0, 100.0, motor_constant=K, friction=10.0) for name in ("sum", "difference")]
    both = replace(differential(), motors=tuple(motors), battery=BATTERY)
    expected = circuit(lambda v: v / BATTERY.nominal, 0.0, motors=2)
    found = run(both, [30.0, 0.0], 0.001, 20, ("motor_torque", "battery_voltage"))
    assert found["battery_voltage"][-1, 0] == pytest.approx(expected, rel=1e-7)
    np.testing.assert_allclose(found["motor_torque"][-1], expected / BATTERY.nominal, rtol=1e-7)
    alone = circuit(lambda v: v / BATTERY.nominal, 0.0)
    assert expected < alone - 1


def test_a_motor_that_runs_up_on_a_battery_follows_the_equations():
    """`J w' = line(V, w)` with V of the circuit at every moment; errors of first order in the step."""
    inertia, end = Model(table()).mass_matrix(np.zeros(1))[0, 0] / RATIO**2, 0.05

    def line(voltage: float, speed: float) -> float:
        return voltage / BATTERY.nominal - speed / 100.0

    def rate(_: float, speed: np.ndarray) -> list[float]:
        w = float(speed[0])
        return [line(circuit(lambda v: line(v, w), w), w) / inertia]

    exact = solve_ivp(rate, (0, end), [0.0], rtol=1e-10, atol=1e-10).y[0, -1]
    assert 30 < exact < 90
    errors = []
    for dt in (1e-3, 5e-4, 2.5e-4):
        found = run(table(battery=BATTERY), [50.0], dt, round(end / dt), ("motor_speed",))
        errors.append(abs(found["motor_speed"][-1, 0] - exact))
    assert errors[0] < 0.05 * exact
    np.testing.assert_allclose(np.array(errors[:-1]) / errors[1:], 2.0, atol=0.3)


def test_braking_charges_the_battery():
    found = run(table(battery=BATTERY), [-0.3 * RATIO], 0.001, 3, ("battery_voltage",), v=[90.0 / RATIO])
    assert found["battery_voltage"][-1, 0] > BATTERY.voltage


def test_more_than_a_battery_can_give_halves_its_voltage_and_no_more():
    weak = replace(BATTERY, resistance=20.0)
    found = run(table(10.0, battery=weak), [0.9 * RATIO], 0.001, 50, ("battery_voltage",))
    assert found["battery_voltage"].min() >= 0.5 * weak.voltage * (1 - 1e-12)


TEETH = ((12, 0.02, 0.3), (36, 0.005, -0.8))


def test_cogging_at_rest_is_its_harmonics():
    angle = 0.37
    expected = -sum(size * np.sin(order * angle + phase) for order, size, phase in TEETH)
    robot = table(cogging=TEETH, damping=0.0)
    inertia = Model(robot).mass_matrix(np.zeros(1))[0, 0]
    found = run(robot, [0.0], 1e-7, 1, q=[angle / RATIO])
    assert found["v"][0, 0] * inertia / 1e-7 / RATIO == pytest.approx(expected, rel=1e-5)


def test_cogging_keeps_energy():
    """A rotor that rolls over its teeth: the energy that a step loses or gains vanishes with the step."""
    robot, drift = table(cogging=TEETH), []
    start = {"q": [0.01], "v": [12.0 / RATIO]}
    for dt in (2e-4, 1e-4, 5e-5):
        found = run(robot, [0.0], dt, round(0.5 / dt), ("energy",), **start)
        speed, energy = RATIO * found["v"][:, 0], found["energy"][:, 0]
        drift.append(abs(energy[-1] - energy[0]))
        assert np.ptp(0.5 * Model(robot).mass_matrix(np.zeros(1))[0, 0] * (speed / RATIO) ** 2) > 20 * drift[-1]
    assert drift[0] > 1.6 * drift[1] > 2.5 * drift[2]


def test_cogging_holds_a_rotor_and_vanishes_at_speed():
    """Below its largest torque a rotor comes to rest in the detent; where a step spans teeth, it is hardly felt."""
    friction = {"damping": 2e-5}
    held = run(table(cogging=((12, 0.02, 0.0),), **friction), [0.01 * RATIO], 0.005, 4000, q=[0.0])
    assert RATIO * held["q"][-1, 0] == pytest.approx(np.arcsin(0.5) / 12, rel=1e-6)
    assert abs(held["v"][-1, 0]) < 1e-7
    fast = run(table(cogging=((12, 0.02, 0.0),)), [0.0], 0.005, 200, ("motor_speed",), v=[95.0 / RATIO])
    assert np.abs(fast["motor_speed"][:, 0] / 95.0 - 1).max() < 2e-3


def test_stiff_teeth_do_not_throw_a_rotor_in_long_steps():
    """A hundred times the stiffness at which explicit steps would: implicit where teeth hold, so it comes to rest."""
    teeth = ((84, 20.0, 0.0),)
    held = run(table(cogging=teeth), [0.0], 0.005, 400, ("energy",), q=[0.005 / RATIO])
    stiffness = 84 * 20.0 * 0.005**2 * RATIO**2 / Model(table()).mass_matrix(np.zeros(1))[0, 0]
    assert stiffness > 100
    assert np.abs(RATIO * held["q"]).max() < 0.0051
    assert (held["energy"] < -20 / 84 * np.cos(84 * 0.005)).all()  # the initial energy
    assert np.abs(RATIO * held["q"][-1]).max() < 1e-4


@pytest.mark.parametrize(
    ("name", "value", "change"),
    [
        ("ambient", 70.0, lambda r: with_motor(r, heat=replace(HEAT, ambient=70.0))),
        ("cogging", 0.5, lambda r: with_motor(r, cogging=tuple((n, 0.5 * a, p) for n, a, p in TEETH))),
        ("battery_voltage", 20.0, lambda r: replace(r, battery=replace(BATTERY, voltage=20.0))),
        ("battery_resistance", 0.1, lambda r: replace(r, battery=replace(BATTERY, resistance=0.1))),
    ],
)
def test_parameters_are_the_figures_of_the_robot(name, value, change):
    robot = table(heat=HEAT, cogging=TEETH, battery=BATTERY)
    outputs = ("winding_temperature", "battery_voltage")
    declared = run(robot, [3.0], 0.002, 50, outputs, parameters={name: value})
    changed, before = run(change(robot), [3.0], 0.002, 50, outputs), run(robot, [3.0], 0.002, 50, outputs)
    for key in changed:
        np.testing.assert_allclose(declared[key], changed[key], rtol=1e-9, atol=1e-12)
    assert any(np.abs(changed[key] - before[key]).max() > 1e-4 for key in changed)


def with_motor(robot: Robot, **figures: Any) -> Robot:
    return replace(robot, motors=tuple(replace(motor, **figures) for motor in robot.motors))


@pytest.mark.parametrize("asked", [4.0, -9.0, 50.0])
def test_a_gear_that_turns_backwards_mirrors_its_motor(asked):
    """A ratio of the other sign: the same table to the bit, and torques and speeds of the rotor the other way."""
    lossy = DriveFriction(0.02, 5.0, 1.0, 0.1, 0.2, efficiency=0.8, backdriving_efficiency=0.6)
    robot = table(heat=HEAT, cogging=TEETH, battery=BATTERY, drive_friction=lossy, bandwidth=30.0)
    gear = LinearConstraint("gear", (("rotor", 1.0), ("table", RATIO)))
    teeth = tuple((order, size, -phase) for order, size, phase in TEETH)
    turned = with_motor(replace(robot, constraints=(gear,)), cogging=teeth)
    outputs = ("motor_torque", "motor_speed", "energy")
    one, other = (run(it, [asked], 0.002, 100, outputs, q=[0.2], v=[3.0]) for it in (robot, turned))
    for name, values in one.items():
        sign = -1 if name in ("motor_torque", "motor_speed", "lagging_torque") else 1
        expected = values * [-1, -1, 1] if name == "motor_load" else sign * values
        np.testing.assert_array_equal(other[name], expected, err_msg=name)


def test_ideal_motors_and_plain_ones_cost_what_they_did():
    """Heat, battery and cogging are not traced for ideal motors, nor for robots without them."""
    plain = table(stuck=0.1, drive_friction=DriveFriction(load_motor=0.1))
    full = with_motor(replace(plain, battery=BATTERY), heat=HEAT, cogging=TEETH)

    def count(robot: Robot, motors: str) -> int:
        options = StepOptions(control="torque", motors=motors)
        return iteration_function(Model(robot).mechanism, options).n_instructions()

    assert count(full, "ideal") == count(plain, "ideal")
    assert count(full, "limited") > count(plain, "limited")
