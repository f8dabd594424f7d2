"""Dense networks as compiled loops: forward pass, backward pass, and gradients of losses.

A chunk of samples stays in the cache during forward and backward pass. The parameters of a network are one vector: each
layer has weights (n_in, n_out) row by row, then biases. Widths of layers are padded to whole vectors, and the padding
is always zero. The result of a sample does not depend on the other samples, nor on the number of threads.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from ce_gym.learn.networks.products import LANES, njit, product
from ce_gym.policies import ACTIVATIONS

CHUNK = 128
"""Samples that pass the networks together."""

KINDS = tuple(ACTIVATIONS)
"""Names of activations; the index is `Network.kind`."""

FIGURES = ("policy_gradient_loss", "approx_kl", "clip_fraction")
"""Statistics of a minibatch that `actor_gradient` computes."""


@register_jitable
def padded(width):
    """Return the width of a layer in memory."""
    return -(-width // LANES) * LANES


class Network(NamedTuple):
    """A network.

    Attributes:
        theta: Parameters.
        sizes: Sizes of the layers, the observation first.
        kind: Activation, see `KINDS`.
    """

    theta: NDArray[np.float32]
    sizes: NDArray[np.int64]
    kind: int

    def layers(self) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Return views of weights (n_in, n_out) and biases (n_out,) of each layer without padding."""
        layers, at = [], 0
        for n_in, n_out in pairwise(self.sizes):
            end = at + padded(n_in) * padded(n_out)
            weight = self.theta[at:end].reshape(padded(n_in), padded(n_out))
            layers.append((weight[:n_in, :n_out], self.theta[end : end + n_out]))
            at = end + padded(n_out)
        return layers

    def start(self, last: float, rng: np.random.Generator) -> None:
        """Set orthogonal weights; `last` scales the last layer. Biases are unchanged."""
        layers = self.layers()
        for i, (weight, _) in enumerate(layers):
            q, r = np.linalg.qr(rng.standard_normal((max(weight.shape), min(weight.shape))))
            q = (q * np.sign(np.diag(r))).astype(np.float32)
            weight[:] = (last if i == len(layers) - 1 else 2**0.5) * (q if weight.shape[0] >= weight.shape[1] else q.T)


def parameter_count(sizes: Any) -> int:
    """Return the length of the vector of a network's parameters."""
    return sum((padded(n_in) + 1) * padded(n_out) for n_in, n_out in pairwise(sizes))


class Work(NamedTuple):
    """Buffers of a thread.

    Attributes:
        layers: Layers of a chunk of samples, the observations first.
        d: Gradient with respect to a layer.
        other: Gradient with respect to the layer before.
        transposed: Weights (n_out, n_in) of each layer, at the positions of the parameters.
        zeros: Zeros, of the widest layer.
        unit: The number 1.
    """

    layers: NDArray[np.float32]
    d: NDArray[np.float32]
    other: NDArray[np.float32]
    transposed: NDArray[np.float32]
    zeros: NDArray[np.float32]
    unit: NDArray[np.float32]


def make_work(*networks: Any) -> Work:
    """Return buffers for networks with these sizes of layers."""
    widest = max(padded(size) for sizes in networks for size in sizes)
    chunk = CHUNK * max(sum(padded(size) for size in sizes) for sizes in networks)
    lengths = (chunk, CHUNK * widest, CHUNK * widest, max(map(parameter_count, networks)), widest)
    layers, d, other, transposed, zeros = (np.zeros(length, np.float32) for length in lengths)
    return Work(layers, d, other, transposed, zeros, np.ones(1, np.float32))


@njit
def _tanh(x):
    """Return the hyperbolic tangent by Eigen's rational function, error 4e-7, without branches for vector loops."""
    x = x if x < np.float32(7.9) else np.float32(7.9)
    x = x if x > np.float32(-7.9) else np.float32(-7.9)
    s = x * x
    p = np.float32(-2.76076847742355e-16)
    p = p * s + np.float32(2.00018790482477e-13)
    p = p * s + np.float32(-8.60467152213735e-11)
    p = p * s + np.float32(5.12229709037114e-08)
    p = p * s + np.float32(1.48572235717979e-05)
    p = p * s + np.float32(6.37261928875436e-04)
    p = p * s + np.float32(4.89352455891786e-03)
    q = np.float32(1.19825839466702e-06)
    q = q * s + np.float32(1.18534705686654e-04)
    q = q * s + np.float32(2.26843463243900e-03)
    q = q * s + np.float32(4.89352518554385e-03)
    return x * p / q


TANH, RELU, ELU, SELU, SIGMOID = (KINDS.index(name) for name in ("Tanh", "ReLU", "ELU", "SELU", "Sigmoid"))
SCALE, ALPHA = np.float32(1.0507009873554805), np.float32(1.6732632423543772)
ONE, ZERO = np.float32(1), np.float32(0)


@njit
def _activate(y, width, kind):
    """Apply an activation in place to the first `width` columns of y (n, padded)."""
    for i in range(len(y)):
        for j in range(width):
            x = y[i, j]
            if kind == TANH:
                y[i, j] = _tanh(x)
            elif kind == RELU:
                y[i, j] = max(x, ZERO)
            elif kind == ELU:
                y[i, j] = x if x > 0 else math.expm1(x)
            elif kind == SELU:
                y[i, j] = SCALE * (x if x > 0 else ALPHA * math.expm1(x))
            elif kind == SIGMOID:
                y[i, j] = ONE / (ONE + math.exp(-x))
            else:
                y[i, j] = max(x, ZERO) + math.log1p(math.exp(-abs(x)))


@njit
def _times_slope(d, y, n, kind):
    """Multiply the first n elements of d in place by the derivative of an activation with the values y."""
    for i in range(n):
        if kind == TANH:
            d[i] *= ONE - y[i] * y[i]
        elif kind == RELU:
            d[i] = d[i] if y[i] > 0 else ZERO
        elif kind == ELU:
            d[i] *= ONE if y[i] > 0 else y[i] + ONE
        elif kind == SELU:
            d[i] *= SCALE if y[i] > 0 else y[i] + SCALE * ALPHA
        elif kind == SIGMOID:
            d[i] *= y[i] * (ONE - y[i])
        else:
            d[i] *= ONE - np.float32(math.exp(-y[i]))


@njit
def _transpose(network, transposed):
    """Fill `Work.transposed`."""
    at = 0
    for layer in range(len(network.sizes) - 1):
        n_in, n_out = padded(network.sizes[layer]), padded(network.sizes[layer + 1])
        end = at + n_in * n_out
        weight, result = network.theta[at:end].reshape(n_in, n_out), transposed[at:end].reshape(n_out, n_in)
        for j in range(n_out):
            for i in range(n_in):
                result[j, i] = weight[i, j]
        at = end + n_out


@njit
def _forwards(network, observations, rows, work):
    """Run a network on the observations with the indices `rows`.

    Fills `work.layers` and clears `work.d`.

    Returns:
        The last layer and the array for the gradient with respect to the last layer, each (n, padded n_out).
    """
    sizes, n, n_out = network.sizes, len(rows), padded(network.sizes[0])
    x, at, start = work.layers[: n * n_out].reshape(n, n_out), 0, 0
    x[:] = ZERO
    for i in range(n):
        row = rows[i]
        for j in range(sizes[0]):
            x[i, j] = observations[row, j]
    for layer in range(len(sizes) - 1):
        n_in, n_out = n_out, padded(sizes[layer + 1])
        start += CHUNK * n_in
        y = work.layers[start : start + n * n_out].reshape(n, n_out)
        weights = network.theta.ctypes.data + 4 * at
        biases = weights + 4 * n_in * n_out
        product(x.ctypes.data, n_in, 1, weights, n_out, biases, 0, y.ctypes.data, n_out, n, n_out, sizes[layer])
        if layer < len(sizes) - 2:
            _activate(y, sizes[layer + 1], network.kind)
        x, at = y, at + (n_in + 1) * n_out
    by_outputs = work.d[: x.size].reshape(x.shape)
    by_outputs[:] = ZERO
    return x, by_outputs


@njit
def _backwards(network, n, work, gradient, to_inputs):
    """Add the gradient with respect to the parameters to `gradient`.

    Args:
        network: The network.
        n: Number of samples.
        work: Layers, transposed weights, and in `d` the gradient with respect to the last layer.
        gradient: Same layout as the parameters.
        to_inputs: Whether to continue to the gradient with respect to the observations.

    Returns:
        The gradient with respect to the observations, or to layer 1, with the padding of its rows.
    """
    sizes, d, other, start, at = network.sizes, work.d, work.other, 0, 0
    for layer in range(len(sizes) - 1):
        start += CHUNK * padded(sizes[layer])
        at += (padded(sizes[layer]) + 1) * padded(sizes[layer + 1])
    for layer in range(len(sizes) - 2, -1, -1):
        n_in, n_out = padded(sizes[layer]), padded(sizes[layer + 1])
        start, at = start - CHUNK * n_in, at - (n_in + 1) * n_out
        x, by_y, weights = work.layers[start:], d.ctypes.data, gradient.ctypes.data + 4 * at
        biases = weights + 4 * n_in * n_out
        product(work.unit.ctypes.data, 0, 0, by_y, n_out, biases, 0, biases, 0, 1, n_out, n)
        product(x.ctypes.data, 1, n_in, by_y, n_out, weights, n_out, weights, n_out, sizes[layer], n_out, n)
        if layer > 0 or to_inputs:
            transposed, zeros = work.transposed.ctypes.data + 4 * at, work.zeros.ctypes.data
            product(by_y, n_out, 1, transposed, n_in, zeros, 0, other.ctypes.data, n_in, n, n_in, sizes[layer + 1])
            if layer > 0:
                _times_slope(other, x, n * n_in, network.kind)
            d, other = other, d
    return d


@njit(cache=True, nogil=True)
def outputs(network, observations, result, work):
    """Compute the outputs of a network for observations (n, n_obs) into `result` (n, n_out)."""
    for start in range(0, len(observations), CHUNK):
        rows = np.arange(start, min(start + CHUNK, len(observations)))
        last_layer, _ = _forwards(network, observations, rows, work)
        for i in range(len(rows)):
            for j in range(network.sizes[-1]):
                result[start + i, j] = last_layer[i, j]


@njit(cache=True, nogil=True)
def squared_error_gradient(network, observations, targets, rows, weight, gradient, work):
    """Add the gradient of the weighted sum of squared errors of the outputs; return the sum of squared errors.

    Args:
        network: The network.
        observations: Inputs, shape (n, n_obs).
        targets: Desired outputs, shape (n, n_out).
        rows: Indices of the samples that count.
        weight: Weight of each squared error.
        gradient: Gradient with respect to the parameters, added to this array.
        work: Buffers of `make_work`.
    """
    total = 0.0
    _transpose(network, work.transposed)
    for start in range(0, len(rows), CHUNK):
        chosen = rows[start : start + CHUNK]
        last_layer, by_output = _forwards(network, observations, chosen, work)
        for i in range(len(chosen)):
            for j in range(network.sizes[-1]):
                error = last_layer[i, j] - targets[chosen[i], j]
                total += error * error
                by_output[i, j] = np.float32(2) * weight * error
        _backwards(network, len(chosen), work, gradient, False)
    return total


@njit(cache=True, nogil=True)
def actor_gradient(network, log_std, samples, rows, scaling, clip, entropy, gradient, by_log_std, figures, work):
    """Add the gradient of PPO's clipped objective and of the entropy bonus (Schulman et al. 2017, eq. 7 and 9).

    Args:
        network: The actor.
        log_std: Logarithms of the standard deviations, shape (n_actions,).
        samples: Observations, actions, log-probabilities, advantages of all samples.
        rows: Indices of the samples of the minibatch.
        scaling: Mean and reciprocal standard deviation of the minibatch's advantages, and weight of a sample.
        clip: Clipping range of the probability ratio.
        entropy: Weight of the entropy bonus.
        gradient: Gradient with respect to the actor's parameters, added to this array.
        by_log_std: Gradient with respect to log_std, added to this array.
        figures: Sums of `FIGURES`, added to this array.
        work: Buffers of `make_work`.
    """
    observations, actions, log_probs, advantages = samples
    centre, scale, weight = scaling
    _transpose(network, work.transposed)
    n_actions = network.sizes[-1]
    shrink, constant = np.exp(-log_std), np.float32(n_actions * 0.5 * math.log(2 * math.pi))
    for j in range(n_actions):
        constant += log_std[j]
    for start in range(0, len(rows), CHUNK):
        chosen = rows[start : start + CHUNK]
        means, by_mean = _forwards(network, observations, chosen, work)
        for i in range(len(chosen)):
            row, square = chosen[i], ZERO
            for j in range(n_actions):
                z = (actions[row, j] - means[i, j]) * shrink[j]
                by_mean[i, j] = z
                square += z * z
            log_ratio = np.float32(-0.5) * square - constant - log_probs[row]
            ratio = math.exp(log_ratio)
            advantage = (advantages[row] - centre) * scale
            inside = min(max(ratio, ONE - clip), ONE + clip)
            objective = min(advantage * ratio, advantage * inside)
            slope = -advantage * ratio * weight if advantage * ratio <= advantage * inside else ZERO
            for j in range(n_actions):
                z = by_mean[i, j]
                by_log_std[j] += slope * (z * z - ONE) - entropy * weight
                by_mean[i, j] = slope * z * shrink[j]
            figures[0] -= objective * weight
            figures[1] += (ratio - ONE - log_ratio) * weight  # k3 of http://joschu.net/blog/kl-approx.html
            figures[2] += weight if abs(ratio - ONE) > clip else ZERO
        _backwards(network, len(chosen), work, gradient, False)


@njit(cache=True, nogil=True)
def back_through(network, observations, by_output, gradient, by_observations, work):
    """Back-propagate through a network to its parameters and its inputs.

    Args:
        network: The network.
        observations: Inputs, shape (n, n_obs).
        by_output: Gradient with respect to the outputs, shape (n, n_out).
        gradient: Gradient with respect to the parameters, added to this array.
        by_observations: Gradient with respect to observations, shape (n, n_obs), overwritten.
        work: Buffers of `make_work`.
    """
    _transpose(network, work.transposed)
    for start in range(0, len(observations), CHUNK):
        rows = np.arange(start, min(start + CHUNK, len(observations)))
        n, width = len(rows), padded(network.sizes[0])
        _, by_last_layer = _forwards(network, observations, rows, work)
        for i in range(n):
            for j in range(network.sizes[-1]):
                by_last_layer[i, j] = by_output[start + i, j]
        by_input = _backwards(network, n, work, gradient, True)
        for i in range(n):
            for j in range(network.sizes[0]):
                by_observations[start + i, j] = by_input[i * width + j]
