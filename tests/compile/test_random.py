"""The counter-based streams: the same everywhere, uniform, and independent of each other."""

import casadi as ca
import numpy as np
import pytest

from ce_gym.compile import Buffer, Call, Program, load_kernel
from ce_gym.compile.lowering.random import uniform

SIZE = 12


def program():
    a, b = ca.SX.sym("a", SIZE - 2), ca.SX.sym("b", 2)
    copy = ca.Function("copy", [a, b], [ca.vertcat(a, b)])
    buffers = (Buffer("a", SIZE - 2, "random"), Buffer("b", 2, "random"), Buffer("out", SIZE, "rows_out"))
    return Program("random", buffers, (Call(copy, ("a", "b"), ("out",)),))


@pytest.fixture(params=["float64", "float32"])
def draw(request):
    kernel = load_kernel("random", program, request.param)

    def run(keys, counters, num_threads=1):
        out = np.zeros((len(keys), SIZE), request.param)
        kernel({"out": out}, len(keys), keys=keys, counters=counters, num_threads=num_threads)
        return out

    return run


def test_kernel_and_numpy_agree(draw):
    rng = np.random.default_rng(0)
    keys, counters = rng.integers(0, 2**64, 101, np.uint64), rng.integers(-(2**63), 2**63, 101, np.int64)
    out = draw(keys, counters, num_threads=2)
    np.testing.assert_array_equal(out, uniform(keys, counters, SIZE, out.dtype), strict=True)


def test_a_stream_depends_on_its_key_and_counter_alone(draw):
    keys, counters = np.arange(50, dtype=np.uint64), np.arange(50, dtype=np.int64) * 7
    whole = draw(keys, counters)
    np.testing.assert_array_equal(draw(keys[3:4], counters[3:4])[0], whole[3])
    np.testing.assert_array_equal(draw(keys[::-1].copy(), counters[::-1].copy())[::-1], whole)
    assert len(np.unique(whole.round(12))) > 0.99 * whole.size


@pytest.mark.parametrize("what", ["counters", "keys"])
def test_uniform_and_uncorrelated(draw, what):
    """Neighbouring keys, as users choose them, and consecutive counters are the hard case for a mixer."""
    n = 20_000
    count, fixed = np.arange(n), np.zeros(n)
    keys, counters = (fixed, count) if what == "counters" else (count, fixed)
    u = draw(keys.astype(np.uint64), counters.astype(np.int64)).astype(float)
    assert u.min() >= 0
    assert u.max() < 1
    observed = np.array([np.histogram(column, 64, (0, 1))[0] for column in u.T])
    chi_square = ((observed - n / 64) ** 2 / (n / 64)).sum(1)
    assert chi_square.max() < 63 + 6 * np.sqrt(2 * 63)
    neighbours = np.hstack([u[:-1], u[1:]])
    correlation = np.corrcoef(neighbours.T) - np.eye(2 * SIZE)
    # A column's own successor appears once in each half; all other pairs are distinct draws.
    assert np.abs(correlation).max() < 6 / np.sqrt(n)


def test_one_bit_of_the_key_or_counter_flips_half_the_bits():
    rng = np.random.default_rng(2)
    keys, counters = rng.integers(0, 2**64, 400, np.uint64), rng.integers(0, 2**62, 400, np.int64)
    base = (uniform(keys, counters, 2, "float64") * 2**53).astype(np.uint64)
    for bit in range(0, 62, 5):
        for k, c in ((keys ^ np.uint64(1 << bit), counters), (keys, counters ^ np.int64(1 << bit))):
            other = (uniform(k, c, 2, "float64") * 2**53).astype(np.uint64)
            flipped = np.bitwise_count(base ^ other).mean() / 53
            assert abs(flipped - 0.5) < 0.03
