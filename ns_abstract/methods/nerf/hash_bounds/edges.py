"""Positions of the ends of intervals along a ray, and their distances (docs/dev/design.md, H2)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import (
    HASH_LEAST,
    HASH_SUM_ROUNDING,
    HASH_UP,
    SPACING_BAND_ROUNDING,
    SPACING_ROUNDING,
)
from ns_abstract.methods.nerf.hash_bounds.forms import UNCOUNTED, form_range, reciprocal, scale_add, spread_of


class Edges(NamedTuple):
    """Ends of the intervals of one round.

    Attributes:
        place: [N + 1, n + 3] forms of positions in the spacing, each with a place symbol of its own and no radius.
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


def edges_of(count: int, n: int) -> Edges:
    """Return memory for ``count`` intervals and n pose symbols."""
    forms = count + 1, n + 3
    return Edges(
        np.zeros(forms), np.zeros(count + 1), np.zeros(count + 1), np.zeros(forms), np.zeros(count + 1),
        np.zeros(count + 1),
    )  # fmt: skip


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def space(edges, j, spacing, line, work):
    """Fill in the distance of edge ``j`` from its position (design.md, H2).

    ``spacing``: whether it is piecewise; the ray's ends in its units. ``work``: [4, n + 3].
    """
    piecewise, first, last = spacing
    place, out, low, high = edges.place[j], edges.distance[j], edges.low[j], edges.high[j]
    y, nothing, n = work[0], work[1], place.shape[0] - 3
    nothing[:] = 0.0
    scale_add(place, last - first, nothing, first, y)
    room = SPACING_ROUNDING * (abs(first) + abs(last))
    at_low, at_high = first + (last - first) * low - room, first + (last - first) * high + room
    if not piecewise:
        for s in range(n + 3):
            out[s] = y[s]
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


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _keep_finite(form, low, high):
    """Replace a ``form`` by the interval from ``low`` to ``high`` where that is no wider than the form's rest."""
    n = form.shape[0] - 3
    half = 0.5 * (high - low)
    if not abs(form[n + 1]) + form[n + 2] <= half:
        form[:] = 0.0
        form[0] = low + half if half < np.inf else low
        form[n + 1] = (half + HASH_SUM_ROUNDING * abs(form[0])) * HASH_UP
        form[n + 2] = 0.0


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def middle_of(edges, i, out):
    """Write the middle of interval ``i`` as a form ``out`` [n + 3] without radius.

    Returns:
        The fractions of its place symbol that are the symbols of the interval's start and end.
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
