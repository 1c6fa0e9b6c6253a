"""Composites a pixel's fragments back to front as intervals, over a cell and over parts of it (design.md, B7, B12).

SIMD lanes 0 to 2 hold the channels and lane 3 is padding; or lanes are eight parts of the cell.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numba import njit

from ns_abstract.arithmetic.elementary import exp_kernel, fma
from ns_abstract.arithmetic.rounding import FRAGMENT_ROUNDING, MOVE_SHARE_UP, UP
from ns_abstract.arithmetic.simd.intrinsics import offset_by, prefetch
from ns_abstract.arithmetic.simd.lanes import LINE, lane_sum, load4, load8, maximum, minimum, store, where
from ns_abstract.methods.splat.pixel_block import (
    ALPHA_HIGH,
    ALPHA_LOW,
    EXPONENT,
    EXPONENT_CUT,
    LISTED,
    PART_ENDS,
    color_ends,
    exponent_ends,
    listed_fragment,
    part_axes,
)
from ns_abstract.methods.splat.stage_data import PART_LANES

#: Fragments ahead that are asked for.
AHEAD = 2


class BlendBounds(NamedTuple):
    """Bounds of a composited pixel, and of the colours in it; lanes are channels."""

    low: Any
    high: Any
    darkest: Any
    brightest: Any


class Thresholds(NamedTuple):
    """The least alpha that may be drawn, and the least value of the alpha cap."""

    drawn: float
    most: float


@njit(cache=True, error_model="numpy", forceinline=True)
def thresholds_of(inputs):
    """Return the `Thresholds` of a cell's rules in every evaluation (design.md, B4)."""
    rules, room = inputs.rules, 1.0 - inputs.charges.threshold
    return Thresholds(rules.alpha_min * room, rules.alpha_max * room)


@njit(cache=True, error_model="numpy", forceinline=True)
def blend_least(behind, color, a_low, a_high):
    """Return the least result of a fragment of ``color`` over something at least ``behind`` (design.md, B7)."""
    v = color - behind
    return fma(where(v < 0.0, a_high, a_low), v, behind)


@njit(cache=True, error_model="numpy", forceinline=True)
def blend_most(behind, color, a_low, a_high):
    """Return the largest result of a fragment of ``color`` over something at most ``behind`` (design.md, B7)."""
    v = color - behind
    return fma(where(v > 0.0, a_high, a_low), v, behind)


@njit(cache=True, error_model="numpy", forceinline=True)
def _least_moved(behind, color, brightest, a_low, a_high, move):
    """Return `blend_least` of a fragment that may be drawn behind some that are listed behind it (B12, O2, O3).

    ``brightest`` bounds their colours, ``move`` is the change that the swap bound allows.
    """
    front = blend_least(behind, color, a_low, a_high)
    return maximum(front - move, minimum(front, fma(a_high, min(0.0, color - brightest), behind)))


@njit(cache=True, error_model="numpy", forceinline=True)
def _most_moved(behind, color, darkest, a_low, a_high, move):
    """Return `blend_most` of a fragment that may be drawn behind some of those listed behind it; see `_least_moved`."""
    front = blend_most(behind, color, a_low, a_high)
    return minimum(front + move, maximum(front, fma(a_high, max(0.0, color - darkest), behind)))


@njit(cache=True, error_model="numpy", forceinline=True)
def blend_interval(behind, values, at, colors, ends):
    """Return one fragment over the interval ``behind`` (design.md, B7); its colour's bounds are at ``ends``."""
    a_low, a_high = values[at + ALPHA_LOW], values[at + ALPHA_HIGH]
    c_low, c_high = load4(colors, ends), load4(colors, ends + 4)
    return BlendBounds(
        blend_least(behind.low, c_low, a_low, a_high), blend_most(behind.high, c_high, a_low, a_high),
        minimum(behind.darkest, c_low), maximum(behind.brightest, c_high),
    )  # fmt: skip


@njit(cache=True, error_model="numpy", forceinline=True)
def part_alphas(values, at, part, inputs, thresholds):
    """Return least and largest alpha of the fragment at ``at`` over eight parts of the cell from ``part`` on (B12)."""
    middles, count = inputs.parts.middles, inputs.shape.parts
    e = at + EXPONENT
    zero = 0.0 * load8(middles, part)
    y1, y2 = zero + values[e], zero + values[e + 1]
    for k in range(part_axes(inputs.shape)):
        e += 2
        middle = load8(middles, count * k + part)
        y1 = fma(middle, values[e], y1)
        y2 = fma(middle, values[e + 1], y2)
    y1, y2 = abs(y1), abs(y2)
    ends = at + exponent_ends(inputs.shape.monomials)
    e1, e2 = values[ends], values[ends + 1]
    near1, near2, far1, far2 = maximum(0.0, y1 - e1), maximum(0.0, y2 - e2), y1 + e1, y2 + e2
    nearest = minimum((0.5 * (1.0 - FRAGMENT_ROUNDING)) * fma(near1, near1, near2 * near2), EXPONENT_CUT)
    farthest = minimum((0.5 * UP) * fma(far1, far1, far2 * far2), EXPONENT_CUT)
    high = minimum(values[ends + 3] * exp_kernel(-nearest), values[at + ALPHA_HIGH])
    low = minimum(values[ends + 2] * exp_kernel(-farthest), thresholds.most)
    low = maximum(where(low < values[ends + 4], 0.0, low), values[at + ALPHA_LOW])
    return low, where(high < thresholds.drawn, 0.0, high)


@njit(cache=True, error_model="numpy", forceinline=True)
def _add_parts(out, slopes, channel, low, high, part, inputs):
    """Write eight parts' ends of a channel to ``out`` and add them to the sums ``slopes``, see `blend_parts`."""
    store(out, PART_ENDS + inputs.shape.parts * channel + part, low)
    store(out, PART_ENDS + inputs.shape.parts * (3 + channel) + part, high)
    for k in range(part_axes(inputs.shape)):
        middle = load8(inputs.parts.middles, inputs.shape.parts * k + part)
        slopes[4 * k + channel] += lane_sum(middle * (low + high))


@njit(cache=True, error_model="numpy")
def sort_keys(keys, order, count):
    """Sort the first ``count`` of ``keys``, least first; ``order`` receives their former positions."""
    for e in range(count):
        order[e] = e
    # by insertion, after sorting what lies far apart: most groups are small
    step = 1
    while step < count // 3:
        step = 3 * step + 1
    while step > 0:
        for e in range(step, count):
            key, place = keys[e], order[e]
            other = e
            while other >= step and keys[other - step] > key:
                keys[other], order[other] = keys[other - step], order[other - step]
                other -= step
            keys[other], order[other] = key, place
        step //= 3


@njit(cache=True, error_model="numpy")
def _ordered_end(value, start, stop, channel, side, block, alphas):
    """Return one end of a channel over eight parts, for list entries [start, stop) in every order (design.md, B12, O4).

    Args:
        value: The end of the composite behind them.
        start, stop: The entries of a group.
        channel: 0 to 2.
        side: 0: the least, 1: the largest.
        block: The pixel's block.
        alphas: Bounds of alpha over the parts, two times eight for each entry.
    """
    fragments, palette = block.fragments, block.palette
    keys, order, forms, count = block.entries.depth_radius, block.entries.first, palette.forms, stop - start
    for e in range(count):
        _, key, _ = listed_fragment(fragments, start + e, forms)
        ends = key + color_ends(forms) + channel
        keys[e] = palette.values[ends] if side == 0 else -palette.values[ends + 4]
    sort_keys(keys, order, count)
    # nearest first: darkest for the least, brightest for the most
    for position in range(count - 1, -1, -1):
        at = 2 * PART_LANES * order[position]
        a_low, a_high = load8(alphas, at), load8(alphas, at + PART_LANES)
        if side == 0:
            value = blend_least(value, keys[position], a_low, a_high)
        else:
            value = blend_most(value, -keys[position], a_low, a_high)
    return value


@njit(cache=True, error_model="numpy")
def _blend_eight(begin, end, part, reordered, block, inputs, slopes):
    """Bound list entries [begin, end) over eight parts from number ``part`` on; return darkest and brightest."""
    fragments, palette, moves, out = block.fragments, block.palette, block.reordering.moves, block.part_ends
    values, colors, forms = fragments.values, palette.values, palette.forms
    alphas = offset_by(out, PART_ENDS + 6 * inputs.shape.parts)
    thresholds = thresholds_of(inputs)
    darkest = load4(palette.background, 0)
    brightest = darkest
    zero = 0.0 * load8(inputs.parts.middles, part)
    low0 = zero + palette.background[0]
    low1 = zero + palette.background[1]
    low2 = zero + palette.background[2]
    high0, high1, high2 = low0, low1, low2
    groups, lists = block.entries.far, fragments.lists
    stop = end
    while stop > begin:
        start, moved = stop - 1, False
        if reordered:
            group = groups[int(lists[LISTED * start + 1])]
            while start > begin and groups[int(lists[LISTED * (start - 1) + 1])] == group:
                start -= 1
        behind = low0, low1, low2, high0, high1, high2
        for entry in range(stop - 1, start - 1, -1):
            ahead, _, _ = listed_fragment(fragments, max(entry - AHEAD, begin), forms)
            for byte in range(0, 8 * fragments.width, LINE):
                prefetch(values, ahead, byte)
            at, key, move = listed_fragment(fragments, entry, forms)
            a_low, a_high = part_alphas(values, at, part, inputs, thresholds)
            c = key + color_ends(forms)
            if stop - start > 1:
                store(alphas, 2 * PART_LANES * (entry - start), a_low)
                store(alphas, 2 * PART_LANES * (entry - start) + PART_LANES, a_high)
            if move != 0:
                moved = True
                # of the colours behind this one
                store(out, 0, darkest)
                store(out, 4, brightest)
                share = minimum(1.0, a_high * (MOVE_SHARE_UP / values[at + ALPHA_HIGH]))
                low0 = _least_moved(low0, colors[c], out[4], a_low, a_high, share * moves[move])
                low1 = _least_moved(low1, colors[c + 1], out[5], a_low, a_high, share * moves[move + 1])
                low2 = _least_moved(low2, colors[c + 2], out[6], a_low, a_high, share * moves[move + 2])
                high0 = _most_moved(high0, colors[c + 4], out[0], a_low, a_high, share * moves[move + 4])
                high1 = _most_moved(high1, colors[c + 5], out[1], a_low, a_high, share * moves[move + 5])
                high2 = _most_moved(high2, colors[c + 6], out[2], a_low, a_high, share * moves[move + 6])
            else:
                low0 = blend_least(low0, colors[c], a_low, a_high)
                low1 = blend_least(low1, colors[c + 1], a_low, a_high)
                low2 = blend_least(low2, colors[c + 2], a_low, a_high)
                high0 = blend_most(high0, colors[c + 4], a_low, a_high)
                high1 = blend_most(high1, colors[c + 5], a_low, a_high)
                high2 = blend_most(high2, colors[c + 6], a_low, a_high)
            darkest, brightest = minimum(darkest, load4(colors, c)), maximum(brightest, load4(colors, c + 4))
        if moved and stop - start > 1:
            low0 = maximum(low0, _ordered_end(behind[0], start, stop, 0, 0, block, alphas))
            low1 = maximum(low1, _ordered_end(behind[1], start, stop, 1, 0, block, alphas))
            low2 = maximum(low2, _ordered_end(behind[2], start, stop, 2, 0, block, alphas))
            high0 = minimum(high0, _ordered_end(behind[3], start, stop, 0, 1, block, alphas))
            high1 = minimum(high1, _ordered_end(behind[4], start, stop, 1, 1, block, alphas))
            high2 = minimum(high2, _ordered_end(behind[5], start, stop, 2, 1, block, alphas))
        stop = start
    _add_parts(out, slopes, 0, low0, high0, part, inputs)
    _add_parts(out, slopes, 1, low1, high1, part, inputs)
    _add_parts(out, slopes, 2, low2, high2, part, inputs)
    return darkest, brightest


@njit(cache=True, error_model="numpy")
def blend_parts(begin, end, reordered, block, inputs, slopes):
    """Bound the list entries [begin, end) of a pixel by intervals over the parts of the cell (design.md, B12).

    ``reordered``: whether fragments may change their order. ``slopes`` [d, 4] receives the variation of the channels
    along the parameters, estimated from the parts.
    """
    out, parts, d = block.part_ends, inputs.parts, inputs.shape.dimensions
    for k in range(4 * d):
        slopes[k] = 0.0
    darkest, brightest = _blend_eight(begin, end, 0, reordered, block, inputs, slopes)
    for part in range(PART_LANES, inputs.shape.parts, PART_LANES):
        _blend_eight(begin, end, part, reordered, block, inputs, slopes)
    for k in range(part_axes(inputs.shape)):
        store(slopes, 4 * k, parts.slope[k] * load4(slopes, 4 * k))
    for side in range(2):
        for channel in range(3):
            at = PART_ENDS + inputs.shape.parts * (3 * side + channel)
            ends = load8(out, at)
            for part in range(PART_LANES, inputs.shape.parts, PART_LANES):
                more = load8(out, at + part)
                ends = maximum(ends, more) if side else minimum(ends, more)
            store(out, PART_LANES, ends)
            value = out[PART_LANES]
            for lane in range(1, PART_LANES):
                other = out[PART_LANES + lane]
                value = max(value, other) if side else min(value, other)
            out[4 * side + channel] = value
        # the lane of nothing
        out[4 * side + 3] = 0.0
    return BlendBounds(load4(out, 0), load4(out, 4), darkest, brightest)


@njit(cache=True, error_model="numpy")
def write_parts(fall, rise, part_ends, out, u):
    """Write the ends of `blend_parts` or `bound_sub_boxes`, widened by ``fall`` and ``rise``, to ``out`` [6, parts].

    Ends that cross or are NaN are written unchanged: they bound nothing. ``u`` is scratch for 8 numbers.
    """
    parts = out.shape[1]
    store(u, 0, -fall)
    store(u, 4, rise)
    for side in range(2):
        for channel in range(3):
            row = 3 * side + channel
            for part in range(parts):
                out[row, part] = part_ends[PART_ENDS + parts * row + part] + u[4 * side + channel]
