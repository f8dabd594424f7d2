"""Derivatives by complex steps: an SX function evaluated on complex numbers, instruction by instruction.

An imaginary part of 1e-30 comes out multiplied by the derivative, without any difference being taken. Comparisons use
real parts.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

STEP = 1e-30


def _atan2(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    slope = (x.real * y.imag - y.real * x.imag) / (x.real**2 + y.real**2)
    return np.arctan2(y.real, x.real) + 1j * slope


BINARY = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_ATAN2: _atan2,
    ca.OP_FMIN: lambda a, b: np.where(a.real < b.real, a, b),
    ca.OP_FMAX: lambda a, b: np.where(a.real > b.real, a, b),
    ca.OP_LT: lambda a, b: (a.real < b.real) + 0j,
    ca.OP_LE: lambda a, b: (a.real <= b.real) + 0j,
    ca.OP_EQ: lambda a, b: (a.real == b.real) + 0j,
    ca.OP_NE: lambda a, b: (a.real != b.real) + 0j,
    ca.OP_AND: lambda a, b: ((a.real != 0) & (b.real != 0)) + 0j,
    ca.OP_OR: lambda a, b: ((a.real != 0) | (b.real != 0)) + 0j,
    ca.OP_IF_ELSE_ZERO: lambda a, b: np.where(a.real != 0, b, 0),
    ca.OP_POW: np.power,
    ca.OP_CONSTPOW: np.power,
    ca.OP_COPYSIGN: lambda a, b: np.where((a.real < 0) == np.signbit(b.real), a, -a),
}
UNARY = {
    ca.OP_ASSIGN: lambda a: a,
    ca.OP_NEG: np.negative,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_SQRT: np.sqrt,
    ca.OP_SQ: np.square,
    ca.OP_EXP: np.exp,
    ca.OP_TANH: np.tanh,
    ca.OP_INV: lambda a: 1 / a,
    ca.OP_TWICE: lambda a: 2 * a,
    ca.OP_NOT: lambda a: (a.real == 0) + 0j,
    ca.OP_SIGN: lambda a: np.sign(a.real) + 0j,
    ca.OP_FABS: lambda a: np.where(a.real < 0, -a, a),
}


def evaluate(function: ca.Function, arguments: list[np.ndarray]) -> list[np.ndarray]:
    """Evaluate a function of columns on complex numbers, shape (n, batch) each."""
    work: dict[int, np.ndarray] = {}
    batch = max(a.shape[1] for a in arguments)
    outputs = [np.zeros((function.nnz_out(i), batch), complex) for i in range(function.n_out())]
    for k in range(function.n_instructions()):
        op, into, of = function.instruction_id(k), function.instruction_output(k), function.instruction_input(k)
        if op == ca.OP_CONST:
            work[into[0]] = np.full(batch, function.instruction_constant(k), complex)
        elif op == ca.OP_INPUT:
            work[into[0]] = np.broadcast_to(arguments[of[0]][of[1]], (batch,)).astype(complex)
        elif op == ca.OP_OUTPUT:
            outputs[into[0]][into[1]] = work[of[0]]
        elif op in BINARY:
            work[into[0]] = BINARY[op](work[of[0]], work[of[1]])
        else:
            work[into[0]] = UNARY[op](work[of[0]])
    return outputs


def jacobian(
    function: ca.Function, arguments: list[np.ndarray], which: int, directions: np.ndarray
) -> list[np.ndarray]:
    """Return how all outputs change as input `which` moves along directions (n, m), shape (n_output, m) each."""
    columns = [np.asarray(a, complex)[:, None] for a in arguments]
    columns[which] = columns[which] + 1j * STEP * directions
    return [output.imag / STEP for output in evaluate(function, columns)]


def tangents(q: np.ndarray, floating: bool) -> np.ndarray:
    """Return how positions change with a rotation and a translation of the base in its axes, and with the joints.

    Written from the definition of the quaternion's rate, `quat * (0, w) / 2`, in numbers.
    """
    if not floating:
        return np.eye(len(q))
    w, x, y, z = q[3:7]
    basis = np.zeros((len(q), len(q) - 1))
    basis[3:7, :3] = np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]) / 2
    u = np.array([x, y, z])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    basis[:3, 3:6] = (w * w - u @ u) * np.eye(3) + 2 * np.outer(u, u) + 2 * w * cross
    basis[7:, 6:] = np.eye(len(q) - 7)
    return basis
