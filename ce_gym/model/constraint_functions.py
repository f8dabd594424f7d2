"""Constraint functions that users register from Python, by name.

A description holds the name only, so that it stays plain data. The dynamics calls the functions with
CasADi expressions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from ce_gym.model.errors import RobotError

ConstraintFunction = Callable[[Sequence[Any]], Sequence[Any]]

_functions: dict[str, ConstraintFunction] = {}


def register_constraint(name: str, function: ConstraintFunction) -> None:
    """Make a function available to `FunctionConstraint` under a name.

    Args:
        name: The name; registering it again with another function replaces it for models built later.
        function: Takes a sequence of joint coordinates (CasADi SX scalars) [rad or m] and returns a sequence of
            expressions of them: residuals `phi` that vanish, or coordinates `gamma` of dependent joints.
    """
    _functions[name] = function


def constraint_function(name: str) -> ConstraintFunction:
    """Return the function registered under `name`.

    Raises:
        RobotError: There is none.
    """
    if name not in _functions:
        known = ", ".join(sorted(_functions)) or "there are none"
        raise RobotError(f"constraint function {name!r}: expected a registered function ({known}); register_constraint")
    return _functions[name]
