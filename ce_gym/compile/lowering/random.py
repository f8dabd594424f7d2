"""Counter-based uniform numbers: a draw is a function of (key, counter, index) only.

The mixer is splitmix64's finaliser (Steele, Lea and Flood 2014, Fast splittable pseudorandom number generators). The
key and the counter are mixed into a start, from which the draws of the lane follow the sequence of splitmix64. The
formula exists twice, as numpy and as vector code, and a test holds both equal.
"""

import numpy as np
from llvmlite import ir
from numpy.typing import DTypeLike

from ce_gym.compile.lowering.vector import Value, VectorBuilder

GOLDEN = 0x9E3779B97F4A7C15
FIRST_FACTOR = 0xBF58476D1CE4E5B9
SECOND_FACTOR = 0x94D049BB133111EB
RANDOM_BITS = {"float64": 53, "float32": 24}


def uniform(keys: np.ndarray, counters: np.ndarray, size: int, dtype: DTypeLike) -> np.ndarray:
    """Return the numbers of a `random` buffer of a kernel.

    Args:
        keys: uint64, shape (n,): one stream each.
        counters: int64, shape (n,): the position in the stream.
        size: draws per position.
        dtype: float64 (53 random bits) or float32 (24).

    Returns:
        Uniform numbers in [0, 1), shape (n, size).
    """
    bits = RANDOM_BITS[np.dtype(dtype).name]
    golden = np.uint64(GOLDEN)
    start = _mix(_mix(keys + golden) ^ (counters.astype(np.uint64) * golden))
    draws = _mix(start[:, None] + np.arange(1, size + 1, dtype=np.uint64) * golden)
    return ((draws >> np.uint64(64 - bits)) * 2.0**-bits).astype(dtype)


def _mix(x: np.ndarray) -> np.ndarray:
    x = (x ^ (x >> np.uint64(30))) * np.uint64(FIRST_FACTOR)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(SECOND_FACTOR)
    return x ^ (x >> np.uint64(31))


def emit_uniform(v: VectorBuilder, keys: Value, counters: Value, outputs: list[tuple[Value, int]]) -> None:
    """Emit code that fills random buffers with `uniform`; several buffers share one sequence, one after the other.

    Args:
        v: builder of the block to append to.
        keys: vector of 64-bit integers, one per lane.
        counters: vector of 64-bit integers, one per lane.
        outputs: pointer to the first vector of each buffer and its size.
    """
    b = v.builder
    golden = _word(v, GOLDEN)
    start = _emit_mix(v, b.xor(_emit_mix(v, b.add(keys, golden)), b.mul(counters, golden)))
    bits = RANDOM_BITS[v.dtype]
    for pointer, size in outputs:
        for index in range(size):
            start = b.add(start, golden)
            high = b.lshr(_emit_mix(v, start), _word(v, 64 - bits))
            v.store(b.fmul(b.sitofp(high, v.float_type), v.const(2.0**-bits)), pointer, index)


def _emit_mix(v: VectorBuilder, x: Value) -> Value:
    b = v.builder
    x = b.mul(b.xor(x, b.lshr(x, _word(v, 30))), _word(v, FIRST_FACTOR))
    x = b.mul(b.xor(x, b.lshr(x, _word(v, 27))), _word(v, SECOND_FACTOR))
    return b.xor(x, b.lshr(x, _word(v, 31)))


def _word(v: VectorBuilder, number: int) -> ir.Constant:
    return ir.Constant(ir.VectorType(ir.IntType(64), v.lanes), [number] * v.lanes)
