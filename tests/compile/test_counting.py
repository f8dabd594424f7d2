"""Floating-point operations of a function, by hand."""

import casadi as ca
import pytest

from ce_gym.compile.lowering.counting import floating_point_operations

X, Y = ca.SX.sym("x"), ca.SX.sym("y")


@pytest.mark.parametrize(
    ("expression", "expected"),
    [(X * Y + 2, 2), (X / Y - ca.sqrt(X), 3), (ca.fmax(X, -Y), 0), (X**2 + X**2, 2), (ca.fabs(X) * Y, 1)],
)
def test_floating_point_operations_are_counted(expression, expected):
    function = ca.Function("f", [X, Y], [expression])
    assert floating_point_operations(function) == expected
    assert floating_point_operations(function, "float32") == expected


def test_polynomials_count_and_are_shorter_in_single_precision():
    turn = ca.Function("turn", [X], [ca.sin(X), ca.cos(X)])
    # reduction: 4 multiply-adds, 1 difference; 2 products; polynomials of 6 (3) coefficients and 3 multiply-adds
    assert floating_point_operations(turn) == 2 * 4 + 1 + 2 + 2 * (5 + 5 + 3)
    assert floating_point_operations(turn, "float32") == 2 * 4 + 1 + 2 + 2 * (2 + 2 + 3)
