"""A user's controller as a C function that the kernel of a simulator calls."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import cfunc, njit, types
from numba.core.dispatcher import Dispatcher
from numba.np.numpy_support import carray

from ce_gym.compile import lane_count
from ce_gym.model.arguments import check_choice


class Controller:
    """A compiled controller; made by `controller`.

    Attributes:
        dtype: "float64" or "float32" of the arrays that the controller takes.
        address: Address of the C function.
    """

    def __init__(self, function: Callable[..., None], dtype: str) -> None:
        check_choice("dtype", dtype, ("float64", "float32"))
        control = function if isinstance(function, Dispatcher) else njit(function)
        lanes, number, pointer = lane_count(dtype), types.int64, types.CPointer(getattr(types, dtype))

        @cfunc(types.void(number, number, pointer, number, pointer, number, pointer, number))
        def run(first, count, q, nq, v, nv, target, n_targets):
            q_lanes, v_lanes = carray(q, (nq, lanes)), carray(v, (nv, lanes))
            targets = carray(target, (n_targets, lanes))
            for lane in range(count):
                control(first + lane, q_lanes[:, lane], v_lanes[:, lane], targets[:, lane])

        self.dtype, self.address = dtype, run.address
        self._function, self._kept = function, run

    def __reduce__(self) -> tuple[Any, ...]:
        return Controller, (self._function, self.dtype)


def controller(function: Callable[..., None], dtype: str = "float64") -> Controller:
    """Return a function as a controller for `ce_gym.Simulator(controller=...)`.

    Args:
        function: `@njit` function (k, q, v, target) that is called before each sub-step of robot k with its positions,
            shape (nq,), velocities, shape (nv,), and targets of `Simulator.step`, shape (n_targets,). It writes the
            targets of the sub-step into `target`. The arrays are views with strides. Threads call the function for
            different robots at the same time. Exceptions are printed, not raised.
        dtype: "float64" or "float32", as the simulator has.
    """
    return Controller(function, dtype)
