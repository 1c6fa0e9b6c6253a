"""Kernels that propagate batches small enough for a core's cache through all layers (design.md, F4, F5)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.simd.lanes import LINE
from ns_abstract.methods.nerf import relu_kernel
from ns_abstract.methods.nerf.layer_kernel import LayerOutput, LayerWeights, linear
from ns_abstract.methods.nerf.layer_polynomials import PostActivation
from ns_abstract.methods.nerf.relu_kernel import relu

#: Pieces that go through all layers together.
CHUNK = 16


class StackedLayers(NamedTuple):
    """All layers of a network in flat arrays, so that one compiled kernel serves any depth; made by `stacked`.

    Attributes:
        shapes: [L, 3] rows that belong to an encoded vector, to neurons, and outputs.
        begins: [L, 3] where a layer begins in ``wide`` and ``columns``, in ``absolute``, and in ``bias``.
        wide, columns, absolute, bias: Those of `layer_kernel.LayerWeights`, rows of an encoded vector first.
        rounding: [L].
        narrow, underflow: Of all layers.
    """

    shapes: np.ndarray
    begins: np.ndarray
    wide: np.ndarray
    columns: np.ndarray
    absolute: np.ndarray
    bias: np.ndarray
    rounding: np.ndarray
    narrow: float
    underflow: float

    def none(self) -> StackedLayers:
        """Return an empty stack of layers, with columns of the same type."""
        return self._replace(shapes=self.shapes[:0], begins=self.begins[:0])


def stacked(layers: Sequence[LayerWeights]) -> StackedLayers:
    """Return ``layers``, at least one, whose columns have one type, concatenated."""
    shapes = np.array([(len(w.seen), len(w.wide), len(w.bias)) for w in layers], np.int64)
    wide = [part.ravel() for w in layers for part in (w.seen, w.wide)]
    # nobody multiplies columns by rows of an encoded vector
    columns = [part.astype(w.columns.dtype).ravel() for w in layers for part in (w.seen, w.columns)]
    absolute = [part.ravel() for w in layers for part in (w.seen_absolute, w.absolute)]
    sizes = [(w.seen.size + w.wide.size, w.seen_absolute.size + w.absolute.size, len(w.bias)) for w in layers]
    begins = np.concatenate([np.zeros((1, 3), np.int64), np.cumsum(np.array(sizes, np.int64), axis=0)[:-1]])
    return StackedLayers(
        shapes, begins, _joined(wide), _joined(columns), _joined(absolute), _joined([w.bias for w in layers]),
        np.array([w.rounding for w in layers]), layers[0].narrow, layers[0].underflow,
    )  # fmt: skip


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    """Return ``parts`` concatenated, beginning at a cache line."""
    size, kind = sum(part.size for part in parts), parts[0].dtype
    room = np.empty(size + LINE // kind.itemsize, kind)
    first = -room.ctypes.data % LINE // kind.itemsize
    return np.concatenate(parts, out=room[first : first + size])


class FieldOutputs(NamedTuple):
    """Results of the last layer for B pieces: polynomials [B, m, n], sums of absolute columns and box [B, n]."""

    poly: np.ndarray
    sums: np.ndarray
    box: np.ndarray


class Workspace(NamedTuple):
    """Scratch for CHUNK pieces behind a ``layer`` and its ``activation``, sized for the widest layer."""

    layer: LayerOutput
    activation: relu_kernel.ReluOutput


@njit(cache=True, error_model="numpy")
def _workspace(m, n, columns, kind):
    """Return a `Workspace` for layers of at most n neurons, m coefficients and ``columns`` columns."""
    k = CHUNK * n
    layer = LayerOutput(
        np.empty(m * k), np.empty(columns * n, kind), np.empty(columns, np.int64), np.empty(k), np.empty(k)
    )  # fmt: skip
    activation = relu_kernel.ReluOutput(
        np.empty(k), np.empty(k), np.empty(k), np.empty(CHUNK, np.bool_), np.empty(CHUNK, np.int64),
        np.empty(k, np.int64), np.empty(k, np.int64), np.empty(k),
    )  # fmt: skip
    return Workspace(layer, activation)


@njit(cache=True, error_model="numpy")
def _table(flat, rows, n):
    """Return the first ``rows`` of n numbers each."""
    return flat[: rows * n].reshape((rows, n))


@njit(cache=True, error_model="numpy")
def _layer(layers, i):
    """Return layer i as `layer_kernel.LayerWeights`."""
    seen_inputs, inputs, n = layers.shapes[i]
    first, second, third = layers.begins[i]
    rows, stride = seen_inputs + inputs, n + -n % (LINE // 2)
    wide = layers.wide[first : first + rows * stride].reshape((rows, stride))
    columns = layers.columns[first : first + rows * stride].reshape((rows, stride))
    absolute = layers.absolute[second : second + rows * n].reshape((rows, n))
    return LayerWeights(
        wide[:seen_inputs],
        absolute[:seen_inputs],
        wide[seen_inputs:],
        columns[seen_inputs:],
        absolute[seen_inputs:],
        layers.bias[third : third + n],
        layers.rounding[i],
        layers.narrow,
        layers.underflow,
    )


@njit(cache=True, error_model="numpy")
def _step(z, encoded, remainder, weights, grid, limit, room):
    """Propagate the pieces ``z`` through one layer and its activation; return the result, stored in ``room``."""
    (pieces, m, _), n = z.poly.shape, weights.bias.shape[0]
    poly, columns, owner, sums, box = room.layer
    slope, size, spread, failed, count, piece, neuron, error = room.activation
    layer = LayerOutput(
        poly[: pieces * m * n].reshape((pieces, m, n)), _table(columns, owner.shape[0], n), owner,
        _table(sums, pieces, n), _table(box, pieces, n),
    )  # fmt: skip
    total = linear(z, encoded, remainder, weights, layer)
    activation = relu_kernel.ReluOutput(
        _table(slope, pieces, n), _table(size, pieces, n), _table(spread, pieces, n), failed[:pieces], count[:pieces],
        piece, neuron, error,
    )  # fmt: skip
    new = relu(relu_kernel.ReluInput(layer.poly, layer.sums, layer.box, z.failed, z.count), grid, limit, activation)
    return PostActivation(
        layer.poly, activation.size, activation.spread, layer.box, activation.slope, activation.failed,
        activation.count, layer.columns[:total], owner[:total], piece[:new], neuron[:new], error[:new],
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _copy(source, target):
    """Copy ``source`` to ``target`` of the same size; an assignment would check every index."""
    flat, result = source.reshape(-1), target.reshape(-1)
    for i in range(flat.shape[0]):
        result[i] = flat[i]


@njit(cache=True, error_model="numpy")
def _piecewise(z, first, new, begin, past):
    """Return pieces ``begin`` to ``past`` of ``z``, and where the next piece's columns begin.

    Their columns, and the columns of one neuron, begin at ``first`` and ``new``. Owners are numbered from 0 on.
    """
    last, latest = first, new
    while last < z.owner.shape[0] and z.owner[last] < past:
        last += 1
    while latest < z.new_owner.shape[0] and z.new_owner[latest] < past:
        latest += 1
    return (
        PostActivation(
            z.poly[begin:past], z.size[begin:past], z.spread[begin:past], z.box[begin:past], z.slope[begin:past],
            z.failed[begin:past], z.count[begin:past], z.columns[first:last], z.owner[first:last] - begin,
            z.new_owner[new:latest] - begin, z.new_neuron[new:latest], z.new_size[new:latest],
        ),
        last,
        latest,
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _keep(found, begin, out, columns, terms):
    """Append the columns and new error terms of ``found`` to ``out``, as pieces from ``begin`` on.

    Returns:
        Where the next ones begin.
    """
    # arrays of a record are counted each time they are taken out of it
    source, owner, failed, target, owners = found.columns, found.owner, found.failed, out.columns, out.owner
    for c in range(owner.shape[0]):
        if not failed[owner[c]]:
            for j in range(source.shape[1]):
                target[columns, j] = source[c, j]
            owners[columns] = owner[c] + begin
            columns += 1
    new_owner, neuron, size = found.new_owner, found.new_neuron, found.new_size
    new_owners, neurons, sizes = out.new_owner, out.new_neuron, out.new_size
    for c in range(new_owner.shape[0]):
        if not failed[new_owner[c]]:
            new_owners[terms], neurons[terms], sizes[terms] = new_owner[c] + begin, neuron[c], size[c]
            terms += 1
    return columns, terms


@njit(cache=True, error_model="numpy")
def through_layers(z, encoded, remainder, layers, last, grid, limit, out, outputs):
    """Return layers with their activations and a last one without, the pieces in the order in which they are given.

    Args:
        z: `PostActivation` of B pieces.
        encoded, remainder: [B, m, k] and [B, k] of the vector that layers see (`layer_kernel.linear`).
        layers, last: `StackedLayers`; at most one is last, which sees no encoded vector.
        grid, limit: See `relu_kernel.relu`.
        out: `PostActivation` behind ``layers``; room for [B limit, n] columns and [B n] new error terms.
        outputs: `FieldOutputs` of the last layer, filled.

    Returns:
        Numbers of columns and of new error terms.
    """
    pieces, m = z.poly.shape[:2]
    widest = layers.shapes[:, 2].max()
    if last.shapes.shape[0]:
        widest = max(widest, last.shapes[0, 2])
    rows, kind = CHUNK * limit, z.columns.dtype
    here, there = _workspace(m, widest, rows, kind), _workspace(m, widest, rows, kind)
    first, new, columns, terms = 0, 0, 0, 0
    for begin in range(0, pieces, CHUNK):
        past = min(begin + CHUNK, pieces)
        piece_layers, first, new = _piecewise(z, first, new, begin, past)
        for i in range(layers.shapes.shape[0]):
            piece_layers = _step(
                piece_layers, encoded[begin:past], remainder[begin:past], _layer(layers, i), grid, limit, here
            )
            here, there = there, here
        if last.shapes.shape[0]:
            # its columns are of no use but for their sums; ``here`` is free
            weights, n = _layer(last, 0), last.shapes[0, 2]
            columns_there, owner = _table(here.layer.columns, rows, n), here.layer.owner
            poly, sums, box = outputs.poly[begin:past], outputs.sums[begin:past], outputs.box[begin:past]
            behind = LayerOutput(poly, columns_there, owner, sums, box)
            linear(piece_layers, encoded[begin:past], remainder[begin:past], weights, behind)
        _copy(piece_layers.poly, out.poly[begin:past])
        _copy(piece_layers.size, out.size[begin:past])
        _copy(piece_layers.spread, out.spread[begin:past])
        _copy(piece_layers.box, out.box[begin:past])
        _copy(piece_layers.slope, out.slope[begin:past])
        _copy(piece_layers.failed, out.failed[begin:past])
        _copy(piece_layers.count, out.count[begin:past])
        columns, terms = _keep(piece_layers, begin, out, columns, terms)
    return columns, terms
