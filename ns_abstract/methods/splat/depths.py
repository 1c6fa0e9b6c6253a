"""Expected depth and accumulation of a block's pixels (docs/dev/design.md, D1-D4).

The fragments are those that `blend` composites; their colours are the depth, in the palette's fourth lane, and 1 in the
first lane for the accumulation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import (
    DEPTH_ROUNDING,
    FRAGMENT_ROUNDING,
    LAYER_ROUNDING,
    PIXEL_RANGE_ROUNDING,
    SECOND_ORDER,
    UP,
)
from ns_abstract.arithmetic.simd.intrinsics import lowest_bit, offset_by, signed
from ns_abstract.arithmetic.simd.lanes import maximum, minimum, store
from ns_abstract.methods.splat.blend import blend_quadratic, blend_several, flattened, form_range
from ns_abstract.methods.splat.lists import BLOCK
from ns_abstract.methods.splat.pixel_block import ALPHA_HIGH, FORM, OPEN, RHO, color_ends, color_size, listed_fragment

#: Lanes of accumulation and depth.
_SUM, DEPTH = 0, 3
#: Columns of `PixelBounds.layers`.
ACCUMULATION_LOW, ACCUMULATION_HIGH, DEPTH_LOW, DEPTH_HIGH = range(4)


class _Span(NamedTuple):
    """Differences of a pixel's depths to their reference, and their magnitude.

    Attributes:
        nearest, farthest: Least and greatest difference.
        largest: Greatest magnitude of a depth relative to the common form.
    """

    nearest: float
    farthest: float
    largest: float


@njit(cache=True, error_model="numpy", forceinline=True)
def _set_reference(begin, end, fragments, palette, reference, m):
    """Write the reference of a pixel: the mean of its depths' polynomials, weighted as at the cell's middle (D2)."""
    values, colors, forms = fragments.values, palette.values, palette.forms
    for k in range(m):
        reference[k] = 0.0
    light, total = 1.0, 0.0
    for entry in range(begin, end):
        at, key, _ = listed_fragment(fragments, entry, forms)
        weight = light * min(max(values[at + FORM], 0.0), values[at + ALPHA_HIGH])
        light -= weight
        total += weight
        for k in range(m):
            reference[k] += weight * colors[key + 4 * k + DEPTH]
    if total > 0.0:
        for k in range(m):
            reference[k] /= total


@njit(cache=True, error_model="numpy", forceinline=True)
def _shift_depths(begin, end, block, reference, m):
    """Fill the palette ``block.shifted`` with a pixel's depths less the reference, and 1; return its `_Span`.

    The changes of colours by reordering are removed from their rows of moves.
    """
    fragments, palette, moves = block.fragments, block.palette, block.reordering.moves
    forms, colors, shifted = palette.forms, palette.values, block.shifted.values
    nearest, farthest, largest = np.inf, -np.inf, 0.0
    for entry in range(begin, end):
        _, key, move = listed_fragment(fragments, entry, forms)
        for r in range(color_size(forms)):
            shifted[key + r] = 0.0
        radius, spread = colors[key + 4 * forms + DEPTH], 0.0
        for k in range(m):
            coefficient = colors[key + 4 * k + DEPTH]
            change = coefficient - reference[k]
            shifted[key + 4 * k + DEPTH] = change
            # the difference's rounding
            radius += FRAGMENT_ROUNDING * (abs(coefficient) + abs(reference[k]))
            spread += abs(change) if k > 0 else 0.0
        shifted[key + 4 * forms + DEPTH] = radius
        spread = (spread + radius) * UP
        ends = key + color_ends(forms)
        low, high = shifted[key + DEPTH] - spread, shifted[key + DEPTH] + spread
        shifted[ends + DEPTH], shifted[ends + 4 + DEPTH] = low, high
        shifted[key + _SUM] = shifted[ends + _SUM] = shifted[ends + 4 + _SUM] = 1.0
        nearest, farthest = min(nearest, low), max(farthest, high)
        largest = max(largest, abs(colors[ends + DEPTH]), abs(colors[ends + 4 + DEPTH]))
        if move != 0:
            for lane in range(DEPTH):
                moves[move + lane] = 0.0
                moves[move + 4 + lane] = 0.0
    return _Span(nearest, farthest, largest)


@njit(cache=True, error_model="numpy", forceinline=True)
def _range(polynomial, order, m):
    """Return the range over the box of a polynomial of ``m`` coefficients, rounded outward (design.md, A4)."""
    middle, size = polynomial[0], 0.0
    for k in range(1, m):
        size += abs(polynomial[k])
    low, high = middle - size, middle + size
    if order == 2:
        slope, bend = abs(polynomial[1]), polynomial[2]
        low, high = middle + min(bend - slope, 0.0), middle + max(bend + slope, 0.0)
        if slope < 2.0 * abs(bend):
            vertex = middle - 0.25 * slope * slope / bend
            low, high = min(low, vertex), max(high, vertex)
    room = PIXEL_RANGE_ROUNDING * (abs(middle) + size)
    return low - room, high + room


@njit(cache=True, error_model="numpy", forceinline=True)
def _weighted_mean(polynomials, radius, low, high, total_low, total_high, order, m):
    """Return bounds of a polynomial plus a weighted sum divided by the accumulation (design.md, D3).

    ``polynomials`` [2 m] are the polynomial, which is overwritten, and that of the sum, with the sum's ``radius``. The
    sum lies between ``low`` and ``high``; the accumulation, which is positive, between ``total_low`` and
    ``total_high``.
    """
    base_low, base_high = _range(polynomials, order, m)
    first_low = base_low + low / (total_low if low < 0.0 else total_high)
    first_high = base_high + high / (total_low if high > 0.0 else total_high)
    # to first order the sum is divided by one number
    factor = 2.0 / (total_low + total_high)
    for k in range(m):
        polynomials[k] += factor * polynomials[m + k]
    other_low, other_high = _range(polynomials, order, m)
    off = max(abs(low), abs(high)) * max(abs(1.0 / total_low - factor), abs(factor - 1.0 / total_high))
    room = 0.0
    for k in range(m):
        room += abs(polynomials[k]) + 2.0 * factor * abs(polynomials[m + k])
    off = (off + factor * radius) * UP + FRAGMENT_ROUNDING * (room + factor * max(abs(low), abs(high)))
    return max(first_low, other_low - off), min(first_high, other_high + off)


@njit(cache=True, error_model="numpy", forceinline=True)
def _blend_depths(begin, end, block, polynomials, by_lane, order, m):
    """Composite a pixel's shifted depths and accumulation: writes polynomials, then ends and radii by lane."""
    fragments, moves = block.fragments, block.reordering.moves
    if order == 2:
        blended = blend_quadratic(begin, end, fragments, block.shifted, moves, polynomials, block.crossings, False)
        r = blended.radius
    else:
        blended = blend_several(begin, end, fragments, block.shifted, moves, polynomials, m, block.crossings, False)
        r = flattened(polynomials, blended.radius, offset_by(polynomials, 4 * (m + fragments.bends)), m)
    ends = blended.ends
    r = r * (UP + LAYER_ROUNDING * (end - begin))
    bottom, top = form_range(polynomials, r, order, m)
    store(by_lane, 0, maximum(ends.low, bottom))
    store(by_lane, 4, minimum(ends.high, top))
    store(by_lane, 8, r)


@njit(cache=True, error_model="numpy", forceinline=True)
def _write(layers, total_low, total_high, low, high):
    layers[ACCUMULATION_LOW], layers[ACCUMULATION_HIGH] = total_low, total_high
    layers[DEPTH_LOW], layers[DEPTH_HIGH] = low, high


@njit(cache=True, error_model="numpy", forceinline=True)
def _expected_depth(result, radius, span, low, high, total_low, total_high, rounding, common, charges, order, m):
    """Return bounds of the expected depth where something is drawn; the upper one is infinite if not finite (D3, D4).

    ``result`` holds the reference, then the polynomial of the sum of weights times shifted depths, with its ``radius``;
    that sum lies between ``low`` and ``high``. Overwrites ``result``.
    """
    magnitude = 0.0
    for k in range(m):
        result[k] += common[k]
        magnitude += abs(common[k])
    magnitude = (magnitude + common[m]) * UP + span.largest
    # of the sums of weights times depths, and of the accumulation
    error = (rounding * total_high + rounding) * magnitude
    shift_low, shift_high = _range(result, order, m)
    low, high = _weighted_mean(result, radius + error, low - error, high + error, total_low, total_high, order, m)
    # a mean lies among what it is made of
    off = error / total_low * UP
    low, high = max(low, shift_low + span.nearest - off), min(high, shift_high + span.farthest + off)
    size = max(abs(low), abs(high))
    off = common[m] + charges.expected_depth * size + DEPTH_ROUNDING * (magnitude + size)
    low, high = low - off, high + off
    is_bounded = low <= high and math.isfinite(high - low)
    return max(low if is_bounded else 0.0, 0.0), high if is_bounded else np.inf


@njit(cache=True, error_model="numpy")
def shade_layers(pixels, left, above, block, inputs, bounds):
    """Write `PixelBounds.layers` of the ``pixels`` of a block that `shade` has composited (design.md, D1-D4).

    It reads the depths in lane `DEPTH` of the palette, and changes rows of moves, which are not used afterwards.
    """
    fragments, t = block.fragments, block.sums
    per_pixel, charges, cutoffs = fragments.per_pixel, inputs.charges, inputs.cutoffs
    order, m = inputs.shape.order, inputs.shape.monomials
    unseen = block.palette.unseen
    # behind what blending takes: ends and radii by lane, the reference, two polynomials of the result
    by_lane = offset_by(t, 4 * (2 * m + fragments.bends))
    reference = offset_by(by_lane, 16)
    result = offset_by(reference, m)
    # a fragment that is drawn has this alpha at least
    least = inputs.rules.alpha_min * (1.0 - 2.0 * charges.threshold)
    while pixels != 0:
        q = lowest_bit(pixels)
        pixels = signed(pixels & (pixels - 1))
        begin, n = q * fragments.capacity, int(fragments.lengths[q])
        end = begin + n
        _set_reference(begin, end, fragments, block.palette, reference, m)
        span = _shift_depths(begin, end, block, reference, m)
        _blend_depths(begin, end, block, t, by_lane, order, m)
        rounding = SECOND_ORDER * (charges.blend_fragment * n + charges.blend_pixel)
        # light that is lost to a stop that was ignored, and that comes to what is missing (B6)
        lost = per_pixel[RHO + q] * (1.0 + charges.lost_light)
        passed = per_pixel[OPEN + q] * (1.0 + charges.lost_light)
        nearest, farthest, largest = span.nearest, span.farthest, span.largest
        if passed > 0.0:
            shift_low, shift_high = _range(reference, order, m)
            nearest = min(nearest, unseen[DEPTH] - shift_high)
            farthest = max(farthest, unseen[4 + DEPTH] - shift_low)
            largest = max(largest, abs(unseen[DEPTH]), abs(unseen[4 + DEPTH]))
            rounding += SECOND_ORDER * cutoffs.fade
        # the sum: of weights times depths against the reference
        fall = max(lost * max(farthest, 0.0), passed * max(-nearest, 0.0))
        rise = max(lost * max(-nearest, 0.0), passed * max(farthest, 0.0))
        sum_low, sum_high = by_lane[DEPTH] - fall, by_lane[4 + DEPTH] + rise
        total_low = max(by_lane[_SUM] - lost - rounding, 0.0)
        total_high = min(by_lane[4 + _SUM] + passed + rounding, 1.0)
        some = least - rounding
        layers = bounds.layers[0, above + q // BLOCK, left + q % BLOCK]
        is_bounded = total_low <= total_high and math.isfinite(farthest - nearest + sum_high - sum_low)
        if (not is_bounded and n == 0 and passed == 0.0) or (is_bounded and some > 0.0 and total_high < some):
            # nothing can be drawn
            _write(layers, 0.0, 0.0, np.inf, -np.inf)
        elif not is_bounded:
            _write(layers, 0.0, 1.0, 0.0, np.inf)
        elif not some > 0.0:
            # so many that rounding may hide one
            _write(layers, total_low, total_high, 0.0, np.inf)
        else:
            for k in range(m):
                result[k], result[m + k] = reference[k], t[4 * k + DEPTH]
            drawn = max(total_low, some)
            total_low = drawn if total_low > 0.0 else total_low
            radius, span = by_lane[8 + DEPTH] + max(fall, rise), _Span(nearest, farthest, largest)
            low, high = _expected_depth(
                result, radius, span, sum_low, sum_high, drawn, total_high, rounding, inputs.colors.common, charges,
                order, m,
            )  # fmt: skip
            _write(layers, total_low, total_high, low, high)
