"""Named expressions -> CasADi functions."""

from __future__ import annotations

import casadi as ca

SX = ca.SX


def traced(name: str, inputs: dict[str, SX], outputs: dict[str, SX]) -> ca.Function:
    """Make a function of named expressions, with dense outputs and common sub-expressions shared."""
    shared = ca.cse([ca.densify(expression) for expression in outputs.values()])
    names = list(inputs), list(outputs)
    return ca.Function(name, list(inputs.values()), shared, *names, {"allow_free": True})  # figures may be symbols
