"""Bounds of front-to-back blending in a fixed order: the paper's SUMCUMPROD and what it replaces.

Layers run along the first axis, nearest first; the other axes are pixels or channels. The blended
value is ``pc = sum_i a_i c_i prod_{j<i} (1 - a_j)`` ("Abstract Rendering", Algorithm 2, lines 8-10).
"""

from __future__ import annotations

import itertools

import numpy as np

from ns_abstract.paper.affine import Enclosure, Face, constant_like, range_of
from ns_abstract.paper.interval import Float64Array, Interval


def blend(alphas: Float64Array, colors: Float64Array) -> Float64Array:
    """Return the blended value of layers [n, ...] (float64)."""
    light = np.cumprod(np.concatenate([np.ones((1, *alphas.shape[1:])), 1.0 - alphas[:-1]]), axis=0)
    return (light * alphas * colors).sum(axis=0)


def cumulative_blend(alphas: Face, colors: Interval | Float64Array) -> Face:
    """Return the blend by lines 8-10 of Algorithm 2: every opacity is used once per layer behind it.

    Args:
        alphas: Opacities [n, ...], of any face.
        colors: Colours [n, ...].

    Raises:
        IndexError: There are no layers.
    """
    color: Interval | Float64Array = colors[0]
    total = alphas[0] * color
    light = 1.0 - alphas[0]
    for i in range(1, alphas.shape[0]):
        color = colors[i]
        total = total + alphas[i] * light * color
        light = light * (1.0 - alphas[i])
    return total


def _over(alpha: Interval, color: Interval, behind: Interval) -> Interval:
    """Return the hull of ``P + a (c - P)``: multi-affine, so its extremes lie at the ends."""
    ends = itertools.product(alpha.bounds(), color.bounds(), behind.bounds())
    values = [Interval(p) + Interval(a) * (Interval(c) - p) for a, c, p in ends]
    return Interval(
        np.minimum.reduce([value.lower for value in values]), np.maximum.reduce([value.upper for value in values])
    )


def sumcumprod(alphas: Face, colors: Interval | Float64Array, behind: float = 0.0) -> Face:
    """Return SUMCUMPROD (Algorithm 5): blend back to front, ``P <- a_i c_i + (1 - a_i) P``, each ``a_i`` once.

    For independent opacities in [0, 1] the interval face is the exact range up to rounding: P increases with the P
    behind it, and each step is exact. The affine face takes each step as ``P + a (c - P)``, so a remainder behind a
    layer is multiplied by what passes the layer. Opacities [n, ...] may have any face, colours [n, ...] broadcast
    against them, and ``behind`` shows through all layers.
    """
    n = alphas.shape[0]
    ranges = range_of(alphas)
    colors = Interval.lift(colors)
    value = Interval(behind)
    form = None if isinstance(alphas, Interval) else Enclosure.of(alphas.basis, value)
    for i in reversed(range(n)):
        value = _over(ranges[i], colors[i], value)
        if form is not None:
            shape = value.shape
            alpha = alphas[i].broadcast_to(shape)
            form = (form + alpha * (colors[i] - form)).meet(value)
    return constant_like(alphas, value) if form is None else form
