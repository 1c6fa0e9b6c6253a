"""Bounds of a pixel whose fragments have an open depth order (docs/dev/design.md, O2-O4).

SIMD lanes 0 to 2 hold the channels; lane 3 is padding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from numba import njit

from ns_abstract.arithmetic.elementary import fma
from ns_abstract.arithmetic.rounding import SWAP_ROUNDING, UP
from ns_abstract.arithmetic.simd.intrinsics import lowest_bit
from ns_abstract.arithmetic.simd.lanes import bits, load4, load8, maximum, minimum, store
from ns_abstract.methods.splat.intervals import BlendBounds, blend_interval, sort_keys
from ns_abstract.methods.splat.lists import PIXELS
from ns_abstract.methods.splat.pixel_block import (
    ALPHA_HIGH,
    ALPHA_LOW,
    LIGHT,
    LISTED,
    color_ends,
    color_size,
    listed_fragment,
)


@dataclass(frozen=True)
class OrderTuning:
    """When reordering is bounded more tightly than by the swap bound; soundness does not depend on it."""

    #: Reordering that moves no channel of a pixel by more is not examined beyond the swap bound.
    reordering_matters: float = 1e-4


_REORDERING_MATTERS = OrderTuning.reordering_matters


class ReorderScratch(NamedTuple):
    """Memory for `_interval_group`: 16 numbers, then keys and places by list position."""

    numbers: Any
    keys: Any
    order: Any


@njit(cache=True, error_model="numpy")
def swap_bounds(pairs, slots, block):
    """Bound the change of colours by reordering when a fragment joins those behind it (design.md, O2).

    ``pairs`` and ``slots`` are their numbers. The first half of a fragment's row of ``moves`` becomes the largest fall
    of three channels, and of padding, then the largest rise.
    """
    fragments, palette, reordering = block.fragments, block.palette, block.reordering
    colors, forms, moves = palette.values, palette.forms, reordering.moves
    values, capacity, places = fragments.values, fragments.capacity, reordering.places
    for p in range(pairs):
        k, other = reordering.pairs[2 * p], reordering.pairs[2 * p + 1]
        front, back = reordering.slots[k], reordering.slots[other]
        if front < 0 or back < 0:
            continue
        both = reordering.drawn[front] & reordering.drawn[back]
        if both == 0:
            continue
        # bounds of the colours
        e, f = k * color_size(forms) + color_ends(forms), other * color_size(forms) + color_ends(forms)
        falls = maximum(0.0, load4(colors, e + 4) - load4(colors, f))
        rises = maximum(0.0, load4(colors, f + 4) - load4(colors, e))
        while both != 0:
            q = lowest_bit(both)
            both &= both - 1
            at, _, _ = listed_fragment(fragments, q * capacity + int(places[back * PIXELS + q]), forms)
            _, _, move = listed_fragment(fragments, q * capacity + int(places[front * PIXELS + q]), forms)
            alpha = values[at + ALPHA_HIGH]
            store(moves, move, fma(alpha, falls, load4(moves, move)))
            store(moves, move + 4, fma(alpha, rises, load4(moves, move + 4)))
            store(moves, move + 8, maximum(load4(moves, move + 8), falls))
            store(moves, move + 12, maximum(load4(moves, move + 12), rises))
    # one rounding by pair
    up = UP + SWAP_ROUNDING * pairs
    for slot in range(slots):
        some = reordering.drawn[slot]
        while some != 0:
            q = lowest_bit(some)
            some &= some - 1
            at, _, move = listed_fragment(fragments, q * capacity + int(places[slot * PIXELS + q]), forms)
            # the weights of the fragments it may move behind add up to at most one
            store(moves, move, values[at + ALPHA_HIGH] * minimum(load8(moves, move), load8(moves, move + 8)) * up)


@njit(cache=True, error_model="numpy")
def _interval_group(start, stop, behind, fragments, palette, moves, scratch):
    """Blend list entries [start, stop) of open order over ``behind``, by intervals (design.md, O2-O4).

    Returns the tightest of the swap, hull and antichain bounds.
    """
    values, colors, forms = fragments.values, palette.values, palette.forms
    t, keys, order = scratch.numbers, scratch.keys, scratch.order
    store(t, 8, behind.low)
    store(t, 12, behind.high)
    for entry in range(stop - 1, start - 1, -1):
        at, key, move = listed_fragment(fragments, entry, forms)
        ends = key + color_ends(forms)
        a_high = values[at + ALPHA_HIGH]
        # wherever it goes among the fragments behind, it moves the colour by at most its alpha times
        # the distance to the darkest or brightest of what lies behind
        hull_low = fma(a_high, minimum(0.0, load4(colors, ends) - behind.brightest), behind.low)
        hull_high = fma(a_high, maximum(0.0, load4(colors, ends + 4) - behind.darkest), behind.high)
        front = blend_interval(behind, values, at, colors, ends)
        hull_low, hull_high = minimum(front.low, hull_low), maximum(front.high, hull_high)
        low = maximum(front.low - load4(moves, move), hull_low)
        high = minimum(front.high + load4(moves, move + 4), hull_high)
        behind = BlendBounds(low, high, front.darkest, front.brightest)
    store(t, 0, behind.low)
    store(t, 4, behind.high)
    count = stop - start
    for channel in range(3):
        for side in range(2):
            for e in range(count):
                _, key, _ = listed_fragment(fragments, start + e, forms)
                ends = key + color_ends(forms) + channel
                keys[e] = colors[ends] if side == 0 else -colors[ends + 4]
            sort_keys(keys, order, count)
            value = t[8 + 4 * side + channel]
            # nearest first: darkest for the lower bound, brightest for the upper one
            for position in range(count - 1, -1, -1):
                at, _, _ = listed_fragment(fragments, start + order[position], forms)
                color = keys[position] if side == 0 else -keys[position]
                v = color - value
                grows = v < 0.0 if side == 0 else v > 0.0
                value += values[at + (ALPHA_HIGH if grows else ALPHA_LOW)] * v
            if side == 0:
                t[channel] = max(t[channel], value)
            else:
                t[4 + channel] = min(t[4 + channel], value)
    return BlendBounds(load4(t, 0), load4(t, 4), behind.darkest, behind.brightest)


@njit(cache=True, error_model="numpy", forceinline=True)
def _worth_reordering(begin, end, ends, form_low, form_high, fragments, forms, moves):
    """Return whether rules O3 and O4, for open depth orders, may tighten a pixel's bounds notably beyond its forms."""
    falls = 0.0 * ends.low
    rises = falls
    for entry in range(begin, end):
        _, _, move = listed_fragment(fragments, entry, forms)
        if move != 0:
            light = fragments.light[2 * entry + LIGHT]
            falls = fma(light, load4(moves, move), falls)
            rises = fma(light, load4(moves, move + 4), rises)
    gain = maximum(minimum(falls, ends.low + falls - form_low), minimum(rises, form_high - (ends.high - rises)))
    return bits(gain > _REORDERING_MATTERS) != 0


@njit(cache=True, error_model="numpy", forceinline=True)
def sharpened(begin, end, ends, form_low, form_high, block, scratch):
    """Return bounds ``ends`` of a pixel with open depth orders, tightened where that may pay (O4).

    The pixel's list entries are [begin, end); ``form_low`` and ``form_high`` are its bounds by forms.
    """
    fragments, palette, moves, group = block.fragments, block.palette, block.reordering.moves, block.entries.far
    lists, forms = fragments.lists, palette.forms
    low, high = ends.low, ends.high
    if not _worth_reordering(begin, end, ends, form_low, form_high, fragments, forms, moves):
        return low, high
    background = load4(palette.background, 0)
    value = BlendBounds(background, background, background, background)
    stop = end
    while stop > begin:
        start = stop - 1
        number = group[int(lists[LISTED * start + 1])]
        while start > begin and group[int(lists[LISTED * (start - 1) + 1])] == number:
            start -= 1
        if stop - start == 1:
            at, key, _ = listed_fragment(fragments, start, forms)
            value = blend_interval(value, fragments.values, at, palette.values, key + color_ends(forms))
        else:
            value = _interval_group(start, stop, value, fragments, palette, moves, scratch)
        stop = start
    return maximum(low, value.low), minimum(high, value.high)
