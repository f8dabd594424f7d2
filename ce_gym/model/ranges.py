"""Types of numbers with an allowed range, for the fields of descriptions, and the check of descriptions.

The type of a field has the range of its values, and the unit: `Annotated[Positive, "N/m"]`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from ce_gym.model.errors import invalid_value

LARGEST_FIGURE = 1e12
"""Largest length, mass, inertia, ratio, gain and so on [SI units]; its cube is within the range of single precision."""
SMALLEST_FIGURE = 1 / LARGEST_FIGURE
"""Smallest value of a quantity that must be positive [SI units]."""


@dataclass(frozen=True)
class Range:
    """Allowed values of a number.

    Attributes:
        expected: The range in words, for messages.
        lowest: Smallest value.
        highest: Largest finite value.
        may_be_infinite: Whether infinity is allowed.
    """

    expected: str
    lowest: float = field(default=0.0, repr=False)
    highest: float = field(default=LARGEST_FIGURE, repr=False)
    may_be_infinite: bool = field(default=False, repr=False)

    def __contains__(self, value: object) -> bool:
        """Whether a value is an allowed number; NaN never is."""
        return _is_number(value) and (
            self.lowest <= value <= self.highest  # type: ignore[operator]
            or (self.may_be_infinite and value == math.inf)
        )


_UP_TO = f"up to {LARGEST_FIGURE:g}"
_ABOVE_0 = f"more than 0, from {SMALLEST_FIGURE:g} to {LARGEST_FIGURE:g}"
FINITE = Range(f"finite numbers, {_UP_TO} in size", -LARGEST_FIGURE)
NOT_NEGATIVE = Range(f"0 or more, {_UP_TO}")
POSITIVE = Range(_ABOVE_0, SMALLEST_FIGURE)
TEMPERATURE = Range("a temperature from -200 to 1000", -200.0, 1000.0)  # where copper has its linear resistance

Finite = Annotated[float, FINITE]
NotNegative = Annotated[float, NOT_NEGATIVE]
NotNegativeOrInfinite = Annotated[float, Range(f"0 or more, {_UP_TO}, or infinite", may_be_infinite=True)]
Positive = Annotated[float, POSITIVE]
PositiveOrInfinite = Annotated[float, Range(f"{_ABOVE_0}, or infinite", SMALLEST_FIGURE, may_be_infinite=True)]
Share = Annotated[float, Range("a share from 0 to 1", highest=1.0)]
PositiveShare = Annotated[float, Range("a share above 0, at most 1", SMALLEST_FIGURE, 1.0)]
HeatCapacity = Annotated[float, Range("more than 0, from 0.001 to 1e+12", 1e-3), "J/K"]
ThermalResistance = Annotated[
    float, Range("more than 0, from 0.0001 to 1e+12, or infinite", 1e-4, may_be_infinite=True), "K/W"
]
Temperature = Annotated[float, TEMPERATURE, "deg C"]


def check_fields(description: Any, file: str, prefix: str) -> None:
    """Check the type and the range of each field of a description, but not the fields of its parts.

    Args:
        description: A dataclass.
        file: Name of the file, for messages.
        prefix: Beginning of keys in messages, such as "motors.knee_rotor.".

    Raises:
        RobotError: A value has another type or is out of range.
    """
    for name, (is_allowed, expected) in _checks(type(description)).items():
        value = getattr(description, name)
        if not is_allowed(value):
            raise invalid_value(file, f"{prefix}{name}", value, expected)


_Check = tuple[Callable[[Any], bool], str]
"""Whether a value is allowed, and the allowed values in words."""


@cache
def _checks(kind: type) -> dict[str, _Check]:
    """Return the check of each field of a dataclass, by name."""
    hints = get_type_hints(kind, include_extras=True)
    return {each.name: _check_of(hints[each.name]) for each in fields(kind)}


def _check_of(hint: Any) -> _Check:
    """Return the check of a type."""
    kind, parts = get_origin(hint), get_args(hint)
    if kind is Annotated and isinstance(parts[1], Range):
        return parts[1].__contains__, parts[1].expected + "".join(f" [{unit}]" for unit in parts[2:])
    if kind in (Union, UnionType):
        checks = [_check_of(part) for part in parts]
        names = [expected for part, (_, expected) in zip(parts, checks, strict=True) if part is not NoneType]
        return lambda value: any(is_allowed(value) for is_allowed, _ in checks), " or ".join(names)
    if kind is Literal:
        return lambda value: isinstance(value, str) and value in parts, f"one of {', '.join(parts)}"
    if kind is tuple:
        return _check_of_tuple(parts)
    if hint is float:
        return _is_number, "a number"
    if hint is int:
        return lambda value: _is_number(value) and not isinstance(value, float | np.floating), "a whole number"
    if isinstance(hint, type) and (hint in (bool, str, NoneType) or is_dataclass(hint)):
        names = {bool: "true or false", str: "text"}
        return lambda value: isinstance(value, hint), names.get(hint, f"a {hint.__name__}")
    return lambda value: True, ""


def _check_of_tuple(parts: tuple[Any, ...]) -> _Check:
    if parts[1:] == (...,):
        is_part, expected = _check_of(parts[0])
        return lambda value: isinstance(value, tuple) and all(map(is_part, value)), f"a tuple, each {expected}"
    checks = [_check_of(part) for part in parts]

    def is_allowed(value: Any) -> bool:
        if not isinstance(value, tuple | list | np.ndarray) or len(value) != len(checks):
            return False
        return all(is_part(part) for (is_part, _), part in zip(checks, value, strict=True))

    return is_allowed, f"{len(parts)} of: {', '.join(dict.fromkeys(expected for _, expected in checks))}"


def _is_number(value: object) -> bool:
    if type(value) is float:
        return True
    is_number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    return is_number and (not isinstance(value, int) or abs(value) <= sys.float_info.max)
