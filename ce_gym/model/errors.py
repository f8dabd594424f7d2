"""Errors and warnings of robot files: one line each, without the traceback of a dependency."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable
from fnmatch import fnmatchcase

_LONGEST_VALUE = 60
_MOST_NAMES = 60
_SHORT = reprlib.Repr()  # stops inside a large value; aliases can make a small YAML file a huge one
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 6
_SHORT.maxlevel = 3
_SHORT.maxstring = _SHORT.maxother = _LONGEST_VALUE


class RobotError(ValueError):
    """A robot description that cannot be used; the message is one line, without control characters."""

    def __init__(self, message: str):
        super().__init__(printable(message))


class InertiaWarning(UserWarning):
    """An inertia that no rigid body can have; it is used unchanged."""


class LossyImportWarning(UserWarning):
    """Parts of a file have no counterpart in `Robot`; the message is a short list, `Robot.notes` the full one."""


def file_error(file: object, problem: str, expected: str, kind: type[RobotError] = RobotError) -> RobotError:
    """Return the error of a problem in a file, as one line: file, problem, and what was expected."""
    return kind(f"{file}: {problem}: expected {expected}")


def invalid_value(file: str, key: str, value: object, expected: str) -> RobotError:
    """Return the error for an invalid value: file, key, value and allowed values.

    Args:
        file: Name of the file as the user gave it.
        key: Place in the file, such as `rotors.FL_hip_rotor.mass`.
        value: The invalid value; None if it is missing.
        expected: The allowed values.
    """
    return file_error(file, f"{key} is {shown(value)}", expected)


def unknown_name(file: str, key: str, value: object, known: Iterable[str], what: str) -> RobotError:
    """Return the error for an unknown name in a file, with the known names."""
    return invalid_value(file, key, value, f"{what}: {listed_names(value, known)}")


def check_names(
    argument: str,
    names: Iterable[object],
    known: Iterable[str],
    what: str,
    patterns: bool = False,
    listed: str | None = None,
) -> None:
    """Check that each name in a list exists and is listed once.

    Args:
        argument: Name of the argument with the list.
        names: The list.
        known: The names that exist.
        what: Kind of the names, such as "a joint".
        patterns: Whether names can be patterns, such as "*_hip", each of which must match a name.
        listed: The names that exist, in words; all of `known` if None.

    Raises:
        ValueError: One line with the first wrong name, the names that exist and the most similar name.
    """
    if isinstance(names, str):
        raise ValueError(f"{argument}={names!r}; expected a list of names, such as [{names!r}]")
    allowed, seen = list(known), set()
    for name in names:
        matches = isinstance(name, str) and (
            any(fnmatchcase(each, name) for each in allowed) if patterns else name in allowed
        )
        if not matches:
            raise ValueError(f"{argument}={name!r}; expected {what} {listed_names(name, allowed, listed)}")
        if name in seen:
            raise ValueError(f"{argument}={name!r} is listed twice; expected each name once")
        seen.add(name)


def listed_names(value: object, known: Iterable[str], listed: str | None = None) -> str:
    """Return the known names as text, with the most similar to `value`: `hip, knee (did you mean 'hip'?)`."""
    names = [str(name) for name in known]
    rest = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    listed = listed or f"{', '.join(names[:_MOST_NAMES])}{rest}" or "none: there are none"
    by_lower = {name.lower(): name for name in names}
    close = difflib.get_close_matches(str(value).strip("*?").lower(), by_lower, n=1)
    return listed + (f" (did you mean {by_lower[close[0]]!r}?)" if close else "")


def printable(text: str) -> str:
    """Return text in which characters that could move a terminal's cursor are escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)


def shown(value: object) -> str:
    """Return `value` as one short line of text, "missing" for None."""
    if value is None:
        return "missing"
    try:
        text = " ".join(_SHORT.repr(value).split())
    except ValueError:  # Python does not print integers of thousands of digits
        text = "a number with thousands of digits"
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "..."
