"""Per-Gaussian stage of the bounds: from pose forms to what a pixel needs (design.md, G1-G10).

Gaussians that no pose of the cell shows are dropped, the others projected in blocks: by `line_projection` for one
parameter and order 2, by `form_projection` otherwise. `records` tells what is left of each.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from ns_abstract.arithmetic.compiled import borrowed, pointer
from ns_abstract.arithmetic.lanes import bits, load8, scatter_columns, store, where
from ns_abstract.arithmetic.units import UNIT64
from ns_abstract.arithmetic.wide_forms import bounds, reach, size
from ns_abstract.methods.splat import records as row
from ns_abstract.methods.splat.form_projection import WORKSPACE, project_forms, rotate
from ns_abstract.methods.splat.line_projection import compensate_line, project_line
from ns_abstract.methods.splat.records import (
    LANES,
    REGION,
    coordinate_errors,
    float_errors,
    gather,
    gather_means,
    regions,
)

_CHUNK = 1024
_COEFFICIENT = 8.0 * UNIT64
_UP = 1.0 + 128.0 * UNIT64


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
def _stage_chunk(
    chunk, candidates_, means_, axes_, extents_, noise_, opacity_low_, opacity_high_, faint_, mean_radius_,
    rotation_, offset_, origin_, camera_reach_, rotation_reach_, camera_, rules_, errors_,
    d, order, m, antialiased,
    record_, box_, tiles_, depth_, delta_, depth_error_, state_,
):  # fmt: skip
    """One chunk of candidates; see `gaussian_stage`."""
    candidates = borrowed(candidates_)
    means = borrowed(means_)
    axes = borrowed(axes_)
    extents = borrowed(extents_)
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
    work_ = np.empty(WORKSPACE * size(m))
    work = borrowed(work_)
    table_ = np.empty((row.table_rows(record_.shape[1]), LANES))
    s = borrowed(table_.reshape(-1))
    scratch_ = np.empty((17, LANES))
    scratch = borrowed(scratch_)
    places_ = np.empty(LANES, np.int64)
    places = borrowed(places_)
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
            candidates, everyone[first - start : first - start + lanes], means, extents, opacity_high, mean_radius,
            rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors, d, order, m, antialiased,
            work, s, state, alive, count,
        )  # fmt: skip
    for first in range(0, count, LANES):
        lanes = min(LANES, count - first)
        _project_block(
            candidates, alive[first : first + lanes], means, axes, noise, opacity_low, opacity_high, faint, mean_radius,
            rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors,
            d, order, m, antialiased, work, s, scratch, places, record, box, tiles, depth, delta, depth_error, state,
        )  # fmt: skip
    # the owners of the borrowed arrays live to here
    return work_.size + table_.size + scratch_.size + places_.size + alive_.size + everyone_.size


@njit(cache=True, parallel=True, error_model="numpy")
def gaussian_stage(
    candidates, means, axes, extents, noise, opacity_low, opacity_high, faint, mean_radius,
    rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors,
    d, order, m, antialiased,
    record, box, tiles, depth, delta, depth_error, state,
):  # fmt: skip
    """Fill the records of ``candidates`` [n] (indices into the scene's arrays).

    Args:
        candidates: [n] int32.
        means, axes: [N, 3], [N, 3, 3] of the scene; means in the middle of their ranges.
        extents: [N] largest standard deviations, up to rounding.
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
        record, box, tiles, depth, delta, depth_error, state: outputs, one row per candidate; ``record`` has
            `records.columns`;
            ``box`` [n, 4] pixels x0, x1, y0, y1; ``tiles`` [n, 8] outer then inner tile ranges;
            ``depth`` [n] at the middle; ``delta`` [n, 3] mean minus origin; ``state`` [n] 1 if visible.
    """
    for chunk in prange((candidates.shape[0] + _CHUNK - 1) // _CHUNK):
        _stage_chunk(
            chunk, candidates, means, axes, extents, noise, opacity_low, opacity_high, faint, mean_radius,
            rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors,
            d, order, m, antialiased,
            record, box, tiles, depth, delta, depth_error, state,
        )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _cull_block(
    candidates, block, means, extents, opacity_high, mean_radius, rotation_, offset_, origin, camera_reach,
    rotation_reach, camera, rules, errors, d, order, m, antialiased, work_, s_, state, alive, count,
):  # fmt: skip
    """Drop the Gaussians of ``block`` that no pose of the cell shows (design.md, G3); others go to ``alive``."""
    rotation, offset, work, s = pointer(rotation_), pointer(offset_), pointer(work_), pointer(s_)
    near, far, alpha_min, margin = rules[0], rules[1], rules[7], rules[6]
    fx, fy, cx, cy, width, height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    unit = errors[0]
    gather_means(candidates, block, means, mean_radius, origin, s_)
    lanes = block.shape[0]
    for q in range(LANES):
        i = candidates[block[min(q, lanes - 1)]]
        s[row.EXTENT + q] = extents[i]
        s[row.OPHIGH + q] = opacity_high[i]
    coordinate_errors(s_, LANES, rotation_reach, camera_reach, unit)
    limit_x = max(cx, width - cx) / fx + margin * 0.5 * width / fx
    limit_y = max(cy, height - cy) / fy + margin * 0.5 * height / fy
    if margin >= 0.0:
        stretch = math.sqrt(fx * fx * (1.0 + limit_x * limit_x) + fy * fy * (1.0 + limit_y * limit_y)) * REGION
    else:
        stretch = np.inf
    # radius <= 3 sqrt(lambda + 0.1) + 1 <= 3 |J| s + 3 sqrt(eps2d + 0.1) + 1, times z
    blur = rules[4] * math.sqrt(rules[2] + math.sqrt(rules[5])) + 2.0
    z = 2 * size(m)
    for first in range(0, lanes, 8):
        v0, v1, v2 = load8(s, row.V0 + first), load8(s, row.V1 + first), load8(s, row.V2 + first)
        rotate(work, rotation, 2, v0, v1, v2, offset, True, 0.0 * v0, z, d, order, m)
        nearest, farthest = bounds(work, z, d, order, m)
        spread_z = load8(s, row.SZ + first) + load8(s, row.EZ + first)
        # a bound that is not a number keeps the Gaussian
        gone = (farthest + spread_z < near) | (nearest - spread_z > far)
        # antialiased, rounding may raise it: see `regions`
        if not antialiased:
            gone = gone | (load8(s, row.OPHIGH + first) * (1.0 + 64.0 * unit) < alpha_min)
        extent = rules[4] * stretch * load8(s, row.EXTENT + first) * REGION
        for axis in range(2):
            a = axis * size(m)
            focal, center, length = (fx, cx, width) if axis == 0 else (fy, cy, height)
            rotate(work, rotation, axis, v0, v1, v2, offset, True, 0.0 * v0, a, d, order, m)
            error = focal * (load8(s, row.EX + axis * LANES + first) + load8(s, row.SX + axis * LANES + first))
            error = extent + error + (max(length, abs(center), abs(length - center)) + blur) * spread_z
            # focal x + (center + blur) z + extent < 0: left of the image at every pose with z > 0
            before = _linear_top(work, a, focal, z, center + blur, order, m) + error
            behind = _linear_top(work, a, -focal, z, length - center + blur, order, m) + error
            gone = gone | (before * REGION < 0.0) | (behind * REGION < 0.0)
        hidden = bits(gone)
        for lane in range(min(8, lanes - first)):
            index = block[first + lane]
            if hidden & (1 << lane) != 0:
                state[index] = 0
                continue
            state[index] = 1
            alive[count] = index
            count += 1
    return count


@njit(cache=True, error_model="numpy", forceinline=True)
def _linear_top(w, a, s, b, t, order, m):
    """Upper bound of ``s a + t b`` over the box."""
    top = s * load8(w, a) + t * load8(w, b) + abs(s) * load8(w, a + 8 * m) + abs(t) * load8(w, b + 8 * m)
    for k in range(1, m):
        top = top + abs(s * load8(w, a + 8 * k) + t * load8(w, b + 8 * k))
    return top + 8.0 * _COEFFICIENT * (abs(s) * reach(w, a, order, m) + abs(t) * reach(w, b, order, m))


@njit(cache=True, error_model="numpy")
def _project_block(
    candidates, block, means, axes, noise, opacity_low, opacity_high, faint, mean_radius,
    rotation, offset, origin, camera_reach, rotation_reach, camera, rules, errors,
    d, order, m, antialiased, work, s, scratch, places, record, box, tiles, depth, delta, depth_error, state,
):  # fmt: skip
    """Records of up to `LANES` Gaussians (design.md, G4-G10)."""
    unit, cx, cy = errors[0], camera[2], camera[3]
    # loops of a length that the compiler does not know become vector code
    n = scratch.shape[1]
    gather(candidates, block, means, axes, noise, mean_radius, opacity_low, opacity_high, faint, origin, s)
    coordinate_errors(s, n, rotation_reach, camera_reach, unit)
    if d == 1 and order == 2:
        project_line(s, n, rotation, offset, camera, rules)
        if antialiased:
            compensate_line(s, n, scratch[:6], scratch[6:11], scratch[11:])
    else:
        project_forms(
            pointer(work), pointer(s), pointer(rotation), pointer(offset), camera, rules, d, order, m, antialiased
        )
    float_errors(s, n, rules, camera, errors, rotation_reach)
    regions(s, n, rules, camera, errors, antialiased)
    _fill_records(pointer(s), cx, cy, 6 if antialiased else 5, m)
    last = block.shape[0] - 1
    for q in range(LANES):
        places[q] = block[min(q, last)]
    width = record.shape[1]
    lanes, out, to = pointer(s), pointer(record), pointer(places)
    for q in range(0, LANES, 8):
        for column in range(0, width, 8):
            at = row.RECORD + column * LANES + q
            # lanes in excess repeat the last one
            scatter_columns(
                out, to, q, width, column, load8(lanes, at), load8(lanes, at + LANES),
                load8(lanes, at + 2 * LANES), load8(lanes, at + 3 * LANES), load8(lanes, at + 4 * LANES),
                load8(lanes, at + 5 * LANES), load8(lanes, at + 6 * LANES), load8(lanes, at + 7 * LANES),
            )  # fmt: skip
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


@njit(cache=True, error_model="numpy")
def _fill_records(s, cx, cy, count, m):
    """What `regions` left open of the columns before a record's ``count`` forms; the mean's float error in these."""
    stride = m + 1
    for q in range(0, LANES, 8):
        store(s, row.R_MEAN_X + q, load8(s, row.X0 + q) + cx)
        store(s, row.R_MEAN_Y + q, load8(s, row.Y0 + q) + cy)
        # in units of y
        mean_error = load8(s, row.EW + q)
        total = mean_error
        for f in range(count):
            start = row.FP + f * stride * LANES + q
            first = abs(load8(s, start))
            # with 16 units for the rounding of what the pixel stage adds up
            spread = 2.0 * _COEFFICIENT * first
            for k in range(1, stride):
                spread = spread + abs(load8(s, start + k * LANES))
            if f == 3 or f == 4:
                spread = spread + mean_error
                store(s, start + m * LANES, load8(s, start + m * LANES) + mean_error)
            if f < 5:
                store(s, row.R_SPREAD + f * LANES + q, spread)
            total = total + first + spread
        tame = (load8(s, row.KNOWN + q) == 1.0) & (total < np.inf)
        store(s, row.R_WILD + q, where(tame, 0.0, 1.0))
        store(s, row.R_FAINT + q, where(tame, load8(s, row.R_FAINT + q), -1.0))
