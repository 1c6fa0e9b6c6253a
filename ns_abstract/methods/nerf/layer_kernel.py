"""Linear layers of `ns_abstract.methods.nerf.zonotope` on a CPU, compiled: what is off costs nothing (design.md, F4).

About half of a field's neurons are off on all of a piece. Each piece's products run over the other rows of the weight
alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.simd.intrinsics import pointer
from ns_abstract.arithmetic.simd.lanes import LINE, load_line
from ns_abstract.arithmetic.simd.products import ROWS, four_rows, rows_from, store_rows

#: Rows of a product that pass a line of the weight while it stays in a core's first cache; a multiple of `ROWS`.
BLOCK = 32


@njit(cache=True, error_model="numpy")
def multiply(x, live, weight, rest, out):
    """``out[r] = sum_i x[r, live[i]] weight[live[i]]``.

    Args:
        x: [R, inputs].
        live: [k] inputs.
        weight: [inputs, n and more, to whole pairs of lines].
        rest: [ROWS, two lines] scratch.
        out: [R, n].
    """
    (count, n), (inputs, stride) = out.shape, weight.shape
    line, k = LINE // weight.itemsize, live.shape[0]
    w, f, o, s, places = pointer(weight), pointer(x), pointer(out), pointer(rest), pointer(live)
    rest[:] = 0.0
    nothing, pair = load_line(s, 0), 2 * line
    for begin in range(0, count, BLOCK):
        for c in range(0, n, pair):
            for first in range(begin, min(begin + BLOCK, count), ROWS):
                sums = four_rows(f, rows_from(first, count - 1, inputs), places, k, w, c, stride, line, nothing)
                if c + pair <= n:
                    store_rows(o, rows_from(first, count - 1, n), c, line, sums)
                    continue
                store_rows(s, rows_from(0, ROWS - 1, pair), 0, line, sums)
                for r in range(first, min(first + ROWS, count)):
                    for j in range(c, n):
                        out[r, j] = rest[r - first, j - c]


class Terms(NamedTuple):
    """Error terms of B pieces before a layer.

    Attributes:
        columns: [C, inputs] in the order of their pieces, of the type that they are multiplied in.
        begin: [B + 1] where the columns of each piece begin.
        slope: [B, inputs] what columns are multiplied by first.
        new_begin, new_neuron, new_size: [B + 1], [N], [N] those that move one neuron only, likewise.
    """

    columns: np.ndarray
    begin: np.ndarray
    slope: np.ndarray
    new_begin: np.ndarray
    new_neuron: np.ndarray
    new_size: np.ndarray


class Product(NamedTuple):
    """B pieces behind a layer.

    Attributes:
        poly: [B, m, n].
        columns, owner: [C + N, n] of the columns' type and [C + N] their pieces, in order.
        sums: [B, n] float64 sums of the absolute columns.
    """

    poly: np.ndarray
    columns: np.ndarray
    owner: np.ndarray
    sums: np.ndarray


@njit(cache=True, error_model="numpy")
def linear(poly, size, terms, wide, weight, out):
    """A linear layer without its bias, piece by piece (design.md, F4).

    Args:
        poly: [B, m, inputs].
        size: [B, inputs] 0 where a neuron is off: what the other arrays hold there is not looked at.
        terms: `Terms`.
        wide, weight: [inputs, n and more, to whole pairs of lines] for polynomials, float64, and for columns, of their type.
        out: `Product`, filled.
    """
    inputs, n = wide.shape[0], out.poly.shape[2]
    live, gain = np.empty(inputs, np.int64), np.empty(inputs, weight.dtype)
    scaled = np.empty((BLOCK, inputs), weight.dtype)
    rest = np.empty((ROWS, 2 * LINE // weight.itemsize), weight.dtype)
    rest_wide = np.empty((ROWS, 2 * LINE // wide.itemsize), np.float64)
    place = 0
    for b in range(poly.shape[0]):
        count = 0
        for j in range(inputs):
            if size[b, j] != 0.0:
                live[count] = j
                count += 1
            gain[j] = terms.slope[b, j]
        multiply(poly[b], live[:count], wide, rest_wide, out.poly[b])
        first = place
        for begin in range(terms.begin[b], terms.begin[b + 1], BLOCK):
            past = min(begin + BLOCK, terms.begin[b + 1])
            for c in range(begin, past):
                for j in range(inputs):
                    scaled[c - begin, j] = terms.columns[c, j] * gain[j]
            multiply(scaled[: past - begin], live[:count], weight, rest, out.columns[place : place + past - begin])
            place += past - begin
        for c in range(terms.new_begin[b], terms.new_begin[b + 1]):
            for j in range(n):
                out.columns[place, j] = terms.new_size[c] * wide[terms.new_neuron[c], j]
            place += 1
        sums = out.sums[b]
        sums[:] = 0.0
        for c in range(first, place):
            for j in range(n):
                sums[j] += abs(out.columns[c, j])
        out.owner[first:place] = b
