"""Requests of a live page, as JSON: `{"do": name, ...}`. Invalid messages give an error of one line."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from ce_gym.model.arguments import check, is_number
from ce_gym.model.options import Check, flag, number, one_of
from ce_gym.viewer.live.robot import RANGES
from ce_gym.viewer.live.session import Session

MOST_SPEED = 4.0

Message = Mapping[str, Any]
Request = Callable[[Session], None]


def request_of(message: Message) -> Request:
    """Return the change of a session that a message requests.

    Raises:
        ValueError: The message is not a valid request.
    """
    change, checks = REQUESTS[one_of(REQUESTS)("do", message.get("do"))]
    values = checked(message, checks)
    if missing := [name for name in checks if name not in values]:
        raise ValueError(f"do={message['do']!r}: {missing[0]!r} is missing")
    if message["do"] == "figure":
        number(*RANGES[values["name"]])("value", values["value"])
    return lambda session: change(session, **values)


def checked(message: Message, checks: Mapping[str, Check]) -> dict[str, Any]:
    """Return the entries of a message beside `do`, each after its check.

    Raises:
        ValueError: An entry is unknown or has a wrong value.
    """
    values = {}
    for name, value in message.items():
        if name != "do":
            check("entry", name, name in checks, f"one of {', '.join(checks) or 'none'}")
            values[name] = checks[name](name, value)
    return values


def parsed(body: bytes) -> dict[str, Any]:
    """Return a posted message.

    Raises:
        ValueError: The body is not a JSON object.
    """
    try:
        message = json.loads(body)
    except (ValueError, RecursionError):
        raise ValueError("message: expected JSON") from None
    if not isinstance(message, dict):
        raise ValueError(f"message: {type(message).__name__}; expected an object")
    return message


def _vector(name: str, value: Any) -> list[float]:
    valid = isinstance(value, list) and len(value) == 3 and all(is_number(x) and abs(x) < 1e6 for x in value)
    check(name, value, valid, "three numbers")
    return [float(x) for x in value]


def _text(name: str, value: Any) -> str:
    check(name, value, isinstance(value, str), "a name")
    return value


def _set_figure(session: Session, name: str, value: float) -> None:
    session.set_figures({name: value})


REQUESTS: Mapping[str, tuple[Callable[..., None], Mapping[str, Check]]] = {
    "drive": (Session.drive, {"shares": _vector}),
    "pause": (Session.pause, {"on": flag}),
    "speed": (Session.set_speed, {"speed": number(0.01, MOST_SPEED)}),
    "step": (Session.step_once, {}),
    "look_back": (Session.look_back, {"seconds": number(0.0, 1e4)}),
    "drag": (Session.drag, {"body": _text, "point": _vector, "target": _vector}),
    "release": (Session.release, {}),
    "throw": (Session.throw, {}),
    "drop": (Session.drop, {}),
    "reset": (Session.reset, {}),
    "align": (Session.align_ghost, {}),
    "figure": (_set_figure, {"name": one_of(RANGES), "value": number(0.0)}),
}
"""The change of a session and the checks of its arguments, by the name of a request."""
