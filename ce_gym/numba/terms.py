"""A user's `@njit` function as a reward term or termination of environments on the CPU."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from functools import lru_cache
from itertools import accumulate, pairwise
from types import FunctionType
from typing import Any

import numpy as np
from numba import cfunc, njit, types
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaError, UnsupportedBytecodeError
from numba.np.numpy_support import carray

from ce_gym.compile import lane_count
from ce_gym.envs.terms import registry
from ce_gym.envs.terms.context import TermContext

EXPECTED = {
    "reward": "one float, such as 0.5 * q[2]",
    "termination": "one bool, such as q[2] < 0.2",
}


class NjitTerm:
    """An `@njit` function that the kernel of an environment calls; made by `reward` and `termination`.

    Attributes:
        kind: "reward" or "termination".
        inputs: Properties of `TermContext` that the function takes, in order.
        function: The function.
    """

    def __init__(self, kind: str, function: Any) -> None:
        compiled = njit(function) if isinstance(function, FunctionType) else function
        if not isinstance(compiled, Dispatcher):
            raise ValueError(f"{kind} term {function!r}; expected a function, with or without @njit")
        self.kind, self.function, self.__name__ = kind, compiled, compiled.__name__
        self.__doc__, self.__module__ = compiled.__doc__, compiled.__module__
        arguments = list(inspect.signature(compiled.py_func).parameters.values())
        parameters = [argument for argument in arguments if argument.default is not argument.empty]
        self.inputs = tuple(argument.name for argument in arguments if argument.default is argument.empty)
        if not self.inputs or any(argument.kind is not argument.POSITIONAL_OR_KEYWORD for argument in arguments):
            given = inspect.signature(compiled.py_func)
            expected = "names of properties of TermContext, then parameters with defaults, as in (q, v, width=1.0)"
            raise ValueError(f"{kind} term {self.__name__!r}: arguments {given}; expected {expected}")
        if compiled.targetoptions.get("parallel"):
            expected = "@njit without it: threads share the robots already"
            raise ValueError(f"{kind} term {self.__name__!r}: parallel=True; expected {expected}")
        context = inspect.Parameter("s", inspect.Parameter.POSITIONAL_ONLY)
        self.__signature__ = inspect.Signature([context, *parameters])

    def __call__(self, s: TermContext, **parameters: Any) -> Any:
        """Return the symbol of the value that the kernel gets from the function."""
        return s._njit_value

    def compiled(self, shapes: tuple[tuple[int, ...], ...], parameters: Mapping[str, Any], dtype: str) -> Any:
        """Return the C function for `Foreign`: it reads the inputs in one buffer and writes the value into another.

        Args:
            shapes: Shapes of the inputs.
            parameters: Parameters that differ from the defaults.
            dtype: "float64" or "float32" of the buffers.

        Raises:
            ValueError: numba cannot compile the function, the function returns another type, or a parameter is not
                numeric; one line.
        """
        _, *defaults = self.__signature__.parameters.values()
        constants = []
        for name, default in ((parameter.name, parameter.default) for parameter in defaults):
            value = parameters.get(name, default)
            if np.ndim(value) > 1 or np.asarray(value).dtype.kind not in "biuf":
                expected = "a number or a list of numbers"
                raise ValueError(f"{self.kind} term {self.__name__!r}: {name}={value!r}; expected {expected}")
            constants.append(tuple(value) if np.ndim(value) else value)
        return _compiled(self.kind, self.function, shapes, dtype, *constants)


@lru_cache(maxsize=None, typed=True)
def _compiled(kind: str, function: Any, shapes: tuple[tuple[int, ...], ...], dtype: str, *constants: Any) -> Any:
    place, term = f"{kind} term {function.__name__!r}", _of_one_array(function, shapes, constants)
    try:
        returned = types.unliteral(term.compile((types.float64[::1],)) and term.nopython_signatures[0].return_type)
    except (NumbaError, UnsupportedBytecodeError) as error:
        raise ValueError(f"{place}: {_first_message(error)}") from error
    if not isinstance(returned, types.Boolean | types.Integer | types.Float if kind == "reward" else types.Boolean):
        raise ValueError(f"{place} returns {returned}; expected {EXPECTED[kind]}")
    lanes, number, pointer = lane_count(dtype), types.int64, types.CPointer(getattr(types, dtype))

    @cfunc(types.void(number, number, pointer, number, pointer, number))
    def run(first, count, inputs, n_inputs, result, n_results):
        columns, results, row = carray(inputs, (n_inputs, lanes)), carray(result, (lanes,)), np.empty(n_inputs)
        for lane in range(count):
            row[:] = columns[:, lane]
            results[lane] = term(row)

    return run


def _of_one_array(function: Any, shapes: tuple[tuple[int, ...], ...], constants: tuple[Any, ...]) -> Any:
    """Return a function as a function of one array that holds all of its arrays."""
    ends = accumulate(map(math.prod, shapes), initial=0)
    arguments = [f"row[{a}:{b}].reshape({shape})" for (a, b), shape in zip(pairwise(ends), shapes, strict=True)]
    names = {f"constant_{i}": constant for i, constant in enumerate(constants)}
    scope = {"function": function, **names}
    exec(f"def whole(row): return function({', '.join([*arguments, *names])})", scope)
    return njit(scope["whole"])


def _first_message(error: Exception) -> str:
    """Return what numba says about the innermost function, in one line."""
    lines = [line.strip() for line in str(error).splitlines() if not line.startswith("Failed in")]
    ends = [i for i, line in enumerate(lines) if line.startswith(("There are", "During", "File"))]
    return " ".join(" ".join(lines[: min(ends, default=1)]).split())


def reward(function: Any) -> Any:
    """Add a reward term under the function's name; the kernels of environments on the CPU call the function.

    Args:
        function: Function with or without `@njit`. Arguments without defaults are names of properties of `TermContext`
            and get float64 arrays; a number has shape (1,), and a list a row for each entry. Arguments with defaults
            are parameters that a task can set. The function returns one number. Threads call the function for different
            robots at the same time.

    Raises:
        ValueError: The arguments have another form, or the package has a term of this name.
    """
    return registry.reward(NjitTerm("reward", function)).function


def termination(function: Any) -> Any:
    """Add a condition that ends an episode: a function as for `reward` that returns a bool."""
    return registry.termination(NjitTerm("termination", function)).function
