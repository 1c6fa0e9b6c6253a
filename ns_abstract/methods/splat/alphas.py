"""Alphas as polynomial forms: one Gaussian on some pixels of a block, eight at a time (design.md, B1-B4)."""

from __future__ import annotations

from numba import njit

from ns_abstract.arithmetic.compiled import pointer, signed
from ns_abstract.arithmetic.elementary import EXP_RELATIVE_ERROR, exp_kernel, fma
from ns_abstract.arithmetic.lanes import bits, load8, maximum, minimum, store, store_columns, where
from ns_abstract.methods.splat.block import (
    ALPHA_HIGH,
    ALPHA_LOW,
    B1,
    B2,
    C1,
    C2,
    CURVE,
    FORM,
    L1,
    L2,
    MAX,
    MIN,
    ROUND,
    S0,
    SB,
    SHI,
    SL,
    SLO,
    SR,
    UP,
    WEIGHT,
    parabola,
    set_unknown,
)
from ns_abstract.methods.splat.lists import PIXELS
from ns_abstract.methods.splat.records import FAINT, FORMS, KAPPA, OPACITY_HIGH, OPACITY_LOW, WILD

#: Half-width of the exponent's range up to which exp(-t) is fitted by a polynomial.
_FIT_LIMIT = 2.0
#: Exponents are cut here; exp(-60) is far below any threshold.
_EXPONENT_LIMIT = 60.0
#: The set of all of 8 lanes.
_ALL = 255


@njit(cache=True, error_model="numpy", inline="always")
def _spread(rows, first, last, n, s, out):
    """``s[out + q] = sum over rows [first, last) of |rows|``; inlined so that ``out`` is a constant."""
    for q in range(n):
        s[out + q] = 0.0
    for k in range(first, last):
        for q in range(n):
            s[out + q] += abs(rows[k, q])


@njit(cache=True, error_model="numpy", inline="always")
def _square_sum_range(c1, c2, e1, e2, k_low, k_high):
    """Bounds of (y1^2 + y2^2)/2 + K for |y - c| <= e, c >= 0 (design.md, B2)."""
    near1 = maximum(0.0, c1 - e1)
    near2 = maximum(0.0, c2 - e2)
    far1 = c1 + e1
    far2 = c2 + e2
    low = fma(0.5 * (1.0 - ROUND), fma(near1, near1, near2 * near2), k_low)
    return low, fma(0.5, fma(far1, far1, far2 * far2), k_high) * UP


@njit(cache=True, error_model="numpy", inline="always")
def _curved_radius(c1, c2, l1, l2, b1, b2, r1, r2, s0, k_radius, k_high):
    """Radius of (y1^2 + y2^2)/2 + K of order 2 from the sizes c, l, b, r of the parts of y1 and y2 (design.md, B2)."""
    first = fma(c1, r1, fma(l1 + 0.5 * b1, b1, r1 * (l1 + b1 + 0.5 * r1)))
    second = fma(c2, r2, fma(l2 + 0.5 * b2, b2, r2 * (l2 + b2 + 0.5 * r2)))
    size = fma(c1, l1 + b1 + r1, fma(c2, l2 + b2 + r2, s0)) + k_high
    return (first + second + fma(ROUND, size, k_radius)) * UP


@njit(cache=True, error_model="numpy")
def _exponent(record, n, offset_x, offset_y, s, y1, y2, poly, d, m, antialiased):
    """Form sigma = (y1^2 + y2^2)/2 + K of order 2 (design.md, B1-B2).

    Coefficients go into ``poly`` (row 0 unused), centre, radius and bounds into rows S0, SR, SLO, SHI,
    sums of absolute coefficients into SL, SB.
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
    _spread(y1, 1, 1 + d, n, s, L1)
    _spread(y2, 1, 1 + d, n, s, L2)
    _spread(y1, 1 + d, m, n, s, B1)
    _spread(y2, 1 + d, m, n, s, B2)
    rp = record[base + m] + ROUND * abs(record[base])
    rc = record[base + stride + m] + ROUND * abs(record[base + stride])
    rs = record[base + 2 * stride + m] + ROUND * abs(record[base + 2 * stride])
    rw1 = record[base + 3 * stride + m] + ROUND * abs(record[base + 3 * stride])
    rw2 = record[base + 4 * stride + m] + ROUND * abs(record[base + 4 * stride])
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
        s[C1 + q] = abs(y1[0, q])
    for q in range(n):
        s[C2 + q] = abs(y2[0, q])
    for q in range(n):
        ax = abs(offset_x[q])
        ay = abs(offset_y[q])
        c1 = s[C1 + q]
        c2 = s[C2 + q]
        l1 = s[L1 + q]
        l2 = s[L2 + q]
        b1 = s[B1 + q]
        b2 = s[B2 + q]
        r1 = rp * ax + rc * ay + rw1 + ROUND * (l1 + b1)
        r2 = rs * ay + rw2 + ROUND * (l2 + b2)
        s0 = 0.5 * (c1 * c1 + c2 * c2)
        e1 = l1 + b1 + r1
        e2 = l2 + b2 + r2
        s[S0 + q] = s0 + k_middle
        s[SR + q] = _curved_radius(c1, c2, l1, l2, b1, b2, r1, r2, s0, k_radius, k_high)
        s[SLO + q], s[SHI + q] = _square_sum_range(c1, c2, e1, e2, k_low, k_high)
    _spread(poly, 1, 1 + d, n, s, SL)
    _spread(poly, 1 + d, m, n, s, SB)
    # range of the polynomial, exact in each p_k alone
    for q in range(n):
        rounding = ROUND * (s[SL + q] + s[SB + q] + s[S0 + q])
        s[MIN + q] = s[S0 + q] - s[SR + q] - rounding
        s[MAX + q] = s[S0 + q] + s[SR + q] + rounding
    _add_range(pointer(poly), d, n, s)
    for q in range(n):
        s[SHI + q] = min(s[SHI + q], s[MAX + q])
        s[SLO + q] = max(s[SLO + q], s[MIN + q])


@njit(cache=True, error_model="numpy", forceinline=True)
def _exponent_affine(record, n, offset_x, offset_y, s, rows, m, antialiased):
    """`_exponent` for order 1, eight pixels at a time."""
    stride = m + 1
    p, c, g = record[FORMS], record[FORMS + stride], record[FORMS + 2 * stride]
    w1, w2 = record[FORMS + 3 * stride], record[FORMS + 4 * stride]
    rp = record[FORMS + m] + ROUND * abs(p)
    rc = record[FORMS + stride + m] + ROUND * abs(c)
    rs = record[FORMS + 2 * stride + m] + ROUND * abs(g)
    rw1 = record[FORMS + 3 * stride + m] + ROUND * abs(w1)
    rw2 = record[FORMS + 4 * stride + m] + ROUND * abs(w2)
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
            store(rows, (FORM + k) * PIXELS + q, slope)
            l1 = l1 + abs(g1)
            l2 = l2 + abs(g2)
            sl = sl + abs(slope)
        c1 = abs(c1)
        c2 = abs(c2)
        r1 = rp * abs(ax) + rc * abs(ay) + rw1 + ROUND * l1
        r2 = rs * abs(ay) + rw2 + ROUND * l2
        s0 = 0.5 * (c1 * c1 + c2 * c2)
        # (g.p)^2 / 2 lies in [0, l^2 / 2]: half centre, half radius
        curve = 0.25 * (l1 * l1 + l2 * l2)
        e1 = l1 + r1
        e2 = l2 + r2
        center = s0 + curve + k_middle
        first = fma(c1, r1, r1 * (l1 + 0.5 * r1))
        second = fma(c2, r2, r2 * (l2 + 0.5 * r2))
        size = fma(c1, e1, fma(c2, e2, s0)) + k_high
        radius = (first + second + (curve + fma(ROUND, size, k_radius))) * UP
        low, high = _square_sum_range(c1, c2, e1, e2, k_low, k_high)
        spread = (sl + radius + ROUND * center) * UP
        store(s, S0 + q, center)
        store(s, SR + q, radius)
        store(s, SL + q, sl)
        store(s, SB + q, 0.0 * sl)
        store(s, SLO + q, maximum(low, center - spread))
        store(s, SHI + q, minimum(high, center + spread))


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
    pr += ROUND * abs(p0)
    cr += ROUND * abs(c0)
    gr += ROUND * abs(g0)
    vr += ROUND * abs(v0)
    wr += ROUND * abs(w0)
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
        r1 = fma(pr, abs(ax), fma(cr, abs(ay), fma(ROUND, l1 + b1, vr)))
        r2 = fma(gr, abs(ay), fma(ROUND, l2 + b2, wr))
        e1 = l1 + b1 + r1
        e2 = l2 + b2 + r2
        radius = _curved_radius(y1, y2, l1, l2, b1, b2, r1, r2, s0, kr, k_high)
        low, high = _square_sum_range(y1, y2, e1, e2, k_low, k_high)
        s0 = s0 + k0
        slope = abs(linear)
        bend = abs(quadratic)
        rounding = ROUND * (slope + bend + abs(s0))
        bottom, top = parabola(slope, quadratic)
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
    """Add the range of the order-2 polynomial's non-constant part to rows MIN and MAX (design.md, A4)."""
    for q in range(0, n, 8):
        bottom, top = load8(s, MIN + q), load8(s, MAX + q)
        row = 1 + d
        for k in range(1, d + 1):
            low, high = parabola(abs(load8(poly, k * PIXELS + q)), load8(poly, row * PIXELS + q))
            bottom, top = bottom + low, top + high
            row += 1
            for _ in range(k + 1, d + 1):
                mixed = abs(load8(poly, row * PIXELS + q))
                bottom, top = bottom - mixed, top + mixed
                row += 1
        store(s, MIN + q, bottom)
        store(s, MAX + q, top)


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
    opacity_spread = 0.5 * (opacity_high - opacity_low) * UP + ROUND * opacity
    low = minimum(maximum(0.0, s_low * (1.0 - kappa)), _EXPONENT_LIMIT)
    high = maximum(low, s_high * (1.0 + kappa))
    # float evaluation moves the exponent by kappa
    sr = s_radius + kappa * minimum(high, 4.0 * _EXPONENT_LIMIT)
    width = 0.5 * (high - low) * UP
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
    error = fma(abs(weight), sr, fma(k2, bent, fma(ROUND + 2.0 * EXP_RELATIVE_ERROR, size, fit)))
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
    radius = fma(0.5, excess + jump, radius) * UP
    a_low = where(skips, 0.0, sure * a_low)
    # gone where it cannot reach the threshold
    gone = (a_high < alpha_min) | (low > sigma_max)
    a_high = where(gone, 0.0, a_high)
    a_low = where(gone, 0.0, a_low)
    flat = 0.5 * (a_high - a_low)
    keep = where(radius < flat, fits * sure, 0.0)
    center = where(keep == 1.0, center, 0.5 * (a_high + a_low))
    radius = where(keep == 1.0, radius, flat * UP)
    return center, radius, a_low, a_high, keep * (scale * weight), keep * (scale * k2)


@njit(cache=True, error_model="numpy", forceinline=True)
def _fit_exponential(
    n, s, rows, opacity_low, opacity_high, kappa, sigma_max, alpha_min, alpha_min_high, alpha_max, sure, unit, order, m
):
    """`_fitted_exponential` from rows of ``s`` to those of a layer's columns.

    Factors go to rows WEIGHT, CURVE. Returns the set of lanes on which alpha may reach the threshold.
    """
    quadratic = 1.0 if order == 2 else 0.0
    found = 0
    for q in range(0, n, 8):
        center, radius, low, high, weight, curve = _fitted_exponential(
            load8(s, SLO + q), load8(s, SHI + q), load8(s, S0 + q), load8(s, SR + q), load8(s, SL + q),
            load8(s, SB + q), opacity_low, opacity_high, kappa, sigma_max, alpha_min, alpha_min_high, alpha_max,
            sure, unit, quadratic,
        )  # fmt: skip
        store(rows, ALPHA_LOW * PIXELS + q, low)
        store(rows, ALPHA_HIGH * PIXELS + q, high)
        store(rows, FORM * PIXELS + q, center)
        store(rows, (FORM + m) * PIXELS + q, radius)
        store(s, WEIGHT + q, weight)
        store(s, CURVE + q, curve)
        found |= (_ALL - bits(high < alpha_min)) << q
    return found


@njit(cache=True, error_model="numpy", forceinline=True)
def alphas(
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
                set_unknown(layers, given + q * width, high, m)
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
                            square = load8(rows, (FORM + k) * PIXELS + q) * load8(rows, (FORM + l) * PIXELS + q)
                            at = (FORM + row) * PIXELS + q
                            curved = load8(s, WEIGHT + q) * load8(rows, at) + factor * load8(s, CURVE + q) * square
                            store(rows, at, curved)
                        row += 1
            for k in range(FORM + 1, FORM + 1 + d):
                for q in range(0, n, 8):
                    store(rows, k * PIXELS + q, load8(s, WEIGHT + q) * load8(rows, k * PIXELS + q))
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
