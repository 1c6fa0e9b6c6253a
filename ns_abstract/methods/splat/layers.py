"""Layers of a block of pixels, nearest first: what may be drawn, in which orders, and where the stop hides it.

Gaussian by Gaussian, `collect_layers` finds the pixels that it may reach and its alpha there, keeps what may
contribute, and notes which Gaussians that share a pixel may change places (design.md, B5-B6, O1).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ns_abstract.arithmetic.compiled import advanced, lowest_bit, pointer, prefetch, signed
from ns_abstract.arithmetic.lanes import load8, maximum, minimum, root, spans, store, where
from ns_abstract.methods.splat.alphas import alphas
from ns_abstract.methods.splat.block import (
    ALPHA_HIGH,
    ALPHA_LOW,
    C1,
    LEFT,
    LIGHT,
    LISTED,
    LOST,
    MOVES,
    NUMBERS,
    OPEN,
    REACH,
    RHO,
    ROUND,
    THI,
    TLO,
    UP,
    color_ends,
    color_size,
    longest_list,
    set_unknown,
)
from ns_abstract.methods.splat.lists import AHEAD, BLOCK, PIXELS
from ns_abstract.methods.splat.records import FAINT, FORMS, MEAN_X, MEAN_Y, SPREAD, WILD

#: Room for rounding where pixels are left out.
_ROOM = 1.0 + 2.0**-30
#: List entries that pass the steps of `collect_layers` together: no step waits for the one before.
BATCH = 8
#: Pixel q of a block lies in row q >> _ROW_SHIFT; sets of pixels are the bits of an int64.
_ROW_SHIFT = BLOCK.bit_length() - 1
# what a block may answer in place of a number of pairs
GIVE_UP = -1
GROW = -2


@njit(cache=True, error_model="numpy", forceinline=True)
def _uncertain(i, j, delta, depth_error, slope, m):
    """Whether the depth order of Gaussians i and j is not the same over the whole cell (design.md, O1).

    ``slope`` [rows, 3], flat, is the third row of the rotation: depths differ by ``slope . (delta_i - delta_j)``.
    """
    x = delta[3 * i] - delta[3 * j]
    y = delta[3 * i + 1] - delta[3 * j + 1]
    z = delta[3 * i + 2] - delta[3 * j + 2]
    center = slope[0] * x + slope[1] * y + slope[2] * z
    spread = 0.0
    for k in range(1, m):
        spread += abs(slope[3 * k] * x + slope[3 * k + 1] * y + slope[3 * k + 2] * z)
    size = abs(delta[3 * i]) + abs(delta[3 * j]) + abs(delta[3 * i + 1]) + abs(delta[3 * j + 1])
    size += abs(delta[3 * i + 2]) + abs(delta[3 * j + 2])
    rounding = ROUND * size * 2.0
    radius = slope[3 * m] * abs(x) + slope[3 * m + 1] * abs(y) + slope[3 * m + 2] * abs(z)
    return not (abs(center) > (spread + radius) * UP + rounding + depth_error[i] + depth_error[j])


@njit(cache=True, error_model="numpy")
def _depth_reach(entries, depth, delta, depth_error, slope, ray, m, reach, deep):
    """How far in depth each entry may move against the block's central ray (design.md, O1).

    Entries i, j keep their order where ``room |depth_i - depth_j| > reach_i + reach_j``; ``deep`` receives the
    depths. Returns ``room`` (not positive where nothing can be said) and the largest reach of all but a few entries.
    ``ray`` [3] is the ray scaled to unit depth at the middle pose.
    """
    count = entries.size
    along = 0.0
    for k in range(1, m):
        along += abs(slope[k, 0] * ray[0] + slope[k, 1] * ray[1] + slope[k, 2] * ray[2])
    along += slope[m, 0] * abs(ray[0]) + slope[m, 1] * abs(ray[1]) + slope[m, 2] * abs(ray[2])
    total = 0.0
    for k in range(count):
        ahead = entries[min(k + AHEAD, count - 1)]
        prefetch(delta, ahead, 0)
        prefetch(depth, ahead, 0)
        prefetch(depth_error, ahead, 0)
        i = entries[k]
        deep[k] = depth[i]
        # offset from the central ray: what a rotation moves in depth relative to the ray
        x = delta[i, 0] - depth[i] * ray[0]
        y = delta[i, 1] - depth[i] * ray[1]
        z = delta[i, 2] - depth[i] * ray[2]
        e = slope[m, 0] * abs(x) + slope[m, 1] * abs(y) + slope[m, 2] * abs(z)
        for row in range(1, m):
            e += abs(slope[row, 0] * x + slope[row, 1] * y + slope[row, 2] * z)
        size = abs(delta[i, 0]) + abs(delta[i, 1]) + abs(delta[i, 2]) + abs(depth[i]) * (1.0 + along)
        reach[k] = e * UP + 4.0 * ROUND * size + depth_error[i]
        total += reach[k]
    room = (1.0 - along) * (1.0 - 2.0**-30)
    if not total < np.inf:
        room = -1.0
    # few entries reach far: they are compared with all, the others within a window
    typical = 4.0 * total / max(count, 1)
    largest = 0.0
    for k in range(count):
        if reach[k] <= typical:
            largest = max(largest, reach[k])
    return room, largest


@njit(cache=True, error_model="numpy")
def _reached(record, ox, oy, left, right, top, bottom, m, s):
    """The set of pixels of a range where the exponent may stay low enough for the threshold.

    Row by row, sigma >= (near1^2 + near2^2)/2 bounds the columns, where near1 and near2 are what the forms' spread
    leaves of |y1| and |y2| (design.md, B2). (ox, oy) is the offset of the block's first pixel from the mean.
    """
    inside = ((2 << (bottom * BLOCK + BLOCK - 1)) - 1) & ~((1 << (top * BLOCK)) - 1)
    wild = record[WILD] != 0.0
    p, c, g, w1, w2 = 0.0, 0.0, 0.0, 0.0, 0.0
    spread1, spread2 = np.inf, np.inf
    if not wild:
        stride = m + 1
        p = record[FORMS]
        c = record[FORMS + stride]
        g = record[FORMS + 2 * stride]
        w1 = record[FORMS + 3 * stride]
        w2 = record[FORMS + 4 * stride]
        x = max(abs(ox + left), abs(ox + right))
        y = max(abs(oy + top), abs(oy + bottom))
        spread1 = (record[SPREAD] * x + record[SPREAD + 1] * y + record[SPREAD + 3]) * _ROOM
        spread2 = (record[SPREAD + 2] * y + record[SPREAD + 4]) * _ROOM
    # without a bound on the columns the whole rows are taken
    numbers = load8(s, NUMBERS)
    start = float(left) + 0.0 * numbers
    stop = float(right) + 0.0 * numbers
    if p > 0.0 and spread1 < np.inf and spread2 < np.inf:
        inverse = 1.0 / p
        ay = oy + numbers
        near = maximum(0.0, abs(g * ay - w2) - spread2)
        rest = 2.0 * record[FAINT] * _ROOM - near * near * (2.0 - _ROOM)
        half = (root(maximum(rest, 0.0)) + spread1) * inverse * _ROOM
        center = (c * ay + w1) * inverse - ox
        slack = (_ROOM - 1.0) * (abs(center) + abs(ox) + half)
        start = maximum(start, center - half - slack)
        stop = where(rest >= 0.0, minimum(stop, center + half + slack), -1.0)
    return spans(minimum(float(BLOCK), start), maximum(-1.0, stop)) & inside


@njit(cache=True, error_model="numpy")
def _pixels_of(record, box, x0, y0, m, s):
    """The set of a block's pixels on which a Gaussian may reach the threshold."""
    left = int(math.ceil(min(max(box[0] - 0.5 - x0, 0.0), float(BLOCK))))
    right = int(math.floor(min(max(box[1] - 0.5 - x0, -1.0), BLOCK - 1.0)))
    top = int(math.ceil(min(max(box[2] - 0.5 - y0, 0.0), float(BLOCK))))
    bottom = int(math.floor(min(max(box[3] - 0.5 - y0, -1.0), BLOCK - 1.0)))
    if top > bottom or left > right:
        return 0
    ox, oy = x0 + 0.5 - record[MEAN_X], y0 + 0.5 - record[MEAN_Y]
    return signed(_reached(record, ox, oy, left, right, top, bottom, m, s))


@njit(cache=True, error_model="numpy", forceinline=True)
def _pixels_once(k, entries, record, columns, box, x0, y0, m, s, masks, asked):
    """`_pixels_of` list position k, found when first asked for; ``asked`` [entries] starts as 0."""
    if asked[k] == 0:
        asked[k] = 1
        i = entries[k]
        masks[k] = _pixels_of(advanced(record, i * columns), advanced(box, 4 * i), x0, y0, m, s)
    return masks[k]


@njit(cache=True, error_model="numpy")
def _pixels_at(lanes, pixels):
    """The set of the pixels in ``lanes``."""
    found = 0
    while lanes != 0:
        found |= 1 << int(pixels[lowest_bit(lanes)])
        lanes &= lanes - 1
    return signed(found)


@njit(cache=True, error_model="numpy", forceinline=True)
def _find_pairs(
    k, found, pixels, entries, length, record, columns, box, x0, y0, s, masks, asked, deep, delta, depth_error, slope,
    m, reach, room, largest, farthest, far, far_count, first, last, pairs, pair_limit, count,
):  # fmt: skip
    """Append the pairs (k, later entry) that share a pixel and are of uncertain order; widen ``first``, ``last``.

    ``pixels`` in the lanes ``found`` are k's; ``masks`` and ``asked`` are those of `_pixels_once`. Returns the number
    of pairs, or -1 where ``pairs`` is full.
    """
    i = entries[k]
    shown = 0
    beyond = length
    window = reach[k] + largest
    # those within the window, then those that reach far
    other = k
    f = 0
    within = True
    while True:
        if within:
            other += 1
            if other >= length or (deep[other] - deep[k]) * room > window:
                within = False
                beyond = other
                continue
        else:
            while f < far_count and far[f] < beyond:
                f += 1
            if f >= far_count:
                break
            other = far[f]
            f += 1
            if (deep[other] - deep[k]) * room > reach[k] + farthest:
                break
        if (deep[other] - deep[k]) * room > reach[k] + reach[other]:
            continue
        if shown == 0:
            shown = _pixels_at(found, pixels)
        theirs = _pixels_once(other, entries, record, columns, box, x0, y0, m, s, masks, asked)
        if shown & int(theirs) == 0 or not _uncertain(i, entries[other], delta, depth_error, slope, m):
            continue
        if count >= pair_limit:
            return -1
        pairs[2 * count] = k
        pairs[2 * count + 1] = other
        last[k] = max(last[k], other)
        first[other] = min(first[other], k)
        count += 1
    return count


@njit(cache=True, error_model="numpy")
def _still_live(found, pixels, live):
    """Those lanes of ``found`` whose pixel is in ``live``."""
    left = 0
    while found != 0:
        lane = lowest_bit(found)
        found &= found - 1
        if live & (1 << int(pixels[lane])) != 0:
            left |= 1 << lane
    return left


@njit(cache=True, error_model="numpy", forceinline=True)
def _append_layer(number, q, k, t_low, t_high, layers, width, s, lengths, lists, deepest):
    """Append layer ``number`` to pixel q's list, with the light that it leaves; returns its place there."""
    at = number * width
    layers[at + LEFT] = t_low
    layers[at + LIGHT] = s[THI + q]
    s[TLO + q] = t_low
    s[THI + q] = t_high
    count = lengths[q]
    entry = LISTED * (q * deepest + count)
    lists[entry] = number
    lists[entry + 1] = k
    lists[entry + 2] = 0
    lengths[q] = count + 1
    return count


@njit(cache=True, error_model="numpy")
def _keep_drawn(
    found, pixels, first_layer, k, layers, width, s, lengths, lists, deepest, bright, shrink, grow
):  # fmt: skip
    """Keep the layers of a Gaussian whose place is certain in those lanes of ``found`` that leave more than ``bright``.

    Lane b is layer number ``first_layer + b`` on the pixel ``pixels[b]``. Returns the other lanes.
    """
    rest = 0
    while found != 0:
        lane = lowest_bit(found)
        found &= found - 1
        q = int(pixels[lane])
        number = first_layer + lane
        at = number * width
        t_low = s[TLO + q] * (1.0 - layers[at + ALPHA_HIGH]) * shrink
        if not t_low > bright:
            rest |= 1 << lane
            continue
        t_high = s[THI + q] * (1.0 - layers[at + ALPHA_LOW]) * grow
        _append_layer(number, q, k, t_low, t_high, layers, width, s, lengths, lists, deepest)
    return rest


@njit(cache=True, error_model="numpy", forceinline=True)
def _set_colors(palette, k, color, color_rows):
    """Write the colour of list position k: centre, slopes, radius, then its lower and upper bound over the cell.

    Each is four numbers: three channels and one of none.
    """
    forms = max(color_rows - 1, 1)
    at = k * color_size(forms)
    for channel in range(3):
        start = channel * color_rows
        spread = 0.0
        for r in range(1, color_rows):
            spread += abs(color[start + r])
        spread *= UP
        for r in range(forms):
            palette[at + 4 * r + channel] = color[start + r]
        palette[at + 4 * forms + channel] = color[start + forms] if color_rows > 1 else 0.0
        palette[at + color_ends(forms) + channel] = color[start] - spread
        palette[at + color_ends(forms) + 4 + channel] = color[start] + spread


@njit(cache=True, error_model="numpy")
def _colors_behind(first, length, entries, colors, colors_, color_rows, background, unseen, marks):
    """Ends of the colours of the list's entries from ``first`` on and of the background; marks them (design.md, B6).

    ``unseen`` [8] receives the darkest and the brightest of three channels and of one of none.
    """
    for channel in range(4):
        unseen[channel] = background[channel]
        unseen[4 + channel] = background[channel]
    for k in range(first, length):
        ahead = entries[min(k + BATCH, length - 1)]
        for byte in range(0, 24 * color_rows, 64):
            prefetch(colors_, ahead, byte)
        i = entries[k]
        if marks[i] == 0:
            marks[i] = 1
        color = advanced(colors, i * 3 * color_rows)
        for channel in range(3):
            at = channel * color_rows
            spread = 0.0
            for r in range(1, color_rows):
                spread += abs(color[at + r])
            unseen[channel] = min(unseen[channel], color[at] - spread * UP)
            unseen[4 + channel] = max(unseen[4 + channel], color[at] + spread * UP)


@njit(cache=True, error_model="numpy")
def collect_layers(
    entries_, record_, box_, tiles_, tile_x, tile_y, colors_, palette_, depth_, delta_, depth_error_, slope_, ray,
    s_, y1, y2, poly, rows_, layers_, width, offset_x, offset_y, pixels_, batch_, masks_, asked_, lists_, lengths_,
    reach_, deep_, far_, first_, last_, slots_, owners_, drawn_, places_, moves_, pairs_, x0, y0, d, order, m,
    antialiased, rules, errors, floor, background_, unseen_, marks_,
):  # fmt: skip
    """Collect the layers of every pixel, nearest first (design.md, B5-B6).

    ``layers`` receives layer after layer, ``width`` numbers each; ``lists[q, e]`` the number of pixel q's layer e
    there, its list position and its row of ``moves`` (0: its order is certain; the others are set to 0).
    ``first[k] <= k <= last[k]`` become the list positions whose depth order against entry k is uncertain, ``pairs``
    [., 2] all such pairs, ``slots[k]`` numbers the entries that take part in one (-1: it does not) and ``owners``
    leads back; the set ``drawn`` holds a slot's pixels and ``places`` its place in their lists. Returns the number of
    pairs and of slots; or GIVE_UP where more pairs are uncertain than ``pairs`` may hold, or GROW where another
    buffer is too small.

    A list may end where no pose leaves more light than ``floor``. All that is missing lies behind what it holds, and
    row OPEN of ``s`` bounds the light that comes there, ``unseen`` [8] the colours (`_colors_behind`). OPEN is 0 where
    nothing is missing, as if ``floor`` is negative.

    Row RHO of ``s`` receives how much transmittance may be lost to a stop that the kept layers ignore;
    ``marks`` is set for the entries that some pixel that takes light may draw, or stop at; ``palette`` receives
    their colours. ``batch`` [2, entries], ``masks`` and ``asked`` are scratch, and so are ``offset_x``, ``offset_y``
    and ``pixels``, by pixel of a batch.
    """
    entries, record, box, tiles = pointer(entries_), pointer(record_), pointer(box_), pointer(tiles_)
    colors, palette, delta = pointer(colors_), pointer(palette_), pointer(delta_)
    depth_error, slope, s, rows = pointer(depth_error_), pointer(slope_), pointer(s_), pointer(rows_)
    layers, ax, ay, pixels = pointer(layers_), pointer(offset_x), pointer(offset_y), pointer(pixels_)
    begins, hits, masks, asked = pointer(batch_[0]), pointer(batch_[1]), pointer(masks_), pointer(asked_)
    lists, lengths, reach, deep = pointer(lists_), pointer(lengths_), pointer(reach_), pointer(deep_)
    far, first, last, slots = pointer(far_), pointer(first_), pointer(last_), pointer(slots_)
    owners, drawn, places, moves = pointer(owners_), pointer(drawn_), pointer(places_), pointer(moves_)
    pairs, marks = pointer(pairs_), pointer(marks_)
    length, columns, color_columns = entries_.size, record_.shape[1], colors_.shape[1]
    deepest, slot_limit, pair_limit = lists_.shape[1], drawn_.size, pairs_.shape[0]
    unit = errors[0]
    stop = rules[9]
    stop_low = stop * (1.0 - 8.0 * unit)
    stop_high = stop * (1.0 + 8.0 * unit)
    dark = max(stop_low, floor)
    # two roundings of the running transmittance
    shrink, grow = 1.0 - 8.0 * unit, 1.0 + 8.0 * unit
    capacity = layers_.size // width
    move_limit = moves_.shape[0]
    color_rows = color_columns // 3
    for q in range(PIXELS):
        s[TLO + q] = 1.0
        s[THI + q] = 1.0
        s[REACH + q] = -1.0
        s[RHO + q] = 0.0
        s[LOST + q] = 0.0
        s[OPEN + q] = 0.0
        lengths[q] = 0
    room, largest = _depth_reach(entries_, depth_, delta_, depth_error_, slope_, ray, m, reach_, deep_)
    if not room > 0.0:
        return GIVE_UP, 0
    far_count = 0
    farthest = 0.0
    for k in range(length):
        first[k] = k
        last[k] = k
        slots[k] = -1
        asked[k] = 0
        if reach[k] > largest:
            far[far_count] = k
            far_count += 1
            farthest = max(farthest, reach[k])
    pair_count = 0
    slot_count = 0
    # row 0 is for layers that do not move
    for r in range(MOVES):
        moves[r] = 0.0
    move_count = 1
    live = -1
    # pixels that take no light, or too little, behind the layers whose place is still open
    dim = 0
    missing = length
    used = 0
    for start in range(0, length, BATCH):
        some = min(BATCH, length - start)
        begun = live
        # which pixels: only those that the Gaussian may reach and that still take light
        for b in range(some):
            ahead = entries[min(start + b + BATCH, length - 1)]
            prefetch(box_, ahead, 0)
            prefetch(tiles_, ahead, 0)
            for byte in range(0, 8 * columns, 64):
                prefetch(record_, ahead, byte)
            prefetch(record_, ahead, 8 * columns - 8)
            for byte in range(0, 8 * color_columns, 64):
                prefetch(colors_, ahead, byte)
            _pixels_once(start + b, entries, record, columns, box, x0, y0, m, s, masks, asked)
        end = 0
        for b in range(some):
            i = entries[start + b]
            row = advanced(record, i * columns)
            ox, oy = x0 + 0.5 - row[MEAN_X], y0 + 0.5 - row[MEAN_Y]
            mask = live & masks[start + b]
            begins[b] = end
            while mask != 0:
                q = lowest_bit(mask)
                mask &= mask - 1
                pixels[end] = q
                ax[end] = ox + (q & (BLOCK - 1))
                ay[end] = oy + (q >> _ROW_SHIFT)
                end += 1
        begins[some] = end
        # eight at a time, some in excess
        if used + end + 8 > capacity:
            return GROW, 0
        if longest_list(lengths) + some > deepest:
            return GROW, 0
        for b in range(some):
            i = entries[start + b]
            begin = begins[b]
            n = begins[b + 1] - begin
            hits[b] = 0
            if n > 0:
                core = advanced(tiles, 8 * i + 4)
                sure = core[0] <= tile_x and tile_x < core[1] and core[2] <= tile_y and tile_y < core[3]
                hits[b] = alphas(
                    advanced(record, i * columns), n, advanced(ax, begin), advanced(ay, begin), s, y1, y2, poly, rows,
                    layers, (used + begin) * width, width, d, order, m, antialiased, sure, rules, errors,
                )  # fmt: skip
        for b in range(some):
            found = hits[b]
            begin = begins[b]
            if live != begun:
                found = _still_live(found, advanced(pixels, begin), live)
            if found == 0:
                continue
            k = start + b
            i = entries[k]
            pair_count = _find_pairs(
                k, found, advanced(pixels, begin), entries, length, record, columns, box, x0, y0, s, masks, asked, deep,
                delta, depth_error, slope, m, reach, room, largest, farthest, far, far_count, first, last, pairs,
                pair_limit, pair_count,
            )  # fmt: skip
            if pair_count < 0:
                return GIVE_UP, 0
            alone = first[k] == k and last[k] == k
            if not alone:
                if slot_count >= slot_limit:
                    return GROW, 0
                slots[k] = slot_count
                owners[slot_count] = k
                drawn[slot_count] = 0
                slot_count += 1
            # threads share these bytes: written no more than once each
            if marks[i] == 0:
                marks[i] = 1
            _set_colors(palette, k, advanced(colors, i * color_columns), color_rows)
            if alone:
                found = _keep_drawn(
                    found, advanced(pixels, begin), used + begin, k, layers, width, s, lengths, lists, deepest,
                    max(stop_high, floor), shrink, grow,
                )  # fmt: skip
            while found != 0:
                lane = begin + lowest_bit(found)
                found &= found - 1
                q = int(pixels[lane])
                at = (used + lane) * width
                low = layers[at + ALPHA_LOW]
                high = layers[at + ALPHA_HIGH]
                before = s[THI + q]
                t_low = s[TLO + q] * (1.0 - high) * shrink
                t_high = before * (1.0 - low) * grow
                if alone and t_high <= stop_low:
                    # surely the stop: neither this layer nor any behind it is drawn
                    live = signed(live & ~(1 << q))
                    continue
                if alone and t_low <= stop_high:
                    # s[LOST] is the most that any stop so far may leave of the light
                    s[LOST + q] = max(s[LOST + q], min(before, stop_high / (1.0 - high)))
                    if s[LOST + q] >= before:
                        set_unknown(layers, at, high, m)
                    else:
                        s[RHO + q] = s[LOST + q]
                count = _append_layer(used + lane, q, k, t_low, t_high, layers, width, s, lengths, lists, deepest)
                if t_high <= dark:
                    dim = signed(dim | (1 << q))
                if not alone:
                    if move_count >= move_limit:
                        return GROW, 0
                    lists[LISTED * (q * deepest + count) + 2] = move_count
                    for r in range(MOVES * move_count, MOVES * (move_count + 1), 8):
                        store(moves, r, 0.0 * load8(s, NUMBERS))
                    move_count += 1
                    drawn[slots[k]] = signed(int(drawn[slots[k]]) | (1 << q))
                    places[slots[k] * PIXELS + q] = count
                    # layers up to the last one whose order is uncertain may still come first
                    s[REACH + q] = max(s[REACH + q], float(last[k]))
            some_dim = dim & live
            while some_dim != 0:
                q = lowest_bit(some_dim)
                some_dim = signed(some_dim & (some_dim - 1))
                if s[REACH + q] <= k:
                    live = signed(live & ~(1 << q))
                    if s[THI + q] > stop_low and k + 1 < length:
                        s[OPEN + q] = s[THI + q]
                        missing = min(missing, k + 1)
        if live == 0:
            break
        used += end
    if missing < length:
        _colors_behind(
            missing, length, entries, colors, colors_, color_rows, pointer(background_), pointer(unseen_), marks
        )
    return pair_count, slot_count


@njit(cache=True, error_model="numpy")
def settle_stops(
    layers_, width, lists_, lengths, first_, last_, owners_, drawn_, places_, slot_count, s_, m, stop, unit
):
    """Drop or weaken the layers of uncertain depth order that the stop may hide (design.md, B6)."""
    layers, lists, first, last = pointer(layers_), pointer(lists_), pointer(first_), pointer(last_)
    owners, drawn, places, s = pointer(owners_), pointer(drawn_), pointer(places_), pointer(s_)
    deepest = lists_.shape[1]
    stop_low = stop * (1.0 - 8.0 * unit)
    stop_high = stop * (1.0 + 8.0 * unit)
    # the stop is out of reach of most pixels
    dark = 0
    for q in range(PIXELS):
        s[C1 + q] = 0.0
        if not s[TLO + q] > stop_high:
            dark |= 1 << q
    if dark == 0:
        return
    for slot in range(slot_count):
        k = owners[slot]
        some = drawn[slot]
        while some != 0:
            q = lowest_bit(some)
            some &= some - 1
            if dark & (1 << q) == 0:
                continue
            start = q * deepest
            e = start + int(places[slot * PIXELS + q])
            behind = e
            while behind + 1 < start + int(lengths[q]) and int(lists[LISTED * (behind + 1) + 1]) <= last[k]:
                behind += 1
            t_low = layers[int(lists[LISTED * behind]) * width + LEFT]
            if t_low > stop_high:
                continue
            before = e
            while before > start and int(lists[LISTED * (before - 1) + 1]) >= first[k]:
                before -= 1
            light = layers[int(lists[LISTED * before]) * width + LIGHT]
            at = int(lists[LISTED * e]) * width
            t_high = light * (1.0 - layers[at + ALPHA_LOW]) * (1.0 + 8.0 * unit)
            # the most light that a stop at this layer may leave
            high = layers[at + ALPHA_HIGH]
            lost = min(light, stop_high / (1.0 - high))
            if t_high <= stop_low:
                s[C1 + q] = max(s[C1 + q], lost)
                set_unknown(layers, at, 0.0, m)
            elif lost < light:
                # kept; what the stop may leave of the light is added at the end
                s[RHO + q] = max(s[RHO + q], lost, s[LOST + q])
            else:
                s[C1 + q] = max(s[C1 + q], lost)
                set_unknown(layers, at, high, m)
    # a stop at a dropped or weakened layer also hides the kept layers behind it
    for q in range(PIXELS):
        if s[RHO + q] > 0.0:
            s[RHO + q] = max(s[RHO + q], s[C1 + q])


@njit(cache=True, error_model="numpy")
def number_chains(last, chain):
    """Number the groups of list positions: no uncertain pair spans two groups."""
    group = 0
    reach = -1
    for k in range(last.size):
        if k > reach:
            group += 1
        chain[k] = group
        reach = max(reach, last[k])
