"""Bounds of the places of hierarchical samples, and of the colours of rays from samples there (design.md, F14)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import EDGE_BINS, EDGE_ROUNDING, PLACE_ROOM
from ns_abstract.methods.nerf.render import HISTOGRAM_PADDING, Sampling


def edge_bounds(alpha_low: np.ndarray, alpha_high: np.ndarray, sampling: Sampling) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds [r, S + 1] of the sorted edges of the fine samples, as distances (design.md, F14).

    ``alpha_low``, ``alpha_high`` [r, samples] bound the coarse pass' opacities; S is ``samples + importance + 1``.
    """
    rows, bins = alpha_low.shape
    rounding = EDGE_ROUNDING * (bins + EDGE_BINS)
    one = np.ones((rows, 1))
    # transmittance of the bins before a knot, and of those behind it: least and largest
    before, after = [], []
    for passed in (1.0 - alpha_high, 1.0 - alpha_low):
        before.append(np.cumprod(np.concatenate([one, passed], axis=1), axis=1))
        after.append(np.cumprod(np.concatenate([one, passed[:, ::-1]], axis=1), axis=1)[:, ::-1])
    padding = HISTOGRAM_PADDING * np.arange(bins + 1)

    def share(before: np.ndarray, after: np.ndarray) -> np.ndarray:
        return (1.0 - before + padding) / (1.0 - before * after + padding[-1])

    least = np.maximum.accumulate(share(before[1], after[0]) - rounding, axis=1)
    most = np.minimum.accumulate((share(before[0], after[1]) + rounding)[:, ::-1], axis=1)[:, ::-1]
    count = sampling.importance + 1
    wanted = (np.arange(count) + 0.5) / count
    knots = np.linspace(0.0, 1.0, bins + 1)
    edges = []
    for shares, sign in ((most, -1.0), (least, 1.0)):
        new = np.stack([np.interp(wanted + sign * rounding, row, knots) for row in shares])
        places = np.sort(np.concatenate([np.broadcast_to(knots, (rows, bins + 1)), new], axis=1), axis=1)
        places = np.clip(places + sign * rounding, 0.0, 1.0)
        places[:, 0], places[:, -1] = 0.0, 1.0
        ends = places * sampling.far + (1.0 - places) * sampling.near
        ends[:, 1:-1] += sign * rounding * sampling.far
        edges.append(np.clip(ends, sampling.near, sampling.far))
    return edges[0], edges[1]


@njit(cache=True, error_model="numpy")
def field_hulls(edges_low, edges_high, start, step, densities, colors, density, color):
    """Write bounds of density and colour at the fine samples' midpoints from bounds on parts of the rays (F14).

    Args:
        edges_low, edges_high: [r, S + 1] of `edge_bounds`.
        start, step: Distance at which the first part begins, and length of every part.
        densities: [2, r, parts] least and largest, on equal parts of the rays.
        colors: [2, r, parts, 3] least and largest; infinity above -infinity for parts that are left out.
        density, color: [2, r, S], [2, r, S, 3]; overwritten.
    """
    parts = densities.shape[2]
    for r in range(edges_low.shape[0]):
        for i in range(edges_low.shape[1] - 1):
            near = 0.5 * (edges_low[r, i] + edges_low[r, i + 1])
            far = 0.5 * (edges_high[r, i] + edges_high[r, i + 1])
            begin = min(max(math.floor((near - start) / step - PLACE_ROOM), 0), parts - 1)
            stop = min(max(math.floor((far - start) / step + PLACE_ROOM), begin), parts - 1)
            least, most = np.inf, -np.inf
            for k in range(begin, stop + 1):
                least, most = min(least, densities[0, r, k]), max(most, densities[1, r, k])
            density[0, r, i], density[1, r, i] = least, most
            for c in range(3):
                dark, bright = np.inf, -np.inf
                for k in range(begin, stop + 1):
                    dark, bright = min(dark, colors[0, r, k, c]), max(bright, colors[1, r, k, c])
                color[0, r, i, c], color[1, r, i, c] = dark, bright


@njit(cache=True, error_model="numpy")
def composite(edges_low, edges_high, density, color, lower, upper):
    """Composite rays from bounds of their samples' places, densities and colours; write bounds of the result (F14).

    ``edges_low``, ``edges_high`` [r, S + 1] are of `edge_bounds`, ``density`` [2, r, S] and ``color`` [2, r, S, 3]
    (least above largest: left out) of `field_hulls`. ``lower``, ``upper`` [r, 3] hold the background first.
    """
    count = edges_low.shape[1] - 1
    ends = np.empty(2 * count + 2)
    for r in range(edges_low.shape[0]):
        ends[: count + 1] = edges_low[r]
        ends[count + 1 :] = edges_high[r]
        ends.sort()
        first = last = count - 1
        for k in range(2 * count, -1, -1):
            length = ends[k + 1] - ends[k]
            if length <= 0.0:
                continue
            # first and last sample whose interval may cover this segment
            while first > 0 and edges_high[r, first] > ends[k]:
                first -= 1
            while last > 0 and edges_low[r, last] >= ends[k + 1]:
                last -= 1
            least, most = density[0, r, first], density[1, r, first]
            for i in range(first + 1, last + 1):
                least, most = min(least, density[0, r, i]), max(most, density[1, r, i])
            least, most = -math.expm1(-length * least), -math.expm1(-length * most)
            for c in range(3):
                dark, bright = np.inf, -np.inf
                for i in range(first, last + 1):
                    dark, bright = min(dark, color[0, r, i, c]), max(bright, color[1, r, i, c])
                if not dark <= bright:
                    dark, bright = 0.0, 1.0
                rise, fall = bright - upper[r, c], dark - lower[r, c]
                upper[r, c] += (most if rise > 0.0 else least) * rise
                lower[r, c] += (most if fall < 0.0 else least) * fall
