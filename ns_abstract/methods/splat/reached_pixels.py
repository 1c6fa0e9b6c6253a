"""Finds the pixels of a block that a Gaussian may reach, as bit sets."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import REGION
from ns_abstract.arithmetic.simd.intrinsics import lowest_bit, offset_by, signed
from ns_abstract.arithmetic.simd.lanes import load8, maximum, minimum, root, spans, where
from ns_abstract.methods.splat.lists import BLOCK
from ns_abstract.methods.splat.pixel_block import NUMBERS
from ns_abstract.methods.splat.projection_errors import EXPONENT_LIMIT, FORMS, MEAN_X, MEAN_Y, SPREAD, UNBOUNDED

#: Pixel q of a block lies in row q >> ROW_SHIFT; sets of pixels are the bits of an int64.
ROW_SHIFT = BLOCK.bit_length() - 1


@njit(cache=True, error_model="numpy")
def _pixels_within(record, ox, oy, left, right, top, bottom, m, per_pixel):
    """Return the set of pixels of a range where the exponent may be low enough for the alpha threshold.

    Row by row, sigma >= (near1^2 + near2^2)/2 bounds the columns, where near1 and near2 are lower bounds of |y1| and
    |y2| (design.md, B2). (ox, oy) is the offset of the block's first pixel from the mean.
    """
    inside = ((2 << (bottom * BLOCK + BLOCK - 1)) - 1) & ~((1 << (top * BLOCK)) - 1)
    unbounded = record[UNBOUNDED] != 0.0
    p, c, g, w1, w2 = 0.0, 0.0, 0.0, 0.0, 0.0
    spread1, spread2 = np.inf, np.inf
    if not unbounded:
        stride = m + 1
        p = record[FORMS]
        c = record[FORMS + stride]
        g = record[FORMS + 2 * stride]
        w1 = record[FORMS + 3 * stride]
        w2 = record[FORMS + 4 * stride]
        x = max(abs(ox + left), abs(ox + right))
        y = max(abs(oy + top), abs(oy + bottom))
        spread1 = (record[SPREAD] * x + record[SPREAD + 1] * y + record[SPREAD + 3]) * REGION
        spread2 = (record[SPREAD + 2] * y + record[SPREAD + 4]) * REGION
    # without a bound on the columns the whole rows are taken
    numbers = load8(per_pixel, NUMBERS)
    start = float(left) + 0.0 * numbers
    stop = float(right) + 0.0 * numbers
    if p > 0.0 and spread1 < np.inf and spread2 < np.inf:
        inverse = 1.0 / p
        ay = oy + numbers
        near = maximum(0.0, abs(g * ay - w2) - spread2)
        rest = 2.0 * record[EXPONENT_LIMIT] * REGION - near * near * (2.0 - REGION)
        half = (root(maximum(rest, 0.0)) + spread1) * inverse * REGION
        center = (c * ay + w1) * inverse - ox
        slack = (REGION - 1.0) * (abs(center) + abs(ox) + half)
        start = maximum(start, center - half - slack)
        stop = where(rest >= 0.0, minimum(stop, center + half + slack), -1.0)
    return spans(minimum(float(BLOCK), start), maximum(-1.0, stop)) & inside


@njit(cache=True, error_model="numpy")
def _pixels_of(record, box, x0, y0, m, per_pixel):
    """Return the set of a block's pixels on which a Gaussian may reach the alpha threshold."""
    left = int(math.ceil(min(max(box[0] - 0.5 - x0, 0.0), float(BLOCK))))
    right = int(math.floor(min(max(box[1] - 0.5 - x0, -1.0), BLOCK - 1.0)))
    top = int(math.ceil(min(max(box[2] - 0.5 - y0, 0.0), float(BLOCK))))
    bottom = int(math.floor(min(max(box[3] - 0.5 - y0, -1.0), BLOCK - 1.0)))
    if top > bottom or left > right:
        return 0
    ox, oy = x0 + 0.5 - record[MEAN_X], y0 + 0.5 - record[MEAN_Y]
    return signed(_pixels_within(record, ox, oy, left, right, top, bottom, m, per_pixel))


@njit(cache=True, error_model="numpy", forceinline=True)
def pixels_once(k, listed, entries, per_pixel):
    """Return `_pixels_of` list position k, computed at first use."""
    if entries.has_pixels[k] == 0:
        entries.has_pixels[k] = 1
        i = listed.numbers[k]
        entries.pixels[k] = _pixels_of(
            offset_by(listed.record, i * listed.columns), offset_by(listed.box, 4 * i), listed.x0, listed.y0, listed.m,
            per_pixel,
        )  # fmt: skip
    return entries.pixels[k]


@njit(cache=True, error_model="numpy")
def pixels_at(lanes, pixels):
    """Return the set of the pixels whose numbers are in ``pixels`` in these ``lanes``, a bit set."""
    at = 0
    while lanes != 0:
        at |= 1 << int(pixels[lowest_bit(lanes)])
        lanes &= lanes - 1
    return signed(at)
