"""Calls of a traced function on numpy arrays with any leading batch shape."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def call_on_batch(function: ca.Function, arguments: Sequence[Array]) -> list[Array]:
    """Call a function of column vectors on arrays that share leading batch dimensions.

    Args:
        function: The function; its inputs are columns (n,).
        arguments: One array for each input, shape (..., n).

    Returns:
        One array for each output, shape (..., rows, columns).

    Raises:
        ValueError: An array has the wrong shape.
    """
    for i, a in enumerate(arguments):
        if a.ndim == 0 or a.shape[-1] != function.size1_in(i):
            expected = f"(..., {function.size1_in(i)})"
            raise ValueError(f"{function.name()}: {function.name_in(i)} has shape {a.shape}; expected {expected}")
    batch = np.broadcast_shapes(*[a.shape[:-1] for a in arguments])
    count = int(np.prod(batch))
    flat = [np.broadcast_to(a, (*batch, a.shape[-1])).reshape(count, a.shape[-1]).T for a in arguments]
    if count == 0:
        return [np.zeros((*batch, *function.size_out(i))) for i in range(function.n_out())]
    outputs = function.call([ca.DM(a) for a in flat]) if count == 1 else function.map(count).call(flat)
    results = []
    for i, output in enumerate(outputs):
        rows, columns = function.size_out(i)
        value = np.asarray(ca.DM(output).full()).reshape(rows, count, columns)
        results.append(np.moveaxis(value, 1, 0).reshape(*batch, rows, columns))
    return results
