"""Affine forms over a sub-box of a pose set and one position on a ray, for kernels of hash-grid fields (design.md, H1).

A form is an array [n + 3]: centre, coefficients of the n pose symbols, that of the place symbol, and a radius. Over one
parameter ``p`` the pose symbols are two, ``p`` and ``2 p^2 - 1`` ("line"), so that curvature is followed; over more
they are the parameters themselves.

Kernels here are called millions of times with records of many arrays, so they are compiled without numba's counting of
references (`UNCOUNTED`), which took half of the time and made threads wait for one another. Such a kernel allocates no
array; numba refuses to compile one that would. A kernel that does is `COUNTED`, as it would otherwise inherit its
caller's setting.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from ns_abstract.arithmetic.elementary import exp_kernel
from ns_abstract.arithmetic.rounding import (
    EXP_DOWN,
    EXP_UP,
    FORM_ROUNDING,
    HASH_BAND_ROUNDING,
    HASH_PRODUCT_ROUNDING,
    HASH_UP,
    UNDERFLOW64,
)

#: How kernels are compiled that make no array, and those that do.
UNCOUNTED: dict[str, Any] = {"_nrt": False}
COUNTED: dict[str, Any] = {"_nrt": True}
#: Past these arguments an exponential is 0 or more than any number.
_LEAST, _MOST = -700.0, 700.0
#: Ranges up to this half-width are followed by Taylor's formula, wider ones by a chord.
_TAYLOR_RANGE = 0.5


@dataclass(frozen=True)
class BandTuning:
    """When chords are replaced by an interval; soundness does not depend on it."""

    #: Least slope of a chord of the exponential.
    flat: float = 1e-280
    #: Least distance of a logistic function's value from 0 and 1 at which its place is looked for.
    margin: float = 1e-12


_FLAT, _MARGIN = BandTuning.flat, BandTuning.margin


def form_width(dimensions: int) -> int:
    """Return the number of pose symbols of sets with ``dimensions`` parameters."""
    return 2 if dimensions == 1 else dimensions


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def exp_below(x):
    """Return a lower bound of ``exp(x)``; ``x`` is not NaN."""
    if x < _LEAST:
        return 0.0
    return exp_kernel(min(x, _MOST)) * EXP_DOWN


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def exp_above(x):
    """Return an upper bound of ``exp(x)``, infinite where the function may overflow."""
    if not x < _MOST:
        return np.inf
    return exp_kernel(max(x, _LEAST)) * EXP_UP


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def pose_range(a, line, n):
    """Return the least and largest value of the pose part of the form ``a``, without its centre."""
    if line:
        g, q = a[1], a[2]
        low, high = q - abs(g), q + abs(g)
        if abs(g) < 4.0 * abs(q):
            vertex = -q - g * g / (8.0 * q)
            low, high = min(low, vertex), max(high, vertex)
        return low, high
    spread = 0.0
    for i in range(1, n + 1):
        spread += abs(a[i])
    return -spread, spread


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def form_range(a, line):
    """Return the least and largest value of the form ``a``, rounded outward."""
    n = a.shape[0] - 3
    low, high = pose_range(a, line, n)
    rest = abs(a[n + 1]) + a[n + 2]
    slack = FORM_ROUNDING * (abs(a[0]) + abs(low) + abs(high) + rest)
    return a[0] + low - rest - slack, a[0] + high + rest + slack


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def spread_of(a):
    """Return the sum of the absolute coefficients of a form and its radius."""
    total = 0.0
    for i in range(1, a.shape[0]):
        total += abs(a[i])
    return total * HASH_UP


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def multiply(a, b, line, out):
    """Write ``out = a b`` (design.md, H1); ``out`` is neither of them."""
    k = a.shape[0] - 1
    spread_a, spread_b, shift, mixed = 0.0, 0.0, 0.0, 0.0
    for i in range(1, k):
        out[i] = a[0] * b[i] + b[0] * a[i]
        spread_a += abs(a[i])
        spread_b += abs(b[i])
        h = 0.5 * a[i] * b[i]
        shift += h
        mixed += abs(h)
    rest = spread_a * spread_b - mixed
    if line:
        # p^2 is followed by the second symbol
        h = 0.5 * a[1] * b[1]
        out[2] += h
        rest -= abs(h)
    out[0] = a[0] * b[0] + shift
    size_a, size_b = abs(a[0]) + spread_a, abs(b[0]) + spread_b
    rest = max(rest, 0.0) + size_a * b[k] + size_b * a[k] + a[k] * b[k]
    out[k] = (rest + HASH_PRODUCT_ROUNDING * size_a * size_b) * HASH_UP + UNDERFLOW64


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def scale_add(a, factor, b, shift, out):
    """Write ``out = factor a + b + shift``; ``b`` may be ``out``."""
    k = a.shape[0] - 1
    size = abs(shift)
    for i in range(k):
        size += abs(factor * a[i]) + abs(b[i])
        out[i] = factor * a[i] + b[i]
    out[0] += shift
    out[k] = (abs(factor) * a[k] + b[k] + FORM_ROUNDING * size) * HASH_UP + UNDERFLOW64


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def compose(a, derivatives, line, out, scratch):
    """Write ``out = f(a)`` by Taylor's formula of order 2 about the centre (design.md, A3).

    ``derivatives`` are f, f', f'' / 2 at the centre, and a bound of ``|f'''| / 6`` over the range; ``line`` tells
    whether the pose symbols are those of one parameter; ``scratch`` is [2, n + 3].
    """
    k = a.shape[0] - 1
    f0, f1, f2, f3 = derivatives
    step, square = scratch[0], scratch[1]
    for i in range(k + 1):
        step[i] = a[i]
    step[0] = 0.0
    multiply(step, step, line, square)
    reach = spread_of(a)
    for i in range(k):
        out[i] = f1 * step[i] + f2 * square[i]
    out[0] += f0
    size = abs(f0) + abs(f1) * reach + abs(f2) * reach * reach
    rest = abs(f1) * step[k] + abs(f2) * square[k] + f3 * reach * reach * reach
    out[k] = (rest + HASH_PRODUCT_ROUNDING * size) * HASH_UP + UNDERFLOW64


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def reciprocal(a, line, out, scratch):
    """Compute ``out = 1 / a`` for a positive form, else a form of infinite radius."""
    low, _ = form_range(a, line)
    c = a[0]
    if not low > 0.0:
        out[:] = 0.0
        out[-1] = np.inf
        return
    inverse = 1.0 / c
    square = inverse * inverse
    compose(a, (inverse, -square, square * inverse, 1.0 / (low * low * low * low) * HASH_UP), line, out, scratch)


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def exp_band(center, low, high):
    """Return a polynomial and a rest that enclose ``exp`` on an interval (design.md, H5).

    ``low <= center <= high``. Returns v, slope, curvature, rest: ``|exp(center + t) - v - slope t - curvature t^2| <=
    rest`` where ``center + t`` is in the interval; the curvature is not negative. Where the function may overflow,
    only the rest is not 0: it is infinite.
    """
    if not (high < _MOST and low <= high):
        return 0.0, 0.0, 0.0, np.inf
    least, most = exp_below(low), exp_above(high)
    reach = max(high - center, center - low)
    if center < _LEAST or not reach < 2.0 * _MOST:
        return 0.5 * (least + most), 0.0, 0.0, 0.5 * (most - least) * HASH_UP + HASH_BAND_ROUNDING * most + UNDERFLOW64
    value = exp_kernel(center)
    if reach <= _TAYLOR_RANGE:
        rest = most * reach * reach * reach * (1.0 / 6.0) * HASH_UP
        return value, value, 0.5 * value, rest + HASH_BAND_ROUNDING * value
    # the chord's slope; exp(h) - slope h is convex: largest at the ends, least where exp(h) = slope
    slope = (most - least) / (high - low)
    if slope < _FLAT:
        return 0.5 * (least + most), 0.0, 0.0, 0.5 * (most - least) + HASH_BAND_ROUNDING * most + UNDERFLOW64
    top = max(most - slope * (high - center), least - slope * (low - center))
    tangent = math.log(slope) - center
    bottom = slope - slope * tangent
    rounding = HASH_BAND_ROUNDING * (most + slope * (reach + abs(tangent) + abs(center)))
    return 0.5 * (top + bottom), slope, 0.0, 0.5 * (top - bottom) + rounding + UNDERFLOW64


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def sigmoid(x):
    """Return the logistic function, up to a relative error of 2^-48."""
    if x >= 0.0:
        return 1.0 / (1.0 + exp_kernel(-min(x, _MOST)))
    e = exp_kernel(max(x, _LEAST))
    return e / (1.0 + e)


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def sigmoid_band(center, low, high):
    """Return `exp_band` for the logistic function: value, slope, half the second derivative, and rest."""
    if not (low <= center <= high and high - low < np.inf):
        return 0.5, 0.0, 0.0, 0.5
    value, reach = sigmoid(center), max(high - center, center - low)
    if reach <= _TAYLOR_RANGE:
        slope = value * (1.0 - value)
        # |s'''| <= s', whose largest value is at the point of the interval that is nearest to 0
        nearest = sigmoid(min(max(0.0, low), high))
        steepest = nearest * (1.0 - nearest)
        rest = steepest * reach * reach * reach * (1.0 / 6.0) * HASH_UP
        return value, slope, 0.5 * slope * (1.0 - 2.0 * value), rest * HASH_UP + HASH_BAND_ROUNDING
    least, most = sigmoid(low), sigmoid(high)
    slope = (most - least) / (high - low)
    # s(x) - slope x is largest and least at the ends or where s' = slope
    ends = least - slope * (low - center), most - slope * (high - center)
    top, bottom = max(ends[0], ends[1]), min(ends[0], ends[1])
    if slope < 0.25:
        root = math.sqrt(0.25 - slope)
        for s in (0.5 - root, 0.5 + root):
            if s > _MARGIN and s < 1.0 - _MARGIN:
                place = math.log(s / (1.0 - s))
                if low < place < high:
                    there = s - slope * (place - center)
                    top, bottom = max(top, there), min(bottom, there)
            else:
                # too flat to tell where
                return 0.5 * (least + most), 0.0, 0.0, 0.5 * (most - least) + HASH_BAND_ROUNDING
    return 0.5 * (top + bottom), slope, 0.0, 0.5 * (top - bottom) + HASH_BAND_ROUNDING * (1.0 + slope * reach)


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def apply_band(form, band, line, out):
    """Compute ``out = f(form)`` from `exp_band` or `sigmoid_band` for the form's centre and range (design.md, H5)."""
    n = form.shape[0] - 3
    value, slope, curvature, rest = band
    others = (abs(form[n + 1]) + form[n + 2]) * HASH_UP
    for s in range(1, n + 2):
        out[s] = slope * form[s]
    spread = others
    for s in range(1, n + 1):
        spread += abs(form[s])
    bent = 0.0
    if curvature != 0.0:
        if line:
            own = form[1] * form[1]
            remaining = others + abs(form[2])
            bent = 0.5 * curvature * own
            out[2] += bent
            rest += abs(curvature) * (2.0 * abs(form[1]) * remaining + remaining * remaining)
        else:
            bent = 0.5 * curvature * spread * spread
            rest += abs(bent)
    out[0] = value + bent
    rounding = FORM_ROUNDING * (abs(value) + slope * spread + abs(bent))
    out[n + 2] = (rest + slope * form[n + 2] + rounding) * HASH_UP + UNDERFLOW64
