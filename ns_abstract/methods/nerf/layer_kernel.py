"""Linear layers of `ns_abstract.methods.nerf.zonotope` on a CPU, compiled: what is off costs nothing (design.md, F4).

About half of a field's neurons are off on all of a piece. Each piece's products run over the other rows of the weight
alone, which are packed once for its polynomials and columns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

#: Rows of a product that are worked on together, and inputs: written out in `multiply`.
STEP = 4
#: Inputs whose rows of the weight stay in a core's first cache while all rows pass them (32 KiB of 256 float32).
BLOCK = 32


@njit(cache=True, error_model="numpy")
def multiply(rows, live, scale, packed, tile, out, sums):
    """``out[r] = sum_i rows[r, live[i]] scale[i] packed[i]``, and ``sums`` grows by its absolute values.

    Products and sums apart, four rows by four inputs at once: no dot product's order of summation matters here, and a
    processor's wide registers are filled without leave to reorder anything.

    Args:
        rows: [R, inputs].
        live, scale: [k] inputs and what they are multiplied by; k a multiple of 4.
        packed: [k, n].
        tile: [4, n] scratch.
        out: [R, n].
        sums: [n] float64.
    """
    count, n = out.shape
    if n < STEP:
        # a density or a colour
        for r in range(count):
            for j in range(n):
                tile[0, j] = 0.0
                for i in range(live.shape[0]):
                    tile[0, j] += rows[r, live[i]] * scale[i] * packed[i, j]
                out[r, j] = tile[0, j]
                sums[j] += abs(tile[0, j])
        return
    t0, t1, t2, t3 = tile[0], tile[1], tile[2], tile[3]
    for begin in range(0, max(live.shape[0], 1), BLOCK):
        past = min(begin + BLOCK, live.shape[0])
        for r0 in range(0, count, 4):
            r1, r2, r3 = min(r0 + 1, count - 1), min(r0 + 2, count - 1), min(r0 + 3, count - 1)
            for r in range(4):
                for j in range(n):
                    tile[r, j] = out[min(r0 + r, count - 1), j] if begin else 0.0
            for i in range(begin, past, 4):
                p0, p1, p2, p3 = packed[i], packed[i + 1], packed[i + 2], packed[i + 3]
                j0, j1, j2, j3 = live[i], live[i + 1], live[i + 2], live[i + 3]
                s0, s1, s2, s3 = scale[i], scale[i + 1], scale[i + 2], scale[i + 3]
                a00, a01, a02, a03 = rows[r0, j0] * s0, rows[r0, j1] * s1, rows[r0, j2] * s2, rows[r0, j3] * s3
                a10, a11, a12, a13 = rows[r1, j0] * s0, rows[r1, j1] * s1, rows[r1, j2] * s2, rows[r1, j3] * s3
                a20, a21, a22, a23 = rows[r2, j0] * s0, rows[r2, j1] * s1, rows[r2, j2] * s2, rows[r2, j3] * s3
                a30, a31, a32, a33 = rows[r3, j0] * s0, rows[r3, j1] * s1, rows[r3, j2] * s2, rows[r3, j3] * s3
                for j in range(n):
                    x0, x1, x2, x3 = p0[j], p1[j], p2[j], p3[j]
                    t0[j] += a00 * x0 + a01 * x1 + (a02 * x2 + a03 * x3)
                    t1[j] += a10 * x0 + a11 * x1 + (a12 * x2 + a13 * x3)
                    t2[j] += a20 * x0 + a21 * x1 + (a22 * x2 + a23 * x3)
                    t3[j] += a30 * x0 + a31 * x1 + (a32 * x2 + a33 * x3)
            for r in range(r0, min(r0 + 4, count)):
                for j in range(n):
                    out[r, j] = tile[r - r0, j]
    for r in range(count):
        for j in range(n):
            sums[j] += abs(out[r, j])


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
        wide, weight: [inputs, n] for polynomials, float64, and for columns, of their type.
        out: `Product`, filled.
    """
    inputs, n = wide.shape
    live, gain = np.empty(inputs + STEP, np.int64), np.empty(inputs + STEP, weight.dtype)
    ones = np.ones(inputs + STEP, np.float64)
    packed, packed_wide = np.empty((inputs + STEP, n), weight.dtype), np.empty((inputs + STEP, n), np.float64)
    tile, tile_wide = np.empty((STEP, n), weight.dtype), np.empty((STEP, n), np.float64)
    unused = np.zeros(n)
    place = 0
    for b in range(poly.shape[0]):
        count = 0
        for j in range(inputs):
            if size[b, j] != 0.0:
                live[count] = j
                gain[count] = terms.slope[b, j]
                for i in range(n):
                    packed_wide[count, i] = wide[j, i]
                    packed[count, i] = weight[j, i]
                count += 1
        # rows of zeros fill up the last step
        while count % STEP != 0:
            live[count], gain[count] = live[0], 0.0
            packed_wide[count], packed[count] = 0.0, 0.0
            count += 1
        multiply(poly[b], live[:count], ones[:count], packed_wide, tile_wide, out.poly[b], unused)
        sums, first = out.sums[b], place
        sums[:] = 0.0
        columns = terms.columns[terms.begin[b] : terms.begin[b + 1]]
        place += columns.shape[0]
        multiply(columns, live[:count], gain[:count], packed, tile, out.columns[first:place], sums)
        for c in range(terms.new_begin[b], terms.new_begin[b + 1]):
            for j in range(n):
                out.columns[place, j] = terms.new_size[c] * wide[terms.new_neuron[c], j]
                sums[j] += abs(out.columns[place, j])
            place += 1
        out.owner[first:place] = b
