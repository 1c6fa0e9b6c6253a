"""Bounds of blending when the depth order is uncertain: the paper's VR-IND, sorting, and our own.

Layers run along the first axis in any order; depths are [n], opacities [n, ...].
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from ns_abstract.paper.affine import Enclosure
from ns_abstract.paper.blend import convex_combination, cumulative_blend
from ns_abstract.paper.interval import BoolArray, Float64Array, Interval
from ns_abstract.paper.linear import Face, LinearBounds, constant_like

# depths may be of another face than opacities
Depths = TypeVar("Depths", Interval, Enclosure, LinearBounds)
# the faces that another bound can narrow
Ranged = TypeVar("Ranged", Interval, Enclosure)


def _range(x: Interval | Enclosure | LinearBounds) -> Interval:
    return x if isinstance(x, Interval) else x.range


def _differences(depths: Depths) -> Interval:
    """Ranges of ``d_i - d_j`` [n, n]."""
    n = depths.shape[0]
    rows = depths.reshape(n, 1).broadcast_to((n, n))
    return _range(rows - depths.reshape(1, n).broadcast_to((n, n)))


def surely_in_front(depths: Depths) -> BoolArray:
    """[n, n] whether layer j lies in front of layer i, ``d_j < d_i``, for every parameter value."""
    return _differences(depths).lower > 0.0


def permute(x: Float64Array, y: Float64Array) -> Float64Array:
    """``x`` reordered by ascending ``y``, equal ones in place."""
    return np.asarray(x)[np.argsort(y, kind="stable")]


def sort_by(x: Face, y: Depths) -> Face:
    """Bounds of `permute`: each place holds every element that may stand there.

    Element i may take the places from the number of elements surely before it to n - 1 minus the
    number surely after it; equal keys are undecided. A place with one candidate keeps its form.

    Args:
        x: Values [n, ...].
        y: Keys [n].
    """
    n = y.shape[0]
    if n == 0:
        return x
    before = surely_in_front(y)
    first, last = before.sum(axis=1), n - 1 - before.sum(axis=0)
    places = []
    for k in range(n):
        candidates = np.flatnonzero((first <= k) & (k <= last))
        if candidates.size == 1:
            places.append(x[int(candidates[0])])
            continue
        among = _range(x)[candidates]
        places.append(constant_like(x, Interval(among.lower.min(axis=0), among.upper.max(axis=0))))
    return type(x).stack(places)


def sorted_blend(alphas: Face, depths: Depths, colors: Interval | Float64Array) -> Face:
    """Lines 13-18 of Algorithm 1 with sorted opacities and colours bounded one by one."""
    return cumulative_blend(sort_by(alphas, depths), sort_by(Interval.lift(colors), depths))


def vr_ind_weights(alphas: Face, depths: Depths) -> tuple[Face, Face]:
    """Weights of the layers and of what is behind them, from pairwise indicators.

    ``w_i = a_i prod_{j != i} (1 - a_j Ind(d_i - d_j))`` (eq. 22; its ``a_i`` inside the product is a
    misprint for ``a_j``), ``w_behind = prod_j (1 - a_j)``. The indicator of a pair that may be equally
    deep counts as undecided, so that either order of a tie is enclosed.

    Args:
        alphas: Opacities [n, ...] in [0, 1].
        depths: [n].

    Returns:
        [n, ...] and [...], of the face of ``alphas``.
    """
    n = alphas.shape[0]
    front = surely_in_front(depths)
    either = Interval(0.0, 1.0)
    passing = 1.0 - alphas
    weights = []
    for i in range(n):
        weight = alphas[i]
        for j in range(n):
            if j == i or front[j, i]:
                continue
            if front[i, j]:
                weight = weight * passing[j]
            else:
                weight = weight * (1.0 - alphas[j] * constant_like(alphas, either.broadcast_to(alphas.shape[1:])))
        weights.append(weight)
    behind = passing[0]
    for j in range(1, n):
        behind = behind * passing[j]
    return type(alphas).stack(weights), behind


def vr_ind(alphas: Face, depths: Depths, colors: Interval | Float64Array) -> Face:
    """VR-IND (Algorithm 4): ``pc = sum_i w_i c_i``, without sorting.

    Args:
        alphas: Opacities [n, ...] in [0, 1], of any face.
        depths: [n]; the order is decided from the forms of the differences where it has forms.
        colors: Colours [n, ...] that broadcast against ``alphas``; numbers for `LinearBounds`.
    """
    weights, _ = vr_ind_weights(alphas, depths)
    return _weighted_sum(weights, colors)


def _weighted_sum(weights: Face, colors: Interval | Float64Array) -> Face:
    shape = np.broadcast_shapes(weights.shape[1:], colors.shape[1:])
    color: Interval | Float64Array = colors[0]
    total = weights[0].broadcast_to(shape) * color
    for i in range(1, weights.shape[0]):
        color = colors[i]
        total = total + weights[i].broadcast_to(shape) * color
    return total


def ordered_blend(alphas: Ranged, depths: Depths, colors: Interval | Float64Array) -> Ranged:
    """VR-IND, narrowed by the fact that the weights and the light that passes add up to 1.

    Args:
        alphas: Opacities [n, ...] in [0, 1].
        depths: [n].
        colors: Colours [n, ...] that broadcast against ``alphas``; what is behind them counts as black.
    """
    weights, behind = vr_ind_weights(alphas, depths)
    total = _weighted_sum(weights, colors)
    colors = Interval.lift(colors)
    # weights of opacities in [0, 1] lie there too
    unit = Interval(0.0, 1.0)
    ends = zip(_range(weights).intersect(unit).bounds(), _range(behind).intersect(unit).bounds(), strict=True)
    boxes = Interval(*(np.concatenate([layers, rest[None]]) for layers, rest in ends))
    black = np.zeros((1, *colors.shape[1:]))
    bound = convex_combination(boxes, Interval(*(np.concatenate([end, black]) for end in colors.bounds())))
    return total.intersect(bound) if isinstance(total, Interval) else total.meet(bound)
