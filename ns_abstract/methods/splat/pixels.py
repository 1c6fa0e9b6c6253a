"""Per-pixel stage of the bounds: alphas as polynomial forms, blended back to front.

One pass handles a block of `PIXELS` pixels of one tile (design.md, B1-B9). Alphas are found Gaussian by Gaussian,
nearest first, eight pixels at a time, and kept as layers one after the other; each pixel lists those that may
contribute to it. Then each pixel's list is blended from its end, the three channels side by side.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from ns_abstract.arithmetic.compiled import advanced, borrowed, lowest_bit, pointer, prefetch, signed, taken
from ns_abstract.arithmetic.elementary import EXP_RELATIVE_ERROR, exp_kernel, fma
from ns_abstract.arithmetic.lanes import (
    bits,
    load4,
    load8,
    maximum,
    minimum,
    root,
    spans,
    store,
    store_columns,
    where,
)
from ns_abstract.arithmetic.units import UNIT64
from ns_abstract.methods.splat.lists import AHEAD, BLOCK, PIXELS, block_lists, longest_first
from ns_abstract.methods.splat.records import (
    FAINT,
    FORMS,
    KAPPA,
    MEAN_X,
    MEAN_Y,
    OPACITY_HIGH,
    OPACITY_LOW,
    SPREAD,
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
#: List entries that pass the steps of `_forward` together: no step waits for the one before.
_BATCH = 8
#: Pixel q of a block lies in row q >> _ROW_SHIFT; sets of pixels are the bits of an int64.
_ROW_SHIFT = BLOCK.bit_length() - 1
assert PIXELS == 64 and BLOCK == 8

# Scratch is flat: row r holds its lanes at r * PIXELS .. r * PIXELS + PIXELS - 1, one by pixel.
(
    _C1, _C2, _L1, _L2, _B1, _B2, _S0, _SR, _SL, _SB, _SLO, _SHI, _WEIGHT, _CURVE,
    _TLO, _THI, _REACH, _RHO, _LOST, _MIN, _MAX, _NUMBERS,
) = range(0, 22 * PIXELS, PIXELS)  # fmt: skip
_ROWS = 22
#: The set of all of 8 lanes.
_ALL = 255
#: Columns of a layer: bounds of alpha, transmittance behind it at its least and before it at its most, alpha's
#: coefficients and then its radius.
_ALPHA_LOW, _ALPHA_HIGH, _LEFT, _LIGHT, _FORM = range(5)
#: Columns of an entry of a pixel's list: the layer's number, its list position, its row of moves; one is spare.
_LISTED = 4
#: Columns of a row of moves: by how much reordering may lower and raise the pixel, found from sums and from maxima.
_MOVES = 16


@njit(cache=True, error_model="numpy", inline="always")
def _spread(rows, first, last, n, s, out):
    """``s[out + q] = sum over rows [first, last) of |rows|``; inlined so that ``out`` is a constant."""
    for q in range(n):
        s[out + q] = 0.0
    for k in range(first, last):
        for q in range(n):
            s[out + q] += abs(rows[k, q])


@njit(cache=True, error_model="numpy", forceinline=True)
def _alphas(
    record, n, ax, ay, s, y1, y2, poly, rows, layers, given, width, d, order, m, antialiased, sure, rules, errors
):
    """Alpha of one Gaussian on ``n`` pixels of a block (design.md, B1-B4).

    ``record`` is the Gaussian's; ``ax`` and ``ay`` hold the pixels' offsets from the mean. Writes what is known of
    alpha pixel by pixel to ``layers[given : ...]``; ``rows`` [columns of a layer, lanes], flat, and its part ``poly``
    [m, lanes] are scratch. ``sure`` tells whether the Gaussian surely belongs to the tile. Returns the set of those
    of the ``n`` pixels on which alpha may reach the threshold.
    """
    unit = errors[0]
    alpha_min = rules[7] * (1.0 - 2.0 * unit)
    alpha_min_high = rules[7] * (1.0 + 2.0 * unit)
    alpha_max = rules[8]
    opacity_low = record[OPACITY_LOW]
    opacity_high = record[OPACITY_HIGH]
    sigma_max = record[FAINT]
    found = 0
    if record[WILD] != 0.0:
        high = min(opacity_high, alpha_max) * (1.0 + 2.0 * unit)
        if high >= alpha_min:
            for q in range(n):
                _set_unknown(layers, given + q * width, high, m)
            found = -1
    elif d == 1 and order == 2:
        found = _alpha_line(
            record, n, ax, ay, layers, given, sigma_max, opacity_low, opacity_high, alpha_min, alpha_min_high,
            alpha_max, 1.0 if sure else 0.0, unit, antialiased,
        )  # fmt: skip
    else:
        if order == 1:
            _exponent_affine(record, n, ax, ay, s, rows, m, antialiased)
        else:
            _exponent(record, -(-n // 8) * 8, ax, ay, s, y1, y2, poly, d, m, antialiased)
        found = _fit_exponential(
            n, s, rows, opacity_low, opacity_high, record[KAPPA], sigma_max, alpha_min, alpha_min_high, alpha_max,
            1.0 if sure else 0.0, unit, order, m,
        )  # fmt: skip
        if found != 0:
            if order == 2:
                # alpha_q = weight * sigma_q + curve * (linear part of sigma) squared, before sigma's rows are scaled
                row = 1 + d
                for k in range(1, d + 1):
                    for l in range(k, d + 1):
                        factor = 1.0 if l == k else 2.0
                        for q in range(0, n, 8):
                            square = load8(rows, (_FORM + k) * PIXELS + q) * load8(rows, (_FORM + l) * PIXELS + q)
                            at = (_FORM + row) * PIXELS + q
                            curved = load8(s, _WEIGHT + q) * load8(rows, at) + factor * load8(s, _CURVE + q) * square
                            store(rows, at, curved)
                        row += 1
            for k in range(_FORM + 1, _FORM + 1 + d):
                for q in range(0, n, 8):
                    store(rows, k * PIXELS + q, load8(s, _WEIGHT + q) * load8(rows, k * PIXELS + q))
            for q in range(0, n, 8):
                for k in range(0, width, 8):
                    at = k * PIXELS + q
                    store_columns(
                        layers, given + q * width + k, width, load8(rows, at), load8(rows, at + PIXELS),
                        load8(rows, at + 2 * PIXELS), load8(rows, at + 3 * PIXELS), load8(rows, at + 4 * PIXELS),
                        load8(rows, at + 5 * PIXELS), load8(rows, at + 6 * PIXELS), load8(rows, at + 7 * PIXELS),
                    )  # fmt: skip
    # not the lanes in excess
    return signed(found & ((2 << (int(n) - 1)) - 1))


@njit(cache=True, error_model="numpy", forceinline=True)
def _set_unknown(layers, at, high, m):
    """Let the layer at ``at`` have any alpha from 0 to ``high``."""
    layers[at + _ALPHA_LOW] = 0.0
    layers[at + _ALPHA_HIGH] = high
    layers[at + _FORM] = 0.5 * high
    for k in range(1, m):
        layers[at + _FORM + k] = 0.0
    layers[at + _FORM + m] = 0.5 * high * _UP


@njit(cache=True, error_model="numpy", forceinline=True)
def _parabola(slope, bend):
    """Range of +-slope p + bend p^2 over p in [-1, 1], up to rounding, of lanes (design.md, A4)."""
    bottom, top = bend - slope, bend + slope
    # the vertex counts where it lies inside [-1, 1]
    inside = slope < 2.0 * abs(bend)
    if bits(inside) != 0:
        vertex = -0.25 * (slope * slope) / where(bend != 0.0, bend, 1.0)
        bottom = where(inside, minimum(bottom, vertex), bottom)
        top = where(inside, maximum(top, vertex), top)
    return bottom, top


@njit(cache=True, error_model="numpy", inline="always")
def _square_sum_range(c1, c2, e1, e2, k_low, k_high):
    """Bounds of (y1^2 + y2^2)/2 + K for |y - c| <= e, c >= 0 (design.md, B2)."""
    near1 = maximum(0.0, c1 - e1)
    near2 = maximum(0.0, c2 - e2)
    far1 = c1 + e1
    far2 = c2 + e2
    low = fma(0.5 * (1.0 - _ROUND), fma(near1, near1, near2 * near2), k_low)
    return low, fma(0.5, fma(far1, far1, far2 * far2), k_high) * _UP


@njit(cache=True, error_model="numpy", inline="always")
def _curved_radius(c1, c2, l1, l2, b1, b2, r1, r2, s0, k_radius, k_high):
    """Radius of (y1^2 + y2^2)/2 + K of order 2 from the sizes c, l, b, r of the parts of y1 and y2 (design.md, B2)."""
    first = fma(c1, r1, fma(l1 + 0.5 * b1, b1, r1 * (l1 + b1 + 0.5 * r1)))
    second = fma(c2, r2, fma(l2 + 0.5 * b2, b2, r2 * (l2 + b2 + 0.5 * r2)))
    size = fma(c1, l1 + b1 + r1, fma(c2, l2 + b2 + r2, s0)) + k_high
    return (first + second + fma(_ROUND, size, k_radius)) * _UP


@njit(cache=True, error_model="numpy")
def _exponent(record, n, offset_x, offset_y, s, y1, y2, poly, d, m, antialiased):
    """Form sigma = (y1^2 + y2^2)/2 + K of order 2 (design.md, B1-B2).

    Coefficients go into ``poly`` (row 0 unused), centre, radius and bounds into rows _S0, _SR, _SLO, _SHI,
    sums of absolute coefficients into _SL, _SB.
    """
    stride = m + 1
    base = FORMS
    for k in range(m):
        p = record[base + k]
        c = record[base + stride + k]
        g = record[base + 2 * stride + k]
        w1 = record[base + 3 * stride + k]
        w2 = record[base + 4 * stride + k]
        for q in range(n):
            y1[k, q] = p * offset_x[q] - c * offset_y[q] - w1
        for q in range(n):
            y2[k, q] = g * offset_y[q] - w2
    _spread(y1, 1, 1 + d, n, s, _L1)
    _spread(y2, 1, 1 + d, n, s, _L2)
    _spread(y1, 1 + d, m, n, s, _B1)
    _spread(y2, 1 + d, m, n, s, _B2)
    rp = record[base + m] + _ROUND * abs(record[base])
    rc = record[base + stride + m] + _ROUND * abs(record[base + stride])
    rs = record[base + 2 * stride + m] + _ROUND * abs(record[base + 2 * stride])
    rw1 = record[base + 3 * stride + m] + _ROUND * abs(record[base + 3 * stride])
    rw2 = record[base + 4 * stride + m] + _ROUND * abs(record[base + 4 * stride])
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
        k_middle = record[base + 5 * stride]
        k_radius = record[base + 5 * stride + m]
        for k in range(1, m):
            extra = record[base + 5 * stride + k]
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
        ax = abs(offset_x[q])
        ay = abs(offset_y[q])
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
    _add_range(pointer(poly), d, n, s)
    for q in range(n):
        s[_SHI + q] = min(s[_SHI + q], s[_MAX + q])
        s[_SLO + q] = max(s[_SLO + q], s[_MIN + q])


@njit(cache=True, error_model="numpy", forceinline=True)
def _exponent_affine(record, n, offset_x, offset_y, s, rows, m, antialiased):
    """`_exponent` for order 1, eight pixels at a time."""
    stride = m + 1
    p, c, g = record[FORMS], record[FORMS + stride], record[FORMS + 2 * stride]
    w1, w2 = record[FORMS + 3 * stride], record[FORMS + 4 * stride]
    rp = record[FORMS + m] + _ROUND * abs(p)
    rc = record[FORMS + stride + m] + _ROUND * abs(c)
    rs = record[FORMS + 2 * stride + m] + _ROUND * abs(g)
    rw1 = record[FORMS + 3 * stride + m] + _ROUND * abs(w1)
    rw2 = record[FORMS + 4 * stride + m] + _ROUND * abs(w2)
    k_middle, k_radius, k_spread = 0.0, 0.0, 0.0
    if antialiased:
        k_middle = record[FORMS + 5 * stride]
        k_radius = record[FORMS + 5 * stride + m]
        for k in range(1, m):
            k_spread += abs(record[FORMS + 5 * stride + k])
    k_low = max(0.0, k_middle - k_spread - k_radius)
    k_high = abs(k_middle) + k_spread + k_radius
    for q in range(0, n, 8):
        ax = load8(offset_x, q)
        ay = load8(offset_y, q)
        c1 = fma(p, ax, -fma(c, ay, w1))
        c2 = fma(g, ay, -w2)
        l1 = 0.0 * ax
        l2 = 0.0 * ax
        sl = 0.0 * ax
        for k in range(1, m):
            g1 = fma(record[FORMS + k], ax, -fma(record[FORMS + stride + k], ay, record[FORMS + 3 * stride + k]))
            g2 = fma(record[FORMS + 2 * stride + k], ay, -record[FORMS + 4 * stride + k])
            slope = fma(c1, g1, c2 * g2)
            if antialiased:
                slope = slope + record[FORMS + 5 * stride + k]
            store(rows, (_FORM + k) * PIXELS + q, slope)
            l1 = l1 + abs(g1)
            l2 = l2 + abs(g2)
            sl = sl + abs(slope)
        c1 = abs(c1)
        c2 = abs(c2)
        r1 = rp * abs(ax) + rc * abs(ay) + rw1 + _ROUND * l1
        r2 = rs * abs(ay) + rw2 + _ROUND * l2
        s0 = 0.5 * (c1 * c1 + c2 * c2)
        # (g.p)^2 / 2 lies in [0, l^2 / 2]: half centre, half radius
        curve = 0.25 * (l1 * l1 + l2 * l2)
        e1 = l1 + r1
        e2 = l2 + r2
        center = s0 + curve + k_middle
        first = fma(c1, r1, r1 * (l1 + 0.5 * r1))
        second = fma(c2, r2, r2 * (l2 + 0.5 * r2))
        size = fma(c1, e1, fma(c2, e2, s0)) + k_high
        radius = (first + second + (curve + fma(_ROUND, size, k_radius))) * _UP
        low, high = _square_sum_range(c1, c2, e1, e2, k_low, k_high)
        spread = (sl + radius + _ROUND * center) * _UP
        store(s, _S0 + q, center)
        store(s, _SR + q, radius)
        store(s, _SL + q, sl)
        store(s, _SB + q, 0.0 * sl)
        store(s, _SLO + q, maximum(low, center - spread))
        store(s, _SHI + q, minimum(high, center + spread))


@njit(cache=True, error_model="numpy", forceinline=True)
def _alpha_line(
    record, n, offset_x, offset_y, layers, given, sigma_max, opacity_low, opacity_high, alpha_min, alpha_min_high,
    alpha_max, sure, unit, antialiased,
):  # fmt: skip
    """`_exponent` and `_fit_exponential` for one parameter and order 2, eight pixels at a time."""
    p0, p1, p2, pr = record[FORMS], record[FORMS + 1], record[FORMS + 2], record[FORMS + 3]
    c0, c1, c2, cr = record[FORMS + 4], record[FORMS + 5], record[FORMS + 6], record[FORMS + 7]
    g0, g1, g2, gr = record[FORMS + 8], record[FORMS + 9], record[FORMS + 10], record[FORMS + 11]
    v0, v1, v2, vr = record[FORMS + 12], record[FORMS + 13], record[FORMS + 14], record[FORMS + 15]
    w0, w1, w2, wr = record[FORMS + 16], record[FORMS + 17], record[FORMS + 18], record[FORMS + 19]
    pr += _ROUND * abs(p0)
    cr += _ROUND * abs(c0)
    gr += _ROUND * abs(g0)
    vr += _ROUND * abs(v0)
    wr += _ROUND * abs(w0)
    k0, k1, k2, kr = 0.0, 0.0, 0.0, 0.0
    if antialiased:
        k0, k1, k2, kr = record[FORMS + 20], record[FORMS + 21], record[FORMS + 22], record[FORMS + 23]
    k_low = max(0.0, k0 - abs(k1) - abs(k2) - kr)
    k_high = abs(k0) + abs(k1) + abs(k2) + kr
    kappa = record[KAPPA]
    found = 0
    for q in range(0, n, 8):
        ax = load8(offset_x, q)
        ay = load8(offset_y, q)
        y1 = fma(p0, ax, -fma(c0, ay, v0))
        l1 = fma(p1, ax, -fma(c1, ay, v1))
        b1 = fma(p2, ax, -fma(c2, ay, v2))
        y2 = fma(g0, ay, -w0)
        l2 = fma(g1, ay, -w1)
        b2 = fma(g2, ay, -w2)
        linear = fma(y1, l1, fma(y2, l2, k1))
        quadratic = fma(y1, b1, fma(y2, b2, fma(0.5, fma(l1, l1, l2 * l2), k2)))
        s0 = 0.5 * fma(y1, y1, y2 * y2)
        l1 = abs(l1)
        l2 = abs(l2)
        b1 = abs(b1)
        b2 = abs(b2)
        y1 = abs(y1)
        y2 = abs(y2)
        r1 = fma(pr, abs(ax), fma(cr, abs(ay), fma(_ROUND, l1 + b1, vr)))
        r2 = fma(gr, abs(ay), fma(_ROUND, l2 + b2, wr))
        e1 = l1 + b1 + r1
        e2 = l2 + b2 + r2
        radius = _curved_radius(y1, y2, l1, l2, b1, b2, r1, r2, s0, kr, k_high)
        low, high = _square_sum_range(y1, y2, e1, e2, k_low, k_high)
        s0 = s0 + k0
        slope = abs(linear)
        bend = abs(quadratic)
        rounding = _ROUND * (slope + bend + abs(s0))
        bottom, top = _parabola(slope, quadratic)
        low = maximum(low, s0 + bottom - radius - rounding)
        if bits(low > sigma_max) == _ALL:
            # alpha stays below the threshold
            continue
        center, spread, low, high, weight, curve = _fitted_exponential(
            low, minimum(high, s0 + top + radius + rounding), s0, radius, slope, bend, opacity_low, opacity_high,
            kappa, sigma_max, alpha_min, alpha_min_high, alpha_max, sure, unit, 1.0,
        )  # fmt: skip
        store_columns(
            layers, given + 8 * q, 8, low, high, low, high, center, weight * linear,
            fma(weight, quadratic, curve * (linear * linear)), spread,
        )  # fmt: skip
        found |= (_ALL - bits(high < alpha_min)) << q
    return found


@njit(cache=True, error_model="numpy", forceinline=True)
def _add_range(poly, d, n, s):
    """Add the range of the order-2 polynomial's non-constant part to rows _MIN and _MAX (design.md, A4)."""
    for q in range(0, n, 8):
        bottom, top = load8(s, _MIN + q), load8(s, _MAX + q)
        row = 1 + d
        for k in range(1, d + 1):
            low, high = _parabola(abs(load8(poly, k * PIXELS + q)), load8(poly, row * PIXELS + q))
            bottom, top = bottom + low, top + high
            row += 1
            for _ in range(k + 1, d + 1):
                mixed = abs(load8(poly, row * PIXELS + q))
                bottom, top = bottom - mixed, top + mixed
                row += 1
        store(s, _MIN + q, bottom)
        store(s, _MAX + q, top)


@njit(cache=True, error_model="numpy", forceinline=True)
def _fitted_exponential(
    s_low, s_high, s0, s_radius, l, b, opacity_low, opacity_high, kappa, sigma_max, alpha_min, alpha_min_high,
    alpha_max, sure, unit, quadratic,
):  # fmt: skip
    """Form alpha = opacity exp(-sigma) with its thresholds (design.md, B3-B4), of lanes.

    Takes bounds, centre and radius of sigma and the sums of its absolute coefficients of first and second order;
    ``quadratic`` is 1 for forms of order 2. Returns alpha's centre, radius and bounds, and the factors that turn
    sigma's coefficients into alpha's.
    """
    opacity = 0.5 * (opacity_low + opacity_high)
    opacity_spread = 0.5 * (opacity_high - opacity_low) * _UP + _ROUND * opacity
    low = minimum(maximum(0.0, s_low * (1.0 - kappa)), _EXPONENT_LIMIT)
    high = maximum(low, s_high * (1.0 + kappa))
    # float evaluation moves the exponent by kappa
    sr = s_radius + kappa * minimum(high, 4.0 * _EXPONENT_LIMIT)
    width = 0.5 * (high - low) * _UP
    half = minimum(width, _FIT_LIMIT)
    fits = where(width < _FIT_LIMIT, 1.0, 0.0)
    e_low = exp_kernel(-low)
    e_half = exp_kernel(-half)
    slack = (30.0 + 3.0 * low + 6.0 * half) * unit + 4.0 * EXP_RELATIVE_ERROR
    a_high = opacity_high * e_low * (1.0 + slack)
    a_low = fits * (opacity_low * e_low * (e_half * e_half) * (1.0 - slack))
    # exp(-t) = k0 - k1 t + k2 t^2 +- fit over |t| <= half (design.md, B3)
    h = 0.5 * half
    x = h * h
    x2 = x * x
    i0 = fma(x, fma(x, fma(x, fma(x, 1.0 / 576.0, 1.0 / 36.0), 0.25), 1.0), 1.0)
    k1 = fma(x, fma(x, fma(x, fma(x, 1.0 / 2880.0, 1.0 / 144.0), 1.0 / 12.0), 0.5), 1.0)
    j2 = fma(x, fma(x, fma(x, fma(x, 1.0 / 17280.0, 1.0 / 720.0), 1.0 / 48.0), 1.0 / 6.0), 0.5)
    fit = (h * x) * (1.0 / 3.0) * fma(x, fma(x, 1.0 / 24.0, 0.25), 1.0) * fma(x, 1.0 / 15.0, fma(h, 0.25, 1.0))
    fit = fma(1.2e-4 * x, x2 * x2, fma(1.0 - quadratic, 2.0 * x * j2, fit))
    k0 = i0 - quadratic * (2.0 * x * j2)
    k2 = quadratic * j2
    t0 = s0 - (low + half)
    scale = opacity * (e_low * e_half)
    weight = fma(2.0 * k2, t0, -k1)
    spread = sr + l + b
    size = fma(abs(t0), 4.0 + abs(t0), fma(spread, 1.0 + spread, 4.0))
    bent = fma(b, fma(2.0, l, b), sr * fma(2.0, l + b, sr))
    error = fma(abs(weight), sr, fma(k2, bent, fma(_ROUND + 2.0 * EXP_RELATIVE_ERROR, size, fit)))
    radius = fma(scale, error, 1.01 * e_low * fma(opacity_high, slack, opacity_spread))
    center = scale * fma(t0, fma(k2, t0, -k1), k0)
    # alpha_max
    excess = maximum(0.0, a_high - alpha_max)
    a_high = minimum(a_high, alpha_max * (1.0 + 2.0 * unit))
    a_low = minimum(a_low, alpha_max * (1.0 - 2.0 * unit))
    # alpha_min: below it the layer is skipped
    skips = a_low < alpha_min_high
    jump = where(skips, minimum(alpha_min_high, a_high), 0.0)
    center = center - 0.5 * (excess + jump)
    radius = fma(0.5, excess + jump, radius) * _UP
    a_low = where(skips, 0.0, sure * a_low)
    # gone where it cannot reach the threshold
    gone = (a_high < alpha_min) | (low > sigma_max)
    a_high = where(gone, 0.0, a_high)
    a_low = where(gone, 0.0, a_low)
    flat = 0.5 * (a_high - a_low)
    keep = where(radius < flat, fits * sure, 0.0)
    center = where(keep == 1.0, center, 0.5 * (a_high + a_low))
    radius = where(keep == 1.0, radius, flat * _UP)
    return center, radius, a_low, a_high, keep * (scale * weight), keep * (scale * k2)


@njit(cache=True, error_model="numpy", forceinline=True)
def _fit_exponential(
    n, s, rows, opacity_low, opacity_high, kappa, sigma_max, alpha_min, alpha_min_high, alpha_max, sure, unit, order, m
):
    """`_fitted_exponential` from rows of ``s`` to those of a layer's columns.

    Factors go to rows _WEIGHT, _CURVE. Returns the set of lanes on which alpha may reach the threshold.
    """
    quadratic = 1.0 if order == 2 else 0.0
    found = 0
    for q in range(0, n, 8):
        center, radius, low, high, weight, curve = _fitted_exponential(
            load8(s, _SLO + q), load8(s, _SHI + q), load8(s, _S0 + q), load8(s, _SR + q), load8(s, _SL + q),
            load8(s, _SB + q), opacity_low, opacity_high, kappa, sigma_max, alpha_min, alpha_min_high, alpha_max,
            sure, unit, quadratic,
        )  # fmt: skip
        store(rows, _ALPHA_LOW * PIXELS + q, low)
        store(rows, _ALPHA_HIGH * PIXELS + q, high)
        store(rows, _FORM * PIXELS + q, center)
        store(rows, (_FORM + m) * PIXELS + q, radius)
        store(s, _WEIGHT + q, weight)
        store(s, _CURVE + q, curve)
        found |= (_ALL - bits(high < alpha_min)) << q
    return found


# what a block may answer in place of a number of pairs
_GIVE_UP = -1
_GROW = -2


@njit(cache=True, error_model="numpy", forceinline=True)
def _uncertain(i, j, delta, depth_error, slope, m):
    """Whether the depth order of Gaussians i and j is not the same over the whole cell (design.md, O1).

    ``slope`` [rows, 3], flat, is the third row of the rotation: depths differ by ``slope . (delta_i - delta_j)``.
    """
    x = delta[3 * i] - delta[3 * j]
    y = delta[3 * i + 1] - delta[3 * j + 1]
    z = delta[3 * i + 2] - delta[3 * j + 2]
    center = slope[0] * x + slope[1] * y + slope[2] * z
    spread = 0.0
    for k in range(1, m):
        spread += abs(slope[3 * k] * x + slope[3 * k + 1] * y + slope[3 * k + 2] * z)
    size = abs(delta[3 * i]) + abs(delta[3 * j]) + abs(delta[3 * i + 1]) + abs(delta[3 * j + 1])
    size += abs(delta[3 * i + 2]) + abs(delta[3 * j + 2])
    rounding = _ROUND * size * 2.0
    radius = slope[3 * m] * abs(x) + slope[3 * m + 1] * abs(y) + slope[3 * m + 2] * abs(z)
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


@njit(cache=True, error_model="numpy")
def _reached(record, ox, oy, left, right, top, bottom, m, s):
    """The set of pixels of a range where the exponent may stay low enough for the threshold.

    Row by row, sigma >= (near1^2 + near2^2)/2 bounds the columns, where near1 and near2 are what the forms' spread
    leaves of |y1| and |y2| (design.md, B2). (ox, oy) is the offset of the block's first pixel from the mean.
    """
    inside = ((2 << (bottom * BLOCK + BLOCK - 1)) - 1) & ~((1 << (top * BLOCK)) - 1)
    wild = record[WILD] != 0.0
    p, c, g, w1, w2 = 0.0, 0.0, 0.0, 0.0, 0.0
    spread1, spread2 = np.inf, np.inf
    if not wild:
        stride = m + 1
        p = record[FORMS]
        c = record[FORMS + stride]
        g = record[FORMS + 2 * stride]
        w1 = record[FORMS + 3 * stride]
        w2 = record[FORMS + 4 * stride]
        x = max(abs(ox + left), abs(ox + right))
        y = max(abs(oy + top), abs(oy + bottom))
        spread1 = (record[SPREAD] * x + record[SPREAD + 1] * y + record[SPREAD + 3]) * _ROOM
        spread2 = (record[SPREAD + 2] * y + record[SPREAD + 4]) * _ROOM
    # without a bound on the columns the whole rows are taken
    numbers = load8(s, _NUMBERS)
    start = float(left) + 0.0 * numbers
    stop = float(right) + 0.0 * numbers
    if p > 0.0 and spread1 < np.inf and spread2 < np.inf:
        inverse = 1.0 / p
        ay = oy + numbers
        near = maximum(0.0, abs(g * ay - w2) - spread2)
        rest = 2.0 * record[FAINT] * _ROOM - near * near * (2.0 - _ROOM)
        half = (root(maximum(rest, 0.0)) + spread1) * inverse * _ROOM
        center = (c * ay + w1) * inverse - ox
        slack = (_ROOM - 1.0) * (abs(center) + abs(ox) + half)
        start = maximum(start, center - half - slack)
        stop = where(rest >= 0.0, minimum(stop, center + half + slack), -1.0)
    return spans(minimum(float(BLOCK), start), maximum(-1.0, stop)) & inside


@njit(cache=True, error_model="numpy")
def _pixels_of(record, box, x0, y0, m, s):
    """The set of a block's pixels on which a Gaussian may reach the threshold."""
    left = int(math.ceil(min(max(box[0] - 0.5 - x0, 0.0), float(BLOCK))))
    right = int(math.floor(min(max(box[1] - 0.5 - x0, -1.0), BLOCK - 1.0)))
    top = int(math.ceil(min(max(box[2] - 0.5 - y0, 0.0), float(BLOCK))))
    bottom = int(math.floor(min(max(box[3] - 0.5 - y0, -1.0), BLOCK - 1.0)))
    if top > bottom or left > right:
        return 0
    ox, oy = x0 + 0.5 - record[MEAN_X], y0 + 0.5 - record[MEAN_Y]
    return signed(_reached(record, ox, oy, left, right, top, bottom, m, s))


@njit(cache=True, error_model="numpy", forceinline=True)
def _pixels_once(k, entries, record, columns, box, x0, y0, m, s, masks, asked):
    """`_pixels_of` list position k, found when first asked for; ``asked`` [entries] starts as 0."""
    if asked[k] == 0:
        asked[k] = 1
        i = entries[k]
        masks[k] = _pixels_of(advanced(record, i * columns), advanced(box, 4 * i), x0, y0, m, s)
    return masks[k]


@njit(cache=True, error_model="numpy")
def _pixels_at(lanes, pixels):
    """The set of the pixels in ``lanes``."""
    found = 0
    while lanes != 0:
        found |= 1 << int(pixels[lowest_bit(lanes)])
        lanes &= lanes - 1
    return signed(found)


@njit(cache=True, error_model="numpy", forceinline=True)
def _find_pairs(
    k, found, pixels, entries, length, record, columns, box, x0, y0, s, masks, asked, deep, delta, depth_error, slope,
    m, reach, room, largest, farthest, far, far_count, first, last, pairs, pair_limit, count,
):  # fmt: skip
    """Append the pairs (k, later entry) that share a pixel and are of uncertain order; widen ``first``, ``last``.

    ``pixels`` in the lanes ``found`` are k's; ``masks`` and ``asked`` are those of `_pixels_once`. Returns the number
    of pairs, or -1 where ``pairs`` is full.
    """
    i = entries[k]
    shown = 0
    beyond = length
    window = reach[k] + largest
    # those within the window, then those that reach far
    other = k
    f = 0
    within = True
    while True:
        if within:
            other += 1
            if other >= length or (deep[other] - deep[k]) * room > window:
                within = False
                beyond = other
                continue
        else:
            while f < far_count and far[f] < beyond:
                f += 1
            if f >= far_count:
                break
            other = far[f]
            f += 1
            if (deep[other] - deep[k]) * room > reach[k] + farthest:
                break
        if (deep[other] - deep[k]) * room > reach[k] + reach[other]:
            continue
        if shown == 0:
            shown = _pixels_at(found, pixels)
        theirs = _pixels_once(other, entries, record, columns, box, x0, y0, m, s, masks, asked)
        if shown & int(theirs) == 0 or not _uncertain(i, entries[other], delta, depth_error, slope, m):
            continue
        if count >= pair_limit:
            return -1
        pairs[2 * count] = k
        pairs[2 * count + 1] = other
        last[k] = max(last[k], other)
        first[other] = min(first[other], k)
        count += 1
    return count


@njit(cache=True, error_model="numpy")
def _still_live(found, pixels, live):
    """Those lanes of ``found`` whose pixel is in ``live``."""
    left = 0
    while found != 0:
        lane = lowest_bit(found)
        found &= found - 1
        if live & (1 << int(pixels[lane])) != 0:
            left |= 1 << lane
    return left


@njit(cache=True, error_model="numpy")
def _keep_drawn(
    found, pixels, first_layer, k, layers, width, s, lengths, lists, deepest, stop_high, shrink, grow
):  # fmt: skip
    """Keep the layers of a Gaussian whose place is certain in those lanes of ``found`` that no stop can hide.

    Lane b is layer number ``first_layer + b`` on the pixel ``pixels[b]``. Returns the other lanes.
    """
    rest = 0
    while found != 0:
        lane = lowest_bit(found)
        found &= found - 1
        q = int(pixels[lane])
        number = first_layer + lane
        at = number * width
        t_low = s[_TLO + q] * (1.0 - layers[at + _ALPHA_HIGH]) * shrink
        if not t_low > stop_high:
            rest |= 1 << lane
            continue
        before = s[_THI + q]
        count = lengths[q]
        layers[at + _LEFT] = t_low
        layers[at + _LIGHT] = before
        s[_TLO + q] = t_low
        s[_THI + q] = before * (1.0 - layers[at + _ALPHA_LOW]) * grow
        entry = _LISTED * (q * deepest + count)
        lists[entry] = number
        lists[entry + 1] = k
        lists[entry + 2] = 0
        lengths[q] = count + 1
    return rest


@njit(cache=True, error_model="numpy")
def _forward(
    entries_, record_, box_, tiles_, tile_x, tile_y, colors_, palette_, depth_, delta_, depth_error_, slope_, ray,
    s_, y1, y2, poly, rows_, layers_, width, offset_x, offset_y, pixels_, batch_, masks_, asked_, lists_, lengths_,
    reach_, deep_, far_, first_, last_, slots_, owners_, drawn_, places_, moves_, pairs_, x0, y0, d, order, m,
    antialiased, rules, errors, marks_,
):  # fmt: skip
    """Collect the layers of every pixel, nearest first (design.md, B5-B6).

    ``layers`` receives layer after layer, ``width`` numbers each; ``lists[q, e]`` the number of pixel q's layer e
    there, its list position and its row of ``moves`` (0: its order is certain; the others are set to 0).
    ``first[k] <= k <= last[k]`` become the list positions whose depth order against entry k is uncertain, ``pairs``
    [., 2] all such pairs, ``slots[k]`` numbers the entries that take part in one (-1: it does not) and ``owners``
    leads back; the set ``drawn`` holds a slot's pixels and ``places`` its place in their lists. Returns the number of
    pairs and of slots; or _GIVE_UP where more pairs are uncertain than ``pairs`` may hold, or _GROW where another
    buffer is too small.

    Row _RHO of ``s`` receives how much transmittance may be lost to a stop that the kept layers ignore;
    ``marks`` is set for the entries that some pixel that takes light may draw, or stop at; ``palette`` receives
    their colours. ``batch`` [2, entries], ``masks`` and ``asked`` are scratch, and so are ``offset_x``, ``offset_y``
    and ``pixels``, by pixel of a batch.
    """
    entries, record, box, tiles = pointer(entries_), pointer(record_), pointer(box_), pointer(tiles_)
    colors, palette, delta = pointer(colors_), pointer(palette_), pointer(delta_)
    depth_error, slope, s, rows = pointer(depth_error_), pointer(slope_), pointer(s_), pointer(rows_)
    layers, ax, ay, pixels = pointer(layers_), pointer(offset_x), pointer(offset_y), pointer(pixels_)
    begins, hits, masks, asked = pointer(batch_[0]), pointer(batch_[1]), pointer(masks_), pointer(asked_)
    lists, lengths, reach, deep = pointer(lists_), pointer(lengths_), pointer(reach_), pointer(deep_)
    far, first, last, slots = pointer(far_), pointer(first_), pointer(last_), pointer(slots_)
    owners, drawn, places, moves = pointer(owners_), pointer(drawn_), pointer(places_), pointer(moves_)
    pairs, marks = pointer(pairs_), pointer(marks_)
    length, columns, color_columns = entries_.size, record_.shape[1], colors_.shape[1]
    deepest, slot_limit, pair_limit = lists_.shape[1], drawn_.size, pairs_.shape[0]
    unit = errors[0]
    stop = rules[9]
    stop_low = stop * (1.0 - 8.0 * unit)
    stop_high = stop * (1.0 + 8.0 * unit)
    # two roundings of the running transmittance
    shrink, grow = 1.0 - 8.0 * unit, 1.0 + 8.0 * unit
    capacity = layers_.size // width
    move_limit = moves_.shape[0]
    color_rows = color_columns // 3
    for q in range(PIXELS):
        s[_TLO + q] = 1.0
        s[_THI + q] = 1.0
        s[_REACH + q] = -1.0
        s[_RHO + q] = 0.0
        s[_LOST + q] = 0.0
        lengths[q] = 0
    room, largest = _depth_reach(entries_, depth_, delta_, depth_error_, slope_, ray, m, reach_, deep_)
    if not room > 0.0:
        return _GIVE_UP, 0
    far_count = 0
    farthest = 0.0
    for k in range(length):
        first[k] = k
        last[k] = k
        slots[k] = -1
        asked[k] = 0
        if reach[k] > largest:
            far[far_count] = k
            far_count += 1
            farthest = max(farthest, reach[k])
    pair_count = 0
    slot_count = 0
    # row 0 is for layers that do not move
    for r in range(_MOVES):
        moves[r] = 0.0
    move_count = 1
    live = -1
    # pixels that take no light behind the layers whose place is still open
    dim = 0
    used = 0
    for start in range(0, length, _BATCH):
        some = min(_BATCH, length - start)
        begun = live
        # which pixels: only those that the Gaussian may reach and that still take light
        for b in range(some):
            ahead = entries[min(start + b + _BATCH, length - 1)]
            prefetch(box_, ahead, 0)
            prefetch(tiles_, ahead, 0)
            for byte in range(0, 8 * columns, 64):
                prefetch(record_, ahead, byte)
            prefetch(record_, ahead, 8 * columns - 8)
            for byte in range(0, 8 * color_columns, 64):
                prefetch(colors_, ahead, byte)
            _pixels_once(start + b, entries, record, columns, box, x0, y0, m, s, masks, asked)
        end = 0
        for b in range(some):
            i = entries[start + b]
            row = advanced(record, i * columns)
            ox, oy = x0 + 0.5 - row[MEAN_X], y0 + 0.5 - row[MEAN_Y]
            mask = live & masks[start + b]
            begins[b] = end
            while mask != 0:
                q = lowest_bit(mask)
                mask &= mask - 1
                pixels[end] = q
                ax[end] = ox + (q & (BLOCK - 1))
                ay[end] = oy + (q >> _ROW_SHIFT)
                end += 1
        begins[some] = end
        # eight at a time, some in excess
        if used + end + 8 > capacity:
            return _GROW, 0
        longest = 0
        for q in range(PIXELS):
            longest = max(longest, int(lengths[q]))
        if longest + some > deepest:
            return _GROW, 0
        for b in range(some):
            i = entries[start + b]
            begin = begins[b]
            n = begins[b + 1] - begin
            hits[b] = 0
            if n > 0:
                core = advanced(tiles, 8 * i + 4)
                sure = core[0] <= tile_x and tile_x < core[1] and core[2] <= tile_y and tile_y < core[3]
                hits[b] = _alphas(
                    advanced(record, i * columns), n, advanced(ax, begin), advanced(ay, begin), s, y1, y2, poly, rows,
                    layers, (used + begin) * width, width, d, order, m, antialiased, sure, rules, errors,
                )  # fmt: skip
        for b in range(some):
            found = hits[b]
            begin = begins[b]
            if live != begun:
                found = _still_live(found, advanced(pixels, begin), live)
            if found == 0:
                continue
            k = start + b
            i = entries[k]
            pair_count = _find_pairs(
                k, found, advanced(pixels, begin), entries, length, record, columns, box, x0, y0, s, masks, asked, deep,
                delta, depth_error, slope, m, reach, room, largest, farthest, far, far_count, first, last, pairs,
                pair_limit, pair_count,
            )  # fmt: skip
            if pair_count < 0:
                return _GIVE_UP, 0
            alone = first[k] == k and last[k] == k
            if not alone:
                if slot_count >= slot_limit:
                    return _GROW, 0
                slots[k] = slot_count
                owners[slot_count] = k
                drawn[slot_count] = 0
                slot_count += 1
            # threads share these bytes: written no more than once each
            if marks[i] == 0:
                marks[i] = 1
            _set_colors(palette, k, advanced(colors, i * color_columns), color_rows)
            if alone:
                found = _keep_drawn(
                    found, advanced(pixels, begin), used + begin, k, layers, width, s, lengths, lists, deepest,
                    stop_high, shrink, grow,
                )  # fmt: skip
            while found != 0:
                lane = begin + lowest_bit(found)
                found &= found - 1
                q = int(pixels[lane])
                at = (used + lane) * width
                low = layers[at + _ALPHA_LOW]
                high = layers[at + _ALPHA_HIGH]
                before = s[_THI + q]
                t_low = s[_TLO + q] * (1.0 - high) * shrink
                t_high = before * (1.0 - low) * grow
                if alone and t_high <= stop_low:
                    # surely the stop: neither this layer nor any behind it is drawn
                    live = signed(live & ~(1 << q))
                    continue
                count = lengths[q]
                if alone and t_low <= stop_high:
                    # s[_LOST] is the most that any stop so far may leave of the light
                    s[_LOST + q] = max(s[_LOST + q], min(before, stop_high / (1.0 - high)))
                    if s[_LOST + q] >= before:
                        _set_unknown(layers, at, high, m)
                    else:
                        s[_RHO + q] = s[_LOST + q]
                layers[at + _LEFT] = t_low
                layers[at + _LIGHT] = before
                entry = _LISTED * (q * deepest + count)
                lists[entry] = used + lane
                lists[entry + 1] = k
                lists[entry + 2] = 0
                lengths[q] = count + 1
                s[_TLO + q] = t_low
                s[_THI + q] = t_high
                if t_high <= stop_low:
                    dim = signed(dim | (1 << q))
                if not alone:
                    if move_count >= move_limit:
                        return _GROW, 0
                    lists[entry + 2] = move_count
                    for r in range(_MOVES * move_count, _MOVES * (move_count + 1), 8):
                        store(moves, r, 0.0 * load8(s, _NUMBERS))
                    move_count += 1
                    drawn[slots[k]] = signed(int(drawn[slots[k]]) | (1 << q))
                    places[slots[k] * PIXELS + q] = count
                    # layers up to the last one whose order is uncertain may still come first
                    s[_REACH + q] = max(s[_REACH + q], float(last[k]))
            some_dim = dim & live
            while some_dim != 0:
                q = lowest_bit(some_dim)
                some_dim &= some_dim - 1
                if s[_REACH + q] <= k:
                    live = signed(live & ~(1 << q))
        if live == 0:
            break
        used += end
    return pair_count, slot_count


@njit(cache=True, error_model="numpy")
def _settle_stops(
    layers_, width, lists_, lengths, first_, last_, owners_, drawn_, places_, slot_count, s_, m, stop, unit
):
    """Drop or weaken the layers of uncertain depth order that the stop may hide (design.md, B6)."""
    layers, lists, first, last = pointer(layers_), pointer(lists_), pointer(first_), pointer(last_)
    owners, drawn, places, s = pointer(owners_), pointer(drawn_), pointer(places_), pointer(s_)
    deepest = lists_.shape[1]
    stop_low = stop * (1.0 - 8.0 * unit)
    stop_high = stop * (1.0 + 8.0 * unit)
    # the stop is out of reach of most pixels
    dark = 0
    for q in range(PIXELS):
        s[_C1 + q] = 0.0
        if not s[_TLO + q] > stop_high:
            dark |= 1 << q
    if dark == 0:
        return
    for slot in range(slot_count):
        k = owners[slot]
        some = drawn[slot]
        while some != 0:
            q = lowest_bit(some)
            some &= some - 1
            if dark & (1 << q) == 0:
                continue
            start = q * deepest
            e = start + int(places[slot * PIXELS + q])
            behind = e
            while behind + 1 < start + int(lengths[q]) and int(lists[_LISTED * (behind + 1) + 1]) <= last[k]:
                behind += 1
            t_low = layers[int(lists[_LISTED * behind]) * width + _LEFT]
            if t_low > stop_high:
                continue
            before = e
            while before > start and int(lists[_LISTED * (before - 1) + 1]) >= first[k]:
                before -= 1
            light = layers[int(lists[_LISTED * before]) * width + _LIGHT]
            at = int(lists[_LISTED * e]) * width
            t_high = light * (1.0 - layers[at + _ALPHA_LOW]) * (1.0 + 8.0 * unit)
            # the most light that a stop at this layer may leave
            high = layers[at + _ALPHA_HIGH]
            lost = min(light, stop_high / (1.0 - high))
            if t_high <= stop_low:
                s[_C1 + q] = max(s[_C1 + q], lost)
                _set_unknown(layers, at, 0.0, m)
            elif lost < light:
                # kept; what the stop may leave of the light is added at the end
                s[_RHO + q] = max(s[_RHO + q], lost, s[_LOST + q])
            else:
                s[_C1 + q] = max(s[_C1 + q], lost)
                _set_unknown(layers, at, high, m)
    # a stop at a dropped or weakened layer also hides the kept layers behind it
    for q in range(PIXELS):
        if s[_RHO + q] > 0.0:
            s[_RHO + q] = max(s[_RHO + q], s[_C1 + q])


@njit(cache=True, error_model="numpy", inline="always")
def _color_size(forms):
    """Numbers of one colour of the palette."""
    return 4 * (forms + 3)


@njit(cache=True, error_model="numpy", inline="always")
def _ends(forms):
    """Where in a colour of the palette its lower bound stands, before its upper one."""
    return 4 * (forms + 1)


@njit(cache=True, error_model="numpy", forceinline=True)
def _set_colors(palette, k, color, color_rows):
    """Write the colour of list position k: centre, slopes, radius, then its lower and upper bound over the cell.

    Each is four numbers: three channels and one of none.
    """
    forms = max(color_rows - 1, 1)
    at = k * _color_size(forms)
    for channel in range(3):
        start = channel * color_rows
        spread = 0.0
        for r in range(1, color_rows):
            spread += abs(color[start + r])
        spread *= _UP
        for r in range(forms):
            palette[at + 4 * r + channel] = color[start + r]
        palette[at + 4 * forms + channel] = color[start + forms] if color_rows > 1 else 0.0
        palette[at + _ends(forms) + channel] = color[start] - spread
        palette[at + _ends(forms) + 4 + channel] = color[start] + spread


@njit(cache=True, error_model="numpy", forceinline=True)
def _listed_layer(lists, entry, width, forms):
    """Where a pixel's layer stands, its colour in the palette and its row of moves (0: none)."""
    at = _LISTED * entry
    return int(lists[at]) * width, int(lists[at + 1]) * _color_size(forms), _MOVES * int(lists[at + 2])


@njit(cache=True, error_model="numpy")
def _swap_bounds(
    pairs_, pair_count, slots_, slot_count, drawn_, places_, layers_, width, lists_, palette_, forms, moves_
):  # fmt: skip
    """Bound what reordering may change when a layer joins the layers behind it (design.md, O2).

    The first half of its row of ``moves`` becomes how much three channels, and one of none, may fall, then rise.
    """
    pairs, slots, drawn, places = pointer(pairs_), pointer(slots_), pointer(drawn_), pointer(places_)
    layers, lists, palette, moves = pointer(layers_), pointer(lists_), pointer(palette_), pointer(moves_)
    deepest = lists_.shape[1]
    for p in range(pair_count):
        k, other = pairs[2 * p], pairs[2 * p + 1]
        front, back = slots[k], slots[other]
        if front < 0 or back < 0:
            continue
        both = drawn[front] & drawn[back]
        if both == 0:
            continue
        # bounds of the colours
        e, f = k * _color_size(forms) + _ends(forms), other * _color_size(forms) + _ends(forms)
        falls = maximum(0.0, load4(palette, e + 4) - load4(palette, f))
        rises = maximum(0.0, load4(palette, f + 4) - load4(palette, e))
        while both != 0:
            q = lowest_bit(both)
            both &= both - 1
            at, _, _ = _listed_layer(lists, q * deepest + int(places[back * PIXELS + q]), width, forms)
            _, _, move = _listed_layer(lists, q * deepest + int(places[front * PIXELS + q]), width, forms)
            alpha = layers[at + _ALPHA_HIGH]
            store(moves, move, fma(alpha, falls, load4(moves, move)))
            store(moves, move + 4, fma(alpha, rises, load4(moves, move + 4)))
            store(moves, move + 8, maximum(load4(moves, move + 8), falls))
            store(moves, move + 12, maximum(load4(moves, move + 12), rises))
    # one rounding by pair
    up = _UP + 2.0 * UNIT64 * pair_count
    for slot in range(slot_count):
        some = drawn[slot]
        while some != 0:
            q = lowest_bit(some)
            some &= some - 1
            at, _, move = _listed_layer(lists, q * deepest + int(places[slot * PIXELS + q]), width, forms)
            # the weights of the layers it may move behind add up to at most one
            store(moves, move, layers[at + _ALPHA_HIGH] * minimum(load8(moves, move), load8(moves, move + 8)) * up)


@njit(cache=True, error_model="numpy", forceinline=True)
def _blend_interval(low, high, darkest, brightest, layers, at, palette, ends):
    """One layer over the interval [low, high] (design.md, B7); also the range of the colours so far."""
    a_low, a_high = layers[at + _ALPHA_LOW], layers[at + _ALPHA_HIGH]
    c_low, c_high = load4(palette, ends), load4(palette, ends + 4)
    v = c_low - low
    low = fma(where(v < 0.0, a_high, a_low), v, low)
    v = c_high - high
    high = fma(where(v > 0.0, a_high, a_low), v, high)
    return low, high, minimum(darkest, c_low), maximum(brightest, c_high)


@njit(cache=True, error_model="numpy")
def _sort(keys, order, count):
    """Sort the first ``count`` of ``keys``, least first; ``order`` receives where each stood."""
    for e in range(count):
        order[e] = e
    # by insertion, after sorting what lies far apart: most groups are small
    step = 1
    while step < count // 3:
        step = 3 * step + 1
    while step > 0:
        for e in range(step, count):
            key, place = keys[e], order[e]
            other = e
            while other >= step and keys[other - step] > key:
                keys[other], order[other] = keys[other - step], order[other - step]
                other -= step
            keys[other], order[other] = key, place
        step //= 3


@njit(cache=True, error_model="numpy")
def _interval_chain(
    layers, width, lists, palette, forms, moves, low, high, darkest, brightest, start, stop, t, keys, order
):
    """One step of the interval blend for list entries [start, stop) whose order is uncertain (design.md, O2-O4).

    Returns the tighter of the swap, hull and antichain bounds, and the range of the colours so far; ``t``, ``keys`` and
    ``order`` are scratch.
    """
    store(t, 8, low)
    store(t, 12, high)
    for entry in range(stop - 1, start - 1, -1):
        at, key, move = _listed_layer(lists, entry, width, forms)
        ends = key + _ends(forms)
        a_high = layers[at + _ALPHA_HIGH]
        # wherever it goes among the layers behind, it moves the colour by at most its alpha times
        # the distance to the darkest or brightest of what lies behind
        hull_low = fma(a_high, minimum(0.0, load4(palette, ends) - brightest), low)
        hull_high = fma(a_high, maximum(0.0, load4(palette, ends + 4) - darkest), high)
        low, high, darkest, brightest = _blend_interval(low, high, darkest, brightest, layers, at, palette, ends)
        hull_low, hull_high = minimum(low, hull_low), maximum(high, hull_high)
        low = maximum(low - load4(moves, move), hull_low)
        high = minimum(high + load4(moves, move + 4), hull_high)
    store(t, 0, low)
    store(t, 4, high)
    count = stop - start
    for channel in range(3):
        for side in range(2):
            for e in range(count):
                _, key, _ = _listed_layer(lists, start + e, width, forms)
                ends = key + _ends(forms) + channel
                keys[e] = palette[ends] if side == 0 else -palette[ends + 4]
            _sort(keys, order, count)
            value = t[8 + 4 * side + channel]
            # nearest first: darkest for the lower bound, brightest for the upper one
            for position in range(count - 1, -1, -1):
                at, _, _ = _listed_layer(lists, start + order[position], width, forms)
                color = keys[position] if side == 0 else -keys[position]
                v = color - value
                grows = v < 0.0 if side == 0 else v > 0.0
                value += layers[at + (_ALPHA_HIGH if grows else _ALPHA_LOW)] * v
            if side == 0:
                t[channel] = max(t[channel], value)
            else:
                t[4 + channel] = min(t[4 + channel], value)
    return load4(t, 0), load4(t, 4), darkest, brightest


@njit(cache=True, error_model="numpy")
def _sharpened(
    low, high, form_low, form_high, layers, width, lists, palette, forms, begin, end, moves, chain, background, t, keys,
    order,
):  # fmt: skip
    """Interval [low, high] of a pixel whose layers' depth orders are uncertain, sharpened where that may pay (O4).

    The list entries of the pixel are [begin, end); ``form_low`` and ``form_high`` are its bounds by the forms;
    ``chain[k]`` numbers the groups; ``t``, ``keys`` and ``order`` are scratch.
    """
    falls = 0.0 * low
    rises = falls
    for entry in range(begin, end):
        at, _, move = _listed_layer(lists, entry, width, forms)
        if move != 0:
            light = layers[at + _LIGHT]
            falls = fma(light, load4(moves, move), falls)
            rises = fma(light, load4(moves, move + 4), rises)
    # how much of what reordering moves may be won back, where the forms are not tighter anyhow
    gain = maximum(minimum(falls, low + falls - form_low), minimum(rises, form_high - (high - rises)))
    if bits(gain > _REORDERING_MATTERS) == 0:
        return low, high
    value_low = load4(background, 0)
    value_high = value_low
    darkest = value_low
    brightest = value_low
    stop = end
    while stop > begin:
        start = stop - 1
        group = chain[int(lists[_LISTED * start + 1])]
        while start > begin and chain[int(lists[_LISTED * (start - 1) + 1])] == group:
            start -= 1
        if stop - start == 1:
            at, key, _ = _listed_layer(lists, start, width, forms)
            value_low, value_high, darkest, brightest = _blend_interval(
                value_low, value_high, darkest, brightest, layers, at, palette, key + _ends(forms)
            )
        else:
            value_low, value_high, darkest, brightest = _interval_chain(
                layers, width, lists, palette, forms, moves, value_low, value_high, darkest, brightest, start, stop, t,
                keys, order,
            )  # fmt: skip
        stop = start
    return maximum(low, value_low), minimum(high, value_high)


@njit(cache=True, error_model="numpy", forceinline=True)
def _blend_line(layers, width, lists, palette, forms, begin, end, moves, background, t):
    """Blend the list entries [begin, end) of a pixel back to front, as forms and as intervals (design.md, B7).

    For one parameter and order 2. Lanes are the channels; ``background`` [4] and ``palette`` (`_set_colors`, ``forms``
    rows before the radius) have a fourth one of zeros. ``t`` [m, 4] receives the polynomials; returns their radii, not
    yet rounded up, the intervals' ends, and the range of all colours.
    """
    moving = forms > 1
    p0 = load4(background, 0)
    p1 = 0.0 * p0
    p2 = 0.0 * p0
    r = 0.0 * p0
    bottom = p0
    top = p0
    darkest = p0
    brightest = p0
    for entry in range(end - 1, begin - 1, -1):
        at, key, move = _listed_layer(lists, entry, width, forms)
        a0, a1, a2 = layers[at + _FORM], layers[at + _FORM + 1], layers[at + _FORM + 2]
        # colour - P, a form without radius
        v0 = load4(palette, key) - p0
        if moving:
            v1 = load4(palette, key + 4) - p1
            v2 = load4(palette, key + 8) - p2
        else:
            v1 = -p1
            v2 = -p2
        # sums in the order that leaves short chains from layer to layer
        p0 = fma(a0, v0, p0)
        p1 = fma(a0, v1, fma(a1, v0, p1))
        p2 = fma(a0, v2, fma(a2, v0, fma(a1, v1, p2)))
        a1 = abs(a1)
        a2 = abs(a2)
        v1 = abs(v1)
        v2 = abs(v2)
        v1 = v1 + v2
        size = abs(v0) + v1
        added = fma(layers[at + _ALPHA_HIGH], load4(palette, key + 4 * forms), fma(a1, v2, a2 * v1))
        added = fma(layers[at + _FORM + 3], size, fma(_ROUND, fma(1.0 + a1 + a2, size, abs(p0)), added))
        r = fma(1.0 - layers[at + _ALPHA_LOW], r, added)
        bottom, top, darkest, brightest = _blend_interval(
            bottom, top, darkest, brightest, layers, at, palette, key + _ends(forms)
        )
        if move != 0:
            falls, rises = load4(moves, move), load4(moves, move + 4)
            p0 = p0 + 0.5 * (rises - falls)
            r = r + 0.5 * (rises + falls)
            bottom = bottom - falls
            top = top + rises
    store(t, 0, p0)
    store(t, 4, p1)
    store(t, 8, p2)
    return r, bottom, top, darkest, brightest


@njit(cache=True, error_model="numpy", forceinline=True)
def _step_affine(r, layers, at, palette, key, forms, t, m):
    """One layer over the polynomials ``t`` [m, 4], flat, of order 1 and radius ``r`` (design.md, B7); the new radius.

    Lanes are the channels.
    """
    moving = forms > 1
    a0 = layers[at + _FORM]
    p0 = load4(t, 0)
    value = load4(palette, key) - p0
    middle = fma(a0, value, p0)
    steep = 0.0
    change_size = 0.0 * p0
    curves = 0.0 * p0
    for k in range(1, m):
        slope = load4(t, 4 * k)
        alpha = layers[at + _FORM + k]
        change = -slope
        if moving:
            change = load4(palette, key + 4 * k) - slope
        # half of a product of two slopes goes to the centre, half to the radius
        curve = 0.5 * (alpha * change)
        store(t, 4 * k, fma(a0, change, fma(alpha, value, slope)))
        middle = middle + curve
        curves = curves + abs(curve)
        steep += abs(alpha)
        change_size = change_size + abs(change)
    store(t, 0, middle)
    size = abs(value) + change_size
    added = fma(layers[at + _ALPHA_HIGH], load4(palette, key + 4 * forms), fma(steep, change_size, -curves))
    added = fma(layers[at + _FORM + m], size, fma(_ROUND, fma(1.0 + steep, size, abs(middle)), added))
    return fma(1.0 - layers[at + _ALPHA_LOW], r, added)


@njit(cache=True, error_model="numpy", forceinline=True)
def _step_curved(r, layers, at, palette, key, forms, t, value, d, m):
    """`_step_affine` for order 2; ``value`` [m, 4], flat, is scratch."""
    moving = forms > 1
    a0 = layers[at + _FORM]
    # value = colour - P, a form without radius
    v0 = load4(palette, key) - load4(t, 0)
    slopes = 0.0 * v0
    bends = 0.0 * v0
    steep, bent = 0.0, 0.0
    for k in range(1, m):
        v = -load4(t, 4 * k)
        if moving:
            v = load4(palette, key + 4 * k) + v
        store(value, 4 * k, v)
        alpha = layers[at + _FORM + k]
        store(t, 4 * k, load4(t, 4 * k) + (a0 * v + alpha * v0))
        if k <= d:
            slopes = slopes + abs(v)
            steep += abs(alpha)
        else:
            bends = bends + abs(v)
            bent += abs(alpha)
    p0 = load4(t, 0) + a0 * v0
    store(t, 0, p0)
    row = 1 + d
    for k in range(1, d + 1):
        alpha, v = layers[at + _FORM + k], load4(value, 4 * k)
        store(t, 4 * row, load4(t, 4 * row) + alpha * v)
        row += 1
        for l in range(k + 1, d + 1):
            product = alpha * load4(value, 4 * l) + layers[at + _FORM + l] * v
            store(t, 4 * row, load4(t, 4 * row) + product)
            row += 1
    size = abs(v0) + (slopes + bends)
    added = fma(layers[at + _ALPHA_HIGH], load4(palette, key + 4 * forms), fma(steep, bends, bent * (slopes + bends)))
    added = fma(layers[at + _FORM + m], size, fma(_ROUND, fma(1.0 + steep + bent, size, abs(p0)), added))
    return fma(1.0 - layers[at + _ALPHA_LOW], r, added)


@njit(cache=True, error_model="numpy", forceinline=True)
def _blend(layers, width, lists, palette, forms, begin, end, moves, background, d, order, m, t, value):
    """`_blend_line` for any number of parameters and order; ``value`` is scratch."""
    bottom = load4(background, 0)
    r = 0.0 * bottom
    store(t, 0, bottom)
    for k in range(1, m):
        store(t, 4 * k, r)
    top = bottom
    darkest = bottom
    brightest = bottom
    for entry in range(end - 1, begin - 1, -1):
        at, key, move = _listed_layer(lists, entry, width, forms)
        if order == 1:
            r = _step_affine(r, layers, at, palette, key, forms, t, m)
        else:
            r = _step_curved(r, layers, at, palette, key, forms, t, value, d, m)
        bottom, top, darkest, brightest = _blend_interval(
            bottom, top, darkest, brightest, layers, at, palette, key + _ends(forms)
        )
        if move != 0:
            falls, rises = load4(moves, move), load4(moves, move + 4)
            store(t, 0, load4(t, 0) + 0.5 * (rises - falls))
            r = r + 0.5 * (rises + falls)
            bottom = bottom - falls
            top = top + rises
    return r, bottom, top, darkest, brightest


@njit(cache=True, error_model="numpy", forceinline=True)
def _form_range(t, r, d, order, m):
    """Range over the box of the polynomials ``t`` [m, 4] of radii ``r``, rounded outward (design.md, A4)."""
    middle = load4(t, 0)
    bottom, top = middle, middle
    size = 0.0 * middle
    for k in range(1, m):
        size = size + abs(load4(t, 4 * k))
    if order == 1:
        bottom, top = middle - size, middle + size
    else:
        row = 1 + d
        for k in range(1, d + 1):
            low, high = _parabola(abs(load4(t, 4 * k)), load4(t, 4 * row))
            bottom, top = bottom + low, top + high
            row += 1
            for _ in range(k + 1, d + 1):
                mixed = abs(load4(t, 4 * row))
                bottom, top = bottom - mixed, top + mixed
                row += 1
    room = 8.0 * _ROUND * (abs(middle) + size) + r * _UP
    return bottom - room, top + room


@njit(cache=True, error_model="numpy")
def _chains(last, chain):
    """Number the groups of list positions: no uncertain pair spans two groups."""
    group = 0
    reach = -1
    for k in range(last.size):
        if k > reach:
            group += 1
        chain[k] = group
        reach = max(reach, last[k])


@njit(cache=True, error_model="numpy")
def _block(
    listed, x0, y0, tile_x, tile_y, record, box, tiles, depth, delta, depth_error, colors, color_radius,
    slope, direction, camera, rules, errors, background, negligible, d, order, m, antialiased,
    s, t, y1, y2, poly, rows, value, palette, layers, offset_x, offset_y, pixels, batch, masks, asked, lists, lengths,
    reach, deep, far, first, last, slots, owners, drawn, places, pairs, moves, ray, lower, upper, linear, slopes,
    statistics, marks,
):  # fmt: skip
    """Bounds of one block of pixels whose first pixel is (x0, y0). Returns whether the buffers sufficed.

    ``lower``, ``upper`` [side, side, 3] are the tile's, ``linear`` starts with the tile's or is empty;
    ``slopes`` [d] are the tile's sums of absolute linear coefficients, ``statistics`` is the thread's row.
    """
    unit = errors[0]
    side = lower.shape[0]
    width = rows.size // PIXELS
    forms = max(colors.shape[1] // 3 - 1, 1)
    u = (x0 + 0.5 * BLOCK - camera[2]) / camera[0]
    v = (y0 + 0.5 * BLOCK - camera[3]) / camera[1]
    for k in range(3):
        ray[k] = direction[k] * u + direction[3 + k] * v + direction[6 + k]
    pair_count, slot_count = _forward(
        listed, record, box, tiles, tile_x, tile_y, colors, palette, depth, delta, depth_error, slope, ray,
        s, y1, y2, poly, rows, layers, width, offset_x, offset_y, pixels, batch, masks, asked, lists, lengths, reach,
        deep, far, first, last, slots, owners, drawn, places, moves, pairs, x0, y0, d, order, m, antialiased, rules,
        errors, marks,
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
    if slot_count > 0:
        _swap_bounds(
            pairs, pair_count, slots, slot_count, drawn, places, layers, width, lists, palette, forms, moves
        )
        _settle_stops(
            layers, width, lists, lengths, first, last, owners, drawn, places, slot_count, s, m, rules[9], unit
        )
        _chains(last[: listed.size], far)
    statistics[1] += deepest
    statistics[2] += pair_count
    _shade(
        layers, width, lists, palette, forms, lengths, moves, far, slot_count > 0, background, color_radius, negligible,
        unit, x0 % side, y0 % side, d, order, m, s, t, value, reach, first, lower, upper, linear, slopes, statistics,
    )  # fmt: skip
    return True


@njit(cache=True, error_model="numpy")
def _shade(
    layers_, width, lists_, palette_, forms, lengths, moves_, chain, reordered, background_, color_radius, negligible,
    unit, left, top_row, d, order, m, s_, t_, value_, keys_, order_, lower, upper, linear, slopes, statistics,
):  # fmt: skip
    """Blend every pixel's layers and write its bounds; lanes are the channels, a fourth one holds nothing.

    The block begins at column ``left`` and row ``top_row`` of its tile; ``reordered`` tells whether layers may move.
    """
    layers, lists, palette, moves = pointer(layers_), pointer(lists_), pointer(palette_), pointer(moves_)
    background, s, t, value = pointer(background_), pointer(s_), pointer(t_), pointer(value_)
    keys, order_of = pointer(keys_), pointer(order_)
    deepest = lists_.shape[1]
    # behind the polynomials: scratch, then sums of absolute linear coefficients
    u = advanced(t, 4 * m)
    sums = advanced(t, 4 * m + 16)
    behind = load4(background, 0)
    for k in range(d):
        store(sums, 4 * k, 0.0 * behind)
    for q in range(PIXELS):
        begin = q * deepest
        end = begin + int(lengths[q])
        if d == 1 and order == 2:
            r, low, high, darkest, brightest = _blend_line(
                layers, width, lists, palette, forms, begin, end, moves, background, t
            )
        else:
            r, low, high, darkest, brightest = _blend(
                layers, width, lists, palette, forms, begin, end, moves, background, d, order, m, t, value
            )
        # the radius' own rounding: three for every layer
        r = r * (_UP + 4.0 * UNIT64 * lengths[q])
        form_low, form_high = _form_range(t, r, d, order, m)
        if reordered:
            low, high = _sharpened(
                low, high, form_low, form_high, layers, width, lists, palette, forms, begin, end, moves, chain,
                background, u, keys, order_of,
            )  # fmt: skip
        for k in range(d):
            store(sums, 4 * k, load4(sums, 4 * k) + abs(load4(t, 4 + 4 * k)))
        store(u, 0, darkest)
        store(u, 4, brightest)
        dark, light = min(u[0], u[1], u[2]), max(u[4], u[5], u[6])
        # rounding of the program's own sums and products (design.md, B8)
        bright = max(1.0, light, -dark)
        slack = (
            (3.0 * lengths[q] + 16.0) * (unit + 8.0 * UNIT64) * bright * 1.01 + color_radius + negligible * bright
        )
        # a stop that was ignored shows the background in place of what lies behind (B6)
        rho = s[_RHO + q] * (1.0 + 16.0 * unit)
        fall = slack + rho * maximum(0.0, light - behind)
        rise = slack + rho * maximum(0.0, behind - dark)
        bottom = maximum(low, form_low) - fall
        top = minimum(high, form_high) + rise
        # crossed or not a number: nothing is known
        known = bottom <= top
        store(u, 0, minimum(1.0, maximum(0.0, where(known, bottom, 0.0))))
        store(u, 4, maximum(0.0, minimum(1.0, where(known, top, 1.0))))
        if bits(known) != 15:
            statistics[4] += 1
        row, column = top_row + q // BLOCK, left + q % BLOCK
        for channel in range(3):
            lower[row, column, channel] = u[channel]
            upper[row, column, channel] = u[4 + channel]
        if linear.shape[0] > 0:
            store(u, 0, r + maximum(fall, rise))
            for channel in range(3):
                for k in range(m):
                    linear[0, row, column, channel, k] = t[4 * k + channel]
                linear[0, row, column, channel, m] = u[channel]
    for k in range(d):
        slopes[k] += sums[4 * k] + sums[4 * k + 1] + sums[4 * k + 2]


@njit(cache=True, error_model="numpy")
def _aligned(size):
    """Uninitialised doubles that begin with a cache line."""
    memory = np.empty(size + 7)
    start = -(memory.ctypes.data // 8) % 8
    return memory[start : start + size]


@njit(cache=True, error_model="numpy")
def _pixel_worker(
    thread, sequence_, counter_, wanted, offsets, entries, record_, box_, tiles_, depth_, delta_, depth_error_, colors_,
    color_radius, slope_, direction_, camera_, rules_, errors_, background_colors, negligible, pair_limit, d, order, m,
    antialiased, lower_, upper_, linear_, slopes_, statistics_, marks_,
):  # fmt: skip
    """One thread's tiles: the next of ``sequence`` that none has taken yet; see `pixel_stage`."""
    sequence, counter = borrowed(sequence_), pointer(counter_)
    record, box, tiles, depth = borrowed(record_), borrowed(box_), borrowed(tiles_), borrowed(depth_)
    delta, depth_error, colors, slope = borrowed(delta_), borrowed(depth_error_), borrowed(colors_), borrowed(slope_)
    direction, camera, rules, errors = borrowed(direction_), borrowed(camera_), borrowed(rules_), borrowed(errors_)
    lower, upper, slopes = borrowed(lower_), borrowed(upper_), borrowed(slopes_)
    linear, statistics, marks = borrowed(linear_), borrowed(statistics_), borrowed(marks_)
    image_width, image_height = camera[4], camera[5]
    side = lower.shape[1]
    tiles_x = int(math.ceil(image_width / side))
    blocks = side // BLOCK
    # columns of a layer, and numbers of a colour of the palette
    width = -(-(_FORM + m + 1) // 8) * 8
    color_size = _color_size(max(colors.shape[1] // 3 - 1, 1))
    scratch = np.zeros(_ROWS * PIXELS)
    scratch[_NUMBERS : _NUMBERS + BLOCK] = np.arange(BLOCK)
    background_ = np.zeros(4)
    background_[:3] = background_colors
    channels_ = np.zeros(4 * (2 * m + 4))
    value_ = np.zeros(4 * m)
    planes = np.empty((2 * m, PIXELS))
    rows_ = np.zeros((width, PIXELS))
    offsets_ = np.zeros((2, _BATCH * PIXELS + 8))
    pixels_ = np.empty(_BATCH * PIXELS, np.uint8)
    batch_ = np.empty((2, _BATCH + 1), np.int64)
    lengths_ = np.empty(PIXELS, np.uint32)
    ray_ = np.empty(3)
    s, t, value, background = borrowed(scratch), borrowed(channels_), borrowed(value_), borrowed(background_)
    y1, y2, poly = borrowed(planes[:m]), borrowed(planes[m:]), borrowed(rows_[_FORM : _FORM + m])
    rows, batch = borrowed(rows_.reshape(width * PIXELS)), borrowed(batch_)
    offset_x, offset_y = borrowed(offsets_[0]), borrowed(offsets_[1])
    pixels, lengths, ray = borrowed(pixels_), borrowed(lengths_), borrowed(ray_)
    layers_ = _aligned(256 * PIXELS * width)
    lists_ = np.empty((PIXELS, 256, _LISTED), np.uint32)
    drawn_ = np.empty(512, np.int64)
    places_ = np.empty((512, PIXELS), np.uint32)
    moves_ = np.empty((8192, _MOVES))
    reach_ = np.empty((2, 1024))
    order_ = np.empty((7, 1024), np.int64)
    palette_ = np.zeros(1024 * color_size)
    pairs_ = np.empty((pair_limit, 2), np.int64)
    block_offsets = np.empty(blocks * blocks + 1, np.int64)
    block_entries = np.empty(4096, np.uint32)
    while True:
        turn = taken(counter)
        if turn >= sequence.size:
            break
        number = sequence[turn]
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
                order_ = np.empty((7, 2 * listed.size), np.int64)
                palette_ = np.zeros(2 * listed.size * color_size)
            while not _block(
                borrowed(listed), x0, y0, tile_x, tile_y, record, box, tiles, depth, delta, depth_error, colors,
                color_radius, slope, direction, camera, rules, errors, background, negligible, d, order, m,
                antialiased, s, t, y1, y2, poly, rows, value, borrowed(palette_), borrowed(layers_), offset_x,
                offset_y, pixels, batch, borrowed(order_[0]), borrowed(order_[1]), borrowed(lists_), lengths,
                borrowed(reach_[0]), borrowed(reach_[1]), borrowed(order_[2]), borrowed(order_[3]),
                borrowed(order_[4]), borrowed(order_[5]), borrowed(order_[6]), borrowed(drawn_), borrowed(places_),
                borrowed(pairs_), borrowed(moves_), ray,
                lower[number], upper[number], linear[min(number, linear.shape[0]) :],
                slopes[number], statistics[thread], marks,
            ):  # fmt: skip
                capacity = 2 * lists_.shape[1]
                layers_ = _aligned(capacity * PIXELS * width)
                lists_ = np.empty((PIXELS, capacity, _LISTED), np.uint32)
                drawn_ = np.empty(2 * capacity, np.int64)
                places_ = np.empty((2 * capacity, PIXELS), np.uint32)
                moves_ = np.empty((32 * capacity, _MOVES))
    # the owners of the borrowed arrays live to here
    return (
        scratch.size + background_.size + channels_.size + value_.size + planes.size + rows_.size + offsets_.size
        + pixels_.size + batch_.size + lengths_.size + ray_.size + layers_.size + lists_.size + drawn_.size
        + places_.size + moves_.size + reach_.size + order_.size + palette_.size + pairs_.size
    )  # fmt: skip


@njit(cache=True, parallel=True, error_model="numpy")
def pixel_stage(
    wanted, offsets, entries, record, box, tiles, depth, delta, depth_error, colors, color_radius,
    slope, direction, camera, rules, errors, background, negligible, pair_limit, d, order, m, antialiased,
    threads, lower, upper, linear, slopes, statistics, marks,
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
        slopes: [t, d] sums of absolute linear coefficients, added to.
        marks: [n] uint8; set to 1 for every Gaussian that some pixel of these tiles may draw or stop at.
            Those that stay 0 are hidden or too faint for every pose: leaving them out changes nothing.
        statistics: [threads, 5] blocks, layers, uncertain pairs, blocks where too many pairs were
            uncertain, pixels with results that were not numbers.
    """
    sequence = longest_first(wanted, offsets)
    counter = np.zeros(1, np.int64)
    for thread in prange(threads):
        _pixel_worker(
            thread, sequence, counter, wanted, offsets, entries, record, box, tiles, depth, delta, depth_error, colors,
            color_radius, slope, direction, camera, rules, errors, background, negligible, pair_limit, d, order, m,
            antialiased, lower, upper, linear, slopes, statistics, marks,
        )  # fmt: skip
