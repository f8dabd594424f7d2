"""Every operation, and graphs of operations, against CasADi's own evaluation."""

import casadi as ca
import numpy as np
import pytest

from ce_gym.compile import Buffer, Call, Program, aligned_zeros, lane_count, load_kernel

TOLERANCE = {"float64": 4e-15, "float32": 2e-6}
X, Y = ca.SX.sym("x"), ca.SX.sym("y")
OPERATIONS = {
    "add": X + Y,
    "sub": X - Y,
    "mul": X * Y,
    "div": X / Y,
    "neg": -X,
    "sq": X**2,
    "twice": 2 * X,
    "inv": 1 / X,
    "sqrt": ca.sqrt(ca.fabs(X)),
    "sin": ca.sin(X),
    "cos": ca.cos(X),
    "sin_and_cos": ca.sin(X) * ca.cos(X) + ca.sin(Y),
    "tan": ca.tan(X),
    "asin": ca.asin(X / 4),
    "acos": ca.acos(X / 4),
    "atan": ca.atan(X),
    "atan2": ca.atan2(X, Y),
    "exp": ca.exp(X),
    "log": ca.log(ca.fabs(X)),
    "tanh": ca.tanh(X),
    "cube": X**3,
    "inverse_fifth": X**-5,
    "root": ca.fabs(X) ** 0.5,
    "power": ca.fabs(X) ** 1.7,
    "power_of_two": ca.fabs(X) ** Y,
    "hypot": ca.hypot(X, Y),
    "fabs": ca.fabs(X),
    "sign": ca.sign(X),
    "fmin": ca.fmin(X, Y),
    "fmax": ca.fmax(X, 0.25),
    "floor": ca.floor(X),
    "ceil": ca.ceil(X),
    "copysign": ca.copysign(X, Y),
    "fmod": ca.fmod(X, Y),
    "remainder": ca.remainder(X, Y),
    "lt": X < Y,
    "le": X <= Y,
    "eq": ca.eq(ca.floor(X), ca.floor(Y)),
    "ne": ca.ne(ca.floor(X), ca.floor(Y)),
    "not": ca.logic_not(ca.floor(X)),
    "and": ca.logic_and(X > 0, Y > 0),
    "or": ca.logic_or(X > 0, ca.floor(Y)),
    "if_else": ca.if_else(X > Y, ca.sin(X), ca.exp(Y)),
    "if_else_zero": ca.if_else(ca.floor(X), Y, 0),
    "constant": 0 * X + 0.1,
}


def samples(n, size, dtype, seed=0):
    values = np.random.default_rng(seed).uniform(-3.5, 3.5, (n, size))
    values[:4, 0] = [0.0, 1.0, -1.0, 2.0]  # comparisons must meet their border cases
    values[:4, -1] = [1.0, 1.0, -1.0, -2.0]
    return values.astype(dtype)


def by_casadi(function, *inputs):
    """The function row by row, in float64."""
    results = [function.call([ca.DM(x) for x in row]) for row in zip(*inputs, strict=True)]
    return [np.array([np.array(r[i]).ravel(order="F") for r in results]) for i in range(function.n_out())]


def assert_close(value, exact, dtype):
    np.testing.assert_allclose(value, exact, rtol=TOLERANCE[dtype], atol=TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_every_operation(dtype, evaluate):
    function = ca.Function("operations", [X, Y], list(OPERATIONS.values()))
    x, y = samples(67, 1, dtype), samples(67, 1, dtype, seed=1)
    values = evaluate(function, x, y, dtype=dtype)
    for name, value, exact in zip(OPERATIONS, values, by_casadi(function, x, y), strict=True):
        np.testing.assert_allclose(
            value, exact, rtol=10 * TOLERANCE[dtype], atol=TOLERANCE[dtype], err_msg=f"{name} in {dtype}"
        )


def random_graph(seed, n_operations=250):
    """Outputs of a random graph in which every value stays of order one."""
    rng = np.random.default_rng(seed)
    x = ca.SX.sym("x", 6)
    nodes = [x[i] for i in range(6)]
    choices = [
        lambda a, b: (a + b) / 2,
        lambda a, b: a - 0.5 * b,
        lambda a, b: a * b / (1 + a * a),
        lambda a, b: ca.sin(a + b),
        lambda a, b: ca.cos(a) * b,
        lambda a, b: ca.sqrt(1 + a * a) - ca.fabs(b),
        lambda a, b: ca.atan2(a, 2 + b * b),
        lambda a, b: ca.exp(-a * a) + ca.tanh(b),
        lambda a, b: ca.log(1 + a * a) / (1 + b * b),
        lambda a, b: ca.fmin(a, b) + ca.fmax(a, 0.3 * b) / 2,
    ]
    for _ in range(n_operations):
        i, j = rng.integers(max(0, len(nodes) - 30), len(nodes), 2)
        nodes.append(choices[rng.integers(len(choices))](nodes[i], nodes[j]) + 0.0)
    return ca.Function(f"graph_{seed}", [x], [ca.vertcat(*nodes[-12:])])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_random_graphs(seed, evaluate):
    function = random_graph(seed)
    x = samples(29, 6, "float64", seed)
    (value,) = evaluate(function, x)
    (exact,) = by_casadi(function, x)
    np.testing.assert_allclose(value, exact, rtol=1e-10, atol=1e-12)


def test_the_branch_not_taken_does_no_harm(evaluate):
    function = ca.Function("guard", [X], [ca.if_else(X > 0, ca.log(X), -1), ca.if_else(X == 0, 5, 1 / X)])
    x = np.array([[-1.0], [0.0], [2.0], [np.nan]])
    logarithm, inverse = evaluate(function, x)
    np.testing.assert_array_equal(logarithm[:, 0], [-1, -1, np.log(2.0), -1])
    np.testing.assert_array_equal(inverse[:, 0], [-1, 5, 0.5, np.nan])


def test_nan_fails_every_bound(evaluate):
    outputs = [X < 1e6, ca.fabs(X) <= 1e6, ca.eq(X, Y), ca.ne(X, Y), ca.logic_not(X < 1e6)]
    x = np.array([[np.nan], [np.inf], [1.0]])
    values = np.hstack(evaluate(ca.Function("bound", [X, Y], outputs), x, x))
    np.testing.assert_array_equal(values, [[0, 0, 0, 1, 1], [0, 0, 1, 0, 1], [1, 1, 1, 0, 0]])


def test_arithmetic_is_not_assumed_finite(evaluate):
    """With the fast-math flags nnan or ninf the optimiser would make all of these true."""
    product = (X * Y) * Y
    outputs = [ca.eq(product, Y * (Y * X)), ca.fabs(product) < ca.inf, ca.fabs(product) <= ca.inf]
    function = ca.Function("finite", [X, Y], outputs)
    assert function.n_instructions() > 10, "CasADi folded what the compiler should have to decide"
    x = np.array([[np.nan], [1e300], [2.0]])
    np.testing.assert_array_equal(np.hstack(evaluate(function, x, x)), [[0, 0, 0], [1, 0, 1], [1, 1, 1]])


def test_minimum_ignores_nan_as_casadi_does(evaluate):
    function = ca.Function("minmax", [X, Y], [ca.fmin(X, Y), ca.fmax(X, Y), ca.fmin(X, 2.0), ca.fmax(2.0, X)])
    x, y = np.array([[np.nan], [1.0], [np.nan]]), np.array([[1.0], [np.nan], [np.nan]])
    values = np.hstack(evaluate(function, x, y))
    np.testing.assert_array_equal(values, np.hstack(by_casadi(function, x, y)))


@pytest.mark.slow
def test_a_nan_stays_in_its_lane(evaluate):
    function = random_graph(3)
    x = samples(16, 6, "float64")
    (clean,) = evaluate(function, x)
    x[5] = np.nan
    (dirty,) = evaluate(function, x)
    assert np.isnan(dirty[5]).any()
    others = np.arange(16) != 5
    np.testing.assert_array_equal(dirty[others], clean[others])


def test_sparse_inputs_and_outputs(evaluate):
    x = ca.SX.sym("x", ca.Sparsity.lower(3))
    function = ca.Function("sparse", [x], [x.T, ca.SX(2, 2), x @ x])
    rows = samples(5, 9, "float64")
    transposed, zero, square = evaluate(function, rows)
    for row, t, z, s in zip(rows, transposed, zero, square, strict=True):
        lower = np.tril(row.reshape(3, 3, order="F"))
        np.testing.assert_array_equal(t.reshape(3, 3, order="F"), lower.T)
        np.testing.assert_array_equal(z, 0)
        np.testing.assert_allclose(s.reshape(3, 3, order="F"), lower @ lower, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_outputs_may_overwrite_inputs(dtype):
    a, b = ca.SX.sym("a", 4), ca.SX.sym("b", 4)
    swap = ca.Function("swap", [a, b], [b[[3, 2, 1, 0]], a + b])
    buffers = (Buffer("a", 4, "tiles"), Buffer("b", 4, "tiles"))
    program = Program("swap", buffers, (Call(swap, ("a", "b"), ("a", "b")),))
    kernel = load_kernel(f"swap {dtype}", lambda: program, dtype)
    lanes = lane_count(dtype)
    a, b = aligned_zeros((2, 4, lanes), dtype), aligned_zeros((2, 4, lanes), dtype)
    a[:] = np.arange(a.size).reshape(a.shape)
    b[:] = 1000 + a
    expected = b[:, ::-1].copy(), a + b
    kernel({"a": a, "b": b}, 2 * lanes)
    np.testing.assert_array_equal(a, expected[0])
    np.testing.assert_array_equal(b, expected[1])


def test_unknown_operation_is_named(evaluate):
    with pytest.raises(NotImplementedError, match="'bad': OP_ERF has no vector form; expected one of OP_ACOS, "):
        evaluate(ca.Function("bad", [X], [ca.erf(X)]), np.ones((1, 1)))
