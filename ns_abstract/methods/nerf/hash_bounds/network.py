"""Bounds of small networks over a sub-box of a ray's poses, by zonotopes (docs/dev/design.md, H4).

Rows of a matrix are the centre, the coefficients of the pose symbols and of the place symbol, and those of error
symbols: one for every feature, and one for every unstable ReLU. A radius by neuron holds rounding errors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import BIAS_ROUNDING, HASH_UP, RELU_ROUNDING, gamma
from ns_abstract.arithmetic.simd.lanes import LINE
from ns_abstract.methods.nerf.hash_bounds.forms import UNCOUNTED, spread_of
from ns_abstract.methods.nerf.hash_field import DenseNet
from ns_abstract.methods.nerf.layer_kernel import multiply as product

#: Float64 elements of a pair of lines, to which rows of weights are padded.
_PAIR = 2 * LINE // 8


class NetWeights(NamedTuple):
    """A network as kernels take it: ReLU after every layer but the last.

    Attributes:
        sizes: [layers + 1] widths from inputs to outputs.
        weight: [layers, most inputs, most outputs to whole pairs of lines], transposed.
        bias: [layers, most outputs].
        rounding: [layers] relative error of a layer's sums, here and in a concrete evaluation (design.md, F4).
    """

    sizes: np.ndarray
    weight: np.ndarray
    absolute: np.ndarray
    bias: np.ndarray
    rounding: np.ndarray


def net_weights(net: DenseNet) -> NetWeights:
    """Return the arrays of ``net`` for kernels."""
    sizes = np.array([net.weights[0].shape[1], *(w.shape[0] for w in net.weights)], np.int64)
    layers, inputs, outputs = len(net.weights), int(sizes[:-1].max()), int(sizes[1:].max())
    padded = -(-outputs // _PAIR) * _PAIR
    weight, bias = np.zeros((layers, inputs, padded)), np.zeros((layers, padded))
    for i, (w, b) in enumerate(zip(net.weights, net.biases, strict=True)):
        weight[i, : w.shape[1], : w.shape[0]] = w.T
        bias[i, : len(b)] = b
    rounding = np.array([2.0 * gamma(int(n) + 4) for n in sizes[:-1]])
    return NetWeights(sizes, weight, np.abs(weight), bias, rounding)


class LayerZonotope(NamedTuple):
    """Memory for the neurons of one layer.

    Attributes:
        rows: [most rows, most neurons].
        radius, size: [most neurons] radii, and bounds of absolute values where they are known.
    """

    rows: np.ndarray
    radius: np.ndarray
    size: np.ndarray


def zonotope(rows: int, neurons: int) -> LayerZonotope:
    """Return memory for ``rows`` of ``neurons``."""
    return LayerZonotope(np.zeros((rows, neurons)), np.zeros(neurons), np.zeros(neurons))


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def from_features(features, weights, out):
    """Compute neurons ``out`` of the first layer from forms ``features`` [F, n + 3], each with a symbol of its own.

    Returns:
        The number of rows.
    """
    count, width = features.shape
    shared, n = width - 1, weights.sizes[1]
    rows, radius, w = out.rows, out.radius, weights.weight[0]
    bias, absolute = weights.bias[0], weights.absolute[0]
    for j in range(n):
        rows[0, j] = bias[j]
        radius[j] = BIAS_ROUNDING * abs(bias[j])
    for s in range(1, shared):
        for j in range(n):
            rows[s, j] = 0.0
    for f in range(count):
        size = (abs(features[f, 0]) + spread_of(features[f])) * weights.rounding[0]
        for s in range(shared):
            x = features[f, s]
            if x != 0.0:
                for j in range(n):
                    rows[s, j] += x * w[f, j]
        x = features[f, width - 1]
        for j in range(n):
            rows[shared + f, j] = x * w[f, j]
            radius[j] += size * absolute[f, j]
    for j in range(n):
        radius[j] = (radius[j] + BIAS_ROUNDING * abs(rows[0, j])) * HASH_UP
    return shared + count


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def relu(z, count, n, live):
    """Compute max(0, z) of ``n`` neurons in ``count`` rows, in place (design.md, H4).

    ``live``: [n] receives the numbers of the neurons that may be positive. Returns the number of rows, and that of live
    neurons.
    """
    rows, radius, size = z.rows, z.radius, z.size
    # at first the spreads
    size[:n] = 0.0
    for r in range(1, count):
        for j in range(n):
            size[j] += abs(rows[r, j])
    terms, alive = count, 0
    for j in range(n):
        center, spread = rows[0, j], size[j]
        reach = (spread + radius[j]) * HASH_UP
        if center + reach <= 0.0:
            for r in range(terms):
                rows[r, j] = 0.0
            radius[j] = size[j] = 0.0
            continue
        live[alive] = j
        alive += 1
        size[j] = (abs(center) + spread) * HASH_UP
        if center - reach >= 0.0:
            continue
        low, high = center - reach, center + reach
        slope = high / (high - low)
        error = -0.5 * slope * low
        for r in range(terms):
            rows[r, j] *= slope
        rows[0, j] += error
        rounding = RELU_ROUNDING * (slope * size[j] + error)
        radius[j] = (radius[j] * slope + rounding) * HASH_UP
        for k in range(n):
            rows[count, k] = 0.0
        rows[count, j] = error * HASH_UP
        size[j] = (slope * size[j] + 2.0 * error) * HASH_UP
        count += 1
    return count, alive


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def linear(z, count, live, weight, absolute, bias, rounding, out, rest):
    """Compute neurons ``out`` [n] of a layer from its inputs ``z``, of ``count`` rows, of which ``live`` [k] count.

    ``weight`` [inputs, n and more, to whole pairs of lines], ``absolute`` weights and ``bias`` [n and more];
    ``rounding`` is the relative error of the layer's sums. The radius of ``out`` may hold further terms; ``rest``
    [ROWS, two lines] is scratch.
    """
    rows, radius = out.rows, out.radius
    n = rows.shape[1]
    if n == 1:
        for r in range(count):
            total = 0.0
            for k in live:
                total += z.rows[r, k] * weight[k, 0]
            rows[r, 0] = total
    else:
        product(z.rows[:count], live, weight, rest, rows[:count])
    for j in range(n):
        radius[j] = 0.0
    for k in live:
        own = z.radius[k] + rounding * (z.size[k] + z.radius[k])
        for j in range(n):
            radius[j] += own * absolute[k, j]
    for j in range(n):
        rows[0, j] += bias[j]
        radius[j] = (radius[j] + BIAS_ROUNDING * (abs(bias[j]) + abs(rows[0, j]))) * HASH_UP


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def remaining_layers(rooms, count, weights, live, rest):
    """Bound the layers after the first, whose neurons before their ReLU are in ``rooms[0]``; return the last's rows.

    ``rooms``: `LayerZonotope` of every layer, and more; ``count``: rows of the first. ``live`` [most neurons] and
    ``rest`` [ROWS, two lines] are scratch.
    """
    for layer in range(1, weights.sizes.shape[0] - 1):
        z = rooms[layer - 1]
        n = weights.sizes[layer]
        count, alive = relu(z, count, n, live)
        linear(
            z, count, live[:alive], weights.weight[layer, :n], weights.absolute[layer], weights.bias[layer],
            weights.rounding[layer], rooms[layer], rest,
        )  # fmt: skip
    return count


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def sizes_of(z, count):
    """Compute bounds of the absolute values of neurons, from ``count`` rows."""
    n = z.rows.shape[1]
    for j in range(n):
        z.size[j] = 0.0
    for r in range(count):
        for j in range(n):
            z.size[j] += abs(z.rows[r, j])
    for j in range(n):
        z.size[j] *= HASH_UP


class HeadWeights(NamedTuple):
    """The network of colours.

    Attributes:
        direction: [16, n] the first layer's weights of harmonics.
        geometry, absolute: [outputs of the density's network, n and more] its other weights, and their absolute values.
    """

    net: NetWeights
    direction: np.ndarray
    geometry: np.ndarray
    absolute: np.ndarray


def head_weights(net: DenseNet, harmonics: int) -> HeadWeights:
    """Return the arrays of ``net``, whose first inputs are ``harmonics`` of the direction."""
    weights = net_weights(net)
    first = weights.weight[0]
    inputs = int(weights.sizes[0])
    geometry = np.zeros((1 + inputs - harmonics, first.shape[1]))
    geometry[1:] = first[harmonics:inputs]
    return HeadWeights(weights, np.ascontiguousarray(first[:harmonics]), geometry, np.abs(geometry))


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def weigh_direction(forms, head, rows, radius):
    """Set ``rows`` and ``radius`` to the contribution of a direction to the first layer of the ``head``.

    It is the weighted sum of the direction's spherical harmonics ``forms`` [16, n + 3]: ``rows`` [n + 2, neurons] are
    its linear part, ``radius`` [neurons] bounds the rest, and the rounding.
    """
    count, width = forms.shape
    rows[:] = 0.0
    radius[:] = 0.0
    for f in range(count):
        own = forms[f, width - 1] + head.net.rounding[0] * (abs(forms[f, 0]) + spread_of(forms[f]))
        for j in range(rows.shape[1]):
            for s in range(width - 1):
                rows[s, j] += forms[f, s] * head.direction[f, j]
            radius[j] += own * abs(head.direction[f, j])


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def colors(z, count, seen, head, rooms, live, rest):
    """Compute neurons of colours before the sigmoid in ``rooms[-1]``; return the number of rows.

    ``z`` is the `LayerZonotope` of the density's network, ``count`` rows; ``seen`` the result of `weigh_direction`. For
    the others see `remaining_layers`.
    """
    sizes_of(z, count)
    n = z.rows.shape[1]
    for k in range(1, n):
        live[k - 1] = k
    first, (rows, radius) = rooms[0], seen
    linear(z, count, live[: n - 1], head.geometry, head.absolute, head.net.bias[0], head.net.rounding[0], first, rest)
    for s in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            first.rows[s, j] += rows[s, j]
    for j in range(rows.shape[1]):
        first.radius[j] = (first.radius[j] + radius[j] + BIAS_ROUNDING * abs(first.rows[0, j])) * HASH_UP
    return remaining_layers(rooms, count, head.net, live, rest)


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def output_form(z, count, j, shared, out):
    """Write neuron ``j`` of ``count`` rows as a form ``out`` [shared + 1]; error symbols are added to the radius."""
    rest = z.radius[j]
    for r in range(shared, count):
        rest += abs(z.rows[r, j])
    for s in range(shared):
        out[s] = z.rows[s, j]
    out[shared] = rest * HASH_UP
