"""The keys `motors` and `battery` of YAML robot files."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from ce_gym.model.drives import Battery, DriveFriction, Motor
from ce_gym.model.errors import invalid_value
from ce_gym.model.formats.motor_library import MotorType, motor_type, read_heat
from ce_gym.model.formats.reading import Section, finite

_NUMBERS = ("torque", "velocity", "stall", "damping", "bandwidth", "motor_constant")
_FRICTION_KEYS = tuple(field.name for field in fields(DriveFriction) if field.name != "factor")
_BOTH_KEYS = ("load", "stribeck_load")
"""Keys that set the share of the motor's torque and the share of the external torque to the same number."""


def read_motors(file: Section) -> tuple[dict[str, MotorType], tuple[Motor, ...]]:
    """Return the library's entries that motors use, by rotor, and the motors."""
    library: dict[str, MotorType] = {}
    motors = []
    for rotor, motor in file.section("motors").sections():
        motor.allow("use", "friction", "heat", "cogging", *_NUMBERS)
        numbers: dict[str, float] = {}
        if "use" in motor:
            library[rotor] = motor_type(motor.text("use"), motor.file, motor.key("use"))
            numbers = library[rotor].limits()
        numbers |= {key: motor.number(key) for key in motor if key in _NUMBERS}
        optional = _friction(motor) | _heat(motor, library.get(rotor)) | _cogging(motor)
        motors.append(Motor(rotor, **numbers, **optional))
    return library, tuple(motors)


def read_battery(file: Section) -> Battery | None:
    """Return the battery; its nominal voltage is the voltage without load by default."""
    if "battery" not in file:
        return None
    section = file.section("battery").allow(*(field.name for field in fields(Battery)))
    voltage, resistance = section.number("voltage"), section.number("resistance")
    return Battery(voltage, resistance, section.number("nominal", voltage), section.number("idle", 0.0))


def _friction(motor: Section) -> dict[str, Any]:
    """Return the dry friction of a motor: a number, or a mapping with terms that depend on speed and load."""
    if not isinstance(motor.get("friction", None), dict):
        return {"friction": motor.number("friction", 0.0)}
    section = motor.section("friction").allow("coulomb", *_BOTH_KEYS, *_FRICTION_KEYS)
    numbers = {key: section.number(key) for key in section if key in _FRICTION_KEYS}
    for both in (key for key in _BOTH_KEYS if key in section):
        for key in (f"{both}_motor", f"{both}_external"):
            if key in section:
                raise section.invalid(key, section.get(key), f"none beside {both!r}, which sets both")
            numbers[key] = section.number(both)
    drive = {"drive_friction": DriveFriction(**numbers)} if numbers else {}
    return {"friction": section.number("coulomb", 0.0)} | drive


def _heat(motor: Section, entry: MotorType | None) -> dict[str, Any]:
    """Return the thermal parameters of a motor: a mapping, or `library` for the motor's entry in the library."""
    if "heat" not in motor:
        return {}
    if motor.get("heat") != "library":
        return {"heat": read_heat(motor.section("heat"))}
    if entry is None or entry.heat is None:
        expected = "figures, or `use` of a motor of the library that has them"
        raise motor.invalid("heat", "library", expected)
    return {"heat": entry.heat}


def _cogging(motor: Section) -> dict[str, Any]:
    """Return harmonics of cogging, each a list of order per turn, torque [N m] and optional phase [rad]."""
    harmonics = []
    for i, item in enumerate(motor.list("cogging")):
        key = f"{motor.key('cogging')}[{i}]"
        if not isinstance(item, list) or len(item) not in (2, 3):
            expected = "order in a turn of the rotor, torque [N m] and perhaps phase [rad]"
            raise invalid_value(motor.file, key, item, expected)
        order, torque, phase = (finite(motor.file, f"{key}[{j}]", x) for j, x in enumerate([*item, 0.0][:3]))
        if not (order > 0 and order == int(order)):
            raise invalid_value(motor.file, f"{key}[0]", order, "a whole number of periods in a turn of the rotor")
        harmonics.append((int(order), torque, phase))
    return {"cogging": tuple(harmonics)} if harmonics else {}
