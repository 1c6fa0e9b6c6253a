"""Collects the fragments of a block of pixels, nearest first, with open depth orders and early termination.

Gaussian by Gaussian, `collect_fragments` finds the pixels that it may reach and its alpha there, stores what may
contribute, and records which Gaussians on a common pixel may change their order (docs/dev/design.md, B5-B6, O1).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import UP
from ns_abstract.arithmetic.simd.intrinsics import lowest_bit, offset_by, pointer, prefetch, signed
from ns_abstract.arithmetic.simd.lanes import load8, store
from ns_abstract.methods.splat.alphas import alphas
from ns_abstract.methods.splat.depth_pairs import DepthWindow, block_list, depth_radii, find_pairs
from ns_abstract.methods.splat.lists import BLOCK, PIXELS
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
from ns_abstract.methods.splat.projection_errors import MEAN_X, MEAN_Y
from ns_abstract.methods.splat.reached_pixels import ROW_SHIFT, pixels_once

# what a block may answer in place of a number of pairs
GIVE_UP = -1
GROW = -2


class _EarlyTermination(NamedTuple):
    """Bounds of the transmittance at early termination, the transmittance below which lists end, and rounding."""

    low: float
    high: float
    floor: float
    shrink: float
    grow: float


@njit(cache=True, error_model="numpy", forceinline=True)
def _start(numbers, inputs, block):
    """Reset a block's pixels and list positions; return the `DepthWindow`."""
    entries, per_pixel, lengths = block.entries, block.fragments.per_pixel, block.fragments.lengths
    for q in range(PIXELS):
        per_pixel[TLO + q] = 1.0
        per_pixel[THI + q] = 1.0
        per_pixel[LAST + q] = -1.0
        per_pixel[RHO + q] = 0.0
        per_pixel[LOST + q] = 0.0
        per_pixel[OPEN + q] = 0.0
        per_pixel[HIDDEN + q] = 0.0
        lengths[q] = 0
    room, largest = depth_radii(
        numbers, inputs.gaussians, inputs.axes.depth, block.ray, inputs.shape.monomials, entries
    )
    far = 0
    farthest = 0.0
    for k in range(numbers.size):
        entries.first[k] = k
        entries.last[k] = k
        block.reordering.slots[k] = -1
        entries.has_pixels[k] = 0
        if entries.depth_radius[k] > largest:
            entries.far[far] = k
            far += 1
            farthest = max(farthest, entries.depth_radius[k])
    # row 0 is for fragments that do not move
    for r in range(MOVES):
        block.reordering.moves[r] = 0.0
    return DepthWindow(room, largest, far, farthest)


@njit(cache=True, error_model="numpy")
def _still_live(lanes, pixels, live):
    """Return those ``lanes`` whose pixel is in the set ``live``."""
    left = 0
    while lanes != 0:
        lane = lowest_bit(lanes)
        lanes &= lanes - 1
        if live & (1 << int(pixels[lane])) != 0:
            left |= 1 << lane
    return left


@njit(cache=True, error_model="numpy", forceinline=True)
def _append(number, q, k, t_low, t_high, fragments):
    """Append fragment ``number`` to pixel q's list, with the transmittance behind it; return its position there."""
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
    """Append a Gaussian's fragments, of certain order, in those ``lanes`` that leave enough transmittance.

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
    """Append a Gaussian's fragments, of certain order, in ``lanes`` that early termination may hide (B6).

    Returns ``live`` without the pixels that surely terminate, and ``dim`` with those that get too little light.
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
    """Append the fragments of ``slot``, whose order is open; return ``dim`` and the number of moves with theirs."""
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
def set_colors(palette, k, color, color_rows, channels):
    """Write the colour of list position k to the palette; ``color`` [channels, color_rows] is the Gaussian's."""
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
    """Write ends of the colours of the list's entries from ``first`` on and of the background; mark them (B6)."""
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
        color = offset_by(values, i * color_columns)
        for channel in range(channels):
            at = channel * color_rows
            spread = 0.0
            for r in range(1, color_rows):
                spread += abs(color[at + r])
            unseen[channel] = min(unseen[channel], color[at] - spread * UP)
            unseen[4 + channel] = max(unseen[4 + channel], color[at] + spread * UP)


@njit(cache=True, error_model="numpy", forceinline=True)
def place_batch(start, some, live, listed, inputs, block):
    """Find the pixels of `FragmentBatch` on which ``some`` positions from ``start`` on may be drawn.

    Returns the number of pixels.
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
        pixels_once(start + b, listed, block.entries, block.fragments.per_pixel)
    end = 0
    for b in range(some):
        row = offset_by(listed.record, listed.numbers[start + b] * listed.columns)
        ox, oy = listed.x0 + 0.5 - row[MEAN_X], listed.y0 + 0.5 - row[MEAN_Y]
        pixels = live & block.entries.pixels[start + b]
        batch.begins[b] = end
        while pixels != 0:
            q = lowest_bit(pixels)
            pixels &= pixels - 1
            batch.pixels[end] = q
            batch.offset_x[end] = ox + (q & (BLOCK - 1))
            batch.offset_y[end] = oy + (q >> ROW_SHIFT)
            end += 1
    batch.begins[some] = end
    return end


@njit(cache=True, error_model="numpy", forceinline=True)
def find_alphas(start, some, used, place, listed, inputs, block):
    """Compute the alphas of `place_batch`'s positions: fragments from number ``used`` on, and `FragmentBatch.found`."""
    batch = block.batch
    for b in range(some):
        i = listed.numbers[start + b]
        begin = batch.begins[b]
        n = batch.begins[b + 1] - begin
        batch.found[b] = 0
        if n > 0:
            core = offset_by(listed.tiles, 8 * i + 4)
            sure = (
                core[0] <= place.tile_x
                and place.tile_x < core[1]
                and core[2] <= place.tile_y
                and place.tile_y < core[3]
            )
            offset = (used + begin) * block.fragments.width
            record = offset_by(listed.record, i * listed.columns)
            batch.found[b] = alphas(record, begin, n, offset, sure, block, inputs)


@njit(cache=True, error_model="numpy", forceinline=True)
def _hide_dim(dim, k, length, live, missing, fragments, stop_low):
    """Close the pixels ``dim`` behind position k, unless a listed fragment may still come behind it.

    Returns ``live`` without these pixels and the first position that is ``missing`` in any of them (B6).
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

    Fills ``block``, without its sums, from the Gaussians ``numbers`` (rows of ``inputs.gaussians``), nearest first.
    Sets ``marks_`` [n] for those that some open pixel may draw, or terminate at. Returns the number of pairs and of
    slots; or GIVE_UP where more pairs are open than fit, or GROW where another buffer is too small.

    A list may end where no pose leaves more light than ``inputs.cutoffs.floor``. All missing fragments are behind those
    in the list. Row OPEN of `Fragments.per_pixel` bounds the light that reaches them, `Palette.unseen` their colours;
    OPEN is 0 where none is missing, as with a negative floor. Row RHO receives the transmittance that an early
    termination, which the kept fragments ignore, may hide.
    """
    fragments, entries, reordering, batch = block.fragments, block.entries, block.reordering, block.batch
    charges, m = inputs.charges, inputs.shape.monomials
    colors, channels, marks = inputs.colors.values, inputs.colors.channels, pointer(marks_)
    listed = block_list(numbers, place, inputs)
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
        end = place_batch(start, some, live, listed, inputs, block)
        # eight at a time, some in excess
        if used + end + 8 > capacity * PIXELS or longest_list(fragments.lengths) + some > capacity:
            return GROW, 0
        find_alphas(start, some, used, place, listed, inputs, block)
        for b in range(some):
            lanes = batch.found[b]
            begin = batch.begins[b]
            pixels = offset_by(batch.pixels, begin)
            if live != begun:
                lanes = _still_live(lanes, pixels, live)
            if lanes == 0:
                continue
            k = start + b
            i = listed.numbers[k]
            pairs = find_pairs(k, lanes, pixels, listed, entries, fragments.per_pixel, window, reordering, pairs)
            if pairs < 0:
                return GIVE_UP, 0
            # threads share these bytes: written no more than once each
            if marks[i] == 0:
                marks[i] = 1
            color = offset_by(pointer(colors), i * color_columns)
            set_colors(block.palette, k, color, color_columns // channels, channels)
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
    """Drop or weaken the fragments of open depth order that early termination may hide (design.md, B6).

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
            per_pixel[HIDDEN + q] = max(per_pixel[HIDDEN + q], lost)
            if t_high <= stop_low:
                set_unknown(fragments, at, 0.0, m)
            elif lost < light:
                # kept; what the stop may leave of the light is added at the end
                per_pixel[RHO + q] = max(per_pixel[RHO + q], lost, per_pixel[LOST + q])
            else:
                set_unknown(fragments, at, high, m)
    # a stop at one of these also hides the kept fragments behind it
    for q in range(PIXELS):
        if per_pixel[RHO + q] > 0.0:
            per_pixel[RHO + q] = max(per_pixel[RHO + q], per_pixel[HIDDEN + q])


@njit(cache=True, error_model="numpy")
def number_groups(length, entries):
    """Write group numbers of list positions to ``entries.far``: no open pair spans two groups (design.md, O4)."""
    group = 0
    last = -1
    for k in range(length):
        if k > last:
            group += 1
        entries.far[k] = group
        last = max(last, entries.last[k])
