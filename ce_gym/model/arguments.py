"""Checks of arguments. An error is one line with the argument, its value and the allowed values."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

import numpy as np

from ce_gym.model.errors import listed_names


def check(argument: str, value: object, valid: Any, expected: str) -> None:
    """Raise a ValueError unless `valid`."""
    if not valid:
        raise ValueError(f"{argument}={value!r}; expected {expected}")


def check_choice(argument: str, value: object, choices: Iterable[object]) -> None:
    """Raise a ValueError unless a value is one of the choices."""
    known = tuple(choices)
    close = listed_names(value, [each for each in known if isinstance(each, str)]).partition(" (")[2]
    check(argument, value, value in known, " or ".join(map(repr, known)) + (f" ({close}" if close else ""))


def check_whole(argument: str, value: Any, least: int, unit: str = "") -> None:
    """Raise a ValueError unless a value is a whole number, at least `least`."""
    check(argument, value, is_whole(value) and value >= least, f"a whole number{unit}, at least {least}")


def check_shape(argument: str, value: Any, *expected: tuple[int, ...]) -> None:
    """Raise a ValueError unless an array has one of the shapes."""
    if tuple(value.shape) not in expected:
        raise ValueError(f"{argument} has shape {tuple(value.shape)}; expected {' or '.join(map(str, expected))}")


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number."""
    number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    return number and bool(abs(value) <= sys.float_info.max)  # a whole number may have hundreds of digits


def is_whole(value: object) -> bool:
    """Return whether a value is a whole number."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)
