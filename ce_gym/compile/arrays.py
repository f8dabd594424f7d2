"""Tiles in memory: number of lanes, number of tiles, and arrays that start on a cache line."""

import numpy as np
from numpy.typing import DTypeLike

ALIGNMENT = 64
"""Bytes of one cache line and of one AVX-512 register."""


def lane_count(dtype: DTypeLike) -> int:
    """Return the lanes of one tile; one lane is one environment.

    Args:
        dtype: `float64` or `float32`.

    Returns:
        8 for float64, 16 for float32, which fill 64 bytes.

    Raises:
        ValueError: for any other dtype.
    """
    name = np.dtype(dtype).name
    if name not in ("float64", "float32"):
        raise ValueError(f"dtype: {name!r}, expected 'float64' or 'float32'")
    return ALIGNMENT // np.dtype(dtype).itemsize


def tile_count(num_envs: int, dtype: DTypeLike) -> int:
    """Return the number of tiles for `num_envs` lanes; the last tile may be padded."""
    return -(-num_envs // lane_count(dtype))


def aligned_zeros(shape: int | tuple[int, ...], dtype: DTypeLike) -> np.ndarray:
    """Return zeros of `shape` in C order that start on a multiple of 64 bytes."""
    dtype = np.dtype(dtype)
    n_bytes = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    raw = np.zeros(n_bytes + ALIGNMENT, np.uint8)
    start = -raw.ctypes.data % ALIGNMENT
    return raw[start : start + n_bytes].view(dtype).reshape(shape)


def aligned_copy(array: np.ndarray) -> np.ndarray:
    """Return a copy of an array that starts on a multiple of 64 bytes."""
    copy = aligned_zeros(array.shape, array.dtype)
    copy[...] = array
    return copy
