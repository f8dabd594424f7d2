"""Finding terms by name: the package's own and those a user adds.

    @ce_gym.reward
    def near_the_origin(s):
        return -(s.q[0] ** 2 + s.q[1] ** 2)

    gymnasium.make("ce_gym/MiniCheetahVelocity-v0", reward_weights={"near_the_origin": 0.5})

May know the term files and snapshots.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from types import ModuleType
from typing import TypeVar

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.terms import metrics, observations, rewards, terminations
from ce_gym.envs.terms.context import Snapshot

Term = Callable[[Snapshot], SX]
_F = TypeVar("_F", bound=Callable)


def _functions_of(module: ModuleType) -> dict[str, Term]:
    return {
        name: function
        for name, function in inspect.getmembers(module, inspect.isfunction)
        if function.__module__ == module.__name__ and not name.startswith("_")
    }


OWN: dict[str, dict[str, Term]] = {
    "reward": _functions_of(rewards),
    "observation": _functions_of(observations),
    "termination": _functions_of(terminations),
    "metric": _functions_of(metrics),
}
_added: dict[str, dict[str, Term]] = {kind: {} for kind in OWN}


def find_term(kind: str, name: str) -> Term:
    """Return a term.

    Args:
        kind: "reward", "observation", "termination" or "metric".
        name: Of the function.

    Raises:
        ValueError: If there is none; names those there are.
    """
    known = OWN[kind] | _added[kind]
    if name not in known:
        raise ValueError(f"no {kind} term {name!r}; expected one of {', '.join(sorted(known))}")
    return known[name]


def is_added(kind: str, name: str) -> bool:
    """Whether a term comes from a user."""
    return name in _added[kind]


def reward(function: _F) -> _F:
    """Add a reward term under the function's name: a function of a `Snapshot` that returns one number.

    Raises:
        ValueError: If the package has a term of this name.
    """
    return _add("reward", function)


def observation(function: _F) -> _F:
    """Add an observation block under the function's name: a function of a `Snapshot` that returns a vector."""
    return _add("observation", function)


def termination(function: _F) -> _F:
    """Add a condition that ends an episode: a function of a `Snapshot` that returns 0 or 1."""
    return _add("termination", function)


def metric(function: _F) -> _F:
    """Add a figure to report under the function's name: a function of a `Snapshot` that returns one number."""
    return _add("metric", function)


def _add(kind: str, function: _F) -> _F:
    name = function.__name__
    if name in OWN[kind]:
        raise ValueError(f"{kind} term {name!r}: the package has one of this name; give yours another")
    _added[kind][name] = function
    return function
