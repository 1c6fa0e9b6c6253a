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
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

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
    """``out = s * a + t * b + shift`` for numbers ``s``, ``t``, ``shift``; ``out`` may be ``a`` or ``b``.

    See design.md, A1.
    """
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
    """``out = a * b`` (design.md, A2). ``out`` must be another array than ``a`` and ``b``."""
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
    """``out = f(a)`` from bounds of ``f`` over the range of ``a`` (design.md, A3).

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
    """``out = a * a``; for order 1 tighter than `multiply`, since ``(g.p)^2`` is never negative."""
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
def add_product(a, b, sign, out, d, order, m):
    """``out += sign * a * b`` except for the rows ``sum |.|`` of ``out``; `set_norms` must follow.

    ``sign`` is 1 or -1. Charges its own share of the rounding of up to three such additions.
    """
    n = out.shape[1]
    for q in range(n):
        out[m + 1, q] = abs(a[0, q]) + a[m + 1, q] + a[m + 2, q]
    for q in range(n):
        out[m + 2, q] = abs(b[0, q]) + b[m + 1, q] + b[m + 2, q]
    for q in range(n):
        pa = out[m + 1, q]
        pb = out[m + 2, q]
        out[m, q] += pa * b[m, q] + pb * a[m, q] + a[m, q] * b[m, q] + ADDED_PRODUCT_ROUNDING * (pa * pb)
    for q in range(n):
        out[0, q] += sign * (a[0, q] * b[0, q])
    for k in range(1, m):
        for q in range(n):
            out[k, q] += sign * (a[0, q] * b[k, q] + b[0, q] * a[k, q])
    if order == 2:
        row = d + 1
        for k in range(1, d + 1):
            for q in range(n):
                out[row, q] += sign * (a[k, q] * b[k, q])
            row += 1
            for l in range(k + 1, d + 1):
                for q in range(n):
                    out[row, q] += sign * (a[k, q] * b[l, q] + a[l, q] * b[k, q])
                row += 1
        for q in range(n):
            out[m, q] += a[m + 1, q] * b[m + 2, q] + a[m + 2, q] * (b[m + 1, q] + b[m + 2, q])
    else:
        for q in range(n):
            out[m, q] += a[m + 1, q] * b[m + 1, q]
        for k in range(1, d + 1):
            for q in range(n):
                out[m + 1, q] = 0.5 * (a[k, q] * b[k, q])
            for q in range(n):
                out[0, q] += sign * out[m + 1, q]
            for q in range(n):
                out[m, q] -= abs(out[m + 1, q])
    for q in range(n):
        out[m, q] = out[m, q] * UP + UNDERFLOW64


@njit(cache=True, error_model="numpy")
def add_square(a, out, d, order, m):
    """``out += a * a`` except for the rows ``sum |.|`` of ``out``; `set_norms` must follow."""
    if order == 2:
        add_product(a, a, 1.0, out, d, order, m)
        return
    n = out.shape[1]
    for q in range(n):
        l = a[m + 1, q]
        r = a[m, q]
        half = 0.5 * (l * l)
        p = abs(a[0, q]) + l
        out[m, q] = (out[m, q] + (2.0 * p + r) * r + half + ADDED_PRODUCT_ROUNDING * (p * p)) * UP + UNDERFLOW64
    for q in range(n):
        out[0, q] += a[0, q] * a[0, q] + 0.5 * (a[m + 1, q] * a[m + 1, q])
    for k in range(1, m):
        for q in range(n):
            out[k, q] += 2.0 * (a[0, q] * a[k, q])


@njit(cache=True, error_model="numpy")
def bounds(a, low, high, d, order, m):
    """``low[q] <= x_q(p) <= high[q]`` over the box, rounded outward (design.md, A4)."""
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


@njit(cache=True, error_model="numpy")
def reciprocal(a, work, out, d, order, m):
    """``out = 1 / a`` for ``a > 0`` (1e-75 to 1e75); ``work`` is [5, n] scratch."""
    for q in range(out.shape[1]):
        c = a[0, q]
        e = (a[m + 1, q] + a[m + 2, q] + a[m, q]) * UP
        low = (c - e) * (1.0 - FORM_ROUNDING)
        inside = SMALLEST < low < LARGEST
        f0 = 1.0 / c if inside else 1.0
        work[0, q] = f0
        work[1, q] = -f0 * f0
        if order == 2:
            work[2, q] = f0 * f0 * f0
            low2 = low * low
            work[4, q] = 1.0 / (low2 * low2) * UP if inside else np.inf
        else:
            high = (c + e) * UP
            work[2, q] = 1.0 / (high * high * high) * (1.0 - FORM_ROUNDING) if inside else 0.0
            work[3, q] = 1.0 / (low * low * low) * UP if inside else np.inf
    compose(a, work[0], work[1], work[2], work[3], work[4], out, d, order, m)


@njit(cache=True, error_model="numpy")
def square_root(a, work, out, d, order, m):
    """``out = sqrt(a)`` for ``a > 0``; ``work`` is [5, n] scratch."""
    for q in range(out.shape[1]):
        c = a[0, q]
        e = (a[m + 1, q] + a[m + 2, q] + a[m, q]) * UP
        low = (c - e) * (1.0 - FORM_ROUNDING)
        inside = SMALLEST < low < LARGEST
        f0 = np.sqrt(c) if inside else 1.0
        work[0, q] = f0
        work[1, q] = 0.5 / f0
        if order == 2:
            work[2, q] = -0.125 / (f0 * f0 * f0)
            work[4, q] = 0.0625 / (low * low * np.sqrt(low)) * UP if inside else np.inf
        else:
            high = (c + e) * UP
            work[2, q] = -0.125 / (low * np.sqrt(low)) * UP if inside else -np.inf
            work[3, q] = -0.125 / (high * np.sqrt(high)) * CURVATURE_DOWN if inside else np.inf
    compose(a, work[0], work[1], work[2], work[3], work[4], out, d, order, m)


@njit(cache=True, error_model="numpy")
def reciprocal_square_root(a, work, out, d, order, m):
    """``out = 1 / sqrt(a)`` for ``a > 0``; ``work`` is [5, n] scratch."""
    for q in range(out.shape[1]):
        c = a[0, q]
        e = (a[m + 1, q] + a[m + 2, q] + a[m, q]) * UP
        low = (c - e) * (1.0 - FORM_ROUNDING)
        inside = SMALLEST < low < LARGEST
        f0 = 1.0 / np.sqrt(c) if inside else 1.0
        f2 = f0 * f0
        work[0, q] = f0
        work[1, q] = -0.5 * f0 * f2
        if order == 2:
            work[2, q] = 0.375 * f0 * f2 * f2
            work[4, q] = 0.3125 / (low * low * low * np.sqrt(low)) * UP if inside else np.inf
        else:
            high = (c + e) * UP
            work[2, q] = 0.375 / (high * high * np.sqrt(high)) * CURVATURE_DOWN if inside else -np.inf
            work[3, q] = 0.375 / (low * low * np.sqrt(low)) * UP if inside else np.inf
    compose(a, work[0], work[1], work[2], work[3], work[4], out, d, order, m)


@njit(cache=True, error_model="numpy")
def logarithm(a, work, out, d, order, m):
    """``out = log(a)`` for ``a > 0``; ``work`` is [5, n] scratch.

    The library's logarithm is charged four units of ``|log(a)| + 1`` (checked at start-up,
    `ns_abstract.arithmetic.selfcheck`).
    """
    for q in range(out.shape[1]):
        c = a[0, q]
        e = (a[m + 1, q] + a[m + 2, q] + a[m, q]) * UP
        low = (c - e) * (1.0 - FORM_ROUNDING)
        inside = SMALLEST < low < LARGEST
        inverse = 1.0 / c if inside else 1.0
        work[0, q] = np.log(c) if inside else 0.0
        work[1, q] = inverse
        if order == 2:
            work[2, q] = -0.5 * inverse * inverse
            work[4, q] = 1.0 / (3.0 * low * low * low) * UP if inside else np.inf
        else:
            high = (c + e) * UP
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


class FormArray:
    """An array of forms over one box, with numpy-like operators.

    ``data`` is [basis.rows, n] with n the product of ``shape``. Operators return new arrays;
    numbers and numpy arrays (exact constants) mix with forms by broadcasting.
    """

    #: numpy arrays on the left of an operator leave it to this class
    __array_ufunc__ = None

    def __init__(self, basis: Basis, data: Float64Array, shape: tuple[int, ...]) -> None:
        self.basis = basis
        self.data = data
        self.shape = shape

    @classmethod
    def constant(cls, basis: Basis, values: Float64Array | float, radius: Float64Array | float = 0.0) -> FormArray:
        """Forms that are the numbers ``values`` up to ``radius``."""
        values = np.asarray(values, dtype=np.float64)
        data = np.zeros((basis.rows, values.size))
        data[0] = values.ravel()
        if np.ndim(radius) or radius != 0.0:
            data[basis.monomials].reshape(values.shape)[...] = radius
        return cls(basis, data, values.shape)

    @classmethod
    def parameter(cls, basis: Basis, index: int, middle: float = 0.0, half_width: float = 1.0) -> FormArray:
        """The scalar form ``middle + half_width * p_index``."""
        form = cls.constant(basis, middle)
        form.data[1 + index] = half_width
        set_norms(form.data, *form._layout)
        return form

    @property
    def _layout(self) -> tuple[int, int, int]:
        return self.basis.dimensions, self.basis.order, self.basis.monomials

    @property
    def center(self) -> Float64Array:
        """Values at the middle of the box (the polynomial's constant term)."""
        return self.data[0].reshape(self.shape)

    @property
    def radius(self) -> Float64Array:
        """Radius of the part that is not polynomial."""
        return self.data[self.basis.monomials].reshape(self.shape)

    @property
    def linear(self) -> Float64Array:
        """Linear coefficients, [d, *shape]."""
        return self.data[1 : 1 + self.basis.dimensions].reshape(-1, *self.shape)

    def bounds(self) -> tuple[Float64Array, Float64Array]:
        """Lower and upper bounds over the box, rounded outward."""
        low = np.empty(self.data.shape[1])
        high = np.empty(self.data.shape[1])
        bounds(self.data, low, high, *self._layout)
        return low.reshape(self.shape), high.reshape(self.shape)

    def _lift(self, other: FormArray | Float64Array | float) -> FormArray:
        return other if isinstance(other, FormArray) else FormArray.constant(self.basis, other)

    def broadcast_to(self, shape: tuple[int, ...]) -> FormArray:
        """The forms repeated to ``shape``."""
        if shape == self.shape:
            return self
        rows = self.basis.rows
        padded = (rows, *(1,) * (len(shape) - len(self.shape)), *self.shape)
        data = np.empty((rows, *shape))
        data[...] = self.data.reshape(padded)
        return FormArray(self.basis, data.reshape(rows, -1), shape)

    def _pair(self, other: FormArray | Float64Array | float) -> tuple[FormArray, FormArray]:
        other = self._lift(other)
        if other.shape == self.shape:
            return self, other
        shape = np.broadcast_shapes(self.shape, other.shape)
        return self.broadcast_to(shape), other.broadcast_to(shape)

    def _combine(self, s: float, other: FormArray | Float64Array | float, t: float) -> FormArray:
        a, b = self._pair(other)
        out = np.empty_like(a.data)
        scale_add(a.data, s, b.data, t, 0.0, out, *self._layout)
        return FormArray(self.basis, out, a.shape)

    def __add__(self, other: FormArray | Float64Array | float) -> FormArray:
        return self._combine(1.0, other, 1.0)

    def __sub__(self, other: FormArray | Float64Array | float) -> FormArray:
        return self._combine(1.0, other, -1.0)

    def __neg__(self) -> FormArray:
        out = self.data.copy()
        negate(out, self.basis.monomials)
        return FormArray(self.basis, out, self.shape)

    __radd__ = __add__

    def __rsub__(self, other: Float64Array | float) -> FormArray:
        return (-self) + other

    def __mul__(self, other: FormArray | Float64Array | float) -> FormArray:
        a, b = self._pair(other)
        out = np.empty_like(a.data)
        multiply(a.data, b.data, out, *self._layout)
        return FormArray(self.basis, out, a.shape)

    __rmul__ = __mul__

    def __getitem__(self, index: Any) -> FormArray:
        rows = self.basis.rows
        data = self.data.reshape(rows, *self.shape)[(slice(None), *(index if isinstance(index, tuple) else (index,)))]
        return FormArray(self.basis, np.ascontiguousarray(data.reshape(rows, -1)), data.shape[1:])

    def sum(self, axis: int) -> FormArray:
        """Sum over one axis, one addition at a time."""
        parts = [self[(slice(None),) * axis + (i,)] for i in range(self.shape[axis])]
        total = parts[0]
        for part in parts[1:]:
            total = total + part
        return total

    def flipped(self, signs: Float64Array) -> FormArray:
        """The forms times ``signs`` (1 or -1, broadcast against ``shape``), without rounding."""
        data = self.data.copy()
        data[: self.basis.monomials].reshape(-1, *self.shape)[...] *= signs
        return FormArray(self.basis, data, self.shape)

    def transpose(self) -> FormArray:
        """Matrix transpose of a two-dimensional array."""
        rows = self.basis.rows
        data = self.data.reshape(rows, *self.shape).swapaxes(1, 2)
        return FormArray(self.basis, np.ascontiguousarray(data).reshape(rows, -1), self.shape[::-1])

    def __matmul__(self, other: FormArray | Float64Array) -> FormArray:
        other = self._lift(other)
        n, k = self.shape
        if len(other.shape) == 1:
            return (self * FormArray(self.basis, other.data, (1, k)).broadcast_to((n, k))).sum(1)
        left = FormArray(self.basis, self.data, (n, k, 1))
        right = FormArray(self.basis, other.data, (1, k, other.shape[1]))
        return (left * right).sum(1)

    def __rmatmul__(self, other: Float64Array) -> FormArray:
        return self._lift(other) @ self

    def _unary(self, kernel) -> FormArray:
        out = np.empty_like(self.data)
        kernel(self.data, np.empty((5, out.shape[1])), out, *self._layout)
        return FormArray(self.basis, out, self.shape)

    def square(self) -> FormArray:
        """Element-wise square."""
        out = np.empty_like(self.data)
        square(self.data, out, *self._layout)
        return FormArray(self.basis, out, self.shape)

    def reciprocal(self) -> FormArray:
        """Element-wise ``1 / x``; the radius is not finite where ``x`` may be 0 or below."""
        return self._unary(reciprocal)

    def sqrt(self) -> FormArray:
        """Element-wise square root; the radius is not finite where ``x`` may be 0 or below."""
        return self._unary(square_root)

    def rsqrt(self) -> FormArray:
        """Element-wise ``1 / sqrt(x)``; the radius is not finite where ``x`` may be 0 or below."""
        return self._unary(reciprocal_square_root)

    def compose(self, f0, f1, f2_low, f2_high, f3) -> FormArray:
        """See the kernel `compose`; arguments broadcast against ``shape``."""
        values = np.empty((5, *self.shape))
        for row, value in enumerate((f0, f1, f2_low, f2_high, f3)):
            values[row] = value
        out = np.empty_like(self.data)
        # one array per value
        compose(self.data, *values.reshape(5, -1), out, *self._layout)  # pyright: ignore[reportCallIssue]
        return FormArray(self.basis, out, self.shape)
