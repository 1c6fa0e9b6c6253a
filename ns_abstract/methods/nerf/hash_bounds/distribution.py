"""Positions of the samples of the next round: quantiles of the intervals' weights (docs/dev/design.md, H6).

``light`` is a `Light`, ``count`` the number N of its intervals, ``line`` as in `forms`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import (
    HASH_LIGHT_ROUNDING,
    HASH_PLACE_ROUNDING,
    HASH_PLACES_ROUNDING,
    HASH_SUM_ROUNDING,
    HASH_UP,
    SHARE_BINS,
    SHARE_ROUNDING,
)
from ns_abstract.methods.nerf.hash_bounds.forms import UNCOUNTED, exp_above, exp_below, form_range, pose_range
from ns_abstract.methods.nerf.hash_bounds.light import depths_functional
from ns_abstract.methods.nerf.render import HISTOGRAM_PADDING


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _excess(light, count, k, share, line, out):
    """Compute ``share D - 1 + A_k - a k``: D times the excess of the distribution's share beyond edge k (H6).

    Args:
        k: An edge.
        share: In (0, 1).
        out: [n + 3] centre and pose symbols; overwritten.

    Returns:
        Bounds, and the rest that is not in symbols.
    """
    n = out.shape[0] - 3
    end, here = light.light[count], light.light[k]
    pad = HISTOGRAM_PADDING
    rounding = SHARE_ROUNDING * (count + SHARE_BINS) * (1.0 + pad * count)
    out[0] = share * (1.0 - end[0] + pad * count) - 1.0 + here[0] - pad * k
    for s in range(1, n + 1):
        out[s] = share * end[1] * light.total[count, s] - here[1] * light.total[k, s]
    if line:
        out[2] += here[2] - share * end[2]
    rest = share * end[3] + here[3] + rounding
    low = share * (1.0 - light.left[count, 1] + pad * count) - 1.0 + light.left[k, 0] - pad * k - rounding
    high = share * (1.0 - light.left[count, 0] + pad * count) - 1.0 + light.left[k, 1] - pad * k + rounding
    if k < count:
        symbols = depths_functional(light, count, k, share * end[1], -here[1], 0.0, (0.0, 0.0), 1.0)
        pose_low, pose_high = pose_range(out, line, n)
        reach = (symbols + rest) * HASH_UP
        low, high = max(low, out[0] + pose_low - reach), min(high, out[0] + pose_high + reach)
    return low, high, rest


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _bin(light, k, line, out):
    """Return weight plus padding of bin k of a round: its form's symbols in ``out`` [n + 3], its rest, and bounds."""
    n = out.shape[0] - 3
    here, there = light.light[k], light.light[k + 1]
    out[0] = here[0] - there[0] + HISTOGRAM_PADDING
    for s in range(1, n + 1):
        out[s] = there[1] * light.total[k + 1, s] - here[1] * light.total[k, s]
    if line:
        out[2] += here[2] - there[2]
    rest = here[3] + there[3] + HASH_LIGHT_ROUNDING
    rest = (rest + depths_functional(light, k + 1, k, 0.0, -here[1], there[1], (0.0, 0.0), 1.0)) * HASH_UP
    # 1 - exp(-x), up to a few units
    low = light.left[k, 0] * max(1.0 - exp_above(-light.least[k]), 0.0) - HASH_LIGHT_ROUNDING
    high = light.left[k, 1] * (1.0 - exp_below(-light.most[k])) + HASH_LIGHT_ROUNDING
    low, high = (
        max(low, 0.0) + HISTOGRAM_PADDING * (1.0 - HASH_SUM_ROUNDING),
        high + HISTOGRAM_PADDING * (1.0 + HASH_SUM_ROUNDING),
    )
    pose_low, pose_high = pose_range(out, line, n)
    if rest < np.inf:
        low, high = max(low, out[0] + pose_low - rest), min(high, out[0] + pose_high + rest)
    return rest, low, high


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _one_bin(light, count, edges, k, share, line, out, work):
    """Compute the position of the edge at fraction ``share`` of the distribution, which surely lies in bin k (H6)."""
    n = out.shape[0] - 3
    value, weight = work[0], work[1]
    _excess(light, count, k, share, line, value)
    rest_weight, low_weight, high_weight = _bin(light, k, line, weight)
    center = weight[0]
    if not (center > 0.0 and low_weight > 0.0):
        return np.inf
    part = min(max(value[0] / center, 0.0), 1.0)
    end, here, there = light.light[count], light.light[k], light.light[k + 1]
    before, behind = edges.place[k], edges.place[k + 1]
    # what is left of the excess: share D - 1 + A_k - a k - part (A_k - A_k+1 + a)
    factors = share * end[1], -(1.0 - part) * here[1], -part * there[1]
    for s in range(n + 1):
        value[s] -= part * weight[s]
    rest = share * end[3] + (1.0 - part) * here[3] + part * there[3]
    rest += SHARE_ROUNDING * (count + SHARE_BINS) * (1.0 + HISTOGRAM_PADDING * count) + HASH_LIGHT_ROUNDING
    length, spread_length = behind[0] - before[0], 0.0
    for s in range(1, n + 1):
        spread_length += abs(behind[s] - before[s])
    others_length = spread_length - abs(behind[1] - before[1]) + abs(before[n + 1]) + abs(behind[n + 1])
    spread_length += abs(before[n + 1]) + abs(behind[n + 1])
    scale = length / center
    own = (1.0 - part) * before[n + 1], part * behind[n + 1]
    symbols = depths_functional(light, count, k, factors[0], factors[1], factors[2], (0.0, 0.0), 1.0)
    followed = depths_functional(light, count, k, factors[0], factors[1], factors[2], own, scale)
    for s in range(n + 1):
        out[s] = (1.0 - part) * before[s] + part * behind[s] + scale * value[s]
    # products of deviations: of the excess with those of the weight, and of both with the length's
    pose_value, pose_weight = 0.0, 0.0
    for s in range(1, n + 1):
        pose_value += abs(value[s])
        pose_weight += abs(weight[s])
    reach = abs(value[0]) + pose_value + symbols + rest
    form_weight = pose_weight + rest_weight
    reach_weight = min(form_weight, max(high_weight - center, center - low_weight) * HASH_UP)
    bend, turn, slope = 0.0, 0.0, 0.0
    products = reach * reach_weight / (center * low_weight)
    if line:
        others, others_weight = reach - abs(value[1]), form_weight - abs(weight[1])
        curved = value[1] * weight[1] / (center * center)
        second = abs(value[1]) * others_weight + others * (abs(weight[1]) + others_weight)
        followed_products = second / (center * low_weight) + abs(curved) * reach_weight / low_weight
        if followed_products < products:
            bend, products = -curved, followed_products
        slope = value[1] / center
        turn = slope * (behind[1] - before[1])
    own_rest = (max(reach / center - abs(slope), 0.0) + abs(bend) + products) * spread_length
    if line:
        own_rest += abs(slope) * others_length
    bent = length * bend + turn
    out[0] += 0.5 * bent
    if line:
        out[2] += 0.5 * bent
    rest = abs(scale) * rest + abs(length) * products + own_rest
    return (followed + rest) * HASH_UP + HASH_PLACE_ROUNDING * (1.0 + abs(scale) * reach)


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _slopes_of_bins(light, edges, first, past, line, work):
    """Return the least and largest slope of the inverse distribution in bins ``first`` to ``past`` (exclusive)."""
    least, most = np.inf, 0.0
    for k in range(first, past):
        _, low, high = _bin(light, k, line, work)
        longest = edges.high[k + 1] - edges.low[k]
        shortest = max(edges.low[k + 1] - edges.high[k], 0.0)
        least, most = min(least, shortest / high), max(most, longest / low)
    return least * (1.0 - HASH_LIGHT_ROUNDING), most * (1.0 + HASH_LIGHT_ROUNDING)


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _several_bins(light, count, edges, first, past, share, line, out, work):
    """Compute the position of the edge at fraction ``share``, in several bins, by slopes of either side (H6)."""
    n = out.shape[0] - 3
    value, best = work[0], np.inf
    k = first + 1
    for j in range(first + 1, past):
        _excess(light, count, j, share, line, value)
        if abs(value[0]) < best:
            k, best = j, abs(value[0])
    low, high, rest = _excess(light, count, k, share, line, value)
    below = _slopes_of_bins(light, edges, first, k, line, work[1])
    above = _slopes_of_bins(light, edges, k, past, line, work[1])
    down, up = 0.5 * (below[0] + below[1]), 0.5 * (above[0] + above[1])
    wide = max(high, 0.0) * 0.5 * (above[1] - above[0]), max(-low, 0.0) * 0.5 * (below[1] - below[0])
    slope, corner = up if low >= 0.0 else down, 0.0
    if low < 0.0 < high:
        slope = (up * high - down * low) / (high - low)
        corner = (up - slope) * high
    symbols = depths_functional(
        light, count, k, share * light.light[count, 1], -light.light[k, 1], 0.0, (edges.place[k, n + 1], 0.0), slope
    )
    for s in range(n + 1):
        out[s] = edges.place[k, s] + slope * value[s]
    out[0] += 0.5 * corner
    return (symbols + abs(slope) * rest + max(wide[0], wide[1]) + 0.5 * abs(corner)) * HASH_UP + HASH_PLACES_ROUNDING


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def follow(light, count, edges, wanted, line, out, work):
    """Compute the positions ``out`` of the edges of the next round; return whether all are finite (design.md, H6).

    Args:
        light: `Light` of this round.
        count: Its number of intervals.
        edges: Its edges.
        wanted: Number of edges of the next round.
        out: `Edges`; only positions are filled in.
        work: [3, n + 3].
    """
    n, first = out.place.shape[1] - 3, 0
    scratch = work[2]
    for j in range(wanted):
        share = (j + 0.5) / wanted
        # the last edge that surely comes first, and the first one that surely does not
        while first + 1 < count and _excess(light, count, first + 1, share, line, scratch)[0] >= 0.0:
            first += 1
        past = first + 1
        while past < count and not _excess(light, count, past, share, line, scratch)[1] <= 0.0:
            past += 1
        place = out.place[j]
        low, high = _within(light, count, edges, first, past, share, line, work)
        if past == first + 1:
            rest = _one_bin(light, count, edges, first, share, line, place, work)
        else:
            rest = _several_bins(light, count, edges, first, past, share, line, place, work)
        place[n + 1], place[n + 2] = rest, 0.0
        if rest < np.inf:
            least, most = form_range(place, line)
            low, high = max(low, least), min(high, most)
        half = 0.5 * (high - low)
        if not low <= high:
            return False
        if not rest < half:
            place[:] = 0.0
            place[0], place[n + 1] = low + half, (half + HASH_SUM_ROUNDING) * HASH_UP
        out.low[j], out.high[j] = low, high
    return True


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _within(light, count, edges, first, past, share, line, work):
    """Return bounds of the position of the edge at fraction ``share`` in bins ``first`` to ``past`` (exclusive)."""
    low, _, _ = _excess(light, count, first, share, line, work[0])
    _, _, high_weight = _bin(light, first, line, work[1])
    part = min(max(low / high_weight, 0.0), 1.0)
    least = edges.low[first] + part * (edges.low[first + 1] - edges.low[first])
    _, high, _ = _excess(light, count, past - 1, share, line, work[0])
    _, low_weight, _ = _bin(light, past - 1, line, work[1])
    part = min(max(high / low_weight, 0.0), 1.0)
    most = edges.high[past - 1] + part * (edges.high[past] - edges.high[past - 1])
    return least - HASH_PLACE_ROUNDING, most + HASH_PLACE_ROUNDING
