"""Forms of eight quantities side by side: the rules of `forms` with sums kept in registers (design.md, A6).

A form lies in a flat array of doubles (`intrinsics.pointer`), row after row as `forms` has them, eight lanes each; the
row ``sum |q|`` has no meaning where there are no terms of order 2. A rule takes the places where its operands and its
result begin, and `size` tells how long a form is. Each function has the name of its kernel there; results may be
written over no operand unless it says so.

What is linear is there for both orders, for culling over cells of one parameter; products and functions are there for
order 1: their one-parameter kin is `line_forms`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ns_abstract.arithmetic.elementary import fma
from ns_abstract.arithmetic.rounding import (
    ADDED_PRODUCT_ROUNDING,
    CURVATURE_DOWN,
    FORM_ROUNDING,
    LARGEST,
    RANGE_ROUNDING,
    SMALLEST,
    UNDERFLOW64,
    UP,
)
from ns_abstract.arithmetic.simd.lanes import bits, load8, maximum, minimum, root, store, where


@njit(cache=True, error_model="numpy", inline="always")
def size(m):
    """Return the number of doubles of one form of ``m`` monomials."""
    return 8 * (m + 3)


@njit(cache=True, error_model="numpy", forceinline=True)
def _norms(w, a, m, order):
    """Write the rows ``sum |g|`` and ``sum |q|`` of the form at ``a`` (`forms.set_norms`)."""
    linear = load8(w, a + 8 * (m + 1))
    if order == 2:
        return linear, load8(w, a + 8 * (m + 2))
    return linear, 0.0 * linear


@njit(cache=True, error_model="numpy", forceinline=True)
def magnitude(w, a, m, order=1):
    """Return an upper bound of the polynomial's absolute value, up to rounding."""
    linear, curved = _norms(w, a, m, order)
    return abs(load8(w, a)) + linear + curved


@njit(cache=True, error_model="numpy", forceinline=True)
def set_norms(w, out, m, order=1, d=0):
    """Return `forms.set_norms`; the number of parameters ``d`` matters for order 2 alone."""
    last = d + 1 if order == 2 else m
    total = 0.0 * load8(w, out)
    for k in range(1, last):
        total = total + abs(load8(w, out + 8 * k))
    store(w, out + 8 * (m + 1), total * UP)
    if order == 2:
        total = 0.0 * total
        for k in range(d + 1, m):
            total = total + abs(load8(w, out + 8 * k))
        store(w, out + 8 * (m + 2), total * UP)


@njit(cache=True, error_model="numpy")
def scale_add(w, a, s, b, t, shift, out, m):
    """Return `forms.scale_add`; ``out`` may be ``a`` or ``b``."""
    total = abs(s) * magnitude(w, a, m) + abs(t) * magnitude(w, b, m) + abs(shift)
    radius = abs(s) * load8(w, a + 8 * m) + abs(t) * load8(w, b + 8 * m) + FORM_ROUNDING * total
    store(w, out, s * load8(w, a) + t * load8(w, b) + shift)
    for k in range(1, m):
        store(w, out + 8 * k, s * load8(w, a + 8 * k) + t * load8(w, b + 8 * k))
    store(w, out + 8 * m, radius * UP + UNDERFLOW64)
    set_norms(w, out, m)


@njit(cache=True, error_model="numpy", forceinline=True)
def _nothing(like):
    """Return lanes of 0, of the type of ``like``."""
    return where(abs(like) >= 0.0, 0.0, 0.0)


@njit(cache=True, error_model="numpy")
def clear(w, out, m):
    """Set the form at ``out`` to 0."""
    for k in range(m + 3):
        store(w, out + 8 * k, _nothing(load8(w, out)))


@njit(cache=True, error_model="numpy", forceinline=True)
def _before(w, at, fresh):
    """Return the start of a sum: lanes of 0 if it is ``fresh``, else the eight numbers at ``at``."""
    return _nothing(load8(w, at)) if fresh else load8(w, at)


@njit(cache=True, error_model="numpy", forceinline=True)
def _accumulate(w, a, b, sign, out, coefficient, fresh, m):
    """Write ``out = sign a b`` or, not ``fresh``, ``out += sign a b``, but for the rows that `set_norms` writes."""
    ca, cb = load8(w, a), load8(w, b)
    ra, rb = load8(w, a + 8 * m), load8(w, b + 8 * m)
    la, lb = load8(w, a + 8 * (m + 1)), load8(w, b + 8 * (m + 1))
    pa, pb = abs(ca) + la, abs(cb) + lb
    center = _before(w, out, fresh) + sign * (ca * cb)
    radius = _before(w, out + 8 * m, fresh) + (pa * rb + pb * ra + ra * rb + coefficient * (pa * pb))
    ca, cb = sign * ca, sign * cb
    # sum g_k h_k p_k^2 lies in [0, 1] * (.), so half of it moves to the centre
    radius = radius + la * lb
    for k in range(1, m):
        ga, gb, at = load8(w, a + 8 * k), load8(w, b + 8 * k), out + 8 * k
        store(w, at, _before(w, at, fresh) + fma(ca, gb, cb * ga))
        half = 0.5 * (ga * gb)
        center = center + sign * half
        radius = radius - abs(half)
    store(w, out, center)
    store(w, out + 8 * m, radius * UP + UNDERFLOW64)


@njit(cache=True, error_model="numpy")
def add_product(w, a, b, sign, out, m):
    """Write ``out += sign a b``, but for the rows of sums: `set_norms` must follow (design.md, A2)."""
    _accumulate(w, a, b, sign, out, ADDED_PRODUCT_ROUNDING, False, m)


@njit(cache=True, error_model="numpy")
def multiply(w, a, b, out, m):
    """Return `forms.multiply` (design.md, A2)."""
    _accumulate(w, a, b, 1.0, out, FORM_ROUNDING, True, m)
    set_norms(w, out, m)


@njit(cache=True, error_model="numpy", forceinline=True)
def _accumulate_square(w, a, out, coefficient, fresh, m):
    """Write ``out = a a`` or, not ``fresh``, ``out += a a``, but for the rows that `set_norms` writes."""
    c, r, l = load8(w, a), load8(w, a + 8 * m), load8(w, a + 8 * (m + 1))
    half = 0.5 * (l * l)
    p = abs(c) + l
    radius = _before(w, out + 8 * m, fresh) + ((2.0 * p + r) * r + half + coefficient * (p * p))
    store(w, out, _before(w, out, fresh) + (c * c + half))
    for k in range(1, m):
        store(w, out + 8 * k, fma(2.0 * c, load8(w, a + 8 * k), _before(w, out + 8 * k, fresh)))
    store(w, out + 8 * m, radius * UP + UNDERFLOW64)


@njit(cache=True, error_model="numpy")
def add_square(w, a, out, m):
    """Write ``out += a a``, but for the rows of sums: `set_norms` must follow (design.md, A2)."""
    _accumulate_square(w, a, out, ADDED_PRODUCT_ROUNDING, False, m)


@njit(cache=True, error_model="numpy")
def square(w, a, out, m):
    """Return `forms.square`."""
    _accumulate_square(w, a, out, FORM_ROUNDING, True, m)
    set_norms(w, out, m)


@njit(cache=True, error_model="numpy", forceinline=True)
def bounds(w, a, m, order=1, d=0):
    """Lower and upper bounds over the box, rounded outward (`forms.bounds`; design.md, A4)."""
    c, r = load8(w, a), load8(w, a + 8 * m)
    linear, curved = _norms(w, a, m, order)
    if order == 1:
        spread = (linear + r + FORM_ROUNDING * abs(c)) * UP
        return c - spread, c + spread
    high = (r + RANGE_ROUNDING * (abs(c) + linear + curved)) * UP
    low = -high
    row = d + 1
    for k in range(1, d + 1):
        g, s = abs(load8(w, a + 8 * k)), load8(w, a + 8 * row)
        # g p + s p^2 over [-1, 1]: the ends, and the vertex where it lies inside; in this order nothing underflows
        vertex = -(g / (4.0 * where(s != 0.0, s, 1.0))) * g
        inside = g < 2.0 * abs(s)
        low = low + where(inside, minimum(s - g, vertex), s - g)
        high = high + where(inside, maximum(s + g, vertex), s + g)
        row += 1
        for _ in range(k + 1, d + 1):
            mixed = abs(load8(w, a + 8 * row))
            low, high = low - mixed, high + mixed
            row += 1
    return low + c, high + c


@njit(cache=True, error_model="numpy", forceinline=True)
def _compose(w, a, f0, f1, f2_low, f2_high, out, m):
    """Return `forms.compose` (design.md, A3)."""
    r, l = load8(w, a + 8 * m), load8(w, a + 8 * (m + 1))
    e = (l + r) * UP
    low = minimum(f2_low, 0.0) * (e * e)
    high = maximum(f2_high, 0.0) * (e * e)
    middle = 0.5 * (low + high)
    rounding = FORM_ROUNDING * (abs(f1) * l + abs(f0) + abs(middle))
    radius = abs(f1) * r + 0.5 * (high - low) + rounding
    store(w, out, f0 + middle)
    for k in range(1, m):
        store(w, out + 8 * k, f1 * load8(w, a + 8 * k))
    store(w, out + 8 * m, radius * UP + UNDERFLOW64)
    set_norms(w, out, m)


@njit(cache=True, error_model="numpy", forceinline=True)
def _ends(w, a, m):
    """Lower and upper bounds of a form, and whether the lower one lies where functions are defined (`forms._ends`)."""
    c = load8(w, a)
    e = (load8(w, a + 8 * (m + 1)) + load8(w, a + 8 * m)) * UP
    low = (c - e) * (1.0 - FORM_ROUNDING)
    return low, (c + e) * UP, (low > SMALLEST) & (low < LARGEST)


@njit(cache=True, error_model="numpy")
def reciprocal(w, a, out, m):
    """Return `forms.reciprocal`."""
    low, high, inside = _ends(w, a, m)
    f0 = 1.0 / where(inside, load8(w, a), 1.0)
    least = where(inside, 1.0 / (high * high * high) * (1.0 - FORM_ROUNDING), 0.0)
    most = where(inside, 1.0 / (low * low * low) * UP, np.inf)
    _compose(w, a, f0, -f0 * f0, least, most, out, m)


@njit(cache=True, error_model="numpy")
def reciprocal_square_root(w, a, out, m):
    """Return `forms.reciprocal_square_root`."""
    low, high, inside = _ends(w, a, m)
    low, high = where(inside, low, 1.0), where(inside, high, 1.0)
    f0 = 1.0 / root(where(inside, load8(w, a), 1.0))
    least = where(inside, 0.375 / (high * high * root(high)) * CURVATURE_DOWN, -np.inf)
    most = where(inside, 0.375 / (low * low * root(low)) * UP, np.inf)
    _compose(w, a, f0, -0.5 * f0 * (f0 * f0), least, most, out, m)


@njit(cache=True, error_model="numpy")
def logarithm(w, a, out, m):
    """Return `forms.logarithm`; ``out`` has room for one more form, which is scratch."""
    low, high, inside = _ends(w, a, m)
    center = where(inside, load8(w, a), 1.0)
    scratch = out + size(m)
    store(w, scratch, center)
    for lane in range(8):
        w[scratch + lane] = math.log(w[scratch + lane])
    f0 = load8(w, scratch)
    f1 = 1.0 / center
    least = where(inside, -0.5 / (low * low) * UP, -np.inf)
    most = where(inside, -0.5 / (high * high) * CURVATURE_DOWN, np.inf)
    _compose(w, a, f0, f1, least, most, out, m)
    store(w, out + 8 * m, load8(w, out + 8 * m) + FORM_ROUNDING)


@njit(cache=True, error_model="numpy")
def clamp(w, a, limit_low, limit_high, low, high, m):
    """Replace ``a`` by ``min(limit_high, max(limit_low, a))`` given its bounds (`forms.clamp_below`; design.md, A5)."""
    if bits(low < limit_low) != 0:
        _raise(w, a, 1.0, limit_low, low, high, m)
        low, high = maximum(low, limit_low), maximum(high, limit_low)
    if bits(high > limit_high) != 0:
        _raise(w, a, -1.0, -limit_high, -high, -low, m)


@njit(cache=True, error_model="numpy")
def _raise(w, a, sign, floor, low, high, m):
    """Replace the form ``sign * a`` by ``max(sign * a, floor)``, given bounds ``low``, ``high`` of ``sign * a``."""
    crosses = (low < floor) & (high > floor)
    under = (low < floor) & (high <= floor)
    # floor + s t, s = chord slope of max(t, 0) over t = a - floor in [low - floor, high - floor]
    above, below = high - floor, floor - low
    s = above / where(crosses, above + below, 1.0)
    shift = 0.5 * (s * below)
    center = sign * load8(w, a)
    linear = load8(w, a + 8 * (m + 1))
    total = abs(center) + linear + abs(floor)
    radius = (s * load8(w, a + 8 * m) + shift + FORM_ROUNDING * (total + shift)) * UP + UNDERFLOW64
    raised = floor + s * (center - floor) + shift
    store(w, a, sign * where(crosses, raised, where(under, floor, center)))
    store(w, a + 8 * m, where(crosses, radius, where(under, 0.0, load8(w, a + 8 * m))))
    s = where(crosses, s, where(under, 0.0, 1.0))
    for k in range(1, m):
        store(w, a + 8 * k, s * load8(w, a + 8 * k))
    store(w, a + 8 * (m + 1), s * where(crosses, UP, 1.0) * linear)
