"""Motors on their torque-speed lines, forwards and backwards: how the power of a battery depends on its voltage."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from test_drive_friction import RATIO, hoist

from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.model import Battery, Motor

TORQUE, STALL, FREE, K, DT = 0.5, 1.2, 40.0, 0.1, 0.01
BATTERY = Battery(24.0, 0.4, 24.0, idle=12.0)


def torque(voltage: float, speed: float, side: int) -> float:
    """Torque of a motor on its line at a speed, up to the current limit."""
    return side * min(TORQUE, STALL * (voltage / BATTERY.nominal - side * speed / FREE))


def newton(sag: float, power: float, answer: float) -> float:
    """How far the voltage is down after one step of Newton's method on the battery's circuit [V]."""

    def missing(down: float) -> float:
        voltage = BATTERY.voltage - down
        drawn = power + answer * (sag - down) + BATTERY.idle
        return down - BATTERY.resistance * drawn / voltage

    h = 1e-5
    return sag - missing(sag) * 2 * h / (missing(sag + h) - missing(sag - h))


@pytest.mark.parametrize("side", [1, -1])
def test_a_battery_goes_by_the_line_that_a_motor_is_on(side):
    """Random speeds and voltages, a falling weight that takes motors through their no-load speed within a step."""
    motor = Motor("rotor", torque=TORQUE, velocity=FREE, stall=STALL, motor_constant=K)
    robot = replace(hoist(motor), battery=BATTERY, gravity=(0.0, 0.0, 9.81 * side))  # ahead on that line
    options = StepOptions(control="torque", motors="limited")
    function = step_function(Model(robot).mechanism, options, ("motor_torque", "motor_speed"))
    rng, opposite, wrong = np.random.default_rng(5), 0, 0.0
    for _ in range(60):
        sag = rng.uniform(0.5, 3.0)
        voltage = BATTERY.voltage - sag
        share = voltage / BATTERY.nominal
        start = side * FREE * (share - rng.choice([0.001, 0.01, 0.1, 0.3]) * rng.uniform(0.5, 1.0))
        state = {"q": 0, "v": start / RATIO, "battery_sag": sag}
        after = function(**state, diverged=0, target=side * 3.0 * TORQUE * RATIO, dt=DT)
        tau, speed = float(after["motor_torque"]), float(after["motor_speed"])
        assert tau == pytest.approx(torque(voltage, speed, side), abs=1e-12)
        h = 1e-4
        rise = (torque(voltage + h, speed, side) - torque(voltage - h, speed, side)) / (2 * h)
        assert rise == pytest.approx(side * STALL / BATTERY.nominal, rel=1e-8)
        power, answer = tau * speed + (tau / K) ** 2, (speed + 2 * tau / K**2) * rise
        expected = newton(sag, power, answer)
        assert float(ca.DM(after["battery_sag_next"])) == pytest.approx(expected, rel=1e-6)
        opposite += tau * side < -1e-3
        wrong = max(wrong, abs(newton(sag, power, -answer) - expected))
    assert opposite > 10
    assert wrong > 0.01
