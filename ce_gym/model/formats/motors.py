"""The motor library: published figures of actuators, by name, for robot files to `use`.

The file is `motors.yaml` beside the robots that come with the package; each entry names the source of its figures.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields
from functools import cache
from pathlib import Path

from ce_gym.model.assets import assets_folder
from ce_gym.model.drives import Heat
from ce_gym.model.errors import unknown_name
from ce_gym.model.formats.reading import Section, read_yaml
from ce_gym.model.table import table_text

_NUMBERS = ("ratio", "inertia", "torque", "velocity", "resistance", "motor_constant")
_OPTIONAL = ("velocity", "resistance", "motor_constant")


@dataclass(frozen=True)
class MotorType:
    """An actuator that can be bought, its gearbox included.

    Attributes:
        name: How robot files name it.
        ratio: Of its own gearbox: turns of the rotor for one of the output.
        inertia: Of all that spins, seen from the rotor [kg m^2]: reflected inertia over the ratio squared.
        torque: Largest, at the rotor [N m].
        velocity: No-load speed of the rotor [rad/s]; None if it is not published.
        resistance: Of a phase [ohm]; None if it is not published.
        motor_constant: Torque over the root of what the winding then loses, at 20 deg C [N m/sqrt(W)]; None likewise.
        heat: How it grows warm; None likewise.
        source: Where the figures are from, and which of them are estimates.
    """

    name: str
    ratio: float
    inertia: float
    torque: float
    velocity: float | None
    resistance: float | None
    motor_constant: float | None
    heat: Heat | None
    source: str

    def limits(self) -> dict[str, float]:
        """Return what a `Motor` has of it: torque [N m], velocity [rad/s] and motor constant of the rotor."""
        more = {"velocity": self.velocity, "motor_constant": self.motor_constant}
        return {"torque": self.torque} | {key: value for key, value in more.items() if value is not None}


def motor_types(folder: Path | None = None) -> dict[str, MotorType]:
    """Return the entries of the library by name.

    Args:
        folder: Where `motors.yaml` is; by default the folder of robots that come with the package.

    Raises:
        RobotError: The file is wrong; one line that says where.

    Examples:
        >>> motor_types()["unitree_7520_14"].ratio
        14.318182
    """
    return dict(_library(folder or assets_folder()))


def motor_type(name: str, file: str, key: str) -> MotorType:
    """Return an entry of the library.

    Args:
        name: Its name.
        file: The file that uses it, for messages.
        key: Where in that file.

    Raises:
        RobotError: There is no such entry.
    """
    library = motor_types()
    if name not in library:
        raise unknown_name(file, key, name, library, "the name of a motor in the library")
    return library[name]


def motor_table() -> str:
    """Return a line for each entry, figures at the rotor."""
    columns = ("motor", "ratio", "inertia [kg m^2]", "torque [N m]", "no-load speed [rad/s]", "resistance [ohm]")
    rows = [(m.name, m.ratio, m.inertia, m.torque, m.velocity, m.resistance) for m in motor_types().values()]
    return table_text(columns, rows)


def heat_of(section: Section) -> Heat:
    """Return the figures of how a motor grows warm."""
    section.allow(*(field.name for field in fields(Heat)))
    asked = {field.name for field in fields(Heat) if field.default is MISSING} | set(section)
    return Heat(**{name: section.number(name) for name in asked})


@cache
def _library(folder: Path) -> tuple[tuple[str, MotorType], ...]:
    return tuple((name, _motor(name, section)) for name, section in read_yaml(folder / "motors.yaml").sections())


def _motor(name: str, section: Section) -> MotorType:
    section.allow(*_NUMBERS, "heat", "source")
    figures = {key: section.number(key, None) if key in _OPTIONAL else section.number(key) for key in _NUMBERS}
    for key, value in figures.items():
        if value is not None and not value > 0.0:
            raise section.invalid(key, value, "more than 0")
    heat = heat_of(section.section("heat")) if "heat" in section else None
    return MotorType(name, **figures, heat=heat, source=section.text("source"))  # type: ignore[arg-type]
