"""Dense networks as compiled loops: forward pass, backward pass, and gradients of PPO.

For layers of 64 or 128 units, the overhead of frameworks and BLAS libraries takes as long as the multiplications. Here
one block of a matrix product stays in registers (`_emit`), and a chunk of samples stays in the cache during forward and
backward pass.

All parameters are one vector. Each layer has weights (n_in, n_out) row by row, then biases. The order is: layers of the
actor, logarithms of the standard deviations, layers of the critic. Widths of layers are padded to whole vectors, and
the padding is always zero. Sums have a fixed order with one rounding per step, so that results do not depend on the
number of threads or the width of the processor's vectors.
"""

from __future__ import annotations

import math
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import njit as numba_njit
from numba import types
from numba.extending import intrinsic

from ce_gym.policies import ACTIVATIONS

LANES = 16
"""Elements of a vector; processors with narrower vectors use several instructions."""

ROWS, COLUMNS = (8 if binding.get_host_cpu_features().get("avx512f") else 3), 2
"""Rows and vectors of a block, so that it fits the registers."""

CHUNK = 128
"""Samples that pass the networks together."""

KINDS = tuple(ACTIVATIONS)
"""Names of activations; the index is the argument `kind` of the functions below."""

njit = partial(numba_njit, error_model="numpy")
"""Without checks of divisions, as in numpy, so that loops become vector instructions."""

FIGURES = ("policy_gradient_loss", "value_loss", "approx_kl", "clip_fraction")
"""Statistics of a minibatch that `actor_gradient` and `critic_gradient` compute."""


def padded(width: int) -> int:
    """Return the width of a layer in memory."""
    return -(-width // LANES) * LANES


def _make_block(rows: int, columns: int) -> Any:
    """Return a numba function for a block of `c = start + a @ b` in registers, `rows` times `columns` vectors."""

    @intrinsic
    def block(_typing, a, row_a, step_a, b, row_b, start, row_start, c, row_c, n):
        """Compute a block.

        Arguments are addresses of first elements, distances between rows and between terms of the sum in elements, and
        the number of terms.
        """

        def emit(context, builder, _signature, arguments):
            name = f"product_{rows}_{columns}"
            function = builder.module.globals.get(name) or _emit(builder.module, name, rows, columns)
            builder.call(function, arguments)
            return context.get_dummy_value()

        return types.void(*[types.int64] * 10), emit

    return block


def _emit(module, name: str, rows: int, columns: int) -> ir.Function:
    """Return the block as a function of an LLVM module: a loop over the sum, which has at least one term."""
    word, lane = ir.IntType(64), ir.FloatType()
    vector = ir.VectorType(lane, LANES)
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [word] * 10), name)
    function.linkage = "linkonce_odr"
    function.attributes.add("noinline")
    a, row_a, step_a, b, row_b, start, row_start, c, row_c, n = function.args
    fused = f"llvm.fma.v{LANES}f32"
    fma = module.globals.get(fused) or ir.Function(module, ir.FunctionType(vector, [vector] * 3), fused)
    undefined, zeros = ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    entry, body, end = (function.append_basic_block(part) for part in ("entry", "body", "end"))
    builder: Any = ir.IRBuilder(entry)

    def element(base, row, distance, offset):
        index = builder.add(builder.mul(distance, word(row)), offset)
        return builder.gep(builder.inttoptr(base, lane.as_pointer()), [index])

    def address(base, row, distance, j):
        return builder.bitcast(element(base, row, distance, word(j * LANES)), vector.as_pointer())

    def everywhere(scalar):
        return builder.shuffle_vector(builder.insert_element(undefined, scalar, ir.IntType(32)(0)), undefined, zeros)

    places = [(i, j) for i in range(rows) for j in range(columns)]
    first = [builder.load(address(start, i, row_start, j), align=4) for i, j in places]
    builder.branch(body)
    builder.position_at_end(body)
    k, sums = builder.phi(word), [builder.phi(vector) for _ in places]
    below = builder.add(b, builder.mul(builder.mul(k, row_b), word(4)))
    right = [builder.load(address(below, 0, row_b, j), align=4) for j in range(columns)]
    left = [everywhere(builder.load(element(a, i, row_a, builder.mul(k, step_a)))) for i in range(rows)]
    added = [builder.call(fma, [left[i], right[j], sums[p]]) for p, (i, j) in enumerate(places)]
    following = builder.add(k, word(1))
    for phi, old, new in ((k, word(0), following), *zip(sums, first, added, strict=True)):
        phi.add_incoming(old, entry)
        phi.add_incoming(new, body)
    builder.cbranch(builder.icmp_signed("<", following, n), body, end)
    builder.position_at_end(end)
    for p, (i, j) in enumerate(places):
        builder.store(added[p], address(c, i, row_c, j), align=4)
    builder.ret_void()
    return function


_wide, _narrow = _make_block(ROWS, COLUMNS), _make_block(ROWS, 1)
_wide_row, _narrow_row = _make_block(1, COLUMNS), _make_block(1, 1)


@njit
def _product(a, row_a, step_a, b, row_b, start, row_start, c, row_c, m, n, k):
    """Compute `c = start + a @ b` from addresses, shape (m, n) with k terms per sum; n is a multiple of `LANES`."""
    wide, j = LANES * COLUMNS, 0
    while j < n:
        two, i = j + wide <= n, 0
        at_b, at_s, at_c = b + 4 * j, start + 4 * j, c + 4 * j
        while i < m:
            at_a = a + 4 * i * row_a
            s, o = at_s + 4 * i * row_start, at_c + 4 * i * row_c
            if i + ROWS <= m:
                if two:
                    _wide(at_a, row_a, step_a, at_b, row_b, s, row_start, o, row_c, k)
                else:
                    _narrow(at_a, row_a, step_a, at_b, row_b, s, row_start, o, row_c, k)
                i += ROWS
            else:
                if two:
                    _wide_row(at_a, row_a, step_a, at_b, row_b, s, row_start, o, row_c, k)
                else:
                    _narrow_row(at_a, row_a, step_a, at_b, row_b, s, row_start, o, row_c, k)
                i += 1
        j += wide if two else LANES


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
    if kind == TANH:
        for i in range(len(y)):
            for j in range(width):
                y[i, j] = _tanh(y[i, j])
        return
    for i in range(len(y)):
        for j in range(width):
            x = y[i, j]
            if kind == RELU:
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
    if kind == TANH:
        for i in range(n):
            d[i] *= ONE - y[i] * y[i]
        return
    for i in range(n):
        if kind == RELU:
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
def _width(sizes, layer):
    """Return the width of a layer in memory; the observation has no padding."""
    return sizes[0] if layer == 0 else (sizes[layer] + LANES - 1) // LANES * LANES


@njit
def _forwards(theta, sizes, kind, values, n):
    """Fill `values` with the layers of n samples, after the observations; return the last layer."""
    at, here, n_out = 0, 0, sizes[0]
    parameters, first = theta.ctypes.data, values.ctypes.data
    for layer in range(len(sizes) - 1):
        n_in, n_out = n_out, _width(sizes, layer + 1)
        there, bias = here + n * n_in, at + n_in * n_out
        x, w, b, y = first + 4 * here, parameters + 4 * at, parameters + 4 * bias, first + 4 * there
        _product(x, n_in, 1, w, n_out, b, 0, y, n_out, n, n_out, n_in)
        if layer < len(sizes) - 2:
            _activate(values[there : there + n * n_out].reshape(n, n_out), sizes[layer + 1], kind)
        at, here = bias + n_out, there
    return values[here : here + n * n_out].reshape(n, n_out)


@njit
def _backwards(theta, sizes, kind, values, n, d, other, turned, gradient):
    """Add the gradient with respect to theta to `gradient`, from d, the gradient with respect to the last layer.

    `d` and `other` are overwritten and have the size of n rows of the widest layer; `turned` has the size of the
    largest weight matrix.
    """
    here, end = 0, 0
    for layer in range(len(sizes) - 1):
        here += n * _width(sizes, layer)
        end += (_width(sizes, layer) + 1) * _width(sizes, layer + 1)
    for layer in range(len(sizes) - 2, -1, -1):
        n_in, n_out = _width(sizes, layer), _width(sizes, layer + 1)
        here, bias = here - n * n_in, end - n_out
        at = bias - n_in * n_out
        for i in range(n):
            for j in range(n_out):
                gradient[bias + j] += d[i * n_out + j]
        g, by_output = gradient.ctypes.data + 4 * at, d.ctypes.data
        _product(values.ctypes.data + 4 * here, 1, n_in, by_output, n_out, g, n_out, g, n_out, n_in, n_out, n)
        if layer > 0:
            for i in range(n_in):
                for j in range(n_out):
                    turned[j * n_in + i] = theta[at + i * n_out + j]
            for i in range(n * n_in):
                other[i] = ZERO
            o = other.ctypes.data
            _product(by_output, n_out, 1, turned.ctypes.data, n_in, o, n_in, o, n_in, n, n_in, n_out)
            _times_slope(other, values[here:], n * n_in, kind)
            d, other, end = other, d, at


@njit
def _gather(observations, rows, values):
    """Copy observations with the indices `rows` to the start of `values`."""
    size = observations.shape[1]
    for i in range(len(rows)):
        for j in range(size):
            values[i * size + j] = observations[rows[i], j]


@njit(cache=True, nogil=True)
def outputs(theta, sizes, kind, observations, result, work):
    """Compute the outputs of a network for observations (n, n_obs) into `result` (n, n_out)."""
    for start in range(0, len(observations), CHUNK):
        rows = np.arange(start, min(start + CHUNK, len(observations)))
        _gather(observations, rows, work[0])
        last_layer = _forwards(theta, sizes, kind, work[0], len(rows))
        for i in range(len(rows)):
            for j in range(sizes[-1]):
                result[start + i, j] = last_layer[i, j]


@njit(cache=True, nogil=True)
def actor_gradient(
    theta, log_std, sizes, kind, samples, rows, scaling, clip, entropy, gradient, by_log_std, figures, work
):
    """Add the gradient of PPO's clipped objective and of the entropy bonus (Schulman et al. 2017, eq. 7 and 9).

    Args:
        theta: Parameters of the actor.
        log_std: Logarithms of the standard deviations, shape (n_actions,).
        sizes: Sizes of the layers, the observation first.
        kind: Activation, see `KINDS`.
        samples: Observations, actions, log-probabilities, advantages of all samples.
        rows: Indices of the samples of the minibatch.
        scaling: Mean and reciprocal standard deviation of the minibatch's advantages, and weight of a sample.
        clip: Clipping range of the probability ratio.
        entropy: Weight of the entropy bonus.
        gradient: Gradient with respect to theta, added to this array.
        by_log_std: Gradient with respect to log_std, added to this array.
        figures: Sums of `FIGURES` except the value loss, added to this array.
        work: Buffers of `make_work`.
    """
    observations, actions, log_probs, advantages = samples
    centre, scale, weight = scaling
    values, d, other, turned = work
    n_actions = sizes[-1]
    shrink, constant = np.exp(-log_std), np.float32(n_actions * 0.5 * math.log(2 * math.pi))
    for j in range(n_actions):
        constant += log_std[j]
    for start in range(0, len(rows), CHUNK):
        chosen = rows[start : start + CHUNK]
        n = len(chosen)
        _gather(observations, chosen, values)
        means = _forwards(theta, sizes, kind, values, n)
        by_mean = d[: means.size].reshape(means.shape)
        for i in range(n):
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
            for j in range(n_actions, by_mean.shape[1]):
                by_mean[i, j] = ZERO
            figures[0] -= objective * weight
            figures[2] += (ratio - ONE - log_ratio) * weight  # k3 of http://joschu.net/blog/kl-approx.html
            figures[3] += weight if abs(ratio - ONE) > clip else ZERO
        _backwards(theta, sizes, kind, values, n, d, other, turned, gradient)


@njit(cache=True, nogil=True)
def critic_gradient(theta, sizes, kind, samples, rows, weight, coefficient, gradient, figures, work):
    """Add the gradient of `coefficient` times the squared error of values.

    `samples` are observations and returns; see `actor_gradient` for the other arguments.
    """
    observations, returns = samples
    values, d, other, turned = work
    for start in range(0, len(rows), CHUNK):
        chosen = rows[start : start + CHUNK]
        n = len(chosen)
        _gather(observations, chosen, values)
        last_layer = _forwards(theta, sizes, kind, values, n)
        by_value = d[: last_layer.size].reshape(last_layer.shape)
        for i in range(n):
            error = last_layer[i, 0] - returns[chosen[i]]
            for j in range(1, by_value.shape[1]):
                by_value[i, j] = ZERO
            by_value[i, 0] = np.float32(2) * coefficient * weight * error
            figures[1] += error * error * weight
        _backwards(theta, sizes, kind, values, n, d, other, turned, gradient)


def parameter_count(sizes) -> int:
    """Return the length of the vector of a network's parameters."""
    widths = [sizes[0], *(padded(size) for size in sizes[1:])]
    return sum((n_in + 1) * n_out for n_in, n_out in pairwise(widths))


def layers_of(theta: np.ndarray, sizes) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return views of weights (n_in, n_out) and biases (n_out,) of each layer without padding."""
    widths = [sizes[0], *(padded(size) for size in sizes[1:])]
    layers, at = [], 0
    for i in range(len(sizes) - 1):
        end = at + widths[i] * widths[i + 1]
        weight = theta[at:end].reshape(widths[i], widths[i + 1])
        layers.append((weight[: sizes[i], : sizes[i + 1]], theta[end : end + sizes[i + 1]]))
        at = end + widths[i + 1]
    return layers


def start_layers(vector: np.ndarray, sizes, last: float, rng: np.random.Generator) -> None:
    """Set orthogonal weights in a vector of parameters; `last` scales the last layer. Biases are unchanged."""
    layers = layers_of(vector, sizes)
    for i, (weight, _) in enumerate(layers):
        q, r = np.linalg.qr(rng.standard_normal((max(weight.shape), min(weight.shape))))
        q = (q * np.sign(np.diag(r))).astype(np.float32)
        weight[:] = (last if i == len(layers) - 1 else 2**0.5) * (q if weight.shape[0] >= weight.shape[1] else q.T)


def make_work(sizes) -> tuple[np.ndarray, ...]:
    """Return buffers of one thread for networks up to these sizes."""
    widths = [padded(size) for size in sizes]
    lengths = (CHUNK * sum(widths), CHUNK * max(widths), CHUNK * max(widths), max(widths) ** 2)
    return tuple(np.zeros(length, np.float32) for length in lengths)
