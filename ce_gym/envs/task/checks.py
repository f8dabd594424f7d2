"""Checks of the figures of a task that users give as arguments."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from ce_gym.dynamics.forces.friction import FRICTION
from ce_gym.dynamics.forces.motors import MOTORS
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.envs.task.tasks import STARTS, Actions
from ce_gym.envs.task.terrain_tiles import checked_terrain
from ce_gym.envs.terms.registry import terms_of
from ce_gym.model.arguments import check, check_choice, check_whole, is_number
from ce_gym.model.errors import check_names, listed_names

CHOICES = {"actions": get_args(Actions), "friction": FRICTION, "motors": MOTORS, "method": METHODS}
POSITIVE = ("action_scale", "command_period", "gait_period", "dt", "tolerance")
COUNTS = ("history", "n_substeps", "episode_length", "max_episode_steps")
TERMS = ("observations", "terminations", "metrics", "critic")
HEAVIEST = 1e9
"""Largest weight of a reward, either way."""
LARGEST = {"dt": 0.1, "standing_fraction": 1.0, "tolerance": 1.0}


def checked_value(name: str, value: Any, old: Any) -> Any:
    """Return a figure of a task in the form that tasks have it.

    Args:
        name: Attribute of `Task`.
        value: What a user gave.
        old: What the task has, whose kind decides.

    Raises:
        ValueError: If it is not of that kind or out of range.
    """
    if name in CHOICES:
        check_choice(name, value, CHOICES[name])
        return value
    if name == "terrain":
        return checked_terrain(value)
    if name in ("contacts", "seldom"):
        return value if isinstance(value, str) else _names(name, value)
    if name == "self_collisions":
        return value if isinstance(value, str) else tuple(_names(name, pair) for pair in _sequence(name, value))
    if name == "command_range":
        pairs = tuple(_pair(name, pair) for pair in _sequence(name, value))
        check(name, value, len(pairs) == 3, "three pairs (low, high) with low <= high")
        return pairs
    if name == "latency":
        low, high = _pair(name, value)
        check(name, value, low >= 0 and low == int(low) and high == int(high), "two whole numbers, 0 or more")
        return int(low), int(high)
    if name in ("randomise", "start"):
        check(name, value, isinstance(value, Mapping), "pairs (low, high) by the name of a figure")
        for key in value if name == "start" else ():
            check(name, key, key in STARTS, f"one of {listed_names(key, STARTS)}")
        return {str(key): _pair(f"{name}[{key!r}]", pair) for key, pair in value.items()}
    if name in TERMS:
        return _terms(name, value)
    if name in COUNTS:
        check_whole(name, value, 1)
        return int(value)
    if isinstance(old, bool):
        check(name, value, isinstance(value, bool), "true or false")
        return value
    if isinstance(old, Mapping):
        check(name, value, isinstance(value, Mapping), "numbers by name")
        for key, figure in value.items():
            check(f"{name}[{key!r}]", figure, number(f"{name}[{key!r}]", figure) >= 0, "0 or more")
            check(name, key, name != "reset_noise" or key in old, f"one of {listed_names(key, old)}")
        return {**old, **{str(key): float(figure) for key, figure in value.items()}}
    if isinstance(old, tuple):
        return _names(name, value)
    if name == "command_curriculum":
        check(name, value, 0 < number(name, value) <= 1, "a share above 0 and up to 1")
    figure, expected = number(name, value), "a positive number" if name in POSITIVE else "0 or more"
    check(name, value, figure > 0 or (figure == 0 and name not in POSITIVE), expected)
    most = LARGEST.get(name, math.inf)
    check(name, value, figure <= most, f"at most {most:g}")
    return figure


def merged_rewards(old: Mapping[str, Any], given: Any) -> dict[str, Any]:
    """Return reward terms of a task with some replaced or added, those of weight 0 left out.

    Args:
        old: What the task has, a weight or a mapping of `weight` and parameters by the name of the term.
        given: What a user gave, likewise; parameters alone leave the weight as it was.

    Raises:
        ValueError: If it is nothing of the kind, or a term of weight 0 does not exist.
    """
    check("rewards", given, isinstance(given, Mapping), "weights, or mappings of weight and parameters, by name")
    rewards = dict(old)
    for term, value in given.items():
        before = old.get(term, {})
        before = dict(before) if isinstance(before, Mapping) else {"weight": before}
        new = before | (dict(value) if isinstance(value, Mapping) else {"weight": value})
        place = f"rewards[{term!r}]"
        check(place, value, "weight" in new, "a `weight`, for the task has none")
        new["weight"] = number(place, new["weight"])
        check(place, value, abs(new["weight"]) <= HEAVIEST, f"a weight from -{HEAVIEST:g} to {HEAVIEST:g}")
        rewards[str(term)] = new if len(new) > 1 else new["weight"]
        if new["weight"] == 0:
            terms_of("reward", {term: new})
            del rewards[str(term)]
    return rewards


def _terms(name: str, value: Any) -> Any:
    """Return names of terms, or parameters of terms by name."""
    if isinstance(value, Mapping):
        terms: Any = {str(key): {} if own is None else own for key, own in value.items()}
        for key, own in terms.items():
            check(f"{name}[{key!r}]", own, isinstance(own, Mapping), "parameters by name")
    else:
        terms = _names(name, value)
        check_names(name, terms, terms, "a term among")
    check(name, value, len(terms) > 0 or name != "observations", "at least one name")
    return terms


def number(name: str, value: Any) -> float:
    """Return a finite number.

    Raises:
        ValueError: If it is none.
    """
    check(name, value, is_number(value), "a finite number")
    return float(value)


def _pair(name: str, value: Any) -> tuple[float, float]:
    items = _sequence(name, value)
    check(name, value, len(items) == 2, "a pair (low, high) with low <= high")
    low, high = (number(name, item) for item in items)
    check(name, value, low <= high, "a pair (low, high) with low <= high")
    return low, high


def _names(name: str, value: Any) -> tuple[str, ...]:
    items = tuple(_sequence(name, value))
    check(name, value, all(isinstance(item, str) for item in items), "a list of names")
    return items


def _sequence(name: str, value: Any) -> Sequence[Any]:
    check(name, value, isinstance(value, Sequence) and not isinstance(value, str), "a list")
    return value
