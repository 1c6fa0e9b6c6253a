"""What the per-Gaussian stage leaves for the pixels: float errors, pixel regions and tile ranges (design.md, G5-G9).

For every Gaussian that some pose of the cell may show, one record is written:

    0, 1   mean in pixels at the cell's middle (the point pixel offsets are taken from)
    2, 3   lower and upper opacity
    4      kappa: relative error of the exponent that float evaluation may add
    5      1 where nothing but the opacity is known ("wild"), else 0
    6      exponent from which on alpha is below the threshold, however it is evaluated (B4); -1 if wild
    7 ..   of the forms P, Q, S, W1, W2: how far each may be from its centre, for pixels that surely see nothing
    12 ..  forms P, Q, S, W1, W2 (and K if antialiased), each m coefficients and a radius

so that for a pixel at offset (ax, ay) from the mean

    y1 = P ax - Q ay - W1,   y2 = S ay - W2,   alpha = opacity exp(-(y1^2 + y2^2)/2 - K).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ns_abstract.arithmetic.units import UNIT64

#: Lanes of one block of the compiled stage.
LANES = 32
_UP = 1.0 + 128.0 * UNIT64
#: Rounding of the opacity in units: a sigmoid is two exponentials or divisions and an addition.
_SIGMOID = 12.0
#: Room for rounding where a region of pixels or tiles is computed from bounds.
REGION = 1.0 + 2.0**-30

# columns of a record before its forms
MEAN_X, MEAN_Y, OPACITY_LOW, OPACITY_HIGH, KAPPA, WILD, FAINT, SPREAD = range(8)
FORMS = SPREAD + 5


@njit(cache=True, error_model="numpy")
def columns(count, m):
    """Columns of a record of ``count`` forms of ``m`` monomials: whole cache lines."""
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
    OPLOW, OPHIGH, OPFAINT,
    # largest standard deviation
    EXTENT,
    # bounds that the projection leaves: depth, ratios, scaled covariance entries, determinant, half difference,
    # squared compensation, reach of the third row of rotation times axes
    ZLO, ZHI, ULO, UHI, VLO, VHI, ALO, AHI, CLO, CHI, BLO, BHI, DLO, DHI, LO, HI, DISC, DEEP0, DEEP1, DEEP2,
    # depth and mean in pixels from the middle of the view, at the cell's middle
    Z0, X0, Y0,
    # float errors of the coordinates, what a range of means adds to them
    EX, EY, EZ, SX, SY, SZ,
    # what `float_errors` leaves
    ZLOW, ZHIGH, MXLO, MXHI, MYLO, MYHI, A, C, DET, EDET, SHARP, RHIGH, RLOW, ETA, EW, TAME,
    # what `regions` leaves beside columns of the record: state, box and tiles
    GONE, KNOWN, BOX0, BOX1, BOX2, BOX3, T0, T1, T2, T3, T4, T5, T6, T7,
) = range(0, 93 * LANES, LANES)  # fmt: skip
# a record, column by column
RECORD = T7 + LANES
R_MEAN_X, R_MEAN_Y, R_OPACITY_LOW, R_OPACITY_HIGH, R_KAPPA, R_WILD, R_FAINT, R_SPREAD = (
    RECORD + column * LANES for column in (MEAN_X, MEAN_Y, OPACITY_LOW, OPACITY_HIGH, KAPPA, WILD, FAINT, SPREAD)
)
# its forms, four rows each where there is one parameter, and behind them the determinant
FP, FQ, FS, FW1, FW2, FK, FD = range(RECORD + FORMS * LANES, RECORD + (FORMS + 28) * LANES, 4 * LANES)


@njit(cache=True, error_model="numpy")
def table_rows(width):
    """Rows of the scratch for records of ``width`` columns."""
    return RECORD // LANES + max(width, (FD - RECORD) // LANES + 4)


@njit(cache=True, error_model="numpy")
def gather_means(candidates, block, means, mean_radius, origin, s):
    """Copy the means of the Gaussians ``block`` to the rows V0 .. V2, M0 .. R2; lanes in excess repeat the last one."""
    lanes = block.shape[0]
    for q in range(LANES):
        i = candidates[block[min(q, lanes - 1)]]
        for k in range(3):
            s[V0 + k * LANES + q] = means[i, k] - origin[k]
            s[M0 + k * LANES + q] = abs(means[i, k])
            s[R0 + k * LANES + q] = mean_radius[i, k] if mean_radius.shape[0] > 0 else 0.0


@njit(cache=True, error_model="numpy")
def gather(candidates, block, means, axes, noise, mean_radius, opacity_low, opacity_high, faint, origin, s):
    """Copy what the Gaussians ``block`` are made of to the rows V0 .. OPFAINT; lanes in excess repeat the last one."""
    gather_means(candidates, block, means, mean_radius, origin, s)
    lanes = block.shape[0]
    for q in range(LANES):
        i = candidates[block[min(q, lanes - 1)]]
        for column in range(3):
            for k in range(3):
                s[B00 + (3 * column + k) * LANES + q] = axes[i, k, column]
        for k in range(12):
            s[N0 + k * LANES + q] = noise[i, k]
        s[OPLOW + q] = opacity_low[i]
        s[OPHIGH + q] = opacity_high[i]
        s[OPFAINT + q] = faint[i]


@njit(cache=True, error_model="numpy")
def coordinate_errors(s, n, rotation_reach, camera_reach, unit):
    """Float errors of the camera coordinates and what ranges of means add to them (G2, S2): rows EX .. SZ."""
    c0, c1, c2 = camera_reach[0], camera_reach[1], camera_reach[2]
    for row in range(3):
        r0, r1, r2 = rotation_reach[3 * row], rotation_reach[3 * row + 1], rotation_reach[3 * row + 2]
        error, spread = EX + row * LANES, SX + row * LANES
        for q in range(n):
            # ten units of the sum of absolute products
            total = r0 * (s[M0 + q] + s[R0 + q] + c0) + r1 * (s[M1 + q] + s[R1 + q] + c1) + r2 * (
                s[M2 + q] + s[R2 + q] + c2
            )
            s[error + q] = 10.0 * unit * total * _UP
        for q in range(n):
            s[spread + q] = (r0 * s[R0 + q] + r1 * s[R1 + q] + r2 * s[R2 + q]) * _UP


@njit(cache=True, error_model="numpy")
def float_errors(s, n, rules, camera, errors, rotation_reach):
    """Float errors of mean, covariance and exponent, and the radius' range (design.md, G5-G8): rows ZLOW .. TAME.

    Numbers of Gaussians that may come too near are of no use; `regions` does not look at them.
    """
    sigmas, discriminant_min, margin = rules[4], rules[5], rules[6]
    fx, fy, cx, cy, width, height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    unit, division, root = errors[0], errors[2], errors[3]
    rr0, rr1, rr2 = rotation_reach[0], rotation_reach[1], rotation_reach[2]
    rr3, rr4, rr5 = rotation_reach[3], rotation_reach[4], rotation_reach[5]
    rr6, rr7, rr8 = rotation_reach[6], rotation_reach[7], rotation_reach[8]
    limit_x, limit_y, clamp_x, clamp_y = np.inf, np.inf, 0.0, 0.0
    if margin >= 0.0:
        limit_x = max(cx, width - cx) / fx + margin * 0.5 * width / fx
        limit_y = max(cy, height - cy) / fy + margin * 0.5 * height / fy
        clamp_x, clamp_y = 8.0 * unit * limit_x, 8.0 * unit * limit_y
    for q in range(n):
        error_z = s[EZ + q]
        z_low = s[ZLO + q] - error_z
        z_high = s[ZHI + q] + error_z
        s[ZLOW + q] = z_low
        s[ZHIGH + q] = z_high
        ratio_x = max(abs(s[ULO + q]), abs(s[UHI + q]))
        ratio_y = max(abs(s[VLO + q]), abs(s[VHI + q]))
        # G5: reciprocal of depth, means
        relative_z = error_z / z_low
        relative_rz = relative_z + (division + 1.0) * unit
        error_u = s[EX + q] / z_low + ratio_x * (relative_rz + 2.0 * unit)
        error_v = s[EY + q] / z_low + ratio_y * (relative_rz + 2.0 * unit)
        error_mean_x = fx * error_u + 8.0 * unit * (fx * ratio_x + abs(cx))
        error_mean_y = fy * error_v + 8.0 * unit * (fy * ratio_y + abs(cy))
        s[MXLO + q] = fx * s[ULO + q] + cx - error_mean_x * REGION
        s[MXHI + q] = fx * s[UHI + q] + cx + error_mean_x * REGION
        s[MYLO + q] = fy * s[VLO + q] + cy - error_mean_y * REGION
        s[MYHI + q] = fy * s[VHI + q] + cy + error_mean_y * REGION
        # clamped ratios
        ratio_x = min(ratio_x, limit_x)
        ratio_y = min(ratio_y, limit_y)
        error_u = min(error_u, 2.0 * limit_x) + clamp_x
        error_v = min(error_v, 2.0 * limit_y) + clamp_y
        # G6: covariance. F bounds the error of the world covariance and all later roundings
        relative_j = relative_z + 2.0 * relative_rz + 8.0 * unit
        jx = fx / z_low
        jy = fy / z_low
        deep0, deep1, deep2 = s[DEEP0 + q], s[DEEP1 + q], s[DEEP2 + q]
        depth_variance = deep0 * deep0 + deep1 * deep1 + deep2 * deep2
        gx0 = jx * (rr0 + ratio_x * rr6)
        gx1 = jx * (rr1 + ratio_x * rr7)
        gx2 = jx * (rr2 + ratio_x * rr8)
        gy0 = jy * (rr3 + ratio_y * rr6)
        gy1 = jy * (rr4 + ratio_y * rr7)
        gy2 = jy * (rr5 + ratio_y * rr8)
        grow = relative_j * (2.0 + relative_j)
        f00 = s[N0 + q] + grow * s[N6 + q]
        f11 = s[N1 + q] + grow * s[N7 + q]
        f22 = s[N2 + q] + grow * s[N8 + q]
        f01 = s[N3 + q] + grow * s[N9 + q]
        f02 = s[N4 + q] + grow * s[N10 + q]
        f12 = s[N5 + q] + grow * s[N11 + q]
        depth_variance += f00 * rr6 * rr6 + f11 * rr7 * rr7 + f22 * rr8 * rr8
        depth_variance += 2.0 * (f01 * rr6 * rr7 + f02 * rr6 * rr8 + f12 * rr7 * rr8)
        error_a = (
            gx0 * (f00 * gx0 + f01 * gx1 + f02 * gx2)
            + gx1 * (f01 * gx0 + f11 * gx1 + f12 * gx2)
            + gx2 * (f02 * gx0 + f12 * gx1 + f22 * gx2)
        )
        h0 = f00 * gy0 + f01 * gy1 + f02 * gy2
        h1 = f01 * gy0 + f11 * gy1 + f12 * gy2
        h2 = f02 * gy0 + f12 * gy1 + f22 * gy2
        error_b = gx0 * h0 + gx1 * h1 + gx2 * h2
        error_c = gy0 * h0 + gy1 * h1 + gy2 * h2
        z2_low = z_low * z_low
        z2_high = z_high * z_high
        a = s[AHI + q] / z2_low
        c = s[CHI + q] / z2_low
        b = max(abs(s[BLO + q]), abs(s[BHI + q])) / z2_low
        det = s[DLO + q] / (z2_high * z2_high)
        jump_x = jx * error_u
        jump_y = jy * error_v
        deep = np.sqrt(depth_variance)
        root_a = np.sqrt(a)
        root_c = np.sqrt(c)
        error_a = (
            error_a + 2.0 * jump_x * deep * root_a + jump_x * jump_x * depth_variance + 2.0 * unit * a
        ) * 1.01
        error_c = (
            error_c + 2.0 * jump_y * deep * root_c + jump_y * jump_y * depth_variance + 2.0 * unit * c
        ) * 1.01
        error_b = (
            error_b + deep * (jump_x * root_c + jump_y * root_a) + jump_x * jump_y * depth_variance + 2.0 * unit * b
        ) * 1.01
        # G8: lambda_max = (a + c)/2 + sqrt(max(floor, ((a - c)/2)^2 + b^2))
        difference = max(abs(s[LO + q]), abs(s[HI + q])) / z2_low
        nearest = max(0.0, s[LO + q], -s[HI + q]) / z2_high
        b_nearest = max(0.0, s[BLO + q], -s[BHI + q]) / z2_high
        half_high = 0.5 * (a + c)
        half_low = 0.5 * (max(s[ALO + q], 0.0) + max(s[CLO + q], 0.0)) / z2_high
        error_half = 0.5 * (error_a + error_c) + 4.0 * unit * half_high
        products = 6.0 * unit * (a * c + b * b)
        error_det = (
            c * error_a + a * error_c + 2.0 * b * error_b + error_a * error_c + error_b * error_b + products
        ) * 1.01
        error_disc = (
            2.0 * half_high * error_half + error_half * error_half + error_det + 4.0 * unit * half_high * half_high
        )
        disc_high = max(discriminant_min, difference * difference + b * b + error_disc)
        disc_low = max(discriminant_min, nearest * nearest + b_nearest * b_nearest - error_disc)
        top_high = (half_high + error_half + np.sqrt(disc_high)) * (1.0 + 2.0 * root * unit)
        top_low = max(0.0, half_low - error_half + np.sqrt(disc_low)) * (1.0 - 2.0 * root * unit)
        # np.ceil: math.ceil is an int64, which a huge Gaussian overflows
        s[RHIGH + q] = np.ceil(sigmas * np.sqrt(top_high) * (1.0 + 2.0 * root * unit) * REGION)
        s[RLOW + q] = np.ceil(sigmas * np.sqrt(top_low) * (1.0 - 2.0 * root * unit) / REGION)
        # what is not finite, or not a number, in any of them is not so in the sum
        s[TAME + q] = a + c + error_a + error_b + error_c
        s[A + q] = a
        s[C + q] = c
        s[DET + q] = det
        s[EDET + q] = error_det
        s[SHARP + q] = (error_det + products) / det
        # G7: relative error of the exponent
        s[ETA + q] = (
            (c * error_a + 2.0 * (root_a * root_c) * error_b + a * error_c) / det + 80.0 * unit * (a * c) / det
        ) * 1.01
        # float error of the mean, in units of y
        s[EW + q] = (np.sqrt(c / det) * error_mean_x + np.sqrt(a / det) * error_mean_y) * 1.01


def faint_exponents(opacity_high: np.ndarray, alpha_min: float, unit: float) -> np.ndarray:
    """Exponents [N] from which on opacities [N] leave less than ``alpha_min``, however they are evaluated (B4)."""
    with np.errstate(divide="ignore"):
        exponent = np.log(opacity_high * (1.0 + _SIGMOID * unit) * (1.0 + 64.0 * unit) / alpha_min)
    # room for the rounding of the exponential, which grows more slowly than the exponent's own error
    return exponent * REGION + 2.0**-30


@njit(cache=True, error_model="numpy", inline="always")
def _within(x, most):
    return min(max(x, 0.0), most)


@njit(cache=True, error_model="numpy")
def regions(s, n, rules, camera, errors, antialiased):
    """What is known of each Gaussian, from the rows of `float_errors` (design.md, G5-G9): rows GONE .. T7.

    GONE is 1 where no pose shows it, KNOWN where its forms may be relied on. The others may cover every pixel. Of a
    record: the opacities, kappa and the exponent from which on alpha is below the threshold.
    """
    near, far, tile, alpha_min, work_tile = rules[0], rules[1], rules[3], rules[7], rules[10]
    width, height = camera[4], camera[5]
    unit, division, root, overflow = errors[0], errors[2], errors[3], errors[6]
    cut = tile > 0.0
    side = tile if cut else work_tile
    across, down = np.ceil(width / side), np.ceil(height / side)
    # the compensation's own division and root
    above = (0.5 * division + root + 2.0) * unit if antialiased else 0.0
    for q in range(n):
        a, c, det, error_det = s[A + q], s[C + q], s[DET + q], s[EDET + q]
        mean_x_low, mean_x_high, mean_y_low, mean_y_high = s[MXLO + q], s[MXHI + q], s[MYLO + q], s[MYHI + q]
        z_high = s[ZHIGH + q]
        # in front of the camera; products of covariances that may overflow leave nothing known
        front = (s[ZLOW + q] >= near * (1.0 + 4.0 * unit)) & (z_high < np.inf)
        front = front & (a * c < overflow) & (s[TAME + q] < np.inf)
        radius_high, radius_low = s[RHIGH + q], s[RLOW + q]
        snap_x = 8.0 * unit * (abs(mean_x_low) + abs(mean_x_high) + radius_high)
        snap_y = 8.0 * unit * (abs(mean_y_low) + abs(mean_y_high) + radius_high)
        left, right = mean_x_low - radius_high - snap_x, mean_x_high + radius_high + snap_x
        top, bottom = mean_y_low - radius_high - snap_y, mean_y_high + radius_high + snap_y
        # a place that is not finite is no number in some of these
        placed = front & (right - left < np.inf) & (bottom - top < np.inf)
        bounded = placed & cut
        # image-border culls of fully_fused_projection_fwd.cu:171-180
        gone = bounded & ((right <= 0.0) | (left >= width) | (bottom <= 0.0) | (top >= height))
        s[T0 + q] = np.floor(_within(left / side, across)) if bounded else 0.0
        s[T1 + q] = np.ceil(_within(right / side, across)) if bounded else across
        s[T2 + q] = np.floor(_within(top / side, down)) if bounded else 0.0
        s[T3 + q] = np.ceil(_within(bottom / side, down)) if bounded else down
        # surely hit: the tile range of every mean and radius contains it
        left, right = mean_x_high - radius_low + snap_x, mean_x_low + radius_low - snap_x
        top, bottom = mean_y_high - radius_low + snap_y, mean_y_low + radius_low - snap_y
        sure = bounded & (left < width) & (top < height) & (right > 0.0) & (bottom > 0.0)
        whole = front & (not cut)
        s[T4 + q] = np.floor(_within(left / side, across)) if sure else 0.0
        last = np.ceil(_within(right / side, across)) if sure else (across if whole else 0.0)
        s[T5 + q] = s[T4 + q] if z_high > far else last
        s[T6 + q] = np.floor(_within(top / side, down)) if sure else 0.0
        s[T7 + q] = np.ceil(_within(bottom / side, down)) if sure else (down if whole else 0.0)
        # G7: relative error of the exponent
        sharp_enough = front & (det > 0.0) & (error_det < 0.5 * det)
        kappa = s[ETA + q]
        known = placed & sharp_enough & (kappa < 0.25)
        kappa = kappa * (1.0 + 4.0 * kappa)
        # sigmoid: two exponentials or divisions and an addition
        lower = s[OPLOW + q] * (1.0 - _SIGMOID * unit)
        opacity = s[OPHIGH + q] * (1.0 + _SIGMOID * unit) * (1.0 + above)
        upper = opacity
        faint = s[OPFAINT + q]
        if antialiased:
            # det0/det exceeds 1 where rounding lowers det: nothing is known before its error is.
            # compensation_fl^2 <= (det + e0)/(det - e), which falls in det
            excess = np.sqrt((1.0 + s[SHARP + q]) / (1.0 - error_det / det)) * REGION
            upper = min(1.0, opacity * excess) if sharp_enough else 1.0
            gone = gone | (sharp_enough & (upper * (1.0 + 64.0 * unit) < alpha_min))
            # compensation_fl^2 = max(0, (det0 + e)/(det + e)) may vanish
            ratio_low = s[DISC + q]
            relative = s[SHARP + q] / ratio_low + s[SHARP + q] + (division + 2.0) * unit
            known = known & (ratio_low > 0.0) & (relative < 0.25)
            slack = 0.51 * relative * (1.0 + relative) + (root + 1.0) * unit
            lower = lower * (1.0 - slack) if known else lower
            upper = opacity * (1.0 + slack) if known else upper
            faint = (faint + (above + slack) * REGION) if known else faint
        s[R_OPACITY_LOW + q] = lower
        s[R_OPACITY_HIGH + q] = upper
        s[R_KAPPA + q] = kappa if known else 0.0
        # pixels where alpha may reach the threshold
        gone = gone | (known & (faint < 0.0))
        faint = faint / (1.0 - kappa)
        s[R_FAINT + q] = faint if known else -1.0
        extent_x = np.sqrt(2.0 * faint * a) * REGION
        extent_y = np.sqrt(2.0 * faint * c) * REGION
        left, right = mean_x_low - extent_x, mean_x_high + extent_x
        top, bottom = mean_y_low - extent_y, mean_y_high + extent_y
        # no pixel centre inside
        gone = gone | (
            known & ((right < 0.5) | (left > width - 0.5) | (bottom < 0.5) | (top > height - 0.5))
        )
        s[BOX0 + q] = left if known else -np.inf
        s[BOX1 + q] = right if known else np.inf
        s[BOX2 + q] = top if known else -np.inf
        s[BOX3 + q] = bottom if known else np.inf
        # tiles without such pixels need not look at it
        s[T0 + q] = max(s[T0 + q], np.floor(max(left - 0.5, 0.0) / side)) if known else s[T0 + q]
        s[T1 + q] = min(s[T1 + q], np.floor(min(right - 0.5, width) / side) + 1.0) if known else s[T1 + q]
        s[T2 + q] = max(s[T2 + q], np.floor(max(top - 0.5, 0.0) / side)) if known else s[T2 + q]
        s[T3 + q] = min(s[T3 + q], np.floor(min(bottom - 0.5, height) / side) + 1.0) if known else s[T3 + q]
        s[GONE + q] = 1.0 if gone else 0.0
        s[KNOWN + q] = 1.0 if known else 0.0
