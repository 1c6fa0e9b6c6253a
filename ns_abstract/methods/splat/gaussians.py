"""Per-Gaussian stage of the bounds: from pose forms to what a pixel needs (design.md, G1-G10).

Gaussians that no pose of the cell shows are dropped, the others projected in blocks: by `line_projection` for one
parameter and order 2, by the forms' array kernels here otherwise. `records` tells what is left of each.
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
from ns_abstract.methods.splat import records as row
from ns_abstract.methods.splat.line_projection import compensate_line, project_line
from ns_abstract.methods.splat.records import (
    FAINT,
    FORMS,
    KAPPA,
    LANES,
    MEAN_X,
    MEAN_Y,
    OPACITY_HIGH,
    OPACITY_LOW,
    REGION,
    SPREAD,
    WILD,
    coordinate_errors,
    float_errors,
    gather,
    gather_means,
    regions,
)

_CHUNK = 1024
_COEFFICIENT = 8.0 * UNIT64
_UP = 1.0 + 128.0 * UNIT64

# workspace slots
(
    _X, _Y, _Z, _RZ, _U, _V,
    _W0, _W1, _W2, _W3, _W4, _W5, _W6, _W7, _W8,
    _N0, _N1, _N2, _N3, _N4, _N5,
    _A, _B, _C, _DET, _K, _T0, _T1, _T2, _P, _Q, _S, _DX, _DY,
) = range(34)  # fmt: skip
_SLOTS = 34
# where `_project_forms` leaves P, Q, S, W1, W2
_FORMS = _N0


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
    """Replace ``a`` by ``min(limit_high, max(-limit_low, a))`` given its bounds; ``other`` [2, n] is scratch."""
    clamp_below(a, -limit_low, low, high, d, order, m)
    for q in range(a.shape[1]):
        other[0, q] = -max(high[q], -limit_low)
        other[1, q] = -max(low[q], -limit_low)
    negate(a, m)
    clamp_below(a, -limit_high, other[0], other[1], d, order, m)
    negate(a, m)


@njit(cache=True, error_model="numpy")
def _stage_chunk(
    chunk, candidates_, means_, axes_, noise_, opacity_low_, opacity_high_, faint_, mean_radius_,
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
    faint = borrowed(faint_)
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
    work_ = np.empty((_SLOTS, m + 3, LANES))
    work = borrowed(work_)
    table_ = np.empty((row.ROWS, LANES))
    table = borrowed(table_)
    s = borrowed(table_.reshape(-1))
    scratch_ = np.empty((5, LANES))
    scratch = borrowed(scratch_)
    alive_ = np.empty(_CHUNK, np.int64)
    alive = borrowed(alive_)
    start = chunk * _CHUNK
    stop = min(n, start + _CHUNK)
    everyone_ = np.arange(start, stop)
    everyone = borrowed(everyone_)
    count = 0
    for first in range(start, stop, LANES):
        lanes = min(LANES, stop - first)
        count = _cull_block(
            candidates, everyone[first - start : first - start + lanes], means, axes, opacity_high, mean_radius,
            rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors, d, order, m, antialiased,
            work, table, s, state, alive, count,
        )  # fmt: skip
    for first in range(0, count, LANES):
        lanes = min(LANES, count - first)
        _project_block(
            candidates, alive[first : first + lanes], means, axes, noise, opacity_low, opacity_high, faint, mean_radius,
            rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors,
            d, order, m, antialiased, work, table, s, scratch, record, box, tiles, depth, delta, depth_error, state,
        )  # fmt: skip
    # the owners of the borrowed arrays live to here
    return work_.size + table_.size + scratch_.size + alive_.size + everyone_.size


@njit(cache=True, parallel=True, error_model="numpy")
def gaussian_stage(
    candidates, means, axes, noise, opacity_low, opacity_high, faint, mean_radius,
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
        faint: [N] see `records.faint_exponents`.
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
            chunk, candidates, means, axes, noise, opacity_low, opacity_high, faint, mean_radius,
            rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors,
            d, order, m, antialiased,
            record, box, tiles, depth, delta, depth_error, state,
        )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _cull_block(
    candidates, block, means, axes, opacity_high, mean_radius, rotation, offset, origin, camera_reach, rotation_reach,
    camera, rules, errors, d, order, m, antialiased, work, table, s, state, alive, count,
):  # fmt: skip
    """Drop the Gaussians of ``block`` that no pose of the cell shows (design.md, G3); others go to ``alive``."""
    near, far, alpha_min, margin = rules[0], rules[1], rules[7], rules[6]
    fx, fy, cx, cy, width, height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    unit = errors[0]
    gather_means(candidates, block, means, mean_radius, origin, s)
    coordinate_errors(s, table.shape[1], rotation_reach, camera_reach, unit)
    vectors = table[row.V0 // LANES : row.V2 // LANES + 1]
    _rotate(rotation, 0, vectors, offset, work[_X], d, order, m)
    _rotate(rotation, 1, vectors, offset, work[_Y], d, order, m)
    _rotate(rotation, 2, vectors, offset, work[_Z], d, order, m)
    nearest, farthest = table[row.ZLO // LANES], table[row.ZHI // LANES]
    bounds(work[_Z], nearest, farthest, d, order, m)
    limit_x = max(cx, width - cx) / fx + margin * 0.5 * width / fx
    limit_y = max(cy, height - cy) / fy + margin * 0.5 * height / fy
    if margin >= 0.0:
        stretch = math.sqrt(fx * fx * (1.0 + limit_x * limit_x) + fy * fy * (1.0 + limit_y * limit_y)) * REGION
    else:
        stretch = np.inf
    # radius <= 3 sqrt(lambda + 0.1) + 1 <= 3 |J| s + 3 sqrt(eps2d + 0.1) + 1, times z
    blur = rules[4] * math.sqrt(rules[2] + math.sqrt(rules[5])) + 2.0
    for q in range(block.shape[0]):
        index = block[q]
        i = candidates[index]
        state[index] = 0
        spread_z = s[row.SZ + q] + s[row.EZ + q]
        if not (farthest[q] + spread_z >= near and nearest[q] - spread_z <= far):
            # a bound that is not a number keeps the Gaussian
            if farthest[q] + spread_z < near or nearest[q] - spread_z > far:
                continue
        # antialiased, rounding may raise it: see `regions`
        if not antialiased and opacity_high[i] * (1.0 + 64.0 * unit) < alpha_min:
            continue
        size = 0.0
        for k in range(3):
            size = max(size, axes[i, 0, k] ** 2 + axes[i, 1, k] ** 2 + axes[i, 2, k] ** 2)
        reach = rules[4] * stretch * math.sqrt(size) * REGION
        outside = False
        for axis in range(2):
            focal = fx if axis == 0 else fy
            center = cx if axis == 0 else cy
            extent = width if axis == 0 else height
            middle = focal * work[_X + axis, 0, q]
            if -center * work[_Z, 0, q] <= middle and middle <= (extent - center) * work[_Z, 0, q]:
                # inside the image at the middle pose
                continue
            error = focal * (s[row.EX + axis * LANES + q] + s[row.SX + axis * LANES + q])
            error += (max(extent, abs(center), abs(extent - center)) + blur) * spread_z
            # focal x + (center + blur) z + reach < 0: left of the image at every pose with z > 0
            low_side = _linear_top(work[_X + axis], work[_Z], q, focal, center + blur, m)
            high_side = _linear_top(work[_X + axis], work[_Z], q, -focal, extent - center + blur, m)
            if (low_side + reach + error) * REGION < 0.0 or (high_side + reach + error) * REGION < 0.0:
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
    candidates, block, means, axes, noise, opacity_low, opacity_high, faint, mean_radius,
    rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors,
    d, order, m, antialiased, work, table, s, scratch, record, box, tiles, depth, delta, depth_error, state,
):  # fmt: skip
    """Records of up to `LANES` Gaussians (design.md, G4-G10); ``s`` is ``table`` in one row."""
    unit, cx, cy = errors[0], camera[2], camera[3]
    # loops of a length that the compiler does not know become vector code
    n = table.shape[1]
    line = d == 1 and order == 2
    gather(candidates, block, means, axes, noise, mean_radius, opacity_low, opacity_high, faint, origin, s)
    coordinate_errors(s, n, rotation_reach, camera_reach, unit)
    if line:
        project_line(s, n, rotation, offset, camera, rules)
        if antialiased:
            compensate_line(s, n, work[_X], scratch, work[_Y])
    else:
        _project_forms(work, table, s, scratch, rotation, offset, camera, rules, d, order, m, antialiased)
    float_errors(s, n, rules, camera, errors, rotation_reach)
    regions(s, n, rules, camera, errors, antialiased)
    stride = m + 1
    count = 6 if antialiased else 5
    reach0, reach1, reach2 = rotation_reach[6], rotation_reach[7], rotation_reach[8]
    for q in range(block.shape[0]):
        index = block[q]
        if s[row.GONE + q] != 0.0:
            state[index] = 0
            continue
        depth[index] = s[row.Z0 + q]
        # G10: rounding of the depth against that of another Gaussian; what both share is in the slope, whose own
        # rounding is charged for the means in the middle of their ranges (S3), hence twice
        products = (
            reach0 * (s[row.M0 + q] + 2.0 * s[row.R0 + q])
            + reach1 * (s[row.M1 + q] + 2.0 * s[row.R1 + q])
            + reach2 * (s[row.M2 + q] + 2.0 * s[row.R2 + q])
        )
        depth_error[index] = (
            unit * (4.2 * products + 1.1 * max(abs(s[row.ZLO + q]), abs(s[row.ZHI + q]))) + s[row.SZ + q]
        )
        for k in range(3):
            delta[index, k] = s[row.V0 + k * LANES + q]
        for k in range(4):
            box[index, k] = s[row.BOX0 + k * LANES + q]
        for k in range(8):
            tiles[index, k] = int(s[row.T0 + k * LANES + q])
        record[index, MEAN_X] = s[row.X0 + q] + cx
        record[index, MEAN_Y] = s[row.Y0 + q] + cy
        record[index, OPACITY_LOW] = s[row.LOWER + q]
        record[index, OPACITY_HIGH] = s[row.UPPER + q]
        record[index, KAPPA] = s[row.BEND + q]
        record[index, FAINT] = s[row.LAST + q]
        record[index, WILD] = 1.0 - s[row.KNOWN + q]
        if s[row.KNOWN + q] == 0.0:
            continue
        total = 0.0
        for f in range(count):
            start = FORMS + f * stride
            if line:
                for k in range(stride):
                    record[index, start + k] = s[row.FP + (4 * f + k) * LANES + q]
            else:
                form = work[_K if f == 5 else _FORMS + f]
                for k in range(stride):
                    record[index, start + k] = form[k, q]
            # with 16 units for the rounding of what the pixel stage adds up
            spread = _COEFFICIENT * 2.0 * abs(record[index, start])
            for k in range(1, stride):
                spread += abs(record[index, start + k])
            if f < 5:
                record[index, SPREAD + f] = spread
            total += abs(record[index, start]) + spread
        # float error of the mean, in units of y
        for f in (3, 4):
            record[index, FORMS + f * stride + m] += s[row.EW + q]
            record[index, SPREAD + f] += s[row.EW + q]
        if not math.isfinite(total + s[row.EW + q]):
            record[index, WILD] = 1.0
            record[index, FAINT] = -1.0


@njit(cache=True, error_model="numpy")
def _project_forms(work, table, s, scratch, rotation, offset, camera, rules, d, order, m, antialiased):
    """`line_projection.project_line` for any number of parameters: forms into the slots _FORMS .. and _K."""
    eps2d, margin = rules[2], rules[6]
    fx, fy, cx, cy, width, height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    none = np.empty((0, 3))
    for r in range(3):
        _rotate(rotation, r, table[row.V0 // LANES : row.V2 // LANES + 1], offset, work[_X + r], d, order, m)
        for q in range(LANES):
            work[_X + r, m, q] += s[row.SX + r * LANES + q]
    bounds(work[_Z], table[row.ZLO // LANES], table[row.ZHI // LANES], d, order, m)
    # u = x / z, v = y / z
    reciprocal(work[_Z], scratch, work[_RZ], d, order, m)
    multiply(work[_X], work[_RZ], work[_U], d, order, m)
    multiply(work[_Y], work[_RZ], work[_V], d, order, m)
    bounds(work[_U], table[row.ULO // LANES], table[row.UHI // LANES], d, order, m)
    bounds(work[_V], table[row.VLO // LANES], table[row.VHI // LANES], d, order, m)
    # pixel offsets: X^ = fx x - (mean_x - cx) z, which vanishes at the middle
    for axis in range(2):
        focal = fx if axis == 0 else fy
        source = work[_X + axis]
        target = work[_DX + axis]
        shifts = table[row.X0 // LANES + axis]
        for q in range(LANES):
            # the pixel offset used later is exactly focal * ratio in float64
            shift = focal * work[_U + axis, 0, q]
            pa = abs(source[0, q]) + source[m + 1, q] + source[m + 2, q]
            pb = abs(work[_Z, 0, q]) + work[_Z, m + 1, q] + work[_Z, m + 2, q]
            target[m, q] = (
                focal * source[m, q] + abs(shift) * work[_Z, m, q] + _COEFFICIENT * (focal * pa + abs(shift) * pb)
            ) * _UP
            shifts[q] = shift
        for k in range(m):
            for q in range(LANES):
                target[k, q] = focal * source[k, q] - shifts[q] * work[_Z, k, q]
        settle(target, d, order, m)
    for q in range(LANES):
        s[row.Z0 + q] = work[_Z, 0, q]
    # the Jacobian's clamped ratios
    if margin >= 0.0:
        # scratch rows serve as the clamp's own bounds; u and v keep theirs for the means
        for axis in range(2):
            focal = fx if axis == 0 else fy
            center = cx if axis == 0 else cy
            extent = width if axis == 0 else height
            for q in range(LANES):
                scratch[0, q] = s[row.ULO + 2 * axis * LANES + q]
                scratch[1, q] = s[row.UHI + 2 * axis * LANES + q]
            extra = margin * 0.5 * extent / focal
            _clamp_ratio(
                work[_U + axis], scratch[0], scratch[1], center / focal + extra, (extent - center) / focal + extra,
                scratch[2:4], d, order, m,
            )  # fmt: skip
    # w = R B, then n0 = w0 - u w2, n1 = w1 - v w2
    for column in range(3):
        first = row.B00 // LANES + 3 * column
        for r in range(3):
            _rotate(rotation, r, table[first : first + 3], none, work[_W0 + 3 * r + column], d, order, m)
        w = work[_W6 + column]
        for q in range(LANES):
            s[row.DEEP0 + column * LANES + q] = abs(w[0, q]) + w[m + 1, q] + w[m + 2, q] + w[m, q]
        _minus_product(work[_W0 + column], work[_U], w, work[_N0 + column], d, order, m)
        _minus_product(work[_W3 + column], work[_V], w, work[_N3 + column], d, order, m)
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
    bounds(work[_A], table[row.ALO // LANES], table[row.AHI // LANES], d, order, m)
    bounds(work[_C], table[row.CLO // LANES], table[row.CHI // LANES], d, order, m)
    bounds(work[_B], table[row.BLO // LANES], table[row.BHI // LANES], d, order, m)
    bounds(work[_DET], table[row.DLO // LANES], table[row.DHI // LANES], d, order, m)
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
    bounds(work[_T1], table[row.LO // LANES], table[row.HI // LANES], d, order, m)
    if antialiased:
        # K = -log(compensation), compensation^2 = |n0 x n1|^2 / det'
        reciprocal(work[_DET], scratch, work[_T0], d, order, m)
        multiply(work[_K], work[_T0], work[_T1], d, order, m)
        bounds(work[_T1], table[row.DISC // LANES], scratch[2], d, order, m)
        logarithm(work[_T1], scratch, work[_T0], d, order, m)
        scale_add(work[_T0], -0.5, work[_T0], 0.0, 0.0, work[_K], d, order, m)
    # P = P' z, Q = Q' z, S = S' z, W1 = P' X^ - Q' Y^, W2 = S' Y^
    multiply(work[_P], work[_Z], work[_FORMS], d, order, m)
    multiply(work[_Q], work[_Z], work[_FORMS + 1], d, order, m)
    multiply(work[_S], work[_Z], work[_FORMS + 2], d, order, m)
    shift = work[_FORMS + 3]
    _clear(shift)
    add_product(work[_P], work[_DX], 1.0, shift, d, order, m)
    add_product(work[_Q], work[_DY], -1.0, shift, d, order, m)
    settle(shift, d, order, m)
    multiply(work[_S], work[_DY], work[_FORMS + 4], d, order, m)


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
