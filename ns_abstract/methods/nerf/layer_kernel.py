"""Linear layers of `ns_abstract.methods.nerf.zonotope` on a CPU, compiled: what is off costs nothing (design.md, F4).

About half of a field's neurons are off on all of a piece. Each piece's products run over the other rows of the weight
alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.simd.intrinsics import pointer
from ns_abstract.arithmetic.simd.lanes import LINE, load_line, store
from ns_abstract.arithmetic.simd.products import ROWS, four_rows

#: Rows of a product that pass a line of the weight while it stays in a core's first cache; a multiple of `ROWS`.
BLOCK = 32


@njit(cache=True, error_model="numpy")
def multiply(x, live, scale, weight, factors, rest, out):
    """``out[r] = sum_i x[r, live[i]] scale[i] weight[live[i]]``.

    Args:
        x: [R, inputs].
        live, scale: [k] inputs, and what they are multiplied by first.
        weight: [inputs, n and more, to whole lines].
        factors: [BLOCK inputs] scratch.
        rest: [ROWS, a line] scratch.
        out: [R, n].
    """
    (count, n), stride, lanes, k = out.shape, weight.shape[1], LINE // weight.itemsize, live.shape[0]
    w, f, o, s, places = pointer(weight), pointer(factors), pointer(out), pointer(rest), pointer(live)
    rest[:] = 0.0
    nothing = load_line(s, 0)
    for begin in range(0, count, BLOCK):
        past = min(begin + BLOCK, count)
        for r0 in range(begin, past, ROWS):
            # the last row fills up the last step
            r1, r2, r3 = min(r0 + 1, count - 1), min(r0 + 2, count - 1), min(r0 + 3, count - 1)
            at = (r0 - begin) * k
            for i in range(k):
                j, g = live[i], scale[i]
                f[at], f[at + 1], f[at + 2], f[at + 3] = x[r0, j] * g, x[r1, j] * g, x[r2, j] * g, x[r3, j] * g
                at += ROWS
        for c in range(0, n, lanes):
            for r0 in range(begin, past, ROWS):
                t0, t1, t2, t3 = four_rows(f, (r0 - begin) * k, places, k, w, c, stride, nothing)
                if c + lanes <= n:
                    store(o, r0 * n + c, t0)
                    store(o, min(r0 + 1, count - 1) * n + c, t1)
                    store(o, min(r0 + 2, count - 1) * n + c, t2)
                    store(o, min(r0 + 3, count - 1) * n + c, t3)
                    continue
                store(s, 0, t0)
                store(s, lanes, t1)
                store(s, 2 * lanes, t2)
                store(s, 3 * lanes, t3)
                for r in range(r0, min(r0 + ROWS, count)):
                    for j in range(c, n):
                        out[r, j] = rest[r - r0, j - c]


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
        wide, weight: [inputs, n and more, to whole lines] for polynomials, float64, and for columns, of their type.
        out: `Product`, filled.
    """
    inputs, n = wide.shape[0], out.poly.shape[2]
    live, gain, ones = np.empty(inputs, np.int64), np.empty(inputs, weight.dtype), np.ones(inputs, np.float64)
    factors, factors_wide = np.empty(BLOCK * inputs, weight.dtype), np.empty(BLOCK * inputs, np.float64)
    rest = np.empty((ROWS, LINE // weight.itemsize), weight.dtype)
    rest_wide = np.empty((ROWS, LINE // wide.itemsize), np.float64)
    place = 0
    for b in range(poly.shape[0]):
        count = 0
        for j in range(inputs):
            if size[b, j] != 0.0:
                live[count], gain[count] = j, terms.slope[b, j]
                count += 1
        multiply(poly[b], live[:count], ones, wide, factors_wide, rest_wide, out.poly[b])
        first = place
        columns = terms.columns[terms.begin[b] : terms.begin[b + 1]]
        place += columns.shape[0]
        multiply(columns, live[:count], gain, weight, factors, rest, out.columns[first:place])
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
