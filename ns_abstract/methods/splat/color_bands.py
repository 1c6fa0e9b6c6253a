"""Bounds one end of a pixel over strips of eight sub-boxes, by bands of colour (docs/dev/design.md, B14).

A band is an interval of colour values; a colour is the sum of the bands that it reaches. SIMD lanes are the sub-boxes
of a strip.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.elementary import fma
from ns_abstract.arithmetic.rounding import BAND_ROUNDING, SECOND_ORDER
from ns_abstract.arithmetic.simd.intrinsics import lowest_bit
from ns_abstract.arithmetic.simd.lanes import bits, load8, maximum, minimum, store, where
from ns_abstract.methods.splat.intervals import part_alphas, sort_keys
from ns_abstract.methods.splat.lists import BLOCK
from ns_abstract.methods.splat.stage_data import PART_LANES

#: Bits of a set of eight lanes.
_ALL = 255


@dataclass(frozen=True)
class ColorBandTuning:
    """The number of bands, and where lists end; soundness does not depend on them."""

    #: Bands of colour.
    bands: int = 8
    #: Least range of colours that is divided.
    least: float = 2.0**-20
    #: How much of an end is not looked at any more.
    worth: float = 2.0**-8


BANDS = ColorBandTuning.bands
_LEAST = ColorBandTuning.least
_WORTH = ColorBandTuning.worth


class ColorEnd(NamedTuple):
    """One row of `ColorEnds`: number, colours, background, number of the opposite end, and the brightest colour."""

    row: int
    colors: np.ndarray
    background: float
    opposite: float
    bright: float


class BandSums(NamedTuple):
    """Sums of a pixel over strips of eight sub-boxes; lanes are the sub-boxes of a strip.

    Attributes:
        levels: [bands + 1] colours between which the bands lie; no colour is beyond the last one.
        drawn, transmittance, occluded: [strips, bands, 8] A, B and C of B14. The picture reaches at most ``drawn`` of a
            band, plus ``transmittance`` times what the fragments behind reach, plus ``occluded``, which is not
            positive, times that at the band's end.
        least_transmittance, most_transmittance: [strips, 8] of the fragments so far, in any order.
        stopped: [strips, 8] largest transmittance at an early termination.
    """

    levels: np.ndarray
    drawn: np.ndarray
    transmittance: np.ndarray
    occluded: np.ndarray
    least_transmittance: np.ndarray
    most_transmittance: np.ndarray
    stopped: np.ndarray


class EndCharges(NamedTuple):
    """Charges on an end (design.md, B6, B8, B14).

    Attributes:
        slack: For rounding, and for omitted fragments.
        hidden: Largest rise of an end by light that an early termination leaves.
        stop: Transmittance of early termination; not positive: there is none.
        dark: Least transmittance of all fragments above which none terminated.
        grown: Factor on the program's transmittance.
    """

    slack: float
    hidden: float
    stop: float
    dark: float
    grown: float


@njit(cache=True, error_model="numpy", forceinline=True)
def end_charges(count, inputs, end):
    """Return the `EndCharges` of a pixel of ``count`` fragments."""
    charges = inputs.charges
    # rounding of the program's own sums and products
    rounding = (charges.blend_fragment * count + charges.blend_pixel) * end.bright * SECOND_ORDER
    own = BAND_ROUNDING * (count + BANDS) * end.bright
    slack = rounding + own + inputs.colors.error + inputs.cutoffs.negligible * end.bright
    # a stop shows the background in place of what lies behind it
    hidden = (abs(end.opposite - end.background) + rounding) * (1.0 + charges.lost_light)
    stop = inputs.rules.transmittance_min * (1.0 + charges.transmittance)
    # two roundings of the light by fragment
    grown = 1.0 + charges.transmittance * count
    return EndCharges(slack, hidden, stop, stop * grown, grown)


@njit(cache=True, error_model="numpy")
def choose_levels(looked_at, count, end, work, sums):
    """Choose levels among the colours of the first ``looked_at`` fragments, half by weight and half by range."""
    levels, colors, most, total = sums.levels, work.colors, end.background, work.weights[looked_at]
    for k in range(count):
        most = max(most, end.colors[work.numbers[k]])
    for k in range(looked_at):
        total += work.weights[k]
        colors[k] = end.colors[work.numbers[k]]
    colors[looked_at] = end.background
    sort_keys(colors, work.order, looked_at + 1)
    first, last, level, weight = colors[0], colors[0], 0, 0.0
    span = max(colors[looked_at] - first, _LEAST)
    for k in range(looked_at + 1):
        # the part of all that is divided up to this colour, without it and with it
        spread = 0.5 * (colors[k] - first) / span
        while level < BANDS - 1 and level / (BANDS - 1) < spread + weight:
            levels[level] = last = min(max(last, first + 2.0 * span * (level / (BANDS - 1) - weight)), colors[k])
            level += 1
        weight += 0.5 * work.weights[work.order[k]] / total
        while level < BANDS - 1 and level / (BANDS - 1) <= spread + weight:
            levels[level] = last = colors[k]
            level += 1
    while level < BANDS:
        levels[level] = colors[looked_at]
        level += 1
    levels[BANDS] = max(most, colors[looked_at])


@njit(cache=True, error_model="numpy", forceinline=True)
def share_of(color, band, levels):
    """Return the fraction of a band that a colour, which is not beyond it, reaches."""
    if band >= BANDS or not color > levels[band]:
        return 0.0
    return (color - levels[band]) / (levels[band + 1] - levels[band])


@njit(cache=True, error_model="numpy", forceinline=True)
def occlude(e, open_, dark, parts, work, sums):
    """Let fragment e occlude the fragments behind it in the bands that its colour does not reach (design.md, B14).

    Early termination at it is possible only where the transmittance of all that may come before it is at most ``dark``.
    """
    strips, below, share = work.strips[e] & open_, work.below[e], work.share[e]
    while strips != 0:
        strip = lowest_bit(strips)
        strips &= strips - 1
        part = PART_LANES * strip
        low = load8(work.low, 2 * parts * e + part)
        stopped = where(
            load8(sums.least_transmittance, part) > dark, 0.0, load8(work.low, 2 * parts * e + parts + part)
        )
        store(sums.stopped, part, maximum(load8(sums.stopped, part), stopped))
        left, first = 1.0 - low, below
        store(sums.most_transmittance, part, load8(sums.most_transmittance, part) * left)
        if share > 0.0:
            at = PART_LANES * (strip * BANDS + below)
            covered = (1.0 - share) * low
            store(sums.occluded, at, fma(left, load8(sums.occluded, at), -covered * load8(sums.transmittance, at)))
            first += 1
        for band in range(first, BANDS):
            at = PART_LANES * (strip * BANDS + band)
            store(sums.transmittance, at, load8(sums.transmittance, at) * left)
            store(sums.occluded, at, load8(sums.occluded, at) * left)


@njit(cache=True, error_model="numpy", forceinline=True)
def composite(k, strips, values, at, thresholds, charges, inputs, work, sums):
    """Composite fragment k over the bands that its colour reaches, with its largest alpha (design.md, B14)."""
    below, share, parts = work.below[k], work.share[k], inputs.shape.parts
    while strips != 0:
        strip = lowest_bit(strips)
        strips &= strips - 1
        part = PART_LANES * strip
        low, high = part_alphas(values, at, part, inputs, thresholds)
        left = 1.0 - high
        store(work.low, 2 * parts * k + part, low)
        stopped = minimum(
            charges.stop / maximum(left, charges.stop), charges.grown * load8(sums.most_transmittance, part)
        )
        store(work.low, 2 * parts * k + parts + part, stopped)
        store(sums.least_transmittance, part, load8(sums.least_transmittance, part) * left)
        for band in range(below):
            place = PART_LANES * (strip * BANDS + band)
            transmittance, occluded = load8(sums.transmittance, place), load8(sums.occluded, place)
            store(sums.drawn, place, fma(transmittance + occluded, high, load8(sums.drawn, place)))
            store(sums.transmittance, place, transmittance * left)
            store(sums.occluded, place, occluded * left)
        if share > 0.0:
            place = PART_LANES * (strip * BANDS + below)
            transmittance, drawn = load8(sums.transmittance, place), share * high
            store(sums.drawn, place, fma(transmittance, drawn, load8(sums.drawn, place)))
            store(sums.transmittance, place, transmittance * (1.0 - drawn))


@njit(cache=True, error_model="numpy", forceinline=True)
def retire_decided_strips(open_, goal, charges, sums):
    """Return the strips of ``open_`` that are not decided; in the others everything behind counts as drawn.

    A strip is decided where little can follow, or where its ends are surely below ``goal``, or beyond it already.
    """
    some = open_
    while some != 0:
        strip = lowest_bit(some)
        some &= some - 1
        begin = PART_LANES * strip * BANDS
        rest = 0.0 * load8(sums.transmittance, begin)
        end = rest + sums.levels[0]
        for band in range(BANDS):
            step = sums.levels[band + 1] - sums.levels[band]
            end = fma(step, load8(sums.drawn, begin + PART_LANES * band), end)
            rest = fma(step, load8(sums.transmittance, begin + PART_LANES * band), rest)
        most = end + rest + (charges.slack + charges.hidden * load8(sums.stopped, PART_LANES * strip))
        if bits(rest <= _WORTH) | bits(end >= goal) | bits(most <= goal) == _ALL:
            for band in range(BANDS):
                at = begin + PART_LANES * band
                store(sums.drawn, at, load8(sums.drawn, at) + load8(sums.transmittance, at))
            open_ &= ~(1 << strip)
    return open_


@njit(cache=True, error_model="numpy")
def keep_possible_stops(closed, last, past, count, parts, work, sums):
    """Allow early termination, in strips ``closed``, at each fragment up to ``last`` whose far end is not passed."""
    if closed == 0:
        return
    for place in range(past, count):
        e = work.by_far[place]
        strips = work.strips[e] & closed if e <= last else 0
        while strips != 0:
            part = PART_LANES * lowest_bit(strips)
            strips &= strips - 1
            stopped = load8(work.low, 2 * parts * e + parts + part)
            store(sums.stopped, part, maximum(load8(sums.stopped, part), stopped))


@njit(cache=True, error_model="numpy")
def write_end(q, open_, charges, place, end, sums, out):
    """Write pixel q's ends with their charges to ``out`` [side, side, 6, parts] (design.md, B6, B8, B14).

    ``open_``: the strips in which the background may be visible. ``place``: the block of pixels.
    """
    side, levels = out.shape[0], sums.levels
    ends = out[place.y0 % side + q // BLOCK, place.x0 % side + q % BLOCK, end.row]
    for lane in range(ends.size):
        strip = lane // PART_LANES
        sees_background = open_ & (1 << strip) != 0
        value = levels[0]
        for band in range(BANDS):
            at = PART_LANES * (strip * BANDS + band) + lane % PART_LANES
            drawn = sums.drawn[at]
            if sees_background and end.background >= levels[band + 1]:
                drawn += sums.transmittance[at] + sums.occluded[at]
            elif sees_background:
                drawn += share_of(end.background, band, levels) * sums.transmittance[at]
            value += (levels[band + 1] - levels[band]) * min(drawn, 1.0)
        value = min(value + sums.stopped[lane] * charges.hidden, levels[BANDS])
        value += charges.slack
        ends[lane] = value if end.row >= 3 else -value
