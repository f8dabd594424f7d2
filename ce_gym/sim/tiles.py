"""State arrays of many robots in the layout of the kernels, and their conversion to and from plain rows.

A tile holds as many robots as a vector register has lanes, and arrays are (n_tiles, size, lanes). Robots beyond
`num_envs` in the last tile are padding with copies of valid states.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.compile import aligned_zeros, lane_count, tile_count


def tiles(num_envs: int, size: int, dtype: str) -> NDArray:
    """Return zeros for `size` values of each robot, shape (n_tiles, size, lanes)."""
    return aligned_zeros((tile_count(num_envs, dtype), size, lane_count(dtype)), dtype)


def read_rows(array: NDArray, num_envs: int) -> NDArray:
    """Return a copy of a tiled array as rows, shape (num_envs, size)."""
    n_tiles, size, lanes = array.shape
    return array.transpose(0, 2, 1).reshape(n_tiles * lanes, size)[:num_envs].copy()


def write_rows(array: NDArray, rows: ArrayLike, mask: NDArray[np.bool_] | None = None) -> None:
    """Write rows into a tiled array; padding repeats the last row.

    Args:
        array: Tiled array, changed in place.
        rows: Values, shape (num_envs, size) or a shape that broadcasts to it.
        mask: Robots to write, shape (num_envs,); all robots if None.
    """
    n_tiles, size, lanes = array.shape
    if mask is None:
        values = np.asarray(rows, array.dtype)
        padded = np.empty((n_tiles * lanes, size), array.dtype)
        count = values.shape[0] if values.ndim == 2 else n_tiles * lanes
        padded[:count] = values
        padded[count:] = padded[count - 1]
        array[...] = padded.reshape(n_tiles, lanes, size).transpose(0, 2, 1)
        return
    index = np.flatnonzero(mask)
    values = np.broadcast_to(np.asarray(rows, array.dtype), (len(mask), size))
    array[index // lanes, :, index % lanes] = values[index]
    if mask[-1]:
        array[-1, :, (len(mask) - 1) % lanes + 1 :] = values[-1][:, None]
