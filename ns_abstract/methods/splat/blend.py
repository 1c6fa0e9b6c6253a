"""Blending of a pixel's layers back to front, as forms and as intervals (design.md, B7-B9, O2-O4).

Lanes are the three channels, and a fourth one of nothing.
"""

from __future__ import annotations

from numba import njit

from ns_abstract.arithmetic.compiled import advanced, lowest_bit, pointer
from ns_abstract.arithmetic.elementary import fma
from ns_abstract.arithmetic.lanes import bits, load4, load8, maximum, minimum, store, where
from ns_abstract.arithmetic.units import UNIT64
from ns_abstract.methods.splat.block import (
    ALPHA_HIGH,
    ALPHA_LOW,
    FORM,
    LIGHT,
    LISTED,
    OPEN,
    RHO,
    ROUND,
    UP,
    color_ends,
    color_size,
    listed_layer,
    parabola,
)
from ns_abstract.methods.splat.lists import BLOCK, PIXELS

#: Reordering that moves no channel of a pixel by more is not examined beyond the swap bound.
_REORDERING_MATTERS = 1e-4


@njit(cache=True, error_model="numpy")
def swap_bounds(
    pairs_, pair_count, slots_, slot_count, drawn_, places_, layers_, width, lists_, palette_, forms, moves_
):  # fmt: skip
    """Bound what reordering may change when a layer joins the layers behind it (design.md, O2).

    The first half of its row of ``moves`` becomes how much three channels, and one of none, may fall, then rise.
    """
    pairs, slots, drawn, places = pointer(pairs_), pointer(slots_), pointer(drawn_), pointer(places_)
    layers, lists, palette, moves = pointer(layers_), pointer(lists_), pointer(palette_), pointer(moves_)
    deepest = lists_.shape[1]
    for p in range(pair_count):
        k, other = pairs[2 * p], pairs[2 * p + 1]
        front, back = slots[k], slots[other]
        if front < 0 or back < 0:
            continue
        both = drawn[front] & drawn[back]
        if both == 0:
            continue
        # bounds of the colours
        e, f = k * color_size(forms) + color_ends(forms), other * color_size(forms) + color_ends(forms)
        falls = maximum(0.0, load4(palette, e + 4) - load4(palette, f))
        rises = maximum(0.0, load4(palette, f + 4) - load4(palette, e))
        while both != 0:
            q = lowest_bit(both)
            both &= both - 1
            at, _, _ = listed_layer(lists, q * deepest + int(places[back * PIXELS + q]), width, forms)
            _, _, move = listed_layer(lists, q * deepest + int(places[front * PIXELS + q]), width, forms)
            alpha = layers[at + ALPHA_HIGH]
            store(moves, move, fma(alpha, falls, load4(moves, move)))
            store(moves, move + 4, fma(alpha, rises, load4(moves, move + 4)))
            store(moves, move + 8, maximum(load4(moves, move + 8), falls))
            store(moves, move + 12, maximum(load4(moves, move + 12), rises))
    # one rounding by pair
    up = UP + 2.0 * UNIT64 * pair_count
    for slot in range(slot_count):
        some = drawn[slot]
        while some != 0:
            q = lowest_bit(some)
            some &= some - 1
            at, _, move = listed_layer(lists, q * deepest + int(places[slot * PIXELS + q]), width, forms)
            # the weights of the layers it may move behind add up to at most one
            store(moves, move, layers[at + ALPHA_HIGH] * minimum(load8(moves, move), load8(moves, move + 8)) * up)


@njit(cache=True, error_model="numpy", forceinline=True)
def _blend_interval(low, high, darkest, brightest, layers, at, palette, ends):
    """One layer over the interval [low, high] (design.md, B7); also the range of the colours so far."""
    a_low, a_high = layers[at + ALPHA_LOW], layers[at + ALPHA_HIGH]
    c_low, c_high = load4(palette, ends), load4(palette, ends + 4)
    v = c_low - low
    low = fma(where(v < 0.0, a_high, a_low), v, low)
    v = c_high - high
    high = fma(where(v > 0.0, a_high, a_low), v, high)
    return low, high, minimum(darkest, c_low), maximum(brightest, c_high)


@njit(cache=True, error_model="numpy")
def _sort(keys, order, count):
    """Sort the first ``count`` of ``keys``, least first; ``order`` receives where each stood."""
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
def _interval_chain(
    layers, width, lists, palette, forms, moves, low, high, darkest, brightest, start, stop, t, keys, order
):
    """One step of the interval blend for list entries [start, stop) whose order is uncertain (design.md, O2-O4).

    Returns the tighter of the swap, hull and antichain bounds, and the range of the colours so far; ``t``, ``keys`` and
    ``order`` are scratch.
    """
    store(t, 8, low)
    store(t, 12, high)
    for entry in range(stop - 1, start - 1, -1):
        at, key, move = listed_layer(lists, entry, width, forms)
        ends = key + color_ends(forms)
        a_high = layers[at + ALPHA_HIGH]
        # wherever it goes among the layers behind, it moves the colour by at most its alpha times
        # the distance to the darkest or brightest of what lies behind
        hull_low = fma(a_high, minimum(0.0, load4(palette, ends) - brightest), low)
        hull_high = fma(a_high, maximum(0.0, load4(palette, ends + 4) - darkest), high)
        low, high, darkest, brightest = _blend_interval(low, high, darkest, brightest, layers, at, palette, ends)
        hull_low, hull_high = minimum(low, hull_low), maximum(high, hull_high)
        low = maximum(low - load4(moves, move), hull_low)
        high = minimum(high + load4(moves, move + 4), hull_high)
    store(t, 0, low)
    store(t, 4, high)
    count = stop - start
    for channel in range(3):
        for side in range(2):
            for e in range(count):
                _, key, _ = listed_layer(lists, start + e, width, forms)
                ends = key + color_ends(forms) + channel
                keys[e] = palette[ends] if side == 0 else -palette[ends + 4]
            _sort(keys, order, count)
            value = t[8 + 4 * side + channel]
            # nearest first: darkest for the lower bound, brightest for the upper one
            for position in range(count - 1, -1, -1):
                at, _, _ = listed_layer(lists, start + order[position], width, forms)
                color = keys[position] if side == 0 else -keys[position]
                v = color - value
                grows = v < 0.0 if side == 0 else v > 0.0
                value += layers[at + (ALPHA_HIGH if grows else ALPHA_LOW)] * v
            if side == 0:
                t[channel] = max(t[channel], value)
            else:
                t[4 + channel] = min(t[4 + channel], value)
    return load4(t, 0), load4(t, 4), darkest, brightest


@njit(cache=True, error_model="numpy")
def _sharpened(
    low, high, form_low, form_high, layers, width, lists, palette, forms, begin, end, moves, chain, background, t, keys,
    order,
):  # fmt: skip
    """Interval [low, high] of a pixel whose layers' depth orders are uncertain, sharpened where that may pay (O4).

    The list entries of the pixel are [begin, end); ``form_low`` and ``form_high`` are its bounds by the forms;
    ``chain[k]`` numbers the groups; ``t``, ``keys`` and ``order`` are scratch.
    """
    falls = 0.0 * low
    rises = falls
    for entry in range(begin, end):
        at, _, move = listed_layer(lists, entry, width, forms)
        if move != 0:
            light = layers[at + LIGHT]
            falls = fma(light, load4(moves, move), falls)
            rises = fma(light, load4(moves, move + 4), rises)
    # how much of what reordering moves may be won back, where the forms are not tighter anyhow
    gain = maximum(minimum(falls, low + falls - form_low), minimum(rises, form_high - (high - rises)))
    if bits(gain > _REORDERING_MATTERS) == 0:
        return low, high
    value_low = load4(background, 0)
    value_high = value_low
    darkest = value_low
    brightest = value_low
    stop = end
    while stop > begin:
        start = stop - 1
        group = chain[int(lists[LISTED * start + 1])]
        while start > begin and chain[int(lists[LISTED * (start - 1) + 1])] == group:
            start -= 1
        if stop - start == 1:
            at, key, _ = listed_layer(lists, start, width, forms)
            value_low, value_high, darkest, brightest = _blend_interval(
                value_low, value_high, darkest, brightest, layers, at, palette, key + color_ends(forms)
            )
        else:
            value_low, value_high, darkest, brightest = _interval_chain(
                layers, width, lists, palette, forms, moves, value_low, value_high, darkest, brightest, start, stop, t,
                keys, order,
            )  # fmt: skip
        stop = start
    return maximum(low, value_low), minimum(high, value_high)


@njit(cache=True, error_model="numpy", forceinline=True)
def _blend_line(layers, width, lists, palette, forms, begin, end, moves, background, t):
    """Blend the list entries [begin, end) of a pixel back to front, as forms and as intervals (design.md, B7).

    For one parameter and order 2. Lanes are the channels; ``background`` [4] and ``palette`` (`layers._set_colors`,
    ``forms`` rows before the radius) have a fourth one of zeros. ``t`` [m, 4] receives the polynomials; returns their
    radii, not yet rounded up, the intervals' ends, and the range of all colours.
    """
    moving = forms > 1
    p0 = load4(background, 0)
    p1 = 0.0 * p0
    p2 = 0.0 * p0
    r = 0.0 * p0
    bottom = p0
    top = p0
    darkest = p0
    brightest = p0
    for entry in range(end - 1, begin - 1, -1):
        at, key, move = listed_layer(lists, entry, width, forms)
        a0, a1, a2 = layers[at + FORM], layers[at + FORM + 1], layers[at + FORM + 2]
        # colour - P, a form without radius
        v0 = load4(palette, key) - p0
        if moving:
            v1 = load4(palette, key + 4) - p1
            v2 = load4(palette, key + 8) - p2
        else:
            v1 = -p1
            v2 = -p2
        # sums in the order that leaves short chains from layer to layer
        p0 = fma(a0, v0, p0)
        p1 = fma(a0, v1, fma(a1, v0, p1))
        p2 = fma(a0, v2, fma(a2, v0, fma(a1, v1, p2)))
        a1 = abs(a1)
        a2 = abs(a2)
        v1 = abs(v1)
        v2 = abs(v2)
        v1 = v1 + v2
        size = abs(v0) + v1
        added = fma(layers[at + ALPHA_HIGH], load4(palette, key + 4 * forms), fma(a1, v2, a2 * v1))
        added = fma(layers[at + FORM + 3], size, fma(ROUND, fma(1.0 + a1 + a2, size, abs(p0)), added))
        r = fma(1.0 - layers[at + ALPHA_LOW], r, added)
        bottom, top, darkest, brightest = _blend_interval(
            bottom, top, darkest, brightest, layers, at, palette, key + color_ends(forms)
        )
        if move != 0:
            falls, rises = load4(moves, move), load4(moves, move + 4)
            p0 = p0 + 0.5 * (rises - falls)
            r = r + 0.5 * (rises + falls)
            bottom = bottom - falls
            top = top + rises
    store(t, 0, p0)
    store(t, 4, p1)
    store(t, 8, p2)
    return r, bottom, top, darkest, brightest


@njit(cache=True, error_model="numpy", forceinline=True)
def _step_affine(r, layers, at, palette, key, forms, t, m):
    """One layer over the polynomials ``t`` [m, 4], flat, of order 1 and radius ``r`` (design.md, B7); the new radius.

    Lanes are the channels.
    """
    moving = forms > 1
    a0 = layers[at + FORM]
    p0 = load4(t, 0)
    value = load4(palette, key) - p0
    middle = fma(a0, value, p0)
    steep = 0.0
    change_size = 0.0 * p0
    curves = 0.0 * p0
    for k in range(1, m):
        slope = load4(t, 4 * k)
        alpha = layers[at + FORM + k]
        change = -slope
        if moving:
            change = load4(palette, key + 4 * k) - slope
        # half of a product of two slopes goes to the centre, half to the radius
        curve = 0.5 * (alpha * change)
        store(t, 4 * k, fma(a0, change, fma(alpha, value, slope)))
        middle = middle + curve
        curves = curves + abs(curve)
        steep += abs(alpha)
        change_size = change_size + abs(change)
    store(t, 0, middle)
    size = abs(value) + change_size
    added = fma(layers[at + ALPHA_HIGH], load4(palette, key + 4 * forms), fma(steep, change_size, -curves))
    added = fma(layers[at + FORM + m], size, fma(ROUND, fma(1.0 + steep, size, abs(middle)), added))
    return fma(1.0 - layers[at + ALPHA_LOW], r, added)


@njit(cache=True, error_model="numpy", forceinline=True)
def _step_curved(r, layers, at, palette, key, forms, t, value, d, m):
    """`_step_affine` for order 2; ``value`` [m, 4], flat, is scratch."""
    moving = forms > 1
    a0 = layers[at + FORM]
    # value = colour - P, a form without radius
    v0 = load4(palette, key) - load4(t, 0)
    slopes = 0.0 * v0
    bends = 0.0 * v0
    steep, bent = 0.0, 0.0
    for k in range(1, m):
        v = -load4(t, 4 * k)
        if moving:
            v = load4(palette, key + 4 * k) + v
        store(value, 4 * k, v)
        alpha = layers[at + FORM + k]
        store(t, 4 * k, load4(t, 4 * k) + (a0 * v + alpha * v0))
        if k <= d:
            slopes = slopes + abs(v)
            steep += abs(alpha)
        else:
            bends = bends + abs(v)
            bent += abs(alpha)
    p0 = load4(t, 0) + a0 * v0
    store(t, 0, p0)
    row = 1 + d
    for k in range(1, d + 1):
        alpha, v = layers[at + FORM + k], load4(value, 4 * k)
        store(t, 4 * row, load4(t, 4 * row) + alpha * v)
        row += 1
        for l in range(k + 1, d + 1):
            product = alpha * load4(value, 4 * l) + layers[at + FORM + l] * v
            store(t, 4 * row, load4(t, 4 * row) + product)
            row += 1
    size = abs(v0) + (slopes + bends)
    added = fma(layers[at + ALPHA_HIGH], load4(palette, key + 4 * forms), fma(steep, bends, bent * (slopes + bends)))
    added = fma(layers[at + FORM + m], size, fma(ROUND, fma(1.0 + steep + bent, size, abs(p0)), added))
    return fma(1.0 - layers[at + ALPHA_LOW], r, added)


@njit(cache=True, error_model="numpy", forceinline=True)
def _blend(layers, width, lists, palette, forms, begin, end, moves, background, d, order, m, t, value):
    """`_blend_line` for any number of parameters and order; ``value`` is scratch."""
    bottom = load4(background, 0)
    r = 0.0 * bottom
    store(t, 0, bottom)
    for k in range(1, m):
        store(t, 4 * k, r)
    top = bottom
    darkest = bottom
    brightest = bottom
    for entry in range(end - 1, begin - 1, -1):
        at, key, move = listed_layer(lists, entry, width, forms)
        if order == 1:
            r = _step_affine(r, layers, at, palette, key, forms, t, m)
        else:
            r = _step_curved(r, layers, at, palette, key, forms, t, value, d, m)
        bottom, top, darkest, brightest = _blend_interval(
            bottom, top, darkest, brightest, layers, at, palette, key + color_ends(forms)
        )
        if move != 0:
            falls, rises = load4(moves, move), load4(moves, move + 4)
            store(t, 0, load4(t, 0) + 0.5 * (rises - falls))
            r = r + 0.5 * (rises + falls)
            bottom = bottom - falls
            top = top + rises
    return r, bottom, top, darkest, brightest


@njit(cache=True, error_model="numpy", forceinline=True)
def _form_range(t, r, d, order, m):
    """Range over the box of the polynomials ``t`` [m, 4] of radii ``r``, rounded outward (design.md, A4)."""
    middle = load4(t, 0)
    bottom, top = middle, middle
    size = 0.0 * middle
    for k in range(1, m):
        size = size + abs(load4(t, 4 * k))
    if order == 1:
        bottom, top = middle - size, middle + size
    else:
        row = 1 + d
        for k in range(1, d + 1):
            low, high = parabola(abs(load4(t, 4 * k)), load4(t, 4 * row))
            bottom, top = bottom + low, top + high
            row += 1
            for _ in range(k + 1, d + 1):
                mixed = abs(load4(t, 4 * row))
                bottom, top = bottom - mixed, top + mixed
                row += 1
    room = 8.0 * ROUND * (abs(middle) + size) + r * UP
    return bottom - room, top + room


@njit(cache=True, error_model="numpy")
def shade(
    layers_, width, lists_, palette_, forms, lengths, moves_, chain, reordered, background_, unseen_, fade,
    color_radius, negligible, unit, left, top_row, d, order, m, s_, t_, value_, keys_, order_, lower, upper, linear,
    slopes, statistics,
):  # fmt: skip
    """Blend every pixel's layers and write its bounds; lanes are the channels, a fourth one holds nothing.

    The block begins at column ``left`` and row ``top_row`` of its tile; ``reordered`` tells whether layers may move.
    Row OPEN of ``s`` bounds the light that comes to layers that are missing and have colours between the two that
    ``unseen`` [8] names; the program adds these up with an error of at most ``fade``.
    """
    layers, lists, palette, moves = pointer(layers_), pointer(lists_), pointer(palette_), pointer(moves_)
    background, s, t, value = pointer(background_), pointer(s_), pointer(t_), pointer(value_)
    unseen, keys, order_of = pointer(unseen_), pointer(keys_), pointer(order_)
    deepest = lists_.shape[1]
    # behind the polynomials: scratch, then sums of absolute linear coefficients
    u = advanced(t, 4 * m)
    sums = advanced(t, 4 * m + 16)
    behind = load4(background, 0)
    for k in range(d):
        store(sums, 4 * k, 0.0 * behind)
    for q in range(PIXELS):
        begin = q * deepest
        end = begin + int(lengths[q])
        if d == 1 and order == 2:
            r, low, high, darkest, brightest = _blend_line(
                layers, width, lists, palette, forms, begin, end, moves, background, t
            )
        else:
            r, low, high, darkest, brightest = _blend(
                layers, width, lists, palette, forms, begin, end, moves, background, d, order, m, t, value
            )
        # the radius' own rounding: three for every layer
        r = r * (UP + 4.0 * UNIT64 * lengths[q])
        form_low, form_high = _form_range(t, r, d, order, m)
        if reordered:
            low, high = _sharpened(
                low, high, form_low, form_high, layers, width, lists, palette, forms, begin, end, moves, chain,
                background, u, keys, order_of,
            )  # fmt: skip
        for k in range(d):
            store(sums, 4 * k, load4(sums, 4 * k) + abs(load4(t, 4 + 4 * k)))
        store(u, 0, darkest)
        store(u, 4, brightest)
        dark, light = min(u[0], u[1], u[2]), max(u[4], u[5], u[6])
        # rounding of the program's own sums and products (design.md, B8)
        bright = max(1.0, light, -dark)
        slack = (
            (3.0 * lengths[q] + 16.0) * (unit + 8.0 * UNIT64) * bright * 1.01 + color_radius + negligible * bright
        )
        # a stop that was ignored shows the background in place of what lies behind (B6)
        rho = s[RHO + q] * (1.0 + 16.0 * unit)
        fall = rho * maximum(0.0, light - behind)
        rise = rho * maximum(0.0, behind - dark)
        # or else layers that are missing show in place of the background
        passed = s[OPEN + q] * (1.0 + 16.0 * unit)
        if passed > 0.0:
            faded = fade * max(bright, unseen[4], unseen[5], unseen[6])
            fall = maximum(fall, fma(passed, behind - load4(unseen, 0), faded))
            rise = maximum(rise, fma(passed, load4(unseen, 4) - behind, faded))
        fall = slack + fall
        rise = slack + rise
        bottom = maximum(low, form_low) - fall
        top = minimum(high, form_high) + rise
        # crossed or not a number: nothing is known
        known = bottom <= top
        store(u, 0, minimum(1.0, maximum(0.0, where(known, bottom, 0.0))))
        store(u, 4, maximum(0.0, minimum(1.0, where(known, top, 1.0))))
        if bits(known) != 15:
            statistics[4] += 1
        row, column = top_row + q // BLOCK, left + q % BLOCK
        for channel in range(3):
            lower[row, column, channel] = u[channel]
            upper[row, column, channel] = u[4 + channel]
        if linear.shape[0] > 0:
            store(u, 0, r + maximum(fall, rise))
            for channel in range(3):
                for k in range(m):
                    linear[0, row, column, channel, k] = t[4 * k + channel]
                linear[0, row, column, channel, m] = u[channel]
    for k in range(d):
        slopes[k] += sums[4 * k] + sums[4 * k + 1] + sums[4 * k + 2]
