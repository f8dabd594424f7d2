"""Calls of traced functions, with buffers bound to their arguments by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from ce_gym.compile import Call
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import output_names, traced

NONE: Mapping[str, str] = {}


def call(
    function: ca.Function, inputs: Mapping[str, str] = NONE, outputs: Mapping[str, str] = NONE, **options: Any
) -> Call:
    """Return the call of a traced function.

    Args:
        function: The function.
        inputs: Buffers by the names of inputs; every other input is bound to the buffer of its own name.
        outputs: Buffers by the names of outputs, as for `inputs`.
        **options: Further attributes of the call.
    """
    read = tuple(inputs.get(name, name) for name in function.name_in())
    written = tuple(outputs.get(name, name) for name in output_names(function))
    return Call(function, read, written, **options)


def assign(values: Mapping[str, ca.DM], **options: Any) -> Call:
    """Return the call that writes constants to buffers, by name."""
    return call(traced("assign", {}, {name: SX(value) for name, value in values.items()}), **options)
