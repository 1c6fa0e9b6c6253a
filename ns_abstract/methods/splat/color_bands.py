"""One end of a pixel over strips of eight sub-boxes, by bands of colour (design.md, B14).

SIMD lanes are the sub-boxes of a strip.
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
    """How many bands of colour there are, and where lists end. Neither decides whether a bound holds."""

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
    """One row of `ColorEnds`: number, colours, background, the opposite end, and the brightest of all rows."""

    row: int
    colors: np.ndarray
    background: float
    opposite: float
    bright: float


class BandSums(NamedTuple):
    """Sums of a pixel over strips of eight sub-boxes; lanes are the sub-boxes of a strip.

    Attributes:
        levels: [bands + 1] colours that the bands lie between, the last of which none is beyond.
        lit, light, less: [strips, bands, 8] the part of a band that the picture reaches is at most ``lit``, ``light``
            times that of what follows, and ``less``, which is not positive, times what it is at the band's end.
        least, most: [strips, 8] light that the fragments so far leave, whatever their order.
        lost: [strips, 8] most light that a stop leaves.
    """

    levels: np.ndarray
    lit: np.ndarray
    light: np.ndarray
    less: np.ndarray
    least: np.ndarray
    most: np.ndarray
    lost: np.ndarray


class EndCharges(NamedTuple):
    """What is added to an end (design.md, B6, B8, B14).

    Attributes:
        slack: For rounding, and for what was left out.
        hidden: Most by which light that a stop leaves raises an end.
        stop: Light at which fragments stop; not positive: they do not.
        dark: Least light of all fragments beyond which none stopped.
        grown: By how much the program's light may be more.
    """

    slack: float
    hidden: float
    stop: float
    dark: float
    grown: float


@njit(cache=True, error_model="numpy", forceinline=True)
def charges_of(count, inputs, end):
    """The `EndCharges` of a pixel of ``count`` fragments."""
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
def set_levels(known, count, end, work, sums):
    """Choose levels among the colours of the ``known`` fragments: half by their weights, half by their range."""
    levels, colors, most, total = sums.levels, work.colors, end.background, work.weights[known]
    for k in range(count):
        most = max(most, end.colors[work.numbers[k]])
    for k in range(known):
        total += work.weights[k]
        colors[k] = end.colors[work.numbers[k]]
    colors[known] = end.background
    sort_keys(colors, work.order, known + 1)
    first, last, level, seen = colors[0], colors[0], 0, 0.0
    span = max(colors[known] - first, _LEAST)
    for k in range(known + 1):
        # the part of all that is divided up to this colour, without it and with it
        reached = 0.5 * (colors[k] - first) / span
        while level < BANDS - 1 and level / (BANDS - 1) < reached + seen:
            levels[level] = last = min(max(last, first + 2.0 * span * (level / (BANDS - 1) - seen)), colors[k])
            level += 1
        seen += 0.5 * work.weights[work.order[k]] / total
        while level < BANDS - 1 and level / (BANDS - 1) <= reached + seen:
            levels[level] = last = colors[k]
            level += 1
    while level < BANDS:
        levels[level] = colors[known]
        level += 1
    levels[BANDS] = max(most, colors[known])


@njit(cache=True, error_model="numpy", forceinline=True)
def share_of(color, band, levels):
    """The part of a band that a colour which is not beyond it reaches."""
    if band >= BANDS or not color > levels[band]:
        return 0.0
    return (color - levels[band]) / (levels[band + 1] - levels[band])


@njit(cache=True, error_model="numpy", forceinline=True)
def cover(e, open_, dark, parts, work, sums):
    """Let fragment e cover what comes behind it in the bands that its colour does not reach (design.md, B14).

    It is a stop only where all that may come before it leaves no more light than ``dark``.
    """
    met, below, share = work.met[e] & open_, work.below[e], work.share[e]
    while met != 0:
        strip = lowest_bit(met)
        met &= met - 1
        part = PART_LANES * strip
        low = load8(work.low, 2 * parts * e + part)
        lost = where(load8(sums.least, part) > dark, 0.0, load8(work.low, 2 * parts * e + parts + part))
        store(sums.lost, part, maximum(load8(sums.lost, part), lost))
        left, first = 1.0 - low, below
        store(sums.most, part, load8(sums.most, part) * left)
        if share > 0.0:
            at = PART_LANES * (strip * BANDS + below)
            covered = (1.0 - share) * low
            store(sums.less, at, fma(left, load8(sums.less, at), -covered * load8(sums.light, at)))
            first += 1
        for band in range(first, BANDS):
            at = PART_LANES * (strip * BANDS + band)
            store(sums.light, at, load8(sums.light, at) * left)
            store(sums.less, at, load8(sums.less, at) * left)


@njit(cache=True, error_model="numpy", forceinline=True)
def show(k, met, values, at, thresholds, charges, inputs, work, sums):
    """Draw fragment k in the bands that its colour reaches, as much of it as there may be (design.md, B14)."""
    below, share, parts = work.below[k], work.share[k], inputs.shape.parts
    while met != 0:
        strip = lowest_bit(met)
        met &= met - 1
        part = PART_LANES * strip
        low, high = part_alphas(values, at, part, inputs, thresholds)
        left = 1.0 - high
        store(work.low, 2 * parts * k + part, low)
        lost = minimum(charges.stop / maximum(left, charges.stop), charges.grown * load8(sums.most, part))
        store(work.low, 2 * parts * k + parts + part, lost)
        store(sums.least, part, load8(sums.least, part) * left)
        for band in range(below):
            place = PART_LANES * (strip * BANDS + band)
            light, less = load8(sums.light, place), load8(sums.less, place)
            store(sums.lit, place, fma(light + less, high, load8(sums.lit, place)))
            store(sums.light, place, light * left)
            store(sums.less, place, less * left)
        if share > 0.0:
            place = PART_LANES * (strip * BANDS + below)
            light, drawn = load8(sums.light, place), share * high
            store(sums.lit, place, fma(light, drawn, load8(sums.lit, place)))
            store(sums.light, place, light * (1.0 - drawn))


@njit(cache=True, error_model="numpy", forceinline=True)
def close_settled(open_, goal, charges, sums):
    """Let all of the light be lit where no more of it matters; returns the strips that stay open.

    That is where little is left, where the ends are below ``goal`` anyhow, or beyond it already.
    """
    some = open_
    while some != 0:
        strip = lowest_bit(some)
        some &= some - 1
        begin = PART_LANES * strip * BANDS
        rest = 0.0 * load8(sums.light, begin)
        end = rest + sums.levels[0]
        for band in range(BANDS):
            step = sums.levels[band + 1] - sums.levels[band]
            end = fma(step, load8(sums.lit, begin + PART_LANES * band), end)
            rest = fma(step, load8(sums.light, begin + PART_LANES * band), rest)
        most = end + rest + (charges.slack + charges.hidden * load8(sums.lost, PART_LANES * strip))
        if bits(rest <= _WORTH) | bits(end >= goal) | bits(most <= goal) == _ALL:
            for band in range(BANDS):
                at = begin + PART_LANES * band
                store(sums.lit, at, load8(sums.lit, at) + load8(sums.light, at))
            open_ &= ~(1 << strip)
    return open_


@njit(cache=True, error_model="numpy")
def note_stops(closed, last, past, count, parts, work, sums):
    """Let each fragment up to ``last`` whose far end is not passed be a stop in the strips ``closed``."""
    if closed == 0:
        return
    for place in range(past, count):
        e = work.by_far[place]
        met = work.met[e] & closed if e <= last else 0
        while met != 0:
            part = PART_LANES * lowest_bit(met)
            met &= met - 1
            lost = load8(work.low, 2 * parts * e + parts + part)
            store(sums.lost, part, maximum(load8(sums.lost, part), lost))


@njit(cache=True, error_model="numpy")
def write_end(q, open_, charges, place, end, sums, out):
    """Write pixel q's ends with their charges to ``out`` [side, side, 6, parts] (design.md, B6, B8, B14).

    ``open_``: the strips that the background may be seen in.
    """
    side, levels = out.shape[0], sums.levels
    ends = out[place.y0 % side + q // BLOCK, place.x0 % side + q % BLOCK, end.row]
    for lane in range(ends.size):
        strip = lane // PART_LANES
        shown = open_ & (1 << strip) != 0
        value = levels[0]
        for band in range(BANDS):
            at = PART_LANES * (strip * BANDS + band) + lane % PART_LANES
            lit = sums.lit[at]
            if shown and end.background >= levels[band + 1]:
                lit += sums.light[at] + sums.less[at]
            elif shown:
                lit += share_of(end.background, band, levels) * sums.light[at]
            value += (levels[band + 1] - levels[band]) * min(lit, 1.0)
        value = min(value + sums.lost[lane] * charges.hidden, levels[BANDS])
        value += charges.slack
        ends[lane] = value if end.row >= 3 else -value
