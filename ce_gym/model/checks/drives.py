"""Checks of motors, their battery and elastic transmissions; each raises a `RobotError` of one line."""

from __future__ import annotations

import math
from dataclasses import fields

from ce_gym.model.checks.body import check_unique
from ce_gym.model.description import Robot
from ce_gym.model.drives import DriveFriction, Heat, Motor
from ce_gym.model.errors import invalid_value, unknown_name


def check_motors(robot: Robot, file: str) -> None:
    """Check the motors of a robot and its battery."""
    rotors = [body.name for body in robot.rotors()]
    check_unique(file, "motors", [motor.rotor for motor in robot.motors])
    for motor in robot.motors:
        if motor.rotor not in rotors:
            raise unknown_name(file, "motors", motor.rotor, rotors, "the name of a rotor")
        key = f"motors.{motor.rotor}"
        if motor.drive_friction is not None:
            _check_friction(motor.drive_friction, file, f"{key}.friction")
        for i, (_, torque, _) in enumerate(motor.cogging):
            if not 0.0 <= torque < math.inf:
                raise invalid_value(file, f"{key}.cogging[{i}][1]", torque, "0 or more [N m]")
        if motor.heat is not None:
            _check_heat(motor.heat, file, f"{key}.heat")
            _check_known(motor, file, key, "heat")
    ambient = sorted({motor.heat.ambient for motor in robot.motors if motor.heat is not None})
    if len(ambient) > 1:
        raise invalid_value(file, "motors.*.heat.ambient", ambient, "one temperature of the air [deg C]")
    if robot.battery is not None:
        for motor in robot.motors:
            key = f"motors.{motor.rotor}"
            _check_known(motor, file, key, "battery")
            if math.isinf(motor.velocity):
                raise invalid_value(file, f"{key}.velocity", None, "the no-load speed [rad/s], for `battery`")


def _check_friction(friction: DriveFriction, file: str, key: str) -> None:
    at_rest = [f.name for f in fields(friction) if f.name.startswith("stribeck") and f.default == 0.0]
    if math.isinf(friction.stribeck_speed) and any(getattr(friction, name) for name in at_rest):
        expected = "the speed at which the friction at rest has fallen to 37 % [rad/s]"
        raise invalid_value(file, f"{key}.stribeck_speed", None, expected)


def _check_heat(heat: Heat, file: str, key: str) -> None:
    if not heat.ambient < heat.warm < heat.hot:
        expected = f"more than {key}.warm, and that more than {key}.ambient"
        raise invalid_value(file, f"{key}.hot", heat.hot, expected)


def _check_known(motor: Motor, file: str, key: str, user: str) -> None:
    """Check that a motor has the values that its thermal model, or the battery, needs."""
    if motor.motor_constant is None:
        expected = f"torque over the root of the loss [N m/sqrt(W)], for `{user}`"
        raise invalid_value(file, f"{key}.motor_constant", None, expected)
    if math.isinf(motor.torque):
        raise invalid_value(file, f"{key}.torque", None, f"its largest torque [N m], for `{user}`")


def check_elastic(robot: Robot, file: str) -> None:
    """Check that one linear constraint determines each elastic rotor, and that no joint depends on the rotor."""
    rotors, names = [body.name for body in robot.rotors()], [body.name for body in robot.bodies]
    check_unique(file, "elastic", [elastic.rotor for elastic in robot.elastic])
    for elastic in robot.elastic:
        key = f"elastic.{elastic.rotor}"
        if elastic.rotor not in rotors:
            raise unknown_name(file, "elastic", elastic.rotor, rotors, "the name of a rotor")
        ties = [tie for tie in robot.constraints if elastic.rotor in tie.bodies]
        if len(ties) != 1 or not ties[0].linear or elastic.rotor in robot.independent:
            expected = "a rotor in exactly one constraint, a linear one, and not independent"
            raise invalid_value(file, key, elastic.rotor, expected)
        if elastic.stretch in names:
            raise invalid_value(file, "body name", elastic.stretch, f"another one: {elastic.rotor!r} is elastic")
        if elastic.backlash and math.isfinite(elastic.preload):
            raise invalid_value(file, f"{key}.preload", elastic.preload, "no preload beside backlash")
