"""Forms of order 2 in one parameter as four numbers: the rules of `forms` for one quantity (design.md, A6).

Compiled loops over many quantities keep these numbers in registers, which takes a fifth of the time that the array
kernels take; each function names its kernel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import FORM_ROUNDING, LARGEST, RANGE_ROUNDING, SMALLEST, UNDERFLOW64, UP


class LineForm(NamedTuple):
    """All functions of p in [-1, 1] within ``radius`` of the polynomial ``center + slope p + bend p^2``."""

    center: float
    slope: float
    bend: float
    radius: float


@njit(cache=True, error_model="numpy", inline="always")
def magnitude(a):
    """Return an upper bound of the polynomial's absolute value, up to rounding."""
    return abs(a.center) + abs(a.slope) + abs(a.bend)


@njit(cache=True, error_model="numpy", inline="always")
def combined(a, s, b, t):
    """Return ``s a + t b`` for numbers ``s``, ``t`` (`forms.scale_add`)."""
    total = abs(s) * magnitude(a) + abs(t) * magnitude(b)
    radius = (abs(s) * a.radius + abs(t) * b.radius + FORM_ROUNDING * total) * UP + UNDERFLOW64
    return LineForm(s * a.center + t * b.center, s * a.slope + t * b.slope, s * a.bend + t * b.bend, radius)


@njit(cache=True, error_model="numpy", inline="always")
def scaled(a, s):
    """Return ``s a`` for a number ``s`` (`forms.scale_add`)."""
    return LineForm(
        s * a.center, s * a.slope, s * a.bend, (abs(s) * (a.radius + FORM_ROUNDING * magnitude(a))) * UP + UNDERFLOW64
    )


@njit(cache=True, error_model="numpy", inline="always")
def multiplied(a, b):
    """Return ``a b`` (design.md, A2; `forms.multiply`)."""
    l, m = abs(a.slope), abs(a.bend)
    h, w = abs(b.slope), abs(b.bend)
    pa = abs(a.center) + l + m
    pb = abs(b.center) + h + w
    radius = pa * b.radius + pb * a.radius + a.radius * b.radius + FORM_ROUNDING * (pa * pb) + l * w + m * (h + w)
    return LineForm(
        a.center * b.center,
        a.center * b.slope + b.center * a.slope,
        a.center * b.bend + b.center * a.bend + a.slope * b.slope,
        radius * UP + UNDERFLOW64,
    )


@njit(cache=True, error_model="numpy", inline="always")
def composed(a, f0, f1, f2, f3):
    """Return ``f(a)`` from value, slope, half curvature and a bound of ``|f'''|/6`` over the range (A3)."""
    l, b, r = abs(a.slope), abs(a.bend), a.radius
    e = (l + b + r) * UP
    c2 = abs(f2)
    rounding = FORM_ROUNDING * (abs(f0) + abs(f1) * (l + b) + c2 * l * l)
    radius = abs(f1) * r + c2 * (2.0 * l * b + b * b + r * (2.0 * (l + b) + r)) + f3 * e * e * e + rounding
    return LineForm(f0, f1 * a.slope, f1 * a.bend + f2 * (a.slope * a.slope), radius * UP + UNDERFLOW64)


@njit(cache=True, error_model="numpy", inline="always")
def _least(a):
    """Lower bound of a form, and whether it lies in the range where the functions below are defined."""
    low = (a.center - (abs(a.slope) + abs(a.bend) + a.radius) * UP) * (1.0 - FORM_ROUNDING)
    return low, (low > SMALLEST) & (low < LARGEST)


@njit(cache=True, error_model="numpy", inline="always")
def inverse(a):
    """Return ``1 / a`` for ``a > 0`` (`forms.reciprocal`)."""
    low, inside = _least(a)
    f0 = 1.0 / (a.center if inside else 1.0)
    low2 = low * low
    f3 = 1.0 / (low2 * low2) * UP if inside else np.inf
    return composed(a, f0, -f0 * f0, f0 * f0 * f0, f3)


@njit(cache=True, error_model="numpy", inline="always")
def inverse_root(a):
    """Return ``1 / sqrt(a)`` for ``a > 0`` (`forms.reciprocal_square_root`)."""
    low, inside = _least(a)
    f0 = 1.0 / np.sqrt(a.center if inside else 1.0)
    f2 = f0 * f0
    f3 = 0.3125 / (low * low * low * np.sqrt(low if inside else 1.0)) * UP if inside else np.inf
    return composed(a, f0, -0.5 * f0 * f2, 0.375 * f0 * f2 * f2, f3)


@njit(cache=True, error_model="numpy", inline="always")
def ends(a):
    """Return bounds of ``a`` over the box, rounded outward (A4; `forms.bounds`)."""
    g, s = abs(a.slope), a.bend
    spread = (a.radius + RANGE_ROUNDING * (abs(a.center) + g + abs(s))) * UP
    # g p + s p^2 over [-1, 1]: the ends, and the vertex where it lies inside
    vertex = -(g / (4.0 * (s if s != 0.0 else 1.0))) * g
    inside = g < 2.0 * abs(s)
    top = vertex if inside & (s < 0.0) else s + g
    bottom = vertex if inside & (s > 0.0) else s - g
    return (bottom - spread) + a.center, (top + spread) + a.center


@njit(cache=True, error_model="numpy", inline="always")
def raised(a, floor, low, high):
    """Return ``max(a, floor)`` given bounds of ``a`` (A5; `forms.clamp_below`)."""
    above = high - floor
    below = floor - low
    crosses = (low < floor) & (high > floor)
    under = (low < floor) & (high <= floor)
    # floor + s t, s = chord slope of max(t, 0) over t = a - floor in [low - floor, high - floor]
    s = above / (above + below if crosses else 1.0)
    shift = 0.5 * (s * below)
    radius = (s * a.radius + shift + FORM_ROUNDING * (magnitude(a) + abs(floor) + shift)) * UP + UNDERFLOW64
    c = floor + s * (a.center - floor) + shift
    s = s if crosses else (0.0 if under else 1.0)
    return LineForm(
        c if crosses else (floor if under else a.center),
        s * a.slope,
        s * a.bend,
        radius if crosses else (0.0 if under else a.radius),
    )


@njit(cache=True, error_model="numpy", inline="always")
def load(s, first, stride, q):
    """Return the form of lane ``q`` from four rows of ``stride`` numbers, the first of which begins at ``first``."""
    return LineForm(s[first + q], s[first + stride + q], s[first + 2 * stride + q], s[first + 3 * stride + q])


@njit(cache=True, error_model="numpy", inline="always")
def store(a, s, first, stride, q):
    """Write a form to where `load` reads it."""
    s[first + q] = a.center
    s[first + stride + q] = a.slope
    s[first + 2 * stride + q] = a.bend
    s[first + 3 * stride + q] = a.radius
