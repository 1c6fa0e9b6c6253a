"""Polynomial forms: quantities over a parameter box, kept as a polynomial plus a radius.

A form over ``p in [-1, 1]^d`` encloses a function ``x`` as

    x(p) = c + sum_k g_k p_k + sum_{k<=l} q_kl p_k p_l + e(p),   |e(p)| <= r        (design.md, A1)

with ``q = 0`` for order 1 (an affine form). The kernels below work on arrays of forms, one row
per coefficient and one column ("lane") per quantity:

    row 0                 c
    rows 1 .. d           g
    rows d+1 .. m-1       q, in the order of `Basis.pairs` (order 2 only)
    row m                 r
    row m+1               sum |g|   (rounded up)
    row m+2               sum |q|   (rounded up)

Every kernel charges its own float64 rounding to ``r``, so a result encloses the real-number
result for every real number its operands enclose. A quantity that leaves a rule's domain gets a
non-finite radius, which every later rule keeps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ns_abstract.arithmetic.rounding import (
    CURVATURE_DOWN,
    FORM_ROUNDING,
    LARGEST,
    RANGE_ROUNDING,
    SMALLEST,
    UNDERFLOW64,
    UP,
)

Float64Array = NDArray[np.float64]

#: Largest number of parameters of a set.
MAX_DIMENSIONS = 8


@dataclass(frozen=True)
class Basis:
    """The monomials of a form: ``dimensions`` parameters, ``order`` 1 (affine) or 2 (quadratic)."""

    dimensions: int
    order: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.dimensions <= MAX_DIMENSIONS:
            raise ValueError(f"at most {MAX_DIMENSIONS} parameters, got {self.dimensions}")
        if self.order not in (1, 2):
            raise ValueError(f"order must be 1 or 2, got {self.order}")

    @cached_property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Parameter pairs (k, l), k <= l, of the quadratic monomials."""
        if self.order == 1:
            return ()
        d = self.dimensions
        return tuple((k, l) for k in range(d) for l in range(k, d))

    @cached_property
    def monomials(self) -> int:
        """Number m of polynomial coefficients."""
        return 1 + self.dimensions + len(self.pairs)

    @property
    def rows(self) -> int:
        """Rows of an array of forms."""
        return self.monomials + 3


@njit(cache=True, error_model="numpy")
def set_norms(out, d, order, m):
    """Recompute the rows ``sum |g|`` and ``sum |q|`` of ``out`` [rows, n] (design.md, A1)."""
    n = out.shape[1]
    for q in range(n):
        out[m + 1, q] = 0.0
        out[m + 2, q] = 0.0
    for k in range(1, d + 1):
        for q in range(n):
            out[m + 1, q] += abs(out[k, q])
    for k in range(d + 1, m):
        for q in range(n):
            out[m + 2, q] += abs(out[k, q])
    for q in range(n):
        out[m + 1, q] *= UP
        out[m + 2, q] *= UP


@njit(cache=True, error_model="numpy")
def scale_add(a, s, b, t, shift, out, d, order, m):
    """Write ``out = s * a + t * b + shift`` for numbers s, t, shift (design.md, A1); ``out`` may be ``a`` or ``b``."""
    n = out.shape[1]
    absolute_s = abs(s)
    absolute_t = abs(t)
    for q in range(n):
        magnitude = (
            absolute_s * (abs(a[0, q]) + a[m + 1, q] + a[m + 2, q])
            + absolute_t * (abs(b[0, q]) + b[m + 1, q] + b[m + 2, q])
            + abs(shift)
        )
        out[m, q] = (absolute_s * a[m, q] + absolute_t * b[m, q] + FORM_ROUNDING * magnitude) * UP + UNDERFLOW64
    for q in range(n):
        out[0, q] = s * a[0, q] + t * b[0, q] + shift
    for k in range(1, m):
        for q in range(n):
            out[k, q] = s * a[k, q] + t * b[k, q]
    set_norms(out, d, order, m)


@njit(cache=True, error_model="numpy")
def multiply(a, b, out, d, order, m):
    """Write ``out = a * b`` (design.md, A2). ``out`` must be another array than ``a`` and ``b``."""
    n = out.shape[1]
    for q in range(n):
        pa = abs(a[0, q]) + a[m + 1, q] + a[m + 2, q]
        pb = abs(b[0, q]) + b[m + 1, q] + b[m + 2, q]
        out[m, q] = pa * b[m, q] + pb * a[m, q] + a[m, q] * b[m, q] + FORM_ROUNDING * (pa * pb)
        out[0, q] = a[0, q] * b[0, q]
    for k in range(1, m):
        for q in range(n):
            out[k, q] = a[0, q] * b[k, q] + b[0, q] * a[k, q]
    if order == 2:
        row = d + 1
        for k in range(1, d + 1):
            for q in range(n):
                out[row, q] += a[k, q] * b[k, q]
            row += 1
            for l in range(k + 1, d + 1):
                for q in range(n):
                    out[row, q] += a[k, q] * b[l, q] + a[l, q] * b[k, q]
                row += 1
        for q in range(n):
            out[m, q] += a[m + 1, q] * b[m + 2, q] + a[m + 2, q] * (b[m + 1, q] + b[m + 2, q])
    else:
        # sum g_k h_k p_k^2 lies in [0, 1] * (.), so half of it moves to the centre
        for q in range(n):
            out[m, q] += a[m + 1, q] * b[m + 1, q]
        for k in range(1, d + 1):
            for q in range(n):
                half = 0.5 * (a[k, q] * b[k, q])
                out[0, q] += half
                out[m, q] -= abs(half)
    for q in range(n):
        out[m, q] = out[m, q] * UP + UNDERFLOW64
    set_norms(out, d, order, m)


@njit(cache=True, error_model="numpy")
def compose(a, f0, f1, f2_low, f2_high, f3, out, d, order, m):
    """Write ``out = f(a)`` from bounds of ``f`` over the range of ``a`` (design.md, A3).

    Args:
        a: Forms [rows, n].
        f0, f1: [n] values of ``f`` and ``f'`` at the centre ``a[0]``.
        f2_low, f2_high: [n] bounds of ``f''/2`` over the range of ``a`` for order 1; for order 2
            both are ``f''/2`` at the centre.
        f3: [n] for order 2 an upper bound of ``|f'''|/6`` over the range; for order 1 unused.
        out: Forms, another array than ``a``.

    ``f0``, ``f1`` and ``f2`` may carry relative errors of up to four units; they are charged here.
    """
    n = out.shape[1]
    if order == 2:
        for q in range(n):
            l = a[m + 1, q]
            b = a[m + 2, q]
            r = a[m, q]
            e = (l + b + r) * UP
            c2 = abs(f2_low[q])
            rounding = FORM_ROUNDING * (abs(f0[q]) + abs(f1[q]) * (l + b) + c2 * l * l)
            out[m, q] = (
                abs(f1[q]) * r + c2 * (2.0 * l * b + b * b + r * (2.0 * (l + b) + r)) + f3[q] * e * e * e + rounding
            ) * UP + UNDERFLOW64
            out[0, q] = f0[q]
        for k in range(1, m):
            for q in range(n):
                out[k, q] = f1[q] * a[k, q]
        row = d + 1
        for k in range(1, d + 1):
            for q in range(n):
                out[row, q] += f2_low[q] * (a[k, q] * a[k, q])
            row += 1
            for l_ in range(k + 1, d + 1):
                for q in range(n):
                    out[row, q] += 2.0 * f2_low[q] * (a[k, q] * a[l_, q])
                row += 1
    else:
        for q in range(n):
            l = a[m + 1, q]
            r = a[m, q]
            e = (l + r) * UP
            low = min(0.0, f2_low[q]) * (e * e)
            high = max(0.0, f2_high[q]) * (e * e)
            middle = 0.5 * (low + high)
            rounding = FORM_ROUNDING * (abs(f1[q]) * l + abs(f0[q]) + abs(middle))
            out[m, q] = (abs(f1[q]) * r + 0.5 * (high - low) + rounding) * UP + UNDERFLOW64
            out[0, q] = f0[q] + middle
        for k in range(1, m):
            for q in range(n):
                out[k, q] = f1[q] * a[k, q]
    set_norms(out, d, order, m)


@njit(cache=True, error_model="numpy")
def square(a, out, d, order, m):
    """Write ``out = a * a``; for order 1 tighter than `multiply`, since ``(g.p)^2`` is never negative."""
    if order == 2:
        multiply(a, a, out, d, order, m)
        return
    n = out.shape[1]
    for q in range(n):
        l = a[m + 1, q]
        r = a[m, q]
        c = a[0, q]
        half = 0.5 * (l * l)
        p = abs(c) + l
        out[m, q] = ((2.0 * p + r) * r + half + FORM_ROUNDING * (p * p)) * UP + UNDERFLOW64
        out[0, q] = c * c + half
    for k in range(1, m):
        for q in range(n):
            out[k, q] = 2.0 * (a[0, q] * a[k, q])
    set_norms(out, d, order, m)


@njit(cache=True, error_model="numpy")
def bounds(a, low, high, d, order, m):
    """Return ``low[q] <= x_q(p) <= high[q]`` over the box, rounded outward (design.md, A4)."""
    n = a.shape[1]
    if order == 1:
        for q in range(n):
            spread = (a[m + 1, q] + a[m, q] + FORM_ROUNDING * abs(a[0, q])) * UP
            low[q] = a[0, q] - spread
            high[q] = a[0, q] + spread
        return
    for q in range(n):
        spread = a[m, q] + RANGE_ROUNDING * (abs(a[0, q]) + a[m + 1, q] + a[m + 2, q])
        low[q] = -spread * UP
        high[q] = spread * UP
    row = d + 1
    for k in range(1, d + 1):
        for q in range(n):
            g = a[k, q]
            s = a[row, q]
            # g p + s p^2 over [-1, 1]: the ends, and the vertex where it lies inside
            top = s + abs(g)
            bottom = s - abs(g)
            if abs(g) < 2.0 * abs(s):
                # in this order nothing underflows that matters
                vertex = -(g / (4.0 * s)) * g
                if s > 0.0:
                    bottom = vertex
                else:
                    top = vertex
            high[q] += top
            low[q] += bottom
        row += 1
        for _ in range(k + 1, d + 1):
            for q in range(n):
                high[q] += abs(a[row, q])
                low[q] -= abs(a[row, q])
            row += 1
    for q in range(n):
        low[q] += a[0, q]
        high[q] += a[0, q]


@njit(cache=True, error_model="numpy", inline="always")
def _ends(a, m, q):
    """Lower and upper bounds of form ``q``, and whether SMALLEST < lower < LARGEST, where functions are defined."""
    c = a[0, q]
    e = (a[m + 1, q] + a[m + 2, q] + a[m, q]) * UP
    low = (c - e) * (1.0 - FORM_ROUNDING)
    return low, (c + e) * UP, SMALLEST < low < LARGEST


@njit(cache=True, error_model="numpy")
def reciprocal(a, work, out, d, order, m):
    """Write ``out = 1 / a`` for ``a > 0`` (1e-75 to 1e75); ``work`` is [5, n] scratch."""
    for q in range(out.shape[1]):
        c, (low, high, inside) = a[0, q], _ends(a, m, q)
        f0 = 1.0 / c if inside else 1.0
        work[0, q] = f0
        work[1, q] = -f0 * f0
        if order == 2:
            work[2, q] = f0 * f0 * f0
            low2 = low * low
            work[4, q] = 1.0 / (low2 * low2) * UP if inside else np.inf
        else:
            work[2, q] = 1.0 / (high * high * high) * (1.0 - FORM_ROUNDING) if inside else 0.0
            work[3, q] = 1.0 / (low * low * low) * UP if inside else np.inf
    compose(a, work[0], work[1], work[2], work[3], work[4], out, d, order, m)


@njit(cache=True, error_model="numpy")
def square_root(a, work, out, d, order, m):
    """Write ``out = sqrt(a)`` for ``a > 0``; ``work`` is [5, n] scratch."""
    for q in range(out.shape[1]):
        c, (low, high, inside) = a[0, q], _ends(a, m, q)
        f0 = np.sqrt(c) if inside else 1.0
        work[0, q] = f0
        work[1, q] = 0.5 / f0
        if order == 2:
            work[2, q] = -0.125 / (f0 * f0 * f0)
            work[4, q] = 0.0625 / (low * low * np.sqrt(low)) * UP if inside else np.inf
        else:
            work[2, q] = -0.125 / (low * np.sqrt(low)) * UP if inside else -np.inf
            work[3, q] = -0.125 / (high * np.sqrt(high)) * CURVATURE_DOWN if inside else np.inf
    compose(a, work[0], work[1], work[2], work[3], work[4], out, d, order, m)


@njit(cache=True, error_model="numpy")
def reciprocal_square_root(a, work, out, d, order, m):
    """Write ``out = 1 / sqrt(a)`` for ``a > 0``; ``work`` is [5, n] scratch."""
    for q in range(out.shape[1]):
        c, (low, high, inside) = a[0, q], _ends(a, m, q)
        f0 = 1.0 / np.sqrt(c) if inside else 1.0
        f2 = f0 * f0
        work[0, q] = f0
        work[1, q] = -0.5 * f0 * f2
        if order == 2:
            work[2, q] = 0.375 * f0 * f2 * f2
            work[4, q] = 0.3125 / (low * low * low * np.sqrt(low)) * UP if inside else np.inf
        else:
            work[2, q] = 0.375 / (high * high * np.sqrt(high)) * CURVATURE_DOWN if inside else -np.inf
            work[3, q] = 0.375 / (low * low * np.sqrt(low)) * UP if inside else np.inf
    compose(a, work[0], work[1], work[2], work[3], work[4], out, d, order, m)


@njit(cache=True, error_model="numpy")
def logarithm(a, work, out, d, order, m):
    """Write ``out = log(a)`` for ``a > 0``, charged four units of ``|log(a)| + 1`` more; ``work`` is [5, n] scratch."""
    for q in range(out.shape[1]):
        c, (low, high, inside) = a[0, q], _ends(a, m, q)
        inverse = 1.0 / c if inside else 1.0
        work[0, q] = np.log(c) if inside else 0.0
        work[1, q] = inverse
        if order == 2:
            work[2, q] = -0.5 * inverse * inverse
            work[4, q] = 1.0 / (3.0 * low * low * low) * UP if inside else np.inf
        else:
            work[2, q] = -0.5 / (low * low) * UP if inside else -np.inf
            work[3, q] = -0.5 / (high * high) * CURVATURE_DOWN if inside else np.inf
    compose(a, work[0], work[1], work[2], work[3], work[4], out, d, order, m)
    for q in range(out.shape[1]):
        out[m, q] += FORM_ROUNDING


@njit(cache=True, error_model="numpy")
def clamp_below(a, floor, low, high, d, order, m):
    """Replace ``a`` by ``max(a, floor)`` given its bounds ``low``, ``high`` [n] (design.md, A5)."""
    n = a.shape[1]
    for q in range(n):
        if low[q] >= floor:
            continue
        if not high[q] > floor:
            if high[q] <= floor:
                for k in range(m + 3):
                    a[k, q] = 0.0
                a[0, q] = floor
            continue
        # floor + s t, s = chord slope of max(t, 0) over t = a - floor in [low - floor, high - floor]
        above = high[q] - floor
        below = floor - low[q]
        s = above / (above + below)
        shift = 0.5 * (s * below)
        magnitude = abs(a[0, q]) + a[m + 1, q] + a[m + 2, q] + abs(floor)
        a[m, q] = (s * a[m, q] + shift + FORM_ROUNDING * (magnitude + shift)) * UP + UNDERFLOW64
        a[0, q] = floor + s * (a[0, q] - floor) + shift
        for k in range(1, m):
            a[k, q] *= s
        a[m + 1, q] *= s * UP
        a[m + 2, q] *= s * UP


@njit(cache=True, error_model="numpy")
def negate(a, m):
    """Replace ``a`` by ``-a``, exactly."""
    for k in range(m):
        for q in range(a.shape[1]):
            a[k, q] = -a[k, q]
