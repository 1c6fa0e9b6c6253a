"""Composites a pixel's fragments back to front, as forms and as intervals (docs/dev/design.md, B7-B11, O2-O4).

SIMD lanes 0 to 2 hold the channels; lane 3 is padding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from numba import njit

from ns_abstract.arithmetic.elementary import fma
from ns_abstract.arithmetic.rounding import (
    CURVE_ROUNDING,
    FRAGMENT_ROUNDING,
    LAYER_ROUNDING,
    PIXEL_RANGE_ROUNDING,
    SECOND_ORDER,
    UP,
)
from ns_abstract.arithmetic.simd.intrinsics import lowest_bit, offset_by, prefetch, signed
from ns_abstract.arithmetic.simd.lanes import LINE, bits, load4, maximum, minimum, store, where
from ns_abstract.methods.splat.form_sub_boxes import bound_sub_boxes
from ns_abstract.methods.splat.intervals import AHEAD, BlendBounds, blend_interval, blend_parts, write_parts
from ns_abstract.methods.splat.lists import BLOCK
from ns_abstract.methods.splat.pixel_block import (
    ALPHA_HIGH,
    ALPHA_LOW,
    BEND,
    BEND_SPREAD,
    FORM,
    HIDDEN,
    LEFT,
    LIGHT,
    OPEN,
    RHO,
    color_ends,
    crossing_of,
    listed_fragment,
    parabola,
)
from ns_abstract.methods.splat.reordering import ReorderScratch, sharpened
from ns_abstract.methods.splat.threshold_crossings import bound_by_parts, clear_slopes, gather_crossings, set_blend


@dataclass(frozen=True)
class BlendTuning:
    """When fragments that some poses skip are bounded jointly; soundness does not depend on it."""

    #: Crossings are looked at together where they may widen a pixel by more than this part.
    crossings_matter: float = 2.0**-4


_CROSSINGS_MATTER = BlendTuning.crossings_matter


class _PixelResult(NamedTuple):
    """Bounds and form of a pixel; lanes are channels.

    Attributes:
        low, high: Bounds by forms.
        ends: Bounds by intervals.
        center, radius: Of the linear sets, whose slopes are those of the polynomials.
    """

    low: Any
    high: Any
    ends: Any
    center: Any
    radius: Any


class _Blend(NamedTuple):
    """A composited pixel; lanes are channels.

    Attributes:
        radius: Of the polynomials.
        ends: Bounds by intervals.
        crossings: Number of fragments that some poses skip, which the polynomials count as drawn.
        since: The first of these that counts.
    """

    radius: Any
    ends: Any
    crossings: int
    since: Any


@njit(cache=True, error_model="numpy", forceinline=True)
def _keep_distances(number, entry, nearest, farthest, size, crossings):
    """Store bounds of a skippable fragment's colour less the colour behind it, up to rounding of ``size`` (B11)."""
    room = FRAGMENT_ROUNDING * size
    crossings.entries[number] = entry
    store(crossings.distances, 8 * number, nearest - room)
    store(crossings.distances, 8 * number + 4, farthest + room)


@njit(cache=True, error_model="numpy", forceinline=True)
def blend_quadratic(begin, end, fragments, palette, moves, polynomials, crossings, split):
    """Composite the list entries [begin, end) of a pixel back to front, as forms and as intervals (design.md, B7).

    For one parameter and order 2. Writes ``polynomials`` [m, 4]; returns a `_Blend` whose radii are not yet rounded up.
    If ``split``, fragments that some poses skip are drawn and stored in ``crossings`` (B11); else their forms enclose
    both cases.
    """
    values, colors, forms = fragments.values, palette.values, palette.forms
    moving = forms > 1
    p0 = load4(palette.background, 0)
    p1 = 0.0 * p0
    p2 = 0.0 * p0
    r = 0.0 * p0
    ends = BlendBounds(p0, p0, p0, p0)
    number = 0
    for entry in range(end - 1, begin - 1, -1):
        at, key, move = listed_fragment(fragments, entry, forms)
        a0, a1, a2 = values[at + FORM], values[at + FORM + 1], values[at + FORM + 2]
        crossing = 0.0
        if split:
            crossing = 0.5 * crossing_of(fragments, at)
            a0 += crossing
        # colour - P, a form without radius
        v0 = load4(colors, key) - p0
        if moving:
            v1 = load4(colors, key + 4) - p1
            v2 = load4(colors, key + 8) - p2
        else:
            v1 = -p1
            v2 = -p2
        moved = abs(v1) + abs(v2)
        size = abs(v0) + moved
        if crossing > 0.0:
            _keep_distances(number, entry, v0 - moved, v0 + moved, size, crossings)
            number += 1
        # p^3 = 3/4 p + T3/4 and p^4 = p^2 - 1/8 + T4/8
        cubic = fma(a1, v2, a2 * v1)
        quartic = a2 * v2
        # sums in the order that leaves short chains from fragment to fragment
        p0 = fma(a0, v0, fma(-0.125, quartic, p0))
        p1 = fma(a0, v1, fma(a1, v0, fma(0.75, cubic, p1)))
        p2 = fma(a0, v2, fma(a2, v0, fma(a1, v1, p2 + quartic)))
        a1 = abs(a1)
        a2 = abs(a2)
        dropped = fma(0.25, abs(cubic), 0.125 * abs(quartic))
        added = fma(values[at + ALPHA_HIGH], load4(colors, key + 4 * forms), dropped)
        added = fma(
            values[at + FORM + 3] - crossing, size, fma(FRAGMENT_ROUNDING, fma(1.0 + a1 + a2, size, abs(p0)), added)
        )
        r = fma(1.0 - values[at + ALPHA_LOW], r, added)
        ends = blend_interval(ends, values, at, colors, key + color_ends(forms))
        if move != 0:
            falls, rises = load4(moves, move), load4(moves, move + 4)
            p0 = p0 + 0.5 * (rises - falls)
            r = r + 0.5 * (rises + falls)
            ends = BlendBounds(ends.low - falls, ends.high + rises, ends.darkest, ends.brightest)
    store(polynomials, 0, p0)
    store(polynomials, 4, p1)
    store(polynomials, 8, p2)
    return _Blend(r, ends, number, 0.0 * r)


@njit(cache=True, error_model="numpy", forceinline=True)
def _curve_range(polynomials, scratch, m):
    """Return the range of the quadratic parts of ``polynomials`` [m + bends, 4], which contains 0 (B10)."""
    low = 0.0 * load4(polynomials, 0)
    high = low
    for k in range(1, m):
        store(scratch, 4 * k, low)
    pair = m
    for j in range(1, m):
        own, shared = load4(polynomials, 4 * pair), load4(scratch, 4 * j)
        pair += 1
        for k in range(j + 1, m):
            # |p_j p_k| is at most half the sum of their squares
            half = 0.5 * abs(load4(polynomials, 4 * pair))
            shared = shared + half
            store(scratch, 4 * k, load4(scratch, 4 * k) + half)
            pair += 1
        low = low + minimum(0.0, own - shared)
        high = high + maximum(0.0, own + shared)
    return low, high


@njit(cache=True, error_model="numpy", forceinline=True)
def _step_of_several(r, at, key, crossing, fragments, palette, polynomials, scratch, m):
    """Composite one fragment over polynomials with radii ``r``, drawn also for up to 2 ``crossing`` of skipped alpha.

    Returns the new radii, and bounds of the fragment's colour less the colour behind it, up to rounding of a size (B7,
    B10, B11). ``polynomials`` [m + bends, 4]: coefficients of order 0 and 1, then those of products of two parameters;
    ``scratch`` [m, 4] is overwritten.
    """
    values, colors, forms = fragments.values, palette.values, palette.forms
    moving = forms > 1
    form = offset_by(values, at + FORM)
    bends = offset_by(form, m + 1)
    # alpha's curvature is about - bent to about + bent, that of what is behind likewise
    about, bent = values[at + BEND], values[at + BEND_SPREAD]
    sunk, risen = _curve_range(polynomials, scratch, m)
    middle_curve, wound, curved = 0.5 * (sunk + risen), 0.5 * (risen - sunk), maximum(risen, -sunk)
    a0 = form[0] + crossing
    remaining = a0 + about
    p0 = load4(polynomials, 0)
    value = load4(colors, key) - p0
    visible_value = value - middle_curve
    steep = 0.0
    change_size = 0.0 * p0
    for k in range(1, m):
        slope = load4(polynomials, 4 * k)
        change = -slope
        if moving:
            change = load4(colors, key + 4 * k) - slope
        store(scratch, 4 * k, change)
        store(polynomials, 4 * k, fma(remaining, change, fma(form[k], visible_value, slope)))
        steep += abs(form[k])
        change_size = change_size + abs(change)
    middle = fma(about, middle_curve, fma(a0, value, p0))
    store(polynomials, 0, middle)
    pair = 0
    for j in range(1, m):
        change, a = load4(scratch, 4 * j), form[j]
        for k in range(j, m):
            curve = load4(polynomials, 4 * (m + pair))
            product = a * load4(scratch, 4 * k)
            if j < k:
                product = fma(form[k], change, product)
            store(polynomials, 4 * (m + pair), fma(-remaining, curve, fma(bends[pair], visible_value, curve + product)))
            pair += 1
    nearest, farthest = value - change_size - risen, value + change_size - sunk
    size = abs(value) + change_size + curved
    dropped = fma(steep, wound, bent * (change_size + wound)) * UP
    added = fma(values[at + ALPHA_HIGH], load4(colors, key + 4 * forms), dropped)
    rounding = fma(1.0 + steep + 2.0 * bent, size + 2.0 * curved, abs(middle))
    added = fma(form[m] - crossing, size * UP, fma(FRAGMENT_ROUNDING, rounding, added))
    return fma(1.0 - values[at + ALPHA_LOW], r, added), nearest, farthest, size


@njit(cache=True, error_model="numpy", forceinline=True)
def flattened(polynomials, r, scratch, m):
    """Move the range of the curvature behind ``polynomials`` into centres and radii; return the radii (B10)."""
    low, high = _curve_range(polynomials, scratch, m)
    store(polynomials, 0, load4(polynomials, 0) + 0.5 * (low + high))
    return r + 0.5 * (high - low) + CURVE_ROUNDING * (abs(load4(polynomials, 0)) + 2.0 * (high - low))


@njit(cache=True, error_model="numpy", forceinline=True)
def blend_several(begin, end, fragments, palette, moves, polynomials, m, crossings, split):
    """Composite a pixel's list entries for several parameters, or none (design.md, B7, B10); see `blend_quadratic`.

    Writes ``polynomials`` [m + bends, 4] with their curvature (see `flattened`).
    """
    values, colors, forms = fragments.values, palette.values, palette.forms
    p0 = load4(palette.background, 0)
    r = 0.0 * p0
    store(polynomials, 0, p0)
    scratch = offset_by(polynomials, 4 * (m + fragments.bends))
    for k in range(1, m + fragments.bends):
        store(polynomials, 4 * k, r)
    ends = BlendBounds(p0, p0, p0, p0)
    number, since = 0, r
    for entry in range(end - 1, begin - 1, -1):
        ahead, _, _ = listed_fragment(fragments, max(entry - AHEAD, begin), forms)
        for byte in range(0, 8 * fragments.width, LINE):
            prefetch(values, ahead, byte)
        at, key, move = listed_fragment(fragments, entry, forms)
        crossing = 0.0
        if split:
            crossing = 0.5 * crossing_of(fragments, at)
        r, nearest, farthest, size = _step_of_several(r, at, key, crossing, fragments, palette, polynomials, scratch, m)
        if crossing > 0.0:
            _keep_distances(number, entry, nearest, farthest, size, crossings)
            number += 1
        ends = blend_interval(ends, values, at, colors, key + color_ends(forms))
        if move != 0:
            falls, rises = load4(moves, move), load4(moves, move + 4)
            store(polynomials, 0, load4(polynomials, 0) + 0.5 * (rises - falls))
            r = r + 0.5 * (rises + falls)
            ends = BlendBounds(ends.low - falls, ends.high + rises, ends.darkest, ends.brightest)
        # where the interval says more than the form, the form is the interval
        half = 0.5 * (ends.high - ends.low)
        wide = r > half
        if bits(wide) & 7 != 0:
            store(polynomials, 0, where(wide, 0.5 * (ends.low + ends.high), load4(polynomials, 0)))
            for k in range(1, m + fragments.bends):
                store(polynomials, 4 * k, where(wide, 0.0, load4(polynomials, 4 * k)))
            r = where(wide, half * UP + FRAGMENT_ROUNDING * (abs(ends.low) + abs(ends.high)), r)
            since = where(wide, float(number), since)
    return _Blend(r, ends, number, since)


@njit(cache=True, error_model="numpy", forceinline=True)
def form_range(polynomials, r, order, m):
    """Return the range over the box of ``polynomials`` [m, 4] with radii ``r``, rounded outward (design.md, A4)."""
    middle = load4(polynomials, 0)
    bottom, top = middle, middle
    size = 0.0 * middle
    for k in range(1, m):
        size = size + abs(load4(polynomials, 4 * k))
    if order == 1:
        bottom, top = middle - size, middle + size
    else:
        low, high = parabola(abs(load4(polynomials, 4)), load4(polynomials, 8))
        bottom, top = bottom + low, top + high
    room = PIXEL_RANGE_ROUNDING * (abs(middle) + size) + r * UP
    return bottom - room, top + room


@njit(cache=True, error_model="numpy")
def _stop_slack(q, darkest, brightest, room, block, inputs, scratch):
    """Write how far an early termination that pixel q's fragments ignore may lower and raise the picture (B6, iii).

    ``darkest`` and ``brightest`` bound all colours of the list, ``room`` the rounding of its compositing. The two go to
    the first 8 numbers of ``scratch``, channels in lanes.
    """
    fragments, palette, charges = block.fragments, block.palette, inputs.charges
    values, per_pixel, forms = fragments.values, fragments.per_pixel, palette.forms
    background, rho, lost_up = load4(palette.background, 0), per_pixel[RHO + q], 1.0 + charges.lost_light
    store(scratch, 0, rho * lost_up * maximum(0.0, brightest - background))
    store(scratch, 4, rho * lost_up * maximum(0.0, background - darkest))
    if per_pixel[HIDDEN + q] > 0.0:
        # what lies behind the stop depends on the order
        return
    stop = inputs.rules.transmittance_min * (1.0 + charges.transmittance)
    begin = q * fragments.capacity
    value = BlendBounds(background, background, background, background)
    falls = 0.0 * background
    rises = falls
    for entry in range(begin + int(fragments.lengths[q]) - 1, begin - 1, -1):
        if fragments.light[2 * entry + LEFT] > stop:
            # the program stops neither here nor before
            break
        at, key, _ = listed_fragment(fragments, entry, forms)
        value = blend_interval(value, values, at, palette.values, key + color_ends(forms))
        # a stop at this fragment shows the background in place of it and all behind it
        lost = lost_up * min(rho, fragments.light[2 * entry + LIGHT], stop / (1.0 - values[at + ALPHA_HIGH]))
        falls = maximum(falls, lost * (maximum(0.0, value.high - background) + room))
        rises = maximum(rises, lost * (maximum(0.0, background - value.low) + room))
    store(scratch, 0, minimum(load4(scratch, 0), falls))
    store(scratch, 4, minimum(load4(scratch, 4), rises))


@njit(cache=True, error_model="numpy", forceinline=True)
def _slack(q, ends, block, inputs, scratch):
    """Return how far the bounds of pixel q are widened below and above after compositing (design.md, B6, B8).

    ``scratch`` is scratch for 8 numbers.
    """
    per_pixel, palette, cutoffs, charges = block.fragments.per_pixel, block.palette, inputs.cutoffs, inputs.charges
    unseen = palette.unseen
    behind = load4(palette.background, 0)
    store(scratch, 0, ends.darkest)
    store(scratch, 4, ends.brightest)
    dark, light = min(scratch[0], scratch[1], scratch[2]), max(scratch[4], scratch[5], scratch[6])
    # rounding of the program's own sums and products
    bright = max(1.0, light, -dark)
    rounding = charges.blend_fragment * block.fragments.lengths[q] + charges.blend_pixel
    slack = rounding * bright * SECOND_ORDER + inputs.colors.error + cutoffs.negligible * bright
    fall = 0.0 * behind
    rise = fall
    if per_pixel[RHO + q] > 0.0:
        _stop_slack(q, dark, light, rounding * bright, block, inputs, scratch)
        fall, rise = load4(scratch, 0), load4(scratch, 4)
    # or else fragments that are missing show in place of the background
    passed = per_pixel[OPEN + q] * (1.0 + charges.lost_light)
    if passed > 0.0:
        faded = cutoffs.fade * max(bright, unseen[4], unseen[5], unseen[6])
        fall = maximum(fall, fma(passed, behind - load4(unseen, 0), faded))
        rise = maximum(rise, fma(passed, load4(unseen, 4) - behind, faded))
    return slack + fall, slack + rise


@njit(cache=True, error_model="numpy", forceinline=True)
def _form_bounds(begin, end, block, inputs, linear):
    """Return the `_PixelResult` of a pixel's list entries [begin, end), by forms and intervals (design.md, B7-B11).

    The block's sums receive the polynomials, then scratch; ``linear``: whether linear sets are needed.
    """
    fragments, palette, moves, crossings = block.fragments, block.palette, block.reordering.moves, block.crossings
    polynomials, limit = block.sums, inputs.rules.alpha_min * (1.0 - inputs.charges.threshold)
    d, order, m = inputs.shape.dimensions, inputs.shape.order, inputs.shape.monomials
    scratch = offset_by(polynomials, 4 * (m + fragments.bends))
    if order == 2:
        blended = blend_quadratic(begin, end, fragments, palette, moves, polynomials, crossings, True)
    else:
        blended = blend_several(begin, end, fragments, palette, moves, polynomials, m, crossings, True)
    radius, ends = blended.radius, blended.ends
    # the radius' own rounding: three for every fragment
    up = UP + LAYER_ROUNDING * (end - begin)
    falls, rises = 0.0 * radius, 0.0 * radius
    if blended.crossings > 0 or inputs.shape.sub_boxes > 0:
        store(scratch, 0, radius * up)
        set_blend(polynomials, scratch, crossings, d)
    if blended.crossings > 0:
        store(scratch, 16, blended.since)
        gather_crossings(
            begin, end, blended.crossings, offset_by(scratch, 16), fragments, crossings, scratch, inputs.shape
        )
        falls, rises = load4(scratch, 0), load4(scratch, 4)
    if inputs.shape.sub_boxes > 0:
        store(scratch, 0, falls)
        store(scratch, 4, rises)
        bound_sub_boxes(blended.crossings, limit, scratch, crossings, inputs, block.part_ends)
    if order == 1:
        radius = flattened(polynomials, radius, scratch, m)
    radius = radius * up
    drawn_low, drawn_high = form_range(polynomials, radius, order, m)
    low, high = drawn_low - falls, drawn_high + rises
    # skipping lowers by half of what it lowers and raises by half of what it raises, give or take as much
    center, radius = load4(polynomials, 0) + 0.5 * (rises - falls), (radius + 0.5 * (falls + rises)) * UP
    # what skipping adds to bounds without it
    drawn_low, drawn_high = maximum(ends.low, drawn_low), minimum(ends.high, drawn_high)
    added = (minimum(ends.high, high) - drawn_high) + (drawn_low - maximum(ends.low, low))
    if blended.crossings == 0 or d == 0 or bits(added > _CROSSINGS_MATTER * (drawn_high - drawn_low)) & 7 == 0:
        return _PixelResult(low, high, ends, center, radius)
    store(scratch, 0, falls)
    store(scratch, 4, rises)
    bound_by_parts(blended.crossings, limit, crossings, scratch, d)
    low, high = maximum(low, load4(scratch, 0)), minimum(high, load4(scratch, 4))
    if linear:
        # what is off the slopes alone
        clear_slopes(crossings, d, order)
        store(scratch, 0, falls)
        store(scratch, 4, rises)
        bound_by_parts(blended.crossings, limit, crossings, scratch, d)
        least, most = load4(scratch, 0), load4(scratch, 4)
        half = 0.5 * (most - least) + FRAGMENT_ROUNDING * (abs(least) + abs(most))
        center = where(half < radius, 0.5 * (least + most), center)
        radius = minimum(radius, half)
    return _PixelResult(low, high, ends, center, radius)


@njit(cache=True, error_model="numpy")
def shade(pixels, left, above, reordered, block, inputs, bounds):
    """Composite the fragments of each of a block's ``pixels`` and write its bounds (design.md, B7-B9, B11, B12).

    The block begins at column ``left`` and row ``above`` of its tile, whose slice of `PixelBounds` is ``bounds``;
    ``reordered``: whether fragments may change their order. Row OPEN of `Fragments.per_pixel` bounds the light that
    reaches missing fragments, whose colours lie between the two of `Palette.unseen`.
    """
    fragments, palette, polynomials = block.fragments, block.palette, block.sums
    lower, upper, linear, slopes = bounds.lower, bounds.upper, bounds.linear, bounds.slopes
    d, m = inputs.shape.dimensions, inputs.shape.monomials
    # behind the polynomials: scratch, then sums of absolute linear coefficients
    scratch = offset_by(polynomials, 4 * (m + fragments.bends))
    sums = offset_by(scratch, 4 * m + 20)
    reorder_scratch = ReorderScratch(scratch, block.entries.depth_radius, block.entries.first)
    for k in range(d):
        store(sums, 4 * k, 0.0 * load4(palette.background, 0))
    while pixels != 0:
        q = lowest_bit(pixels)
        pixels = signed(pixels & (pixels - 1))
        begin = q * fragments.capacity
        end = begin + int(fragments.lengths[q])
        if inputs.shape.parts > 0:
            own = blend_parts(begin, end, reordered, block, inputs, offset_by(polynomials, 4))
            pixel_bounds = _PixelResult(own.low, own.high, own, 0.5 * (own.low + own.high), 0.5 * (own.high - own.low))
        else:
            pixel_bounds = _form_bounds(begin, end, block, inputs, linear.shape[0] > 0)
        form_low, form_high, ends = pixel_bounds.low, pixel_bounds.high, pixel_bounds.ends
        low, high = ends.low, ends.high
        if reordered:
            low, high = sharpened(begin, end, ends, form_low, form_high, block, reorder_scratch)
        for k in range(d):
            store(sums, 4 * k, load4(sums, 4 * k) + abs(load4(polynomials, 4 + 4 * k)))
        fall, rise = _slack(q, ends, block, inputs, scratch)
        bottom = maximum(low, form_low) - fall
        top = minimum(high, form_high) + rise
        # crossed or not a number: nothing is known
        consistent = bottom <= top
        store(scratch, 0, minimum(1.0, maximum(0.0, where(consistent, bottom, 0.0))))
        store(scratch, 4, maximum(0.0, minimum(1.0, where(consistent, top, 1.0))))
        if bits(consistent) != 15:
            bounds.statistics[4] += 1
        row, column = above + q // BLOCK, left + q % BLOCK
        for channel in range(3):
            lower[row, column, channel] = scratch[channel]
            upper[row, column, channel] = scratch[4 + channel]
        if bounds.parts.shape[0] > 0:
            write_parts(fall, rise, block.part_ends, bounds.parts[0, row, column], scratch)
        if linear.shape[0] > 0:
            center = pixel_bounds.center + 0.5 * (rise - fall)
            store(polynomials, 0, center)
            store(scratch, 0, (pixel_bounds.radius + 0.5 * (rise + fall)) * UP + FRAGMENT_ROUNDING * abs(center))
            for channel in range(3):
                for k in range(m):
                    linear[0, row, column, channel, k] = polynomials[4 * k + channel]
                linear[0, row, column, channel, m] = scratch[channel]
    for k in range(d):
        slopes[k] += sums[4 * k] + sums[4 * k + 1] + sums[4 * k + 2]
