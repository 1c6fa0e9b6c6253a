"""Optical depths along a ray, light that is left, and the samples that follow them (design.md, H5, H6)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import (
    DEPTH_PRODUCT_ROUNDING,
    DEPTH_SUM_ROUNDING,
    HASH_LEAST,
    HASH_LIGHT_ROUNDING,
    HASH_PLACE_ROUNDING,
    HASH_PLACES_ROUNDING,
    HASH_SUM_ROUNDING,
    HASH_UP,
    SHARE_BINS,
    SHARE_ROUNDING,
    SPACING_BAND_ROUNDING,
    SPACING_ROUNDING,
)
from ns_abstract.methods.nerf.hash_bounds.forms import (
    exp_above,
    exp_band,
    exp_below,
    form_range,
    multiply,
    pose_range,
    reciprocal,
    scale_add,
    spread_of,
)
from ns_abstract.methods.nerf.render import HISTOGRAM_PADDING


class Edges(NamedTuple):
    """Ends of the intervals of one round.

    Attributes:
        place: [N + 1, n + 3] forms of places in the spacing, each with a place symbol of its own and no radius.
        low, high: [N + 1] bounds of these.
        distance: [N + 1, n + 3] forms of distances, with the same symbols.
        near, far: [N + 1] bounds of these.
    """

    place: np.ndarray
    low: np.ndarray
    high: np.ndarray
    distance: np.ndarray
    near: np.ndarray
    far: np.ndarray


class Light(NamedTuple):
    """Depths of N intervals of one round, and the light that is left before and behind them.

    Attributes:
        depth: [N, n + 4] forms of optical depths; symbols are those of poses, of the interval's start and of its end.
        least, most: [N] bounds of these.
        total: [N + 1, n + 3] sums of the depths before an edge: centre, pose symbols and two unused numbers.
        edge: [N + 1] coefficients of the edges' symbols in all sums that reach beyond.
        edges, rests: [N + 2], [N + 1] sums of the absolute ``edge`` before an edge, and of the depths' radii.
        size: [N + 1] sums of the absolute values of depths.
        bounds: [N + 1, 2] bounds of the sums.
        light: [N + 1, 4] the light that is left at an edge, ``exp(-total)``: centre, what it loses by unit of the
            total's deviation, coefficient of the second pose symbol (line), rest.
        left: [N + 1, 2] bounds of the light.
    """

    depth: np.ndarray
    least: np.ndarray
    most: np.ndarray
    total: np.ndarray
    edge: np.ndarray
    edges: np.ndarray
    rests: np.ndarray
    size: np.ndarray
    bounds: np.ndarray
    light: np.ndarray
    left: np.ndarray


def edges_of(count: int, n: int) -> Edges:
    """Room for ``count`` intervals and n pose symbols."""
    forms = count + 1, n + 3
    return Edges(
        np.zeros(forms), np.zeros(count + 1), np.zeros(count + 1), np.zeros(forms), np.zeros(count + 1),
        np.zeros(count + 1),
    )  # fmt: skip


def light_of(count: int, n: int) -> Light:
    """Room for ``count`` intervals and n pose symbols."""
    return Light(
        np.zeros((count, n + 4)), np.zeros(count), np.zeros(count), np.zeros((count + 1, n + 3)), np.zeros(count + 1),
        np.zeros(count + 2), np.zeros(count + 1), np.zeros(count + 1), np.zeros((count + 1, 2)),
        np.zeros((count + 1, 4)), np.zeros((count + 1, 2)),
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def times(a, b):
    """``a b``, 0 where ``a`` is 0 although ``b`` is infinite."""
    return 0.0 if a == 0.0 else a * b


@njit(cache=True, error_model="numpy")
def space(edges, j, spacing, line, work):
    """Fill in the distance of edge ``j`` (design.md, H2).

    Args:
        edges: `Edges`.
        j: The edge.
        spacing: Whether it is piecewise; the ray's ends in its units.
        line: See `forms`.
        work: [4, n + 3].
    """
    piecewise, first, last = spacing
    place, out, low, high = edges.place[j], edges.distance[j], edges.low[j], edges.high[j]
    y, nothing, n = work[0], work[1], place.shape[0] - 3
    nothing[:] = 0.0
    scale_add(place, last - first, nothing, first, y)
    room = SPACING_ROUNDING * (abs(first) + abs(last))
    at_low, at_high = first + (last - first) * low - room, first + (last - first) * high + room
    if not piecewise:
        out[:] = y
        out[n + 2] += room
        edges.near[j], edges.far[j] = at_low, at_high
        return
    near = 2.0 * at_low if at_low < 0.5 else 1.0 / max(2.0 - 2.0 * at_low, HASH_LEAST)
    far = 2.0 * at_high if at_high < 0.5 else 1.0 / (2.0 - 2.0 * at_high)
    if not at_high < 1.0:
        far = np.inf
    edges.near[j], edges.far[j] = max(near * (1.0 - SPACING_BAND_ROUNDING), 0.0), far * (1.0 + SPACING_BAND_ROUNDING)
    y[n + 2] += room
    form_low, form_high = form_range(y, line)
    if form_high <= 0.5:
        scale_add(y, 2.0, nothing, 0.0, out)
    elif form_low >= 0.5:
        scale_add(y, -2.0, nothing, 2.0, y)
        y[n + 2] += SPACING_ROUNDING
        reciprocal(y, line, out, work[2:])
        if out[n + 2] < np.inf:
            out[n + 2] += SPACING_ROUNDING * abs(out[0])
    elif form_high < 1.0:
        # once differentiable: the second derivative is between 0 and 8 / (2 - 2 y)^3
        c, reach, end = y[0], spread_of(y), 2.0 - 2.0 * form_high
        slope = 2.0 if c < 0.5 else 2.0 / ((2.0 - 2.0 * c) * (2.0 - 2.0 * c))
        value = 2.0 * c if c < 0.5 else 1.0 / (2.0 - 2.0 * c)
        bend = 4.0 / (end * end * end) * reach * reach * HASH_UP
        y[0] = 0.0
        scale_add(y, slope, nothing, value + 0.5 * bend, out)
        out[n + 2] += 0.5 * bend * HASH_UP + SPACING_BAND_ROUNDING * (1.0 + abs(value))
    else:
        out[:] = 0.0
        out[n + 2] = np.inf
    _keep_finite(out, edges.near[j], edges.far[j])


@njit(cache=True, error_model="numpy")
def _keep_finite(form, low, high):
    """Replace a ``form`` by the interval from ``low`` to ``high`` where that is as good as its own rest."""
    n = form.shape[0] - 3
    half = 0.5 * (high - low)
    if not abs(form[n + 1]) + form[n + 2] <= half:
        form[:] = 0.0
        form[0] = low + half if half < np.inf else low
        form[n + 1] = (half + HASH_SUM_ROUNDING * abs(form[0])) * HASH_UP
        form[n + 2] = 0.0


@njit(cache=True, error_model="numpy")
def middle_of(edges, i, out):
    """The middle of interval ``i`` as a form ``out`` [n + 3] without radius.

    Returns:
        Shares of its place symbol that are the symbols of the interval's start and end.
    """
    a, b = edges.distance[i], edges.distance[i + 1]
    n = a.shape[0] - 3
    for s in range(n + 1):
        out[s] = 0.5 * (a[s] + b[s])
    start, stop = 0.5 * a[n + 1], 0.5 * b[n + 1]
    total = start + stop + 0.5 * (a[n + 2] + b[n + 2]) + HASH_SUM_ROUNDING * (abs(a[0]) + abs(b[0]))
    out[n + 1], out[n + 2] = total * HASH_UP, 0.0
    if total > 0.0:
        return start / out[n + 1], stop / out[n + 1]
    return 0.0, 0.0


@njit(cache=True, error_model="numpy")
def add_depth(edges, i, density, bounds, shares, line, light, work):
    """Fill in interval ``i`` and its end from the form of its ``density`` (design.md, H6).

    Args:
        edges: `Edges`.
        i: The interval; those before it are filled in.
        density: [n + 3] with the place symbol of the interval's middle.
        bounds: Least and largest density.
        shares: Those of `middle_of`.
        line: See `forms`.
        light: `Light`.
        work: [2, n + 4].

    Returns:
        Whether something is known.
    """
    a, b = edges.distance[i], edges.distance[i + 1]
    n = a.shape[0] - 3
    length, value, out = work[0], work[1], light.depth[i]
    for s in range(n + 1):
        length[s], value[s] = b[s] - a[s], density[s]
    length[n + 1], length[n + 2] = -a[n + 1], b[n + 1]
    length[n + 3] = (a[n + 2] + b[n + 2] + SPACING_ROUNDING * (abs(a[0]) + abs(b[0]))) * HASH_UP
    value[n + 1], value[n + 2] = density[n + 1] * shares[0], density[n + 1] * shares[1]
    left = max(1.0 - shares[0] - shares[1], 0.0) + HASH_SUM_ROUNDING
    value[n + 3] = (density[n + 2] + abs(density[n + 1]) * left) * HASH_UP
    multiply(length, value, line, out)
    out[n + 3] += DEPTH_PRODUCT_ROUNDING * (abs(out[0]) + spread_of(out))
    shortest = edges.near[i + 1] - edges.far[i]
    longest = edges.far[i + 1] - edges.near[i]
    pose_low, pose_high = pose_range(length, line, n)
    rest = abs(length[n + 1]) + abs(length[n + 2]) + length[n + 3]
    shortest = max(0.0, shortest, length[0] + pose_low - rest) * (1.0 - DEPTH_PRODUCT_ROUNDING)
    longest = min(longest, length[0] + pose_high + rest) * (1.0 + DEPTH_PRODUCT_ROUNDING)
    room = SPACING_ROUNDING * (abs(a[0]) + abs(b[0]))
    shortest, longest = max(shortest - room, 0.0), max(longest + room, 0.0)
    least = times(shortest, bounds[0]) * (1.0 - DEPTH_PRODUCT_ROUNDING)
    most = longest * bounds[1] * (1.0 + DEPTH_PRODUCT_ROUNDING)
    # where density may overflow, a concrete interval of length 0 is not a number
    known = bounds[1] < np.inf or shortest > 0.0
    if not known:
        return False
    if out[n + 3] < np.inf:
        pose_low, pose_high = pose_range(out, line, n)
        rest = (abs(out[n + 1]) + abs(out[n + 2]) + out[n + 3]) * HASH_UP
        least, most = max(least, out[0] + pose_low - rest), min(most, out[0] + pose_high + rest)
        if not least <= most:
            return False
    else:
        out[:] = 0.0
        out[n + 3] = np.inf
    light.least[i], light.most[i] = least, most
    _add_up(light, i, line, n)
    return True


@njit(cache=True, error_model="numpy")
def begin(light):
    """Set the light at the first edge: all of it."""
    light.total[0] = 0.0
    light.edge[0] = light.edges[0] = light.rests[0] = light.size[0] = 0.0
    light.bounds[0] = 0.0
    light.light[0] = 0.0
    light.light[0, 0] = 1.0
    light.left[0] = 1.0


@njit(cache=True, error_model="numpy")
def _add_up(light, i, line, n):
    """Sum and light behind interval ``i``."""
    x, total, k = light.depth[i], light.total, i + 1
    for s in range(n + 1):
        total[k, s] = total[i, s] + x[s]
    light.edge[i] += x[n + 1]
    light.edge[k] = x[n + 2]
    light.edges[k] = light.edges[i] + abs(light.edge[i])
    light.edges[k + 1] = light.edges[k] + abs(light.edge[k])
    light.rests[k] = (light.rests[i] + x[n + 3]) * HASH_UP
    spread = abs(x[n + 1]) + abs(x[n + 2])
    for s in range(n + 1):
        spread += abs(x[s])
    light.size[k] = light.size[i] + spread
    slack = DEPTH_SUM_ROUNDING * (k + 4.0) * light.size[k]
    down, up = 1.0 - DEPTH_SUM_ROUNDING * (k + 4.0), 1.0 + DEPTH_SUM_ROUNDING * (k + 4.0)
    low, high = light.bounds[i, 0] + light.least[i] * down, light.bounds[i, 1] + light.most[i] * up
    pose_low, pose_high = pose_range(total[k], line, n)
    others = (light.edges[k + 1] + light.rests[k] + slack) * HASH_UP
    form = others < np.inf
    if form:
        low, high = max(low, total[k, 0] + pose_low - others), min(high, total[k, 0] + pose_high + others)
        low = max(low, 0.0)
        if not low <= high:
            low, high = 0.0, np.inf
    light.bounds[k, 0], light.bounds[k, 1] = low, high
    light.left[k, 0], light.left[k, 1] = exp_below(-high), min(exp_above(-low), 1.0)
    half = 0.5 * (light.left[k, 1] - light.left[k, 0])
    out = light.light[k]
    if form and low <= total[k, 0] <= high:
        value, slope, curvature, rest = exp_band(-total[k, 0], -high, -low)
        # rounding of the sum moves the light like a deviation
        rest += slope * slack
        bend = 0.0
        if curvature > 0.0:
            if line:
                # the square of the deviation, whose first symbol is followed
                own = total[k, 1] * total[k, 1]
                remaining = others + abs(total[k, 2])
                rest += curvature * (2.0 * abs(total[k, 1]) * remaining + remaining * remaining)
                value += 0.5 * curvature * own
                bend = 0.5 * curvature * own
            else:
                reach = max(pose_high, -pose_low) + others
                value += 0.5 * curvature * reach * reach
                rest += 0.5 * curvature * reach * reach
        if rest < half:
            out[0], out[1], out[2], out[3] = value, slope, bend, (rest + HASH_LIGHT_ROUNDING * abs(value)) * HASH_UP
            return
    out[0], out[1], out[2] = light.left[k, 0] + half, 0.0, 0.0
    out[3] = (half + HASH_SUM_ROUNDING) * HASH_UP


@njit(cache=True, error_model="numpy")
def give_up(light, first, count):
    """Leave open the depths of the intervals from ``first`` on."""
    n = light.depth.shape[1] - 4
    for i in range(first, count):
        light.depth[i] = 0.0
        light.depth[i, n + 3] = np.inf
        light.least[i], light.most[i] = 0.0, np.inf
        _add_up(light, i, False, n)


@njit(cache=True, error_model="numpy")
def _functional(light, count, k, at_end, at_start, behind, own, scale):
    """Sum of the absolute coefficients of ``scale (at_end dS_N + at_start dS_k + behind dS_k+1) + own symbols``.

    dS is what a sum of depths deviates by, without its pose symbols (design.md, H6).

    Args:
        light: `Light`.
        count: N.
        k: An edge below N.
        at_end, at_start, behind: Factors; 0 where the light is an interval.
        own: Coefficients of the symbols of the edges k and k + 1 that are added.
        scale: A factor.
    """
    n = light.depth.shape[1] - 4
    start = light.depth[k - 1, n + 2] if k > 0 else 0.0
    total = times(abs(at_end + at_start + behind), light.edges[k] + light.rests[k])
    here = times(at_end + behind, light.edge[k]) + times(at_start, start)
    there = times(at_end, light.edge[k + 1]) + times(behind, light.depth[k, n + 2])
    total += times(abs(at_end + behind), light.depth[k, n + 3])
    if at_end != 0.0:
        far = max(light.edges[count + 1] - light.edges[k + 2], 0.0) if k + 2 <= count else 0.0
        far += max(light.rests[count] - light.rests[k + 1], 0.0)
        total += abs(at_end) * (far + (HASH_UP - 1.0) * (light.edges[count + 1] + light.rests[count]))
    return (abs(scale) * total + abs(scale * here + own[0]) + abs(scale * there + own[1])) * HASH_UP


@njit(cache=True, error_model="numpy")
def _excess(light, count, k, share, line, out):
    """``share D - 1 + A_k - a k``: how far the share of the distribution is beyond edge k, times D (design.md, H6).

    Args:
        light: `Light`.
        count: N.
        k: An edge.
        share: In (0, 1).
        line: See `forms`.
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
        symbols = _functional(light, count, k, share * end[1], -here[1], 0.0, (0.0, 0.0), 1.0)
        pose_low, pose_high = pose_range(out, line, n)
        reach = (symbols + rest) * HASH_UP
        low, high = max(low, out[0] + pose_low - reach), min(high, out[0] + pose_high + reach)
    return low, high, rest


@njit(cache=True, error_model="numpy")
def _bin(light, k, line, out):
    """Weight and padding of bin k: pose symbols ``out`` [n + 3] of the form, its rest, and bounds."""
    n = out.shape[0] - 3
    here, there = light.light[k], light.light[k + 1]
    out[0] = here[0] - there[0] + HISTOGRAM_PADDING
    for s in range(1, n + 1):
        out[s] = there[1] * light.total[k + 1, s] - here[1] * light.total[k, s]
    if line:
        out[2] += here[2] - there[2]
    rest = here[3] + there[3] + HASH_LIGHT_ROUNDING
    rest = (rest + _functional(light, k + 1, k, 0.0, -here[1], there[1], (0.0, 0.0), 1.0)) * HASH_UP
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


@njit(cache=True, error_model="numpy")
def _one_bin(light, count, edges, k, share, line, out, work):
    """Place of an edge that surely lies in bin k (design.md, H6)."""
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
    symbols = _functional(light, count, k, factors[0], factors[1], factors[2], (0.0, 0.0), 1.0)
    followed = _functional(light, count, k, factors[0], factors[1], factors[2], own, scale)
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


@njit(cache=True, error_model="numpy")
def _slopes_of_bins(light, edges, first, past, line, work):
    """Least and largest slope of the places in bins ``first`` to ``past`` (exclusive)."""
    least, most = np.inf, 0.0
    for k in range(first, past):
        _, low, high = _bin(light, k, line, work)
        longest = edges.high[k + 1] - edges.low[k]
        shortest = max(edges.low[k + 1] - edges.high[k], 0.0)
        least, most = min(least, shortest / high), max(most, longest / low)
    return least * (1.0 - HASH_LIGHT_ROUNDING), most * (1.0 + HASH_LIGHT_ROUNDING)


@njit(cache=True, error_model="numpy")
def _several_bins(light, count, edges, first, past, share, line, out, work):
    """Place of an edge in one of several bins: from a knot on by slopes of either side (design.md, H6)."""
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
    symbols = _functional(
        light, count, k, share * light.light[count, 1], -light.light[k, 1], 0.0, (edges.place[k, n + 1], 0.0), slope
    )
    for s in range(n + 1):
        out[s] = edges.place[k, s] + slope * value[s]
    out[0] += 0.5 * corner
    return (symbols + abs(slope) * rest + max(wide[0], wide[1]) + 0.5 * abs(corner)) * HASH_UP + HASH_PLACES_ROUNDING


@njit(cache=True, error_model="numpy")
def follow(light, count, edges, wanted, line, out, work):
    """Places ``out`` of the edges of the next round (design.md, H6).

    Args:
        light: `Light` of this round.
        count: Its intervals.
        edges: Theirs.
        wanted: Edges of the next round.
        line: See `forms`.
        out: `Edges`; places alone are filled in.
        work: [3, n + 3].

    Returns:
        Whether all is finite.
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


@njit(cache=True, error_model="numpy")
def _within(light, count, edges, first, past, share, line, work):
    """Bounds of the place of an edge in the bins from ``first`` to ``past`` (exclusive)."""
    low, _, _ = _excess(light, count, first, share, line, work[0])
    _, _, high_weight = _bin(light, first, line, work[1])
    part = min(max(low / high_weight, 0.0), 1.0)
    least = edges.low[first] + part * (edges.low[first + 1] - edges.low[first])
    _, high, _ = _excess(light, count, past - 1, share, line, work[0])
    _, low_weight, _ = _bin(light, past - 1, line, work[1])
    part = min(max(high / low_weight, 0.0), 1.0)
    most = edges.high[past - 1] + part * (edges.high[past] - edges.high[past - 1])
    return least - HASH_PLACE_ROUNDING, most + HASH_PLACE_ROUNDING
