"""Dataclasses of options: each field declares its default and a check, which returns the value to store."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, TypeAlias

from ce_gym.model.arguments import check, check_choice, is_number, is_whole
from ce_gym.model.errors import listed_names

Check: TypeAlias = Callable[[str, Any], Any]
"""Takes the name of a field and a value; returns the value to store, or raises a ValueError with one line."""


class UnknownArgument(TypeError, ValueError):
    """A keyword argument that does not exist: a TypeError as in Python, and a ValueError as all wrong arguments."""


def option(check: Check, default: Any = MISSING, merges: bool = False) -> Any:
    """Return a field of a dataclass that derives from `Options`.

    Args:
        check: Check of its values.
        default: Default of the field; without a default the field is required.
        merges: Whether a user's mapping changes some entries of the default and keeps the others.
    """
    metadata = {"check": check, "merges": merges}
    if isinstance(default, Mapping):
        return field(default_factory=lambda: default, metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Options:
    """Base of dataclasses that check their fields."""

    def __post_init__(self) -> None:
        for each in fields(self):
            if "check" in each.metadata:
                value = each.metadata["check"](each.name, getattr(self, each.name))
                object.__setattr__(self, each.name, value)


def check_fields(options: type[Options], names: Iterable[str], others: Iterable[str] = ()) -> None:
    """Check that options have fields of these names.

    Args:
        options: The class of the options.
        names: Keyword arguments that a user gave.
        others: Further arguments that exist, listed in the error.

    Raises:
        UnknownArgument: One line with the first wrong name, the names that exist, and the closest name.
    """
    known = [each.name for each in fields(options)]
    for name in names:
        if name not in known:
            expected = listed_names(name, dict.fromkeys([*others, *known]))
            raise UnknownArgument(f"unexpected keyword argument {name!r}; expected one of {expected}")


def optional(check: Check) -> Check:
    """Return a check that also allows None."""
    return lambda name, value: None if value is None else check(name, value)


def one_of(known: Iterable[object]) -> Check:
    """Return a check for a choice; names that are added to `known` later are allowed, too."""

    def checked(name: str, value: Any) -> Any:
        check_choice(name, value, known)
        return value

    return checked


def number(least: float, most: float = math.inf, unit: str = "") -> Check:
    """Return a check for a finite number from `least` to `most`."""
    bounds = f", {least:g} or more" if most == math.inf else f" between {least:g} and {most:g} {unit}".rstrip()

    def checked(name: str, value: Any) -> float:
        check(name, value, is_number(value) and least <= value <= most, f"a number{bounds}")
        return float(value)

    return checked


def positive(most: float = math.inf, unit: str = "") -> Check:
    """Return a check for a finite number above 0, up to `most`."""
    bound = "" if most == math.inf else f", at most {most:g} {unit}".rstrip()

    def checked(name: str, value: Any) -> float:
        check(name, value, is_number(value) and 0 < value <= most, f"a positive number{bound}")
        return float(value)

    return checked


def whole(least: int, most: float = math.inf) -> Check:
    """Return a check for a whole number from `least` to `most`."""
    expected = f", at least {least}" if most == math.inf else f" between {least} and {most}"

    def checked(name: str, value: Any) -> int:
        check(name, value, is_whole(value) and least <= value <= most, f"a whole number{expected}")
        return int(value)

    return checked


def flag(name: str, value: Any) -> bool:
    """Check a value that is true or false."""
    check(name, value, isinstance(value, bool), "true or false")
    return value


def names(name: str, value: Any) -> str | tuple[str, ...]:
    """Check a name or a list of names; whether they exist is checked with the robot."""
    check(name, value, isinstance(value, Iterable), "a name or a list of names")
    return value if isinstance(value, str) else tuple(value)


def pairs_of_names(name: str, value: Any) -> str | tuple[tuple[str, ...], ...]:
    """Check a name or a list of pairs of names; whether they exist is checked with the robot."""
    if isinstance(value, str):
        return value
    pairs = tuple(value) if isinstance(value, Iterable) else (value,)
    lists = all(isinstance(pair, Iterable) and not isinstance(pair, str) for pair in pairs)
    check(name, value, lists, "a name or a list of pairs of names")
    return tuple(tuple(pair) for pair in pairs)
