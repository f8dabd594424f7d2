"""Types of numbers with an allowed range, for the fields of descriptions, and their check."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache
from typing import Annotated, Any, get_args, get_type_hints

from ce_gym.model.errors import invalid_value

LARGEST_FIGURE = 1e12
"""Largest length, mass, inertia, ratio, gain and so on [SI units]; its cube is within the range of single precision."""


@dataclass(frozen=True)
class Range:
    """Allowed values of a number.

    Attributes:
        expected: The range in words, for messages.
        lowest: Smallest value.
        highest: Largest value.
        is_open: Whether the smallest value itself is not allowed.
    """

    expected: str
    lowest: float = field(default=0.0, repr=False)
    highest: float = field(default=math.inf, repr=False)
    is_open: bool = field(default=False, repr=False)

    def __contains__(self, value: float) -> bool:
        """Whether a value is allowed; NaN never is."""
        return self.lowest <= value <= self.highest and not (self.is_open and value == self.lowest)


_UP_TO = f"up to {LARGEST_FIGURE:g}"
Finite = Annotated[float, Range(f"finite numbers, {_UP_TO} in size", -LARGEST_FIGURE, LARGEST_FIGURE)]
NotNegative = Annotated[float, Range(f"0 or more, {_UP_TO}", highest=LARGEST_FIGURE)]
NotNegativeOrInfinite = Annotated[float, Range("0 or more")]
Positive = Annotated[float, Range(f"more than 0, {_UP_TO}", highest=LARGEST_FIGURE, is_open=True)]
PositiveOrInfinite = Annotated[float, Range("more than 0", is_open=True)]
Share = Annotated[float, Range("a share from 0 to 1", highest=1.0)]
PositiveShare = Annotated[float, Range("a share above 0, at most 1", highest=1.0, is_open=True)]
Temperature = Annotated[float, Range("a temperature [deg C]", -273.15, 1000.0)]


def check_fields(description: Any, file: str, prefix: str) -> None:
    """Check the numbers of a description against the ranges of their types; None is allowed where the type has it.

    Args:
        description: A dataclass.
        file: Name of the file, for messages.
        prefix: Beginning of keys in messages, such as "motors.knee_rotor.".

    Raises:
        RobotError: A number is out of range.
    """
    for name, allowed in _ranges(type(description)).items():
        value = getattr(description, name)
        if value is not None and value not in allowed:
            raise invalid_value(file, f"{prefix}{name}", value, allowed.expected)


@cache
def _ranges(kind: type) -> dict[str, Range]:
    """Return the ranges of the fields of a dataclass, by name."""
    hints = get_type_hints(kind, include_extras=True).items()
    parts = [(name, part) for name, hint in hints for part in (hint, *get_args(hint))]  # `X | None` has two arguments
    extras = [(name, extra) for name, part in parts for extra in getattr(part, "__metadata__", ())]
    return {name: extra for name, extra in extras if isinstance(extra, Range)}
