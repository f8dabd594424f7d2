"""Gradients of a network with respect to weights and inputs, for short-horizon actor-critic.

Arrays have the layout of `networks.py`.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numba import njit as numba_njit

from ce_gym.learn.networks.perceptron import CHUNK, LANES, ZERO, _backwards, _forwards, _gather, _product, _width

njit = partial(numba_njit, error_model="numpy")


@njit
def _by_input(theta, sizes, first, n, turned, result):
    """Fill `result` with the gradient with respect to observations, n rows padded to whole vectors; return the width.

    `first` is the gradient with respect to the outputs of layer 1.
    """
    n_in, n_out = sizes[0], _width(sizes, 1)
    wide = (n_in + LANES - 1) // LANES * LANES
    for j in range(n_out):
        for i in range(n_in):
            turned[j * wide + i] = theta[i * n_out + j]
        for i in range(n_in, wide):
            turned[j * wide + i] = ZERO
    for i in range(n * wide):
        result[i] = ZERO
    r = result.ctypes.data
    _product(first.ctypes.data, n_out, 1, turned.ctypes.data, wide, r, wide, r, wide, n, wide, n_out)
    return wide


@njit(cache=True, nogil=True)
def back_through(theta, sizes, kind, observations, by_output, gradient, by_observations, work):
    """Back-propagate through a network.

    Args:
        theta: Parameters of the network.
        sizes: Sizes of its layers, the observation first.
        kind: Activation, see `networks.KINDS`.
        observations: Inputs, shape (n, n_obs).
        by_output: Gradient with respect to the outputs, shape (n, n_out).
        gradient: Gradient with respect to theta, added to this array.
        by_observations: Gradient with respect to observations, shape (n, n_obs), overwritten.
        work: Buffers of `networks.make_work`.
    """
    values, d, other, turned = work
    for start in range(0, len(observations), CHUNK):
        rows = np.arange(start, min(start + CHUNK, len(observations)))
        n = len(rows)
        _gather(observations, rows, values)
        last_layer = _forwards(theta, sizes, kind, values, n)
        width = last_layer.shape[1]
        for i in range(n):
            for j in range(width):
                d[i * width + j] = by_output[start + i, j] if j < sizes[-1] else ZERO
        _backwards(theta, sizes, kind, values, n, d, other, turned, gradient)
        first, free = (d, other) if len(sizes) % 2 == 0 else (other, d)  # each layer swaps the two buffers
        wide = _by_input(theta, sizes, first, n, turned, free)
        for i in range(n):
            for j in range(sizes[0]):
                by_observations[start + i, j] = free[i * wide + j]
