"""Named expressions -> CasADi functions."""

from __future__ import annotations

import casadi as ca

SX = ca.SX
NEXT = "_next"
"""Ends the name of an output that is also the name of an input: CasADi needs different names."""


def traced(name: str, inputs: dict[str, SX], outputs: dict[str, SX]) -> ca.Function:
    """Make a function of named expressions, with dense outputs and common sub-expressions shared."""
    shared = ca.cse([ca.densify(expression) for expression in outputs.values()])
    names = list(inputs), [output + NEXT if output in inputs else output for output in outputs]
    return ca.Function(name, list(inputs.values()), shared, *names, {"allow_free": True})  # figures may be symbols


def output_names(function: ca.Function) -> tuple[str, ...]:
    """Return the names of the outputs of a traced function, without `NEXT`."""
    return tuple(name.removesuffix(NEXT) for name in function.name_out())
