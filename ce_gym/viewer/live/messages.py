"""Requests of a live page, as JSON: `{"do": name, ...}`. Invalid messages give an error of one line."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

from ce_gym.viewer.live.robot import RANGES
from ce_gym.viewer.live.session import Session

MOST_SPEED = 4.0

Message = Mapping[str, Any]
Request = Callable[[Session], None]
Reader = Callable[[Message], Any]


def request_of(message: Message) -> Request:
    """Return the change of a session that a message requests.

    Raises:
        ValueError: The message is not a valid request.
    """
    name = message.get("do")
    if not isinstance(name, str) or name not in REQUESTS:
        raise ValueError(f"do={name!r}; expected one of {', '.join(REQUESTS)}")
    method, readers = REQUESTS[name]
    try:
        values = [read(message) for read in readers]
    except KeyError as missing:
        raise ValueError(f"do={name!r}: {missing} is missing") from None
    return lambda session: method(session, *values)


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


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _number(name: str, low: float, high: float) -> Reader:
    def read(message: Message) -> float:
        value = message[name]
        if not _is_number(value) or not low <= value <= high:
            raise ValueError(f"{name}={value!r}; expected a number from {low:g} to {high:g}")
        return float(value)

    return read


def _vector(name: str) -> Reader:
    def read(message: Message) -> list[float]:
        value = message[name]
        if not isinstance(value, list) or len(value) != 3 or not all(_is_number(x) and abs(x) < 1e6 for x in value):
            raise ValueError(f"{name}={value!r}; expected three numbers")
        return [float(x) for x in value]

    return read


def _on(message: Message) -> bool:
    if not isinstance(on := message["on"], bool):
        raise ValueError(f"on={on!r}; expected true or false")
    return on


def _figure(message: Message) -> dict[str, float]:
    if (name := message["name"]) not in RANGES:
        raise ValueError(f"name={name!r}; expected one of {', '.join(RANGES)}")
    return {name: _number("value", *RANGES[name])(message)}


REQUESTS: Mapping[str, tuple[Callable[..., None], tuple[Reader, ...]]] = {
    "drive": (Session.drive, (_vector("shares"),)),
    "pause": (Session.pause, (_on,)),
    "speed": (Session.set_speed, (_number("speed", 0.01, MOST_SPEED),)),
    "step": (Session.step_once, ()),
    "look_back": (Session.look_back, (_number("seconds", 0.0, 1e4),)),
    "drag": (Session.drag, (lambda message: message["body"], _vector("point"), _vector("target"))),
    "release": (Session.release, ()),
    "throw": (Session.throw, ()),
    "drop": (Session.drop, ()),
    "reset": (Session.reset, ()),
    "align": (Session.align_ghost, ()),
    "figure": (Session.set_figures, (_figure,)),
}
"""The method of `Session` and the readers of its arguments, by the name of a request."""
