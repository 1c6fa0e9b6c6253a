"""Linear layers of `ns_abstract.methods.nerf.zonotope` on a CPU, compiled (docs/dev/design.md, F4).

About half of a field's neurons are inactive over a whole sub-box. Its products run over the weight's other rows alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import BIAS_ROUNDING, FIELD_UP, NARROW_STEPS
from ns_abstract.arithmetic.simd.intrinsics import pointer
from ns_abstract.arithmetic.simd.lanes import LINE, load_line
from ns_abstract.arithmetic.simd.products import ROWS, rows_from, store_rows, sums_of_rows

#: Rows of a product that pass a line of the weight while it stays in a core's first cache; a multiple of `ROWS`.
BLOCK = 36


@njit(cache=True, error_model="numpy")
def multiply(x, live, weight, rest, out):
    """Compute ``out[r] = sum_i x[r, live[i]] weight[live[i]]`` for ``x`` [R, inputs] and ``live`` [k] of the inputs.

    ``weight`` is [inputs, n and more, to whole pairs of lines], ``out`` [R, n], ``rest`` [ROWS, two lines] scratch.
    """
    (count, n), (inputs, stride) = out.shape, weight.shape
    line, k = LINE // weight.itemsize, live.shape[0]
    w, f, o, s, places = pointer(weight), pointer(x), pointer(out), pointer(rest), pointer(live)
    rest[:] = 0.0
    nothing, pair = load_line(s, 0), 2 * line
    for begin in range(0, count, BLOCK):
        for c in range(0, n, pair):
            for first in range(begin, min(begin + BLOCK, count), ROWS):
                sums = sums_of_rows(f, rows_from(first, count - 1, inputs), places, k, w, c, stride, line, nothing)
                if c + pair <= n:
                    store_rows(o, rows_from(first, count - 1, n), c, line, sums)
                    continue
                store_rows(s, rows_from(0, ROWS - 1, pair), 0, line, sums)
                for r in range(first, min(first + ROWS, count)):
                    for j in range(c, n):
                        out[r, j] = rest[r - first, j - c]


class LayerWeights(NamedTuple):
    """A layer.

    Attributes:
        seen, seen_absolute: [k, n and more, to whole pairs of lines] and [k, n]: of an encoded vector, or of none.
        wide, columns: [inputs, n and more, to whole pairs of lines] for polynomials, float64, and for columns, of their
            type.
        absolute: [inputs, n] float64.
        bias: [n].
        rounding: Relative error of a sum over the layer.
        narrow: Relative error of one rounding of columns, where it is not in ``rounding``, or 0.
        underflow: Absolute error of columns before and behind the layer.
    """

    seen: np.ndarray
    seen_absolute: np.ndarray
    wide: np.ndarray
    columns: np.ndarray
    absolute: np.ndarray
    bias: np.ndarray
    rounding: float
    narrow: float
    underflow: float


class LayerOutput(NamedTuple):
    """B pieces behind a layer.

    Attributes:
        poly: [B, m, n].
        columns, owner: [C + N, n] of the columns' type and [C + N] their pieces, ascending; those of pieces that failed
            are left out.
        sums: [B, n] float64 sums of the absolute columns.
        box: [B, n].
    """

    poly: np.ndarray
    columns: np.ndarray
    owner: np.ndarray
    sums: np.ndarray
    box: np.ndarray


@njit(cache=True, error_model="numpy")
def _columns(b, z, first, new, live, weights, scratch, out, place):
    """Compute the columns of the piece ``b`` behind a layer, from ``place`` on, and their sums.

    ``first``, ``new``: where its columns, and those of one neuron, begin in ``z``. ``scratch``: [BLOCK, inputs],
    [inputs] and [ROWS, two lines] of the columns' type. Returns where those of the next piece begin, in ``z`` and
    behind the layer.
    """
    scaled, slope, rest = scratch
    # arrays of a record are counted each time they are taken out of it
    owner, columns, new_owner, before, wide = z.owner, z.columns, z.new_owner, z.slope[b], weights.wide
    new_neuron, new_size, result, sums = z.new_neuron, z.new_size, out.columns, out.sums[b]
    inputs, n, begin = scaled.shape[1], out.sums.shape[1], place
    if z.failed[b]:
        while first < owner.shape[0] and owner[first] == b:
            first += 1
        while new < new_owner.shape[0] and new_owner[new] == b:
            new += 1
    for j in range(inputs):
        slope[j] = before[j]
    while first < owner.shape[0] and owner[first] == b:
        count = 0
        while count < BLOCK and first < owner.shape[0] and owner[first] == b:
            for j in range(inputs):
                scaled[count, j] = columns[first, j] * slope[j]
            count += 1
            first += 1
        multiply(scaled[:count], live, weights.columns, rest, result[place : place + count])
        place += count
    while new < new_owner.shape[0] and new_owner[new] == b:
        size, neuron = new_size[new], new_neuron[new]
        for j in range(n):
            result[place, j] = size * wide[neuron, j]
        place += 1
        new += 1
    sums[:] = 0.0
    for c in range(begin, place):
        for j in range(n):
            sums[j] += abs(result[c, j])
    out.owner[begin:place] = b
    return first, new, place


@njit(cache=True, error_model="numpy")
def _box(b, z, encoded, remainder, live, weights, box):
    """Compute the ``box`` [n] of piece ``b`` behind a layer, without its bias: propagated box, and rounding (F4)."""
    size, before, spread, n = z.size[b], z.box[b], z.spread[b], box.shape[0]
    rounding, underflow, absolute, seen_absolute = (
        weights.rounding,
        weights.underflow,
        weights.absolute,
        weights.seen_absolute,
    )
    narrow = (live.shape[0] + NARROW_STEPS) * weights.narrow
    box[:] = underflow
    for j in live:
        radius = (size[j] + before[j]) * rounding + before[j]
        radius += narrow * spread[j] + underflow
        for k in range(n):
            box[k] += radius * absolute[j, k]
    if not seen_absolute.shape[0]:
        return
    poly, rest = encoded[b], remainder[b]
    whole = rest.copy()
    for k in range(poly.shape[0]):
        for j in range(whole.shape[0]):
            whole[j] += abs(poly[k, j])
    for j in range(whole.shape[0]):
        radius = rest[j] + rounding * whole[j]
        for k in range(n):
            box[k] += radius * seen_absolute[j, k]


@njit(cache=True, error_model="numpy")
def linear(z, encoded, remainder, weights, out):
    """Compute a linear layer, piece by piece; return the number of columns behind it (design.md, F4).

    Args:
        z: `PostActivation` in arrays, columns of the type that they are multiplied in.
        encoded, remainder: [B, m, k] and [B, k] polynomials and remainders of an encoded vector, if the layer sees it.
        out: `LayerOutput`, filled; its columns and owners may be larger.
    """
    inputs, n = weights.absolute.shape
    live_inputs, kind = np.empty(inputs, np.int64), weights.columns.dtype
    rest_wide = np.empty((ROWS, 2 * LINE // weights.wide.itemsize), np.float64)
    scratch = (
        np.empty((BLOCK, inputs), kind), np.empty(inputs, kind),
        np.empty((ROWS, 2 * LINE // weights.columns.itemsize), kind),
    )  # fmt: skip
    every, bias_absolute, bias = np.arange(weights.seen.shape[0]), np.empty((z.poly.shape[1], n)), weights.bias
    first, new, place = 0, 0, 0
    for b in range(z.poly.shape[0]):
        count, size = 0, z.size[b]
        for j in range(inputs):
            if size[j] != 0.0:
                live_inputs[count] = j
                count += 1
        live, poly, box = live_inputs[:count], out.poly[b], out.box[b]
        multiply(z.poly[b], live, weights.wide, rest_wide, poly)
        first, new, place = _columns(b, z, first, new, live, weights, scratch, out, place)
        _box(b, z, encoded, remainder, live, weights, box)
        if every.shape[0]:
            multiply(encoded[b], every, weights.seen, rest_wide, bias_absolute)
            for k in range(poly.shape[0]):
                for j in range(n):
                    poly[k, j] += bias_absolute[k, j]
        for j in range(n):
            poly[0, j] += bias[j]
            box[j] = (box[j] + BIAS_ROUNDING * (abs(bias[j]) + abs(poly[0, j]))) * FIELD_UP
    return place
