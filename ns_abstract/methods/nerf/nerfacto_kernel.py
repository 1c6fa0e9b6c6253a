"""Compiled evaluation of nerfacto along rays, in float64, by the rules of Nerfstudio's torch implementation.

Lines are those of nerfstudio 1.1.5. Grids are passed as `PackedGrid`, networks as `PackedNet`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ns_abstract.methods.nerf.hash_field import DenseNet, HashEncoding
from ns_abstract.methods.nerf.render import HISTOGRAM_PADDING

#: nerfstudio/field_components/encodings.py:407, ``hash_fn``.
PRIME_Y, PRIME_Z = 2654435761, 805459861


class PackedNet(NamedTuple):
    """A network as two arrays.

    Attributes:
        widths: [layers + 1] numbers of neurons, inputs first.
        values: Weights [out, in] and bias [out] of every layer, one after the other.
    """

    widths: NDArray[np.int64]
    values: NDArray[np.float64]


class PackedGrid(NamedTuple):
    """A hash grid: see `HashEncoding`."""

    table: NDArray[np.float64]
    resolutions: NDArray[np.int64]


def pack(net: DenseNet) -> PackedNet:
    """The arrays of a network."""
    widths = [net.weights[0].shape[1], *(weight.shape[0] for weight in net.weights)]
    parts = [part.ravel() for pair in zip(net.weights, net.biases, strict=True) for part in pair]
    return PackedNet(np.array(widths), np.concatenate(parts))


def pack_grid(encoding: HashEncoding) -> PackedGrid:
    """The arrays of a grid."""
    return PackedGrid(encoding.table, encoding.resolutions)


@njit(cache=True, error_model="numpy")
def contract(x, y, z):
    """Return the grids' coordinates of a point, contracted (spatial_distortions.py:66-69, nerfacto_field.py:208)."""
    size = max(abs(x), abs(y), abs(z))
    if not size < 1.0:
        shrunk = 2.0 - 1.0 / size
        x, y, z = shrunk * (x / size), shrunk * (y / size), shrunk * (z / size)
    return (x + 2.0) / 4.0, (y + 2.0) / 4.0, (z + 2.0) / 4.0


@njit(cache=True, error_model="numpy")
def hash_row(x, y, z, rows):
    """Return the row of a level's table, of ``rows`` (a power of two), that the corner (x, y, z) has."""
    return (x ^ (y * PRIME_Y) ^ (z * PRIME_Z)) & (rows - 1)


@njit(cache=True, error_model="numpy")
def grid_features(grid, x, y, z, out):
    """Write the features [L F] of a position in [0, 1]^3 to ``out`` (encodings.py:418-459)."""
    levels, rows, count = grid.table.shape
    for level in range(levels):
        table, size = grid.table[level], grid.resolutions[level]
        qx, qy, qz = x * size, y * size, z * size
        ax, ay, az = math.floor(qx), math.floor(qy), math.floor(qz)
        bx, by, bz = np.int64(math.ceil(qx)), np.int64(math.ceil(qy)), np.int64(math.ceil(qz))
        ox, oy, oz = qx - ax, qy - ay, qz - az
        ax, ay, az = np.int64(ax), np.int64(ay), np.int64(az)
        bbb, abb = hash_row(bx, by, bz, rows), hash_row(ax, by, bz, rows)
        bab, aab = hash_row(bx, ay, bz, rows), hash_row(ax, ay, bz, rows)
        bba, aba = hash_row(bx, by, az, rows), hash_row(ax, by, az, rows)
        baa, aaa = hash_row(bx, ay, az, rows), hash_row(ax, ay, az, rows)
        for k in range(count):
            far = (table[bbb, k] * ox + table[abb, k] * (1.0 - ox)) * oy
            far += (table[bab, k] * ox + table[aab, k] * (1.0 - ox)) * (1.0 - oy)
            near = (table[bba, k] * ox + table[aba, k] * (1.0 - ox)) * oy
            near += (table[baa, k] * ox + table[aaa, k] * (1.0 - ox)) * (1.0 - oy)
            out[level * count + k] = far * oz + near * (1.0 - oz)


@njit(cache=True, error_model="numpy")
def evaluate_net(net, inputs, outputs):
    """Evaluate a network in place: ``inputs`` [most neurons] is overwritten, results are written to ``outputs``."""
    at, layers = 0, net.widths.size - 1
    for layer in range(layers):
        n, m = net.widths[layer], net.widths[layer + 1]
        bias = at + n * m
        for i in range(m):
            total = 0.0
            for j in range(n):
                total += net.values[at + i * n + j] * inputs[j]
            total += net.values[bias + i]
            outputs[i] = total
        if layer < layers - 1:
            for i in range(m):
                inputs[i] = max(outputs[i], 0.0)
        at = bias + m


@njit(cache=True, error_model="numpy")
def harmonics(x, y, z, out):
    """Write 16 harmonics of (d + 1) / 2 for a unit direction d to ``out`` (nerfacto_field.py:242, math.py:42-77)."""
    x, y, z = (x + 1.0) / 2.0, (y + 1.0) / 2.0, (z + 1.0) / 2.0
    xx, yy, zz = x * x, y * y, z * z
    out[0] = 0.28209479177387814
    out[1] = 0.4886025119029199 * y
    out[2] = 0.4886025119029199 * z
    out[3] = 0.4886025119029199 * x
    out[4] = 1.0925484305920792 * x * y
    out[5] = 1.0925484305920792 * y * z
    out[6] = 0.9461746957575601 * zz - 0.31539156525251999
    out[7] = 1.0925484305920792 * x * z
    out[8] = 0.5462742152960396 * (xx - yy)
    out[9] = 0.5900435899266435 * y * (3.0 * xx - yy)
    out[10] = 2.890611442640554 * x * y * z
    out[11] = 0.4570457994644658 * y * (5.0 * zz - 1.0)
    out[12] = 0.3731763325901154 * z * (5.0 * zz - 3.0)
    out[13] = 0.4570457994644658 * x * (5.0 * zz - 1.0)
    out[14] = 1.445305721320277 * z * (xx - yy)
    out[15] = 0.5900435899266435 * x * (xx - 3.0 * yy)


@njit(cache=True, error_model="numpy")
def field_density(grid, net, factor, x, y, z, inputs, outputs):
    """Return the density at a point; the network's outputs are written to ``outputs``."""
    x, y, z = contract(x, y, z)
    # nerfacto_field.py:211-213: false only where rounding puts a point that is very far away onto the cube's face
    inside = 0.0 < x < 1.0 and 0.0 < y < 1.0 and 0.0 < z < 1.0
    if not inside:
        x = y = z = 0.0
    grid_features(grid, x, y, z, inputs)
    evaluate_net(net, inputs, outputs)
    density = factor * math.exp(outputs[0])
    return density if inside else density * 0.0


@njit(cache=True, error_model="numpy")
def distance_at(place, near, far, piecewise):
    """Return the distance of a place in [0, 1] along a ray (ray_samplers.py:113-118, 244-245).

    Args:
        place: Between the ray's ends, in the spacing's unit.
        near, far: The ends, in distances where they are equally spaced, and otherwise as `spacing` returns them.
        piecewise: Whether they are spaced by `spacing`.
    """
    place = place * far + (1.0 - place) * near
    if not piecewise:
        return place
    return 2.0 * place if place < 0.5 else 1.0 / (2.0 - 2.0 * place)


def spacing(distance: float) -> float:
    """Place of a distance in the piecewise spacing: half of it below 1, above it 1 - 1 / (2 distance)."""
    return distance / 2.0 if distance < 1.0 else 1.0 - 1.0 / (2.0 * distance)


@njit(cache=True, error_model="numpy")
def sample_weights(distances, densities, weights):
    """Write the weights [n] of intervals from ``distances`` [n + 1] and ``densities`` [n] (rays.py:139-151)."""
    before = 0.0
    for i in range(weights.size):
        depth = (distances[i + 1] - distances[i]) * densities[i]
        weight = (1.0 - math.exp(-depth)) * math.exp(-before)
        # an interval of no length whose density overflows
        weights[i] = 0.0 if math.isnan(weight) else weight
        before += depth


@njit(cache=True, error_model="numpy")
def next_places(places, weights, quantiles, out):
    """Write the places ``out`` [m] of the next round's edges (ray_samplers.py:305-354, outside training).

    ``places`` [n + 1] are the edges of this round, from 0 to 1, ``weights`` [n] those of its intervals, ``quantiles``
    [m] ascending in (0, 1).
    """
    count = weights.size
    total = 0.0
    for i in range(count):
        total += weights[i] + HISTOGRAM_PADDING
    i, below, above = 0, 0.0, 0.0
    for k in range(quantiles.size):
        # the first interval whose upper end has more than the quantile
        while i < count and not above > quantiles[k]:
            below = above
            above = min(1.0, above + (weights[i] + HISTOGRAM_PADDING) / total)
            i += 1
        part = (quantiles[k] - below) / (above - below)
        part = 0.0 if math.isnan(part) else min(max(part, 0.0), 1.0)
        start = places[i - 1]
        out[k] = start + part * (places[i] - start)


@njit(cache=True, error_model="numpy")
def place_samples(grid, net, factor, ray, ends, piecewise, places, quantiles, buffers):
    """Return the places of the next round's edges on one ray, by one round of a proposal field: ``grid, net, factor``.

    ``ray`` [2, 3] is origin and direction; ``ends`` and ``piecewise`` as `distance_at` takes them; ``places`` [n + 1]
    the edges of this round, ``quantiles`` [m] of the next one's; ``buffers`` [2, most neurons] are overwritten.
    """
    count = places.size - 1
    distances, densities = np.empty(count + 1), np.empty(count)
    for i in range(count + 1):
        distances[i] = distance_at(places[i], ends[0], ends[1], piecewise)
    for i in range(count):
        both = distances[i] + distances[i + 1]
        x, y, z = ray[0] + ray[1] * both / 2.0
        densities[i] = field_density(grid, net, factor, x, y, z, buffers[0], buffers[1])
    weights = np.empty(count)
    sample_weights(distances, densities, weights)
    following = np.empty(quantiles.size)
    next_places(places, weights, quantiles, following)
    return following


@njit(cache=True, error_model="numpy")
def color_samples(grid, density_net, color_net, factor, ray, distances, last, buffers, weights, colors):
    """Write ``weights`` [n] and ``colors`` [n, 3] of the picture's samples on one ray; 0 without weight.

    ``ray`` [2, 3] is origin and direction, ``distances`` [n + 1] the edges. With ``last`` the last sample's colour
    counts whatever its weight; ``buffers`` [3, most neurons] are overwritten.
    """
    count = weights.size
    densities, features = np.empty(count), np.empty((count, density_net.widths[-1]))
    for i in range(count):
        both = distances[i] + distances[i + 1]
        x, y, z = ray[0] + ray[1] * both / 2.0
        densities[i] = field_density(grid, density_net, factor, x, y, z, buffers[0], buffers[1])
        features[i] = buffers[1, : features.shape[1]]
    sample_weights(distances, densities, weights)
    directions = np.empty(16)
    harmonics(ray[1, 0], ray[1, 1], ray[1, 2], directions)
    for i in range(count):
        colors[i] = 0.0
        if weights[i] == 0.0 and not (last and i == count - 1):
            continue
        buffers[0, :16] = directions
        buffers[0, 16 : 15 + features.shape[1]] = features[i, 1:]
        evaluate_net(color_net, buffers[0], buffers[1])
        for c in range(3):
            color = 1.0 / (1.0 + math.exp(-buffers[1, c]))
            # renderers.py:225
            colors[i, c] = 0.0 if math.isnan(color) else color
