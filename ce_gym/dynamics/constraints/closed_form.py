"""Solutions of constraints by formulas, for expressions of a known shape.

| shape                                     | example                         | solution                              |
|-------------------------------------------|---------------------------------|---------------------------------------|
| one row, affine in its one unknown        | `gamma(y)` of a user            | division                              |
| one row, `A z^2 + B z + C`                | a rod that ends on a slider     | one root, on the reference branch     |
| one row, `P sin wz + Q cos wz + R`        | a rod that ends on a crank      | one `atan2`, on the reference branch  |
| two rows, two revolute unknowns, in plane | a pin that closes a four-bar    | the same, then a second `atan2`       |

Random numbers test whether a row has a shape; the coefficients are derivatives at zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX

_POINTS = 12
_SAME = 1e-8
_FAR = 1.0
"""Angles with a reference farther from zero [rad] are measured from the reference, because `atan2` jumps at pi."""


@dataclass(frozen=True)
class Sample:
    """All symbols of a cluster, and random numbers for them near its reference pose.

    Attributes:
        symbols: `[y; z]`, shape (d + m,).
        reference: Values of the symbols at the reference pose, shape (d + m,).
    """

    symbols: SX
    reference: np.ndarray

    def at_random(self, *expressions: SX) -> np.ndarray:
        """Evaluate scalar expressions at random points, shape (expressions, points)."""
        rng = np.random.default_rng(1)
        points = self.reference[:, None] + rng.uniform(-0.7, 0.7, (len(self.reference), _POINTS))
        function = ca.Function("f", [self.symbols], [ca.densify(ca.vertcat(*expressions))])
        return np.array(function.map(_POINTS)(points).full())

    def at_reference(self, expression: SX) -> float:
        """Evaluate a scalar expression at the reference pose."""
        return float(ca.Function("f", [self.symbols], [expression])(self.reference))

    def value_of(self, symbol: SX) -> float:
        """Return the value of one symbol at the reference pose."""
        return self.at_reference(symbol)


def solve_single(row: SX, z: SX, sample: Sample) -> SX | None:
    """Return `z` that makes a row vanish, as an expression of the other symbols; None if there is no formula."""
    first, second, third = _derivatives(row, z, 3)
    d1, d2, d3 = sample.at_random(first, second, third)
    if np.abs(d2).max() <= _SAME * np.abs(d1).max():
        return -ca.substitute(row, z, SX(0)) / ca.substitute(first, z, SX(0))
    if np.abs(d3).max() <= _SAME * np.abs(d2).max():
        return _solve_quadratic(row, z, sample)
    return _solve_sine(row, z, sample)


def solve_pair(rows: tuple[SX, SX], unknowns: tuple[SX, SX], sample: Sample) -> tuple[SX, SX] | None:
    """Return both unknowns of a planar loop, as expressions of the other symbols; None if there is no formula.

    With `rows = e + C cos z2 + S sin z2`, `C` and `S` of equal length and at right angles, `z2` only rotates a vector:
    `e.e = C.C` does not contain `z2`, and is a row for `z1` alone.
    """
    pair = ca.vertcat(*rows)
    for z1, z2 in permutations(unknowns):
        S, C, e = _turned_vector(pair, z2)
        third = [_derivatives(row, z2, 3)[2] + _derivatives(row, z2, 1)[0] for row in rows]
        errors = sample.at_random(*third, ca.dot(C, S), ca.sumsqr(C) - ca.sumsqr(S))
        size = sample.at_random(ca.sumsqr(C)).max()
        if size == 0.0 or np.abs(errors).max() > _SAME * max(size, math.sqrt(size)):
            continue
        solution = solve_single(ca.sumsqr(e) - ca.sumsqr(C), z1, sample)
        if solution is not None:
            second = _near(-ca.dot(S, e), -ca.dot(C, e), sample.value_of(z2))
            return tuple(  # type: ignore[return-value]
                solution if z is z1 else ca.substitute(second, z1, solution) for z in unknowns
            )
    return None


def _derivatives(row: SX, z: SX, count: int) -> list[SX]:
    derivatives = []
    for _ in range(count):
        row = ca.jacobian(row, z)
        derivatives.append(row)
    return derivatives


def _turned_vector(pair: SX, z: SX) -> tuple[SX, SX, SX]:
    """Return `S`, `C` and `e` of `pair = e + C cos z + S sin z`."""
    zero = SX(0)
    first = ca.jacobian(pair, z)
    second = ca.jacobian(first, z)
    S, C = ca.substitute(first, z, zero), -ca.substitute(second, z, zero)
    return S, C, ca.substitute(pair, z, zero) - C


def _frequency(d1: np.ndarray, d3: np.ndarray) -> float | None:
    """Return `w` if `d3 = -w^2 d1` everywhere, rounded if it is nearly the inverse of a round number."""
    if not d3.any():
        return None
    squared = -float(d1 @ d3) / float(d1 @ d1)
    if squared <= 0.0 or np.abs(d3 + squared * d1).max() > _SAME * np.abs(d3).max():
        return None
    frequency = math.sqrt(squared)
    rounded = 1.0 / round(1.0 / frequency, 6)
    return rounded if abs(rounded - frequency) < _SAME * frequency else frequency


def sine_coefficients(row: SX, z: SX, sample: Sample) -> tuple[SX, SX, SX, float] | None:
    """Return `P`, `Q`, `R`, `w` of a row `P sin wz + Q cos wz + R`; None if the row has another shape."""
    first, second, third = _derivatives(row, z, 3)
    w = _frequency(*sample.at_random(first, third))
    if w is None:
        return None
    P, Q = (ca.substitute(x, z, SX(0)) for x in (first / w, -second / w**2))
    return P, Q, ca.substitute(row, z, SX(0)) - Q, w


def _solve_quadratic(row: SX, z: SX, sample: Sample) -> SX:
    """Solve `A z^2 + B z + C = 0` on the side of the reference pose.

    The derivative of the row at the two solutions is `+-sqrt(B^2 - 4 A C)`, so its sign distinguishes them. The square
    root is zero at a singularity and not a number beyond.
    """
    first, second = _derivatives(row, z, 2)
    A, B, C = (ca.substitute(x, z, SX(0)) for x in (second / 2, first, row))
    side = math.copysign(1.0, sample.at_reference(first))
    return (side * ca.sqrt(B * B - 4 * A * C) - B) / (2 * A)


def _solve_sine(row: SX, z: SX, sample: Sample) -> SX | None:
    """Solve `P sin wz + Q cos wz + R = 0` on the side of the reference pose.

    With `d = sqrt(P^2 + Q^2 - R^2)` the two solutions are `wz = atan2(-R P -+ d Q, -R Q +- d P)`. The derivative of the
    row is `+-w d` there, so its sign distinguishes them. `d` is zero at a singularity and not a number beyond.
    """
    coefficients = sine_coefficients(row, z, sample)
    if coefficients is None:
        return None
    P, Q, R, w = coefficients
    side = math.copysign(1.0, sample.at_reference(ca.jacobian(row, z)))
    d = side * ca.sqrt(P * P + Q * Q - R * R)
    return _near(-R * P - d * Q, -R * Q + d * P, w * sample.value_of(z)) / w


def sine_derivatives(coefficients: tuple[SX, SX, SX, float], z: SX, zd: SX, others: SX, rates: SX) -> tuple[SX, SX, SX]:
    """Differentiate a row `P sin wz + Q cos wz + R` where it is zero, so that `P sin wz + Q cos wz = -R`.

    Returns:
        Slope against `others` (1, n), slope against `z`, and second derivative along `rates` (n,) and `zd`.
    """
    P, Q, R, w = coefficients
    s, c = ca.sin(w * z), ca.cos(w * z)
    Pd, Qd, Rd = (ca.jtimes(x, others, rates) for x in (P, Q, R))
    Pdd, Qdd, Rdd = (ca.jtimes(x, others, rates) for x in (Pd, Qd, Rd))
    slope = ca.jacobian(P, others) * s + ca.jacobian(Q, others) * c + ca.jacobian(R, others)
    bias = Pdd * s + Qdd * c + Rdd + 2 * w * zd * (Pd * c - Qd * s) + (w * zd) ** 2 * R
    return slope, w * (P * c - Q * s), bias


def _near(S: SX, C: SX, reference: float) -> SX:
    """Return the angle of (C, S) within half a turn of a reference; `atan2` alone jumps half a turn from zero."""
    if abs(reference) < _FAR:
        return ca.atan2(S, C)
    s, c = math.sin(reference), math.cos(reference)
    return reference + ca.atan2(c * S - s * C, c * C + s * S)


def solve_block(A: SX, b: SX) -> tuple[SX, SX]:
    """Solve a small `A x = b` by formulas without pivots.

    A pivot chosen at the reference pose can become zero at another pose. Therefore: Cramer's rule up to 2 x 2,
    orthogonal rows (modified Gram-Schmidt) beyond.

    Args:
        A: Shape (m, m).
        b: Right-hand sides, shape (m, k).

    Returns:
        `x`, shape (m, k), and the determinant of `A` (of 3 x 3 and larger matrices its absolute value).
    """
    m = A.shape[0]
    if m == 1:
        return b / A, A
    if m == 2:
        determinant = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
        top = A[1, 1] * b[0, :] - A[0, 1] * b[1, :]
        return ca.vertcat(top, A[0, 0] * b[1, :] - A[1, 0] * b[0, :]) / determinant, determinant
    return _orthogonal_solve([A[i, :] for i in range(m)], [b[i, :] for i in range(m)])


def _orthogonal_solve(rows: Sequence[SX], right: Sequence[SX]) -> tuple[SX, SX]:
    """Make rows orthonormal, with the same operations on the right-hand sides; then `x = sum(row^T right)`."""
    rows, right, determinant = list(rows), list(right), SX(1)
    for i in range(len(rows)):
        length = ca.sqrt(ca.sumsqr(rows[i]))
        determinant *= length
        rows[i], right[i] = rows[i] / length, right[i] / length
        for j in range(i + 1, len(rows)):
            overlap = ca.dot(rows[i], rows[j])
            rows[j], right[j] = rows[j] - overlap * rows[i], right[j] - overlap * right[i]
    return sum((row.T @ b for row, b in zip(rows, right, strict=True)), SX(0)), determinant
