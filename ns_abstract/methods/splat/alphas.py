"""Alphas of one Gaussian on some pixels of a block, as forms, eight pixels at a time (docs/dev/design.md, B1-B4, B12).

The exponent is half the sum of two squares, y1 = P ax - Q ay - W1 and y2 = S ay - W2, and of K where opacity is
compensated. P, Q, S, W1, W2 and K are forms in the Gaussian's record. They have order 2 for one parameter, else 1; the
forms of alpha always have order 2 (B10).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numba import njit

from ns_abstract.arithmetic.elementary import exp_kernel, fma
from ns_abstract.arithmetic.rounding import EXP_OF_PARTS, FRAGMENT_ROUNDING, MOTION_ROUNDING, TURN_DOWN, UP
from ns_abstract.arithmetic.simd.intrinsics import signed
from ns_abstract.arithmetic.simd.lanes import bits, load8, maximum, minimum, store, store_columns, where
from ns_abstract.methods.splat.alpha_ranges import (
    Exponent,
    Limits,
    cubic_exponential,
    exponential_range,
    fitted_exponential,
    thresholded,
)
from ns_abstract.methods.splat.lists import PIXELS
from ns_abstract.methods.splat.pixel_block import (
    ALPHA_HIGH,
    ALPHA_LOW,
    BEND,
    BEND_SPREAD,
    EXPONENT,
    EXPONENT_CUT,
    FORM,
    exponent_ends,
    parabola,
    set_unknown,
)
from ns_abstract.methods.splat.projection_errors import (
    EXPONENT_LIMIT,
    FORMS,
    KAPPA,
    OPACITY_HIGH,
    OPACITY_LOW,
    UNBOUNDED,
)

#: The set of all of 8 lanes.
_ALL = 255


class _Whitened(NamedTuple):
    """Forms y1 and y2 of eight pixels: centres, magnitudes of their linear parts, radii."""

    c1: Any
    c2: Any
    l1: Any
    l2: Any
    r1: Any
    r2: Any


class _AffineForms(NamedTuple):
    """Centres of a record's forms of order 1, radii including the centres' rounding, and bounds of K."""

    p: float
    q: float
    s: float
    w1: float
    w2: float
    p_radius: float
    q_radius: float
    s_radius: float
    w1_radius: float
    w2_radius: float
    k: float
    k_radius: float
    k_low: float
    k_high: float


@njit(cache=True, error_model="numpy", inline="always")
def _square_sum_range(c1, c2, e1, e2, k_low, k_high):
    """Return bounds of (y1^2 + y2^2)/2 + K for |y - c| <= e, c >= 0 (design.md, B2)."""
    near1 = maximum(0.0, c1 - e1)
    near2 = maximum(0.0, c2 - e2)
    far1 = c1 + e1
    far2 = c2 + e2
    low = fma(0.5 * (1.0 - FRAGMENT_ROUNDING), fma(near1, near1, near2 * near2), k_low)
    return low, fma(0.5, fma(far1, far1, far2 * far2), k_high) * UP


@njit(cache=True, error_model="numpy", inline="always")
def _quadratic_radius(c, l, b, r):
    """Return the radius of y^2/2 of order 2 from the magnitudes c, l, b, r of the parts of y (design.md, B2)."""
    return fma(c, r, fma(l + 0.5 * b, b, r * (l + b + 0.5 * r)))


@njit(cache=True, error_model="numpy", inline="always")
def _form(record, number, antialiased):
    """Return form ``number`` of order 2 of a record, its radius with the centre's rounding; K is 0 if uncompensated."""
    at = FORMS + 4 * number
    if number < 5:
        return record[at], record[at + 1], record[at + 2], record[at + 3] + FRAGMENT_ROUNDING * abs(record[at])
    if antialiased:
        return record[at], record[at + 1], record[at + 2], record[at + 3]
    return 0.0, 0.0, 0.0, 0.0


@njit(cache=True, error_model="numpy", forceinline=True)
def _quadratic_alphas(record, begin, n, given, block, limits, charges, antialiased):
    """Return `alphas` for one parameter and order 2."""
    batch, values = block.batch, block.fragments.values
    p0, p1, p2, pr = _form(record, 0, antialiased)
    c0, c1, c2, cr = _form(record, 1, antialiased)
    g0, g1, g2, gr = _form(record, 2, antialiased)
    v0, v1, v2, vr = _form(record, 3, antialiased)
    w0, w1, w2, wr = _form(record, 4, antialiased)
    k0, k1, k2, kr = _form(record, 5, antialiased)
    k_low = max(0.0, k0 - abs(k1) - abs(k2) - kr)
    k_high = abs(k0) + abs(k1) + abs(k2) + kr
    drawn_lanes = 0
    for q in range(0, n, 8):
        ax = load8(batch.offset_x, begin + q)
        ay = load8(batch.offset_y, begin + q)
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
        r1 = fma(pr, abs(ax), fma(cr, abs(ay), fma(FRAGMENT_ROUNDING, l1 + b1, vr)))
        r2 = fma(gr, abs(ay), fma(FRAGMENT_ROUNDING, l2 + b2, wr))
        e1 = l1 + b1 + r1
        e2 = l2 + b2 + r2
        size = fma(y1, e1, fma(y2, e2, s0)) + k_high
        radius = _quadratic_radius(y1, l1, b1, r1) + _quadratic_radius(y2, l2, b2, r2)
        radius = (radius + fma(FRAGMENT_ROUNDING, size, kr)) * UP
        low, high = _square_sum_range(y1, y2, e1, e2, k_low, k_high)
        s0 = s0 + k0
        slope = abs(linear)
        bend = abs(quadratic)
        rounding = FRAGMENT_ROUNDING * (slope + bend + abs(s0))
        bottom, top = parabola(slope, quadratic)
        low = maximum(low, s0 + bottom - radius - rounding)
        if bits(low > limits.sigma_max) == _ALL:
            # alpha stays below the threshold
            continue
        high = minimum(high, s0 + top + radius + rounding)
        alpha, tilt, bent = cubic_exponential(low, high, s0, radius, linear, quadratic, limits, charges)
        # one parameter's forms hold its curvature: nothing reads the second column of its range
        store_columns(
            values, given + 8 * q, 8,
            (alpha.low, alpha.high, alpha.crossing, alpha.high, alpha.center, tilt, bent, alpha.radius),
        )  # fmt: skip
        drawn_lanes |= (_ALL - bits(alpha.high < limits.alpha_min)) << q
    return drawn_lanes


@njit(cache=True, error_model="numpy", forceinline=True)
def _affine_forms(record, m, antialiased):
    """Return the `_AffineForms` of a record."""
    stride = m + 1
    p, c, g = record[FORMS], record[FORMS + stride], record[FORMS + 2 * stride]
    w1, w2 = record[FORMS + 3 * stride], record[FORMS + 4 * stride]
    k_middle, k_radius, k_spread = 0.0, 0.0, 0.0
    if antialiased:
        k_middle = record[FORMS + 5 * stride]
        k_radius = record[FORMS + 5 * stride + m]
        for k in range(1, m):
            k_spread += abs(record[FORMS + 5 * stride + k])
    return _AffineForms(
        p=p,
        q=c,
        s=g,
        w1=w1,
        w2=w2,
        p_radius=record[FORMS + m] + FRAGMENT_ROUNDING * abs(p),
        q_radius=record[FORMS + stride + m] + FRAGMENT_ROUNDING * abs(c),
        s_radius=record[FORMS + 2 * stride + m] + FRAGMENT_ROUNDING * abs(g),
        w1_radius=record[FORMS + 3 * stride + m] + FRAGMENT_ROUNDING * abs(w1),
        w2_radius=record[FORMS + 4 * stride + m] + FRAGMENT_ROUNDING * abs(w2),
        k=k_middle,
        k_radius=k_radius,
        k_low=max(0.0, k_middle - k_spread - k_radius),
        k_high=abs(k_middle) + k_spread + k_radius,
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _store_fragments(rows, alpha, fragments, at, m):
    """Write eight fragments from ``alpha``; ``rows`` [., 8] hold the exponent's slopes and alpha's curvature."""
    store(rows, 8 * fragments.crossing, alpha.crossing)
    store(rows, 8 * ALPHA_LOW, alpha.low)
    store(rows, 8 * ALPHA_HIGH, alpha.high)
    store(rows, 8 * FORM, alpha.center)
    store(rows, 8 * (FORM + m), alpha.radius)
    for k in range(FORM + 1, FORM + m):
        store(rows, 8 * k, alpha.weight * load8(rows, 8 * k))
    _store_rows(rows, fragments, at)


@njit(cache=True, error_model="numpy", forceinline=True)
def _store_rows(rows, fragments, at):
    """Write eight fragments from column ``at`` on; their columns are ``rows`` [width, 8]."""
    values, width = fragments.values, fragments.width
    for k in range(0, width, 8):
        row = 8 * k
        store_columns(
            values, at + k, width,
            (
                load8(rows, row), load8(rows, row + 8), load8(rows, row + 16), load8(rows, row + 24),
                load8(rows, row + 32), load8(rows, row + 40), load8(rows, row + 48), load8(rows, row + 56),
            ),
        )  # fmt: skip


@njit(cache=True, error_model="numpy", forceinline=True)
def _whitened(record, f, ax, ay, rows, at, m):
    """Return the `_Whitened` of pixels at offsets ``ax``, ``ay`` from the mean (design.md, B1).

    ``rows`` [., 8] receives the slopes of y1 and y2 by parameter k = 1 ... m - 1 from ``at`` + 16 k on.
    """
    stride = m + 1
    c1 = fma(f.p, ax, -fma(f.q, ay, f.w1))
    c2 = fma(f.s, ay, -f.w2)
    l1 = 0.0 * ax
    l2 = l1
    for k in range(1, m):
        g1 = fma(record[FORMS + k], ax, -fma(record[FORMS + stride + k], ay, record[FORMS + 3 * stride + k]))
        g2 = fma(record[FORMS + 2 * stride + k], ay, -record[FORMS + 4 * stride + k])
        store(rows, at + 16 * k, g1)
        store(rows, at + 16 * k + 8, g2)
        l1 = l1 + abs(g1)
        l2 = l2 + abs(g2)
    r1 = f.p_radius * abs(ax) + f.q_radius * abs(ay) + f.w1_radius + FRAGMENT_ROUNDING * l1
    r2 = f.s_radius * abs(ay) + f.w2_radius + FRAGMENT_ROUNDING * l2
    return _Whitened(c1, c2, l1, l2, r1, r2)


@njit(cache=True, error_model="numpy", forceinline=True)
def _exponent_of_several(record, f, ax, ay, rows, scratch, m, antialiased):
    """Return the `Exponent` of pixels at offsets ``ax``, ``ay`` from the mean (design.md, B1-B3, B10).

    ``rows`` [., 8] receives its slopes and, behind the radius, its curvature; rows from ``scratch`` on are scratch.
    """
    bends = 8 * (FORM + m + 1)
    c1, c2, l1, l2, r1, r2 = _whitened(record, f, ax, ay, rows, scratch, m)
    sl, bend = 0.0 * ax, 0.0 * ax
    for k in range(1, m):
        slope = fma(c1, load8(rows, scratch + 16 * k), c2 * load8(rows, scratch + 16 * k + 8))
        if antialiased:
            slope = slope + record[FORMS + 5 * (m + 1) + k]
        store(rows, 8 * (FORM + k), slope)
        sl = sl + abs(slope)
    for j in range(1, m):
        g1, g2 = load8(rows, scratch + 16 * j), load8(rows, scratch + 16 * j + 8)
        for k in range(j, m):
            curve = fma(g1, load8(rows, scratch + 16 * k), g2 * load8(rows, scratch + 16 * k + 8))
            if j == k:
                curve = 0.5 * curve
            store(rows, bends, curve)
            bend = bend + abs(curve)
            bends += 8
    c1 = abs(c1)
    c2 = abs(c2)
    s0 = 0.5 * (c1 * c1 + c2 * c2)
    bend = bend * UP
    e1 = l1 + r1
    e2 = l2 + r2
    center = s0 + f.k
    first = fma(c1, r1, r1 * (l1 + 0.5 * r1))
    second = fma(c2, r2, r2 * (l2 + 0.5 * r2))
    size = fma(c1, e1, fma(c2, e2, s0)) + f.k_high + bend
    radius = (first + second + fma(FRAGMENT_ROUNDING, size, f.k_radius)) * UP
    low, high = _square_sum_range(c1, c2, e1, e2, f.k_low, f.k_high)
    turn = bend
    if not antialiased:
        # the curvature is no less than the square of the linear part over 2 c^2
        room = 2.0 * fma(c1, c1, c2 * c2) * bend
        share = where(room > 0.0, sl * sl / where(room > 0.0, room, 1.0), 0.0)
        turn = bend * fma(0.5 * TURN_DOWN, minimum(share, 1.0), 1.0)
    # half a sum of squares is not negative
    spread = (sl + radius + FRAGMENT_ROUNDING * (center + bend)) * UP
    return Exponent(
        maximum(low, center - spread), minimum(high, center + (spread + bend) * UP), center, radius, sl, bend, turn
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _set_curvature(alpha, rows, scratch, m):
    """Turn the exponent's curvature in ``rows`` [., 8] into that of ``alpha``, and write its range (design.md, B10).

    The rows hold the exponent's slopes, too; rows from ``scratch`` on are scratch.
    """
    low = 0.0 * alpha.low
    high = low
    for k in range(1, m):
        store(rows, scratch + 8 * k, low)
    at = 8 * (FORM + m + 1)
    for j in range(1, m):
        slope = alpha.curve * load8(rows, 8 * (FORM + j))
        own = fma(alpha.weight, load8(rows, at), slope * load8(rows, 8 * (FORM + j)))
        store(rows, at, own)
        at += 8
        shared = load8(rows, scratch + 8 * j)
        for k in range(j + 1, m):
            bend = fma(alpha.weight, load8(rows, at), 2.0 * (slope * load8(rows, 8 * (FORM + k))))
            store(rows, at, bend)
            at += 8
            # |p_j p_k| is at most half the sum of their squares
            half = 0.5 * abs(bend)
            shared = shared + half
            store(rows, scratch + 8 * k, load8(rows, scratch + 8 * k) + half)
        low = low + minimum(0.0, own - shared)
        high = high + maximum(0.0, own + shared)
    store(rows, 8 * BEND, 0.5 * (low + high))
    store(rows, 8 * BEND_SPREAD, 0.5 * (high - low))


@njit(cache=True, error_model="numpy", forceinline=True)
def _alphas_of_several(record, begin, n, given, block, limits, charges, antialiased, m):
    """Return `alphas` for several parameters, or none, with curvature beside forms of order 1 (design.md, B10)."""
    batch, rows, width = block.batch, block.batch.rows, block.fragments.width
    forms = _affine_forms(record, m, antialiased)
    drawn_lanes = 0
    for q in range(0, n, 8):
        ax = load8(batch.offset_x, begin + q)
        ay = load8(batch.offset_y, begin + q)
        exponent = _exponent_of_several(record, forms, ax, ay, rows, 8 * width, m, antialiased)
        alpha = fitted_exponential(exponent, limits, charges)
        drawable = _ALL - bits(alpha.high < limits.alpha_min)
        if drawable == 0:
            continue
        drawn_lanes |= drawable << q
        _set_curvature(alpha, rows, 8 * width, m)
        _store_fragments(rows, alpha, block.fragments, given + q * width, m)
    return drawn_lanes


@njit(cache=True, error_model="numpy", forceinline=True)
def _along_motion(rows, at, motion, r, size, inputs):
    """Replace the slopes of y1 or y2 by those along the pixels' image motion (design.md, B16).

    The slope by parameter k = 1 ... m - 1 is in ``rows`` [., 8] at ``at`` + 16 k; ``size`` is the sum of their
    magnitudes. The slopes by the two axes of the ``motion`` replace the first two.

    Returns:
        The radius over a motion cell, from the form's radius ``r``, and the slopes' magnitude before and after.
    """
    d, half = inputs.shape.dimensions, inputs.parts.half
    first = 0.0 * size
    second = first
    for k in range(d):
        slope = load8(rows, at + 16 * (k + 1))
        first = fma(slope, load8(rows, motion + 8 * (2 * d + k)), first)
        second = fma(slope, load8(rows, motion + 8 * (3 * d + k)), second)
    rest = r
    for k in range(d):
        along = fma(first, load8(rows, motion + 8 * k), second * load8(rows, motion + 8 * (d + k)))
        rest = rest + abs(load8(rows, at + 16 * (k + 1)) - along)
    store(rows, at + 16, first)
    store(rows, at + 32, second)
    first, second = abs(first), abs(second)
    size = size + first + second
    return fma(half[0], first, fma(half[1], second, fma(MOTION_ROUNDING, size, rest))), size


@njit(cache=True, error_model="numpy", forceinline=True)
def _alphas_over_parts(record, begin, n, given, block, limits, inputs):
    """Return `alphas` for cells bounded over parts: bounds over all of the cell, and exponents (design.md, B12)."""
    batch, rows, fragments = block.batch, block.batch.rows, block.fragments
    charges, half, m = inputs.charges, inputs.parts.half, inputs.shape.monomials
    forms = _affine_forms(record, m, inputs.rules.antialiased)
    kappa, ends = limits.kappa, 8 * exponent_ends(m)
    slack = charges.exponential + EXPONENT_CUT * charges.exponential_by_argument + EXP_OF_PARTS
    zero = 0.0 * load8(rows, 0)
    least = limits.sure * limits.opacity_low * exp_kernel(-min(forms.k_high * (1.0 + kappa), EXPONENT_CUT))
    most = limits.opacity_high * exp_kernel(-min(forms.k_low * (1.0 - kappa), EXPONENT_CUT))
    store(rows, ends + 16, zero + least * (1.0 - slack))
    store(rows, ends + 24, zero + most * (1.0 + slack))
    store(rows, ends + 32, zero + limits.alpha_min_high)
    store(rows, ends + 40, zero + limits.sigma_max)
    drawn_lanes = 0
    for q in range(0, n, 8):
        ax = load8(batch.offset_x, begin + q)
        ay = load8(batch.offset_y, begin + q)
        c1, c2, l1, l2, r1, r2 = _whitened(record, forms, ax, ay, rows, 8 * EXPONENT, m)
        store(rows, 8 * EXPONENT, c1)
        store(rows, 8 * EXPONENT + 8, c2)
        slope, e1, e2, s1, s2 = 0.0 * ax, r1, r2, l1, l2
        for k in range(1, m):
            at = 8 * EXPONENT + 16 * k
            g1, g2 = load8(rows, at), load8(rows, at + 8)
            slope = slope + abs(fma(c1, g1, c2 * g2))
            if not inputs.shape.by_motion:
                e1 = fma(half[k - 1], abs(g1), e1)
                e2 = fma(half[k - 1], abs(g2), e2)
        if inputs.shape.by_motion:
            motion = 8 * fragments.width
            # what is not a pixel keeps what it had
            for lane in range(min(n - q, 8)):
                pixel = int(batch.pixels[begin + q + lane])
                for k in range(4 * (m - 1)):
                    rows[motion + 8 * k + lane] = block.motion[k * PIXELS + pixel]
            e1, s1 = _along_motion(rows, 8 * EXPONENT, motion, r1, l1, inputs)
            e2, s2 = _along_motion(rows, 8 * EXPONENT + 8, motion, r2, l2, inputs)
        c1 = abs(c1)
        c2 = abs(c2)
        # float evaluation moves the exponent by kappa, and a part's centre is rounded
        off = kappa + FRAGMENT_ROUNDING
        store(rows, ends, fma(off, c1 + s1 + r1, e1) * UP)
        store(rows, ends + 8, fma(off, c2 + s2 + r2, e2) * UP)
        # over the whole cell
        s0 = 0.5 * (c1 * c1 + c2 * c2)
        radius = fma(c1, r1, fma(c2, r2, fma(FRAGMENT_ROUNDING, fma(c1, l1 + r1, fma(c2, l2 + r2, s0)), slope)))
        low, high = _square_sum_range(c1, c2, l1 + r1, l2 + r2, forms.k_low, forms.k_high)
        low = maximum(low, s0 + forms.k_low - radius * UP - FRAGMENT_ROUNDING * (s0 + forms.k_low))
        drawn = thresholded(zero, zero, exponential_range(low, high, zero, limits, charges), limits, charges)
        drawable = _ALL - bits(drawn.high < limits.alpha_min)
        if drawable == 0:
            continue
        drawn_lanes |= drawable << q
        store(rows, 8 * ALPHA_LOW, drawn.low)
        store(rows, 8 * ALPHA_HIGH, drawn.high)
        _store_rows(rows, fragments, given + q * fragments.width)
    return drawn_lanes


@njit(cache=True, error_model="numpy", forceinline=True)
def alphas(record, begin, n, given, sure, block, inputs):
    """Compute alpha of one Gaussian on ``n`` pixels of a block (design.md, B1-B4, G12).

    ``record`` is the Gaussian's; the pixels' offsets from the mean are in ``block.batch`` from ``begin`` on. Alphas go
    to ``block.fragments.values`` from ``given`` on, pixel by pixel. ``sure``: whether the Gaussian surely belongs to
    the tile. Returns the set of those of the pixels on which alpha may reach the threshold.
    """
    rules, charges, shape = inputs.rules, inputs.charges, inputs.shape
    alpha_min = rules.alpha_min * (1.0 - charges.threshold)
    drawn_lanes = 0
    if record[UNBOUNDED] != 0.0:
        high = min(record[OPACITY_HIGH], rules.alpha_max) * (1.0 + charges.threshold)
        if high >= alpha_min:
            for q in range(n):
                set_unknown(block.fragments, given + q * block.fragments.width, high, shape.monomials)
            drawn_lanes = -1
    else:
        # G12: what may miss its tile by rounding is hardly above the threshold
        room = rules.tile_room
        missed = 8.0 * record[KAPPA] + 0.125 * room * charges.tile if room > 0.0 else 0.0
        limits = Limits(
            record[OPACITY_LOW], record[OPACITY_HIGH], record[KAPPA], record[EXPONENT_LIMIT], alpha_min,
            rules.alpha_min * (1.0 + charges.threshold + missed), rules.alpha_max, 1.0 if sure else 0.0,
        )  # fmt: skip
        if shape.order == 2:
            drawn_lanes = _quadratic_alphas(record, begin, n, given, block, limits, charges, rules.antialiased)
        elif shape.parts > 0:
            drawn_lanes = _alphas_over_parts(record, begin, n, given, block, limits, inputs)
        else:
            drawn_lanes = _alphas_of_several(
                record, begin, n, given, block, limits, charges, rules.antialiased, shape.monomials
            )
    # not the lanes in excess
    return signed(drawn_lanes & ((2 << (int(n) - 1)) - 1))
