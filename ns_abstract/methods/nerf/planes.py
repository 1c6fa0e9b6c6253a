"""Fit linear bounds in the parameters to bounds by part of a cell (design.md, F12)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ns_abstract.arithmetic.outward import outward
from ns_abstract.arithmetic.rounding import PLANE_ROUNDING, UNIT32
from ns_abstract.refine.protocol import LinearSets

Float64Array = NDArray[np.float64]

#: Most parts by axis that are told apart; neighbours are united beyond.
MOST_PARTS = 64
#: Steps of the search for a slope, and rounds over the axes.
_STEPS, _ROUNDS = 24, 2
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)


def unite_parts(low: np.ndarray, high: np.ndarray, ends: list[Float64Array]) -> tuple[np.ndarray, np.ndarray, list]:
    """Return parts [n, K_1, ..., K_d, 3] with edges ``ends`` [K_j + 1], neighbours united to `MOST_PARTS` by axis."""
    for axis, edges in enumerate(ends):
        count = len(edges) - 1
        if count <= MOST_PARTS:
            continue
        starts = np.unique(np.arange(MOST_PARTS) * count // MOST_PARTS)
        low = np.minimum.reduceat(low, starts, axis=axis + 1)
        high = np.maximum.reduceat(high, starts, axis=axis + 1)
        ends = [*ends[:axis], edges[np.append(starts, count)], *ends[axis + 1 :]]
    return low, high, ends


def fit_planes(
    low: np.ndarray, high: np.ndarray, ends: Sequence[Float64Array], slack: Sequence[float] = ()
) -> LinearSets:
    """Return planes below ``low`` and above ``high`` on every part, and so on their union (design.md, F12).

    The plane ``a p + b`` lies above the parts with middles c and half-widths h where ``b >= max_k(high_k - a c_k + |a|
    h_k)``. The right side, the plane's mean over the cell, is convex in a. It is minimised axis by axis. The offset is
    sound for any slopes.

    Args:
        low, high: [n, K_1, ..., K_d, 3] bounds by part.
        ends: [K_j + 1] edges of the parts along each axis, from -1 to 1.
        slack: [d] by which every part is wider on each side; none where it is left out.

    Returns:
        A_lower [n, 3, d], b_lower [n, 3], A_upper, b_upper, float32, rounded outward.
    """
    n, d = low.shape[0], len(ends)
    low, high, ends = unite_parts(low, high, list(ends))
    count = int(np.prod([len(edges) - 1 for edges in ends], dtype=int))
    middles = [0.5 * (edges[1:] + edges[:-1]) for edges in ends]
    wider = list(slack) or [0.0] * d
    halves = [
        0.5 * (edges[1:] - edges[:-1]) * (1.0 + PLANE_ROUNDING) + PLANE_ROUNDING + more
        for edges, more in zip(ends, wider, strict=True)
    ]
    centre, half = (
        np.stack(np.meshgrid(*part, indexing="ij"), axis=-1).reshape(count, d) if d else np.zeros((1, 0))
        for part in (middles, halves)
    )
    planes = []
    for sign, values in ((-1.0, low), (1.0, high)):
        # [n 3, parts]: below is above upside down
        rows = sign * np.moveaxis(values.reshape(n, count, 3).astype(np.float64), 1, 2).reshape(3 * n, count)
        slope = _slopes(rows, centre, half).astype(np.float32).astype(np.float64)
        offset = _offset(rows, slope, centre, half)
        offset = offset + PLANE_ROUNDING * (1.0 + np.abs(slope).sum(axis=1)) + UNIT32
        offset = outward(sign * offset, sign * offset)[0 if sign < 0.0 else 1]
        planes += [(sign * slope).reshape(n, 3, d).astype(np.float32), offset.reshape(n, 3)]
    return planes[0], planes[1], planes[2], planes[3]


def _offset(rows: Float64Array, slope: Float64Array, centre: Float64Array, half: Float64Array) -> Float64Array:
    """Return [r] least offsets such that planes of ``slope`` [r, d] lie above ``rows`` [r, parts]."""
    return (rows - slope @ centre.T + np.abs(slope) @ half.T).max(axis=1)


def _slopes(rows: Float64Array, centre: Float64Array, half: Float64Array) -> Float64Array:
    """Return [r, d] slopes of planes above ``rows`` [r, parts] whose offsets are small."""
    d = centre.shape[1]
    slope = np.zeros((len(rows), d))
    for _ in range(1 if d == 1 else _ROUNDS):
        for axis in range(d):
            rest = rows - slope @ centre.T + np.abs(slope) @ half.T
            rest += slope[:, axis, None] * centre[:, axis] - np.abs(slope[:, axis, None]) * half[:, axis]

            def offset(
                at: Float64Array, rest: Float64Array = rest, c: Float64Array = centre[:, axis],
                h: Float64Array = half[:, axis],
            ) -> Float64Array:  # fmt: skip
                return (rest - at[:, None] * c + np.abs(at)[:, None] * h).max(axis=1)

            slope[:, axis] = _least(offset, 2.0 * (rest.max(axis=1) - rest.min(axis=1)), slope[:, axis])
    return slope


def _least(offset, reach: Float64Array, least_known: Float64Array) -> Float64Array:
    """Return a point of [-reach, reach] where the convex ``offset`` is nearly least, no worse than two known ones."""
    low, high = -reach, reach.copy()
    inner = [high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)]
    values = [offset(place) for place in inner]
    for _ in range(_STEPS):
        left = values[0] <= values[1]
        low, high = np.where(left, low, inner[0]), np.where(left, inner[1], high)
        fresh = np.where(left, high - _GOLDEN * (high - low), low + _GOLDEN * (high - low))
        value = offset(fresh)
        inner = [np.where(left, fresh, inner[1]), np.where(left, inner[0], fresh)]
        values = [np.where(left, value, values[1]), np.where(left, values[0], value)]
    tried = np.stack([inner[0], least_known, np.zeros_like(least_known)])
    best = np.argmin(np.stack([offset(place) for place in tried]), axis=0)
    return np.take_along_axis(tried, best[None], axis=0)[0]
