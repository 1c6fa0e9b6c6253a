"""Rays of a sub-box of a pose set, and contracted points on them, as forms (docs/dev/design.md, H1, H2)."""

from __future__ import annotations

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import HASH_RAY_ROUNDING, HASH_UP, POINT_PLACE_ROUNDING
from ns_abstract.methods.nerf.hash_bounds.forms import (
    COUNTED,
    UNCOUNTED,
    form_range,
    multiply,
    reciprocal,
    scale_add,
    spread_of,
)

#: A ray whose direction has at least this much of the largest coordinate's axis is followed by quotients.
_ALONG = 0.25


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def line_form(coefficients, exponents, radius, middle, half, line, out):
    """Write the polynomial ``sum_a c_a p^a`` on the box ``middle + half q`` as a form ``out`` of ``q`` (design.md, H1).

    ``coefficients`` [M], ``exponents`` [M, d]; the polynomial's error is at most ``radius``. ``middle`` and ``half``
    [d] are inside of [-1, 1]; ``line``: one parameter, so that second-order terms are followed.
    """
    terms, d = exponents.shape
    out[:] = 0.0
    rest, size, curvature = radius, 0.0, 0.0
    for a in range(terms):
        value = coefficients[a]
        if value == 0.0:
            continue
        power, degree, moved, own = value, 0, 0.0, 0.0
        for k in range(d):
            e = exponents[a, k]
            power *= middle[k] ** e
            degree += e
            moved += e * half[k]
            own += e * half[k] * half[k]
        out[0] += power
        size += abs(value) * (1.0 + degree) * (1.0 + degree)
        for k in range(d):
            if exponents[a, k] > 0:
                slope = value * exponents[a, k] * middle[k] ** (exponents[a, k] - 1)
                for j in range(d):
                    if j != k:
                        slope *= middle[j] ** exponents[a, j]
                out[1 + k] += slope * half[k]
        if line:
            e = exponents[a, 0]
            if e > 1:
                curvature += 0.5 * value * e * (e - 1) * middle[0] ** (e - 2) * half[0] * half[0]
            if e > 2:
                rest += abs(value) * e * (e - 1) * (e - 2) * half[0] * half[0] * half[0] / 6.0
        else:
            # derivatives of monomials on [-1, 1]^d are at most their exponents
            rest += 0.5 * abs(value) * max(moved * moved - own, 0.0)
    if line:
        # p^2 = (1 + (2 p^2 - 1)) / 2
        out[0] += 0.5 * curvature
        out[2] += 0.5 * curvature
    out[-1] = (rest + HASH_RAY_ROUNDING * size) * HASH_UP


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def harmonics(direction, line, out, work):
    """Compute the 16 harmonics ``out`` of ``(direction + 1) / 2`` as forms (``components_from_spherical_harmonics``).

    ``direction`` [3, n + 3], ``out`` [16, n + 3] and ``work`` [9, n + 3] are forms.
    """
    x, y, z, nothing = work[0], work[1], work[2], work[3]
    xx, yy, zz, t, r = work[4], work[5], work[6], work[7], work[8]
    nothing[:] = 0.0
    for i in range(3):
        scale_add(direction[i], 0.5, nothing, 0.5, work[i])
    multiply(x, x, line, xx)
    multiply(y, y, line, yy)
    multiply(z, z, line, zz)
    scale_add(nothing, 0.0, nothing, 0.28209479177387814, out[0])
    scale_add(y, 0.4886025119029199, nothing, 0.0, out[1])
    scale_add(z, 0.4886025119029199, nothing, 0.0, out[2])
    scale_add(x, 0.4886025119029199, nothing, 0.0, out[3])
    multiply(x, y, line, t)
    scale_add(t, 1.0925484305920792, nothing, 0.0, out[4])
    multiply(t, z, line, r)
    scale_add(r, 2.890611442640554, nothing, 0.0, out[10])
    multiply(y, z, line, t)
    scale_add(t, 1.0925484305920792, nothing, 0.0, out[5])
    scale_add(zz, 0.9461746957575601, nothing, -0.31539156525251999, out[6])
    multiply(x, z, line, t)
    scale_add(t, 1.0925484305920792, nothing, 0.0, out[7])
    scale_add(yy, -1.0, xx, 0.0, t)
    scale_add(t, 0.5462742152960396, nothing, 0.0, out[8])
    multiply(z, t, line, r)
    scale_add(r, 1.445305721320277, nothing, 0.0, out[14])
    scale_add(xx, 3.0, nothing, 0.0, t)
    scale_add(yy, -1.0, t, 0.0, t)
    multiply(y, t, line, r)
    scale_add(r, 0.5900435899266435, nothing, 0.0, out[9])
    scale_add(yy, -3.0, xx, 0.0, t)
    multiply(x, t, line, r)
    scale_add(r, 0.5900435899266435, nothing, 0.0, out[15])
    scale_add(zz, 5.0, nothing, -1.0, t)
    multiply(y, t, line, r)
    scale_add(r, 0.4570457994644658, nothing, 0.0, out[11])
    multiply(x, t, line, r)
    scale_add(r, 0.4570457994644658, nothing, 0.0, out[13])
    scale_add(zz, 5.0, nothing, -3.0, t)
    multiply(z, t, line, r)
    scale_add(r, 0.3731763325901154, nothing, 0.0, out[12])


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _negate(a, out):
    """Write ``out = -a``; it may be ``a`` itself."""
    for s in range(a.shape[0] - 1):
        out[s] = -a[s]
    out[-1] = a[-1]


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def quotients(origin, direction, line, ratios, shifts, along, work):
    """Compute the forms ``d_i / d_j`` and ``o_i - o_j d_i / d_j`` by axis j, by which far points are followed (H2).

    ``origin`` and ``direction`` are [3, n + 3]; ``ratios`` and ``shifts`` [3 (j), 3 (i), n + 3] and ``along`` [3],
    whether those of an axis are computed, are overwritten; ``work`` is [4, n + 3].
    """
    inverse, product = work[0], work[1]
    for j in range(3):
        low, high = form_range(direction[j], line)
        along[j] = low > _ALONG or high < -_ALONG
        if not along[j]:
            continue
        if low > 0.0:
            reciprocal(direction[j], line, inverse, work[2:])
        else:
            _negate(direction[j], product)
            reciprocal(product, line, inverse, work[2:])
            _negate(inverse, inverse)
        for i in range(3):
            if i != j:
                multiply(direction[i], inverse, line, ratios[j, i])
                multiply(origin[j], ratios[j, i], line, product)
                scale_add(product, -1.0, origin[i], 0.0, shifts[j, i])


@njit(cache=True, error_model="numpy", **COUNTED)
def _hull_of_slopes(low, high, jacobian):
    """Return slopes [2, 3, 3] of the contraction, least and largest over a box (design.md, H2)."""
    nearest, least_of_all = np.empty(3), 0.0
    for i in range(3):
        nearest[i] = max(0.0, low[i], -high[i])
        least_of_all = max(least_of_all, nearest[i])
    jacobian[0], jacobian[1] = np.inf, -np.inf
    if least_of_all < 1.0:
        for i in range(3):
            for k in range(3):
                one = 1.0 if i == k else 0.0
                jacobian[0, i, k] = min(jacobian[0, i, k], one)
                jacobian[1, i, k] = max(jacobian[1, i, k], one)
    for j in range(3):
        farthest = max(high[j], -low[j])
        if farthest < least_of_all or farthest < 1.0:
            continue
        # the largest coordinate is j, and m = |x_j| in [near, far]
        near, far = max(1.0, least_of_all), farthest
        ends = 2.0 / near - 1.0 / (near * near), 2.0 / far - 1.0 / (far * far)
        turn = 2.0 / (near * near) - 2.0 / (near * near * near), 2.0 / (far * far) - 2.0 / (far * far * far)
        steepest, flattest = max(turn[0], turn[1]), min(turn[0], turn[1])
        if near < 1.5 < far:
            steepest = 8.0 / 27.0
        for i in range(3):
            for k in range(3):
                least, most = 0.0, 0.0
                if i == j and k == j:
                    least, most = 1.0 / (far * far), 1.0 / (near * near)
                elif i == k:
                    least, most = ends[1], ends[0]
                elif k == j:
                    # - sign(x_j) x_i (2 / m^2 - 2 / m^3), |x_i| <= m
                    below, above = max(low[i], -far), min(high[i], far)
                    size = max(abs(below), abs(above))
                    values = (-above * flattest, -above * steepest, -below * flattest, -below * steepest)
                    least = min(values[0], values[1], values[2], values[3])
                    most = max(values[0], values[1], values[2], values[3])
                    if high[j] <= 0.0:
                        least, most = -most, -least
                    elif low[j] < 0.0:
                        least, most = -size * steepest, size * steepest
                jacobian[0, i, k] = min(jacobian[0, i, k], least)
                jacobian[1, i, k] = max(jacobian[1, i, k], most)


@njit(cache=True, error_model="numpy", **COUNTED)
def contracted(x):
    """Return nerfstudio's contraction [3] of a point [3] by the maximum norm."""
    m = max(abs(x[0]), abs(x[1]), abs(x[2]))
    if m < 1.0:
        return x.copy()
    return (2.0 - 1.0 / m) * (x / m)


@njit(cache=True, error_model="numpy", **COUNTED)
def _at_kinks(x, low, high, out):
    """Compute the contraction of the forms ``x`` [3, n + 3] over a box on which it has kinks: a mean-value form."""
    width = x.shape[1]
    jacobian = np.empty((2, 3, 3))
    _hull_of_slopes(low, high, jacobian)
    middle = contracted(np.array([x[0, 0], x[1, 0], x[2, 0]]))
    for i in range(3):
        out[i] = 0.0
        out[i, 0] = middle[i]
        rest = 0.0
        for k in range(3):
            slope = 0.5 * (jacobian[0, i, k] + jacobian[1, i, k])
            half = 0.5 * (jacobian[1, i, k] - jacobian[0, i, k]) * HASH_UP
            for s in range(1, width - 1):
                out[i, s] += slope * x[k, s]
            rest += abs(slope) * x[k, -1] + half * max(high[k] - x[k, 0], x[k, 0] - low[k])
        out[i, -1] = rest * HASH_UP


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _largest(x, axis, positive, room, line, difference):
    """Return whether coordinate ``axis`` of the forms ``x`` [3, n + 3] is surely the largest, by ``room``."""
    sign = 1.0 if positive else -1.0
    for i in range(3):
        if i != axis:
            for other in (-1.0, 1.0):
                # as forms: coordinates that are far away grow together
                scale_add(x[axis], sign * other, x[i], 0.0, difference)
                low, high = form_range(difference, line)
                if (low if other > 0.0 else -high) < room:
                    return False
    return True


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def point(ray, distance, line, out, work):
    """Compute the contracted point ``out`` at ``distance`` as forms of ``(v + 2) / 4`` in [0, 1]^3 (design.md, H2).

    ``ray``: origin and direction [3, n + 3], and the results of `quotients`; ``distance`` [n + 3] has the place symbol;
    ``work`` is [13, n + 3]. Returns whether the point surely lies inside of (0, 1)^3.
    """
    origin, direction, ratios, shifts, along = ray
    x, t = work[:3], work[3]
    low, high, size, radius = work[11], work[12], 0.0, 0.0
    for i in range(3):
        multiply(direction[i], distance, line, t)
        scale_add(t, 1.0, origin[i], 0.0, x[i])
        size = max(size, abs(origin[i, 0]) + abs(t[0]) + spread_of(x[i]))
        low[i], high[i] = form_range(x[i], line)
    for i in range(3):
        low[i] -= POINT_PLACE_ROUNDING * size
        high[i] += POINT_PLACE_ROUNDING * size
        radius = max(radius, abs(low[i]), abs(high[i]))
    if not radius < np.inf:
        return False
    axis, nearest = -1, 0.0
    if radius >= 1.0:
        for j in range(3):
            near = max(low[j], -high[j])
            if near >= 1.0 and near > nearest and _largest(x, j, low[j] > 0.0, POINT_PLACE_ROUNDING * size, line, t):
                axis, nearest = j, near
    if radius < 1.0:
        for i in range(3):
            for s in range(x.shape[1]):
                out[i, s] = x[i, s]
        nearest = 1.0
    elif axis >= 0:
        _outside(axis, low[axis] > 0.0, origin, ratios, shifts, along, x, line, out, work[3:])
    else:
        _at_kinks(x, low, high, out)
        nearest = 1.0
    inside = True
    for i in range(3):
        for s in range(out.shape[1]):
            out[i, s] *= 0.25
        out[i, 0] += 0.5
        out[i, -1] = out[i, -1] * HASH_UP + POINT_PLACE_ROUNDING * (1.0 + size / nearest)
        least, most = form_range(out[i], line)
        inside &= least > 0.0 and most < 1.0
    return inside


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _outside(axis, positive, origin, ratios, shifts, along, x, line, out, work):
    """Compute the contraction where coordinate ``axis`` is the largest and above 1 in magnitude (design.md, H2)."""
    m, inverse, square, factor, rest, scratch = work[0], work[1], work[2], work[3], work[4], work[5:7]
    sign = 1.0 if positive else -1.0
    nothing = work[7]
    nothing[:] = 0.0
    scale_add(x[axis], sign, nothing, 0.0, m)
    reciprocal(m, line, inverse, scratch)
    multiply(inverse, inverse, line, square)
    # 2 - 1 / m, and 2 / m - 1 / m^2
    scale_add(inverse, -1.0, nothing, 2.0, factor)
    scale_add(square, -1.0, nothing, 0.0, rest)
    scale_add(inverse, 2.0, rest, 0.0, rest)
    scale_add(factor, sign, nothing, 0.0, out[axis])
    for i in range(3):
        if i == axis:
            continue
        if along[axis]:
            multiply(ratios[axis, i], factor, line, square)
            multiply(shifts[axis, i], rest, line, m)
            scale_add(square, sign, m, 0.0, out[i])
        else:
            multiply(x[i], rest, line, out[i])
