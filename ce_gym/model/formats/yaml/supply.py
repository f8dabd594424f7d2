"""What motors are fed by and what becomes of them: `battery`, and of each motor `heat` and `cogging`."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from ce_gym.model.drives import Battery
from ce_gym.model.errors import bad
from ce_gym.model.formats.motors import MotorType, heat_of
from ce_gym.model.formats.reading import Section, finite


def read_battery(file: Section) -> Battery | None:
    """Return what `battery` says; the motors' lines hold at its voltage if it does not say for which they do."""
    if "battery" not in file:
        return None
    section = file.section("battery").allow(*(field.name for field in fields(Battery)))
    figures = {key: section.number(key) for key in ("voltage", "resistance")}
    more = {"nominal": section.number("nominal", figures["voltage"]), "idle": section.number("idle", 0.0)}
    return Battery(**figures, **more)


def read_heat(motor: Section, used: MotorType | None) -> dict[str, Any]:
    """Return how a motor grows warm: a mapping, or `library` for the figures of the entry that it uses."""
    if "heat" not in motor:
        return {}
    if motor.get("heat") == "library":
        if used is None or used.heat is None:
            expected = "figures, or `use` of a motor of the library that has them"
            raise bad(motor.file, motor.key("heat"), "library", expected)
        return {"heat": used.heat}
    return {"heat": heat_of(motor.section("heat"))}


def read_cogging(motor: Section) -> dict[str, Any]:
    """Return harmonics of cogging by their order in a turn: a torque, or a torque and a phase."""
    if "cogging" not in motor:
        return {}
    section, found = motor.section("cogging"), []
    for key, value in section.data.items():
        name = section.key(key)
        if not (isinstance(key, int) and key > 0):
            raise bad(motor.file, name, key, "a whole number of periods in a turn of the rotor")
        given = value if isinstance(value, list) else [value, 0.0]
        if len(given) != 2:
            raise bad(motor.file, name, value, "a torque [N m], or a torque and a phase [rad]")
        found.append((key, *(finite(motor.file, name, number) for number in given)))
    return {"cogging": tuple(sorted(found))}
