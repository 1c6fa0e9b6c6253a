"""Colours of Gaussians by spherical harmonics, as numbers and as forms (spherical_harmonics.cuh)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.forms import bounds, clamp_below, set_norms
from ns_abstract.arithmetic.rounding import ARC_UP, MAGNITUDE_UP, SECOND_ORDER, SUM_ROUNDING, UP, Charges
from ns_abstract.arithmetic.simd.intrinsics import borrowed, offset_by, pointer, taken
from ns_abstract.arithmetic.simd.wide_forms import size
from ns_abstract.methods.splat.form_colors import WORKSPACE, form_colors
from ns_abstract.methods.splat.line_colors import accumulate_line, basis_line, directions_line
from ns_abstract.methods.splat.projection_errors import LANES
from ns_abstract.methods.splat.stage_data import FormShape, SceneColors
from ns_abstract.methods.splat.work_sharing import CHUNK, run_in_chunks

#: Largest change of each basis function per unit change of the direction, rounded up.
_SLOPE = np.array(
    [0.0] + [0.489] * 3 + [1.093, 1.093, 1.893, 1.093, 1.093] + [1.771, 2.891, 3.2, 3.8, 3.2, 2.891, 1.771]
)
#: Largest absolute value of each basis function, rounded up.
_SIZE = np.array(
    [0.283] + [0.489] * 3 + [0.547, 0.547, 0.631, 0.547, 0.547] + [0.591, 0.557, 0.64, 0.747, 0.64, 0.557, 0.591]
)


class _ColorScratch(NamedTuple):
    """Memory for a block of `LANES` Gaussians.

    Attributes:
        rows: [19 (m + 3) LANES] the forms, flat.
        wide: Forms of eight, flat; see `form_colors`.
        weights, low, high, angle: [LANES] coefficients, bounds, errors of directions.
    """

    rows: np.ndarray
    wide: np.ndarray
    weights: np.ndarray
    low: np.ndarray
    high: np.ndarray
    angle: np.ndarray


def color_magnitudes(sh: np.ndarray, degree: int) -> np.ndarray:
    """Return [N, 6] by channel: the largest sum of ``sh`` [N, K, 3], and its largest change with the direction."""
    magnitudes = np.zeros((sh.shape[0], 6))
    for k in range((degree + 1) * (degree + 1)):
        sizes = np.abs(sh[:, k])
        magnitudes[:, :3] += _SIZE[k] * sizes
        magnitudes[:, 3:] += _SLOPE[k] * sizes
    # rounding of the sums
    return magnitudes * MAGNITUDE_UP


@njit(cache=True, error_model="numpy")
def sh_basis(x, y, z, degree, out):
    """Write the real spherical harmonics of a unit direction, bands 0 to ``degree``, in gsplat's order."""
    out[0] = 0.2820947917738781
    if degree >= 1:
        out[1] = -0.48860251190292 * y
        out[2] = 0.48860251190292 * z
        out[3] = -0.48860251190292 * x
    if degree >= 2:
        z2 = z * z
        c1 = x * x - y * y
        s1 = 2.0 * x * y
        out[4] = 0.5462742152960395 * s1
        out[5] = -1.092548430592079 * z * y
        out[6] = 0.9461746957575601 * z2 - 0.3153915652525201
        out[7] = -1.092548430592079 * z * x
        out[8] = 0.5462742152960395 * c1
        if degree >= 3:
            c2 = x * c1 - y * s1
            s2 = x * s1 + y * c1
            f = -2.285228997322329 * z2 + 0.4570457994644658
            out[9] = -0.5900435899266435 * s2
            out[10] = 1.445305721320277 * z * s1
            out[11] = f * y
            out[12] = z * (1.865881662950577 * z2 - 1.119528997770346)
            out[13] = f * x
            out[14] = 1.445305721320277 * z * c1
            out[15] = -0.5900435899266435 * c2


@njit(cache=True, error_model="numpy")
def sh_color(sh, direction, degree, basis, out):
    """Write ``out[c] = max(0, 0.5 + sum_k basis_k sh[k, c])`` for an unnormalised ``direction`` [3]."""
    length = math.sqrt(direction[0] * direction[0] + direction[1] * direction[1] + direction[2] * direction[2])
    sh_basis(direction[0] / length, direction[1] / length, direction[2] / length, degree, basis)
    for c in range(3):
        total = 0.0
        for k in range((degree + 1) * (degree + 1)):
            total += basis[k] * sh[k, c]
        out[c] = max(0.0, total + 0.5)


@njit(cache=True, error_model="numpy")
def _color_error(size, change, charges, direction_error):
    """Return a bound of the float error of one colour, see `color_magnitudes` (design.md, C3)."""
    return charges.color_sum + charges.harmonics * size + direction_error * change


@njit(cache=True, error_model="numpy")
def _direction_error(length, position_error, means, mean_radius, i, charges):
    """Return the largest angle between the direction to a Gaussian and any that the program may use, at most 2.

    ``length``: the Gaussian's distance. See design.md, C3, S4.
    """
    size = abs(means[i, 0]) + abs(means[i, 1]) + abs(means[i, 2])
    spread = 0.0
    if mean_radius.shape[0] > 0:
        r0, r1, r2 = mean_radius[i, 0], mean_radius[i, 1], mean_radius[i, 2]
        spread = math.sqrt(r0 * r0 + r1 * r1 + r2 * r2) * UP
        size += r0 + r1 + r2
    distance = length - position_error - spread
    if not distance > 0.0:
        return 2.0
    error = (position_error + spread + charges.direction_mean * size) / distance + charges.direction
    if spread > 0.0:
        # from a chord to the arc, along which the basis functions' slopes hold (design.md, S4)
        error = 2.0 * math.asin(min(1.0, 0.5 * error)) * ARC_UP
    return min(error, 2.0)


@njit(cache=True, error_model="numpy", nogil=True)
def _fixed_worker(counter_, scene, position, position_error, charges, colors):
    """Compute `fixed_colors` of the chunks of Gaussians that no other thread has taken."""
    counter, count = pointer(counter_), scene.means.shape[0]
    means, mean_radius, magnitudes = borrowed(scene.means), borrowed(scene.mean_radius), borrowed(scene.magnitudes)
    shift_low, shift_high, sh = borrowed(scene.low), borrowed(scene.high), borrowed(scene.sh)
    basis = np.empty(16)
    color = np.empty(3)
    direction = np.empty(3)
    while True:
        start = taken(counter) * CHUNK
        if start >= count:
            break
        for i in range(start, min(count, start + CHUNK)):
            for k in range(3):
                direction[k] = means[i, k] - position[k]
            length = math.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
            sh_color(sh[i], direction, scene.degree, basis, color)
            error = _direction_error(length, position_error, means, mean_radius, i, charges)
            for c in range(3):
                radius = _color_error(magnitudes[i, c], magnitudes[i, 3 + c], charges, error)
                if shift_low.shape[0] > 0 and (shift_low[i, c] != 0.0 or shift_high[i, c] != 0.0):
                    size = color[c] + radius + max(abs(shift_low[i, c]), abs(shift_high[i, c]))
                    rounding = charges.shifted_color * size
                    low = max(0.0, max(0.0, color[c] - radius) + shift_low[i, c] - rounding)
                    high = max(0.0, color[c] + radius + shift_high[i, c] + rounding)
                    color[c] = 0.5 * (low + high)
                    radius = 0.5 * (high - low) * UP + SUM_ROUNDING * high
                colors[i, 2 * c] = color[c]
                colors[i, 2 * c + 1] = radius


def fixed_colors(
    scene: SceneColors, position: np.ndarray, position_error: float, charges: Charges, colors: np.ndarray
) -> None:
    """Write colours [N, 6] seen from one camera position: centre and radius by channel (design.md, C1, C3, S4).

    Args:
        scene: The Gaussians.
        position: [3] world; ``position_error`` bounds its error by float evaluation and by the set.
        charges: For the program's rounding.
        colors: The output.
    """
    run_in_chunks(_fixed_worker, scene.means.shape[0], scene, position, position_error, charges, colors)


@njit(cache=True, error_model="numpy")
def gathered(colors, numbers, alive, out):
    """Write the ``colors`` of the Gaussians ``numbers`` [n] to the rows ``alive`` of ``out`` [n, 6]; others stay."""
    for k in alive:
        i = numbers[k]
        for column in range(6):
            out[k, column] = colors[i, column]
    return out


@njit(cache=True, error_model="numpy")
def _set_directions(work, numbers, scene, position, origin, m):
    """Set forms 0 to 2 of ``work`` to the vectors from the camera to the means ``numbers``, without rows of sums."""
    means = borrowed(scene.means)
    for axis in range(3):
        form = work[axis]
        for k in range(m):
            for q in range(LANES):
                form[k, q] = -position[k, axis]
        for q in range(LANES):
            i = numbers[q]
            form[0, q] = (means[i, axis] - origin[axis]) + (origin[axis] - position[0, axis])
            form[m, q] = position[m, axis] + SUM_ROUNDING * (
                abs(means[i, axis] - origin[axis]) + abs(origin[axis] - position[0, axis])
            )


@njit(cache=True, error_model="numpy")
def _set_bands(work, numbers, filled, scratch, scene, shape):
    """Set forms 16 to 18 of ``work`` to the three channels, from the directions; ``scratch.low``: squared lengths."""
    d, order, m = shape.dimensions, shape.order, shape.monomials
    sh, low, weights = borrowed(scene.sh), scratch.low, scratch.weights
    for channel in range(3):
        form = work[16 + channel]
        for k in range(m + 3):
            for q in range(LANES):
                form[k, q] = 0.0
        for q in range(LANES):
            form[0, q] = 0.2820947917738781 * sh[numbers[q], 0, channel] + 0.5
            form[m, q] = SUM_ROUNDING * (abs(sh[numbers[q], 0, channel]) + 1.0)
    if order == 2:
        s = scratch.rows
        directions_line(s, low.shape[0], scene.degree, low)
        for k in range(1, (scene.degree + 1) * (scene.degree + 1)):
            basis_line(s, low.shape[0], k)
            for channel in range(3):
                for q in range(LANES):
                    weights[q] = sh[numbers[q], k, channel]
                accumulate_line(s, low.shape[0], weights, channel)
        return
    for axis in range(3):
        set_norms(work[axis], d, order, m)
    for q in range(0, filled, 8):
        form_colors(
            pointer(scratch.wide), offset_by(pointer(scratch.rows), q), offset_by(pointer(low), q), sh,
            pointer(weights), offset_by(pointer(numbers), q), scene.degree, m,
        )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _clamp_at_zero(form, low, high, shape):
    """Replace ``form`` by its maximum with 0; ``low`` and ``high`` [LANES] are scratch."""
    d, order, m = shape.dimensions, shape.order, shape.monomials
    bounds(form, low, high, d, order, m)
    clamp_below(form, 0.0, low, high, d, order, m)


@njit(cache=True, error_model="numpy")
def _clamp_channel(form, channel, numbers, filled, scratch, scene, charges, shape):
    """Charge a channel's form for float evaluation, clamp it and add the scene's range (design.md, C3, S4)."""
    d, order, m = shape.dimensions, shape.order, shape.monomials
    magnitudes, least_of, most_of = borrowed(scene.magnitudes), borrowed(scene.low), borrowed(scene.high)
    low, high, angle = scratch.low, scratch.high, scratch.angle
    set_norms(form, d, order, m)
    for q in range(filled):
        most, change = magnitudes[numbers[q], channel], magnitudes[numbers[q], 3 + channel]
        form[m, q] += _color_error(most, change, charges, angle[q])
        # a camera that may stand in the Gaussian's centre: any direction
        if not form[m, q] + form[m + 1, q] + form[m + 2, q] <= 2.0 * most + 1.0:
            for r in range(1, m + 3):
                form[r, q] = 0.0
            form[0, q] = 0.5
            form[m, q] = most * SECOND_ORDER + _color_error(most, change, charges, 2.0)
    _clamp_at_zero(form, low, high, shape)
    if least_of.shape[0] == 0:
        return
    for q in range(filled):
        least, most = least_of[numbers[q], channel], most_of[numbers[q], channel]
        if least != 0.0 or most != 0.0:
            middle = 0.5 * (least + most)
            total = abs(form[0, q]) + form[m + 1, q] + form[m + 2, q] + form[m, q]
            form[0, q] += middle
            form[m, q] += max(most - middle, middle - least) * UP + (charges.shifted_color + SUM_ROUNDING) * (
                total + max(abs(least), abs(most))
            )
    _clamp_at_zero(form, low, high, shape)


@njit(cache=True, error_model="numpy", nogil=True)
def _moving_worker(counter_, indices, scene, position, origin, position_error, charges, shape, colors):
    """Compute `moving_colors` of the chunks of Gaussians that no other thread has taken."""
    counter, n, m = pointer(counter_), indices.shape[0], shape.monomials
    # 0-2 direction, 16-18 channels; in between what `line_colors` keeps
    work_ = np.empty((19, m + 3, LANES))
    ends_ = np.empty((4, LANES))
    wide_ = np.empty(WORKSPACE * size(m))
    numbers_ = np.empty(LANES, np.int64)
    work, numbers = borrowed(work_), borrowed(numbers_)
    scratch = _ColorScratch(
        borrowed(work_.reshape(-1)), borrowed(wide_), borrowed(ends_[0]), borrowed(ends_[1]), borrowed(ends_[2]),
        borrowed(ends_[3]),
    )  # fmt: skip
    means, mean_radius, low = borrowed(scene.means), borrowed(scene.mean_radius), scratch.low
    while True:
        start = taken(counter) * CHUNK
        if start >= n:
            break
        for first in range(start, min(n, start + CHUNK), LANES):
            filled = min(LANES, min(n, start + CHUNK) - first)
            for q in range(LANES):
                numbers[q] = indices[first + min(q, filled - 1), 1]
            _set_directions(work, numbers, scene, position, origin, m)
            _set_bands(work, numbers, filled, scratch, scene, shape)
            for q in range(filled):
                distance = math.sqrt(low[q]) * (1.0 - SUM_ROUNDING) if low[q] > 0.0 else 0.0
                scratch.angle[q] = _direction_error(distance, position_error, means, mean_radius, numbers[q], charges)
            for channel in range(3):
                form = work[16 + channel]
                _clamp_channel(form, channel, numbers, filled, scratch, scene, charges, shape)
                for q in range(filled):
                    for k in range(m + 1):
                        colors[indices[first + q, 0], channel * (m + 1) + k] = form[k, q]
    # the owners of the borrowed arrays live to here
    return work_.size + ends_.size + wide_.size + numbers_.size


def moving_colors(
    indices: np.ndarray, scene: SceneColors, position: np.ndarray, origin: np.ndarray, position_error: float,
    charges: Charges, shape: FormShape, colors: np.ndarray,
) -> None:  # fmt: skip
    """Write colours over a cell in which the camera moves, as forms (design.md, C2, C3, S4).

    ``indices`` [n, 2] are rows of ``colors`` and numbers of Gaussians in the scene. ``position`` [rows, 3] are forms,
    of ``shape``, of the camera position in the world, centred at ``origin`` [3], within ``position_error``. ``colors``
    [., 3 (m + 1)] receives coefficients and radius by channel; ``charges`` are for the program's rounding.
    """
    run_in_chunks(
        _moving_worker, indices.shape[0], indices, scene, position, origin, position_error, charges, shape, colors
    )
