"""Collect the fragments of a block of pixels, nearest first, with uncertain depth orders and early termination.

Gaussian by Gaussian, `collect_fragments` finds the pixels that it may reach and its alpha there, keeps what may
contribute, and notes which Gaussians that share a pixel may change places (design.md, B5-B6, O1).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import ORDER_ROUNDING, REGION, TURN_ROOM, UP, WINDOW_ROUNDING
from ns_abstract.arithmetic.simd.intrinsics import advanced, lowest_bit, pointer, prefetch, signed
from ns_abstract.arithmetic.simd.lanes import load8, maximum, minimum, root, spans, store, where
from ns_abstract.methods.splat.alphas import alphas
from ns_abstract.methods.splat.lists import AHEAD, BLOCK, PIXELS
from ns_abstract.methods.splat.pixel_block import (
    ALPHA_HIGH,
    ALPHA_LOW,
    BATCH,
    HIDDEN,
    LAST,
    LEFT,
    LIGHT,
    LISTED,
    LOST,
    MOVES,
    NUMBERS,
    OPEN,
    RHO,
    THI,
    TLO,
    color_ends,
    color_size,
    longest_list,
    set_unknown,
)
from ns_abstract.methods.splat.projection_errors import EXPONENT_LIMIT, FORMS, MEAN_X, MEAN_Y, SPREAD, UNBOUNDED

#: Pixel q of a block lies in row q >> _ROW_SHIFT; sets of pixels are the bits of an int64.
_ROW_SHIFT = BLOCK.bit_length() - 1
# what a block may answer in place of a number of pairs
GIVE_UP = -1
GROW = -2


class _BlockList(NamedTuple):
    """A block's list of Gaussians, nearest first, with pointers to their `ProjectedGaussians`.

    Attributes:
        numbers: [length] the Gaussians' rows.
        columns: Columns of ``record``.
        slope: [rows, 3] see `ViewingAxes.depth`.
        tied: See `ViewingAxes.tied`.
        x0, y0: The block's first pixel.
        m: Coefficients of a form.
    """

    numbers: np.ndarray
    length: int
    record: np.ndarray
    columns: int
    box: np.ndarray
    tiles: np.ndarray
    delta: np.ndarray
    depth_error: np.ndarray
    slope: np.ndarray
    tied: bool
    x0: int
    y0: int
    m: int


class _DepthWindow(NamedTuple):
    """How far apart in depth list positions may change places (O1).

    Attributes:
        room: Positions i, j keep their order where ``room |depth_i - depth_j| > radius_i + radius_j``; if not positive,
            nothing is known.
        largest: Largest `ListEntries.depth_radius` of all but the few positions in ``far``.
        far: How many these are.
        farthest: Their largest one.
    """

    room: float
    largest: float
    far: int
    farthest: float


class _EarlyTermination(NamedTuple):
    """Bounds on the transmittance of early termination, the transmittance below which tracking ends, and rounding."""

    low: float
    high: float
    floor: float
    shrink: float
    grow: float


@njit(cache=True, error_model="numpy", forceinline=True)
def _uncertain(i, j, listed):
    """Whether the depth order of Gaussians i and j, listed in this order, may be another in the cell (design.md, O1).

    Depths differ by the third row of the rotation times ``delta_i - delta_j``.
    """
    delta, slope, depth_error, m = listed.delta, listed.slope, listed.depth_error, listed.m
    x = delta[3 * i] - delta[3 * j]
    y = delta[3 * i + 1] - delta[3 * j + 1]
    z = delta[3 * i + 2] - delta[3 * j + 2]
    if listed.tied and x == 0.0 and y == 0.0 and z == 0.0:
        return i > j
    center = slope[0] * x + slope[1] * y + slope[2] * z
    spread = 0.0
    for k in range(1, m):
        spread += abs(slope[3 * k] * x + slope[3 * k + 1] * y + slope[3 * k + 2] * z)
    size = abs(delta[3 * i]) + abs(delta[3 * j]) + abs(delta[3 * i + 1]) + abs(delta[3 * j + 1])
    size += abs(delta[3 * i + 2]) + abs(delta[3 * j + 2])
    rounding = ORDER_ROUNDING * size
    radius = slope[3 * m] * abs(x) + slope[3 * m + 1] * abs(y) + slope[3 * m + 2] * abs(z)
    return not (abs(center) > (spread + radius) * UP + rounding + depth_error[i] + depth_error[j])


@njit(cache=True, error_model="numpy", forceinline=True)
def _turn(slope, ray, m):
    """By how much the depth of a point of unit depth on ``ray`` [3] changes over the cell, at most (design.md, O1)."""
    along = 0.0
    for k in range(1, m):
        along += abs(slope[k, 0] * ray[0] + slope[k, 1] * ray[1] + slope[k, 2] * ray[2])
    return along + (slope[m, 0] * abs(ray[0]) + slope[m, 1] * abs(ray[1]) + slope[m, 2] * abs(ray[2]))


@njit(cache=True, error_model="numpy", forceinline=True)
def _steadiness(along):
    """Lower bound of one less the exact `_turn` (design.md, O1), of which a small one may be nothing but rounding."""
    return 1.0 - along - TURN_ROOM


@njit(cache=True, error_model="numpy")
def _depth_radii(numbers, gaussians, slope, ray, m, entries):
    """How far in depth each entry may move against the block's central ray (design.md, O1).

    Fills ``entries.depth_radius`` and ``entries.depth``; returns `_DepthWindow.room` and `_DepthWindow.largest`.
    """
    depth, delta, depth_error = gaussians.depth, gaussians.delta, gaussians.depth_error
    radii, deep = entries.depth_radius, entries.depth
    count = numbers.size
    along = _turn(slope, ray, m)
    total = 0.0
    for k in range(count):
        ahead = numbers[min(k + AHEAD, count - 1)]
        prefetch(delta, ahead, 0)
        prefetch(depth, ahead, 0)
        prefetch(depth_error, ahead, 0)
        i = numbers[k]
        deep[k] = depth[i]
        # offset from the central ray: what a rotation moves in depth relative to the ray
        x = delta[i, 0] - depth[i] * ray[0]
        y = delta[i, 1] - depth[i] * ray[1]
        z = delta[i, 2] - depth[i] * ray[2]
        e = slope[m, 0] * abs(x) + slope[m, 1] * abs(y) + slope[m, 2] * abs(z)
        for row in range(1, m):
            e += abs(slope[row, 0] * x + slope[row, 1] * y + slope[row, 2] * z)
        size = abs(delta[i, 0]) + abs(delta[i, 1]) + abs(delta[i, 2]) + abs(depth[i]) * (1.0 + along)
        radii[k] = e * UP + WINDOW_ROUNDING * size + depth_error[i]
        total += radii[k]
    room = _steadiness(along)
    if not total < np.inf:
        room = -1.0
    # few entries reach far: they are compared with all, the others within a window
    typical = 4.0 * total / max(count, 1)
    largest = 0.0
    for k in range(count):
        if radii[k] <= typical:
            largest = max(largest, radii[k])
    return room, largest


@njit(cache=True, error_model="numpy", forceinline=True)
def _start(numbers, inputs, block):
    """Reset a block's pixels and list positions; returns the `_DepthWindow`."""
    entries, per_pixel, lengths = block.entries, block.fragments.per_pixel, block.fragments.lengths
    for q in range(PIXELS):
        per_pixel[TLO + q] = 1.0
        per_pixel[THI + q] = 1.0
        per_pixel[LAST + q] = -1.0
        per_pixel[RHO + q] = 0.0
        per_pixel[LOST + q] = 0.0
        per_pixel[OPEN + q] = 0.0
        lengths[q] = 0
    room, largest = _depth_radii(
        numbers, inputs.gaussians, inputs.axes.depth, block.ray, inputs.shape.monomials, entries
    )
    far = 0
    farthest = 0.0
    for k in range(numbers.size):
        entries.first[k] = k
        entries.last[k] = k
        block.reordering.slots[k] = -1
        entries.asked[k] = 0
        if entries.depth_radius[k] > largest:
            entries.far[far] = k
            far += 1
            farthest = max(farthest, entries.depth_radius[k])
    # row 0 is for fragments that do not move
    for r in range(MOVES):
        block.reordering.moves[r] = 0.0
    return _DepthWindow(room, largest, far, farthest)


@njit(cache=True, error_model="numpy")
def _pixels_within(record, ox, oy, left, right, top, bottom, m, per_pixel):
    """The set of pixels of a range where the exponent may stay low enough for the threshold.

    Row by row, sigma >= (near1^2 + near2^2)/2 bounds the columns, where near1 and near2 are what the forms' spread
    leaves of |y1| and |y2| (design.md, B2). (ox, oy) is the offset of the block's first pixel from the mean.
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
    """The set of a block's pixels on which a Gaussian may reach the threshold."""
    left = int(math.ceil(min(max(box[0] - 0.5 - x0, 0.0), float(BLOCK))))
    right = int(math.floor(min(max(box[1] - 0.5 - x0, -1.0), BLOCK - 1.0)))
    top = int(math.ceil(min(max(box[2] - 0.5 - y0, 0.0), float(BLOCK))))
    bottom = int(math.floor(min(max(box[3] - 0.5 - y0, -1.0), BLOCK - 1.0)))
    if top > bottom or left > right:
        return 0
    ox, oy = x0 + 0.5 - record[MEAN_X], y0 + 0.5 - record[MEAN_Y]
    return signed(_pixels_within(record, ox, oy, left, right, top, bottom, m, per_pixel))


@njit(cache=True, error_model="numpy", forceinline=True)
def _pixels_once(k, listed, entries, per_pixel):
    """`_pixels_of` list position k, found when first asked for."""
    if entries.asked[k] == 0:
        entries.asked[k] = 1
        i = listed.numbers[k]
        entries.pixels[k] = _pixels_of(
            advanced(listed.record, i * listed.columns), advanced(listed.box, 4 * i), listed.x0, listed.y0, listed.m,
            per_pixel,
        )  # fmt: skip
    return entries.pixels[k]


@njit(cache=True, error_model="numpy")
def _pixels_at(lanes, pixels):
    """The set of the pixels that stand in the lanes ``found``."""
    at = 0
    while lanes != 0:
        at |= 1 << int(pixels[lowest_bit(lanes)])
        lanes &= lanes - 1
    return signed(at)


@njit(cache=True, error_model="numpy", forceinline=True)
def _find_pairs(k, found, pixels, listed, entries, per_pixel, window, reordering, count):
    """Append the pairs (k, later entry) that share a pixel and are of uncertain order; widen ``first``, ``last``.

    ``pixels`` in the lanes ``found`` are k's. Returns the number of pairs, or -1 where there is no room for them.
    """
    radii, deep, far, pairs = entries.depth_radius, entries.depth, entries.far, reordering.pairs
    i = listed.numbers[k]
    pixel_set = 0
    beyond = listed.length
    near = radii[k] + window.largest
    # those within the window, then those that reach far
    other = k
    f = 0
    within = True
    while True:
        if within:
            other += 1
            if other >= listed.length or (deep[other] - deep[k]) * window.room > near:
                within = False
                beyond = other
                continue
        else:
            while f < window.far and far[f] < beyond:
                f += 1
            if f >= window.far:
                break
            other = far[f]
            f += 1
            if (deep[other] - deep[k]) * window.room > radii[k] + window.farthest:
                break
        if (deep[other] - deep[k]) * window.room > radii[k] + radii[other]:
            continue
        if pixel_set == 0:
            pixel_set = _pixels_at(found, pixels)
        theirs = _pixels_once(other, listed, entries, per_pixel)
        if pixel_set & int(theirs) == 0 or not _uncertain(i, listed.numbers[other], listed):
            continue
        if count >= reordering.pair_limit:
            return -1
        pairs[2 * count] = k
        pairs[2 * count + 1] = other
        entries.last[k] = max(entries.last[k], other)
        entries.first[other] = min(entries.first[other], k)
        count += 1
    return count


@njit(cache=True, error_model="numpy")
def _still_live(lanes, pixels, live):
    """Those lanes of ``found`` whose pixel is in ``live``."""
    left = 0
    while lanes != 0:
        lane = lowest_bit(lanes)
        lanes &= lanes - 1
        if live & (1 << int(pixels[lane])) != 0:
            left |= 1 << lane
    return left


@njit(cache=True, error_model="numpy", forceinline=True)
def _append(number, q, k, t_low, t_high, fragments):
    """Append fragment ``number`` to pixel q's list, with the light that it leaves; returns its place there."""
    per_pixel, lists, light = fragments.per_pixel, fragments.lists, fragments.light
    count = fragments.lengths[q]
    entry = q * fragments.capacity + count
    light[2 * entry + LEFT] = t_low
    light[2 * entry + LIGHT] = per_pixel[THI + q]
    per_pixel[TLO + q] = t_low
    per_pixel[THI + q] = t_high
    lists[LISTED * entry] = number
    lists[LISTED * entry + 1] = k
    lists[LISTED * entry + 2] = 0
    fragments.lengths[q] = count + 1
    return count


@njit(cache=True, error_model="numpy")
def _keep_drawn(lanes, pixels, number, k, fragments, stop):
    """Keep the fragments of a Gaussian whose place is certain in those lanes of ``found`` that leave enough light.

    Lane b is fragment ``number + b`` on the pixel ``pixels[b]``. Returns the other lanes.
    """
    per_pixel, values = fragments.per_pixel, fragments.values
    bright = max(stop.high, stop.floor)
    rest = 0
    while lanes != 0:
        lane = lowest_bit(lanes)
        lanes &= lanes - 1
        q = int(pixels[lane])
        at = (number + lane) * fragments.width
        t_low = per_pixel[TLO + q] * (1.0 - values[at + ALPHA_HIGH]) * stop.shrink
        if not t_low > bright:
            rest |= 1 << lane
            continue
        t_high = per_pixel[THI + q] * (1.0 - values[at + ALPHA_LOW]) * stop.grow
        _append(number + lane, q, k, t_low, t_high, fragments)
    return rest


@njit(cache=True, error_model="numpy", forceinline=True)
def _keep_alone(lanes, pixels, number, k, fragments, stop, live, dim, m):
    """`_keep_drawn` for lanes that a stop may hide (B6).

    Returns ``live`` without the pixels that surely stop, and ``dim`` with those that get too little light.
    """
    per_pixel, values = fragments.per_pixel, fragments.values
    dark = max(stop.low, stop.floor)
    while lanes != 0:
        lane = lowest_bit(lanes)
        lanes &= lanes - 1
        q = int(pixels[lane])
        at = (number + lane) * fragments.width
        high = values[at + ALPHA_HIGH]
        before = per_pixel[THI + q]
        t_low = per_pixel[TLO + q] * (1.0 - high) * stop.shrink
        t_high = before * (1.0 - values[at + ALPHA_LOW]) * stop.grow
        if t_high <= stop.low:
            # surely the stop: neither this fragment nor any behind it is drawn
            live = signed(live & ~(1 << q))
            continue
        if t_low <= stop.high:
            # LOST is the most that any stop so far may leave of the light
            per_pixel[LOST + q] = max(per_pixel[LOST + q], min(before, stop.high / (1.0 - high)))
            if per_pixel[LOST + q] >= before:
                set_unknown(fragments, at, high, m)
            else:
                per_pixel[RHO + q] = per_pixel[LOST + q]
        _append(number + lane, q, k, t_low, t_high, fragments)
        if t_high <= dark:
            dim = signed(dim | (1 << q))
    return live, dim


@njit(cache=True, error_model="numpy", forceinline=True)
def _keep_moving(lanes, pixels, number, k, slot, block, stop, dim, moved):
    """Keep the fragments of slot ``slot``, whose place is uncertain; ``dim`` and the number of moves with theirs."""
    fragments, entries, reordering = block.fragments, block.entries, block.reordering
    per_pixel, values = fragments.per_pixel, fragments.values
    dark = max(stop.low, stop.floor)
    reordering.slots[k] = slot
    reordering.owners[slot] = k
    drawn = 0
    while lanes != 0:
        lane = lowest_bit(lanes)
        lanes &= lanes - 1
        q = int(pixels[lane])
        at = (number + lane) * fragments.width
        t_low = per_pixel[TLO + q] * (1.0 - values[at + ALPHA_HIGH]) * stop.shrink
        t_high = per_pixel[THI + q] * (1.0 - values[at + ALPHA_LOW]) * stop.grow
        count = _append(number + lane, q, k, t_low, t_high, fragments)
        if t_high <= dark:
            dim = signed(dim | (1 << q))
        fragments.lists[LISTED * (q * fragments.capacity + count) + 2] = moved
        for r in range(MOVES * moved, MOVES * (moved + 1), 8):
            store(reordering.moves, r, 0.0 * load8(per_pixel, NUMBERS))
        moved += 1
        drawn = signed(drawn | (1 << q))
        reordering.places[slot * PIXELS + q] = count
        # fragments up to the last one whose order is uncertain may still come first
        per_pixel[LAST + q] = max(per_pixel[LAST + q], float(entries.last[k]))
    reordering.drawn[slot] = drawn
    return dim, moved


@njit(cache=True, error_model="numpy", forceinline=True)
def _set_colors(palette, k, color, color_rows, channels):
    """Write the colour of list position k: see `Palette`; ``color`` [channels, color_rows] is the Gaussian's."""
    forms, values = palette.forms, palette.values
    at = k * color_size(forms)
    for channel in range(channels):
        start = channel * color_rows
        spread = 0.0
        for r in range(1, color_rows):
            spread += abs(color[start + r])
        spread *= UP
        for r in range(forms):
            values[at + 4 * r + channel] = color[start + r]
        values[at + 4 * forms + channel] = color[start + forms] if color_rows > 1 else 0.0
        values[at + color_ends(forms) + channel] = color[start] - spread
        values[at + color_ends(forms) + 4 + channel] = color[start] + spread


@njit(cache=True, error_model="numpy")
def _colors_behind(first, listed, colors, channels, palette, marks):
    """Ends of the colours of the list's entries from ``first`` on and of the background; marks them (design.md, B6)."""
    color_columns = colors.shape[1]
    color_rows = color_columns // channels
    values, unseen = pointer(colors), palette.unseen
    for channel in range(4):
        unseen[channel] = palette.background[channel]
        unseen[4 + channel] = palette.background[channel]
    if channels == 4:
        # the background has no depth
        unseen[3], unseen[7] = np.inf, -np.inf
    for k in range(first, listed.length):
        ahead = listed.numbers[min(k + BATCH, listed.length - 1)]
        for byte in range(0, 8 * color_columns, 64):
            prefetch(colors, ahead, byte)
        i = listed.numbers[k]
        if marks[i] == 0:
            marks[i] = 1
        color = advanced(values, i * color_columns)
        for channel in range(channels):
            at = channel * color_rows
            spread = 0.0
            for r in range(1, color_rows):
                spread += abs(color[at + r])
            unseen[channel] = min(unseen[channel], color[at] - spread * UP)
            unseen[4 + channel] = max(unseen[4 + channel], color[at] + spread * UP)


@njit(cache=True, error_model="numpy", forceinline=True)
def _place_batch(start, some, live, listed, inputs, block):
    """Find the pixels of `FragmentBatch` for ``some`` positions from ``start`` on that they may be drawn on.

    Returns how many there are.
    """
    gaussians, colors, batch = inputs.gaussians, inputs.colors.values, block.batch
    for b in range(some):
        ahead = listed.numbers[min(start + b + BATCH, listed.length - 1)]
        prefetch(gaussians.box, ahead, 0)
        prefetch(gaussians.tiles, ahead, 0)
        for byte in range(0, 8 * listed.columns, 64):
            prefetch(gaussians.record, ahead, byte)
        prefetch(gaussians.record, ahead, 8 * listed.columns - 8)
        for byte in range(0, 8 * colors.shape[1], 64):
            prefetch(colors, ahead, byte)
        _pixels_once(start + b, listed, block.entries, block.fragments.per_pixel)
    end = 0
    for b in range(some):
        row = advanced(listed.record, listed.numbers[start + b] * listed.columns)
        ox, oy = listed.x0 + 0.5 - row[MEAN_X], listed.y0 + 0.5 - row[MEAN_Y]
        pixels = live & block.entries.pixels[start + b]
        batch.begins[b] = end
        while pixels != 0:
            q = lowest_bit(pixels)
            pixels &= pixels - 1
            batch.pixels[end] = q
            batch.offset_x[end] = ox + (q & (BLOCK - 1))
            batch.offset_y[end] = oy + (q >> _ROW_SHIFT)
            end += 1
    batch.begins[some] = end
    return end


@njit(cache=True, error_model="numpy", forceinline=True)
def _find_alphas(start, some, used, place, listed, inputs, block):
    """Write the alphas of `_place_batch`'s positions: fragments from number ``used`` on, and `FragmentBatch.found`."""
    batch = block.batch
    for b in range(some):
        i = listed.numbers[start + b]
        begin = batch.begins[b]
        n = batch.begins[b + 1] - begin
        batch.found[b] = 0
        if n > 0:
            core = advanced(listed.tiles, 8 * i + 4)
            sure = (
                core[0] <= place.tile_x
                and place.tile_x < core[1]
                and core[2] <= place.tile_y
                and place.tile_y < core[3]
            )
            offset = (used + begin) * block.fragments.width
            record = advanced(listed.record, i * listed.columns)
            batch.found[b] = alphas(record, begin, n, offset, sure, block, inputs)


@njit(cache=True, error_model="numpy", forceinline=True)
def _hide_dim(dim, k, length, live, missing, fragments, stop_low):
    """Let pixels ``dim`` take no light behind position k unless something that is listed may still come behind it.

    Returns ``live`` without these and the first position that is ``missing`` in any of them (B6).
    """
    per_pixel = fragments.per_pixel
    while dim != 0:
        q = lowest_bit(dim)
        dim = signed(dim & (dim - 1))
        if per_pixel[LAST + q] <= k:
            live = signed(live & ~(1 << q))
            if per_pixel[THI + q] > stop_low and k + 1 < length:
                per_pixel[OPEN + q] = per_pixel[THI + q]
                missing = min(missing, k + 1)
    return live, missing


@njit(cache=True, error_model="numpy")
def collect_fragments(numbers, place, inputs, block, marks_):
    """Collect the fragments of every pixel of a block, nearest first (design.md, B5-B6).

    Fills ``block`` but for its sums, from the Gaussians ``numbers`` (rows of ``inputs.gaussians``), nearest first; sets
    ``marks_`` [n] for those that some pixel that takes light may draw, or stop at. Returns the number of pairs and of
    slots; or GIVE_UP where more pairs are uncertain than there is room for, or GROW where another buffer is too small.

    A list may end where no pose leaves more light than ``inputs.cutoffs.floor``. All that is missing lies behind what
    it holds, and row OPEN of `Fragments.per_pixel` bounds the light that comes there, `Palette.unseen` the colours.
    OPEN is 0 where nothing is missing, as if the floor is negative. Row RHO receives how much transmittance may be lost
    to a stop that the kept fragments ignore.
    """
    fragments, entries, reordering, batch = block.fragments, block.entries, block.reordering, block.batch
    gaussians, charges, m = inputs.gaussians, inputs.charges, inputs.shape.monomials
    colors, channels, marks = inputs.colors.values, inputs.colors.channels, pointer(marks_)
    listed = _BlockList(
        pointer(numbers), numbers.size, pointer(gaussians.record), gaussians.record.shape[1], pointer(gaussians.box),
        pointer(gaussians.tiles), pointer(gaussians.delta), pointer(gaussians.depth_error),
        pointer(inputs.axes.depth), inputs.axes.tied, place.x0, place.y0, m,
    )  # fmt: skip
    length, capacity, color_columns = listed.length, fragments.capacity, colors.shape[1]
    stop_light, step = inputs.rules.transmittance_min, charges.transmittance
    stop = _EarlyTermination(
        stop_light * (1.0 - step), stop_light * (1.0 + step), inputs.cutoffs.floor, 1.0 - step, 1.0 + step
    )
    window = _start(numbers, inputs, block)
    if not window.room > 0.0:
        return GIVE_UP, 0
    # not as literals, for which what is called would be compiled once more
    pairs, slots, moved, used = signed(0), signed(0), signed(1), signed(0)
    # pixels that take light, and those that take none, or too little, behind the fragments whose place is still open
    live, dim = signed(place.wanted), signed(0)
    missing = length
    for start in range(0, length, BATCH):
        some = min(BATCH, length - start)
        begun = live
        end = _place_batch(start, some, live, listed, inputs, block)
        # eight at a time, some in excess
        if used + end + 8 > capacity * PIXELS or longest_list(fragments.lengths) + some > capacity:
            return GROW, 0
        _find_alphas(start, some, used, place, listed, inputs, block)
        for b in range(some):
            lanes = batch.found[b]
            begin = batch.begins[b]
            pixels = advanced(batch.pixels, begin)
            if live != begun:
                lanes = _still_live(lanes, pixels, live)
            if lanes == 0:
                continue
            k = start + b
            i = listed.numbers[k]
            pairs = _find_pairs(k, lanes, pixels, listed, entries, fragments.per_pixel, window, reordering, pairs)
            if pairs < 0:
                return GIVE_UP, 0
            # threads share these bytes: written no more than once each
            if marks[i] == 0:
                marks[i] = 1
            color = advanced(pointer(colors), i * color_columns)
            _set_colors(block.palette, k, color, color_columns // channels, channels)
            if entries.first[k] == k and entries.last[k] == k:
                lanes = _keep_drawn(lanes, pixels, used + begin, k, fragments, stop)
                live, dim = _keep_alone(lanes, pixels, used + begin, k, fragments, stop, live, dim, m)
            else:
                if slots >= 2 * capacity or moved + PIXELS > 32 * capacity:
                    return GROW, 0
                dim, moved = _keep_moving(lanes, pixels, used + begin, k, slots, block, stop, dim, moved)
                slots += 1
            live, missing = _hide_dim(dim & live, k, length, live, missing, fragments, stop.low)
        if live == 0:
            break
        used += end
    if missing < length:
        _colors_behind(missing, listed, colors, channels, block.palette, marks)
    return pairs, slots


@njit(cache=True, error_model="numpy")
def apply_stops(slots, block, inputs):
    """Drop or weaken the fragments of uncertain depth order that the stop may hide (design.md, B6).

    ``slots`` is their number.
    """
    fragments, entries, reordering = block.fragments, block.entries, block.reordering
    values, width, lists, per_pixel = fragments.values, fragments.width, fragments.lists, fragments.per_pixel
    m, stop, step = inputs.shape.monomials, inputs.rules.transmittance_min, inputs.charges.transmittance
    stop_low = stop * (1.0 - step)
    stop_high = stop * (1.0 + step)
    # the stop is out of reach of most pixels
    dark = 0
    for q in range(PIXELS):
        per_pixel[HIDDEN + q] = 0.0
        if not per_pixel[TLO + q] > stop_high:
            dark |= 1 << q
    if dark == 0:
        return
    for slot in range(slots):
        k = reordering.owners[slot]
        some = reordering.drawn[slot]
        while some != 0:
            q = lowest_bit(some)
            some &= some - 1
            if dark & (1 << q) == 0:
                continue
            start = q * fragments.capacity
            e = start + int(reordering.places[slot * PIXELS + q])
            behind = e
            end = start + int(fragments.lengths[q])
            while behind + 1 < end and int(lists[LISTED * (behind + 1) + 1]) <= entries.last[k]:
                behind += 1
            t_low = fragments.light[2 * behind + LEFT]
            if t_low > stop_high:
                continue
            before = e
            while before > start and int(lists[LISTED * (before - 1) + 1]) >= entries.first[k]:
                before -= 1
            light = fragments.light[2 * before + LIGHT]
            at = int(lists[LISTED * e]) * width
            t_high = light * (1.0 - values[at + ALPHA_LOW]) * (1.0 + step)
            # the most light that a stop at this fragment may leave
            high = values[at + ALPHA_HIGH]
            lost = min(light, stop_high / (1.0 - high))
            if t_high <= stop_low:
                per_pixel[HIDDEN + q] = max(per_pixel[HIDDEN + q], lost)
                set_unknown(fragments, at, 0.0, m)
            elif lost < light:
                # kept; what the stop may leave of the light is added at the end
                per_pixel[RHO + q] = max(per_pixel[RHO + q], lost, per_pixel[LOST + q])
            else:
                per_pixel[HIDDEN + q] = max(per_pixel[HIDDEN + q], lost)
                set_unknown(fragments, at, high, m)
    # a stop at a dropped or weakened fragment also hides the kept fragments behind it
    for q in range(PIXELS):
        if per_pixel[RHO + q] > 0.0:
            per_pixel[RHO + q] = max(per_pixel[RHO + q], per_pixel[HIDDEN + q])


@njit(cache=True, error_model="numpy")
def number_groups(length, entries):
    """Number the groups of list positions into ``entries.far``: no uncertain pair spans two groups (design.md, O4)."""
    group = 0
    last = -1
    for k in range(length):
        if k > last:
            group += 1
        entries.far[k] = group
        last = max(last, entries.last[k])
