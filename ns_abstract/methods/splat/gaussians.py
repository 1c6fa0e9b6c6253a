"""The per-Gaussian stage of the bounds: projects Gaussians over a cell's poses (docs/dev/design.md, G1-G11).

Gaussians that no pose of the cell shows are dropped. The others are projected in blocks: by `line_projection` for one
parameter and order 2, by `form_projection` otherwise. `projection_errors` describes the records.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import CULL_ROUNDING, WHITENED_ROUNDING, Charges
from ns_abstract.arithmetic.simd.intrinsics import borrowed, pointer, signed, taken
from ns_abstract.arithmetic.simd.lanes import bits, load8, scatter_columns, store, where
from ns_abstract.arithmetic.simd.wide_forms import bounds, magnitude, size
from ns_abstract.geometry.camera_path import Intrinsics
from ns_abstract.methods.splat import projection_errors as row
from ns_abstract.methods.splat.constants import RasterRules
from ns_abstract.methods.splat.form_projection import WORKSPACE, project_forms, rotate
from ns_abstract.methods.splat.line_projection import compensate_line, project_line
from ns_abstract.methods.splat.pixel_regions import projected_stretch, regions
from ns_abstract.methods.splat.projection_errors import (
    LANES,
    REGION,
    compensations,
    coordinate_errors,
    float_errors,
    gather,
    gather_means,
)
from ns_abstract.methods.splat.stage_data import (
    CellPoses,
    FormShape,
    ProjectedGaussians,
    ProjectionInputs,
    SceneGaussians,
)
from ns_abstract.methods.splat.work_sharing import CHUNK, run_in_chunks


def covariance_noise(axes: np.ndarray, charges: Charges) -> np.ndarray:
    """Return the float error of each world covariance and of the products made with it (design.md, G6).

    ``axes``: [N, 3, 3] scaled principal axes. The result [N, 12] holds error bounds, then absolute values, of the
    entries 00, 11, 22, 01, 02, 12.
    """
    size = np.abs(axes)
    scale = np.sqrt(np.sum(axes * axes, axis=1))  # [N, 3]
    out = np.empty((axes.shape[0], 12))
    entry = charges.rotation_entry
    squares = np.sum(scale * scale, axis=1)
    for k, (r, c) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
        covariance = np.abs(np.sum(axes[:, r] * axes[:, c], axis=1))
        products = np.sum(size[:, r] * size[:, c], axis=1)
        spread = np.sum(scale * (size[:, r] + size[:, c]), axis=1)
        out[:, k] = entry * spread + entry * entry * squares + charges.covariance_products * products
        out[:, k] = out[:, k] + charges.covariance * covariance + charges.flush
        out[:, 6 + k] = covariance * (1.0 + charges.covariance_size) + charges.covariance_size_products * products
    return out


class _ProjectionScratch(NamedTuple):
    """Memory for a block of `LANES` Gaussians.

    Attributes:
        work: Forms of eight, flat; see `form_projection`.
        rows: Rows of lanes, flat; see `projection_errors`.
        logarithms: [17, LANES] for `line_projection.compensate_line`.
        places: [LANES] rows of the output for the records.
    """

    work: np.ndarray
    rows: np.ndarray
    logarithms: np.ndarray
    places: np.ndarray


@njit(cache=True, error_model="numpy")
def _borrowed_inputs(scene, poses, camera, rules, charges, shape):
    """Return the `ProjectionInputs` without references to the arrays' owners."""
    scene = SceneGaussians(
        borrowed(scene.means), borrowed(scene.mean_radius), borrowed(scene.axes), borrowed(scene.extents),
        borrowed(scene.noise), borrowed(scene.opacity_low), borrowed(scene.opacity_high),
        borrowed(scene.exponent_limits),
    )  # fmt: skip
    poses = CellPoses(
        borrowed(poses.rotation), borrowed(poses.offset), borrowed(poses.origin), borrowed(poses.camera_magnitude),
        borrowed(poses.rotation_magnitude),
    )  # fmt: skip
    return ProjectionInputs(scene, poses, camera, rules, charges, shape)


@njit(cache=True, error_model="numpy", nogil=True)
def _stage_worker(counter_, candidates_, scene, poses, camera, rules, charges, shape, out, state_):
    """Compute `gaussian_stage` of the chunks of candidates that no other thread has taken."""
    counter, candidates, state = pointer(counter_), borrowed(candidates_), borrowed(state_)
    inputs = _borrowed_inputs(scene, poses, camera, rules, charges, shape)
    out = ProjectedGaussians(
        borrowed(out.record), borrowed(out.box), borrowed(out.tiles), borrowed(out.depth), borrowed(out.delta),
        borrowed(out.depth_error),
    )  # fmt: skip
    owned = _ProjectionScratch(
        np.empty(WORKSPACE * size(inputs.shape.monomials)),
        np.empty(row.table_rows(out.record.shape[1]) * LANES),
        np.empty((17, LANES)),
        np.empty(LANES, np.int64),
    )
    scratch = _ProjectionScratch(
        borrowed(owned.work), borrowed(owned.rows), borrowed(owned.logarithms), borrowed(owned.places)
    )
    alive_, everyone_ = np.empty(CHUNK, np.int64), np.empty(CHUNK, np.int64)
    alive, everyone = borrowed(alive_), borrowed(everyone_)
    while True:
        start = taken(counter) * CHUNK
        if start >= candidates.shape[0]:
            break
        stop = min(candidates.shape[0], start + CHUNK)
        for k in range(stop - start):
            everyone[k] = start + k
        # not as a literal, for which what is called would be compiled once more
        count = signed(0)
        for first in range(0, stop - start, LANES):
            block = everyone[first : first + min(LANES, stop - start - first)]
            count = _cull_block(candidates, block, inputs, scratch, state, alive, count)
        for first in range(0, count, LANES):
            filled = min(LANES, count - first)
            _project_block(candidates, alive[first : first + filled], inputs, scratch, out, state)
    # the owners of the borrowed arrays live to here
    return len(owned) + alive_.size + everyone_.size


def gaussian_stage(
    candidates: np.ndarray, scene: SceneGaussians, poses: CellPoses, camera: Intrinsics, rules: RasterRules,
    charges: Charges, shape: FormShape, out: ProjectedGaussians, state: np.ndarray,
) -> None:  # fmt: skip
    """Project the ``candidates`` over a cell (design.md, G).

    Args:
        candidates: [n] int32 indices into the scene's arrays.
        out: The output; ``out.record`` has `projection_errors.columns`.
        state: [n] uint8 output: 1 if visible; else the candidate's row of ``out`` is not set.
    """
    run_in_chunks(
        _stage_worker, candidates.shape[0], candidates, scene, poses, camera, rules, charges, shape, out, state
    )


@njit(cache=True, error_model="numpy")
def _cull_block(candidates, block, inputs, scratch, state, alive, count):
    """Drop the Gaussians of ``block`` that no pose of the cell shows; append the others to ``alive`` (G3)."""
    scene, poses, rules, charges = inputs.scene, inputs.poses, inputs.rules, inputs.charges
    rotation, offset = pointer(poses.rotation), pointer(poses.offset)
    work, s_ = pointer(scratch.work), scratch.rows
    s = pointer(s_)
    d, order, m = inputs.shape.dimensions, inputs.shape.order, inputs.shape.monomials
    fx, fy, cx, cy, width, height = inputs.camera
    gather_means(candidates, block, scene, poses.origin, s_)
    filled = block.shape[0]
    extents, opacity_high = scene.extents, scene.opacity_high
    for q in range(LANES):
        i = candidates[block[min(q, filled - 1)]]
        s[row.EXTENT + q] = extents[i]
        s[row.OPHIGH + q] = opacity_high[i]
    coordinate_errors(s_, LANES, poses, charges)
    limit_x, limit_y = row.view_limits(rules, inputs.camera)
    if rules.view_margin >= 0.0:
        stretch = math.sqrt(fx * fx * (1.0 + limit_x * limit_x) + fy * fy * (1.0 + limit_y * limit_y)) * REGION
    else:
        stretch = np.inf
    # radius <= 3 sqrt(lambda + 0.1) + 1 <= 3 |J| s + 3 sqrt(eps2d + 0.1) + 1, times z
    blur = rules.radius_sigmas * math.sqrt(rules.eps2d + math.sqrt(rules.discriminant_min)) + 2.0
    # where products may overflow, anything may be shown (G9)
    safe = rules.near * math.sqrt(math.sqrt(charges.overflow)) * 0.5
    modelled = projected_stretch(rules, inputs.camera)
    most = charges.overflow / max(1.0, modelled / rules.near)
    z = 2 * size(m)
    for first in range(0, filled, 8):
        v = load8(s, row.V0 + first), load8(s, row.V1 + first), load8(s, row.V2 + first)
        rotate(work, rotation, 2, v, offset, True, 0.0 * v[0], z, inputs.shape)
        nearest, farthest = bounds(work, z, m, order, d)
        spread_z = load8(s, row.SZ + first) + load8(s, row.EZ + first)
        # a bound that is not a number keeps the Gaussian
        gone = (farthest + spread_z < rules.near) | (nearest - spread_z > rules.far)
        largest = load8(s, row.EXTENT + first)
        tame = (largest * modelled < safe) & (largest * largest < most)
        # antialiased, rounding may raise it: see `regions`
        if not rules.antialiased:
            gone = gone | (tame & (load8(s, row.OPHIGH + first) * (1.0 + charges.exponent_limit) < rules.alpha_min))
        extent = rules.radius_sigmas * stretch * largest * REGION
        for axis in range(2):
            a = axis * size(m)
            focal, center, length = (fx, cx, width) if axis == 0 else (fy, cy, height)
            rotate(work, rotation, axis, v, offset, True, 0.0 * v[0], a, inputs.shape)
            error = focal * (load8(s, row.EX + axis * LANES + first) + load8(s, row.SX + axis * LANES + first))
            error = extent + error + (max(length, abs(center), abs(length - center)) + blur) * spread_z
            # focal x + (center + blur) z + extent < 0: left of the image at every pose with z > 0
            before = _linear_top(work, a, focal, z, center + blur, order, m) + error
            behind = _linear_top(work, a, -focal, z, length - center + blur, order, m) + error
            gone = gone | (tame & ((before * REGION < 0.0) | (behind * REGION < 0.0)))
        hidden = bits(gone)
        for lane in range(min(8, filled - first)):
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
    """Return an upper bound of ``s a + t b`` over the box."""
    top = s * load8(w, a) + t * load8(w, b) + abs(s) * load8(w, a + 8 * m) + abs(t) * load8(w, b + 8 * m)
    for k in range(1, m):
        top = top + abs(s * load8(w, a + 8 * k) + t * load8(w, b + 8 * k))
    return top + CULL_ROUNDING * (abs(s) * magnitude(w, a, m, order) + abs(t) * magnitude(w, b, m, order))


@njit(cache=True, error_model="numpy")
def _project_block(candidates, block, inputs, scratch, out, state):
    """Write records of up to `LANES` Gaussians (design.md, G4-G11)."""
    scene, poses, camera, rules, charges, shape = inputs
    s, logarithms = scratch.rows, scratch.logarithms
    # loops of a length that the compiler does not know become vector code
    n = logarithms.shape[1]
    gather(candidates, block, scene, poses.origin, s)
    coordinate_errors(s, n, poses, charges)
    if shape.order == 2:
        project_line(s, n, poses.rotation, poses.offset, camera, rules)
        if rules.antialiased:
            compensate_line(s, n, logarithms[:6], logarithms[6:11], logarithms[11:])
    else:
        project_forms(
            pointer(scratch.work), pointer(s), pointer(poses.rotation), pointer(poses.offset), camera, rules, shape
        )
    float_errors(s, n, rules, camera, charges, poses.rotation_magnitude)
    if rules.antialiased:
        compensations(s, n, rules, charges)
    regions(s, n, rules, camera, charges)
    _fill_records(pointer(s), camera.cx, camera.cy, 6 if rules.antialiased else 5, shape.monomials)
    _scatter_records(block, s, scratch.places, out.record)
    _set_outputs(block, s, poses.rotation_magnitude, charges, out, state)


@njit(cache=True, error_model="numpy")
def _scatter_records(block, s, places, record):
    """Write the records in rows ``s`` to the rows of ``record`` that ``block`` names; ``places`` is scratch."""
    last = block.shape[0] - 1
    for q in range(LANES):
        places[q] = block[min(q, last)]
    width = record.shape[1]
    rows, out, to = pointer(s), pointer(record), pointer(places)
    for q in range(0, LANES, 8):
        for column in range(0, width, 8):
            at = row.RECORD + column * LANES + q
            # lanes in excess repeat the last one
            scatter_columns(
                out, to, q, width, column,
                (
                    load8(rows, at), load8(rows, at + LANES), load8(rows, at + 2 * LANES), load8(rows, at + 3 * LANES),
                    load8(rows, at + 4 * LANES), load8(rows, at + 5 * LANES), load8(rows, at + 6 * LANES),
                    load8(rows, at + 7 * LANES),
                ),
            )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _set_outputs(block, s, rotation_magnitude, charges, out, state):
    """Write the fields of `ProjectedGaussians` other than records, and the state (design.md, G10, S3)."""
    depth, depth_error, delta, box, tiles = out.depth, out.depth_error, out.delta, out.box, out.tiles
    r0, r1, r2 = rotation_magnitude[6], rotation_magnitude[7], rotation_magnitude[8]
    for q in range(block.shape[0]):
        index = block[q]
        if s[row.GONE + q] != 0.0:
            state[index] = 0
            continue
        depth[index] = s[row.Z0 + q]
        # rounding of the depth against that of another Gaussian; what both share is in the slope, whose own
        # rounding is charged for the means in the middle of their ranges (S3), hence twice
        products = (
            r0 * (s[row.M0 + q] + 2.0 * s[row.R0 + q])
            + r1 * (s[row.M1 + q] + 2.0 * s[row.R1 + q])
            + r2 * (s[row.M2 + q] + 2.0 * s[row.R2 + q])
        )
        farthest = max(abs(s[row.ZLO + q]), abs(s[row.ZHI + q]))
        depth_error[index] = charges.depth_products * products + charges.depth * farthest + s[row.SZ + q]
        for k in range(3):
            delta[index, k] = s[row.V0 + k * LANES + q]
        for k in range(4):
            box[index, k] = s[row.BOX0 + k * LANES + q]
        for k in range(8):
            tiles[index, k] = int(s[row.T0 + k * LANES + q])


@njit(cache=True, error_model="numpy")
def _fill_records(s, cx, cy, count, m):
    """Fill the columns before a record's ``count`` forms that `regions` left; charge forms for the mean's error."""
    stride = m + 1
    for q in range(0, LANES, 8):
        store(s, row.R_MEAN_X + q, load8(s, row.X0 + q) + cx)
        store(s, row.R_MEAN_Y + q, load8(s, row.Y0 + q) + cy)
        # in units of y
        mean_error = load8(s, row.EW + q)
        total = mean_error
        if count > 5:
            formless = load8(s, row.FORMLESS + q) != 0.0
            for at in range(row.FP + 5 * stride * LANES + q, row.FP + 6 * stride * LANES + q, LANES):
                store(s, at, where(formless, 0.0, load8(s, at)))
        for f in range(count):
            start = row.FP + f * stride * LANES + q
            first = abs(load8(s, start))
            # with 16 units for the rounding of what the pixel stage adds up
            spread = WHITENED_ROUNDING * first
            for k in range(1, stride):
                spread = spread + abs(load8(s, start + k * LANES))
            if f == 3 or f == 4:
                spread = spread + mean_error
                store(s, start + m * LANES, load8(s, start + m * LANES) + mean_error)
            if f < 5:
                store(s, row.R_SPREAD + f * LANES + q, spread)
            total = total + first + spread
        tame = (load8(s, row.KNOWN + q) == 1.0) & (total < np.inf)
        store(s, row.R_UNBOUNDED + q, where(tame, 0.0, 1.0))
        store(s, row.R_EXPONENT_LIMIT + q, where(tame, load8(s, row.R_EXPONENT_LIMIT + q), -1.0))
