"""Terms of the package and of users by name, and tracing them with clear errors.

@ce_gym.reward
def near_the_origin(s, width=1.0):
    return -(s.q[0] ** 2 + s.q[1] ** 2) / width**2

gymnasium.make("ce_gym/MiniCheetahVelocity-v0", rewards={"near_the_origin": {"weight": 0.5, "width": 2.0}})
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.envs.terms import (
    height_scan,
    metrics,
    observations,
    outcomes,
    range_scan,
    rewards,
    sensors,
    skills,
    terminations,
)
from ce_gym.envs.terms.context import TermContext
from ce_gym.model.arguments import is_number
from ce_gym.model.errors import listed_names

Function = Callable[..., SX]
_F = TypeVar("_F", bound=Callable)


def _functions_of(module: ModuleType) -> dict[str, Function]:
    return {
        name: function
        for name, function in inspect.getmembers(module, inspect.isfunction)
        if function.__module__ == module.__name__ and not name.startswith("_")
    }


OWN: dict[str, dict[str, Function]] = {
    "reward": _functions_of(rewards) | _functions_of(skills),
    "observation": _functions_of(observations)
    | _functions_of(height_scan)
    | _functions_of(range_scan)
    | _functions_of(sensors),
    "termination": _functions_of(terminations),
    "metric": _functions_of(metrics) | _functions_of(outcomes),
}
ON_REQUEST = {
    "contact_forces": "contact_forces=True in the environment",
    "motor_torque": "the observation 'motor_torques' in the task",
}
"""Properties of `TermContext` that only some environments have, and the argument that adds each."""
_added: dict[str, dict[str, Function]] = {kind: {} for kind in OWN}


@dataclass(frozen=True)
class Term:
    """A term of a task.

    Attributes:
        kind: "reward", "observation", "termination" or "metric".
        name: Name of the function.
        function: A function of a `TermContext` and of parameters with defaults.
        parameters: Parameters that differ from the defaults.
        weight: Weight of a reward.
    """

    kind: str
    name: str
    function: Function
    parameters: Mapping[str, Any]
    weight: float = 1.0

    @property
    def added(self) -> bool:
        """Whether a user has added the term."""
        return self.name in _added[self.kind]

    @property
    def at_the_end(self) -> bool:
        """Whether a metric reports its final value instead of its mean over the episode."""
        return self.function.__module__ == outcomes.__name__

    @property
    def key(self) -> str:
        """Kind and name, the name of the term in kernels."""
        return f"{self.kind}_{self.name}".replace("__", "_")  # CasADi's rule for names

    @property
    def inputs(self) -> tuple[str, ...]:
        """Properties of `TermContext` that an `@njit` function takes; empty for a traced term."""
        return getattr(self.function, "inputs", ())

    def __call__(self, s: TermContext) -> SX:
        """Trace the term.

        Raises:
            ValueError: The function cannot be traced; one line.
        """
        with self._tracing(s):
            value = self.function(s, **self.parameters)
            if value is None:
                raise TypeError("returns None; expected a CasADi expression")
            return SX(value)

    def trace_inputs(self, s: TermContext) -> list[SX]:
        """Trace the inputs of an `@njit` function; a list has a row for each entry.

        Raises:
            ValueError: An input does not exist, or is not an array; one line.
        """
        values = []
        with self._tracing(s):
            for name in self.inputs:
                value = getattr(s, name)
                if isinstance(value, list):
                    value = ca.horzcat(SX(), *value).T
                if not isinstance(value, SX | np.ndarray | float):
                    raise TypeError(f"argument {name!r}: {type(value).__name__}; expected a property with numbers")
                values.append(ca.densify(SX(value)))
        return values

    @contextmanager
    def _tracing(self, s: TermContext) -> Iterator[None]:
        """Name the term that is being traced, also in errors."""
        s.term = f"{self.kind}_{self.name}"
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", category=FutureWarning)  # CasADi's, of numpy's functions
                yield
        except (RuntimeError, NotImplementedError, TypeError, KeyError, AttributeError) as error:
            raise ValueError(f"{self.kind} term {self.name!r}: {_advice(error, s)}") from error

    def number(self, s: TermContext) -> SX:
        """Trace a term that returns one number.

        Raises:
            ValueError: The function cannot be traced or returns another shape; one line.
        """
        value = self(s)
        if value.numel() != 1:
            expected = "expected one number, for instance ca.sumsqr(...) or ca.sum1(...)"
            raise ValueError(f"{self.kind} term {self.name!r} has shape {value.shape}; {expected}")
        return value


def _advice(error: Exception, s: TermContext) -> str:
    """Return one line on an error in a term: the names that exist, the CasADi functions to use, or its own text."""
    if isinstance(error, AttributeError) and error.obj is s:
        known = [name for name in dir(TermContext) if not name.startswith("_")]
        return f"no attribute {error.name!r} of TermContext; expected one of {listed_names(error.name, known)}"
    if isinstance(error, KeyError):
        bodies = [body.name for body in s.mechanism.robot.bodies]
        key = str(error.args[0]) if error.args else ""
        if key in ON_REQUEST:
            return f"{key} is not computed; expected {ON_REQUEST[key]}"
        return key if "has no body" in key else f"no key {key!r}; bodies are {listed_names(key, bodies)}"
    if "truth value" in str(error):
        return "a condition on a traced value (Python's if, and, or, min, max); expected ca.if_else, ca.fmin, ca.fmax"
    text = str(error).strip().splitlines() or [type(error).__name__]
    if isinstance(error, TypeError | AttributeError):
        return text[0]
    return f"{text[-1]}; expected arithmetic of CasADi expressions (ca.sqrt, ca.if_else, ca.dot, ...)"


def terms_of(kind: str, chosen: Mapping[str, Any] | Iterable[str]) -> dict[str, Term]:
    """Return the terms that a task names.

    Args:
        kind: "reward", "observation", "termination" or "metric".
        chosen: Names, or parameters by name. A reward has a weight, or parameters that include `weight`.

    Raises:
        ValueError: There is no such term or parameter; the message lists the existing ones.
    """
    return {name: _term(kind, name, chosen[name] if isinstance(chosen, Mapping) else {}) for name in chosen}


def _term(kind: str, name: str, options: Any) -> Term:
    known = OWN[kind] | _added[kind]
    if name not in known:
        raise ValueError(f"no {kind} term {name!r}; expected one of {listed_names(name, sorted(known))}")
    parameters = dict(options) if isinstance(options, Mapping) else {"weight": options}
    weight = parameters.pop("weight", 1.0) if kind == "reward" else 1.0
    defaults = parameters_of(known[name])
    for key, value in parameters.items():
        if key not in defaults:
            expected = f"one of {listed_names(key, defaults)}" if defaults else "none"
            raise ValueError(f"{kind} term {name!r}: parameter {key!r}; expected {expected}")
        if is_number(defaults[key]) and not is_number(value):
            raise ValueError(f"{kind} term {name!r}: {key}={value!r}; expected a finite number")
    return Term(kind, name, known[name], parameters, weight)


def parameters_of(function: Function) -> dict[str, Any]:
    """Return the parameters of a term and their defaults."""
    _, *others = inspect.signature(function).parameters.values()
    return {parameter.name: parameter.default for parameter in others}


def reward(function: _F) -> _F:
    """Add a reward term under the function's name: a function of a `TermContext` that returns one number.

    Further arguments, with defaults, are parameters that a task can set; see `TermContext.recall` for memory.

    Raises:
        ValueError: The package has a term of this name, or a parameter has no default.
    """
    return _add("reward", function)


def observation(function: _F) -> _F:
    """Add an observation block under the function's name: a function of a `TermContext` that returns a vector."""
    return _add("observation", function)


def termination(function: _F) -> _F:
    """Add a condition that ends an episode: a function of a `TermContext` that returns 0 or 1."""
    return _add("termination", function)


def metric(function: _F) -> _F:
    """Add a metric under the function's name: a function of a `TermContext` that returns one number."""
    return _add("metric", function)


def _add(kind: str, function: _F) -> _F:
    name = function.__name__
    if name in OWN[kind]:
        raise ValueError(f"{kind} term {name!r}: the package has one of this name; give yours another")
    for parameter, default in parameters_of(function).items():
        if default is inspect.Parameter.empty:
            raise ValueError(f"{kind} term {name!r}: parameter {parameter!r} has no default; expected one")
    if hasattr(function, "py_func"):
        expected = "CasADi operations without @njit, or ce_gym.numba.reward and ce_gym.numba.termination"
        raise ValueError(f"{kind} term {name!r}: an @njit function; expected {expected}")
    _added[kind][name] = function
    return function
