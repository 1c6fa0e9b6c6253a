"""Per-pixel stage of the bounds: alphas as polynomial forms, blended back to front.

One pass handles a block of `PIXELS` pixels (lanes) of one tile (design.md, B1-B9). Each lane keeps
a list of the layers that may contribute to it, nearest first; a layer holds

    alpha's m coefficients and radius, its lower and upper bound, and its colour.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from ns_abstract.arithmetic.elementary import EXP_RELATIVE_ERROR, exp_kernel
from ns_abstract.arithmetic.units import UNIT64
from ns_abstract.methods.splat.gaussians import (
    FORMS,
    KAPPA,
    MEAN_X,
    MEAN_Y,
    OPACITY_HIGH,
    OPACITY_LOW,
    WILD,
)
from ns_abstract.methods.splat.lists import BLOCK, PIXELS, block_lists

_ROUND = 16.0 * UNIT64
_UP = 1.0 + 128.0 * UNIT64
#: Half-width of the exponent's range up to which exp(-t) is fitted by a polynomial.
_FIT_LIMIT = 2.0
#: Exponents are cut here; exp(-60) is far below any threshold.
_EXPONENT_LIMIT = 60.0

# rows of the lane scratch
(
    _AX, _AY, _C1, _R1, _L1, _B1, _C2, _R2, _L2, _B2, _S0, _SR, _SL, _SB, _SLO, _SHI, _WEIGHT, _A0, _AR, _LO, _HI,
    _TLO, _THI, _LIVE, _DROP, _CURVE,
) = range(26)  # fmt: skip
_LANE_ROWS = 26


@njit(cache=True)
def _spread(coefficients, first, last, out):
    """``out[q] = sum over rows [first, last) of |coefficients|``."""
    for q in range(PIXELS):
        out[q] = 0.0
    for k in range(first, last):
        for q in range(PIXELS):
            out[q] += abs(coefficients[k, q])


@njit(cache=True)
def _alpha_forms(record, lanes, y1, y2, poly, d, order, m, antialiased, sure, rules, errors, smooth):
    """Alpha of one Gaussian on the lanes of a block: rows of ``poly``, bounds in ``lanes`` (design.md, B1-B4).

    ``record`` is the Gaussian's record; ``sure`` whether it surely belongs to the tile.
    Returns the largest upper bound.
    """
    unit = errors[0]
    stride = m + 1
    alpha_min = rules[7] * (1.0 - 2.0 * unit)
    alpha_min_high = rules[7] * (1.0 + 2.0 * unit)
    alpha_max = rules[8]
    opacity_low = record[OPACITY_LOW]
    opacity_high = record[OPACITY_HIGH]
    top = 0.0
    if record[WILD] != 0.0:
        high = min(opacity_high, alpha_max) * (1.0 + 2.0 * unit)
        for k in range(m):
            for q in range(PIXELS):
                poly[k, q] = 0.0
        for q in range(PIXELS):
            poly[0, q] = 0.5 * high
            lanes[_AR, q] = 0.5 * high * _UP
            lanes[_LO, q] = 0.0
            lanes[_HI, q] = high
        return high
    base = FORMS
    for k in range(m):
        p = record[base + k]
        c = record[base + stride + k]
        s = record[base + 2 * stride + k]
        w1 = record[base + 3 * stride + k]
        w2 = record[base + 4 * stride + k]
        for q in range(PIXELS):
            y1[k, q] = p * lanes[_AX, q] - c * lanes[_AY, q] - w1
            y2[k, q] = s * lanes[_AY, q] - w2
    _spread(y1, 1, 1 + d, lanes[_L1])
    _spread(y2, 1, 1 + d, lanes[_L2])
    _spread(y1, 1 + d, m, lanes[_B1])
    _spread(y2, 1 + d, m, lanes[_B2])
    rp = record[base + m] + _ROUND * abs(record[base])
    rc = record[base + stride + m] + _ROUND * abs(record[base + stride])
    rs = record[base + 2 * stride + m] + _ROUND * abs(record[base + 2 * stride])
    rw1 = record[base + 3 * stride + m]
    rw2 = record[base + 4 * stride + m]
    for q in range(PIXELS):
        ax = abs(lanes[_AX, q])
        ay = abs(lanes[_AY, q])
        lanes[_R1, q] = rp * ax + rc * ay + rw1 + _ROUND * (lanes[_L1, q] + lanes[_B1, q])
        lanes[_R2, q] = rs * ay + rw2 + _ROUND * (lanes[_L2, q] + lanes[_B2, q])
    # sigma = (y1^2 + y2^2)/2 + K: coefficients into poly, radius into _SR
    for k in range(m):
        for q in range(PIXELS):
            poly[k, q] = y1[0, q] * y1[k, q] + y2[0, q] * y2[k, q]
    if order == 2:
        row = 1 + d
        for k in range(1, d + 1):
            for q in range(PIXELS):
                poly[row, q] += 0.5 * (y1[k, q] * y1[k, q] + y2[k, q] * y2[k, q])
            row += 1
            for l in range(k + 1, d + 1):
                for q in range(PIXELS):
                    poly[row, q] += y1[k, q] * y1[l, q] + y2[k, q] * y2[l, q]
                row += 1
    k_radius = 0.0
    k_spread = 0.0
    k_low = 0.0
    k_middle = 0.0
    if antialiased:
        k_middle = record[base + 5 * stride]
        k_radius = record[base + 5 * stride + m]
        for k in range(1, m):
            k_spread += abs(record[base + 5 * stride + k])
            for q in range(PIXELS):
                poly[k, q] += record[base + 5 * stride + k]
        k_low = max(0.0, k_middle - k_spread - k_radius)
    for q in range(PIXELS):
        c1 = abs(y1[0, q])
        c2 = abs(y2[0, q])
        l1 = lanes[_L1, q]
        l2 = lanes[_L2, q]
        b1 = lanes[_B1, q]
        b2 = lanes[_B2, q]
        r1 = lanes[_R1, q]
        r2 = lanes[_R2, q]
        s0 = 0.5 * poly[0, q]
        # order 1 keeps (g.p)^2 / 2 in [0, l^2 / 2] as half centre, half radius
        curve = 0.25 * (l1 * l1 + l2 * l2) if order == 1 else 0.0
        e1 = l1 + b1 + r1
        e2 = l2 + b2 + r2
        sr = (
            c1 * r1
            + c2 * r2
            + l1 * b1
            + l2 * b2
            + 0.5 * (b1 * b1 + b2 * b2)
            + r1 * (l1 + b1 + 0.5 * r1)
            + r2 * (l2 + b2 + 0.5 * r2)
            + curve
            + k_radius
            + _ROUND * (s0 + c1 * e1 + c2 * e2 + abs(k_middle) + k_spread)
        ) * _UP
        lanes[_S0, q] = s0 + curve + k_middle
        lanes[_SR, q] = sr
        near1 = max(0.0, c1 - e1)
        near2 = max(0.0, c2 - e2)
        far1 = c1 + e1
        far2 = c2 + e2
        lanes[_SLO, q] = (0.5 * (near1 * near1 + near2 * near2)) * (1.0 - _ROUND) + k_low
        lanes[_SHI, q] = (0.5 * (far1 * far1 + far2 * far2) + abs(k_middle) + k_spread + k_radius) * _UP
    _spread(poly, 1, 1 + d, lanes[_SL])
    _spread(poly, 1 + d, m, lanes[_SB])
    # range of the polynomial, exact in each p_k alone
    if order == 2:
        for q in range(PIXELS):
            lanes[_A0, q] = 0.0
            lanes[_WEIGHT, q] = 0.0
        row = 1 + d
        for k in range(1, d + 1):
            for q in range(PIXELS):
                g = abs(poly[k, q])
                s = poly[row, q]
                inside = g < 2.0 * abs(s)
                vertex = -(g * g) / (4.0 * s) if inside else 0.0
                lanes[_A0, q] += max(s + g, vertex)
                lanes[_WEIGHT, q] += min(s - g, vertex) if inside else s - g
            row += 1
            for _ in range(k + 1, d + 1):
                for q in range(PIXELS):
                    lanes[_A0, q] += abs(poly[row, q])
                    lanes[_WEIGHT, q] -= abs(poly[row, q])
                row += 1
        for q in range(PIXELS):
            rounding = _ROUND * (lanes[_SL, q] + lanes[_SB, q] + lanes[_S0, q])
            lanes[_SHI, q] = min(lanes[_SHI, q], lanes[_S0, q] + lanes[_A0, q] + lanes[_SR, q] + rounding)
            lanes[_SLO, q] = max(lanes[_SLO, q], lanes[_S0, q] + lanes[_WEIGHT, q] - lanes[_SR, q] - rounding)
    else:
        for q in range(PIXELS):
            spread = (lanes[_SL, q] + lanes[_SR, q] + _ROUND * lanes[_S0, q]) * _UP
            lanes[_SHI, q] = min(lanes[_SHI, q], lanes[_S0, q] + spread)
            lanes[_SLO, q] = max(lanes[_SLO, q], lanes[_S0, q] - spread)
    kappa = record[KAPPA]
    sigma_max = math.log(opacity_high / alpha_min) + 2.0**-20 if opacity_high > 0.0 else -1.0
    opacity = 0.5 * (opacity_low + opacity_high)
    opacity_spread = 0.5 * (opacity_high - opacity_low) * _UP + _ROUND * opacity
    for q in range(PIXELS):
        low = max(0.0, lanes[_SLO, q] * (1.0 - kappa))
        high = max(low, lanes[_SHI, q]) * (1.0 + kappa)
        # the polynomial describes the exact exponent; float evaluation moves it by kappa
        lanes[_SR, q] += kappa * high
        half = min(0.5 * (high - low) * _UP, _FIT_LIMIT)
        fits = half < _FIT_LIMIT
        middle = 0.5 * (low + high)
        e_low = exp_kernel(-min(low, _EXPONENT_LIMIT))
        e_half = exp_kernel(-half)
        slack = (30.0 + 3.0 * min(low, _EXPONENT_LIMIT) + 6.0 * half) * unit + 4.0 * EXP_RELATIVE_ERROR
        a_high = opacity_high * e_low * (1.0 + slack)
        a_low = opacity_low * e_low * (e_half * e_half) * (1.0 - slack)
        if not fits or low >= _EXPONENT_LIMIT:
            a_low = 0.0
        e_middle = e_low * e_half
        # exp(-t) = k0 - k1 t + k2 t^2 +- fit over |t| <= half (design.md, B3)
        h = 0.5 * half
        x = h * h
        i0 = 1.0 + x * (1.0 + x * (0.25 + x * (1.0 / 36.0 + x * (1.0 / 576.0))))
        k1 = 1.0 + x * (0.5 + x * (1.0 / 12.0 + x * (1.0 / 144.0 + x * (1.0 / 2880.0))))
        j2 = 0.5 + x * (1.0 / 6.0 + x * (1.0 / 48.0 + x * (1.0 / 720.0 + x * (1.0 / 17280.0))))
        x2 = x * x
        fit = (h * x) * (1.0 / 3.0) * (1.0 + 0.25 * x + x2 * (1.0 / 24.0)) * (1.0 + 0.25 * h + x * (1.0 / 15.0))
        fit += 1.2e-4 * x * x2 * x2
        t0 = lanes[_S0, q] - middle
        sr = lanes[_SR, q]
        l = lanes[_SL, q]
        b = lanes[_SB, q]
        scale = opacity * e_middle
        if order == 2:
            k0 = i0 - 2.0 * x * j2
            k2 = j2
            curve = 2.0 * l * b + b * b + sr * (2.0 * (l + b) + sr)
        else:
            k0 = i0
            k2 = 0.0
            fit += 2.0 * x * j2
            curve = 0.0
        weight = 2.0 * k2 * t0 - k1
        center = scale * (k0 - k1 * t0 + k2 * t0 * t0)
        size = 4.0 + abs(t0) * (4.0 + abs(t0)) + l + b + k2 * l * l
        radius = scale * (fit + abs(weight) * sr + k2 * curve + (_ROUND + 2.0 * EXP_RELATIVE_ERROR) * size)
        radius += (opacity_spread * e_low + opacity_high * e_low * slack) * 1.01
        lanes[_WEIGHT, q] = scale * weight
        lanes[_CURVE, q] = scale * k2
        # alpha_max
        excess = max(0.0, a_high - alpha_max)
        center -= 0.5 * excess
        radius += 0.5 * excess
        a_high = min(a_high, alpha_max * (1.0 + 2.0 * unit))
        a_low = min(a_low, alpha_max * (1.0 - 2.0 * unit))
        # alpha_min: below it the layer is skipped
        skips = a_low < alpha_min_high
        jump = min(alpha_min_high, a_high)
        if skips:
            center -= 0.5 * jump
            radius += 0.5 * jump
            a_low = 0.0
        if not sure:
            a_low = 0.0
        radius *= _UP
        flat = 0.5 * (a_high - a_low)
        constant = not fits or not sure or radius >= flat
        if a_high < alpha_min or low > sigma_max:
            a_high = 0.0
            a_low = 0.0
            flat = 0.0
            constant = True
        if constant:
            center = 0.5 * (a_high + a_low)
            radius = flat * _UP
            lanes[_WEIGHT, q] = 0.0
            lanes[_CURVE, q] = 0.0
        lanes[_A0, q] = center
        lanes[_AR, q] = radius
        lanes[_LO, q] = a_low
        lanes[_HI, q] = a_high
        top = max(top, a_high)
    if order == 2:
        # alpha_q = weight * sigma_q + curve * (linear part of sigma) squared, before sigma's rows are scaled
        row = 1 + d
        for k in range(1, d + 1):
            for l_ in range(k, d + 1):
                factor = 1.0 if l_ == k else 2.0
                for q in range(PIXELS):
                    poly[row, q] = lanes[_WEIGHT, q] * poly[row, q] + factor * lanes[_CURVE, q] * (
                        poly[k, q] * poly[l_, q]
                    )
                row += 1
    for k in range(1, 1 + d):
        for q in range(PIXELS):
            poly[k, q] *= lanes[_WEIGHT, q]
    for q in range(PIXELS):
        poly[0, q] = lanes[_A0, q]
    return top


# state of the blend, one row of lanes each, per channel: polynomial rows 0..m-1, then these
_P_RADIUS, _P_LOW, _P_HIGH = range(3)


@njit(cache=True)
def _grow(buffer, rows):
    larger = np.empty((rows, buffer.shape[1], buffer.shape[2]), buffer.dtype)
    larger[: buffer.shape[0]] = buffer
    return larger


@njit(cache=True)
def _uncertain(i, j, depth, delta, depth_error, slope, m):
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


@njit(cache=True)
def _windows(entries, depth, delta, depth_error, slope, ray, m, limit, first, last):
    """Smallest and largest list position whose order against each entry is uncertain.

    ``first[k] <= k <= last[k]``. ``ray`` [3] is the block's central ray, scaled to unit depth at the
    middle pose. Returns the number of uncertain pairs, or -1 if more than ``limit`` pairs had to be
    looked at; then every pair counts as uncertain.
    """
    count = entries.size
    along = 0.0
    for k in range(1, m):
        along += abs(slope[k, 0] * ray[0] + slope[k, 1] * ray[1] + slope[k, 2] * ray[2])
    along += slope[m, 0] * abs(ray[0]) + slope[m, 1] * abs(ray[1]) + slope[m, 2] * abs(ray[2])
    room = (1.0 - along) * (1.0 - 2.0**-30)
    reach = np.empty(count)
    largest = 0.0
    for k in range(count):
        i = entries[k]
        # offset from the central ray: what a rotation moves in depth relative to the ray
        x = delta[i, 0] - depth[i] * ray[0]
        y = delta[i, 1] - depth[i] * ray[1]
        z = delta[i, 2] - depth[i] * ray[2]
        e = slope[m, 0] * abs(x) + slope[m, 1] * abs(y) + slope[m, 2] * abs(z)
        for row in range(1, m):
            e += abs(slope[row, 0] * x + slope[row, 1] * y + slope[row, 2] * z)
        size = abs(delta[i, 0]) + abs(delta[i, 1]) + abs(delta[i, 2]) + abs(depth[i]) * (1.0 + along)
        reach[k] = e * _UP + 4.0 * _ROUND * size + depth_error[i]
        if not reach[k] <= largest:
            largest = reach[k]
        first[k] = k
        last[k] = k
    pairs = 0
    looked = 0
    for k in range(count):
        i = entries[k]
        for other in range(k + 1, count):
            j = entries[other]
            gap = (depth[j] - depth[i]) * room
            if room > 0.0 and gap > reach[k] + largest:
                break
            looked += 1
            if looked > limit:
                for p in range(count):
                    first[p] = 0
                    last[p] = count - 1
                return -1
            if not (room > 0.0 and gap > reach[k] + reach[other]) and _uncertain(
                i, j, depth, delta, depth_error, slope, m
            ):
                pairs += 1
                last[k] = other
                if first[other] > k:
                    first[other] = k
    return pairs


@njit(cache=True)
def _forward(
    entries, record, tiles, tile_x, tile_y, colors, lanes, y1, y2, poly, layers, sources, lengths, first, last, ordered,
    x0, y0, d, order, m, antialiased, rules, errors,
):  # fmt: skip
    """Collect the layers of every lane, nearest first (design.md, B5-B6). Returns the buffers.

    ``ordered`` tells that the depth order is certain: then layers behind the stop are settled here.
    Otherwise they are kept, with the transmittances needed to settle them later.
    """
    unit = errors[0]
    alpha_min = rules[7] * (1.0 - 2.0 * unit)
    stop = rules[9]
    width = m + 5
    channels = colors.shape[1]
    for q in range(PIXELS):
        lanes[_TLO, q] = 1.0
        lanes[_THI, q] = 1.0
        lanes[_LIVE, q] = 1.0
        lengths[q] = 0
        lanes[_DROP, q] = -1.0
    for k in range(entries.size):
        i = entries[k]
        ox = x0 + 0.5 - record[i, MEAN_X]
        oy = y0 + 0.5 - record[i, MEAN_Y]
        for q in range(PIXELS):
            lanes[_AX, q] = ox + (q % BLOCK)
            lanes[_AY, q] = oy + (q // BLOCK)
        sure = (
            tiles[i, 4] <= tile_x and tile_x < tiles[i, 5] and tiles[i, 6] <= tile_y and tile_y < tiles[i, 7]
        )
        top = _alpha_forms(record[i], lanes, y1, y2, poly, d, order, m, antialiased, sure, rules, errors, True)
        if top < alpha_min:
            continue
        alive = False
        for q in range(PIXELS):
            high = lanes[_HI, q]
            if lanes[_LIVE, q] == 0.0 or high < alpha_min:
                alive = alive or lanes[_LIVE, q] != 0.0
                continue
            low = lanes[_LO, q]
            # each product of the running transmittance is rounded once or twice
            t_low = lanes[_TLO, q] * (1.0 - high) * (1.0 - 8.0 * unit)
            t_high = lanes[_THI, q] * (1.0 - low) * (1.0 + 8.0 * unit)
            if ordered and t_high <= stop * (1.0 - 8.0 * unit):
                # surely the stop: neither this layer nor any behind it is drawn
                lanes[_LIVE, q] = 0.0
                continue
            alive = True
            n = lengths[q]
            if n >= layers.shape[0]:
                layers = _grow(layers, 2 * layers.shape[0])
                sources = _grow(sources, 2 * sources.shape[0])
            maybe_stop = ordered and t_low <= stop * (1.0 + 8.0 * unit)
            if maybe_stop:
                layers[n, 0, q] = 0.5 * high
                for r in range(1, m):
                    layers[n, r, q] = 0.0
                layers[n, m, q] = 0.5 * high * _UP
                low = 0.0
            else:
                for r in range(m):
                    layers[n, r, q] = poly[r, q]
                layers[n, m, q] = lanes[_AR, q]
            layers[n, m + 1, q] = low
            layers[n, m + 2, q] = high
            # transmittance after this layer at its least, before it at its most
            layers[n, m + 3, q] = t_low
            layers[n, m + 4, q] = lanes[_THI, q]
            for c in range(channels):
                layers[n, width + c, q] = colors[i, c]
            sources[n, 0, q] = k
            lengths[q] = n + 1
            lanes[_TLO, q] = t_low
            lanes[_THI, q] = t_high
            if not ordered:
                # layers up to the last one whose order is uncertain may still come first
                lanes[_DROP, q] = max(lanes[_DROP, q], float(last[k]))
        if not ordered:
            alive = False
            for q in range(PIXELS):
                if lanes[_LIVE, q] != 0.0 and lanes[_THI, q] <= stop * (1.0 - 8.0 * unit) and k >= lanes[_DROP, q]:
                    lanes[_LIVE, q] = 0.0
                alive = alive or lanes[_LIVE, q] != 0.0
        if not alive:
            break
    return layers, sources


@njit(cache=True)
def _settle_stops(layers, sources, lengths, first, last, m, stop, unit):
    """Drop or weaken the layers that the stop may hide, where the depth order is uncertain (design.md, B6)."""
    for q in range(PIXELS):
        n = lengths[q]
        for e in range(n):
            k = sources[e, 0, q]
            behind = e
            while behind + 1 < n and sources[behind + 1, 0, q] <= last[k]:
                behind += 1
            before = e
            while before > 0 and sources[before - 1, 0, q] >= first[k]:
                before -= 1
            t_low = layers[behind, m + 3, q]
            t_high = layers[before, m + 4, q] * (1.0 - layers[e, m + 1, q]) * (1.0 + 8.0 * unit)
            if t_high <= stop * (1.0 - 8.0 * unit):
                for r in range(m + 3):
                    layers[e, r, q] = 0.0
            elif t_low <= stop * (1.0 + 8.0 * unit):
                high = layers[e, m + 2, q]
                layers[e, 0, q] = 0.5 * high
                for r in range(1, m):
                    layers[e, r, q] = 0.0
                layers[e, m, q] = 0.5 * high * _UP
                layers[e, m + 1, q] = 0.0


@njit(cache=True)
def _color_range(layers, e, q, channel, m, color_rows):
    """Bounds of one layer's colour."""
    start = m + 5 + channel * color_rows
    spread = 0.0
    for r in range(1, color_rows):
        spread += abs(layers[e, start + r, q])
    spread *= _UP
    return layers[e, start, q] - spread, layers[e, start, q] + spread


@njit(cache=True)
def _swap_bounds(
    layers, sources, lengths, entries, last, depth, delta, depth_error, slope, m, color_rows, every, extra
):
    """``extra[e, 2 c, q]``, ``extra[e, 2 c + 1, q]``: how much reordering may lower or raise channel c
    when layer e joins the layers behind it (design.md, O2)."""
    for q in range(PIXELS):
        n = lengths[q]
        for e in range(n):
            for r in range(6):
                extra[e, r, q] = 0.0
            k = sources[e, 0, q]
            if last[k] == k:
                continue
            for f in range(e + 1, n):
                other = sources[f, 0, q]
                if other > last[k]:
                    break
                if not every and not _uncertain(entries[k], entries[other], depth, delta, depth_error, slope, m):
                    continue
                high = layers[f, m + 2, q]
                for channel in range(3):
                    low_e, high_e = _color_range(layers, e, q, channel, m, color_rows)
                    low_f, high_f = _color_range(layers, f, q, channel, m, color_rows)
                    extra[e, 2 * channel, q] += high * max(0.0, high_e - low_f)
                    extra[e, 2 * channel + 1, q] += high * max(0.0, high_f - low_e)
            for r in range(6):
                extra[e, r, q] *= layers[e, m + 2, q] * _UP


@njit(cache=True)
def _interval_chain(layers, extra, low, high, start, stop, q, channel, m, color_rows, suffix_low, suffix_high):
    """One step of the interval blend for layers [start, stop) whose order is uncertain (design.md, O2-O4).

    Returns the tighter of the swap and hull bounds, and the antichain bound.
    """
    behind_low, behind_high = low, high
    for e in range(stop - 1, start - 1, -1):
        c_low, c_high = _color_range(layers, e, q, channel, m, color_rows)
        a_low = layers[e, m + 1, q]
        a_high = layers[e, m + 2, q]
        v = c_high - high
        front_high = high + (a_high if v > 0.0 else a_low) * v
        v = c_low - low
        front_low = low + (a_high if v < 0.0 else a_low) * v
        lower, raise_ = extra[e, 2 * channel, q], extra[e, 2 * channel + 1, q]
        # wherever it goes among the layers behind, it moves the colour by at most its alpha times
        # the distance to the darkest or brightest of what lies behind
        hull_high = max(front_high, high + a_high * max(0.0, c_high - suffix_low))
        hull_low = min(front_low, low + a_high * min(0.0, c_low - suffix_high))
        high = min(front_high + raise_, hull_high) if raise_ > 0.0 else front_high
        low = max(front_low - lower, hull_low) if lower > 0.0 else front_low
        suffix_low = min(suffix_low, c_low)
        suffix_high = max(suffix_high, c_high)
    count = stop - start
    keys = np.empty(count)
    for side in range(2):
        for e in range(count):
            c_low, c_high = _color_range(layers, start + e, q, channel, m, color_rows)
            keys[e] = c_low if side == 0 else -c_high
        order = np.argsort(keys)
        value = behind_low if side == 0 else behind_high
        # nearest first: darkest for the lower bound, brightest for the upper one
        for position in range(count - 1, -1, -1):
            e = start + order[position]
            color = keys[order[position]] if side == 0 else -keys[order[position]]
            v = color - value
            grows = v > 0.0
            if side == 0:
                grows = not grows
            value += (layers[e, m + 2, q] if grows else layers[e, m + 1, q]) * v
        if side == 0:
            low = max(low, value)
        else:
            high = min(high, value)
    return low, high, suffix_low, suffix_high


@njit(cache=True)
def _interval_blend(layers, sources, lengths, extra, chain, background, m, color_rows, low, high):
    """Interval blend of every lane where depth orders are uncertain; ``chain[k]`` numbers the groups."""
    for q in range(PIXELS):
        for channel in range(3):
            value_low = background[channel]
            value_high = background[channel]
            suffix_low = value_low
            suffix_high = value_high
            stop = lengths[q]
            while stop > 0:
                start = stop - 1
                while start > 0 and chain[sources[start - 1, 0, q]] == chain[sources[stop - 1, 0, q]]:
                    start -= 1
                if stop - start > 1:
                    value_low, value_high, suffix_low, suffix_high = _interval_chain(
                        layers, extra, value_low, value_high, start, stop, q, channel, m, color_rows,
                        suffix_low, suffix_high,
                    )  # fmt: skip
                else:
                    c_low, c_high = _color_range(layers, start, q, channel, m, color_rows)
                    v = c_high - value_high
                    value_high += (layers[start, m + 2, q] if v > 0.0 else layers[start, m + 1, q]) * v
                    v = c_low - value_low
                    value_low += (layers[start, m + 2, q] if v < 0.0 else layers[start, m + 1, q]) * v
                    suffix_low = min(suffix_low, c_low)
                    suffix_high = max(suffix_high, c_high)
                stop = start
            low[channel, q] = value_low
            high[channel, q] = value_high


@njit(cache=True)
def _blend(
    layers, count, extra, ordered, background, d, order, m, color_rows, state, radius, low, high, color, value, brightest, lanes
):  # fmt: skip
    """Blend the layers back to front as forms, and as intervals where the order is certain (design.md, B7).

    ``state`` [3, m, lanes] and ``radius`` [3, lanes] receive the polynomial forms, ``low`` and
    ``high`` [3, lanes] the intervals.
    """
    alpha_spread = lanes[_L1]
    alpha_curve = lanes[_B1]
    spread = lanes[_L2]
    curve = lanes[_B2]
    cross = lanes[_S0]
    for q in range(PIXELS):
        brightest[q] = max(1.0, background[0], background[1], background[2])
    for channel in range(3):
        for k in range(m):
            for q in range(PIXELS):
                state[channel, k, q] = 0.0
        for q in range(PIXELS):
            state[channel, 0, q] = background[channel]
            radius[channel, q] = 0.0
        if ordered:
            for q in range(PIXELS):
                low[channel, q] = background[channel]
                high[channel, q] = background[channel]
    for e in range(count - 1, -1, -1):
        layer = layers[e]
        _spread(layer, 1, 1 + d, alpha_spread)
        _spread(layer, 1 + d, m, alpha_curve)
        for channel in range(3):
            start = m + 5 + channel * color_rows
            p = state[channel]
            # value = colour - P, a form without radius
            for q in range(PIXELS):
                value[0, q] = layer[start, q] - p[0, q]
                color[0, q] = 0.0
                color[1, q] = 0.0
            for k in range(1, color_rows):
                for q in range(PIXELS):
                    color[0, q] += abs(layer[start + k, q])
                    color[1, q] = layer[start + k, q]
            moving = color_rows > 2
            for k in range(1, m):
                for q in range(PIXELS):
                    value[k, q] = (layer[start + k, q] if moving else 0.0) - p[k, q]
            for q in range(PIXELS):
                brightest[q] = max(brightest[q], abs(layer[start, q]) + color[0, q])
            _spread(value, 1, 1 + d, spread)
            _spread(value, 1 + d, m, curve)
            for q in range(PIXELS):
                cross[q] = 0.0
            for k in range(m):
                for q in range(PIXELS):
                    p[k, q] += layer[0, q] * value[k, q]
            for k in range(1, m):
                for q in range(PIXELS):
                    p[k, q] += layer[k, q] * value[0, q]
            if order == 2:
                row = 1 + d
                for k in range(1, d + 1):
                    for q in range(PIXELS):
                        p[row, q] += layer[k, q] * value[k, q]
                    row += 1
                    for l in range(k + 1, d + 1):
                        for q in range(PIXELS):
                            p[row, q] += layer[k, q] * value[l, q] + layer[l, q] * value[k, q]
                        row += 1
                for q in range(PIXELS):
                    cross[q] = alpha_spread[q] * curve[q] + alpha_curve[q] * (spread[q] + curve[q])
            else:
                for k in range(1, d + 1):
                    for q in range(PIXELS):
                        half = 0.5 * (layer[k, q] * value[k, q])
                        p[0, q] += half
                        cross[q] -= abs(half)
                for q in range(PIXELS):
                    cross[q] += alpha_spread[q] * spread[q]
            for q in range(PIXELS):
                size = abs(value[0, q]) + spread[q] + curve[q]
                a_low = layer[m + 1, q]
                a_high = layer[m + 2, q]
                radius[channel, q] = (
                    (1.0 - a_low) * radius[channel, q]
                    + a_high * color[1, q]
                    + layer[m, q] * size
                    + cross[q]
                    + _ROUND * (abs(p[0, q]) + size * (1.0 + alpha_spread[q] + alpha_curve[q]))
                ) * _UP
            if ordered:
                for q in range(PIXELS):
                    center = layer[start, q]
                    c_low = center - color[0, q] * _UP
                    c_high = center + color[0, q] * _UP
                    a_low = layer[m + 1, q]
                    a_high = layer[m + 2, q]
                    v = c_high - high[channel, q]
                    high[channel, q] += (a_high if v > 0.0 else a_low) * v
                    v = c_low - low[channel, q]
                    low[channel, q] += (a_high if v < 0.0 else a_low) * v
            else:
                for q in range(PIXELS):
                    lower = extra[e, 2 * channel, q]
                    raise_ = extra[e, 2 * channel + 1, q]
                    p[0, q] += 0.5 * (raise_ - lower)
                    radius[channel, q] += 0.5 * (raise_ + lower) * _UP


@njit(cache=True)
def _form_range(state, radius, channel, d, order, m, low, high):
    """Range of the blended forms of one channel over the box."""
    p = state[channel]
    for q in range(PIXELS):
        low[q] = p[0, q]
        high[q] = p[0, q]
    size = np.abs(p[0])
    if order == 1:
        for k in range(1, m):
            for q in range(PIXELS):
                low[q] -= abs(p[k, q])
                high[q] += abs(p[k, q])
                size[q] += abs(p[k, q])
    else:
        row = 1 + d
        for k in range(1, d + 1):
            for q in range(PIXELS):
                g = abs(p[k, q])
                s = p[row, q]
                inside = g < 2.0 * abs(s)
                vertex = -(g * g) / (4.0 * s) if inside else 0.0
                high[q] += max(s + g, vertex) if inside else s + g
                low[q] += min(s - g, vertex) if inside else s - g
                size[q] += g + abs(s)
            row += 1
            for _ in range(k + 1, d + 1):
                for q in range(PIXELS):
                    low[q] -= abs(p[row, q])
                    high[q] += abs(p[row, q])
                    size[q] += abs(p[row, q])
                row += 1
    for q in range(PIXELS):
        spread = (radius[channel, q] + 4.0 * _ROUND * size[q]) * _UP
        low[q] -= spread
        high[q] += spread


@njit(cache=True)
def _pixel_worker(
    thread, wanted, offsets, entries, record, box, tiles, depth, delta, depth_error, colors, color_radius,
    slope, direction, camera, rules, errors, background, negligible, pair_limit, d, order, m, antialiased,
    threads, lower, upper, linear, statistics,
):  # fmt: skip
    """Every ``threads``-th tile, from number ``thread``; see `pixel_stage`."""
    fx, fy, cx, cy, image_width, image_height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    unit = errors[0]
    stop = rules[9]
    color_rows = colors.shape[1] // 3
    side = lower.shape[1]
    tiles_x = int(math.ceil(image_width / side))
    blocks = side // BLOCK
    lanes = np.zeros((_LANE_ROWS, PIXELS))
    y1 = np.empty((m, PIXELS))
    y2 = np.empty((m, PIXELS))
    poly = np.empty((m, PIXELS))
    value = np.empty((m, PIXELS))
    color = np.empty((2, PIXELS))
    layers = np.empty((256, m + 5 + colors.shape[1], PIXELS))
    sources = np.empty((256, 1, PIXELS), np.int64)
    lengths = np.empty(PIXELS, np.int64)
    state = np.empty((3, m, PIXELS))
    radius = np.empty((3, PIXELS))
    low = np.empty((3, PIXELS))
    high = np.empty((3, PIXELS))
    form_low = np.empty(PIXELS)
    form_high = np.empty(PIXELS)
    block_offsets = np.empty(blocks * blocks + 1, np.int64)
    block_entries = np.empty(4096, np.int32)
    extra = np.zeros((256, 6, PIXELS))
    ray = np.empty(3)
    brightest = np.empty(PIXELS)
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
            count = listed.size
            first = np.empty(count, np.int64)
            last = np.empty(count, np.int64)
            u = (x0 + 0.5 * BLOCK - cx) / fx
            v = (y0 + 0.5 * BLOCK - cy) / fy
            for k in range(3):
                ray[k] = direction[k] * u + direction[3 + k] * v + direction[6 + k]
            pairs = _windows(listed, depth, delta, depth_error, slope, ray, m, pair_limit, first, last)
            ordered = pairs == 0
            layers, sources = _forward(
                listed, record, tiles, tile_x, tile_y, colors, lanes, y1, y2, poly, layers, sources, lengths,
                first, last, ordered, x0, y0, d, order, m, antialiased, rules, errors,
            )  # fmt: skip
            deepest = 0
            for q in range(PIXELS):
                deepest = max(deepest, lengths[q])
            for q in range(PIXELS):
                for e in range(lengths[q], deepest):
                    for r in range(layers.shape[1]):
                        layers[e, r, q] = 0.0
            if not ordered:
                if extra.shape[0] < deepest:
                    extra = np.zeros((layers.shape[0], 6, PIXELS))
                extra[:deepest] = 0.0
                _settle_stops(layers, sources, lengths, first, last, m, stop, unit)
                _swap_bounds(
                    layers, sources, lengths, listed, last, depth, delta, depth_error, slope, m, color_rows,
                    pairs < 0, extra,
                )  # fmt: skip
                # groups of consecutive layers that no certain boundary separates
                chain = np.empty(count, np.int64)
                group = 0
                reach = -1
                for k in range(count):
                    if k > reach:
                        group += 1
                    chain[k] = group
                    reach = max(reach, last[k])
                _interval_blend(
                    layers, sources, lengths, extra, chain, background, m, color_rows, low, high
                )
            _blend(
                layers, deepest, extra, ordered, background, d, order, m, color_rows,
                state, radius, low, high, color, value, brightest, lanes,
            )  # fmt: skip
            statistics[thread, 0] += 1
            statistics[thread, 1] += deepest
            statistics[thread, 2] += max(pairs, 0)
            if pairs < 0:
                statistics[thread, 3] += 1
            for channel in range(3):
                _form_range(state, radius, channel, d, order, m, form_low, form_high)
                for q in range(PIXELS):
                    column = x0 - tile_x * side + q % BLOCK
                    row = y0 - tile_y * side + q // BLOCK
                    # rounding of the program's own sums and products (design.md, B8)
                    slack = (
                        (3.0 * lengths[q] + 16.0) * (unit + 8.0 * UNIT64) * brightest[q] * 1.01
                        + color_radius
                        + negligible * brightest[q]
                    )
                    bottom = max(low[channel, q], form_low[q]) - slack
                    top = min(high[channel, q], form_high[q]) + slack
                    if not bottom <= top:
                        # crossed or not a number: nothing is known
                        bottom = 0.0
                        top = 1.0
                        statistics[thread, 4] += 1
                    lower[number, row, column, channel] = min(1.0, max(0.0, bottom))
                    upper[number, row, column, channel] = max(0.0, min(1.0, top))
                    if linear.shape[0] > 0:
                        for k in range(m):
                            linear[number, row, column, channel, k] = state[channel, k, q]
                        linear[number, row, column, channel, m] = radius[channel, q] + slack


@njit(cache=True, parallel=True)
def pixel_stage(
    wanted, offsets, entries, record, box, tiles, depth, delta, depth_error, colors, color_radius,
    slope, direction, camera, rules, errors, background, negligible, pair_limit, d, order, m, antialiased,
    threads, lower, upper, linear, statistics,
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
        statistics: [threads, 5] blocks, layers, uncertain pairs, blocks where too many pairs were
            uncertain, results that were not numbers.
    """
    for thread in prange(threads):
        _pixel_worker(
            thread, wanted, offsets, entries, record, box, tiles, depth, delta, depth_error, colors, color_radius,
            slope, direction, camera, rules, errors, background, negligible, pair_limit, d, order, m, antialiased,
            threads, lower, upper, linear, statistics,
        )  # fmt: skip
