"""Checks of the fields of a task, see `ce_gym.model.options`, and of its rewards."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from ce_gym.envs.terms.registry import terms_of
from ce_gym.model.arguments import check, check_choice, is_number
from ce_gym.model.errors import check_names, listed_names
from ce_gym.model.options import Check

HEAVIEST = 1e9
"""Largest weight of a reward, either way."""


def terms(name: str, value: Any) -> Any:
    """Check names of terms, or parameters of terms by name; whether the terms exist is checked with the robot."""
    if not isinstance(value, Mapping):
        listed = list_of_names(name, value)
        check_names(name, listed, listed, "a term among")
        return listed
    parameters: Any = {str(key): {} if own is None else own for key, own in value.items()}
    for key, own in parameters.items():
        check(f"{name}[{key!r}]", own, isinstance(own, Mapping), "parameters by name")
    return parameters


def list_of_names(name: str, value: Any) -> tuple[str, ...]:
    """Check a list of names."""
    items = tuple(_sequence(name, value))
    check(name, value, all(isinstance(item, str) for item in items), "a list of names")
    return items


def action_kinds(known: Collection[str]) -> Check:
    """Return a check for a meaning of actions, or for meanings of actions on joints by pattern of joints."""

    def checked(name: str, value: Any) -> Any:
        if not isinstance(value, Mapping):
            check_choice(name, value, known)
            return value
        check(name, value, value, "at least one pattern of joints")
        for pattern, kind in value.items():
            check_choice(f"{name}[{pattern!r}]", kind, [kind for kind in known if kind.startswith("joint")])
        return {str(pattern): kind for pattern, kind in value.items()}

    return checked


def command_ranges(name: str, value: Any) -> tuple[tuple[float, float], ...]:
    """Check the ranges of a command."""
    ranges = tuple(_range(name, pair) for pair in _sequence(name, value))
    check(name, value, len(ranges) == 3, "three pairs (low, high) with low <= high")
    return ranges


def whole_range(name: str, value: Any) -> tuple[int, int]:
    """Check a range of whole numbers, 0 or more."""
    low, high = _range(name, value)
    check(name, value, low >= 0 and low == int(low) and high == int(high), "two whole numbers, 0 or more")
    return int(low), int(high)


def ranges(known: Collection[str] = ()) -> Check:
    """Return a check for ranges by name; names are checked with the robot if `known` is empty."""

    def checked(name: str, value: Any) -> dict[str, tuple[float, float]]:
        check(name, value, isinstance(value, Mapping), "pairs (low, high) by the name of a figure")
        for key in value if known else ():
            check(name, key, key in known, f"one of {listed_names(key, known)}")
        return {str(key): _range(f"{name}[{key!r}]", pair) for key, pair in value.items()}

    return checked


def magnitudes(known: Collection[str] = ()) -> Check:
    """Return a check for numbers from 0 by name; names are checked with the robot if `known` is empty."""

    def checked(name: str, value: Any) -> dict[str, float]:
        check(name, value, isinstance(value, Mapping), "numbers by name")
        for key, figure in value.items():
            check(f"{name}[{key!r}]", figure, number(f"{name}[{key!r}]", figure) >= 0, "0 or more")
            check(name, key, not known or key in known, f"one of {listed_names(key, known)}")
        return {str(key): float(figure) for key, figure in value.items()}

    return checked


def merged_rewards(old: Mapping[str, Any], given: Any) -> dict[str, Any]:
    """Return reward terms of a task with some replaced or added, and without terms of weight 0.

    Args:
        old: Rewards of the task: a weight, or a mapping of `weight` and parameters, by the name of the term.
        given: Rewards of a user, in the same form; parameters alone keep the weight of the task.

    Raises:
        ValueError: If `given` has another form, or a term of weight 0 does not exist.
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


def number(name: str, value: Any) -> float:
    """Return a finite number.

    Raises:
        ValueError: If the value is not a finite number.
    """
    check(name, value, is_number(value), "a finite number")
    return float(value)


def _range(name: str, value: Any) -> tuple[float, float]:
    items = _sequence(name, value)
    check(name, value, len(items) == 2, "a pair (low, high) with low <= high")
    low, high = (number(name, item) for item in items)
    check(name, value, low <= high, "a pair (low, high) with low <= high")
    return low, high


def _sequence(name: str, value: Any) -> Sequence[Any]:
    check(name, value, isinstance(value, Sequence) and not isinstance(value, str), "a list")
    return value
