"""Checks of arrays that users pass to simulators and environments; each raises a `ValueError` of one line."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.model.arguments import check_shape


def real_array(argument: str, values: Any) -> NDArray:
    """Return real numbers, such as a list or a torch tensor, as an array in the memory of the CPU.

    Raises:
        ValueError: The numbers are complex, truth values, text, dates or objects, or lists of unequal lengths.
    """
    try:
        rows = _on_host(values)
    except (ValueError, TypeError):  # lists of unequal lengths
        rows = np.empty(0, object)
    if rows.dtype.kind not in "fiu":
        raise ValueError(f"{argument} is {_kind_of(values)}; expected an array of real numbers, such as float32")
    return rows


def finite_array(argument: str, values: Any, dtype: str, *shapes: tuple[int, ...]) -> NDArray:
    """Return finite real numbers as float64 in the memory of the CPU.

    Args:
        argument: Name of the argument, for messages.
        values: Numbers of a user.
        dtype: Type in which the numbers must be finite.
        shapes: Allowed shapes.

    Raises:
        ValueError: The kind, the shape or a number is not allowed.
    """
    rows = real_array(argument, values)
    check_shape(argument, rows, *shapes)
    if not (np.abs(rows) <= np.finfo(dtype).max).all():
        raise ValueError(f"{argument} holds a number that is not finite in {dtype}")
    return np.asarray(rows, float)


def check_kind(argument: str, tensor: Any) -> None:
    """Check the kind of numbers of a tensor on a GPU, without waiting for its values.

    Raises:
        ValueError: The numbers are not real.
    """
    if tensor.is_complex() or str(tensor.dtype) == "torch.bool":
        raise ValueError(f"{argument} is {_kind_of(tensor)}; expected a tensor of real numbers, such as float32")


def check_mask(argument: str, mask: Any, num_envs: int, some: bool = False) -> Any:
    """Return a mask of robots as it is, a list of truth values as an array.

    Args:
        argument: Name of the argument, for messages.
        mask: A bool array or tensor.
        num_envs: Number of robots.
        some: Whether an entry must be true.

    Raises:
        ValueError: The mask is not of truth values, or has another shape than (num_envs,).
    """
    is_list = isinstance(mask, list) and all(isinstance(x, bool) for x in mask)
    rows: Any = np.array(mask) if is_list else mask
    kind, shape = str(getattr(rows, "dtype", "")), tuple(getattr(rows, "shape", ()))
    if kind.removeprefix("torch.") != "bool" or shape != (num_envs,) or (some and not rows.any()):
        expected = f"a bool array of shape ({num_envs},)" + (" with a true entry" if some else "")
        raise ValueError(f"{argument}={' '.join(repr(mask).split())}; expected {expected}")
    return rows


def _on_host(values: Any) -> NDArray:
    return np.asarray(values.detach().cpu() if hasattr(values, "detach") else values)


def _kind_of(values: Any) -> str:
    if hasattr(values, "dtype"):
        return f"an array of {str(values.dtype).removeprefix('torch.')}"
    return "None" if values is None else f"a {type(values).__name__}"
