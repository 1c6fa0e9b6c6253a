"""Bounds of blending when the depth order [n] of layers [n, ...] is uncertain: the paper's VR-IND, and sorting."""

from __future__ import annotations

import functools
import operator
from typing import TypeVar

import numpy as np

from ns_abstract.paper.affine import Enclosure, Face, constant_like, range_of
from ns_abstract.paper.blend import cumulative_blend
from ns_abstract.paper.interval import BoolArray, Float64Array, Interval

# depths may be of another face than opacities
Depths = TypeVar("Depths", Interval, Enclosure)


def _differences(depths: Depths) -> Interval:
    """Return ranges of ``d_i - d_j`` [n, n]."""
    n = depths.shape[0]
    rows = depths.reshape(n, 1).broadcast_to((n, n))
    return range_of(rows - depths.reshape(1, n).broadcast_to((n, n)))


def surely_in_front(depths: Depths) -> BoolArray:
    """Return [n, n] whether layer j lies in front of layer i, ``d_j < d_i``, for every parameter value."""
    return _differences(depths).lower > 0.0


def sort_by(x: Face, y: Depths) -> Face:
    """Return bounds of ``x`` [n, ...] in ascending order of ``y`` [n]: each place holds every possible element.

    Element i may take the places from the number of elements surely before it to n - 1 minus the number surely after
    it; equal keys are undecided. A place with one candidate keeps its form.
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
        among = range_of(x)[candidates]
        places.append(constant_like(x, Interval(among.lower.min(axis=0), among.upper.max(axis=0))))
    return type(x).stack(places)


def sorted_blend(alphas: Face, depths: Depths, colors: Interval | Float64Array) -> Face:
    """Return the blend by lines 13-18 of Algorithm 1, with sorted opacities and colours bounded one by one."""
    return cumulative_blend(sort_by(alphas, depths), sort_by(Interval.lift(colors), depths))


def vr_ind(alphas: Face, depths: Depths, colors: Interval | Float64Array) -> Face:
    """Return VR-IND (Algorithm 4): ``pc = sum_i w_i c_i``, without sorting, of opacities [n, ...] and depths [n].

    ``w_i = a_i prod_{j != i} (1 - a_j Ind(d_i - d_j))`` (eq. 22; its ``a_i`` inside the product is a misprint for
    ``a_j``). The indicator of a pair that may be equally deep counts as undecided, so that either order of a tie is
    enclosed. The order is decided from the forms of the differences where depths have forms.
    """
    n = alphas.shape[0]
    front = surely_in_front(depths)
    either = constant_like(alphas, Interval(0.0, 1.0).broadcast_to(alphas.shape[1:]))
    passing = 1.0 - alphas
    shape = np.broadcast_shapes(alphas.shape[1:], colors.shape[1:])
    terms = []
    for i in range(n):
        weight = alphas[i]
        for j in range(n):
            if j == i or front[j, i]:
                continue
            weight = weight * (passing[j] if front[i, j] else 1.0 - alphas[j] * either)
        color: Interval | Float64Array = colors[i]
        terms.append(weight.broadcast_to(shape) * color)
    return functools.reduce(operator.add, terms)
