"""Float errors, pixel regions and tile ranges of projected Gaussians (docs/dev/design.md, G5-G12).

One record is written for every Gaussian that some pose of the cell may show:
    0, 1   mean in pixels at the cell's middle (the point pixel offsets are taken from)
    2, 3   lower and upper opacity
    4      kappa: relative error of the exponent by float evaluation
    5      1 where only the opacity is known ("unbounded"), else 0
    6      exponent above which alpha is below the threshold in every evaluation (B4); -1 if unbounded
    7 ..   largest distances of the forms P, Q, S, W1, W2 from their centres, to find pixels that surely see nothing
    12 ..  forms P, Q, S, W1, W2 (and K if antialiased; 0 where the opacity is compensated), each m coefficients and a
        radius
so that for a pixel at offset (ax, ay) from the mean
    y1 = P ax - Q ay - W1,   y2 = S ay - W2,   alpha = opacity exp(-(y1^2 + y2^2)/2 - K).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import (
    COMPENSATION_ROUNDING,
    COVARIANCE_ERROR,
    REGION,
    ROOT_ROUNDING,
    SECOND_ORDER,
    UP,
)

#: Lanes of one block of the compiled stage.
LANES = 32


@dataclass(frozen=True)
class RecordTuning:
    """When Gaussians get tighter error bounds; soundness does not depend on it."""

    #: The squared compensation from which on its logarithm is used.
    least_square: float = 1e-60
    #: Part of the near plane's depth from which on a Gaussian is projected over all of a cell, also where it is not
    #: drawn.
    in_front: float = 2.0**-4
    #: Relative error of a covariance, as its entries' errors tell, beyond which that of its factors is looked at.
    factors_matter: float = 2.0**-10


_LEAST_SQUARE = RecordTuning.least_square
IN_FRONT = RecordTuning.in_front
_FACTORS_MATTER = RecordTuning.factors_matter


# columns of a record before its forms
MEAN_X, MEAN_Y, OPACITY_LOW, OPACITY_HIGH, KAPPA, UNBOUNDED, EXPONENT_LIMIT, SPREAD = range(8)
FORMS = SPREAD + 5


@njit(cache=True, error_model="numpy")
def columns(count, m):
    """Return the columns of a record of ``count`` forms of ``m`` monomials: whole cache lines."""
    return -(-(FORMS + count * (m + 1)) // 8) * 8


# Scratch of a block is flat: row r holds its lanes at r * LANES .. r * LANES + LANES - 1. With constant offsets the
# compiler sees that rows do not overlap, so that long loops over lanes become vector code.
(
    # means minus origin; principal axes by column; float error of their covariance; |mean|, half-width of its range
    V0, V1, V2,
    B00, B10, B20, B01, B11, B21, B02, B12, B22,
    N0, N1, N2, N3, N4, N5, N6, N7, N8, N9, N10, N11,
    M0, M1, M2, R0, R1, R2,
    # ends of the opacity's range, exponent at which it reaches the threshold
    OPLOW, OPHIGH, OPLIMIT,
    # largest standard deviation
    EXTENT,
    # bounds that the projection leaves: depth, ratios, scaled covariance entries, determinant, half difference,
    # squared compensation, magnitude of the third row of rotation times axes
    ZLO, ZHI, ULO, UHI, VLO, VHI, ALO, AHI, CLO, CHI, BLO, BHI, DLO, DHI, LO, HI, SQLO, SQHI, DEEP0, DEEP1, DEEP2,
    # depth and mean in pixels from the middle of the view, at the cell's middle
    Z0, X0, Y0,
    # float errors of the coordinates, what a range of means adds to them
    EX, EY, EZ, SX, SY, SZ,
    # what `float_errors` leaves: depth, means and their errors; clamped ratios' sizes, what their errors move in
    # pixels by unit of depth, relative error of an entry of J
    ZLOW, ZHIGH, MXLO, MXHI, MYLO, MYHI, EMX, EMY, RATIOX, RATIOY, JUMPX, JUMPY, RELJ,
    # the covariance and its errors
    A, B, C, DET, EA, EB, EC, EDET, RHIGH, RLOW, ETA, EW, TAME,
    # of G = J R M by row: squared sizes, errors of the factors; errors in G G^T
    ROWX, ROWY, MOVEX, MOVEY, GRAMA, GRAMB, GRAMC,
    # what `compensations` leaves: bound of the compensation, bounds of the factor beside its form, whether there is no
    # form, logarithms of the upper bounds
    CTOP, CLOW, CHIGH, FORMLESS, CTOPLOG, CHIGHLOG,
    # what `regions` leaves beside columns of the record: state, box and tiles
    GONE, FINITE, FRONT, PLACED, KNOWN, REGIONLIMIT, BOX0, BOX1, BOX2, BOX3, T0, T1, T2, T3, T4, T5, T6, T7,
) = range(0, 121 * LANES, LANES)  # fmt: skip
# a record, column by column
RECORD = T7 + LANES
R_MEAN_X, R_MEAN_Y, R_OPACITY_LOW, R_OPACITY_HIGH, R_KAPPA, R_UNBOUNDED, R_EXPONENT_LIMIT, R_SPREAD = (
    RECORD + column * LANES
    for column in (MEAN_X, MEAN_Y, OPACITY_LOW, OPACITY_HIGH, KAPPA, UNBOUNDED, EXPONENT_LIMIT, SPREAD)
)
# its forms, four rows each where there is one parameter, and behind them the determinant
FP, FQ, FS, FW1, FW2, FK, FD = range(RECORD + FORMS * LANES, RECORD + (FORMS + 28) * LANES, 4 * LANES)


@njit(cache=True, error_model="numpy")
def table_rows(width):
    """Return the rows of the scratch for records of ``width`` columns."""
    return RECORD // LANES + max(width, (FD - RECORD) // LANES + 4)


@njit(cache=True, error_model="numpy")
def gather_means(candidates, block, scene, origin, s):
    """Copy the means of the Gaussians ``block`` to rows V0 .. V2, M0 .. R2; spare lanes repeat the last Gaussian."""
    means, mean_radius = scene.means, scene.mean_radius
    filled = block.shape[0]
    for q in range(LANES):
        i = candidates[block[min(q, filled - 1)]]
        for k in range(3):
            s[V0 + k * LANES + q] = means[i, k] - origin[k]
            s[M0 + k * LANES + q] = abs(means[i, k])
            s[R0 + k * LANES + q] = mean_radius[i, k] if mean_radius.shape[0] > 0 else 0.0


@njit(cache=True, error_model="numpy")
def gather(candidates, block, scene, origin, s):
    """Copy the parameters of the Gaussians ``block`` to rows V0 .. OPLIMIT; spare lanes repeat the last Gaussian."""
    gather_means(candidates, block, scene, origin, s)
    axes, noise, opacity_low, opacity_high, exponent_limits = (
        scene.axes, scene.noise, scene.opacity_low, scene.opacity_high, scene.exponent_limits,
    )  # fmt: skip
    filled = block.shape[0]
    for q in range(LANES):
        i = candidates[block[min(q, filled - 1)]]
        for column in range(3):
            for k in range(3):
                s[B00 + (3 * column + k) * LANES + q] = axes[i, k, column]
        for k in range(12):
            s[N0 + k * LANES + q] = noise[i, k]
        s[OPLOW + q] = opacity_low[i]
        s[OPHIGH + q] = opacity_high[i]
        s[OPLIMIT + q] = exponent_limits[i]


@njit(cache=True, error_model="numpy")
def coordinate_errors(s, n, poses, charges):
    """Compute float errors of the camera coordinates, and their spread by ranges of means: rows EX .. SZ (G2, S2)."""
    rotation_magnitude, camera_magnitude = poses.rotation_magnitude, poses.camera_magnitude
    c0, c1, c2 = camera_magnitude[0], camera_magnitude[1], camera_magnitude[2]
    for row in range(3):
        r0, r1, r2 = rotation_magnitude[3 * row], rotation_magnitude[3 * row + 1], rotation_magnitude[3 * row + 2]
        error, spread = EX + row * LANES, SX + row * LANES
        for q in range(n):
            total = (
                r0 * (s[M0 + q] + s[R0 + q] + c0)
                + r1 * (s[M1 + q] + s[R1 + q] + c1)
                + r2 * (s[M2 + q] + s[R2 + q] + c2)
            )
            s[error + q] = charges.camera_coordinate * total * UP
        for q in range(n):
            s[spread + q] = (r0 * s[R0 + q] + r1 * s[R1 + q] + r2 * s[R2 + q]) * UP


@njit(cache=True, error_model="numpy", forceinline=True)
def _rotation_row(magnitude, k):
    """Return upper bounds of the absolute entries of row ``k`` of the rotation."""
    return magnitude[3 * k], magnitude[3 * k + 1], magnitude[3 * k + 2]


@njit(cache=True, error_model="numpy", forceinline=True)
def _scaled_row(j, ratio, r, r2):
    """Return upper bounds of a row of |J R|, from those of the rotation's row ``r`` and third row ``r2``."""
    return j * (r[0] + ratio * r2[0]), j * (r[1] + ratio * r2[1]), j * (r[2] + ratio * r2[2])


@njit(cache=True, error_model="numpy", forceinline=True)
def _applied(f00, f11, f22, f01, f02, f12, g):
    """Return a symmetric matrix times a vector."""
    return (
        f00 * g[0] + f01 * g[1] + f02 * g[2],
        f01 * g[0] + f11 * g[1] + f12 * g[2],
        f02 * g[0] + f12 * g[1] + f22 * g[2],
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, error_model="numpy", forceinline=True)
def view_limits(rules, camera):
    """Return the largest absolute ratios x/z and y/z at which the Jacobian is evaluated; infinite without a margin."""
    fx, fy, cx, cy, width, height = camera
    margin = rules.view_margin
    if margin < 0.0:
        return np.inf, np.inf
    limit_x = max(cx, width - cx) / fx + margin * 0.5 * width / fx
    limit_y = max(cy, height - cy) / fy + margin * 0.5 * height / fy
    return limit_x, limit_y


@njit(cache=True, error_model="numpy", forceinline=True)
def _axis_sizes(s, k, q):
    """Return the absolute entries of principal axis ``k``."""
    at = B00 + 3 * k * LANES + q
    return abs(s[at]), abs(s[at + LANES]), abs(s[at + 2 * LANES])


@njit(cache=True, error_model="numpy")
def float_errors(s, n, rules, camera, charges, rotation_magnitude):
    """Return float errors of mean, covariance and exponent, and the radius' range (G5-G8): rows ZLOW .. GRAMC.

    Numbers of Gaussians that may come too near are of no use; `regions` does not look at them. The compiler makes
    vector code of the loops as they stand: lanes are Gaussians.
    """
    _mean_errors(s, n, rules, camera, charges)
    _covariance_errors(s, n, camera, charges, rotation_magnitude)
    _radius_ranges(s, n, rules, charges)
    if rules.antialiased or _any_sharp(s, n):
        _factor_errors(s, n, rules, camera, charges, rotation_magnitude)
    for q in range(n):
        a, c, det = s[A + q], s[C + q], s[DET + q]
        s[ETA + q] = (s[ETA + q] + charges.conic * (a * c) / det) * SECOND_ORDER
        # float error of the mean, in units of y
        s[EW + q] = (np.sqrt(c / det) * s[EMX + q] + np.sqrt(a / det) * s[EMY + q]) * SECOND_ORDER


@njit(cache=True, error_model="numpy")
def _mean_errors(s, n, rules, camera, charges):
    """Compute depth and mean with their errors, and errors of the Jacobian: rows ZLOW .. RELJ (design.md, G5, G6)."""
    fx, fy, cx, cy, _, _ = camera
    limit_x, limit_y = view_limits(rules, camera)
    clamp_x, clamp_y = 0.0, 0.0
    if rules.view_margin >= 0.0:
        clamp_x, clamp_y = charges.clamp * limit_x, charges.clamp * limit_y
    for q in range(n):
        error_z = s[EZ + q]
        z_low = s[ZLO + q] - error_z
        s[ZLOW + q] = z_low
        s[ZHIGH + q] = s[ZHI + q] + error_z
        ratio_x = max(abs(s[ULO + q]), abs(s[UHI + q]))
        ratio_y = max(abs(s[VLO + q]), abs(s[VHI + q]))
        # G5: reciprocal of depth, means
        relative_z = error_z / z_low
        relative_rz = relative_z + charges.reciprocal_depth
        error_u = s[EX + q] / z_low + ratio_x * (relative_rz + charges.ratio)
        error_v = s[EY + q] / z_low + ratio_y * (relative_rz + charges.ratio)
        error_mean_x = fx * error_u + charges.mean * (fx * ratio_x + abs(cx))
        error_mean_y = fy * error_v + charges.mean * (fy * ratio_y + abs(cy))
        s[EMX + q], s[EMY + q] = error_mean_x, error_mean_y
        s[MXLO + q] = fx * s[ULO + q] + cx - error_mean_x * REGION
        s[MXHI + q] = fx * s[UHI + q] + cx + error_mean_x * REGION
        s[MYLO + q] = fy * s[VLO + q] + cy - error_mean_y * REGION
        s[MYHI + q] = fy * s[VHI + q] + cy + error_mean_y * REGION
        # clamped ratios
        s[RATIOX + q] = min(ratio_x, limit_x)
        s[RATIOY + q] = min(ratio_y, limit_y)
        s[JUMPX + q] = fx / z_low * (min(error_u, 2.0 * limit_x) + clamp_x)
        s[JUMPY + q] = fy / z_low * (min(error_v, 2.0 * limit_y) + clamp_y)
        s[RELJ + q] = relative_z + 2.0 * relative_rz + charges.jacobian


@njit(cache=True, error_model="numpy")
def _covariance_errors(s, n, camera, charges, rotation_magnitude):
    """Compute bounds of the blurred covariance and its float32 errors: rows A .. EC, from `_mean_errors` (G6).

    TAME is finite where all of them are.
    """
    r0, r1 = _rotation_row(rotation_magnitude, 0), _rotation_row(rotation_magnitude, 1)
    r2 = _rotation_row(rotation_magnitude, 2)
    for q in range(n):
        z_low, z_high = s[ZLOW + q], s[ZHIGH + q]
        jump_x, jump_y, relative_j = s[JUMPX + q], s[JUMPY + q], s[RELJ + q]
        g_x = _scaled_row(camera.fx / z_low, s[RATIOX + q], r0, r2)
        g_y = _scaled_row(camera.fy / z_low, s[RATIOY + q], r1, r2)
        # F bounds the error of the world covariance and all later roundings
        grow = relative_j * (2.0 + relative_j)
        f00 = s[N0 + q] + grow * s[N6 + q]
        f11 = s[N1 + q] + grow * s[N7 + q]
        f22 = s[N2 + q] + grow * s[N8 + q]
        f01 = s[N3 + q] + grow * s[N9 + q]
        f02 = s[N4 + q] + grow * s[N10 + q]
        f12 = s[N5 + q] + grow * s[N11 + q]
        deep0, deep1, deep2 = s[DEEP0 + q], s[DEEP1 + q], s[DEEP2 + q]
        variance = deep0 * deep0 + deep1 * deep1 + deep2 * deep2
        variance += f00 * r2[0] * r2[0] + f11 * r2[1] * r2[1] + f22 * r2[2] * r2[2]
        variance += 2.0 * (f01 * r2[0] * r2[1] + f02 * r2[0] * r2[2] + f12 * r2[1] * r2[2])
        h_x = _applied(f00, f11, f22, f01, f02, f12, g_x)
        h_y = _applied(f00, f11, f22, f01, f02, f12, g_y)
        z2_low = z_low * z_low
        z2_high = z_high * z_high
        a = s[AHI + q] / z2_low
        c = s[CHI + q] / z2_low
        b = max(abs(s[BLO + q]), abs(s[BHI + q])) / z2_low
        deep, root_a, root_c = np.sqrt(variance), np.sqrt(a), np.sqrt(c)
        # errors of the factors, of the ratios in the Jacobian, and of the last sum
        error_a = _dot(g_x, h_x) + 2.0 * jump_x * deep * root_a + jump_x * jump_x * variance + charges.blur * a
        error_c = _dot(g_y, h_y) + 2.0 * jump_y * deep * root_c + jump_y * jump_y * variance + charges.blur * c
        error_b = _dot(g_x, h_y) + deep * (jump_x * root_c + jump_y * root_a) + jump_x * jump_y * variance
        error_a, error_c, error_b = (
            error_a * SECOND_ORDER,
            error_c * SECOND_ORDER,
            (error_b + charges.blur * b) * SECOND_ORDER,
        )
        s[A + q], s[B + q], s[C + q] = a, b, c
        s[DET + q] = s[DLO + q] / (z2_high * z2_high)
        s[EA + q], s[EB + q], s[EC + q] = error_a, error_b, error_c
        s[TAME + q] = a + c + error_a + error_b + error_c


@njit(cache=True, error_model="numpy")
def _radius_ranges(s, n, rules, charges):
    """Compute the determinant's error, the radius' range (G8) and G7's first bound: EDET, RHIGH, RLOW, ETA."""
    for q in range(n):
        z_low, z_high = s[ZLOW + q], s[ZHIGH + q]
        z2_low = z_low * z_low
        z2_high = z_high * z_high
        a, b, c, det = s[A + q], s[B + q], s[C + q], s[DET + q]
        error_a, error_b, error_c = s[EA + q], s[EB + q], s[EC + q]
        # lambda_max = (a + c)/2 + sqrt(max(floor, ((a - c)/2)^2 + b^2))
        difference = max(abs(s[LO + q]), abs(s[HI + q])) / z2_low
        nearest = max(0.0, s[LO + q], -s[HI + q]) / z2_high
        b_nearest = max(0.0, s[BLO + q], -s[BHI + q]) / z2_high
        half_high = 0.5 * (a + c)
        half_low = 0.5 * (max(s[ALO + q], 0.0) + max(s[CLO + q], 0.0)) / z2_high
        error_half = 0.5 * (error_a + error_c) + charges.half_trace * half_high
        error_det = (
            c * error_a + a * error_c + 2.0 * b * error_b + error_a * error_c + error_b * error_b
            + charges.determinant * (a * c + b * b)
        ) * SECOND_ORDER  # fmt: skip
        error_disc = 2.0 * half_high * error_half + error_half * error_half + error_det
        error_disc += charges.discriminant * half_high * half_high
        disc_high = max(rules.discriminant_min, difference * difference + b * b + error_disc)
        disc_low = max(rules.discriminant_min, nearest * nearest + b_nearest * b_nearest - error_disc)
        top_high = (half_high + error_half + np.sqrt(disc_high)) * (1.0 + charges.radius)
        top_low = max(0.0, half_low - error_half + np.sqrt(disc_low)) * (1.0 - charges.radius)
        # np.ceil: math.ceil is an int64, which a huge Gaussian overflows
        s[RHIGH + q] = np.ceil(rules.radius_sigmas * np.sqrt(top_high) * (1.0 + charges.radius) * REGION)
        s[RLOW + q] = np.ceil(rules.radius_sigmas * np.sqrt(top_low) * (1.0 - charges.radius) / REGION)
        s[EDET + q] = error_det
        s[ETA + q] = (c * error_a + 2.0 * (np.sqrt(a) * np.sqrt(c)) * error_b + a * error_c) / det


@njit(cache=True, error_model="numpy")
def _any_sharp(s, n):
    """Return whether any of the row ETA is above `_FACTORS_MATTER`."""
    any_above = False
    for q in range(n):
        any_above = any_above | (s[ETA + q] > _FACTORS_MATTER)
    return any_above


@njit(cache=True, error_model="numpy")
def _factor_errors(s, n, rules, camera, charges, rotation_magnitude):
    """Compute G7's second bound, from the errors of the factors of G = J R M: ETA, EDET, ROWX .. GRAMC (G7, G11).

    The errors are those of the factors, row by row, and of the products in G G^T. Without antialiasing only values
    above `_FACTORS_MATTER` are replaced, so that a Gaussian's bounds do not depend on its neighbours in a block.
    """
    r0, r1 = _rotation_row(rotation_magnitude, 0), _rotation_row(rotation_magnitude, 1)
    r2 = _rotation_row(rotation_magnitude, 2)
    enough = -1.0 if rules.antialiased else _FACTORS_MATTER
    for q in range(n):
        z_low, jump_x, jump_y = s[ZLOW + q], s[JUMPX + q], s[JUMPY + q]
        a, b, c, det = s[A + q], s[B + q], s[C + q], s[DET + q]
        g_x = _scaled_row(camera.fx / z_low, s[RATIOX + q], r0, r2)
        g_y = _scaled_row(camera.fy / z_low, s[RATIOY + q], r1, r2)
        relative = SECOND_ORDER * (s[RELJ + q] + charges.rotation)
        more = 1.0 + relative
        sum_x = (g_x[0] + g_x[1] + g_x[2] + jump_x * (r2[0] + r2[1] + r2[2])) * more
        sum_y = (g_y[0] + g_y[1] + g_y[2] + jump_y * (r2[0] + r2[1] + r2[2])) * more
        move_x, move_y, gram_a, gram_b, gram_c, row_x, row_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(3):
            axis = _axis_sizes(s, k, q)
            entry = charges.rotation_entry * np.sqrt(_dot(axis, axis))
            size_x, size_y = _dot(g_x, axis), _dot(g_y, axis)
            near = s[DEEP0 + k * LANES + q] * more
            whole = _dot(r2, axis) * more
            e_x = relative * size_x + sum_x * entry + jump_x * near
            e_y = relative * size_y + sum_y * entry + jump_y * near
            t_x = more * size_x + sum_x * entry + jump_x * whole
            t_y = more * size_y + sum_y * entry + jump_y * whole
            move_x, move_y = move_x + e_x * e_x, move_y + e_y * e_y
            row_x, row_y = row_x + size_x * size_x, row_y + size_y * size_y
            gram_a, gram_b, gram_c = gram_a + t_x * t_x, gram_b + t_x * t_y, gram_c + t_y * t_y
        move_x, move_y = np.sqrt(move_x), np.sqrt(move_y)
        gram_a = charges.gram * gram_a + charges.flush * (sum_x * sum_x + 1.0)
        gram_b = charges.gram * gram_b + charges.flush * (sum_x * sum_y + 1.0)
        gram_c = charges.gram * gram_c + charges.flush * (sum_y * sum_y + 1.0)
        s[ROWX + q], s[ROWY + q], s[MOVEX + q], s[MOVEY + q] = row_x, row_y, move_x, move_y
        s[GRAMA + q], s[GRAMB + q], s[GRAMC + q] = gram_a, gram_b, gram_c
        # relative errors of the covariance and of its determinant
        moved = np.sqrt(c / det) * move_x + np.sqrt(a / det) * move_y
        gram = c * (gram_a + charges.blur * a) + 2.0 * (np.sqrt(a) * np.sqrt(c)) * gram_b
        gram = gram + a * (gram_c + charges.blur * c)
        eta = min(s[ETA + q], (moved * (2.0 + moved) + gram / det) * SECOND_ORDER)
        products = charges.determinant * (a * c + b * b)
        error_det = min(s[EDET + q], (eta * (2.0 + eta) * det + products) * SECOND_ORDER)
        replaced = s[ETA + q] > enough
        s[EDET + q] = error_det if replaced else s[EDET + q]
        s[ETA + q] = eta if replaced else s[ETA + q]


@njit(cache=True, error_model="numpy")
def compensations(s, n, rules, charges):
    """Compute bounds of the computed compensation: rows CTOP .. CHIGHLOG, from `float_errors` (design.md, G11, G12).

    CTOP bounds it over the cell. It is its form times a factor between CLOW and CHIGH; where FORMLESS is 1 these bound
    the compensation itself, because its logarithm is not known well enough.
    """
    eps2d, least, flush = rules.eps2d, rules.compensation_min, charges.flush
    # and the rounding below
    shrink = 1.0 - charges.compensation - COMPENSATION_ROUNDING
    grow = 1.0 + charges.compensation + COMPENSATION_ROUNDING
    for q in range(n):
        move_x, move_y = s[MOVEX + q], s[MOVEY + q]
        error_a, error_b, error_c = s[GRAMA + q], s[GRAMB + q], s[GRAMC + q]
        # the covariance before the blur
        a = np.sqrt(min(s[ROWX + q], max(0.0, s[A + q] * REGION - eps2d)))
        c = np.sqrt(min(s[ROWY + q], max(0.0, s[C + q] * REGION - eps2d)))
        det, spread = s[DET + q], s[EDET + q] / s[DET + q]
        moved = SECOND_ORDER * (move_x * c + a * move_y + move_x * move_y) / np.sqrt(det)
        a, c = (a + move_x) * (a + move_x), (c + move_y) * (c + move_y)
        error = c * error_a + a * error_c + 2.0 * np.sqrt(a * c) * error_b + error_a * error_c + error_b * error_b
        error = SECOND_ORDER * (error + charges.determinant * (a + error_a) * (c + error_c) + flush) / det
        # the least factor of the determinant; G7's where that is known
        remains = max(1.0 - spread, (1.0 - s[ETA + q]) ** 2) if s[ETA + q] < COVARIANCE_ERROR else 1.0 - spread
        # the square of the compensation lies in [0, 1]; bounds that are no numbers say nothing
        low = s[SQLO + q] if s[SQLO + q] > 0.0 else 0.0
        high = s[SQHI + q] if s[SQHI + q] < 1.0 else 1.0
        low_root, high_root = np.sqrt(low), np.sqrt(high)
        bottom = max(0.0, low_root * (1.0 - ROOT_ROUNDING) - moved)
        bottom = np.sqrt(max(0.0, bottom * bottom - error) / (1.0 + spread)) * shrink
        top = high_root * (1.0 + ROOT_ROUNDING) + moved
        top = np.sqrt((top * top + error) / remains) * grow
        change = (moved * (2.0 * low_root + moved) + error) / low
        # 1.6.0 has a least factor
        formed = (low > _LEAST_SQUARE) & (change < 0.25) & (spread < 0.5) & (0.45 * low > least * least)
        bottom = max(bottom, least * (1.0 - charges.compensation))
        top = max(top, least * (1.0 + charges.compensation))
        s[CTOP + q] = top if top < np.inf else np.inf
        s[CLOW + q] = np.sqrt((1.0 - change) / (1.0 + spread)) * shrink if formed else bottom
        s[CHIGH + q] = np.sqrt((1.0 + change) / (1.0 - spread)) * grow if formed else top
        s[FORMLESS + q] = 0.0 if formed else 1.0
    # the logarithm is no vector code
    for q in range(n):
        s[CTOPLOG + q] = np.log(s[CTOP + q] * REGION)
        s[CHIGHLOG + q] = np.log(s[CHIGH + q] * REGION)
