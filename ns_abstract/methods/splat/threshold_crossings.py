"""Bounds the alpha-threshold crossings of a pixel's fragments jointly over parts of the cell (docs/dev/design.md, B11).

Where alpha crosses the threshold, a fragment is drawn on one side and skipped on the other. A pixel is composited as if
no fragment were skipped. The change by skipping is a sum of one term for each fragment. Here the sum is bounded, in
each of `_PARTS` parts, by one plane above and one below each term, chosen where the sum is likely to be largest.

Rows of `ThresholdCrossings.rows` hold a number of each fragment, and before them, in the first lanes, of the three
channels' blends:
    0        radius of the form of alpha, before the threshold
    1        greatest alpha
    2        alpha up to which the fragment may be skipped
    3, 4     magnitudes of the form's numbers and of the weights, for rounding
    5 .. 10  weights of the change by skipping, in the upper bounds of three channels and in the lower ones
    11 ..    the form: centre, slopes, products of two parameters
    then     the same over a part: centre, slopes, ends of the other terms, two planes above and two below, scratch
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from numba import njit

from ns_abstract.arithmetic.elementary import fma
from ns_abstract.arithmetic.rounding import (
    CROSSING_ROUNDING,
    LAYER_ROUNDING,
    PART_ROUNDING,
    PLANE_ROUNDINGS,
    UNIT64,
    UP,
    WEIGHT_LAYERS,
)
from ns_abstract.arithmetic.simd.intrinsics import lowest_bit, offset_by
from ns_abstract.arithmetic.simd.lanes import lane_sum, load4, load8, maximum, minimum, store, where
from ns_abstract.methods.splat.pixel_block import (
    ALPHA_HIGH,
    ALPHA_LOW,
    CROSSING_FORM,
    CROSSING_LANES,
    CROSSING_RESTRICTED,
    FORM,
    LISTED,
    crossing_of,
)


@dataclass(frozen=True)
class CrossingTuning:
    """Preferences on the planes that bound skipped fragments; soundness does not depend on them."""

    #: Planes whose steepness would divide by less than this part of the threshold are left out.
    steep: float = 2.0**-20


#: Parts of a cell, a power of two.
_PARTS = 8
_STEEP = CrossingTuning.steep
_RADIUS, _TOP, _THRESHOLD, _SIZE, _SIZES, _WEIGHTS = range(6)
# from `_restricted_rows` on: centre, then behind the slopes
_LOW, _HIGH, _ABOVE, _FAR_ABOVE, _FAR_ABOVE_AT_0, _BELOW, _BELOW_AT_0, _FAR_BELOW, _PRODUCTS = range(1, 10)
_SCRATCH = _PRODUCTS + 3

assert CROSSING_FORM == _WEIGHTS + 6 and CROSSING_RESTRICTED == _SCRATCH + 1


@njit(cache=True, error_model="numpy", forceinline=True)
def _restricted_rows(d):
    """Return the first row of forms over a part."""
    return CROSSING_FORM + 1 + d + d * (d + 1) // 2


@njit(cache=True, error_model="numpy", forceinline=True)
def crossing_columns(count):
    """Return the columns of `ThresholdCrossings.rows` in use: whole lanes."""
    return CROSSING_LANES + -(-count // CROSSING_LANES) * CROSSING_LANES


@njit(cache=True, error_model="numpy")
def gather_crossings(begin, end, count, since, fragments, crossings, out, shape):
    """Fill the rows of ``count`` fragments of the list entries [begin, end), and bound the change by skipping (B11).

    By channel, only those from number ``since`` [4] on count. ``out`` [16] receives the largest fall and rise of the
    channels wherever fragments are skipped; the rest is scratch.
    """
    values, rows, room, d = fragments.values, crossings.rows, crossings.room, shape.dimensions
    bends = d * (d + 1) // 2
    products = FORM + 1 + d if shape.order == 2 else FORM + d + 2
    first = load4(since, 0)
    falls = 0.0 * first
    rises = falls
    for column in range(CROSSING_LANES + count, crossing_columns(count)):
        for row in range(_restricted_rows(d)):
            rows[row * room + column] = 0.0
        rows[_THRESHOLD * room + column] = 1.0
    least, most = 1.0, 1.0
    grow = 1.0 + LAYER_ROUNDING * (end - begin + WEIGHT_LAYERS)
    number = count - 1
    for entry in range(begin, end):
        if number < 0:
            break
        at = int(fragments.lists[LISTED * entry]) * fragments.width
        if crossings.entries[number] == entry:
            # raised by what is darker than what lies behind; surely lowered where surely skipped, if brighter
            nearest, farthest = load4(crossings.distances, 8 * number), load4(crossings.distances, 8 * number + 4)
            counts = first <= float(number)
            up = where(counts, where(nearest < 0.0, -most * grow, -least * (2.0 - grow)) * nearest, 0.0)
            down = where(counts, where(farthest > 0.0, most * grow, least * (2.0 - grow)) * farthest, 0.0)
            crossing = crossing_of(fragments, at)
            rises = fma(maximum(0.0, up), crossing, rises)
            falls = fma(maximum(0.0, down), crossing, falls)
            store(out, 8, up)
            store(out, 12, down)
            column = CROSSING_LANES + number
            weights = 0.0
            for channel in range(3):
                rows[(_WEIGHTS + channel) * room + column] = out[8 + channel]
                rows[(_WEIGHTS + 3 + channel) * room + column] = out[12 + channel]
                weights += abs(out[8 + channel]) + abs(out[12 + channel])
            rows[_SIZES * room + column] = weights * UP
            center = values[at + FORM] + 0.5 * crossing
            size = abs(center)
            rows[CROSSING_FORM * room + column] = center
            for k in range(d):
                slope = values[at + FORM + 1 + k]
                rows[(CROSSING_FORM + 1 + k) * room + column] = slope
                size += abs(slope)
            for pair in range(bends):
                bend = values[at + products + pair]
                rows[(CROSSING_FORM + 1 + d + pair) * room + column] = bend
                size += abs(bend)
            radius = (values[at + FORM + shape.monomials] - 0.5 * crossing + PART_ROUNDING * size) * UP
            rows[_RADIUS * room + column] = radius
            rows[_TOP * room + column] = values[at + ALPHA_HIGH]
            rows[_THRESHOLD * room + column] = values[at + fragments.crossing]
            rows[_SIZE * room + column] = (size + radius) * UP
            number -= 1
        most *= 1.0 - values[at + ALPHA_LOW]
        least *= 1.0 - values[at + ALPHA_HIGH]
    store(out, 0, falls * (UP + CROSSING_ROUNDING * count))
    store(out, 4, rises * (UP + CROSSING_ROUNDING * count))


@njit(cache=True, error_model="numpy")
def set_blend(polynomials, radii, crossings, d):
    """Write ``polynomials`` [., 4] and ``radii`` [4] of the three channels in front of the fragments' forms."""
    rows, room = crossings.rows, crossings.room
    for channel in range(CROSSING_LANES):
        size = 0.0
        for row in range(1 + d + d * (d + 1) // 2):
            value = polynomials[4 * row + channel] if channel < 3 else 0.0
            rows[(CROSSING_FORM + row) * room + channel] = value
            size += abs(value)
        rows[_RADIUS * room + channel] = (radii[channel] + PART_ROUNDING * size) * UP if channel < 3 else 0.0
        rows[_SIZE * room + channel] = size


@njit(cache=True, error_model="numpy")
def clear_slopes(crossings, d, order):
    """Remove from the blends what linear sets follow: slopes, and for one parameter and order 2 the curvature (B11)."""
    rows, room = crossings.rows, crossings.room
    for row in range(1, 1 + d + (1 if order == 2 else 0)):
        for channel in range(3):
            rows[(CROSSING_FORM + row) * room + channel] = 0.0


@njit(cache=True, error_model="numpy")
def restrict(columns, middle, half, crossings, d):
    """Compute the first ``columns`` forms over the part of the box with ``middle`` [d] and half-widths ``half`` [d]."""
    rows, room = crossings.rows, crossings.room
    part = _restricted_rows(d)
    behind = part + d
    shared = offset_by(rows, (behind + _SCRATCH) * room)
    for column in range(0, columns, CROSSING_LANES):
        center = load8(rows, CROSSING_FORM * room + column)
        low = 0.0 * center
        high = low
        for k in range(d):
            slope = load8(rows, (CROSSING_FORM + 1 + k) * room + column)
            center = fma(middle[k], slope, center)
            store(rows, (part + 1 + k) * room + column, slope)
            store(shared, CROSSING_LANES * k, low)
        row = CROSSING_FORM + 1 + d
        for j in range(d):
            bend = load8(rows, row * room + column)
            row += 1
            center = fma(middle[j] * middle[j], bend, center)
            slope = fma(2.0 * middle[j], bend, load8(rows, (part + 1 + j) * room + column))
            own, both = half[j] * half[j] * bend, load8(shared, CROSSING_LANES * j)
            for k in range(j + 1, d):
                bend = load8(rows, row * room + column)
                row += 1
                center = fma(middle[j] * middle[k], bend, center)
                slope = fma(middle[k], bend, slope)
                at = (part + 1 + k) * room + column
                store(rows, at, fma(middle[j], bend, load8(rows, at)))
                # |p_j p_k| is at most half the sum of their squares
                size = 0.5 * half[j] * half[k] * abs(bend)
                both = both + size
                store(shared, CROSSING_LANES * k, load8(shared, CROSSING_LANES * k) + size)
            low = low + minimum(0.0, own - both)
            high = high + maximum(0.0, own + both)
            slope = half[j] * slope
            store(rows, (part + 1 + j) * room + column, slope)
        radius = load8(rows, _RADIUS * room + column)
        low, high = low - radius, high + radius
        store(rows, part * room + column, center)
        store(rows, (behind + _LOW) * room + column, low)
        store(rows, (behind + _HIGH) * room + column, high)


@njit(cache=True, error_model="numpy")
def set_planes(columns, limit, crossings, d):
    """Compute planes above and below each fragment's change by skipping over a part, from `restrict` (B11).

    A fragment is surely skipped below alpha ``limit``.
    """
    rows, room = crossings.rows, crossings.room
    part = _restricted_rows(d)
    behind = part + d
    for column in range(CROSSING_LANES, columns, CROSSING_LANES):
        center, reach = load8(rows, part * room + column), 0.0 * load8(rows, 0)
        for k in range(d):
            reach = reach + abs(load8(rows, (part + 1 + k) * room + column))
        low, high = load8(rows, (behind + _LOW) * room + column), load8(rows, (behind + _HIGH) * room + column)
        threshold = load8(rows, _THRESHOLD * room + column)
        least = maximum(center - reach + low, 0.0)
        most = minimum(center + reach + high, load8(rows, _TOP * room + column))
        drawn, skipped = least >= threshold, most < limit
        # from above: alpha itself, and what falls from the threshold to 0 at the greatest alpha
        beyond = most - threshold
        steep = beyond <= _STEEP * threshold
        share = threshold / where(steep, 1.0, beyond)
        far = where(skipped | steep, 1.0, -share)
        far_at_0 = where(skipped | steep, 0.0, share * most)
        # from below: 0, and what falls to it from the least alpha to the threshold
        before = limit - least
        steep = (least <= 0.0) | (before <= _STEEP * limit)
        share = where(steep, 0.0, least) / where(steep, 1.0, before)
        near = where(skipped, 1.0, -share)
        near_at_0 = where(skipped, 0.0, share * limit)
        store(rows, (behind + _ABOVE) * room + column, where(drawn, 0.0, 1.0 + 0.0 * least))
        store(rows, (behind + _FAR_ABOVE) * room + column, where(drawn, 0.0, far))
        store(rows, (behind + _FAR_ABOVE_AT_0) * room + column, where(drawn, 0.0, far_at_0))
        store(rows, (behind + _BELOW) * room + column, where(drawn, 0.0, near))
        store(rows, (behind + _BELOW_AT_0) * room + column, where(drawn, 0.0, near_at_0))
        store(rows, (behind + _FAR_BELOW) * room + column, where(skipped, 1.0 + 0.0 * least, 0.0))


@njit(cache=True, error_model="numpy", forceinline=True)
def _weighted(weight, above, below, above_at_0, below_at_0, before):
    """Return the slope of a weighted term's plane, chosen by its sign, and ``before`` plus the plane's value at 0."""
    raised = weight > 0.0
    return weight * where(raised, above, below), fma(weight, where(raised, above_at_0, below_at_0), before)


@njit(cache=True, error_model="numpy")
def _by_planes(columns, side, place, bounds, crossings, d):
    """Compute upper bounds over a part of ``side`` (1 or -1) times each channel, by planes chosen at ``place`` [d].

    ``bounds`` [4 + 4 d] receives those of three channels, then the slopes of each parameter.
    """
    rows, room = crossings.rows, crossings.room
    part = _restricted_rows(d)
    behind = part + d
    weights, products = (_WEIGHTS if side > 0.0 else _WEIGHTS + 3) * room, (behind + _PRODUCTS) * room
    zero = 0.0 * load8(rows, 0)
    first, second, third, sizes = zero, zero, zero, zero
    for column in range(CROSSING_LANES, columns, CROSSING_LANES):
        center = load8(rows, part * room + column)
        low, high = load8(rows, (behind + _LOW) * room + column), load8(rows, (behind + _HIGH) * room + column)
        alpha = fma(0.5, low + high, center)
        for k in range(d):
            alpha = fma(place[k], load8(rows, (part + 1 + k) * room + column), alpha)
        near = alpha < load8(rows, _THRESHOLD * room + column)
        above = where(
            near, load8(rows, (behind + _ABOVE) * room + column), load8(rows, (behind + _FAR_ABOVE) * room + column)
        )
        above_at_0 = where(near, 0.0, load8(rows, (behind + _FAR_ABOVE_AT_0) * room + column))
        below = where(
            near, load8(rows, (behind + _BELOW) * room + column), load8(rows, (behind + _FAR_BELOW) * room + column)
        )
        below_at_0 = where(near, load8(rows, (behind + _BELOW_AT_0) * room + column), 0.0)
        # the values of either plane, without slopes
        above_at_0 = fma(above, center + where(above > 0.0, high, low), above_at_0)
        below_at_0 = fma(below, center + where(below > 0.0, low, high), below_at_0)
        steepest = maximum(abs(above), abs(below))
        sizes = fma(load8(rows, _SIZES * room + column), fma(steepest, load8(rows, _SIZE * room + column), 1.0), sizes)
        weight = load8(rows, weights + column)
        product, first = _weighted(weight, above, below, above_at_0, below_at_0, first)
        store(rows, products + column, product)
        weight = load8(rows, weights + room + column)
        product, second = _weighted(weight, above, below, above_at_0, below_at_0, second)
        store(rows, products + room + column, product)
        weight = load8(rows, weights + 2 * room + column)
        product, third = _weighted(weight, above, below, above_at_0, below_at_0, third)
        store(rows, products + 2 * room + column, product)
    # rounding of the sums and of what they are of
    slack = (columns + PLANE_ROUNDINGS) * UNIT64 * lane_sum(sizes)
    bounds[0], bounds[1], bounds[2] = lane_sum(first) + slack, lane_sum(second) + slack, lane_sum(third) + slack
    for channel in range(3):
        bounds[channel] += side * rows[part * room + channel]
        ends = rows[(behind + (_HIGH if side > 0.0 else _LOW)) * room + channel]
        bounds[channel] += side * ends
    for k in range(d):
        first, second, third = zero, zero, zero
        for column in range(CROSSING_LANES, columns, CROSSING_LANES):
            slope = load8(rows, (part + 1 + k) * room + column)
            first = fma(load8(rows, products + column), slope, first)
            second = fma(load8(rows, products + room + column), slope, second)
            third = fma(load8(rows, products + 2 * room + column), slope, third)
        slopes = offset_by(bounds, 4 + 4 * k)
        slopes[0], slopes[1], slopes[2] = lane_sum(first), lane_sum(second), lane_sum(third)
        for channel in range(3):
            slopes[channel] += side * rows[(part + 1 + k) * room + channel]
            bounds[channel] += abs(slopes[channel])


@njit(cache=True, error_model="numpy")
def bound_part(columns, side, place, bounds, crossings, d):
    """Compute `_by_planes` at the corner that the blends point to, or where the planes point back; keep the tighter."""
    rows, room = crossings.rows, crossings.room
    part = _restricted_rows(d)
    for k in range(d):
        at = (part + 1 + k) * room
        place[k] = math.copysign(1.0, side * (rows[at] + rows[at + 1] + rows[at + 2]))
    _by_planes(columns, side, place, bounds, crossings, d)
    turned = False
    for k in range(d):
        slopes = offset_by(bounds, 4 + 4 * k)
        if place[k] * (slopes[0] + slopes[1] + slopes[2]) < 0.0:
            place[k] = 0.0
            turned = True
    if turned:
        first, second, third = bounds[0], bounds[1], bounds[2]
        _by_planes(columns, side, place, bounds, crossings, d)
        bounds[0], bounds[1], bounds[2] = min(first, bounds[0]), min(second, bounds[1]), min(third, bounds[2])


@njit(cache=True, error_model="numpy")
def _choose_parts(columns, pieces, crossings, d):
    """Write the number of ``pieces`` [d] of each axis: the axis of most variation by skipping is cut, repeatedly."""
    rows, room = crossings.rows, crossings.room
    steepness = offset_by(pieces, d)
    for k in range(d):
        varies = 0.0 * load8(rows, 0)
        for column in range(CROSSING_LANES, columns, CROSSING_LANES):
            slope = load8(rows, (CROSSING_FORM + 1 + k) * room + column)
            varies = fma(load8(rows, _SIZES * room + column), abs(slope), varies)
        steepness[k] = lane_sum(varies)
        pieces[k] = 1.0
    parts = 1
    while parts < _PARTS:
        best = 0
        for k in range(1, d):
            if steepness[k] > steepness[best]:
                best = k
        steepness[best] *= 0.5
        pieces[best] *= 2.0
        parts *= 2


@njit(cache=True, error_model="numpy", forceinline=True)
def _place_part(number, pieces, middle, half, d):
    """Write the ``middle`` [d] and the half-widths ``half`` [d] of a part by its number."""
    for k in range(d):
        cut = int(pieces[k])
        half[k] = 1.0 / cut
        middle[k] = (2 * (number % cut) + 1) * half[k] - 1.0
        number //= cut


@njit(cache=True, error_model="numpy", forceinline=True)
def _foremost(foretold, left):
    """Return the part among ``left`` with the largest estimate ``foretold`` [_PARTS, 8] of a channel, up or down."""
    best, most = lowest_bit(left), -float("inf")
    for number in range(_PARTS):
        if left & (1 << number) == 0:
            continue
        up, down = 0.0, 0.0
        for channel in range(3):
            up += foretold[8 * number + 4 + channel]
            down += foretold[8 * number + channel]
        if not max(up, down) <= most:
            best, most = number, max(up, down)
    return best


@njit(cache=True, error_model="numpy", forceinline=True)
def crossing_scratch(crossings, d):
    """Return the scratch behind that of `restrict`."""
    return offset_by(crossings.rows, (_restricted_rows(d) + d + _SCRATCH) * crossings.room + CROSSING_LANES * d)


@njit(cache=True, error_model="numpy", forceinline=True)
def foretell(foretold, moved, crossings, d):
    """Bound three channels over a part from the forms of `restrict`, wherever fragments are skipped.

    ``foretold`` [8] receives upper bounds of their negatives, then of themselves; ``moved`` [8] is the largest fall of
    the channels by skipping, then the largest rise.
    """
    rows, room, part = crossings.rows, crossings.room, _restricted_rows(d)
    for channel in range(3):
        reach = 0.0
        for k in range(d):
            reach += abs(rows[(part + 1 + k) * room + channel])
        center = rows[part * room + channel]
        low, high = rows[(part + d + _LOW) * room + channel], rows[(part + d + _HIGH) * room + channel]
        foretold[channel] = (reach - low + moved[channel]) * UP - center
        foretold[4 + channel] = (reach + high + moved[4 + channel]) * UP + center


@njit(cache=True, error_model="numpy")
def bound_by_parts(count, limit, crossings, out, d):
    """Compute bounds of three channels from the blends of `set_blend`, with ``count`` skippable fragments (B11).

    ``out`` [8] holds the largest fall of the channels by skipping, then the largest rise; it receives lower bounds,
    then upper ones, each of three channels and padding. ``d`` is positive.
    """
    columns = crossing_columns(count)
    pieces = crossing_scratch(crossings, d)
    middle = offset_by(pieces, 2 * d)
    half = offset_by(middle, d)
    place = offset_by(half, d)
    bounds = offset_by(place, d)
    foretold = offset_by(bounds, 4 + 4 * d)
    _choose_parts(columns, pieces, crossings, d)
    # what a part may reach at most, wherever fragments are skipped
    for number in range(_PARTS):
        _place_part(number, pieces, middle, half, d)
        restrict(CROSSING_LANES, middle, half, crossings, d)
        foretell(offset_by(foretold, 8 * number), out, crossings, d)
    for k in range(8):
        # nothing is known of the channel of nothing
        out[k] = -float("inf") if k % 4 < 3 else float("inf")
    left = (1 << _PARTS) - 1
    while left != 0:
        number = _foremost(foretold, left)
        left &= ~(1 << number)
        wanted = 0
        for k in range(8):
            if k % 4 < 3 and not foretold[8 * number + k] <= out[k]:
                wanted |= 1 << k
        if wanted == 0:
            continue
        _place_part(number, pieces, middle, half, d)
        restrict(columns, middle, half, crossings, d)
        set_planes(columns, limit, crossings, d)
        for side in range(2):
            if (wanted >> 4 * side) & 15 == 0:
                continue
            bound_part(columns, 1.0 if side == 1 else -1.0, place, bounds, crossings, d)
            for channel in range(3):
                k = 4 * side + channel
                bound = min(foretold[8 * number + k], bounds[channel])
                # what is not a number is not known
                if not bound <= out[k]:
                    out[k] = bound if bound < float("inf") else float("inf")
    for k in range(4):
        out[k] = -out[k]
