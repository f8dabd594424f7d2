"""What has to be true of heat, cogging and a battery for their equations to make sense."""

from __future__ import annotations

import math
from dataclasses import fields

from ce_gym.model.checks.body import check_not_negative
from ce_gym.model.description import Robot
from ce_gym.model.drives import Heat, Motor
from ce_gym.model.errors import invalid_value


def check_supply(robot: Robot, file: str) -> None:
    """Check a robot's battery, and what its motors have of heat and cogging.

    Raises:
        RobotError: A figure is out of range, or one is missing that another needs.
    """
    for motor in robot.motors:
        key = f"motors.{motor.rotor}"
        if motor.motor_constant is not None and not motor.motor_constant > 0.0:
            raise invalid_value(file, f"{key}.motor_constant", motor.motor_constant, "more than 0 [N m/sqrt(W)]")
        for i, (_, torque, _) in enumerate(motor.cogging):
            check_not_negative(file, f"{key}.cogging[{i}][1]", torque, " [N m]")
        if motor.heat is not None:
            _check_heat(motor.heat, file, f"{key}.heat")
            _check_known(motor, file, key, "heat")
    _check_ambient([motor.heat.ambient for motor in robot.motors if motor.heat is not None], file)
    if robot.battery is not None:
        for name in ("voltage", "nominal"):
            if not getattr(robot.battery, name) > 0.0:
                raise invalid_value(file, f"battery.{name}", getattr(robot.battery, name), "more than 0 [V]")
        for name in ("resistance", "idle"):
            check_not_negative(file, f"battery.{name}", getattr(robot.battery, name))
        for motor in robot.motors:
            _check_known(motor, file, f"motors.{motor.rotor}", "battery")
            if math.isinf(motor.velocity):
                expected = "its no-load speed [rad/s], for `battery`"
                raise invalid_value(file, f"motors.{motor.rotor}.velocity", None, expected)


def _check_heat(heat: Heat, file: str, key: str) -> None:
    for field in fields(heat):
        value = getattr(heat, field.name)
        if field.name in ("warm", "hot", "ambient"):
            if not -273.15 <= value <= 1000.0:
                raise invalid_value(file, f"{key}.{field.name}", value, "a temperature [deg C]")
        elif not value > 0.0:
            raise invalid_value(file, f"{key}.{field.name}", value, "more than 0")
    if not heat.ambient < heat.warm < heat.hot:
        raise invalid_value(file, f"{key}.hot", heat.hot, f"more than {key}.warm, and that more than {key}.ambient")


def _check_ambient(found: list[float], file: str) -> None:
    if len(set(found)) > 1:
        expected = "one temperature [deg C], that of the air"
        raise invalid_value(file, "motors.*.heat.ambient", sorted(set(found)), expected)


def _check_known(motor: Motor, file: str, key: str, what: str) -> None:
    if motor.motor_constant is None:
        expected = f"torque over the root of the loss [N m/sqrt(W)], for `{what}`"
        raise invalid_value(file, f"{key}.motor_constant", None, expected)
    if math.isinf(motor.torque):
        raise invalid_value(file, f"{key}.torque", None, f"its largest torque [N m], for `{what}`")
