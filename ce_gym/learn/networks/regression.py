"""Gradient of a network's squared error, for a student that imitates a teacher.

Arrays have the layout of `networks.py`.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numba import njit as numba_njit

from ce_gym.learn.networks.perceptron import CHUNK, ZERO, _backwards, _forwards, _gather

njit = partial(numba_njit, error_model="numpy")


@njit(cache=True, nogil=True)
def squared_error_gradient(theta, sizes, kind, observations, labels, rows, gradient, work):
    """Add the gradient of the mean squared error over rows and outputs; return the mean squared error.

    Args:
        theta: Parameters of the network.
        sizes: Sizes of its layers, the observation first.
        kind: Activation, see `networks.KINDS`.
        observations: Inputs, shape (n, n_obs).
        labels: Desired outputs, shape (n, n_out).
        rows: Indices of the samples.
        gradient: Gradient with respect to theta, added to this array.
        work: Buffers of `networks.make_work`.
    """
    values, d, other, turned = work
    n_out, total = sizes[-1], 0.0
    weight = np.float32(1.0 / (len(rows) * n_out))
    for start in range(0, len(rows), CHUNK):
        chosen = rows[start : start + CHUNK]
        n = len(chosen)
        _gather(observations, chosen, values)
        last_layer = _forwards(theta, sizes, kind, values, n)
        by_output = d[: last_layer.size].reshape(last_layer.shape)
        for i in range(n):
            for j in range(n_out):
                error = last_layer[i, j] - labels[chosen[i], j]
                total += error * error
                by_output[i, j] = np.float32(2) * weight * error
            for j in range(n_out, by_output.shape[1]):
                by_output[i, j] = ZERO
        _backwards(theta, sizes, kind, values, n, d, other, turned, gradient)
    return total * weight
