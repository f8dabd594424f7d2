"""Traced functions of a robot's state as kernels, on arrays with any leading batch shape.

A kernel scales quaternions to unit length, follows dependent coordinates that no formula gives, and evaluates the
function. Its last output tells whether results and positions are finite.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.compile import Buffer, Call, Kernel, Program, load_kernel, scratch_buffers, source_fingerprint
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.constraints.continuation import GAP, GUESS, Continuation
from ce_gym.model.coordinates import UNIT_ROUNDING, UNIT_TOLERANCE

Array = NDArray[Any]

LONG = 25_000
"""Instructions of a function that takes more than about two seconds to compile."""
INTERPRETED = 5000
"""Robots for which a long function is interpreted before it is compiled; that takes about as long as compiling it."""
CHECK = "check"
"""Output that is 0 if `q` is accepted and finite and all other outputs are finite, else 1."""
CLOSED = {"float64": 1e-9, "float32": 1e-5}
"""Largest gap of closed loops [m, -], by dtype."""


class BatchedFunction:
    """A traced function of column vectors that takes rows of many robots.

    Args:
        name: For people, "mini_cheetah exact mass_matrix".
        function: The function. Its input "q" is scaled to unit quaternions; `continuation` finds its input "guess".
        quaternions: Rows of `q` at which quaternions begin.
        continuation: Finds the dependent coordinates that no formula gives; None if the robot has none.
        dtype: "float64" or "float32" for arithmetic and results.
        num_threads: Threads that share the robots of a call.
        nan_rows: Whether all outputs of a robot are nan if an output or an entry of `q` is not finite.

    Attributes:
        function: The function.
        inputs: Sizes of the inputs by name, without "guess".
        outputs: Rows and columns of the outputs by name.
        is_long: Whether the function is interpreted at first.
        nan_rows: Whether all outputs of a robot are nan if an output or an entry of `q` is not finite.
    """

    def __init__(
        self,
        name: str,
        function: ca.Function,
        quaternions: Sequence[int],
        continuation: Continuation | None,
        dtype: str,
        num_threads: int,
        nan_rows: bool,
    ) -> None:
        self.function, self.nan_rows = function, nan_rows
        self.inputs = {x: function.numel_in(x) for x in function.name_in() if x != GUESS}
        self.outputs = {x: function.size_out(x) for x in function.name_out()}
        self.is_long = function.n_instructions() > LONG
        self._name, self._quaternions, self._continuation = name, quaternions, continuation
        self._dtype, self._num_threads = np.dtype(dtype), num_threads
        self._shapes = tuple((size,) for size in self.inputs.values())
        self._n_interpreted = 0
        self._free_calls: list[_SingleCall] = []

    def __call__(self, *arguments: ArrayLike) -> tuple[list[Array], bool]:
        """Evaluate the function.

        Args:
            arguments: Its inputs without "guess", shape (..., n) each.

        Returns:
            The outputs, shape (..., rows, columns), and whether all entries are numbers.

        Raises:
            ValueError: If a shape is wrong.
        """
        if len(arguments) != len(self._shapes):
            names = ", ".join(self.inputs)
            raise ValueError(f"{self.function.name()}: {len(arguments)} arguments; expected {names}")
        if self.is_long:
            return self._on_batch(arguments)
        for argument, shape in zip(arguments, self._shapes, strict=True):
            if type(argument) is not np.ndarray or argument.shape != shape:
                return self._on_batch(arguments)
        return self._on_one(arguments)

    def _on_one(self, arguments: Sequence[Any]) -> tuple[list[Array], bool]:
        """Call the kernel for one robot, in memory that earlier calls have prepared."""
        try:
            call = self._free_calls.pop()
        except IndexError:
            call = self._single_call()
        for row, argument in zip(call.inputs, arguments, strict=True):
            row[...] = argument
        call.run()
        results, is_number = [output.copy() for output in call.outputs], call.check[0, 0] == 0.0
        self._free_calls.append(call)
        if self.nan_rows and not is_number:
            for result in results:
                result[...] = np.nan
        return results, bool(is_number)

    def _single_call(self) -> _SingleCall:
        """Return memory and a call of the kernel for one robot."""
        rows = {name: np.zeros((1, size), self._dtype) for name, size in self.inputs.items()}
        results = self._results(1)
        run = self.kernel.bind(rows | results, 1)
        outputs = [results[name].reshape(shape) for name, shape in self.outputs.items()]
        return _SingleCall([row[0] for row in rows.values()], outputs, results[CHECK], run)

    def _results(self, n: int) -> dict[str, Array]:
        """Return memory for the outputs of n robots."""
        sizes = {name: rows * columns for name, (rows, columns) in self.outputs.items()} | {CHECK: 1}
        return {name: np.empty((n, size), self._dtype) for name, size in sizes.items()}

    def _on_batch(self, arguments: Sequence[ArrayLike]) -> tuple[list[Array], bool]:
        """Check and broadcast the arguments, and call the kernel."""
        arrays = [np.asarray(argument, self._dtype) for argument in arguments]
        for array, (name, size) in zip(arrays, self.inputs.items(), strict=True):
            if array.ndim == 0 or array.shape[-1] != size:
                place = f"{self.function.name()}: {name}"
                raise ValueError(f"{place} has shape {array.shape}; expected (..., {size})")
        batch = np.broadcast_shapes(*[array.shape[:-1] for array in arrays])
        n = int(np.prod(batch))
        shapes = [(*batch, array.shape[-1]) for array in arrays]
        full = [np.broadcast_to(array, shape) for array, shape in zip(arrays, shapes, strict=True)]
        rows = {x: np.ascontiguousarray(a).reshape(n, a.shape[-1]) for x, a in zip(self.inputs, full, strict=True)}
        results = self._results(n)
        if self.is_long and self._n_interpreted < INTERPRETED:
            self._n_interpreted += n
            self._interpret(rows, results)
        else:
            self.kernel(rows | results, n, num_threads=self._num_threads)
        wrong = results[CHECK][:, 0] != 0.0
        if self.nan_rows and wrong.any():
            for name in self.outputs:
                results[name][wrong] = np.nan
        outputs = [results[name].reshape(*batch, *shape) for name, shape in self.outputs.items()]
        return outputs, not wrong.any()

    def _interpret(self, rows: dict[str, Array], results: dict[str, Array]) -> None:
        """Execute the calls by CasADi's interpreter."""
        n = len(results[CHECK])
        values: dict[str, Any] = {name: row.T for name, row in rows.items()}
        for call in self._calls if n else ():
            found = call.function.map(n).call([values[name] for name in call.inputs])
            values |= dict(zip(call.outputs, found, strict=True))
        for name, result in results.items():
            if result.size:
                result[...] = np.asarray(values[name]).T

    @cached_property
    def kernel(self) -> Kernel:
        """The compiled program."""
        functions = dict.fromkeys(call.function.serialize() for call in self._calls)
        return load_kernel(f"{source_fingerprint(__name__)} {list(functions)}", self._program, self._dtype.name)

    def _program(self) -> Program:
        """Return the program of the kernel; empty inputs and outputs are left out."""
        buffers = [Buffer(name, size, "rows_in") for name, size in self.inputs.items() if size]
        checked = self._calls[-1].function
        buffers += [Buffer(name, checked.numel_out(name), "rows_out") for name in checked.name_out()]
        buffers += scratch_buffers(self._calls, [buffer.name for buffer in buffers])
        return Program(self._name, tuple(buffers), tuple(self._calls), compact=True)

    @cached_property
    def _calls(self) -> list[Call]:
        """The calls of the kernel. An output is stored row by row."""
        calls, q = [], "q"
        if "q" in self.inputs and self._quaternions:
            unit, q = _unit_function(self.inputs["q"], self._quaternions, self._dtype), "unit_q"
            calls.append(Call(unit, ("q",), (q,)))
        if GUESS in self.function.name_in():
            assert self._continuation is not None
            calls += self._continuation.calls(q)
        checked = self._checked_function()
        read = tuple(q if name == "q" else name for name in checked.name_in())
        return [*calls, Call(checked, read, tuple(checked.name_out()))]

    def _checked_function(self) -> ca.Function:
        """Return the function with transposed outputs, and a check that is 0 if all entries are numbers."""
        symbols = {name: SX.sym(name, size) for name, size in self.inputs.items()}
        inputs, arguments = dict(symbols), dict(symbols)
        if GUESS in self.function.name_in():
            guess, gap = SX.sym(GUESS, self.function.numel_in(GUESS)), SX.sym(GAP)
            inputs |= {GUESS: guess, GAP: gap}
            arguments[GUESS] = ca.if_else(gap < CLOSED[self._dtype.name], guess, np.nan)
        outputs = self.function.call([arguments[name] for name in self.function.name_in()])
        columns = {name: ca.vec(output.T) for name, output in zip(self.outputs, outputs, strict=True)}
        total = sum([ca.sum1(column) for column in (*columns.values(), symbols.get("q", SX(0)))], SX(0))
        columns[CHECK] = ca.if_else(ca.fabs(total) < np.inf, 0.0, 1.0)
        used = {name: symbol for name, symbol in inputs.items() if symbol.numel()}
        full = {name: column for name, column in columns.items() if column.numel()}
        return ca.Function(self.function.name(), [*used.values()], [*full.values()], [*used], [*full])


@dataclass(frozen=True)
class _SingleCall:
    """Memory for one robot: a row for each input, outputs as matrices, and the call of the kernel on them."""

    inputs: list[Array]
    outputs: list[Array]
    check: Array
    run: Callable[[], None]


def _unit_function(size: int, quaternions: Sequence[int], dtype: np.dtype) -> ca.Function:
    """Return the function that scales quaternions to unit length; those far from it become not a number."""
    q, rounding = SX.sym("q", size), UNIT_ROUNDING * float(np.finfo(dtype).eps)
    unit = SX(q)
    for i in quaternions:
        norm = ca.sqrt(ca.sumsqr(q[i : i + 4]))
        off = ca.fabs(norm - 1)
        unit[i : i + 4] /= ca.if_else(off <= rounding, 1, ca.if_else(off <= UNIT_TOLERANCE, norm, np.nan))
    return traced("unit", {"q": q}, {"unit_q": unit})
