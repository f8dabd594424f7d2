"""What a user sees when a robot file is wrong: one line, no traceback of a dependency."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable

_LONGEST_VALUE = 60
_SHORT = reprlib.Repr()  # stops inside a large value; aliases can make a small YAML file a huge one
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 6
_SHORT.maxlevel = 3
_SHORT.maxstring = _SHORT.maxother = _LONGEST_VALUE


class RobotError(ValueError):
    """A robot description that cannot be used; the message is one line, without control characters."""

    def __init__(self, message: str):
        super().__init__(printable(message))


class InertiaWarning(UserWarning):
    """An inertia that no rigid body can have; it is used as it is."""


class LossyImportWarning(UserWarning):
    """A file says things that a `Robot` cannot; the message is a short list, `Robot.notes` has all of them."""


def bad(file: str, key: str, value: object, expected: str) -> RobotError:
    """Return the error for one bad value: file, key, value, and what was expected.

    Args:
        file: Name of the file as the user gave it.
        key: Where in the file, such as `rotors.FL_hip_rotor.mass`.
        value: What was found there.
        expected: What should be there instead.
    """
    return RobotError(f"{file}: {key} is {shown(value)}: expected {expected}")


def unknown(file: str, key: str, value: object, known: Iterable[str], what: str) -> RobotError:
    """Return the error for a name that does not exist, with the closest one that does."""
    names = list(known)
    close = difflib.get_close_matches(str(value), names, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else f" ({', '.join(names) or 'there are none'})"
    return bad(file, key, value, f"{what}{hint}")


def printable(text: str) -> str:
    """Return text with what could move a terminal's cursor, such as an escape sequence, spelled out."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)


def shown(value: object) -> str:
    """Return `value` as one short line of text; None is a value that is missing."""
    if value is None:
        return "missing"
    try:
        text = " ".join(_SHORT.repr(value).split())
    except ValueError:  # Python does not print integers of thousands of digits
        text = "a number with thousands of digits"
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "..."
