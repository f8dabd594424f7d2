"""What motors are fed by and what becomes of them: `battery`, and of each motor `heat` and `cogging`."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from ce_gym.model.drives import Battery
from ce_gym.model.errors import invalid_value
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
            raise motor.invalid("heat", "library", expected)
        return {"heat": used.heat}
    return {"heat": heat_of(motor.section("heat"))}


def read_cogging(motor: Section) -> dict[str, Any]:
    """Return harmonics of cogging, each a list of its order in a turn, torque and phase, which may be left out."""
    found = []
    for i, item in enumerate(motor.list("cogging")):
        key = f"{motor.key('cogging')}[{i}]"
        if not isinstance(item, list) or len(item) not in (2, 3):
            expected = "order in a turn of the rotor, torque [N m] and perhaps phase [rad]"
            raise invalid_value(motor.file, key, item, expected)
        order, torque, phase = (finite(motor.file, f"{key}[{j}]", x) for j, x in enumerate([*item, 0.0][:3]))
        if not (order > 0 and order == int(order)):
            raise invalid_value(motor.file, f"{key}[0]", order, "a whole number of periods in a turn of the rotor")
        found.append((int(order), torque, phase))
    return {"cogging": tuple(found)} if found else {}
