"""Optical depths along a ray, and the transmittance behind them (docs/dev/design.md, H6)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import (
    DEPTH_PRODUCT_ROUNDING,
    DEPTH_SUM_ROUNDING,
    HASH_LIGHT_ROUNDING,
    HASH_SUM_ROUNDING,
    HASH_UP,
    SPACING_ROUNDING,
)
from ns_abstract.methods.nerf.hash_bounds.forms import (
    UNCOUNTED,
    exp_above,
    exp_band,
    exp_below,
    multiply,
    pose_range,
    spread_of,
)


class Light(NamedTuple):
    """Optical depths of N intervals of one round, and the transmittance before and behind them.

    Attributes:
        depth: [N, n + 4] forms of optical depths; symbols are those of poses, of the interval's start and of its end.
        least, most: [N] bounds of these.
        total: [N + 1, n + 3] sums of the depths before an edge: centre, pose symbols and two unused numbers.
        edge: [N + 1] coefficients of the edges' symbols in all sums that reach beyond.
        edges, rests: [N + 2], [N + 1] sums of the absolute ``edge`` before an edge, and of the depths' radii.
        size: [N + 1] sums of the absolute values of depths.
        bounds: [N + 1, 2] bounds of the sums.
        light: [N + 1, 4] the transmittance at an edge, ``exp(-total)``: centre, loss per unit of the total's deviation,
            coefficient of the second pose symbol (line), rest.
        left: [N + 1, 2] bounds of the transmittance.
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


def light_of(count: int, n: int) -> Light:
    """Return memory for ``count`` intervals and n pose symbols."""
    return Light(
        np.zeros((count, n + 4)), np.zeros(count), np.zeros(count), np.zeros((count + 1, n + 3)), np.zeros(count + 1),
        np.zeros(count + 2), np.zeros(count + 1), np.zeros(count + 1), np.zeros((count + 1, 2)),
        np.zeros((count + 1, 4)), np.zeros((count + 1, 2)),
    )  # fmt: skip


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def times(a, b):
    """Return ``a b``, 0 where ``a`` is 0, even if ``b`` is infinite."""
    return 0.0 if a == 0.0 else a * b


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def add_depth(edges, i, density, bounds, shares, line, light, work):
    """Fill in interval ``i`` and its end from the form of its ``density``; return whether it is finite (design.md, H6).

    The intervals before it are filled in. ``density`` [n + 3] has the place symbol of the interval's middle and lies in
    ``bounds``; ``shares`` are those of `middle_of`; ``work`` is [2, n + 4].
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
    bounded = bounds[1] < np.inf or shortest > 0.0
    if not bounded:
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


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def begin(light):
    """Set the transmittance at the first edge to 1."""
    light.total[0] = 0.0
    light.edge[0] = light.edges[0] = light.rests[0] = light.size[0] = 0.0
    light.bounds[0] = 0.0
    light.light[0] = 0.0
    light.light[0, 0] = 1.0
    light.left[0] = 1.0


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _add_up(light, i, line, n):
    """Compute the sum of optical depths and the transmittance behind interval ``i``."""
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


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def give_up(light, first, count):
    """Set the optical depths of the intervals from ``first`` on to unknown."""
    n = light.depth.shape[1] - 4
    for i in range(first, count):
        light.depth[i] = 0.0
        light.depth[i, n + 3] = np.inf
        light.least[i], light.most[i] = 0.0, np.inf
        _add_up(light, i, False, n)


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def depths_functional(light, count, k, at_end, at_start, behind, own, scale):
    """Return the sum of absolute coefficients of ``scale (at_end dS_N + at_start dS_k + behind dS_k+1) + own symbols``.

    dS is the deviation of a sum of depths, without its pose symbols (design.md, H6); ``k`` is an edge below N. The
    factors are 0 where the transmittance is an interval; ``own`` are coefficients of the symbols of edges k and k + 1
    that are added.
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
