"""Quantities of `Model` as `@njit` functions of rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numba.extending import overload

from ce_gym.dynamics.model import Model
from ce_gym.numba.kernel_call import kernel_call, scratch_size

SCALARS = ("kinetic", "potential", "gap", "nearness")
"""Outputs with one number."""
POINTS = ("positions", "velocities", "angular", "linear", "accelerations")
"""Outputs with a column for each body or contact; results have a row for each."""
ROTATIONS = "rotations"
"""Output with three columns for each body; results have a matrix for each."""


def quantity(model: Model, name: str) -> Callable[..., Any]:
    """Return a quantity of a robot as an `@njit` function.

    The function takes C-contiguous or other arrays of one robot, shape (n,), or of many, shape (..., n), with the same
    number of rows each. It returns the same arrays as the method of `Model` with the same name. All results of a robot
    are nan if `q` or a result is not finite, or if the method raises a ValueError because of a quaternion or a loop.
    Several threads may call the function.

    Args:
        model: The robot at a transmission level. Results have its `dtype`; `num_threads` is ignored.
        name: Name of the quantity, see `Model.casadi_function`.

    Raises:
        KeyError: If there is no such quantity.
    """
    batched = model._batched_function(name)
    kernel, sizes = batched.kernel, batched.inputs
    label, first = batched.function.name(), next(x for x, size in sizes.items() if size)
    shapes = ", ".join(f"{x} (..., {size})" for x, size in sizes.items())
    wrong = [f"{x}.shape[-1] != {size} or {x}.size != n * {size}" for x, size in sizes.items()]
    used = ", ".join(buffer.name for buffer in kernel.arguments)
    fill = ["for i in range(n):", "    if check[i] != 0.0:", *[f"        {x}[i] = np.nan" for x in batched.outputs]]
    lines = [
        f"def {label}({', '.join(sizes)}):",
        f"n = {first}.size // {sizes[first]}",
        f"if {' or '.join(wrong)}:",
        f"    raise ValueError('{label}: expected {shapes}, as many rows of each')",
        *[f"{x} = as_rows({x}, dtype)" for x in sizes],
        *[f"{x} = np.empty((n, {rows}, {columns}), dtype)" for x, (rows, columns) in batched.outputs.items()],
        "check = np.empty(n, dtype)",
        f"call(({used},), np.empty({scratch_size(kernel)}, np.int64), 0, 0, -(-n // {kernel.lanes}), n)",
        *(fill if batched.nan_rows else []),
        f"shape = {first}.shape[:-1]",
        f"return {', '.join(_result(label, x, *size) for x, size in batched.outputs.items())}",
    ]
    names = {"np": np, "dtype": np.dtype(kernel.dtype), "as_rows": as_rows, "call": kernel_call(kernel)}
    names["__name__"] = __name__  # numba caches callers of functions of a module
    exec("\n    ".join(lines), names)
    function = names[label]
    function.__doc__ = f"Return {label} of {model!r}: {shapes} -> {', '.join(batched.outputs)}."
    return njit(nogil=True)(function)


def _result(function: str, name: str, rows: int, columns: int) -> str:
    """Return the code that gives an output, shape (n, rows, columns), the shape of the method of `Model`."""
    if name in SCALARS:
        return f"{name}.reshape(shape)"
    if name in POINTS:
        return f"np.ascontiguousarray({name}.transpose((0, 2, 1))).reshape(shape + ({columns}, {rows}))"
    if name == ROTATIONS:
        by_body = f"{name}.reshape((n, 3, {columns // 3}, 3)).transpose((0, 2, 1, 3))"
        return f"np.ascontiguousarray({by_body}).reshape(shape + ({columns // 3}, 3, 3))"
    if function == "contact_jacobian":
        return f"{name}.reshape(shape + ({rows // 3}, 3, {columns}))"
    is_column = columns == 1 and name.islower()  # matrices have upper-case symbols
    return f"{name}.reshape(shape + ({rows},{'' if is_column else f' {columns}'}))"


def as_rows(array, dtype):
    """Return an array in C order with a dtype, without a copy if it is one."""
    return np.ascontiguousarray(array, dtype)


@overload(as_rows)
def _as_rows(array, dtype):
    if array.layout == "C" and array.dtype == dtype.dtype:
        return lambda array, dtype: array
    return lambda array, dtype: np.ascontiguousarray(array).astype(dtype)


def forward_dynamics(model: Model) -> Callable[..., Any]:
    """Return `Model.forward_dynamics` as an `@njit` function (q, v, tau) -> vdot, see `quantity`."""
    return quantity(model, "forward_dynamics")


def inverse_dynamics(model: Model) -> Callable[..., Any]:
    """Return `Model.inverse_dynamics` as an `@njit` function (q, v, vdot) -> tau, see `quantity`."""
    return quantity(model, "inverse_dynamics")


def mass_matrix(model: Model) -> Callable[..., Any]:
    """Return `Model.mass_matrix` as an `@njit` function q -> M, see `quantity`."""
    return quantity(model, "mass_matrix")


def bias_force(model: Model) -> Callable[..., Any]:
    """Return `Model.bias_force` as an `@njit` function (q, v) -> tau, see `quantity`."""
    return quantity(model, "bias_force")


def body_poses(model: Model) -> Callable[..., Any]:
    """Return `Model.body_poses` as an `@njit` function q -> (positions, rotations), see `quantity`."""
    return quantity(model, "body_poses")


def contact_points(model: Model) -> Callable[..., Any]:
    """Return `Model.contact_points` as an `@njit` function (q, v) -> (positions, velocities), see `quantity`."""
    return quantity(model, "contact_points")
