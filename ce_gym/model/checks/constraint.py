"""Checks of one constraint against the bodies it names; each raises a `RobotError` of one line.

Whether all constraints of a robot can hold together is checked when the dynamics solves them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ce_gym.model.checks.body import check_axis, check_finite
from ce_gym.model.constraints import (
    Constraint,
    FunctionConstraint,
    LinearConstraint,
    LoopConstraint,
    PolynomialConstraint,
    RodConstraint,
    constraint_function,
)
from ce_gym.model.description import Body, Robot
from ce_gym.model.errors import RobotError, invalid_value, unknown_name
from ce_gym.model.ranges import LARGEST_FIGURE


def check_constraint(constraint: Constraint, robot: Robot, file: str) -> None:
    """Check the names and numbers of one constraint."""
    key = f"constraint {constraint.name!r}"
    names = {body.name: body for body in robot.bodies}
    for body in constraint.bodies:
        if body not in names:
            raise unknown_name(file, key, body, names, "the name of a body")
    if constraint.ends and len(set(constraint.ends)) < len(constraint.ends):
        raise invalid_value(file, key, constraint.ends, "two different bodies")
    if not constraint.ends:
        _check_joints(constraint, names, key, file)
    CHECKS[type(constraint)](constraint, key, file)


def _check_joints(constraint: Constraint, names: Mapping[str, Body], key: str, file: str) -> None:
    """Check the bodies of a constraint between joint coordinates."""
    for body in constraint.bodies:
        if names[body].joint.nv > 1:
            raise invalid_value(file, key, body, "a body whose joint has one degree of freedom")
    if len(set(constraint.bodies)) < 2 or len(set(constraint.bodies)) < len(constraint.bodies):
        raise invalid_value(file, key, constraint.bodies, "at least two different bodies, each once")


def _check_linear(constraint: LinearConstraint, key: str, file: str) -> None:
    for body, coefficient in constraint.coefficients:
        if not 0.0 < abs(coefficient) <= LARGEST_FIGURE:
            expected = f"a finite number other than 0, up to {LARGEST_FIGURE:g} in size"
            raise invalid_value(file, f"{key} coefficient of {body!r}", coefficient, expected)


def _check_polynomial(constraint: PolynomialConstraint, key: str, file: str) -> None:
    check_finite(file, f"{key} coefficients", constraint.coefficients)
    if not any(constraint.coefficients[1:]):
        expected = "one of a power of at least 1 that is not 0"
        raise invalid_value(file, f"{key} coefficients", constraint.coefficients, expected)


def _check_loop(constraint: LoopConstraint, key: str, file: str) -> None:
    if constraint.joint not in ("revolute", "ball"):
        raise invalid_value(file, f"{key} joint", constraint.joint, "revolute or ball")
    check_axis(file, f"{key} axis", constraint.axis)
    for placement in (constraint.first_placement, constraint.second_placement):
        check_finite(file, f"{key} placement", (*placement.position, *[x for row in placement.rotation for x in row]))


def _check_rod(constraint: RodConstraint, key: str, file: str) -> None:
    check_finite(file, f"{key} points", (*constraint.first_point, *constraint.second_point))


def _check_function(constraint: FunctionConstraint, key: str, file: str) -> None:
    if not constraint.arguments:
        raise invalid_value(file, f"{key} arguments", constraint.arguments, "at least one body")
    try:
        constraint_function(constraint.function)
    except RobotError as error:
        raise RobotError(f"{file}: {key}: {error}") from None


CHECKS: dict[type[Constraint], Callable[[Any, str, str], None]] = {
    LinearConstraint: _check_linear,
    PolynomialConstraint: _check_polynomial,
    LoopConstraint: _check_loop,
    RodConstraint: _check_rod,
    FunctionConstraint: _check_function,
}
"""Functions (constraint, key, file) that check a kind of constraint."""
