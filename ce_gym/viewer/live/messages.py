"""Requests of a live page, as JSON: `{"do": name, ...}`. Any other message is refused in one line."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

from ce_gym.viewer.live.robot import RANGES
from ce_gym.viewer.live.session import Session

MOST_SPEED = 4.0

Request = Callable[[Session], None]


def request_of(message: Mapping[str, Any]) -> Request:
    """Return what a message does to a session.

    Raises:
        ValueError: If it is not a valid request.
    """
    name = message.get("do")
    if not isinstance(name, str) or name not in REQUESTS:
        raise ValueError(f"do={name!r}; expected one of {', '.join(REQUESTS)}")
    try:
        return REQUESTS[name](message)
    except KeyError as missing:
        raise ValueError(f"do={name!r}: {missing} is missing") from None


def parsed(body: bytes) -> dict[str, Any]:
    """Return the object that a page posted.

    Raises:
        ValueError: If it is no JSON object.
    """
    try:
        message = json.loads(body)
    except (ValueError, RecursionError):
        raise ValueError("message: expected JSON") from None
    if not isinstance(message, dict):
        raise ValueError(f"message: {type(message).__name__}; expected an object")
    return message


def _number(message: Mapping[str, Any], name: str, low: float, high: float) -> float:
    value = message[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{name}={value!r}; expected a number from {low:g} to {high:g}")
    return float(value)


def _vector(message: Mapping[str, Any], name: str) -> list[float]:
    value = message[name]
    if not isinstance(value, list) or len(value) != 3 or not all(_is_coordinate(x) for x in value):
        raise ValueError(f"{name}={value!r}; expected three numbers")
    return [float(x) for x in value]


def _is_coordinate(x: Any) -> bool:
    return isinstance(x, int | float) and not isinstance(x, bool) and math.isfinite(x) and abs(x) < 1e6


def _switch(message: Mapping[str, Any]) -> bool:
    if not isinstance(on := message["on"], bool):
        raise ValueError(f"on={on!r}; expected true or false")
    return on


def _drive(message: Mapping[str, Any]) -> Request:
    shares = _vector(message, "shares")
    return lambda session: session.drive(shares)


def _pause(message: Mapping[str, Any]) -> Request:
    on = _switch(message)
    return lambda session: session.pause(on)


def _set_speed(message: Mapping[str, Any]) -> Request:
    speed = _number(message, "speed", 0.01, MOST_SPEED)
    return lambda session: setattr(session, "speed", speed)


def _look_back(message: Mapping[str, Any]) -> Request:
    seconds = _number(message, "seconds", 0.0, 1e4)
    return lambda session: session.look_back(seconds)


def _drag(message: Mapping[str, Any]) -> Request:
    body, point, target = message["body"], _vector(message, "point"), _vector(message, "target")

    def request(session: Session) -> None:
        if body in session.robots[0].model.body_names:
            session.drag(body, point, target)

    return request


def _set_figure(message: Mapping[str, Any]) -> Request:
    if (name := message["name"]) not in RANGES:
        raise ValueError(f"name={name!r}; expected one of {', '.join(RANGES)}")
    value = _number(message, "value", *RANGES[name])
    return lambda session: session.set_figures({name: value})


REQUESTS: Mapping[str, Callable[[Mapping[str, Any]], Request]] = {
    "drive": _drive,
    "pause": _pause,
    "speed": _set_speed,
    "step": lambda _: Session.step_once,
    "look_back": _look_back,
    "drag": _drag,
    "release": lambda _: Session.release,
    "throw": lambda _: Session.throw,
    "drop": lambda _: Session.drop,
    "reset": lambda _: Session.reset,
    "align": lambda _: Session.align_ghost,
    "figure": _set_figure,
}
