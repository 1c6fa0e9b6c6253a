"""Per-Gaussian stage of the bounds: from pose forms to what a pixel needs.

For every Gaussian that some pose of the cell may show, one record is written (design.md, G1-G9):

    0, 1   mean in pixels at the cell's middle (the point pixel offsets are taken from)
    2, 3   lower and upper opacity
    4      kappa: relative error of the exponent that float evaluation may add
    5      1 where nothing but the opacity is known ("wild"), else 0
    6 ..   forms P, Q, S, W1, W2 (and K if antialiased), each m coefficients and a radius

so that for a pixel at offset (ax, ay) from the mean

    y1 = P ax - Q ay - W1,   y2 = S ay - W2,   alpha = opacity exp(-(y1^2 + y2^2)/2 - K).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from ns_abstract.arithmetic.forms import (
    bounds,
    clamp_below,
    logarithm,
    multiply,
    negate,
    reciprocal,
    reciprocal_square_root,
    scale_add,
    settle,
    square,
)
from ns_abstract.arithmetic.units import UNIT64

#: Lanes of one block of the compiled stage.
LANES = 32
_CHUNK = 1024
_COEFFICIENT = 8.0 * UNIT64
_UP = 1.0 + 128.0 * UNIT64
#: Room for rounding where a region of pixels or tiles is computed from bounds.
_REGION = 1.0 + 2.0**-30

# columns of a record before its forms
MEAN_X, MEAN_Y, OPACITY_LOW, OPACITY_HIGH, KAPPA, WILD, FORMS = range(7)

# workspace slots
(
    _X, _Y, _Z, _RZ, _U, _V,
    _W0, _W1, _W2, _W3, _W4, _W5, _W6, _W7, _W8,
    _N0, _N1, _N2, _N3, _N4, _N5,
    _A, _B, _C, _DET, _K, _T0, _T1, _T2, _P, _Q, _S, _DX, _DY,
) = range(34)  # fmt: skip
SLOTS = 34

# rows of the scalar scratch
(
    _ZLO, _ZHI, _ULO, _UHI, _VLO, _VHI, _ALO, _AHI, _CLO, _CHI, _BLO, _BHI, _DLO, _DHI, _LO, _HI, _DISC,
) = range(17)  # fmt: skip
SCALARS = 17


@njit(cache=True)
def _rotate(rotation, row, vectors, offset, out, d, order, m):
    """``out = rotation[row] . vectors (+ offset[row])`` for exact ``vectors`` [3, n].

    ``rotation`` is [rows, 9], ``offset`` [rows, 3] or empty.
    """
    n = out.shape[1]
    r0, r1, r2 = 3 * row, 3 * row + 1, 3 * row + 2
    has_offset = offset.shape[0] > 0
    for k in range(m):
        a = rotation[k, r0]
        b = rotation[k, r1]
        c = rotation[k, r2]
        shift = offset[k, row] if has_offset else 0.0
        for q in range(n):
            out[k, q] = a * vectors[0, q] + b * vectors[1, q] + c * vectors[2, q] + shift
    magnitude0 = abs(rotation[0, r0]) + rotation[m + 1, r0] + rotation[m + 2, r0]
    magnitude1 = abs(rotation[0, r1]) + rotation[m + 1, r1] + rotation[m + 2, r1]
    magnitude2 = abs(rotation[0, r2]) + rotation[m + 1, r2] + rotation[m + 2, r2]
    shift = 0.0
    radius = 0.0
    if has_offset:
        shift = abs(offset[0, row]) + offset[m + 1, row] + offset[m + 2, row]
        radius = offset[m, row]
    for q in range(n):
        a = abs(vectors[0, q])
        b = abs(vectors[1, q])
        c = abs(vectors[2, q])
        out[m, q] = (
            rotation[m, r0] * a
            + rotation[m, r1] * b
            + rotation[m, r2] * c
            + radius
            + _COEFFICIENT * (magnitude0 * a + magnitude1 * b + magnitude2 * c + shift)
        ) * _UP
    settle(out, d, order, m)


@njit(cache=True)
def _clamp_ratio(a, low, high, limit_low, limit_high, other, d, order, m):
    """Replace ``a`` by ``min(limit_high, max(-limit_low, a))`` and its bounds accordingly."""
    clamp_below(a, -limit_low, low, high, d, order, m)
    for q in range(a.shape[1]):
        low[q] = max(low[q], -limit_low)
        high[q] = max(high[q], -limit_low)
        other[0, q] = -high[q]
        other[1, q] = -low[q]
    negate(a, m)
    clamp_below(a, -limit_high, other[0], other[1], d, order, m)
    negate(a, m)
    for q in range(a.shape[1]):
        low[q] = min(low[q], limit_high)
        high[q] = min(high[q], limit_high)


@njit(cache=True)
def _form_to_record(form, q, record, start, m):
    for k in range(m + 1):
        record[start + k] = form[k, q]


@njit(cache=True)
def _tile_range(low, high, size, count):
    """Tiles [first, past) that the interval of pixels [low, high] touches, clipped to the image."""
    first = math.floor(min(max(low / size, 0.0), float(count)))
    past = math.ceil(min(max(high / size, 0.0), float(count)))
    return int(first), int(past)


@njit(cache=True, parallel=True)
def gaussian_stage(
    candidates, means, axes, opacity_low, opacity_high, mean_radius,
    rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors,
    d, order, m, antialiased,
    record, box, tiles, depth, delta, depth_error, state,
):  # fmt: skip
    """Fill the records of ``candidates`` [n] (indices into the scene's arrays).

    Args:
        candidates: [n] int32.
        means, axes: [N, 3], [N, 3, 3] of the scene.
        opacity_low, opacity_high: [N].
        mean_radius: [N, 3] half-widths of independent mean ranges, world axes, or [0, 3].
        rotation, offset: [rows, 9], [rows, 3] pose forms; see `PoseForms`.
        origin: [3].
        camera_reach: [3] upper bounds of the camera's coordinates.
        rotation_reach: [9] upper bounds of the rotation's absolute entries.
        camera: fx, fy, cx, cy, width, height.
        rules: near, far, eps2d, tile_size, radius_sigmas, discriminant_min, view_margin, alpha_min.
        errors: unit, flush, division, sqrt, rsqrt, exp errors in units.
        record, box, tiles, depth, delta, depth_error, state: outputs, one row per candidate;
            ``box`` [n, 4] pixels x0, x1, y0, y1; ``tiles`` [n, 8] outer then inner tile ranges;
            ``depth`` [n] at the middle; ``delta`` [n, 3] mean minus origin; ``state`` [n] 1 if visible.
    """
    n = candidates.shape[0]
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        work = np.empty((SLOTS, m + 3, LANES))
        scalars = np.empty((SCALARS, LANES))
        scratch = np.empty((5, LANES))
        vectors = np.empty((3, LANES))
        alive = np.empty(_CHUNK, np.int64)
        start = chunk * _CHUNK
        stop = min(n, start + _CHUNK)
        count = 0
        for first in range(start, stop, LANES):
            lanes = min(LANES, stop - first)
            count = _cull_block(
                candidates, first, lanes, means, axes, opacity_high, mean_radius, rotation, offset, origin,
                camera_reach, rotation_reach, camera, rules, errors, d, order, m, work, scalars, vectors,
                state, alive, count,
            )  # fmt: skip
        for first in range(0, count, LANES):
            lanes = min(LANES, count - first)
            _project_block(
                candidates, alive[first : first + lanes], means, axes, opacity_low, opacity_high, mean_radius,
                rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors,
                d, order, m, antialiased, work, scalars, scratch, vectors,
                record, box, tiles, depth, delta, depth_error, state,
            )  # fmt: skip


@njit(cache=True)
def _coordinate_error(rotation_reach, camera_reach, means, i, row, unit):
    """Float error of one camera coordinate (design.md, G2): ten units of the sum of absolute products."""
    total = 0.0
    for k in range(3):
        total += rotation_reach[3 * row + k] * (abs(means[i, k]) + camera_reach[k])
    return 10.0 * unit * total * _UP


@njit(cache=True)
def _mean_spread(rotation_reach, mean_radius, i, row):
    total = 0.0
    if mean_radius.shape[0] > 0:
        for k in range(3):
            total += rotation_reach[3 * row + k] * mean_radius[i, k]
    return total * _UP


@njit(cache=True)
def _cull_block(
    candidates, first, lanes, means, axes, opacity_high, mean_radius, rotation, offset, origin,
    camera_reach, rotation_reach, camera, rules, errors, d, order, m, work, scalars, vectors,
    state, alive, count,
):  # fmt: skip
    """Drop the Gaussians that no pose of the cell shows (design.md, G3); append the others to ``alive``."""
    near, far, alpha_min, margin = rules[0], rules[1], rules[7], rules[6]
    fx, fy, cx, cy, width, height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    unit = errors[0]
    for q in range(LANES):
        i = candidates[first + min(q, lanes - 1)]
        for k in range(3):
            vectors[k, q] = means[i, k] - origin[k]
    _rotate(rotation, 0, vectors, offset, work[_X], d, order, m)
    _rotate(rotation, 1, vectors, offset, work[_Y], d, order, m)
    _rotate(rotation, 2, vectors, offset, work[_Z], d, order, m)
    bounds(work[_Z], scalars[_ZLO], scalars[_ZHI], d, order, m)
    limit_x = max(cx, width - cx) / fx + margin * 0.5 * width / fx
    limit_y = max(cy, height - cy) / fy + margin * 0.5 * height / fy
    if margin >= 0.0:
        stretch = math.sqrt(fx * fx * (1.0 + limit_x * limit_x) + fy * fy * (1.0 + limit_y * limit_y)) * _REGION
    else:
        stretch = np.inf
    # radius <= 3 sqrt(lambda + 0.1) + 1 <= 3 |J| s + 3 sqrt(eps2d + 0.1) + 1, times z
    blur = rules[4] * math.sqrt(rules[2] + math.sqrt(rules[5])) + 2.0
    for q in range(lanes):
        index = first + q
        i = candidates[index]
        state[index] = 0
        error_z = _coordinate_error(rotation_reach, camera_reach, means, i, 2, unit)
        spread_z = _mean_spread(rotation_reach, mean_radius, i, 2) + error_z
        if not (scalars[_ZHI, q] + spread_z >= near and scalars[_ZLO, q] - spread_z <= far):
            # a bound that is not a number keeps the Gaussian
            if scalars[_ZHI, q] + spread_z < near or scalars[_ZLO, q] - spread_z > far:
                continue
        if opacity_high[i] * (1.0 + 64.0 * unit) < alpha_min:
            continue
        size = 0.0
        for k in range(3):
            s = axes[i, 0, k] ** 2 + axes[i, 1, k] ** 2 + axes[i, 2, k] ** 2
            size = max(size, s)
        reach = rules[4] * stretch * math.sqrt(size) * _REGION
        outside = False
        for axis in range(2):
            focal = fx if axis == 0 else fy
            center = cx if axis == 0 else cy
            extent = width if axis == 0 else height
            error = focal * (
                _coordinate_error(rotation_reach, camera_reach, means, i, axis, unit)
                + _mean_spread(rotation_reach, mean_radius, i, axis)
            ) + (extent + blur) * spread_z
            # focal x + (center + blur) z + reach < 0: left of the image at every pose with z > 0
            low_side = _linear_top(work[_X + axis], work[_Z], q, focal, center + blur, m)
            high_side = _linear_top(work[_X + axis], work[_Z], q, -focal, extent - center + blur, m)
            if (low_side + reach + error) * _REGION < 0.0 or (high_side + reach + error) * _REGION < 0.0:
                outside = True
        if outside:
            continue
        state[index] = 1
        alive[count] = index
        count += 1
    return count


@njit(cache=True)
def _linear_top(a, b, q, s, t, m):
    """Upper bound of ``s a + t b`` over the box."""
    top = s * a[0, q] + t * b[0, q] + abs(s) * a[m, q] + abs(t) * b[m, q]
    for k in range(1, m):
        top += abs(s * a[k, q] + t * b[k, q])
    magnitude = abs(s) * (abs(a[0, q]) + a[m + 1, q] + a[m + 2, q]) + abs(t) * (
        abs(b[0, q]) + b[m + 1, q] + b[m + 2, q]
    )
    return top + 8.0 * _COEFFICIENT * magnitude


@njit(cache=True)
def _project_block(
    candidates, block, means, axes, opacity_low, opacity_high, mean_radius,
    rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors,
    d, order, m, antialiased, work, scalars, scratch, vectors,
    record, box, tiles, depth, delta, depth_error, state,
):  # fmt: skip
    """Records of up to `LANES` Gaussians (design.md, G4-G9)."""
    eps2d, margin = rules[2], rules[6]
    fx, fy, cx, cy, width, height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    none = np.empty((0, 3))
    lanes = block.shape[0]
    for q in range(LANES):
        i = candidates[block[min(q, lanes - 1)]]
        for k in range(3):
            vectors[k, q] = means[i, k] - origin[k]
    for row in range(3):
        _rotate(rotation, row, vectors, offset, work[_X + row], d, order, m)
        if mean_radius.shape[0] > 0:
            for q in range(LANES):
                i = candidates[block[min(q, lanes - 1)]]
                work[_X + row, m, q] += _mean_spread(rotation_reach, mean_radius, i, row)
    bounds(work[_Z], scalars[_ZLO], scalars[_ZHI], d, order, m)
    # u = x / z, v = y / z
    reciprocal(work[_Z], scratch, work[_RZ], d, order, m)
    multiply(work[_X], work[_RZ], work[_U], d, order, m)
    multiply(work[_Y], work[_RZ], work[_V], d, order, m)
    bounds(work[_U], scalars[_ULO], scalars[_UHI], d, order, m)
    bounds(work[_V], scalars[_VLO], scalars[_VHI], d, order, m)
    # pixel offsets: X^ = fx x - (mean_x - cx) z, which vanishes at the middle
    for q in range(LANES):
        scratch[3, q] = work[_U, 0, q]
        scratch[4, q] = work[_V, 0, q]
    for axis in range(2):
        focal = fx if axis == 0 else fy
        source = work[_X + axis]
        target = work[_DX + axis]
        for q in range(LANES):
            ratio = scratch[3 + axis, q]
            # the pixel offset used below is exactly focal * ratio in float64
            shift = focal * ratio
            pa = abs(source[0, q]) + source[m + 1, q] + source[m + 2, q]
            pb = abs(work[_Z, 0, q]) + work[_Z, m + 1, q] + work[_Z, m + 2, q]
            target[m, q] = (
                focal * source[m, q] + abs(shift) * work[_Z, m, q] + _COEFFICIENT * (focal * pa + abs(shift) * pb)
            ) * _UP
            scratch[axis, q] = shift
        for k in range(m):
            for q in range(LANES):
                target[k, q] = focal * source[k, q] - scratch[axis, q] * work[_Z, k, q]
        settle(target, d, order, m)
    for q in range(lanes):
        index = block[q]
        record[index, MEAN_X] = scratch[0, q] + cx
        record[index, MEAN_Y] = scratch[1, q] + cy
        depth[index] = work[_Z, 0, q]
        for k in range(3):
            delta[index, k] = vectors[k, q]
    # the Jacobian's clamped ratios
    if margin >= 0.0:
        # scratch rows serve as the clamp's own bounds; u and v keep theirs for the means
        for axis in range(2):
            focal = fx if axis == 0 else fy
            center = cx if axis == 0 else cy
            extent = width if axis == 0 else height
            for q in range(LANES):
                scratch[0, q] = scalars[_ULO + 2 * axis, q]
                scratch[1, q] = scalars[_UHI + 2 * axis, q]
            extra = margin * 0.5 * extent / focal
            _clamp_ratio(
                work[_U + axis], scratch[0], scratch[1], center / focal + extra, (extent - center) / focal + extra,
                scratch[2:4], d, order, m,
            )  # fmt: skip
    # w = R B, then n0 = w0 - u w2, n1 = w1 - v w2
    for column in range(3):
        for q in range(LANES):
            i = candidates[block[min(q, lanes - 1)]]
            for k in range(3):
                vectors[k, q] = axes[i, k, column]
        for row in range(3):
            _rotate(rotation, row, vectors, none, work[_W0 + 3 * row + column], d, order, m)
    for column in range(3):
        multiply(work[_U], work[_W6 + column], work[_T0], d, order, m)
        scale_add(work[_W0 + column], fx, work[_T0], -fx, 0.0, work[_N0 + column], d, order, m)
        multiply(work[_V], work[_W6 + column], work[_T0], d, order, m)
        scale_add(work[_W3 + column], fy, work[_T0], -fy, 0.0, work[_N3 + column], d, order, m)
    # a' = |n0|^2 + eps z^2, c' = |n1|^2 + eps z^2, b' = n0.n1 (covariance times z^2)
    square(work[_Z], work[_T2], d, order, m)
    _dot3(work, _N0, _N0, _A, d, order, m)
    _dot3(work, _N3, _N3, _C, d, order, m)
    _dot3(work, _N0, _N3, _B, d, order, m)
    # det' = |n0 x n1|^2 + eps z^2 (|n0|^2 + |n1|^2) + eps^2 z^4, sums of squares only
    _cross_square(work, _K, d, order, m)
    scale_add(work[_A], 1.0, work[_C], 1.0, 0.0, work[_T0], d, order, m)
    scale_add(work[_T0], eps2d, work[_T2], eps2d * eps2d, 0.0, work[_T1], d, order, m)
    multiply(work[_T1], work[_T2], work[_T0], d, order, m)
    scale_add(work[_K], 1.0, work[_T0], 1.0, 0.0, work[_DET], d, order, m)
    scale_add(work[_A], 1.0, work[_T2], eps2d, 0.0, work[_A], d, order, m)
    scale_add(work[_C], 1.0, work[_T2], eps2d, 0.0, work[_C], d, order, m)
    bounds(work[_A], scalars[_ALO], scalars[_AHI], d, order, m)
    bounds(work[_C], scalars[_CLO], scalars[_CHI], d, order, m)
    bounds(work[_B], scalars[_BLO], scalars[_BHI], d, order, m)
    bounds(work[_DET], scalars[_DLO], scalars[_DHI], d, order, m)
    # S' = 1/sqrt(c'), P' = sqrt(c'/det'), Q' = P' b'/c'
    reciprocal_square_root(work[_C], scratch, work[_S], d, order, m)
    reciprocal_square_root(work[_DET], scratch, work[_T0], d, order, m)
    multiply(work[_C], work[_S], work[_T1], d, order, m)
    multiply(work[_T1], work[_T0], work[_P], d, order, m)
    multiply(work[_B], work[_S], work[_T0], d, order, m)
    multiply(work[_T0], work[_S], work[_T1], d, order, m)
    multiply(work[_P], work[_T1], work[_Q], d, order, m)
    # (a' - c')/2, for the radius
    scale_add(work[_A], 0.5, work[_C], -0.5, 0.0, work[_T1], d, order, m)
    bounds(work[_T1], scalars[_LO], scalars[_HI], d, order, m)
    if antialiased:
        # K = -log(compensation), compensation^2 = |n0 x n1|^2 / det'
        reciprocal(work[_DET], scratch, work[_T0], d, order, m)
        multiply(work[_K], work[_T0], work[_T1], d, order, m)
        bounds(work[_T1], scalars[_DISC], scratch[2], d, order, m)
        logarithm(work[_T1], scratch, work[_T0], d, order, m)
        scale_add(work[_T0], -0.5, work[_T0], 0.0, 0.0, work[_K], d, order, m)
    for q in range(lanes):
        index = block[q]
        i = candidates[index]
        _finish(
            index, i, q, means, axes, opacity_low, opacity_high, camera_reach, rotation_reach,
            rules, camera, errors, m, antialiased, work, scalars, record, box, tiles, depth_error, state,
        )  # fmt: skip
    # P = P' z, Q = Q' z, S = S' z, W1 = P' X^ - Q' Y^, W2 = S' Y^
    stride = m + 1
    multiply(work[_P], work[_Z], work[_T0], d, order, m)
    multiply(work[_Q], work[_Z], work[_T1], d, order, m)
    for q in range(lanes):
        _form_to_record(work[_T0], q, record[block[q]], FORMS, m)
        _form_to_record(work[_T1], q, record[block[q]], FORMS + stride, m)
    multiply(work[_S], work[_Z], work[_T0], d, order, m)
    multiply(work[_P], work[_DX], work[_T1], d, order, m)
    multiply(work[_Q], work[_DY], work[_T2], d, order, m)
    scale_add(work[_T1], 1.0, work[_T2], -1.0, 0.0, work[_T1], d, order, m)
    multiply(work[_S], work[_DY], work[_T2], d, order, m)
    for q in range(lanes):
        index = block[q]
        # _finish left the float error of the mean, in units of y, in the radius column of W1
        error = record[index, FORMS + 3 * stride + m]
        _form_to_record(work[_T0], q, record[index], FORMS + 2 * stride, m)
        _form_to_record(work[_T1], q, record[index], FORMS + 3 * stride, m)
        _form_to_record(work[_T2], q, record[index], FORMS + 4 * stride, m)
        record[index, FORMS + 3 * stride + m] += error
        record[index, FORMS + 4 * stride + m] += error
        if antialiased and record[index, WILD] == 0.0:
            _form_to_record(work[_K], q, record[index], FORMS + 5 * stride, m)
        if record[index, WILD] == 0.0:
            for k in range(FORMS, record.shape[1]):
                if not math.isfinite(record[index, k]):
                    record[index, WILD] = 1.0


@njit(cache=True)
def _dot3(work, a, b, out, d, order, m):
    """``work[out] = work[a..a+2] . work[b..b+2]``; uses slots _T0, _T1."""
    for k in range(3):
        target = work[out] if k == 0 else work[_T0]
        if a == b:
            square(work[a + k], target, d, order, m)
        else:
            multiply(work[a + k], work[b + k], target, d, order, m)
        if k > 0:
            scale_add(work[out], 1.0, work[_T0], 1.0, 0.0, work[out], d, order, m)


@njit(cache=True)
def _cross_square(work, out, d, order, m):
    """``work[out] = |n0 x n1|^2``; uses slots _T0, _T1."""
    for k in range(3):
        i, j = (0, 1) if k == 0 else ((0, 2) if k == 1 else (1, 2))
        multiply(work[_N0 + i], work[_N3 + j], work[_T0], d, order, m)
        multiply(work[_N0 + j], work[_N3 + i], work[_T1], d, order, m)
        scale_add(work[_T0], 1.0, work[_T1], -1.0, 0.0, work[_T0], d, order, m)
        if k == 0:
            square(work[_T0], work[out], d, order, m)
        else:
            square(work[_T0], work[_T1], d, order, m)
            scale_add(work[out], 1.0, work[_T1], 1.0, 0.0, work[out], d, order, m)


@njit(cache=True)
def _finish(
    index, i, q, means, axes, opacity_low, opacity_high, camera_reach, rotation_reach,
    rules, camera, errors, m, antialiased, work, scalars, record, box, tiles, depth_error, state,
):  # fmt: skip
    """Float errors, pixel region and tile ranges of one Gaussian (design.md, G5-G9)."""
    near, tile, sigmas, discriminant_min, margin, alpha_min = (
        rules[0], rules[3], rules[4], rules[5], rules[6], rules[7],
    )  # fmt: skip
    fx, fy, cx, cy, width, height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    unit, flush, division, root = errors[0], errors[1], errors[2], errors[3]
    stride = m + 1
    record[index, FORMS + 3 * stride + m] = 0.0
    record[index, KAPPA] = 0.0
    record[index, WILD] = 1.0
    # sigmoid: two exponentials or divisions and an addition
    slack = 12.0 * unit
    record[index, OPACITY_LOW] = opacity_low[i] * (1.0 - slack)
    record[index, OPACITY_HIGH] = opacity_high[i] * (1.0 + slack)
    tiles_x = int(math.ceil(width / tile)) if tile > 0.0 else 1
    tiles_y = int(math.ceil(height / tile)) if tile > 0.0 else 1
    box[index, 0] = -np.inf
    box[index, 1] = np.inf
    box[index, 2] = -np.inf
    box[index, 3] = np.inf
    tiles[index, 0] = 0
    tiles[index, 1] = tiles_x
    tiles[index, 2] = 0
    tiles[index, 3] = tiles_y
    for k in range(4, 8):
        tiles[index, k] = 0
    error_x = _coordinate_error(rotation_reach, camera_reach, means, i, 0, unit)
    error_y = _coordinate_error(rotation_reach, camera_reach, means, i, 1, unit)
    error_z = _coordinate_error(rotation_reach, camera_reach, means, i, 2, unit)
    depth_error[index] = error_z
    z_low = scalars[_ZLO, q] - error_z
    z_high = scalars[_ZHI, q] + error_z
    if not (z_low >= near * (1.0 + 4.0 * unit) and z_high < np.inf):
        return
    ratio_x = max(abs(scalars[_ULO, q]), abs(scalars[_UHI, q]))
    ratio_y = max(abs(scalars[_VLO, q]), abs(scalars[_VHI, q]))
    # G5: reciprocal of depth, means
    relative_z = error_z / z_low
    relative_rz = relative_z + (division + 1.0) * unit
    error_u = error_x / z_low + ratio_x * (relative_rz + 2.0 * unit)
    error_v = error_y / z_low + ratio_y * (relative_rz + 2.0 * unit)
    error_mean_x = fx * error_u + 8.0 * unit * (fx * ratio_x + abs(cx))
    error_mean_y = fy * error_v + 8.0 * unit * (fy * ratio_y + abs(cy))
    mean_x_low = fx * scalars[_ULO, q] + cx - error_mean_x * _REGION
    mean_x_high = fx * scalars[_UHI, q] + cx + error_mean_x * _REGION
    mean_y_low = fy * scalars[_VLO, q] + cy - error_mean_y * _REGION
    mean_y_high = fy * scalars[_VHI, q] + cy + error_mean_y * _REGION
    # clamped ratios
    if margin >= 0.0:
        limit_x = max(cx, width - cx) / fx + margin * 0.5 * width / fx
        limit_y = max(cy, height - cy) / fy + margin * 0.5 * height / fy
        ratio_x = min(ratio_x, limit_x)
        ratio_y = min(ratio_y, limit_y)
        error_u = min(error_u, 2.0 * limit_x) + 8.0 * unit * limit_x
        error_v = min(error_v, 2.0 * limit_y) + 8.0 * unit * limit_y
    # G6: covariance. F bounds the error of the world covariance and all later roundings
    relative_j = relative_z + 2.0 * relative_rz + 8.0 * unit
    jx = fx / z_low
    jy = fy / z_low
    error_a = 0.0
    error_b = 0.0
    error_c = 0.0
    depth_variance = 0.0
    for k in range(3):
        w = work[_W6 + k]
        reach = abs(w[0, q]) + w[m + 1, q] + w[m + 2, q] + w[m, q]
        depth_variance += reach * reach
    s0 = math.sqrt(axes[i, 0, 0] ** 2 + axes[i, 1, 0] ** 2 + axes[i, 2, 0] ** 2)
    s1 = math.sqrt(axes[i, 0, 1] ** 2 + axes[i, 1, 1] ** 2 + axes[i, 2, 1] ** 2)
    s2 = math.sqrt(axes[i, 0, 2] ** 2 + axes[i, 1, 2] ** 2 + axes[i, 2, 2] ** 2)
    entry = 52.0 * unit
    for r in range(3):
        gx_r = jx * (rotation_reach[r] + ratio_x * rotation_reach[6 + r])
        gy_r = jy * (rotation_reach[3 + r] + ratio_y * rotation_reach[6 + r])
        for c in range(3):
            gx_c = jx * (rotation_reach[c] + ratio_x * rotation_reach[6 + c])
            gy_c = jy * (rotation_reach[3 + c] + ratio_y * rotation_reach[6 + c])
            covariance = abs(
                axes[i, r, 0] * axes[i, c, 0] + axes[i, r, 1] * axes[i, c, 1] + axes[i, r, 2] * axes[i, c, 2]
            )
            products = (
                abs(axes[i, r, 0] * axes[i, c, 0])
                + abs(axes[i, r, 1] * axes[i, c, 1])
                + abs(axes[i, r, 2] * axes[i, c, 2])
            )
            spread = (
                s0 * (abs(axes[i, r, 0]) + abs(axes[i, c, 0]))
                + s1 * (abs(axes[i, r, 1]) + abs(axes[i, c, 1]))
                + s2 * (abs(axes[i, r, 2]) + abs(axes[i, c, 2]))
            )
            squares = s0 * s0 + s1 * s1 + s2 * s2
            f = (
                entry * spread
                + entry * entry * squares
                + 5.0 * unit * products
                + (20.0 * unit + 2.0 * relative_j) * covariance * (1.0 + 64.0 * unit)
                + flush
            )
            error_a += gx_r * gx_c * f
            error_b += gx_r * gy_c * f
            error_c += gy_r * gy_c * f
    a = scalars[_AHI, q] / (z_low * z_low)
    c = scalars[_CHI, q] / (z_low * z_low)
    b = max(abs(scalars[_BLO, q]), abs(scalars[_BHI, q])) / (z_low * z_low)
    det = scalars[_DLO, q] / (z_high * z_high * z_high * z_high)
    jump_x = jx * error_u
    jump_y = jy * error_v
    deep = math.sqrt(depth_variance)
    error_a = (error_a + 2.0 * jump_x * deep * math.sqrt(a) + jump_x * jump_x * depth_variance + 2.0 * unit * a) * 1.01
    error_c = (error_c + 2.0 * jump_y * deep * math.sqrt(c) + jump_y * jump_y * depth_variance + 2.0 * unit * c) * 1.01
    error_b = (
        error_b
        + deep * (jump_x * math.sqrt(c) + jump_y * math.sqrt(a))
        + jump_x * jump_y * depth_variance
        + 2.0 * unit * b
    ) * 1.01
    if not (a < np.inf and c < np.inf and error_a < np.inf and error_c < np.inf and error_b < np.inf):
        return
    # G8: radius and tile ranges. lambda_max = (a + c)/2 + sqrt(max(floor, ((a - c)/2)^2 + b^2))
    z2_low = z_low * z_low
    z2_high = z_high * z_high
    difference = max(abs(scalars[_LO, q]), abs(scalars[_HI, q])) / z2_low
    nearest = 0.0
    if scalars[_LO, q] > 0.0:
        nearest = scalars[_LO, q] / z2_high
    elif scalars[_HI, q] < 0.0:
        nearest = -scalars[_HI, q] / z2_high
    b_nearest = 0.0
    if scalars[_BLO, q] > 0.0:
        b_nearest = scalars[_BLO, q] / z2_high
    elif scalars[_BHI, q] < 0.0:
        b_nearest = -scalars[_BHI, q] / z2_high
    half_high = 0.5 * (a + c)
    half_low = 0.5 * (max(scalars[_ALO, q], 0.0) + max(scalars[_CLO, q], 0.0)) / z2_high
    error_half = 0.5 * (error_a + error_c) + 4.0 * unit * half_high
    error_det = (
        c * error_a + a * error_c + 2.0 * b * error_b + error_a * error_c + error_b * error_b + 6.0 * unit * (a * c + b * b)
    ) * 1.01
    error_disc = 2.0 * half_high * error_half + error_half * error_half + error_det + 4.0 * unit * half_high * half_high
    disc_high = max(discriminant_min, difference * difference + b * b + error_disc)
    disc_low = max(discriminant_min, nearest * nearest + b_nearest * b_nearest - error_disc)
    top_high = (half_high + error_half + math.sqrt(disc_high)) * (1.0 + 2.0 * root * unit)
    top_low = max(0.0, half_low - error_half + math.sqrt(disc_low)) * (1.0 - 2.0 * root * unit)
    radius_high = math.ceil(sigmas * math.sqrt(top_high) * (1.0 + 2.0 * root * unit) * _REGION)
    radius_low = math.ceil(sigmas * math.sqrt(top_low) * (1.0 - 2.0 * root * unit) / _REGION)
    if tile > 0.0:
        snap_x = 8.0 * unit * (abs(mean_x_low) + abs(mean_x_high) + radius_high)
        snap_y = 8.0 * unit * (abs(mean_y_low) + abs(mean_y_high) + radius_high)
        # image-border culls of fully_fused_projection_fwd.cu:171-180
        if (
            mean_x_high + radius_high + snap_x <= 0.0
            or mean_x_low - radius_high - snap_x >= width
            or mean_y_high + radius_high + snap_y <= 0.0
            or mean_y_low - radius_high - snap_y >= height
        ):
            state[index] = 0
            return
        x0, x1 = _tile_range(mean_x_low - radius_high - snap_x, mean_x_high + radius_high + snap_x, tile, tiles_x)
        y0, y1 = _tile_range(mean_y_low - radius_high - snap_y, mean_y_high + radius_high + snap_y, tile, tiles_y)
        tiles[index, 0] = x0
        tiles[index, 1] = x1
        tiles[index, 2] = y0
        tiles[index, 3] = y1
        # surely hit: the tile range of every mean and radius contains it
        if (
            mean_x_high - radius_low + snap_x < width
            and mean_y_high - radius_low + snap_y < height
            and mean_x_low + radius_low - snap_x > 0.0
            and mean_y_low + radius_low - snap_y > 0.0
        ):
            tiles[index, 4] = int(math.floor(min(max((mean_x_high - radius_low + snap_x) / tile, 0.0), float(tiles_x))))
            tiles[index, 5] = int(math.ceil(min(max((mean_x_low + radius_low - snap_x) / tile, 0.0), float(tiles_x))))
            tiles[index, 6] = int(math.floor(min(max((mean_y_high - radius_low + snap_y) / tile, 0.0), float(tiles_y))))
            tiles[index, 7] = int(math.ceil(min(max((mean_y_low + radius_low - snap_y) / tile, 0.0), float(tiles_y))))
    else:
        tiles[index, 4] = 0
        tiles[index, 5] = tiles_x
        tiles[index, 6] = 0
        tiles[index, 7] = tiles_y
    if z_high > rules[1]:
        tiles[index, 5] = tiles[index, 4]
    # G7: relative error of the exponent
    if not (det > 0.0 and error_det < 0.5 * det):
        return
    eta = (c * error_a + 2.0 * math.sqrt(a * c) * error_b + a * error_c) / det
    kappa = (eta + 80.0 * unit * (a * c) / det) * 1.01
    if not kappa < 0.25:
        return
    kappa = kappa * (1.0 + 4.0 * kappa)
    if antialiased:
        # compensation_fl^2 = max(0, (det0 + e)/(det + e))
        det0_error = (error_det + 6.0 * unit * (a * c + b * b)) / det
        ratio_low = scalars[_DISC, q]
        relative = det0_error / ratio_low + det0_error + (division + 2.0) * unit if ratio_low > 0.0 else np.inf
        if not (relative < 0.25):
            # the compensation may vanish
            return
        compensation_slack = 0.51 * relative * (1.0 + relative) + (root + 1.0) * unit
        record[index, OPACITY_LOW] *= 1.0 - compensation_slack
        record[index, OPACITY_HIGH] = min(
            record[index, OPACITY_HIGH] * (1.0 + compensation_slack), opacity_high[i] * (1.0 + slack)
        )
    record[index, KAPPA] = kappa
    record[index, WILD] = 0.0
    record[index, FORMS + 3 * stride + m] = (
        math.sqrt(c / det) * error_mean_x + math.sqrt(a / det) * error_mean_y
    ) * 1.01
    # pixels where alpha may reach the threshold
    exponent = math.log(record[index, OPACITY_HIGH] * (1.0 + 64.0 * unit) / alpha_min) * _REGION + 2.0**-30
    if exponent < 0.0:
        state[index] = 0
        return
    exponent = 2.0 * exponent / (1.0 - kappa)
    extent_x = math.sqrt(exponent * a) * _REGION
    extent_y = math.sqrt(exponent * c) * _REGION
    box[index, 0] = mean_x_low - extent_x
    box[index, 1] = mean_x_high + extent_x
    box[index, 2] = mean_y_low - extent_y
    box[index, 3] = mean_y_high + extent_y
    # no pixel centre inside
    if box[index, 1] < 0.5 or box[index, 0] > width - 0.5 or box[index, 3] < 0.5 or box[index, 2] > height - 0.5:
        state[index] = 0
