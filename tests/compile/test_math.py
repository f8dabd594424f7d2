"""Vector mathematics against a more precise reference, in units in the last place."""

import casadi as ca
import numpy as np
import pytest

RANGES = {  # function, useful range, largest error allowed [ulp]
    "sin": [(-1.0, 1.0), (-10.0, 10.0), (-1e4, 1e4)],
    "cos": [(-1.0, 1.0), (-10.0, 10.0), (-1e4, 1e4)],
    "tan": [(-1.5, 1.5), (-1e3, 1e3)],
    "exp": [(-1.0, 1.0), (-80.0, 80.0)],
    "log": [(0.5, 2.0), (1e-30, 1e30), (0.999, 1.001)],
    "asin": [(-1.0, 1.0), (-1e-3, 1e-3), (0.999, 1.0)],
    "acos": [(-1.0, 1.0), (0.999, 1.0), (-1.0, -0.999)],
    "atan": [(-1.0, 1.0), (-1e4, 1e4), (0.4, 0.43)],
    "tanh": [(-1.0, 1.0), (-20.0, 20.0), (0.6, 0.65)],
    "sqrt": [(0.0, 1e6)],
}
LIMIT = {"tan": 3.0}
NUMPY_NAMES = {"asin": "arcsin", "acos": "arccos", "atan": "arctan"}


@pytest.fixture(scope="module", params=["float64", "float32"])
def dtype(request):
    if request.param == "float64" and np.finfo(np.longdouble).nmant < 60:
        pytest.skip("no reference more precise than float64 on this machine")
    return request.param


def reference(name, *x):
    """The function in higher precision of the very same arguments."""
    wide = np.longdouble if x[0].dtype == np.float64 else np.float64
    with np.errstate(all="ignore"):
        return getattr(np, NUMPY_NAMES.get(name, name))(*(a.astype(wide) for a in x))


def ulps(value, exact):
    """Error in units in the last place of the exact result."""
    return np.max(np.abs(value.astype(exact.dtype) - exact) / np.spacing(np.abs(exact).astype(value.dtype)))


def function_of(name):
    x = ca.SX.sym("x")
    return ca.Function(name, [x], [getattr(ca, name)(x)])


@pytest.mark.slow
@pytest.mark.parametrize("name", RANGES)
def test_error(name, dtype, evaluate):
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform(*bounds, 40_000) for bounds in RANGES[name]]).astype(dtype)
    (value,) = evaluate(function_of(name), x[:, None], dtype=dtype)
    exact = reference(name, x)
    error = ulps(value[:, 0], exact)
    print(f"{name} {dtype}: {error:.2f} ulp")
    assert error <= LIMIT.get(name, 2.0)


def test_sine_near_its_zeros(dtype, evaluate):
    # The floats nearest to multiples of pi/2 are where a coarse reduction loses all digits.
    x = (np.arange(-6000, 6000) * np.longdouble(np.pi) / 2).astype(dtype)
    for name in ("sin", "cos"):
        (value,) = evaluate(function_of(name), x[:, None], dtype=dtype)
        assert ulps(value[:, 0], reference(name, x)) <= 2.0


def test_atan2(dtype, evaluate):
    rng = np.random.default_rng(1)
    angle, radius = rng.uniform(-np.pi, np.pi, 50_000), 10.0 ** rng.uniform(-8, 8, 50_000)
    y, x = (radius * np.sin(angle)).astype(dtype), (radius * np.cos(angle)).astype(dtype)
    sy, sx = ca.SX.sym("y"), ca.SX.sym("x")
    (value,) = evaluate(ca.Function("atan2", [sy, sx], [ca.atan2(sy, sx)]), y[:, None], x[:, None], dtype=dtype)
    error = ulps(value[:, 0], reference("arctan2", y, x))
    print(f"atan2 {dtype}: {error:.2f} ulp")
    assert error <= 2.0


def test_atan2_on_the_axes(evaluate):
    y = np.array([0.0, -0.0, 0.0, -0.0, 1.0, -1.0, 1.0, 0.0, 0.0, 1.0, np.inf, np.nan, 1.0])
    x = np.array([0.0, 0.0, -0.0, -0.0, 0.0, 0.0, -0.0, 1.0, -1.0, np.inf, 1.0, 1.0, np.nan])
    sy, sx = ca.SX.sym("y"), ca.SX.sym("x")
    (value,) = evaluate(ca.Function("atan2", [sy, sx], [ca.atan2(sy, sx)]), y[:, None], x[:, None])
    np.testing.assert_array_equal(value[:, 0], np.arctan2(y, x))
    np.testing.assert_array_equal(np.signbit(value[:-2, 0]), np.signbit(np.arctan2(y, x)[:-2]))


SPECIAL = {
    "sin": {0.0: 0.0, np.inf: np.nan, -np.inf: np.nan},
    "cos": {0.0: 1.0, np.inf: np.nan, -np.inf: np.nan},
    "tan": {0.0: 0.0, np.inf: np.nan},
    "exp": {0.0: 1.0, np.inf: np.inf, -np.inf: 0.0, 1e4: np.inf, -1e4: 0.0},
    "log": {0.0: -np.inf, 1.0: 0.0, -1.0: np.nan, np.inf: np.inf, -np.inf: np.nan},
    "asin": {0.0: 0.0, 1.5: np.nan, -1.5: np.nan, np.inf: np.nan},
    "acos": {1.0: 0.0, 1.5: np.nan, -1.5: np.nan},
    "atan": {0.0: 0.0, np.inf: np.arctan(np.inf), -np.inf: -np.arctan(np.inf)},
    "tanh": {0.0: 0.0, np.inf: 1.0, -np.inf: -1.0, 1e3: 1.0},
    "sqrt": {0.0: 0.0, -1.0: np.nan, np.inf: np.inf},
}


@pytest.mark.parametrize("name", SPECIAL)
def test_special_values(name, dtype, evaluate):
    table = SPECIAL[name] | {np.nan: np.nan}
    x, exact = np.array(list(table)), np.array(list(table.values()), dtype)
    if 0.0 in table:  # the same at -0
        x, exact = np.append(x, -0.0), np.append(exact, exact[list(table).index(0.0)])
    (value,) = evaluate(function_of(name), x[:, None], dtype=dtype)
    np.testing.assert_array_equal(value[:, 0], exact)


def test_exp_and_log_at_the_ends_of_the_range(evaluate):
    x = np.array([709.7, -708.0, -744.0, -740.0])
    (value,) = evaluate(function_of("exp"), x[:, None])
    np.testing.assert_allclose(value[:, 0], np.exp(x), rtol=1e-15, atol=5e-324)
    x = np.array([5e-324, 1e-310, 2.3e-308, 1.7e308])
    (value,) = evaluate(function_of("log"), x[:, None])
    np.testing.assert_allclose(value[:, 0], np.log(x), rtol=3e-16)
