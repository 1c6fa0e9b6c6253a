"""Per-pixel stage of the bounds: alphas as polynomial forms, blended back to front.

One pass handles a block of `PIXELS` pixels (lanes) of one tile (design.md, B1-B9). Each lane keeps
a list of the layers that may contribute to it, nearest first; a layer holds

    alpha's m coefficients and radius, its lower and upper bound, and its colour.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from ns_abstract.arithmetic.compiled import borrowed, lowest_bit, prefetch
from ns_abstract.arithmetic.elementary import EXP_RELATIVE_ERROR, exp_kernel
from ns_abstract.arithmetic.units import UNIT64
from ns_abstract.methods.splat.lists import AHEAD, BLOCK, PIXELS, block_lists
from ns_abstract.methods.splat.records import (
    FAINT,
    FORMS,
    KAPPA,
    MEAN_X,
    MEAN_Y,
    OPACITY_HIGH,
    OPACITY_LOW,
    WILD,
)

_ROUND = 16.0 * UNIT64
_UP = 1.0 + 128.0 * UNIT64
#: Room for rounding where pixels are left out.
_ROOM = 1.0 + 2.0**-30
#: Half-width of the exponent's range up to which exp(-t) is fitted by a polynomial.
_FIT_LIMIT = 2.0
#: Exponents are cut here; exp(-60) is far below any threshold.
_EXPONENT_LIMIT = 60.0
#: Reordering that moves no channel of a pixel by more is not examined beyond the swap bound.
_REORDERING_MATTERS = 1e-4
#: Lane loops run over multiples of this many lanes: short loops of one vector each, or many of several.
_VECTOR_LINE, _VECTOR = 4, 16
#: Lanes that are blended together, down to the deepest of their lists.
_GROUP = 16
#: Pixel q of a block lies in row q >> _ROW_SHIFT; sets of pixels are the bits of an int64.
_ROW_SHIFT = BLOCK.bit_length() - 1
assert PIXELS == 64

# Scratch is flat: row r holds its lanes at r * PIXELS .. r * PIXELS + PIXELS - 1. With constant
# offsets the compiler sees that rows do not overlap. Lane loops run to a length taken from an array:
# with a constant length they would be unrolled into scalar code, as it is they become vector code.
(
    _AX, _AY, _C1, _C2, _L1, _L2, _B1, _B2, _CC, _S0, _SR, _SL, _SB, _SLO, _SHI, _WEIGHT, _CURVE,
    _A0, _AR, _LO, _HI, _TLO, _THI, _REACH, _RHO, _TMP, _MIN, _MAX, _LINEAR, _QUADRATIC, _DARKEST, _BRIGHTEST,
) = range(0, 32 * PIXELS, PIXELS)  # fmt: skip
_ROWS = 32


@njit(cache=True, error_model="numpy", inline="always")
def _spread(rows, first, last, n, s, out):
    """``s[out + q] = sum over rows [first, last) of |rows|``; inlined so that ``out`` is a constant."""
    for q in range(n):
        s[out + q] = 0.0
    for k in range(first, last):
        for q in range(n):
            s[out + q] += abs(rows[k, q])


@njit(cache=True, error_model="numpy", forceinline=True)
def _alpha_forms(record, i, n, s, y1, y2, poly, sigma_max, d, order, m, antialiased, sure, rules, errors):
    """Alpha of one Gaussian on the lanes of a block (design.md, B1-B4).

    Takes the pixel offsets of ``n`` lanes from rows _AX, _AY of ``s``. Leaves the polynomial's
    coefficients in ``poly`` [m, lanes] (one parameter and order 2: in rows _A0, _LINEAR, _QUADRATIC) and the
    radius, lower and upper bound in rows _AR, _LO, _HI; ``sure`` tells whether the Gaussian surely belongs to the
    tile. Returns False where alpha is below the threshold on all lanes.
    """
    unit = errors[0]
    alpha_min = rules[7] * (1.0 - 2.0 * unit)
    alpha_max = rules[8]
    opacity_low = record[i, OPACITY_LOW]
    opacity_high = record[i, OPACITY_HIGH]
    if record[i, WILD] != 0.0:
        high = min(opacity_high, alpha_max) * (1.0 + 2.0 * unit)
        poly[:] = 0.0
        for q in range(n):
            poly[0, q] = 0.5 * high
            s[_A0 + q] = 0.5 * high
            s[_LINEAR + q] = 0.0
            s[_QUADRATIC + q] = 0.0
            s[_AR + q] = 0.5 * high * _UP
            s[_LO + q] = 0.0
            s[_HI + q] = high
        return high >= alpha_min
    line = d == 1 and order == 2
    if line:
        _exponent_line(record, i, n, s, antialiased)
    elif order == 1:
        _exponent_affine(record, i, n, s, poly, m, antialiased)
    else:
        _exponent(record, i, n, s, y1, y2, poly, d, m, antialiased)
    kappa = record[i, KAPPA]
    # nothing to do where the exponent keeps alpha below the threshold on every lane
    reachable = 0
    for q in range(n):
        reachable += 1 if s[_SLO + q] <= sigma_max else 0
    if reachable == 0:
        return False
    _fit_exponential(
        n, s, opacity_low, opacity_high, kappa, sigma_max, alpha_min, rules[7] * (1.0 + 2.0 * unit), alpha_max,
        1.0 if sure else 0.0, unit, order,
    )  # fmt: skip
    if line:
        for q in range(n):
            weight, linear = s[_WEIGHT + q], s[_LINEAR + q]
            s[_QUADRATIC + q] = weight * s[_QUADRATIC + q] + s[_CURVE + q] * (linear * linear)
            s[_LINEAR + q] = weight * linear
        return True
    if order == 2:
        # alpha_q = weight * sigma_q + curve * (linear part of sigma) squared, before sigma's rows are scaled
        row = 1 + d
        for k in range(1, d + 1):
            for l in range(k, d + 1):
                factor = 1.0 if l == k else 2.0
                for q in range(n):
                    poly[row, q] = s[_WEIGHT + q] * poly[row, q] + factor * s[_CURVE + q] * (poly[k, q] * poly[l, q])
                row += 1
    for k in range(1, 1 + d):
        for q in range(n):
            poly[k, q] *= s[_WEIGHT + q]
    for q in range(n):
        poly[0, q] = s[_A0 + q]
    return True


@njit(cache=True, error_model="numpy", inline="always")
def _square_sum_range(c1, c2, e1, e2, k_low, k_high):
    """Bounds of (y1^2 + y2^2)/2 + K for |y - c| <= e, c >= 0 (design.md, B2)."""
    near1 = max(0.0, c1 - e1)
    near2 = max(0.0, c2 - e2)
    far1 = c1 + e1
    far2 = c2 + e2
    low = 0.5 * (near1 * near1 + near2 * near2) * (1.0 - _ROUND) + k_low
    return low, (0.5 * (far1 * far1 + far2 * far2) + k_high) * _UP


@njit(cache=True, error_model="numpy", inline="always")
def _curved_radius(c1, c2, l1, l2, b1, b2, r1, r2, s0, k_radius, k_high):
    """Radius of (y1^2 + y2^2)/2 + K of order 2 from the sizes c, l, b, r of the parts of y1 and y2 (design.md, B2)."""
    return (
        c1 * r1
        + c2 * r2
        + l1 * b1
        + l2 * b2
        + 0.5 * (b1 * b1 + b2 * b2)
        + r1 * (l1 + b1 + 0.5 * r1)
        + r2 * (l2 + b2 + 0.5 * r2)
        + k_radius
        + _ROUND * (s0 + c1 * (l1 + b1 + r1) + c2 * (l2 + b2 + r2) + k_high)
    ) * _UP


@njit(cache=True, error_model="numpy")
def _exponent(record, i, n, s, y1, y2, poly, d, m, antialiased):
    """Form sigma = (y1^2 + y2^2)/2 + K of order 2 (design.md, B1-B2).

    Coefficients go into ``poly`` (row 0 unused), centre, radius and bounds into rows _S0, _SR, _SLO, _SHI,
    sums of absolute coefficients into _SL, _SB.
    """
    stride = m + 1
    base = FORMS
    for k in range(m):
        p = record[i, base + k]
        c = record[i, base + stride + k]
        g = record[i, base + 2 * stride + k]
        w1 = record[i, base + 3 * stride + k]
        w2 = record[i, base + 4 * stride + k]
        for q in range(n):
            y1[k, q] = p * s[_AX + q] - c * s[_AY + q] - w1
        for q in range(n):
            y2[k, q] = g * s[_AY + q] - w2
    _spread(y1, 1, 1 + d, n, s, _L1)
    _spread(y2, 1, 1 + d, n, s, _L2)
    _spread(y1, 1 + d, m, n, s, _B1)
    _spread(y2, 1 + d, m, n, s, _B2)
    rp = record[i, base + m] + _ROUND * abs(record[i, base])
    rc = record[i, base + stride + m] + _ROUND * abs(record[i, base + stride])
    rs = record[i, base + 2 * stride + m] + _ROUND * abs(record[i, base + 2 * stride])
    rw1 = record[i, base + 3 * stride + m] + _ROUND * abs(record[i, base + 3 * stride])
    rw2 = record[i, base + 4 * stride + m] + _ROUND * abs(record[i, base + 4 * stride])
    for k in range(1, m):
        for q in range(n):
            poly[k, q] = y1[0, q] * y1[k, q] + y2[0, q] * y2[k, q]
    row = 1 + d
    for k in range(1, d + 1):
        for q in range(n):
            poly[row, q] += 0.5 * (y1[k, q] * y1[k, q] + y2[k, q] * y2[k, q])
        row += 1
        for l in range(k + 1, d + 1):
            for q in range(n):
                poly[row, q] += y1[k, q] * y1[l, q] + y2[k, q] * y2[l, q]
            row += 1
    k_middle = 0.0
    k_radius = 0.0
    k_spread = 0.0
    if antialiased:
        k_middle = record[i, base + 5 * stride]
        k_radius = record[i, base + 5 * stride + m]
        for k in range(1, m):
            extra = record[i, base + 5 * stride + k]
            k_spread += abs(extra)
            for q in range(n):
                poly[k, q] += extra
    k_low = max(0.0, k_middle - k_spread - k_radius)
    k_high = abs(k_middle) + k_spread + k_radius
    for q in range(n):
        s[_C1 + q] = abs(y1[0, q])
    for q in range(n):
        s[_C2 + q] = abs(y2[0, q])
    for q in range(n):
        ax = abs(s[_AX + q])
        ay = abs(s[_AY + q])
        c1 = s[_C1 + q]
        c2 = s[_C2 + q]
        l1 = s[_L1 + q]
        l2 = s[_L2 + q]
        b1 = s[_B1 + q]
        b2 = s[_B2 + q]
        r1 = rp * ax + rc * ay + rw1 + _ROUND * (l1 + b1)
        r2 = rs * ay + rw2 + _ROUND * (l2 + b2)
        s0 = 0.5 * (c1 * c1 + c2 * c2)
        e1 = l1 + b1 + r1
        e2 = l2 + b2 + r2
        s[_S0 + q] = s0 + k_middle
        s[_SR + q] = _curved_radius(c1, c2, l1, l2, b1, b2, r1, r2, s0, k_radius, k_high)
        s[_SLO + q], s[_SHI + q] = _square_sum_range(c1, c2, e1, e2, k_low, k_high)
    _spread(poly, 1, 1 + d, n, s, _SL)
    _spread(poly, 1 + d, m, n, s, _SB)
    # range of the polynomial, exact in each p_k alone
    for q in range(n):
        rounding = _ROUND * (s[_SL + q] + s[_SB + q] + s[_S0 + q])
        s[_MIN + q] = s[_S0 + q] - s[_SR + q] - rounding
        s[_MAX + q] = s[_S0 + q] + s[_SR + q] + rounding
    _add_range(poly, d, n, s)
    for q in range(n):
        s[_SHI + q] = min(s[_SHI + q], s[_MAX + q])
        s[_SLO + q] = max(s[_SLO + q], s[_MIN + q])


@njit(cache=True, error_model="numpy", forceinline=True)
def _exponent_affine(record, i, n, s, poly, m, antialiased):
    """`_exponent` for order 1: one loop by parameter."""
    stride = m + 1
    p, c, g = record[i, FORMS], record[i, FORMS + stride], record[i, FORMS + 2 * stride]
    w1, w2 = record[i, FORMS + 3 * stride], record[i, FORMS + 4 * stride]
    rp = record[i, FORMS + m] + _ROUND * abs(p)
    rc = record[i, FORMS + stride + m] + _ROUND * abs(c)
    rs = record[i, FORMS + 2 * stride + m] + _ROUND * abs(g)
    rw1 = record[i, FORMS + 3 * stride + m] + _ROUND * abs(w1)
    rw2 = record[i, FORMS + 4 * stride + m] + _ROUND * abs(w2)
    for q in range(n):
        s[_C1 + q] = p * s[_AX + q] - c * s[_AY + q] - w1
        s[_C2 + q] = g * s[_AY + q] - w2
        s[_L1 + q] = 0.0
        s[_L2 + q] = 0.0
        s[_SL + q] = 0.0
        s[_SB + q] = 0.0
    k_middle, k_radius, k_spread = 0.0, 0.0, 0.0
    if antialiased:
        k_middle = record[i, FORMS + 5 * stride]
        k_radius = record[i, FORMS + 5 * stride + m]
    for k in range(1, m):
        p, c, g = record[i, FORMS + k], record[i, FORMS + stride + k], record[i, FORMS + 2 * stride + k]
        w1, w2 = record[i, FORMS + 3 * stride + k], record[i, FORMS + 4 * stride + k]
        extra = 0.0
        if antialiased:
            extra = record[i, FORMS + 5 * stride + k]
            k_spread += abs(extra)
        row = poly[k]
        for q in range(n):
            g1 = p * s[_AX + q] - c * s[_AY + q] - w1
            g2 = g * s[_AY + q] - w2
            slope = s[_C1 + q] * g1 + s[_C2 + q] * g2 + extra
            row[q] = slope
            s[_L1 + q] += abs(g1)
            s[_L2 + q] += abs(g2)
            s[_SL + q] += abs(slope)
    k_low = max(0.0, k_middle - k_spread - k_radius)
    k_high = abs(k_middle) + k_spread + k_radius
    for q in range(n):
        ax = abs(s[_AX + q])
        ay = abs(s[_AY + q])
        c1 = abs(s[_C1 + q])
        c2 = abs(s[_C2 + q])
        l1 = s[_L1 + q]
        l2 = s[_L2 + q]
        r1 = rp * ax + rc * ay + rw1 + _ROUND * l1
        r2 = rs * ay + rw2 + _ROUND * l2
        s0 = 0.5 * (c1 * c1 + c2 * c2)
        # (g.p)^2 / 2 lies in [0, l^2 / 2]: half centre, half radius
        curve = 0.25 * (l1 * l1 + l2 * l2)
        e1 = l1 + r1
        e2 = l2 + r2
        center = s0 + curve + k_middle
        radius = (
            c1 * r1
            + c2 * r2
            + r1 * (l1 + 0.5 * r1)
            + r2 * (l2 + 0.5 * r2)
            + curve
            + k_radius
            + _ROUND * (s0 + c1 * e1 + c2 * e2 + k_high)
        ) * _UP
        low, high = _square_sum_range(c1, c2, e1, e2, k_low, k_high)
        spread = (s[_SL + q] + radius + _ROUND * center) * _UP
        s[_S0 + q] = center
        s[_SR + q] = radius
        s[_SLO + q] = max(low, center - spread)
        s[_SHI + q] = min(high, center + spread)


@njit(cache=True, error_model="numpy", forceinline=True)
def _exponent_line(record, i, n, s, antialiased):
    """`_exponent` for one parameter and order 2 in a single loop; coefficients into rows _LINEAR, _QUADRATIC."""
    p0, p1, p2, pr = record[i, FORMS], record[i, FORMS + 1], record[i, FORMS + 2], record[i, FORMS + 3]
    c0, c1, c2, cr = record[i, FORMS + 4], record[i, FORMS + 5], record[i, FORMS + 6], record[i, FORMS + 7]
    g0, g1, g2, gr = record[i, FORMS + 8], record[i, FORMS + 9], record[i, FORMS + 10], record[i, FORMS + 11]
    v0, v1, v2, vr = record[i, FORMS + 12], record[i, FORMS + 13], record[i, FORMS + 14], record[i, FORMS + 15]
    w0, w1, w2, wr = record[i, FORMS + 16], record[i, FORMS + 17], record[i, FORMS + 18], record[i, FORMS + 19]
    pr += _ROUND * abs(p0)
    cr += _ROUND * abs(c0)
    gr += _ROUND * abs(g0)
    vr += _ROUND * abs(v0)
    wr += _ROUND * abs(w0)
    k0, k1, k2, kr = 0.0, 0.0, 0.0, 0.0
    if antialiased:
        k0, k1, k2, kr = record[i, FORMS + 20], record[i, FORMS + 21], record[i, FORMS + 22], record[i, FORMS + 23]
    k_low = max(0.0, k0 - abs(k1) - abs(k2) - kr)
    k_high = abs(k0) + abs(k1) + abs(k2) + kr
    for q in range(n):
        ax = s[_AX + q]
        ay = s[_AY + q]
        y1 = p0 * ax - c0 * ay - v0
        l1 = p1 * ax - c1 * ay - v1
        b1 = p2 * ax - c2 * ay - v2
        y2 = g0 * ay - w0
        l2 = g1 * ay - w1
        b2 = g2 * ay - w2
        linear = y1 * l1 + y2 * l2 + k1
        quadratic = y1 * b1 + y2 * b2 + 0.5 * (l1 * l1 + l2 * l2) + k2
        s0 = 0.5 * (y1 * y1 + y2 * y2)
        l1 = abs(l1)
        l2 = abs(l2)
        b1 = abs(b1)
        b2 = abs(b2)
        y1 = abs(y1)
        y2 = abs(y2)
        r1 = pr * abs(ax) + cr * abs(ay) + vr + _ROUND * (l1 + b1)
        r2 = gr * abs(ay) + wr + _ROUND * (l2 + b2)
        e1 = l1 + b1 + r1
        e2 = l2 + b2 + r2
        radius = _curved_radius(y1, y2, l1, l2, b1, b2, r1, r2, s0, kr, k_high)
        low, high = _square_sum_range(y1, y2, e1, e2, k_low, k_high)
        s0 += k0
        slope = abs(linear)
        bend = abs(quadratic)
        rounding = _ROUND * (slope + bend + abs(s0))
        # the vertex of linear p + quadratic p^2 counts where it lies inside [-1, 1]
        vertex = -0.25 * (slope * slope) / (quadratic if quadratic != 0.0 else 1.0)
        inside = slope < 2.0 * bend
        top = max(quadratic + slope, vertex) if inside else quadratic + slope
        bottom = min(quadratic - slope, vertex) if inside else quadratic - slope
        s[_S0 + q] = s0
        s[_SR + q] = radius
        s[_SL + q] = slope
        s[_SB + q] = bend
        s[_LINEAR + q] = linear
        s[_QUADRATIC + q] = quadratic
        s[_SLO + q] = max(low, s0 + bottom - radius - rounding)
        s[_SHI + q] = min(high, s0 + top + radius + rounding)


@njit(cache=True, error_model="numpy")
def _add_range(poly, d, n, s):
    """Add the range of the order-2 polynomial's non-constant part to rows _MIN and _MAX (design.md, A4)."""
    row = 1 + d
    for k in range(1, d + 1):
        for q in range(n):
            g = abs(poly[k, q])
            c = poly[row, q]
            # the vertex of g p + c p^2 counts where it lies inside [-1, 1]
            divisor = c if c != 0.0 else 1.0
            vertex = -0.25 * (g * g) / divisor
            inside = g < 2.0 * abs(c)
            top = c + g
            bottom = c - g
            s[_MAX + q] += max(top, vertex) if inside else top
            s[_MIN + q] += min(bottom, vertex) if inside else bottom
        row += 1
        for _ in range(k + 1, d + 1):
            for q in range(n):
                c = abs(poly[row, q])
                s[_MAX + q] += c
                s[_MIN + q] -= c
            row += 1


@njit(cache=True, error_model="numpy", forceinline=True)
def _fit_exponential(
    n, s, opacity_low, opacity_high, kappa, sigma_max, alpha_min, alpha_min_high, alpha_max, sure, unit, order
):
    """Form alpha = opacity exp(-sigma) with its thresholds.

    Leaves centre _A0, radius _AR, bounds _LO, _HI, and the
    factors _WEIGHT, _CURVE that turn sigma's coefficients into alpha's (design.md, B3-B4).
    """
    opacity = 0.5 * (opacity_low + opacity_high)
    opacity_spread = 0.5 * (opacity_high - opacity_low) * _UP + _ROUND * opacity
    quadratic = 1.0 if order == 2 else 0.0
    for q in range(n):
        low = min(max(0.0, s[_SLO + q] * (1.0 - kappa)), _EXPONENT_LIMIT)
        high = max(low, s[_SHI + q] * (1.0 + kappa))
        # float evaluation moves the exponent by kappa
        sr = s[_SR + q] + kappa * min(high, 4.0 * _EXPONENT_LIMIT)
        width = 0.5 * (high - low) * _UP
        half = min(width, _FIT_LIMIT)
        fits = 1.0 if width < _FIT_LIMIT else 0.0
        e_low = exp_kernel(-low)
        e_half = exp_kernel(-half)
        slack = (30.0 + 3.0 * low + 6.0 * half) * unit + 4.0 * EXP_RELATIVE_ERROR
        a_high = opacity_high * e_low * (1.0 + slack)
        a_low = fits * (opacity_low * e_low * (e_half * e_half) * (1.0 - slack))
        # exp(-t) = k0 - k1 t + k2 t^2 +- fit over |t| <= half (design.md, B3)
        h = 0.5 * half
        x = h * h
        x2 = x * x
        i0 = 1.0 + x * (1.0 + x * (0.25 + x * (1.0 / 36.0 + x * (1.0 / 576.0))))
        k1 = 1.0 + x * (0.5 + x * (1.0 / 12.0 + x * (1.0 / 144.0 + x * (1.0 / 2880.0))))
        j2 = 0.5 + x * (1.0 / 6.0 + x * (1.0 / 48.0 + x * (1.0 / 720.0 + x * (1.0 / 17280.0))))
        fit = (h * x) * (1.0 / 3.0) * (1.0 + 0.25 * x + x2 * (1.0 / 24.0)) * (1.0 + 0.25 * h + x * (1.0 / 15.0))
        fit += 1.2e-4 * x * x2 * x2 + (1.0 - quadratic) * (2.0 * x * j2)
        k0 = i0 - quadratic * (2.0 * x * j2)
        k2 = quadratic * j2
        t0 = s[_S0 + q] - (low + half)
        l = s[_SL + q]
        b = s[_SB + q]
        scale = opacity * (e_low * e_half)
        weight = 2.0 * k2 * t0 - k1
        spread = sr + l + b
        size = 4.0 + abs(t0) * (4.0 + abs(t0)) + spread * (1.0 + spread)
        radius = scale * (
            fit
            + abs(weight) * sr
            + k2 * (2.0 * l * b + b * b + sr * (2.0 * (l + b) + sr))
            + (_ROUND + 2.0 * EXP_RELATIVE_ERROR) * size
        )
        radius += (opacity_spread * e_low + opacity_high * e_low * slack) * 1.01
        center = scale * (k0 - k1 * t0 + k2 * t0 * t0)
        # alpha_max
        excess = max(0.0, a_high - alpha_max)
        a_high = min(a_high, alpha_max * (1.0 + 2.0 * unit))
        a_low = min(a_low, alpha_max * (1.0 - 2.0 * unit))
        # alpha_min: below it the layer is skipped
        skips = a_low < alpha_min_high
        jump = min(alpha_min_high, a_high) if skips else 0.0
        center -= 0.5 * (excess + jump)
        radius = (radius + 0.5 * (excess + jump)) * _UP
        a_low = 0.0 if skips else sure * a_low
        # gone where it cannot reach the threshold
        gone = a_high < alpha_min or low > sigma_max
        a_high = 0.0 if gone else a_high
        a_low = 0.0 if gone else a_low
        flat = 0.5 * (a_high - a_low)
        keep = fits * sure
        keep = keep if radius < flat else 0.0
        s[_A0 + q] = center if keep == 1.0 else 0.5 * (a_high + a_low)
        s[_AR + q] = radius if keep == 1.0 else flat * _UP
        s[_LO + q] = a_low
        s[_HI + q] = a_high
        s[_WEIGHT + q] = keep * (scale * weight)
        s[_CURVE + q] = keep * (scale * k2)


# what a block may answer in place of a number of pairs
_GIVE_UP = -1
_GROW = -2


@njit(cache=True, error_model="numpy", forceinline=True)
def _uncertain(i, j, delta, depth_error, slope, m):
    """Whether the depth order of Gaussians i and j is not the same over the whole cell (design.md, O1).

    ``slope`` [rows, 3] is the third row of the rotation: depths differ by ``slope . (delta_i - delta_j)``.
    """
    x = delta[i, 0] - delta[j, 0]
    y = delta[i, 1] - delta[j, 1]
    z = delta[i, 2] - delta[j, 2]
    center = slope[0, 0] * x + slope[0, 1] * y + slope[0, 2] * z
    spread = 0.0
    for k in range(1, m):
        spread += abs(slope[k, 0] * x + slope[k, 1] * y + slope[k, 2] * z)
    size = (
        abs(delta[i, 0]) + abs(delta[j, 0]) + abs(delta[i, 1]) + abs(delta[j, 1]) + abs(delta[i, 2]) + abs(delta[j, 2])
    )
    rounding = _ROUND * size * 2.0
    radius = slope[m, 0] * abs(x) + slope[m, 1] * abs(y) + slope[m, 2] * abs(z)
    return not (abs(center) > (spread + radius) * _UP + rounding + depth_error[i] + depth_error[j])


@njit(cache=True, error_model="numpy")
def _depth_reach(entries, depth, delta, depth_error, slope, ray, m, reach, deep):
    """How far in depth each entry may move against the block's central ray (design.md, O1).

    Entries i, j keep their order where ``room |depth_i - depth_j| > reach_i + reach_j``; ``deep`` receives the
    depths. Returns ``room`` (not positive where nothing can be said) and the largest reach of all but a few entries.
    ``ray`` [3] is the ray scaled to unit depth at the middle pose.
    """
    count = entries.size
    along = 0.0
    for k in range(1, m):
        along += abs(slope[k, 0] * ray[0] + slope[k, 1] * ray[1] + slope[k, 2] * ray[2])
    along += slope[m, 0] * abs(ray[0]) + slope[m, 1] * abs(ray[1]) + slope[m, 2] * abs(ray[2])
    total = 0.0
    for k in range(count):
        ahead = entries[min(k + AHEAD, count - 1)]
        prefetch(delta, ahead, 0)
        prefetch(depth, ahead, 0)
        prefetch(depth_error, ahead, 0)
        i = entries[k]
        deep[k] = depth[i]
        # offset from the central ray: what a rotation moves in depth relative to the ray
        x = delta[i, 0] - depth[i] * ray[0]
        y = delta[i, 1] - depth[i] * ray[1]
        z = delta[i, 2] - depth[i] * ray[2]
        e = slope[m, 0] * abs(x) + slope[m, 1] * abs(y) + slope[m, 2] * abs(z)
        for row in range(1, m):
            e += abs(slope[row, 0] * x + slope[row, 1] * y + slope[row, 2] * z)
        size = abs(delta[i, 0]) + abs(delta[i, 1]) + abs(delta[i, 2]) + abs(depth[i]) * (1.0 + along)
        reach[k] = e * _UP + 4.0 * _ROUND * size + depth_error[i]
        total += reach[k]
    room = (1.0 - along) * (1.0 - 2.0**-30)
    if not total < np.inf:
        room = -1.0
    # few entries reach far: they are compared with all, the others within a window
    typical = 4.0 * total / max(count, 1)
    largest = 0.0
    for k in range(count):
        if reach[k] <= typical:
            largest = max(largest, reach[k])
    return room, largest


@njit(cache=True, error_model="numpy", forceinline=True)
def _find_pairs(
    k, entries, deep, delta, depth_error, slope, m, reach, room, largest, farthest, far, far_count, first, last,
    pairs, count,
):  # fmt: skip
    """Append the pairs (k, later entry) of uncertain order to ``pairs`` and widen ``first``, ``last``.

    Returns their number, or -1 where ``pairs`` is full.
    """
    i = entries[k]
    window = reach[k] + largest
    beyond = entries.size
    for other in range(k + 1, entries.size):
        gap = (deep[other] - deep[k]) * room
        if gap > window:
            beyond = other
            break
        if gap <= reach[k] + reach[other] and _uncertain(
            i, entries[other], delta, depth_error, slope, m
        ):
            if count >= pairs.shape[0]:
                return -1
            pairs[count, 0] = k
            pairs[count, 1] = other
            last[k] = max(last[k], other)
            first[other] = min(first[other], k)
            count += 1
    for f in range(far_count):
        other = far[f]
        if other < beyond:
            continue
        gap = (deep[other] - deep[k]) * room
        if gap > reach[k] + farthest:
            break
        if gap <= reach[k] + reach[other] and _uncertain(
            i, entries[other], delta, depth_error, slope, m
        ):
            if count >= pairs.shape[0]:
                return -1
            pairs[count, 0] = k
            pairs[count, 1] = other
            last[k] = max(last[k], other)
            first[other] = min(first[other], k)
            count += 1
    return count


@njit(cache=True, error_model="numpy", forceinline=True)
def _list_lanes(record, i, ox, oy, left, right, top, bottom, sigma_max, m, live, s, pixels):
    """List the pixels of a range that take light and where the exponent may stay below ``sigma_max``.

    ``live`` holds the pixels that take light. Row by row, sigma >= (near1^2 + near2^2)/2 bounds the
    columns, where near1 and near2 are what the forms' spread leaves of |y1| and |y2| (design.md, B2).
    Writes the offsets from the mean into rows _AX and _AY and the pixel numbers into ``pixels``; returns
    their number. (ox, oy) is the offset of the block's first pixel.
    """
    wild = record[i, WILD] != 0.0
    p, c, g, w1, w2 = 0.0, 0.0, 0.0, 0.0, 0.0
    spread1, spread2 = np.inf, np.inf
    if not wild:
        stride = m + 1
        p = record[i, FORMS]
        c = record[i, FORMS + stride]
        g = record[i, FORMS + 2 * stride]
        w1 = record[i, FORMS + 3 * stride]
        w2 = record[i, FORMS + 4 * stride]
        x = max(abs(ox + left), abs(ox + right))
        y = max(abs(oy + top), abs(oy + bottom))
        spread1 = _ROUND * (abs(p) * x + abs(c) * y + abs(w1))
        spread2 = _ROUND * (abs(g) * y + abs(w2))
        for k in range(1, m + 1):
            spread1 += (
                abs(record[i, FORMS + k]) * x
                + abs(record[i, FORMS + stride + k]) * y
                + abs(record[i, FORMS + 3 * stride + k])
            )
            spread2 += abs(record[i, FORMS + 2 * stride + k]) * y + abs(record[i, FORMS + 4 * stride + k])
        spread1 *= _ROOM
        spread2 *= _ROOM
    # without a bound on the columns the whole rows are taken
    bounded = p > 0.0 and spread1 < np.inf and spread2 < np.inf
    mask = 0
    if bounded:
        inverse = 1.0 / p
        reach = 2.0 * sigma_max * _ROOM
        first, past = float(left), float(right)
        # all rows, in number one that the compiler does not know: vector code
        for row in range(s.size // (_ROWS * BLOCK)):
            ay = oy + row
            near = max(0.0, abs(g * ay - w2) - spread2)
            rest = reach - near * near * (2.0 - _ROOM)
            half = (math.sqrt(max(rest, 0.0)) + spread1) * inverse * _ROOM
            center = (c * ay + w1) * inverse - ox
            slack = (_ROOM - 1.0) * (abs(center) + abs(ox) + half)
            s[_C1 + row] = np.ceil(min(max(center - half - slack, first), past + 1.0))
            s[_C2 + row] = np.floor(max(min(center + half + slack, past), first - 1.0)) if rest >= 0.0 else -1.0
        for row in range(top, bottom + 1):
            start, stop = int(s[_C1 + row]), int(s[_C2 + row])
            if start <= stop:
                mask |= ((2 << stop) - (1 << start)) << (row * BLOCK)
    else:
        for row in range(top, bottom + 1):
            mask |= ((2 << right) - (1 << left)) << (row * BLOCK)
    mask &= live
    n = 0
    while mask != 0:
        pixels[n] = lowest_bit(mask)
        mask &= mask - 1
        n += 1
    for lane in range(n):
        s[_AX + lane] = ox + (pixels[lane] & (BLOCK - 1))
        s[_AY + lane] = oy + (pixels[lane] >> _ROW_SHIFT)
    return n


@njit(cache=True, error_model="numpy")
def _forward(
    entries, record, box, tiles, tile_x, tile_y, colors, depth, delta, depth_error, slope, ray,
    s, y1, y2, poly, pixels, layers, sources, lengths, reach, deep, far, first, last, slots, heights, places, pairs,
    x0, y0, d, order, m, antialiased, rules, errors, marks,
):  # fmt: skip
    """Collect the layers of every lane, nearest first (design.md, B5-B6).

    ``first[k] <= k <= last[k]`` become the list positions whose depth order against entry k is
    uncertain, ``pairs`` [., 2] all such pairs, ``slots[k]`` the row of ``heights`` that holds the
    upper alphas of an entry that takes part in one (-1: none), and of ``places`` that holds its place in
    the lanes' lists (-1: not in it). Returns the number of pairs and of
    slots; or _GIVE_UP where more pairs are uncertain than ``pairs`` may hold, or _GROW where another
    buffer is too small.

    Row _RHO of ``s`` receives how much transmittance may be lost to a stop that the kept layers ignore;
    ``marks`` is set for the entries that some lane that takes light may draw, or stop at.
    """
    unit = errors[0]
    alpha_min = rules[7] * (1.0 - 2.0 * unit)
    stop = rules[9]
    stop_low = stop * (1.0 - 8.0 * unit)
    stop_high = stop * (1.0 + 8.0 * unit)
    line = d == 1 and order == 2
    vector = _VECTOR_LINE if line else _VECTOR
    for q in range(PIXELS):
        s[_TLO + q] = 1.0
        s[_THI + q] = 1.0
        s[_REACH + q] = -1.0
        s[_RHO + q] = 0.0
        s[_TMP + q] = 0.0
        lengths[q] = 0
    room, largest = _depth_reach(entries, depth, delta, depth_error, slope, ray, m, reach, deep)
    if not room > 0.0:
        return _GIVE_UP, 0
    far_count = 0
    farthest = 0.0
    for k in range(entries.size):
        first[k] = k
        last[k] = k
        slots[k] = -1
        if reach[k] > largest:
            far[far_count] = k
            far_count += 1
            farthest = max(farthest, reach[k])
    pair_count = 0
    slot_count = 0
    live = -1
    live_first = 0
    live_last = BLOCK - 1
    record_bytes = 8 * record.shape[1]
    color_bytes = 8 * colors.shape[1]
    for k in range(entries.size):
        if k + AHEAD < entries.size:
            ahead = entries[k + AHEAD]
            prefetch(box, ahead, 0)
            prefetch(tiles, ahead, 0)
            for byte in range(0, record_bytes, 64):
                prefetch(record, ahead, byte)
            prefetch(record, ahead, record_bytes - 8)
            for byte in range(0, color_bytes, 64):
                prefetch(colors, ahead, byte)
        i = entries[k]
        # only the pixels that the Gaussian may reach, in rows that still take light
        left = int(math.ceil(min(max(box[i, 0] - 0.5 - x0, 0.0), float(BLOCK))))
        right = int(math.floor(min(max(box[i, 1] - 0.5 - x0, -1.0), BLOCK - 1.0)))
        top = max(live_first, int(math.ceil(min(max(box[i, 2] - 0.5 - y0, 0.0), float(BLOCK)))))
        bottom = min(live_last, int(math.floor(min(max(box[i, 3] - 0.5 - y0, -1.0), BLOCK - 1.0))))
        if top > bottom or left > right:
            continue
        sigma_max = record[i, FAINT]
        n = _list_lanes(
            record, i, x0 + 0.5 - record[i, MEAN_X], y0 + 0.5 - record[i, MEAN_Y], left, right, top, bottom,
            sigma_max, m, live, s, pixels,
        )  # fmt: skip
        if n == 0:
            continue
        # vector code works on whole multiples; the lanes in excess repeat the last one
        padded = -(-n // vector) * vector
        for lane in range(n, padded):
            s[_AX + lane] = s[_AX + n - 1]
            s[_AY + lane] = s[_AY + n - 1]
        sure = tiles[i, 4] <= tile_x and tile_x < tiles[i, 5] and tiles[i, 6] <= tile_y and tile_y < tiles[i, 7]
        if not _alpha_forms(
            record, i, padded, s, y1, y2, poly, sigma_max, d, order, m, antialiased, sure, rules, errors
        ):
            continue
        pair_count = _find_pairs(
            k, entries, deep, delta, depth_error, slope, m, reach, room, largest, farthest, far, far_count,
            first, last, pairs, pair_count,
        )  # fmt: skip
        if pair_count < 0:
            return _GIVE_UP, 0
        alone = first[k] == k and last[k] == k
        if not alone:
            if slot_count >= heights.shape[0]:
                return _GROW, 0
            slots[k] = slot_count
            heights[slot_count] = 0.0
            places[slot_count] = -1
            slot_count += 1
        ended = False
        seen = False
        for lane in range(n):
            high = s[_HI + lane]
            q = int(pixels[lane])
            if high < alpha_min:
                continue
            seen = True
            low = s[_LO + lane]
            before = s[_THI + q]
            # two roundings of the running transmittance
            t_low = s[_TLO + q] * (1.0 - high) * (1.0 - 8.0 * unit)
            t_high = before * (1.0 - low) * (1.0 + 8.0 * unit)
            if alone and t_high <= stop_low:
                # surely the stop: neither this layer nor any behind it is drawn
                live &= ~(1 << q)
                ended = True
                continue
            count = lengths[q]
            if count >= layers.shape[0]:
                return _GROW, 0
            dropped = False
            if alone and t_low <= stop_high:
                # s[_TMP] is the most that any stop so far may leave of the light
                s[_TMP + q] = max(s[_TMP + q], min(before, stop_high / (1.0 - high)))
                dropped = s[_TMP + q] >= before
                if not dropped:
                    s[_RHO + q] = s[_TMP + q]
            row = layers[count, q]
            if dropped:
                row[0] = 0.5 * high
                for r in range(1, m):
                    row[r] = 0.0
                row[m] = 0.5 * high * _UP
                low = 0.0
            elif line:
                row[0] = s[_A0 + lane]
                row[1] = s[_LINEAR + lane]
                row[2] = s[_QUADRATIC + lane]
                row[3] = s[_AR + lane]
            else:
                for r in range(m):
                    row[r] = poly[r, lane]
                row[m] = s[_AR + lane]
            row[m + 1] = low
            row[m + 2] = high
            # transmittance after this layer at its least, before it at its most
            row[m + 3] = t_low
            row[m + 4] = before
            sources[count, q] = k
            lengths[q] = count + 1
            s[_TLO + q] = t_low
            s[_THI + q] = t_high
            if not alone:
                heights[slots[k], q] = high
                places[slots[k], q] = count
                # layers up to the last one whose order is uncertain may still come first
                s[_REACH + q] = max(s[_REACH + q], float(last[k]))
        # threads share these bytes: written no more than once each
        if seen and marks[i] == 0:
            marks[i] = 1
        if slot_count > 0:
            for lane in range(n):
                q = int(pixels[lane])
                if s[_THI + q] <= stop_low and s[_REACH + q] <= k:
                    live &= ~(1 << q)
                    ended = True
        if ended:
            if live == 0:
                break
            live_first = lowest_bit(live) // BLOCK
            while live & (255 << (live_last * BLOCK)) == 0:
                live_last -= 1
    return pair_count, slot_count


@njit(cache=True, error_model="numpy")
def _settle_stops(layers, sources, lengths, first, last, slots, places, s, m, stop, unit):
    """Drop or weaken the layers of uncertain depth order that the stop may hide (design.md, B6)."""
    stop_low = stop * (1.0 - 8.0 * unit)
    stop_high = stop * (1.0 + 8.0 * unit)
    for q in range(PIXELS):
        s[_CC + q] = 0.0
    for k in range(slots.size):
        if slots[k] < 0:
            continue
        place = places[slots[k]]
        for q in range(PIXELS):
            e = place[q]
            # the stop is out of reach of most lanes
            if e < 0 or s[_TLO + q] > stop_high:
                continue
            behind = e
            while behind + 1 < lengths[q] and sources[behind + 1, q] <= last[k]:
                behind += 1
            t_low = layers[behind, q, m + 3]
            if t_low > stop_high:
                continue
            before = e
            while before > 0 and sources[before - 1, q] >= first[k]:
                before -= 1
            light = layers[before, q, m + 4]
            t_high = light * (1.0 - layers[e, q, m + 1]) * (1.0 + 8.0 * unit)
            # the most light that a stop at this layer may leave
            high = layers[e, q, m + 2]
            lost = min(light, stop_high / (1.0 - high))
            if t_high <= stop_low:
                s[_CC + q] = max(s[_CC + q], lost)
                for r in range(m + 3):
                    layers[e, q, r] = 0.0
            elif lost < light:
                # kept; what the stop may leave of the light is added at the end
                s[_RHO + q] = max(s[_RHO + q], lost, s[_TMP + q])
            else:
                s[_CC + q] = max(s[_CC + q], lost)
                layers[e, q, 0] = 0.5 * high
                for r in range(1, m):
                    layers[e, q, r] = 0.0
                layers[e, q, m] = 0.5 * high * _UP
                layers[e, q, m + 1] = 0.0
    # a stop at a dropped or weakened layer also hides the kept layers behind it
    for q in range(PIXELS):
        if s[_RHO + q] > 0.0:
            s[_RHO + q] = max(s[_RHO + q], s[_CC + q])


@njit(cache=True, error_model="numpy")
def _color_range(colors, i, channel, color_rows):
    """Bounds of one Gaussian's colour over the cell."""
    start = channel * color_rows
    spread = 0.0
    for r in range(1, color_rows):
        spread += abs(colors[i, start + r])
    spread *= _UP
    return colors[i, start] - spread, colors[i, start] + spread


@njit(cache=True, error_model="numpy")
def _swap_bounds(pairs, pair_count, slots, slot_count, heights, entries, colors, color_rows, moves, most):
    """Bound what reordering may change when a slot's layer joins the layers behind it (design.md, O2).

    ``moves[slot, 2 c]`` and ``moves[slot, 2 c + 1]`` (rows of lanes) are how much it may lower or raise channel c.
    """
    moves[:slot_count] = 0.0
    most[:slot_count] = 0.0
    n = heights.shape[1]
    for p in range(pair_count):
        front = slots[pairs[p, 0]]
        back = slots[pairs[p, 1]]
        if front < 0 or back < 0:
            continue
        for channel in range(3):
            low_e, high_e = _color_range(colors, entries[pairs[p, 0]], channel, color_rows)
            low_f, high_f = _color_range(colors, entries[pairs[p, 1]], channel, color_rows)
            for side in range(2):
                change = max(0.0, high_e - low_f) if side == 0 else max(0.0, high_f - low_e)
                if change == 0.0:
                    continue
                total = moves[front, 2 * channel + side]
                single = most[front, 2 * channel + side]
                alpha = heights[back]
                for q in range(n):
                    total[q] += alpha[q] * change
                for q in range(n):
                    single[q] = max(single[q], change if alpha[q] > 0.0 else 0.0)
    for slot in range(slot_count):
        alpha = heights[slot]
        for r in range(6):
            total = moves[slot, r]
            single = most[slot, r]
            # the weights of the layers it may move behind add up to at most one
            for q in range(n):
                total[q] = alpha[q] * min(total[q], single[q]) * _UP


@njit(cache=True, error_model="numpy")
def _collect_moves(moves, slot_count, places, extra, moved):
    """Move the swap bounds from slots to the lanes' layers; ``moved[e]`` tells whether row e has any."""
    for slot in range(slot_count):
        for q in range(PIXELS):
            e = places[slot, q]
            if e < 0:
                continue
            if not moved[e]:
                moved[e] = True
                extra[e] = 0.0
            for r in range(6):
                extra[e, r, q] = moves[slot, r, q]


@njit(cache=True, error_model="numpy")
def _interval_chain(
    layers, sources, entries, colors, extra, moved, low, high, start, stop, q, channel, m, color_rows,
    suffix_low, suffix_high,
):  # fmt: skip
    """One step of the interval blend for layers [start, stop) whose order is uncertain (design.md, O2-O4).

    Returns the tighter of the swap, hull and antichain bounds, and the range of the colours so far.
    """
    behind_low, behind_high = low, high
    for e in range(stop - 1, start - 1, -1):
        layer = layers[e, q]
        c_low, c_high = _color_range(colors, entries[sources[e, q]], channel, color_rows)
        a_low = layer[m + 1]
        a_high = layer[m + 2]
        v = c_high - high
        front_high = high + (a_high if v > 0.0 else a_low) * v
        v = c_low - low
        front_low = low + (a_high if v < 0.0 else a_low) * v
        lower = extra[e, 2 * channel, q] if moved[e] else 0.0
        lift = extra[e, 2 * channel + 1, q] if moved[e] else 0.0
        # wherever it goes among the layers behind, it moves the colour by at most its alpha times
        # the distance to the darkest or brightest of what lies behind
        hull_high = max(front_high, high + a_high * max(0.0, c_high - suffix_low))
        hull_low = min(front_low, low + a_high * min(0.0, c_low - suffix_high))
        high = min(front_high + lift, hull_high) if lift > 0.0 else front_high
        low = max(front_low - lower, hull_low) if lower > 0.0 else front_low
        suffix_low = min(suffix_low, c_low)
        suffix_high = max(suffix_high, c_high)
    count = stop - start
    keys = np.empty(count)
    for side in range(2):
        for e in range(count):
            c_low, c_high = _color_range(colors, entries[sources[start + e, q]], channel, color_rows)
            keys[e] = c_low if side == 0 else -c_high
        order = np.argsort(keys)
        value = behind_low if side == 0 else behind_high
        # nearest first: darkest for the lower bound, brightest for the upper one
        for position in range(count - 1, -1, -1):
            layer = layers[start + order[position], q]
            color = keys[order[position]] if side == 0 else -keys[order[position]]
            v = color - value
            grows = v < 0.0 if side == 0 else v > 0.0
            value += layer[m + 2 if grows else m + 1] * v
        if side == 0:
            low = max(low, value)
        else:
            high = min(high, value)
    return low, high, suffix_low, suffix_high


@njit(cache=True, error_model="numpy")
def _interval_blend(
    layers, sources, entries, colors, lengths, extra, moved, chain, background, m, color_rows, low, high
):
    """Sharpen the interval blend where depth orders are uncertain; ``chain[k]`` numbers the groups."""
    size = np.zeros(chain.size + 2, np.int64)
    for k in range(chain.size):
        size[chain[k]] += 1
    for q in range(PIXELS):
        # reordering that cannot move the colour by a ten-thousandth is left to the swap bound
        weight = 0.0
        for e in range(lengths[q]):
            # of two layers alone the swap bound is exact
            if moved[e] and size[chain[sources[e, q]]] > 2:
                most = 0.0
                for r in range(6):
                    most = max(most, extra[e, r, q])
                weight += most * layers[e, q, m + 4]
        if not weight > _REORDERING_MATTERS:
            continue
        for channel in range(3):
            value_low = background[channel]
            value_high = background[channel]
            suffix_low = value_low
            suffix_high = value_high
            stop = int(lengths[q])
            while stop > 0:
                start = stop - 1
                while start > 0 and chain[sources[start - 1, q]] == chain[sources[stop - 1, q]]:
                    start -= 1
                value_low, value_high, suffix_low, suffix_high = _interval_chain(
                    layers, sources, entries, colors, extra, moved, value_low, value_high, start, stop, q, channel, m,
                    color_rows, suffix_low, suffix_high,
                )  # fmt: skip
                stop = start
            low[channel, q] = max(low[channel, q], value_low)
            high[channel, q] = min(high[channel, q], value_high)


@njit(cache=True, error_model="numpy", forceinline=True)
def _step_affine(n, s, layer, start, p, m, color_rows):
    """One layer over one channel's polynomials ``p`` [m, lanes] of order 1 (design.md, B7): one loop by parameter.

    Leaves the colour's middle, spread and radius in rows _C1, _CC, _C2, the sizes of colour - P and of its slopes in
    _SR and _SB, one more than those of alpha in _SL, what is left of the products in _TMP, and |P| in _S0.
    """
    moving = color_rows > 2
    color, middle = layer[start], p[0]
    for q in range(n):
        # value = colour - P, a form without radius
        value = color[q] - middle[q]
        s[_C1 + q] = color[q]
        s[_WEIGHT + q] = value
        s[_SR + q] = abs(value)
        s[_S0 + q] = middle[q] + s[_A0 + q] * value
        s[_CC + q] = 0.0
        s[_SB + q] = 0.0
        s[_TMP + q] = 0.0
    for k in range(1, m):
        alpha, slope = layer[k], p[k]
        if moving:
            color = layer[start + k]
            for q in range(n):
                change = color[q] - slope[q]
                curve = 0.5 * (alpha[q] * change)
                slope[q] += s[_A0 + q] * change + s[_WEIGHT + q] * alpha[q]
                s[_S0 + q] += curve
                s[_TMP + q] -= abs(curve)
                s[_SB + q] += abs(change)
                s[_CC + q] += abs(color[q])
        else:
            for q in range(n):
                change = -slope[q]
                curve = 0.5 * (alpha[q] * change)
                slope[q] += s[_A0 + q] * change + s[_WEIGHT + q] * alpha[q]
                s[_S0 + q] += curve
                s[_TMP + q] -= abs(curve)
                s[_SB + q] += abs(change)
    # the last row of a colour is its radius
    color = layer[start + color_rows - 1]
    has_radius = 1.0 if color_rows > 1 else 0.0
    for q in range(n):
        spread = has_radius * abs(color[q])
        s[_C2 + q] = spread
        s[_CC + q] += spread
        s[_TMP + q] += s[_L1 + q] * s[_SB + q]
        s[_SL + q] = 1.0 + s[_L1 + q]
        middle[q] = s[_S0 + q]
        s[_S0 + q] = abs(s[_S0 + q])


@njit(cache=True, error_model="numpy")
def _step_curved(n, s, layer, start, p, value, d, m, color_rows):
    """`_step_affine` for order 2; ``value`` [m, lanes] is scratch."""
    moving = color_rows > 2
    for q in range(n):
        s[_C1 + q] = layer[start, q]
        s[_CC + q] = 0.0
    for k in range(1, color_rows):
        for q in range(n):
            s[_CC + q] += abs(layer[start + k, q])
    if color_rows > 1:
        for q in range(n):
            s[_C2 + q] = layer[start + color_rows - 1, q]
    else:
        for q in range(n):
            s[_C2 + q] = 0.0
    # value = colour - P, a form without radius
    for q in range(n):
        value[0, q] = s[_C1 + q] - p[0, q]
    for k in range(1, m):
        if moving:
            for q in range(n):
                value[k, q] = layer[start + k, q] - p[k, q]
        else:
            for q in range(n):
                value[k, q] = -p[k, q]
    _spread(value, 1, 1 + d, n, s, _L2)
    for q in range(n):
        p[0, q] += s[_A0 + q] * value[0, q]
    for k in range(1, m):
        for q in range(n):
            p[k, q] += s[_A0 + q] * value[k, q] + value[0, q] * layer[k, q]
    _spread(value, 1 + d, m, n, s, _B2)
    row = 1 + d
    for k in range(1, d + 1):
        for q in range(n):
            p[row, q] += layer[k, q] * value[k, q]
        row += 1
        for l in range(k + 1, d + 1):
            for q in range(n):
                p[row, q] += layer[k, q] * value[l, q] + layer[l, q] * value[k, q]
            row += 1
    for q in range(n):
        s[_TMP + q] = s[_L1 + q] * s[_B2 + q] + s[_B1 + q] * (s[_L2 + q] + s[_B2 + q])
    for q in range(n):
        s[_SL + q] = 1.0 + s[_L1 + q] + s[_B1 + q]
        s[_SB + q] = s[_L2 + q] + s[_B2 + q]
    for q in range(n):
        s[_SR + q] = abs(value[0, q])
    for q in range(n):
        s[_S0 + q] = abs(p[0, q])


@njit(cache=True, error_model="numpy")
def _blend_group(
    ranked, layers, sources, entries, colors, lengths, layer, extra, moved, background, d, order, m, color_rows,
    state, radius, low, high, value, s,
):  # fmt: skip
    """Blend the layers of the pixels ``ranked`` back to front, as forms and as intervals (design.md, B7).

    ``state`` [3, m, lanes] and ``radius`` [3, lanes] receive the polynomial forms, ``low`` and
    ``high`` [3, lanes] the intervals; rows _MIN and _MAX of ``s`` the range of all colours.
    """
    n = value.shape[1]
    count = 0
    for q in range(n):
        s[_MIN + q] = min(background[0], background[1], background[2])
        s[_MAX + q] = max(background[0], background[1], background[2])
        count = max(count, int(lengths[ranked[q]]))
    state[:] = 0.0
    radius[:] = 0.0
    for channel in range(3):
        for q in range(n):
            state[channel, 0, q] = background[channel]
            low[channel, q] = background[channel]
            high[channel, q] = background[channel]
    for e in range(count - 1, -1, -1):
        # lane by lane in memory, row by row for the arithmetic
        for q in range(n):
            lane = ranked[q]
            if e < lengths[lane]:
                for r in range(m + 3):
                    layer[r, q] = layers[e, lane, r]
                i = entries[sources[e, lane]]
                for r in range(3 * color_rows):
                    layer[m + 3 + r, q] = colors[i, r]
            else:
                for r in range(layer.shape[0]):
                    layer[r, q] = 0.0
        _spread(layer, 1, 1 + d, n, s, _L1)
        if order == 2:
            _spread(layer, 1 + d, m, n, s, _B1)
        # rows that the loops below use often
        for q in range(n):
            s[_A0 + q] = layer[0, q]
        for q in range(n):
            s[_AR + q] = layer[m, q]
        for q in range(n):
            s[_LO + q] = layer[m + 1, q]
        for q in range(n):
            s[_HI + q] = layer[m + 2, q]
        for channel in range(3):
            start = m + 3 + channel * color_rows
            p, r, top, bottom = state[channel], radius[channel], high[channel], low[channel]
            if order == 1:
                _step_affine(n, s, layer, start, p, m, color_rows)
            else:
                _step_curved(n, s, layer, start, p, value, d, m, color_rows)
            for q in range(n):
                size = s[_SR + q] + s[_SB + q]
                r[q] = (
                    (1.0 - s[_LO + q]) * r[q]
                    + s[_HI + q] * s[_C2 + q]
                    + s[_AR + q] * size
                    + s[_TMP + q]
                    + _ROUND * (s[_S0 + q] + size * s[_SL + q])
                ) * _UP
            for q in range(n):
                c_high = s[_C1 + q] + s[_CC + q] * _UP
                v = c_high - top[q]
                top[q] += (s[_HI + q] if v > 0.0 else s[_LO + q]) * v
                s[_MAX + q] = max(s[_MAX + q], c_high)
            for q in range(n):
                c_low = s[_C1 + q] - s[_CC + q] * _UP
                v = c_low - bottom[q]
                bottom[q] += (s[_HI + q] if v < 0.0 else s[_LO + q]) * v
                s[_MIN + q] = min(s[_MIN + q], c_low)
            if moved[e]:
                lower = 2 * channel
                lift = 2 * channel + 1
                for q in range(n):
                    falls, rises = extra[e, lower, ranked[q]], extra[e, lift, ranked[q]]
                    p[0, q] += 0.5 * (rises - falls)
                    r[q] += 0.5 * (rises + falls) * _UP
                    top[q] += rises
                    bottom[q] -= falls


@njit(cache=True, error_model="numpy")
def _blend(
    ranked, layers, sources, entries, colors, lengths, layer, extra, moved, background, d, order, m, color_rows,
    group, group_ends, state, radius, low, high, value, s,
):  # fmt: skip
    """`_blend_group` of all pixels, in the order ``ranked``.

    Rows _DARKEST and _BRIGHTEST of ``s`` receive the range of all colours; ``group`` [3, m, lanes] and
    ``group_ends`` [3, 3, lanes] are scratch for a group.
    """
    n = value.shape[1]
    for first in range(0, PIXELS, n):
        some = ranked[first : first + n]
        _blend_group(
            some, layers, sources, entries, colors, lengths, layer, extra, moved, background, d, order, m, color_rows,
            group, group_ends[0], group_ends[1], group_ends[2], value, s,
        )  # fmt: skip
        for q in range(n):
            s[_DARKEST + int(some[q])] = s[_MIN + q]
            s[_BRIGHTEST + int(some[q])] = s[_MAX + q]
        for channel in range(3):
            for k in range(m):
                for q in range(n):
                    state[channel, k, some[q]] = group[channel, k, q]
            for q in range(n):
                radius[channel, some[q]] = group_ends[0, channel, q]
                low[channel, some[q]] = group_ends[1, channel, q]
                high[channel, some[q]] = group_ends[2, channel, q]


# rows of one channel of the one-parameter blend: coefficients, radius, interval, then the layer's colour
_P0, _P1, _P2, _PR, _PLO, _PHI, _K0, _K1, _K2, _KR = range(0, 10 * _GROUP, _GROUP)
_CHANNEL_ROWS = 10


@njit(cache=True, error_model="numpy", forceinline=True)
def _blend_channel_line(n, s, t):
    """Blend one layer (rows _A0, _LINEAR, _QUADRATIC, _AR, _LO, _HI of ``s``) into one channel's rows ``t``."""
    for q in range(n):
        a0 = s[_A0 + q]
        a1 = s[_LINEAR + q]
        a2 = s[_QUADRATIC + q]
        low = s[_LO + q]
        high = s[_HI + q]
        p0 = t[_P0 + q]
        p1 = t[_P1 + q]
        p2 = t[_P2 + q]
        # colour - P, a form without radius
        v0 = t[_K0 + q] - p0
        v1 = t[_K1 + q] - p1
        v2 = t[_K2 + q] - p2
        p0 += a0 * v0
        t[_P0 + q] = p0
        t[_P1 + q] = p1 + a0 * v1 + v0 * a1
        t[_P2 + q] = p2 + a0 * v2 + v0 * a2 + a1 * v1
        a1 = abs(a1)
        a2 = abs(a2)
        v1 = abs(v1)
        v2 = abs(v2)
        size = abs(v0) + v1 + v2
        t[_PR + q] = (
            (1.0 - low) * t[_PR + q]
            + high * t[_KR + q]
            + s[_AR + q] * size
            + a1 * v2
            + a2 * (v1 + v2)
            + _ROUND * (abs(p0) + size * (1.0 + a1 + a2))
        ) * _UP
        spread = (abs(t[_K1 + q]) + abs(t[_K2 + q]) + t[_KR + q]) * _UP
        c_high = t[_K0 + q] + spread
        c_low = t[_K0 + q] - spread
        v = c_high - t[_PHI + q]
        t[_PHI + q] += (high if v > 0.0 else low) * v
        v = c_low - t[_PLO + q]
        t[_PLO + q] += (high if v < 0.0 else low) * v
        s[_MAX + q] = max(s[_MAX + q], c_high)
        s[_MIN + q] = min(s[_MIN + q], c_low)


@njit(cache=True, error_model="numpy")
def _blend_line(
    ranked, layers, sources, entries, colors, lengths, extra, moved, background, color_rows, state, radius, low, high,
    red, green, blue, s,
):  # fmt: skip
    """`_blend` for one parameter and order 2; ``red``, ``green``, ``blue`` [rows * lanes] are scratch for a group."""
    n = red.size // _CHANNEL_ROWS
    darkest = min(background[0], background[1], background[2])
    brightest = max(background[0], background[1], background[2])
    for first in range(0, PIXELS, n):
        for channel in range(3):
            t = red if channel == 0 else (green if channel == 1 else blue)
            t[:] = 0.0
            for q in range(n):
                t[_P0 + q] = background[channel]
                t[_PLO + q] = background[channel]
                t[_PHI + q] = background[channel]
        deepest = 0
        for q in range(n):
            s[_MIN + q] = darkest
            s[_MAX + q] = brightest
            deepest = max(deepest, lengths[ranked[first + q]])
        for e in range(deepest - 1, -1, -1):
            # lane by lane in memory, row by row for the arithmetic
            for q in range(n):
                lane = ranked[first + q]
                if e < lengths[lane]:
                    row = layers[e, lane]
                    s[_A0 + q] = row[0]
                    s[_LINEAR + q] = row[1]
                    s[_QUADRATIC + q] = row[2]
                    s[_AR + q] = row[3]
                    s[_LO + q] = row[4]
                    s[_HI + q] = row[5]
                    # a list that has ended keeps the colour of its last layer, with alpha 0
                    color = colors[entries[sources[e, lane]]]
                    red[_K0 + q] = color[0]
                    green[_K0 + q] = color[color_rows]
                    blue[_K0 + q] = color[2 * color_rows]
                    if color_rows > 1:
                        # the last row of a colour is its radius, those between are its slopes
                        red[_KR + q] = color[color_rows - 1]
                        green[_KR + q] = color[2 * color_rows - 1]
                        blue[_KR + q] = color[3 * color_rows - 1]
                    if color_rows > 2:
                        red[_K1 + q] = color[1]
                        red[_K2 + q] = color[2]
                        green[_K1 + q] = color[color_rows + 1]
                        green[_K2 + q] = color[color_rows + 2]
                        blue[_K1 + q] = color[2 * color_rows + 1]
                        blue[_K2 + q] = color[2 * color_rows + 2]
                else:
                    s[_A0 + q] = 0.0
                    s[_LINEAR + q] = 0.0
                    s[_QUADRATIC + q] = 0.0
                    s[_AR + q] = 0.0
                    s[_LO + q] = 0.0
                    s[_HI + q] = 0.0
            _blend_channel_line(n, s, red)
            _blend_channel_line(n, s, green)
            _blend_channel_line(n, s, blue)
            if moved[e]:
                for channel in range(3):
                    t = red if channel == 0 else (green if channel == 1 else blue)
                    for q in range(n):
                        lower = extra[e, 2 * channel, ranked[first + q]]
                        lift = extra[e, 2 * channel + 1, ranked[first + q]]
                        t[_P0 + q] += 0.5 * (lift - lower)
                        t[_PR + q] += 0.5 * (lift + lower) * _UP
                        t[_PHI + q] += lift
                        t[_PLO + q] -= lower
        for q in range(n):
            s[_DARKEST + int(ranked[first + q])] = s[_MIN + q]
            s[_BRIGHTEST + int(ranked[first + q])] = s[_MAX + q]
        for channel in range(3):
            t = red if channel == 0 else (green if channel == 1 else blue)
            for q in range(n):
                lane = ranked[first + q]
                state[channel, 0, lane] = t[_P0 + q]
                state[channel, 1, lane] = t[_P1 + q]
                state[channel, 2, lane] = t[_P2 + q]
                radius[channel, lane] = t[_PR + q]
                low[channel, lane] = t[_PLO + q]
                high[channel, lane] = t[_PHI + q]


@njit(cache=True, error_model="numpy")
def _form_range(p, d, order, m, s):
    """Range over the box of one channel's polynomial into rows _SLO, _SHI, rounded outward."""
    n = p.shape[1]
    _spread(p, 1, m, n, s, _SL)
    for q in range(n):
        s[_MIN + q] = p[0, q]
        s[_MAX + q] = p[0, q]
    if order == 1:
        for q in range(n):
            s[_MIN + q] -= s[_SL + q]
            s[_MAX + q] += s[_SL + q]
    else:
        _add_range(p, d, n, s)
    for q in range(n):
        rounding = 8.0 * _ROUND * (abs(p[0, q]) + s[_SL + q])
        s[_SLO + q] = s[_MIN + q] - rounding
        s[_SHI + q] = s[_MAX + q] + rounding


@njit(cache=True, error_model="numpy")
def _chains(last):
    """Number of the group of each list position: no uncertain pair spans two groups."""
    chain = np.empty(last.size, np.int64)
    group = 0
    reach = -1
    for k in range(last.size):
        if k > reach:
            group += 1
        chain[k] = group
        reach = max(reach, last[k])
    return chain


@njit(cache=True, error_model="numpy")
def _rank(lengths, deepest, counts, ranked):
    """Sort the pixels by their ``lengths``, at most ``deepest``, into ``ranked``; ``counts`` is scratch."""
    counts[: deepest + 1] = 0
    for q in range(PIXELS):
        counts[lengths[q]] += 1
    position = 0
    for length in range(deepest + 1):
        count = counts[length]
        counts[length] = position
        position += count
    for q in range(PIXELS):
        ranked[counts[lengths[q]]] = q
        counts[lengths[q]] += 1


@njit(cache=True, error_model="numpy")
def _block(
    listed, x0, y0, tile_x, tile_y, record, box, tiles, depth, delta, depth_error, colors, color_radius,
    slope, direction, camera, rules, errors, background, negligible, d, order, m, antialiased,
    s, y1, y2, poly, value, layer, pixels, layers, sources, lengths, reach, deep, far, first, last, slots, heights,
    places, pairs, moves, most, extra, moved, line, group, group_ends, state, radius, low, high, ray, lower, upper,
    linear, statistics, marks,
):  # fmt: skip
    """Bounds of one block of pixels whose first pixel is (x0, y0). Returns whether the buffers sufficed.

    ``lower``, ``upper`` [side, side, 3] are the tile's, ``linear`` starts with the tile's or is empty;
    ``statistics`` is the thread's row.
    """
    unit = errors[0]
    side = lower.shape[0]
    color_rows = colors.shape[1] // 3
    u = (x0 + 0.5 * BLOCK - camera[2]) / camera[0]
    v = (y0 + 0.5 * BLOCK - camera[3]) / camera[1]
    for k in range(3):
        ray[k] = direction[k] * u + direction[3 + k] * v + direction[6 + k]
    pair_count, slot_count = _forward(
        listed, record, box, tiles, tile_x, tile_y, colors, depth, delta, depth_error, slope, ray,
        s, y1, y2, poly, pixels, layers, sources, lengths, reach, deep, far, first, last, slots, heights, places, pairs,
        x0, y0, d, order, m, antialiased, rules, errors, marks,
    )  # fmt: skip
    if pair_count == _GROW:
        return False
    statistics[0] += 1
    if pair_count == _GIVE_UP:
        # too much may be reordered: nothing is known
        statistics[3] += 1
        for k in range(listed.size):
            marks[listed[k]] = 1
        for q in range(PIXELS):
            row = y0 % side + q // BLOCK
            column = x0 % side + q % BLOCK
            for channel in range(3):
                lower[row, column, channel] = 0.0
                upper[row, column, channel] = 1.0
                if linear.shape[0] > 0:
                    linear[0, row, column, channel, 0] = 0.5
                    linear[0, row, column, channel, m] = 0.5
        return True
    deepest = 0
    for q in range(PIXELS):
        deepest = max(deepest, int(lengths[q]))
    moved[:deepest] = False
    if slot_count > 0:
        _settle_stops(
            layers, sources, lengths, first, last, slots[: listed.size], places, s, m, rules[9], unit
        )
        _swap_bounds(pairs, pair_count, slots, slot_count, heights, listed, colors, color_rows, moves, most)
        _collect_moves(moves, slot_count, places, extra, moved)
    # pixels of like depth are blended together; the pixels' numbers are of no more use
    ranked = pixels
    _rank(lengths, deepest, far, ranked)
    if d == 1 and order == 2:
        _blend_line(
            ranked, layers, sources, listed, colors, lengths, extra, moved, background, color_rows, state, radius,
            low, high, line[0], line[1], line[2], s,
        )  # fmt: skip
    else:
        _blend(
            ranked, layers, sources, listed, colors, lengths, layer, extra, moved, background, d, order, m, color_rows,
            group, group_ends, state, radius, low, high, value, s,
        )  # fmt: skip
    if slot_count > 0:
        _interval_blend(
            layers, sources, listed, colors, lengths, extra, moved, _chains(last[: listed.size]), background, m,
            color_rows, low, high,
        )
    statistics[1] += deepest
    statistics[2] += pair_count
    for channel in range(3):
        _form_range(state[channel], d, order, m, s)
        for q in range(PIXELS):
            row = y0 % side + q // BLOCK
            column = x0 % side + q % BLOCK
            # rounding of the program's own sums and products (design.md, B8)
            bright = max(1.0, s[_BRIGHTEST + q], -s[_DARKEST + q])
            slack = (
                (3.0 * lengths[q] + 16.0) * (unit + 8.0 * UNIT64) * bright * 1.01 + color_radius + negligible * bright
            )
            # a stop that was ignored shows the background in place of what lies behind (B6)
            rho = s[_RHO + q] * (1.0 + 16.0 * unit)
            fall = slack + rho * max(0.0, s[_BRIGHTEST + q] - background[channel])
            rise = slack + rho * max(0.0, background[channel] - s[_DARKEST + q])
            bottom = max(low[channel, q], s[_SLO + q] - radius[channel, q] * _UP) - fall
            top = min(high[channel, q], s[_SHI + q] + radius[channel, q] * _UP) + rise
            if not bottom <= top:
                # crossed or not a number: nothing is known
                bottom = 0.0
                top = 1.0
                statistics[4] += 1
            lower[row, column, channel] = min(1.0, max(0.0, bottom))
            upper[row, column, channel] = max(0.0, min(1.0, top))
            if linear.shape[0] > 0:
                for k in range(m):
                    linear[0, row, column, channel, k] = state[channel, k, q]
                linear[0, row, column, channel, m] = radius[channel, q] + max(fall, rise)
    return True


@njit(cache=True, error_model="numpy")
def _pixel_worker(
    thread, wanted, offsets, entries, record_, box_, tiles_, depth_, delta_, depth_error_, colors_, color_radius,
    slope_, direction_, camera_, rules_, errors_, background_, negligible, pair_limit, d, order, m, antialiased,
    threads, lower_, upper_, linear_, statistics_, marks_,
):  # fmt: skip
    """Every ``threads``-th tile, from number ``thread``; see `pixel_stage`."""
    record, box, tiles, depth = borrowed(record_), borrowed(box_), borrowed(tiles_), borrowed(depth_)
    delta, depth_error, colors, slope = borrowed(delta_), borrowed(depth_error_), borrowed(colors_), borrowed(slope_)
    direction, camera, rules, errors = borrowed(direction_), borrowed(camera_), borrowed(rules_), borrowed(errors_)
    background, lower, upper = borrowed(background_), borrowed(lower_), borrowed(upper_)
    linear, statistics, marks = borrowed(linear_), borrowed(statistics_), borrowed(marks_)
    image_width, image_height = camera[4], camera[5]
    side = lower.shape[1]
    tiles_x = int(math.ceil(image_width / side))
    blocks = side // BLOCK
    rows = m + 5
    scratch = np.zeros(_ROWS * PIXELS)
    planes = np.empty((3 * m, PIXELS))
    group_planes = np.empty((2 * m + 3 + colors.shape[1], _GROUP))
    pixels_ = np.empty(PIXELS, np.uint8)
    lengths_ = np.empty(PIXELS, np.uint32)
    ray_ = np.empty(3)
    s = borrowed(scratch)
    y1, y2, poly = borrowed(planes[:m]), borrowed(planes[m : 2 * m]), borrowed(planes[2 * m : 3 * m])
    value, layer = borrowed(group_planes[:m]), borrowed(group_planes[m:])
    pixels, lengths, ray = borrowed(pixels_), borrowed(lengths_), borrowed(ray_)
    state_ = np.empty((3, m, PIXELS))
    line_ = np.empty((3, _CHANNEL_ROWS * _GROUP))
    line = borrowed(line_)
    ends = np.empty((3, 3, PIXELS))
    group_, group_ends_ = np.empty((3, m, _GROUP)), np.empty((3, 3, _GROUP))
    group, group_ends = borrowed(group_), borrowed(group_ends_)
    state, radius, low, high = borrowed(state_), borrowed(ends[0]), borrowed(ends[1]), borrowed(ends[2])
    layers_ = np.empty((256, PIXELS, rows))
    sources_ = np.empty((256, PIXELS), np.uint32)
    extra_ = np.empty((256, 6, PIXELS))
    moved_ = np.empty(256, np.bool_)
    heights_ = np.empty((64, PIXELS))
    places_ = np.empty((64, PIXELS), np.int64)
    moves_ = np.empty((2, 64, 6, PIXELS))
    reach_ = np.empty((2, 1024))
    order_ = np.empty((4, 1024), np.int64)
    pairs_ = np.empty((pair_limit, 2), np.int64)
    block_offsets = np.empty(blocks * blocks + 1, np.int64)
    block_entries = np.empty(4096, np.uint32)
    for number in range(thread, wanted.size, threads):
        tile = wanted[number]
        tile_x = tile % tiles_x
        tile_y = tile // tiles_x
        block_entries = block_lists(
            entries[offsets[tile] : offsets[tile + 1]], box, tile_x * side, tile_y * side, side,
            block_offsets, block_entries,
        )  # fmt: skip
        for b in range(blocks * blocks):
            x0 = tile_x * side + (b % blocks) * BLOCK
            y0 = tile_y * side + (b // blocks) * BLOCK
            if x0 >= image_width or y0 >= image_height:
                continue
            listed = block_entries[block_offsets[b] : block_offsets[b + 1]]
            if listed.size >= reach_.shape[1]:
                reach_ = np.empty((2, 2 * listed.size))
                order_ = np.empty((4, 2 * listed.size), np.int64)
            while not _block(
                borrowed(listed), x0, y0, tile_x, tile_y, record, box, tiles, depth, delta, depth_error, colors,
                color_radius, slope, direction, camera, rules, errors, background, negligible, d, order, m,
                antialiased, s, y1, y2, poly, value, layer, pixels, borrowed(layers_), borrowed(sources_), lengths,
                borrowed(reach_[0]), borrowed(reach_[1]), borrowed(order_[0]), borrowed(order_[1]),
                borrowed(order_[2]), borrowed(order_[3]),
                borrowed(heights_), borrowed(places_), borrowed(pairs_), borrowed(moves_[0]), borrowed(moves_[1]),
                borrowed(extra_), borrowed(moved_), line, group, group_ends, state, radius, low, high, ray,
                lower[number], upper[number], linear[min(number, linear.shape[0]) :],
                statistics[thread], marks,
            ):  # fmt: skip
                capacity = 2 * layers_.shape[0]
                layers_ = np.empty((capacity, PIXELS, rows))
                sources_ = np.empty((capacity, PIXELS), np.uint32)
                extra_ = np.empty((capacity, 6, PIXELS))
                moved_ = np.empty(capacity, np.bool_)
                slot_capacity = 2 * heights_.shape[0]
                heights_ = np.empty((slot_capacity, PIXELS))
                places_ = np.empty((slot_capacity, PIXELS), np.int64)
                moves_ = np.empty((2, slot_capacity, 6, PIXELS))
    # the owners of the borrowed arrays live to here
    return (
        scratch.size + planes.size + group_planes.size + group_.size + group_ends_.size + pixels_.size + lengths_.size
        + ray_.size + line_.size + state_.size + ends.size + layers_.size + sources_.size
        + extra_.size + moved_.size + heights_.size + places_.size + moves_.size
        + reach_.size + order_.size + pairs_.size
    )  # fmt: skip


@njit(cache=True, parallel=True, error_model="numpy")
def pixel_stage(
    wanted, offsets, entries, record, box, tiles, depth, delta, depth_error, colors, color_radius,
    slope, direction, camera, rules, errors, background, negligible, pair_limit, d, order, m, antialiased,
    threads, lower, upper, linear, statistics, marks,
):  # fmt: skip
    """Bounds of the pixels of the tiles ``wanted`` [t] (tile numbers, row-major).

    Args:
        wanted: [t] int64.
        offsets, entries: Lists of the tiles, nearest first (`lists.tile_lists`, all tiles of the image).
        record .. depth_error: See `gaussians.gaussian_stage`.
        colors: [n, 3] or [n, 3 (m + 1)] forms.
        color_radius: Bound of the error of the colours, added to every result.
        slope: [rows, 3] third row of the rotation forms.
        direction: [9] the middle pose's world-to-camera rotation, row-major.
        negligible: Bound of what all layers that were left out for a negligible alpha may add up to.
        pair_limit: Most depth-order pairs looked at in one block.
        lower, upper: [t, side, side, 3] outputs.
        linear: [t, side, side, 3, m + 1] forms before the clamp, or empty.
        marks: [n] uint8; set to 1 for every Gaussian that some pixel of these tiles may draw or stop at.
            Those that stay 0 are hidden or too faint for every pose: leaving them out changes nothing.
        statistics: [threads, 5] blocks, layers, uncertain pairs, blocks where too many pairs were
            uncertain, results that were not numbers.
    """
    for thread in prange(threads):
        _pixel_worker(
            thread, wanted, offsets, entries, record, box, tiles, depth, delta, depth_error, colors, color_radius,
            slope, direction, camera, rules, errors, background, negligible, pair_limit, d, order, m, antialiased,
            threads, lower, upper, linear, statistics, marks,
        )  # fmt: skip
