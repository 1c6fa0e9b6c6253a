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

from ns_abstract.arithmetic.compiled import borrowed
from ns_abstract.arithmetic.forms import (
    add_product,
    add_square,
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


def covariance_noise(axes: np.ndarray, unit: float, flush: float) -> np.ndarray:
    """Float error of each world covariance and of the products made with it (design.md, G6).

    Args:
        axes: [N, 3, 3] scaled principal axes.
        unit, flush: The arithmetic.

    Returns:
        [N, 12]: the error bounds and the absolute values of the entries 00, 11, 22, 01, 02, 12.
    """
    size = np.abs(axes)
    scale = np.sqrt(np.sum(axes * axes, axis=1))  # [N, 3]
    out = np.empty((axes.shape[0], 12))
    # entries of R(q) carry 52 units: normalisation, products and sums of a quaternion
    entry = 52.0 * unit
    squares = np.sum(scale * scale, axis=1)
    for k, (r, c) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
        covariance = np.abs(np.sum(axes[:, r] * axes[:, c], axis=1))
        products = np.sum(size[:, r] * size[:, c], axis=1)
        spread = np.sum(scale * (size[:, r] + size[:, c]), axis=1)
        out[:, k] = (
            entry * spread + entry * entry * squares + 5.0 * unit * products + 20.5 * unit * covariance + flush
        )
        out[:, 6 + k] = covariance * (1.0 + 64.0 * unit) + 8.0 * unit * products
    return out


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def _form_to_record(form, q, record, start, m):
    for k in range(m + 1):
        record[start + k] = form[k, q]


@njit(cache=True, error_model="numpy")
def _tile_range(low, high, size, count):
    """Tiles [first, past) that the interval of pixels [low, high] touches, clipped to the image."""
    first = math.floor(min(max(low / size, 0.0), float(count)))
    past = math.ceil(min(max(high / size, 0.0), float(count)))
    return int(first), int(past)


@njit(cache=True, error_model="numpy")
def _stage_chunk(
    chunk, candidates_, means_, axes_, noise_, opacity_low_, opacity_high_, mean_radius_,
    rotation_, offset_, origin_, camera_reach_, rotation_reach_, camera_, rules_, errors_,
    d, order, m, antialiased,
    record_, box_, tiles_, depth_, delta_, depth_error_, state_,
):  # fmt: skip
    """One chunk of candidates; see `gaussian_stage`."""
    candidates = borrowed(candidates_)
    means = borrowed(means_)
    axes = borrowed(axes_)
    noise = borrowed(noise_)
    opacity_low = borrowed(opacity_low_)
    opacity_high = borrowed(opacity_high_)
    mean_radius = borrowed(mean_radius_)
    rotation = borrowed(rotation_)
    offset = borrowed(offset_)
    origin = borrowed(origin_)
    camera_reach = borrowed(camera_reach_)
    rotation_reach = borrowed(rotation_reach_)
    camera = borrowed(camera_)
    rules = borrowed(rules_)
    errors = borrowed(errors_)
    record = borrowed(record_)
    box = borrowed(box_)
    tiles = borrowed(tiles_)
    depth = borrowed(depth_)
    delta = borrowed(delta_)
    depth_error = borrowed(depth_error_)
    state = borrowed(state_)
    n = candidates.shape[0]
    work_ = np.empty((SLOTS, m + 3, LANES))
    work = borrowed(work_)
    scalars_ = np.empty((SCALARS, LANES))
    scalars = borrowed(scalars_)
    scratch_ = np.empty((5, LANES))
    scratch = borrowed(scratch_)
    vectors_ = np.empty((3, LANES))
    vectors = borrowed(vectors_)
    alive_ = np.empty(_CHUNK, np.int64)
    alive = borrowed(alive_)
    start = chunk * _CHUNK
    stop = min(n, start + _CHUNK)
    count = 0
    for first in range(start, stop, LANES):
        lanes = min(LANES, stop - first)
        count = _cull_block(
            candidates, first, lanes, means, axes, opacity_high, mean_radius, rotation, offset, origin,
            camera_reach, rotation_reach, camera, rules, errors, d, order, m, antialiased, work, scalars, vectors,
            state, alive, count,
        )  # fmt: skip
    for first in range(0, count, LANES):
        lanes = min(LANES, count - first)
        _project_block(
            candidates, alive[first : first + lanes], means, axes, noise, opacity_low, opacity_high, mean_radius,
            rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors,
            d, order, m, antialiased, work, scalars, scratch, vectors,
            record, box, tiles, depth, delta, depth_error, state,
        )  # fmt: skip
    # the owners of the borrowed arrays live to here
    return work_.size + scalars_.size + scratch_.size + vectors_.size + alive_.size


@njit(cache=True, parallel=True, error_model="numpy")
def gaussian_stage(
    candidates, means, axes, noise, opacity_low, opacity_high, mean_radius,
    rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors,
    d, order, m, antialiased,
    record, box, tiles, depth, delta, depth_error, state,
):  # fmt: skip
    """Fill the records of ``candidates`` [n] (indices into the scene's arrays).

    Args:
        candidates: [n] int32.
        means, axes: [N, 3], [N, 3, 3] of the scene; means in the middle of their ranges.
        noise: [N, 12] see `covariance_noise`.
        opacity_low, opacity_high: [N] ends of the opacities' ranges.
        mean_radius: [N, 3] half-widths of independent mean ranges, world axes, or [0, 3].
        rotation, offset: [rows, 9], [rows, 3] pose forms; see `PoseForms`.
        origin: [3].
        camera_reach: [3] upper bounds of the camera's coordinates.
        rotation_reach: [9] upper bounds of the rotation's absolute entries.
        camera: fx, fy, cx, cy, width, height.
        rules: See `ns_abstract.methods.splat.constants.rules_array`.
        errors: unit, flush, division, sqrt, rsqrt, exp errors in units, largest product.
        record, box, tiles, depth, delta, depth_error, state: outputs, one row per candidate;
            ``box`` [n, 4] pixels x0, x1, y0, y1; ``tiles`` [n, 8] outer then inner tile ranges;
            ``depth`` [n] at the middle; ``delta`` [n, 3] mean minus origin; ``state`` [n] 1 if visible.
    """
    for chunk in prange((candidates.shape[0] + _CHUNK - 1) // _CHUNK):
        _stage_chunk(
            chunk, candidates, means, axes, noise, opacity_low, opacity_high, mean_radius,
            rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors,
            d, order, m, antialiased,
            record, box, tiles, depth, delta, depth_error, state,
        )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _coordinate_error(rotation_reach, camera_reach, means, mean_radius, i, row, unit):
    """Float error of one camera coordinate (design.md, G2, S2): ten units of the sum of absolute products."""
    total = 0.0
    for k in range(3):
        size = abs(means[i, k])
        if mean_radius.shape[0] > 0:
            size += mean_radius[i, k]
        total += rotation_reach[3 * row + k] * (size + camera_reach[k])
    return 10.0 * unit * total * _UP


@njit(cache=True, error_model="numpy")
def _mean_spread(rotation_reach, mean_radius, i, row):
    """How far a Gaussian's own range moves one camera coordinate (design.md, S2); 0 without ranges."""
    total = 0.0
    if mean_radius.shape[0] > 0:
        for k in range(3):
            total += rotation_reach[3 * row + k] * mean_radius[i, k]
    return total * _UP


@njit(cache=True, error_model="numpy")
def _cull_block(
    candidates, first, lanes, means, axes, opacity_high, mean_radius, rotation, offset, origin,
    camera_reach, rotation_reach, camera, rules, errors, d, order, m, antialiased, work, scalars, vectors,
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
        error_z = _coordinate_error(rotation_reach, camera_reach, means, mean_radius, i, 2, unit)
        spread_z = _mean_spread(rotation_reach, mean_radius, i, 2) + error_z
        if not (scalars[_ZHI, q] + spread_z >= near and scalars[_ZLO, q] - spread_z <= far):
            # a bound that is not a number keeps the Gaussian
            if scalars[_ZHI, q] + spread_z < near or scalars[_ZLO, q] - spread_z > far:
                continue
        # antialiased, rounding may raise it: see _finish
        if not antialiased and opacity_high[i] * (1.0 + 64.0 * unit) < alpha_min:
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
            middle = focal * work[_X + axis, 0, q]
            if -center * work[_Z, 0, q] <= middle and middle <= (extent - center) * work[_Z, 0, q]:
                # inside the image at the middle pose
                continue
            error = focal * (
                _coordinate_error(rotation_reach, camera_reach, means, mean_radius, i, axis, unit)
                + _mean_spread(rotation_reach, mean_radius, i, axis)
            ) + (max(extent, abs(center), abs(extent - center)) + blur) * spread_z
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


@njit(cache=True, error_model="numpy")
def _linear_top(a, b, q, s, t, m):
    """Upper bound of ``s a + t b`` over the box."""
    top = s * a[0, q] + t * b[0, q] + abs(s) * a[m, q] + abs(t) * b[m, q]
    for k in range(1, m):
        top += abs(s * a[k, q] + t * b[k, q])
    magnitude = abs(s) * (abs(a[0, q]) + a[m + 1, q] + a[m + 2, q]) + abs(t) * (
        abs(b[0, q]) + b[m + 1, q] + b[m + 2, q]
    )
    return top + 8.0 * _COEFFICIENT * magnitude


@njit(cache=True, error_model="numpy")
def _project_block(
    candidates, block, means, axes, noise, opacity_low, opacity_high, mean_radius,
    rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors,
    d, order, m, antialiased, work, scalars, scratch, vectors,
    record, box, tiles, depth, delta, depth_error, state,
):  # fmt: skip
    """Records of up to `LANES` Gaussians (design.md, G4-G9)."""
    eps2d, margin, unit = rules[2], rules[6], errors[0]
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
        i = candidates[index]
        record[index, MEAN_X] = scratch[0, q] + cx
        record[index, MEAN_Y] = scratch[1, q] + cy
        depth[index] = work[_Z, 0, q]
        # G10: rounding of the depth against that of another Gaussian; what both share is in the slope
        products = 0.0
        for k in range(3):
            size = abs(means[i, k])
            if mean_radius.shape[0] > 0:
                # twice: the slope's own rounding is charged for the means in the middle of their ranges (S3)
                size += 2.0 * mean_radius[i, k]
            products += rotation_reach[6 + k] * size
        depth_error[index] = unit * (4.2 * products + 1.1 * max(abs(scalars[_ZLO, q]), abs(scalars[_ZHI, q]))) + (
            _mean_spread(rotation_reach, mean_radius, i, 2)
        )
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
        _minus_product(work[_W0 + column], work[_U], work[_W6 + column], work[_N0 + column], d, order, m)
        _minus_product(work[_W3 + column], work[_V], work[_W6 + column], work[_N3 + column], d, order, m)
    # a' = fx^2 |n0|^2 + eps z^2, c' = fy^2 |n1|^2 + eps z^2, b' = fx fy n0.n1 (covariance times z^2)
    square(work[_Z], work[_T2], d, order, m)
    _dot3(work, _N0, _N0, _A, d, order, m)
    _dot3(work, _N3, _N3, _C, d, order, m)
    _dot3(work, _N0, _N3, _B, d, order, m)
    scale_add(work[_B], fx * fy, work[_B], 0.0, 0.0, work[_B], d, order, m)
    # det' = fx^2 fy^2 |n0 x n1|^2 + eps z^2 (fx^2 |n0|^2 + fy^2 |n1|^2) + eps^2 z^4, sums of squares only
    _cross_square(work, _K, d, order, m)
    scale_add(work[_K], (fx * fy) * (fx * fy), work[_K], 0.0, 0.0, work[_K], d, order, m)
    scale_add(work[_A], fx * fx, work[_C], fy * fy, 0.0, work[_T0], d, order, m)
    scale_add(work[_T0], eps2d, work[_T2], eps2d * eps2d, 0.0, work[_T1], d, order, m)
    for k in range(m + 3):
        for q in range(LANES):
            work[_DET, k, q] = work[_K, k, q]
    add_product(work[_T1], work[_T2], 1.0, work[_DET], d, order, m)
    settle(work[_DET], d, order, m)
    scale_add(work[_A], fx * fx, work[_T2], eps2d, 0.0, work[_A], d, order, m)
    scale_add(work[_C], fy * fy, work[_T2], eps2d, 0.0, work[_C], d, order, m)
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
            index, i, q, means, noise, opacity_low, opacity_high, mean_radius, camera_reach, rotation_reach,
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
    _clear(work[_T1])
    add_product(work[_P], work[_DX], 1.0, work[_T1], d, order, m)
    add_product(work[_Q], work[_DY], -1.0, work[_T1], d, order, m)
    settle(work[_T1], d, order, m)
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


@njit(cache=True, error_model="numpy")
def _clear(out):
    for k in range(out.shape[0]):
        for q in range(out.shape[1]):
            out[k, q] = 0.0


@njit(cache=True, error_model="numpy")
def _minus_product(c, a, b, out, d, order, m):
    """``out = c - a * b``."""
    for k in range(m + 1):
        for q in range(out.shape[1]):
            out[k, q] = c[k, q]
    add_product(a, b, -1.0, out, d, order, m)
    # the subtraction's own rounding, for what `c` adds
    for q in range(out.shape[1]):
        out[m, q] += _COEFFICIENT * (abs(c[0, q]) + c[m + 1, q] + c[m + 2, q])
    settle(out, d, order, m)


@njit(cache=True, error_model="numpy")
def _dot3(work, a, b, out, d, order, m):
    """``work[out] = work[a..a+2] . work[b..b+2]``."""
    _clear(work[out])
    for k in range(3):
        if a == b:
            add_square(work[a + k], work[out], d, order, m)
        else:
            add_product(work[a + k], work[b + k], 1.0, work[out], d, order, m)
    settle(work[out], d, order, m)


@njit(cache=True, error_model="numpy")
def _cross_square(work, out, d, order, m):
    """``work[out] = |n0 x n1|^2``; uses slot _T0."""
    _clear(work[out])
    for k in range(3):
        i, j = (0, 1) if k == 0 else ((0, 2) if k == 1 else (1, 2))
        _clear(work[_T0])
        add_product(work[_N0 + i], work[_N3 + j], 1.0, work[_T0], d, order, m)
        add_product(work[_N0 + j], work[_N3 + i], -1.0, work[_T0], d, order, m)
        settle(work[_T0], d, order, m)
        add_square(work[_T0], work[out], d, order, m)
    settle(work[out], d, order, m)


@njit(cache=True, error_model="numpy")
def _finish(
    index, i, q, means, noise, opacity_low, opacity_high, mean_radius, camera_reach, rotation_reach,
    rules, camera, errors, m, antialiased, work, scalars, record, box, tiles, depth_error, state,
):  # fmt: skip
    """Float errors, pixel region and tile ranges of one Gaussian (design.md, G5-G9)."""
    near, tile, sigmas, discriminant_min, margin, alpha_min, work_tile = (
        rules[0], rules[3], rules[4], rules[5], rules[6], rules[7], rules[10],
    )  # fmt: skip
    fx, fy, cx, cy, width, height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    unit, division, root, overflow = errors[0], errors[2], errors[3], errors[6]
    stride = m + 1
    record[index, FORMS + 3 * stride + m] = 0.0
    record[index, KAPPA] = 0.0
    record[index, WILD] = 1.0
    # sigmoid: two exponentials or divisions and an addition
    slack = 12.0 * unit
    record[index, OPACITY_LOW] = opacity_low[i] * (1.0 - slack)
    # the compensation's own division and root
    above = 1.0 + (0.5 * division + root + 2.0) * unit if antialiased else 1.0
    opacity = opacity_high[i] * (1.0 + slack) * above
    # det0/det exceeds 1 where rounding lowers det: nothing is known before its error is
    record[index, OPACITY_HIGH] = 1.0 if antialiased else opacity
    tiles_x = int(math.ceil(width / (tile if tile > 0.0 else work_tile)))
    tiles_y = int(math.ceil(height / (tile if tile > 0.0 else work_tile)))
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
    error_x = _coordinate_error(rotation_reach, camera_reach, means, mean_radius, i, 0, unit)
    error_y = _coordinate_error(rotation_reach, camera_reach, means, mean_radius, i, 1, unit)
    error_z = _coordinate_error(rotation_reach, camera_reach, means, mean_radius, i, 2, unit)
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
    depth_variance = 0.0
    for k in range(3):
        w = work[_W6 + k]
        reach = abs(w[0, q]) + w[m + 1, q] + w[m + 2, q] + w[m, q]
        depth_variance += reach * reach
    gx0 = jx * (rotation_reach[0] + ratio_x * rotation_reach[6])
    gx1 = jx * (rotation_reach[1] + ratio_x * rotation_reach[7])
    gx2 = jx * (rotation_reach[2] + ratio_x * rotation_reach[8])
    gy0 = jy * (rotation_reach[3] + ratio_y * rotation_reach[6])
    gy1 = jy * (rotation_reach[4] + ratio_y * rotation_reach[7])
    gy2 = jy * (rotation_reach[5] + ratio_y * rotation_reach[8])
    grow = relative_j * (2.0 + relative_j)
    f00 = noise[i, 0] + grow * noise[i, 6]
    f11 = noise[i, 1] + grow * noise[i, 7]
    f22 = noise[i, 2] + grow * noise[i, 8]
    f01 = noise[i, 3] + grow * noise[i, 9]
    f02 = noise[i, 4] + grow * noise[i, 10]
    f12 = noise[i, 5] + grow * noise[i, 11]
    r0, r1, r2 = rotation_reach[6], rotation_reach[7], rotation_reach[8]
    depth_variance += f00 * r0 * r0 + f11 * r1 * r1 + f22 * r2 * r2
    depth_variance += 2.0 * (f01 * r0 * r1 + f02 * r0 * r2 + f12 * r1 * r2)
    h0 = f00 * gx0 + f01 * gx1 + f02 * gx2
    h1 = f01 * gx0 + f11 * gx1 + f12 * gx2
    h2 = f02 * gx0 + f12 * gx1 + f22 * gx2
    error_a = gx0 * h0 + gx1 * h1 + gx2 * h2
    error_b = gy0 * h0 + gy1 * h1 + gy2 * h2
    error_c = (
        gy0 * (f00 * gy0 + f01 * gy1 + f02 * gy2)
        + gy1 * (f01 * gy0 + f11 * gy1 + f12 * gy2)
        + gy2 * (f02 * gy0 + f12 * gy1 + f22 * gy2)
    )
    a = scalars[_AHI, q] / (z_low * z_low)
    c = scalars[_CHI, q] / (z_low * z_low)
    b = max(abs(scalars[_BLO, q]), abs(scalars[_BHI, q])) / (z_low * z_low)
    # products of covariances that may overflow leave nothing known
    if not a * c < overflow:
        return
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
        c * error_a
        + a * error_c
        + 2.0 * b * error_b
        + error_a * error_c
        + error_b * error_b
        + 6.0 * unit * (a * c + b * b)
    ) * 1.01
    error_disc = 2.0 * half_high * error_half + error_half * error_half + error_det + 4.0 * unit * half_high * half_high
    disc_high = max(discriminant_min, difference * difference + b * b + error_disc)
    disc_low = max(discriminant_min, nearest * nearest + b_nearest * b_nearest - error_disc)
    top_high = (half_high + error_half + math.sqrt(disc_high)) * (1.0 + 2.0 * root * unit)
    top_low = max(0.0, half_low - error_half + math.sqrt(disc_low)) * (1.0 - 2.0 * root * unit)
    # np.ceil: math.ceil is an int64, which a huge Gaussian overflows
    radius_high = np.ceil(sigmas * math.sqrt(top_high) * (1.0 + 2.0 * root * unit) * _REGION)
    radius_low = np.ceil(sigmas * math.sqrt(top_low) * (1.0 - 2.0 * root * unit) / _REGION)
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
    if antialiased:
        # compensation_fl^2 <= (det + e0)/(det - e), which falls in det
        sharp_error = (error_det + 6.0 * unit * (a * c + b * b)) / det
        excess = math.sqrt((1.0 + sharp_error) / (1.0 - error_det / det)) * _REGION
        record[index, OPACITY_HIGH] = min(1.0, opacity * excess)
        if record[index, OPACITY_HIGH] * (1.0 + 64.0 * unit) < alpha_min:
            state[index] = 0
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
        record[index, OPACITY_HIGH] = opacity * (1.0 + compensation_slack)
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
        return
    # tiles without such pixels need not look at it
    side = tile if tile > 0.0 else work_tile
    tiles[index, 0] = max(tiles[index, 0], int(math.floor(max(box[index, 0] - 0.5, 0.0) / side)))
    tiles[index, 1] = min(tiles[index, 1], int(math.floor(min(box[index, 1] - 0.5, width) / side)) + 1)
    tiles[index, 2] = max(tiles[index, 2], int(math.floor(max(box[index, 2] - 0.5, 0.0) / side)))
    tiles[index, 3] = min(tiles[index, 3], int(math.floor(min(box[index, 3] - 0.5, height) / side)) + 1)
