"""The motor library: published data of actuators, by name, for robot files to `use`.

The file is `motors.yaml` beside the robots of the package; each entry names its source.
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
    """A commercial actuator with its gearbox; None for data that is not published.

    Attributes:
        name: Name in robot files.
        ratio: Gear ratio of the gearbox: turns of the rotor for one turn of the output.
        inertia: Inertia of all rotating parts at the rotor [kg m^2]: reflected inertia over the ratio squared.
        torque: Largest torque at the rotor [N m].
        velocity: No-load speed of the rotor [rad/s].
        resistance: Phase resistance [ohm].
        motor_constant: Torque over the root of the copper loss, at 20 deg C [N m/sqrt(W)].
        heat: Thermal parameters.
        source: Source of the data, and which values are estimates.
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
        """Return the arguments of a `Motor`: torque [N m], and velocity [rad/s] and motor constant if published."""
        optional = {"velocity": self.velocity, "motor_constant": self.motor_constant}
        return {"torque": self.torque} | {key: value for key, value in optional.items() if value is not None}


def motor_types(folder: Path | None = None) -> dict[str, MotorType]:
    """Return the entries of the library by name.

    Args:
        folder: Folder of `motors.yaml`; by default the folder of the package's robots.

    Raises:
        RobotError: The file is wrong; one line with the place.

    Examples:
        >>> motor_types()["unitree_7520_14"].ratio
        14.318182
    """
    return dict(_library(folder or assets_folder()))


def motor_type(name: str, file: str, key: str) -> MotorType:
    """Return an entry of the library.

    Args:
        name: Name of the entry.
        file: The file that uses the entry, for messages.
        key: Key in that file, for messages.

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


def read_heat(section: Section) -> Heat:
    """Return the thermal parameters of a motor."""
    section.allow(*(field.name for field in fields(Heat)))
    required = {field.name for field in fields(Heat) if field.default is MISSING}
    return Heat(**{name: section.number(name) for name in required | set(section)})


@cache
def _library(folder: Path) -> tuple[tuple[str, MotorType], ...]:
    return tuple((name, _motor(name, section)) for name, section in read_yaml(folder / "motors.yaml").sections())


def _motor(name: str, section: Section) -> MotorType:
    section.allow(*_NUMBERS, "heat", "source")
    figures = {key: section.number(key, None) if key in _OPTIONAL else section.number(key) for key in _NUMBERS}
    for key, value in figures.items():
        if value is not None and not value > 0.0:
            raise section.invalid(key, value, "more than 0")
    heat = read_heat(section.section("heat")) if "heat" in section else None
    return MotorType(name, **figures, heat=heat, source=section.text("source"))  # type: ignore[arg-type]
