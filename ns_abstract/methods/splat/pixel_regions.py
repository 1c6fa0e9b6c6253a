"""Finds the pixels and tiles in which projected Gaussians may show (docs/dev/design.md, G8-G12)."""

from __future__ import annotations

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import (
    COVARIANCE_ERROR,
    ELLIPSE_ERROR,
    ELLIPSE_SHARPNESS,
    ELLIPSE_SPAN,
    ELLIPSE_TIPS,
    LOGARITHM_ROOM,
    REGION,
    Charges,
)
from ns_abstract.methods.splat import projection_errors as row


def exponent_limits(opacity_high: np.ndarray, alpha_min: float, charges: Charges) -> np.ndarray:
    """Return the exponents [N] above which alpha is below ``alpha_min`` in every evaluation, for opacities [N] (B4)."""
    with np.errstate(divide="ignore"):
        exponent = np.log(opacity_high * (1.0 + charges.opacity) * (1.0 + charges.exponent_limit) / alpha_min)
    # room for the rounding of the exponential, which grows more slowly than the exponent's own error
    return exponent * REGION + LOGARITHM_ROOM


@njit(cache=True, error_model="numpy", forceinline=True)
def _within(x, most):
    return min(max(x, 0.0), most)


@njit(cache=True, error_model="numpy", forceinline=True)
def ellipse_is_met(sharpness, widest, thinnest, eta, span, charges):
    """Return whether a Gaussian's alpha is negligible in tiles that rounding may miss, by its covariance (G12).

    ``sharpness`` is det / (a c), ``widest`` and ``thinnest`` bound a and c, ``span`` the coordinates in pixels.
    """
    unit = 0.125 * charges.tile
    steep = 16.0 * unit * span * np.sqrt(widest / thinnest) < 0.25
    tips = (sharpness * sharpness > ELLIPSE_SHARPNESS * unit) & (
        sharpness * np.sqrt(thinnest) > ELLIPSE_TIPS * unit * span
    )
    return steep & tips & (eta < ELLIPSE_ERROR) & (span < ELLIPSE_SPAN)


@njit(cache=True, error_model="numpy", forceinline=True)
def largest_extent(s, q):
    """Return an upper bound of the largest standard deviation of one lane's Gaussian, up to rounding."""
    total = 0.0
    for k in range(9):
        entry = s[row.B00 + k * row.LANES + q]
        total += entry * entry
    return np.sqrt(total)


@njit(cache=True, error_model="numpy", forceinline=True)
def projected_stretch(rules, camera):
    """Return an upper bound of the norm of z J, up to rounding; 0 for the paper's rules, without float32 program."""
    if rules.view_margin < 0.0:
        return 0.0
    fx, fy, _, _, _, _ = camera
    limit_x, limit_y = row.view_limits(rules, camera)
    return np.sqrt(fx * fx * (1.0 + limit_x * limit_x) + fy * fy * (1.0 + limit_y * limit_y)) * REGION


@njit(cache=True, error_model="numpy")
def regions(s, n, rules, camera, charges):
    """Compute regions and tile ranges from the rows of `float_errors`: rows GONE .. T7 (design.md, G5-G12).

    GONE is 1 where no pose shows the Gaussian, KNOWN where its forms are valid; other Gaussians may cover every pixel.
    Also sets a record's opacities, kappa and the exponent above which alpha is below the threshold.
    """
    _tile_ranges(s, n, rules, camera, charges)
    _opacities(s, n, rules, charges)
    _pixel_boxes(s, n, rules, camera)


@njit(cache=True, error_model="numpy", forceinline=True)
def _tile_side(rules):
    """Return the side of a tile in pixels: the program's, or that of the work's division where it has none."""
    return rules.tile_size if rules.tile_size > 0.0 else float(rules.work_tile)


@njit(cache=True, error_model="numpy")
def _tile_ranges(s, n, rules, camera, charges):
    """Compute the program's tiles: rows T0 .. T7, GONE, FINITE, FRONT, PLACED (design.md, G8, G9, G12)."""
    near, far, room, ellipse = rules.near, rules.far, rules.tile_room, rules.ellipse_tiles
    width, height = camera.width, camera.height
    cut = rules.tile_size > 0.0
    side = _tile_side(rules)
    across, down = np.ceil(width / side), np.ceil(height / side)
    # below it no product of entries of a covariance overflows (G9)
    safe = near * np.sqrt(np.sqrt(charges.overflow)) * 0.5
    stretch = projected_stretch(rules, camera)
    for q in range(n):
        a, c = s[row.A + q], s[row.C + q]
        mean_x_low, mean_x_high, mean_y_low, mean_y_high = (
            s[row.MXLO + q],
            s[row.MXHI + q],
            s[row.MYLO + q],
            s[row.MYHI + q],
        )
        z_high = s[row.ZHIGH + q]
        # well in front of the camera; products of covariances that may overflow leave nothing known
        front = (s[row.ZLOW + q] >= near * row.IN_FRONT) & (z_high < np.inf)
        # at some pose the near or the far plane hides it
        cut_off = (s[row.ZLOW + q] < near * (1.0 + charges.near)) | (z_high > far)
        front = front & (a * c < charges.overflow) & (s[row.TAME + q] < np.inf)
        largest = largest_extent(s, q)
        finite = (front | (largest * stretch < safe)) & (
            largest * largest * max(1.0, stretch / near) < charges.overflow
        )
        front = front & finite
        radius_high, radius_low = s[row.RHIGH + q], s[row.RLOW + q]
        snap_x = charges.tile * (abs(mean_x_low) + abs(mean_x_high) + radius_high)
        snap_y = charges.tile * (abs(mean_y_low) + abs(mean_y_high) + radius_high)
        left, right = mean_x_low - radius_high - snap_x, mean_x_high + radius_high + snap_x
        top, bottom = mean_y_low - radius_high - snap_y, mean_y_high + radius_high + snap_y
        # a place that is not finite is no number in some of these
        placed = front & (right - left < np.inf) & (bottom - top < np.inf)
        bounded = placed & (rules.view_margin >= 0.0)
        # image-border culls of fully_fused_projection_fwd.cu:171-180
        gone = bounded & ((right <= 0.0) | (left >= width) | (bottom <= 0.0) | (top >= height))
        # the tiles of an ellipse come from the conic, which may be wrong by any amount
        boxed = bounded & (not ellipse)
        s[row.T0 + q] = np.floor(_within(left / side, across)) if boxed else 0.0
        s[row.T1 + q] = np.ceil(_within(right / side, across)) if boxed else across
        s[row.T2 + q] = np.floor(_within(top / side, down)) if boxed else 0.0
        s[row.T3 + q] = np.ceil(_within(bottom / side, down)) if boxed else down
        # surely hit: the tile range of every mean and radius contains it
        left, right = mean_x_high - radius_low + snap_x, mean_x_low + radius_low - snap_x
        top, bottom = mean_y_high - radius_low + snap_y, mean_y_low + radius_low - snap_y
        sure = placed & cut & (left < width) & (top < height) & (right > 0.0) & (bottom > 0.0)
        whole = front & (not cut)
        if room > 0.0:
            # G12: where rounding moves a box or an ellipse by less than half a pixel
            span = radius_high + max(abs(mean_x_low), abs(mean_x_high)) + max(abs(mean_y_low), abs(mean_y_high))
            whole = whole & (s[row.ETA + q] * (1.0 + 4.0 * s[row.ETA + q]) < 0.05) & (8.0 * charges.tile * span < 1.0)
            if ellipse:
                thinnest = max(min(s[row.ALO + q], s[row.CLO + q]), 0.0) / (z_high * z_high)
                sharpness = s[row.DET + q] / (a * c)
                whole = whole & ellipse_is_met(sharpness, max(a, c), thinnest, s[row.ETA + q], span, charges)
        s[row.T4 + q] = np.floor(_within(left / side, across)) if sure else 0.0
        last = np.ceil(_within(right / side, across)) if sure else (across if whole else 0.0)
        s[row.T5 + q] = s[row.T4 + q] if cut_off else last
        s[row.T6 + q] = np.floor(_within(top / side, down)) if sure else 0.0
        s[row.T7 + q] = np.ceil(_within(bottom / side, down)) if sure else (down if whole else 0.0)
        s[row.GONE + q], s[row.FINITE + q] = 1.0 if gone else 0.0, 1.0 if finite else 0.0
        s[row.FRONT + q], s[row.PLACED + q] = 1.0 if front else 0.0, 1.0 if placed else 0.0


@njit(cache=True, error_model="numpy")
def _opacities(s, n, rules, charges):
    """Compute opacities, kappa and exponents: KNOWN, GONE, columns of the record, REGIONLIMIT (G7, G9, G11)."""
    alpha_min, antialiased = rules.alpha_min, rules.antialiased
    for q in range(n):
        det = s[row.DET + q]
        finite = s[row.FINITE + q] != 0.0
        # G7: relative error of the exponent
        kappa = s[row.ETA + q]
        sharp = (s[row.EDET + q] < 0.5 * det) | (kappa < COVARIANCE_ERROR)
        sharp_enough = (s[row.FRONT + q] != 0.0) & (det > 0.0) & sharp
        region_is_known = (s[row.PLACED + q] != 0.0) & sharp_enough & (kappa < COVARIANCE_ERROR)
        kappa = kappa * (1.0 + 2.0 * kappa)
        lower = s[row.OPLOW + q] * (1.0 - charges.opacity)
        upper = s[row.OPHIGH + q] * (1.0 + charges.opacity)
        limit = s[row.OPLIMIT + q]
        region_limit = limit
        gone = s[row.GONE + q] != 0.0
        if antialiased:
            # G11; where the determinant may vanish, nothing is known of the compensation
            region_is_known = region_is_known & (s[row.CTOP + q] < np.inf)
            region_limit = limit + s[row.CTOPLOG + q]
            limit = limit + s[row.CHIGHLOG + q]
            all_of_it = min(1.0, upper * s[row.CTOP + q]) if sharp_enough & (s[row.CTOP + q] < np.inf) else 1.0
            gone = gone | (all_of_it * (1.0 + charges.exponent_limit) < alpha_min)
            lower = lower * s[row.CLOW + q] if region_is_known else lower
            upper = upper * s[row.CHIGH + q] if region_is_known else all_of_it
        # a minimum with a number is a number: an exponent that is none leaves the largest alpha
        upper = upper if finite else max(1.0, upper)
        gone = (gone & finite) | (region_is_known & (region_limit < 0.0))
        s[row.R_OPACITY_LOW + q] = lower
        s[row.R_OPACITY_HIGH + q] = upper
        s[row.R_KAPPA + q] = kappa if region_is_known else 0.0
        s[row.R_EXPONENT_LIMIT + q] = limit / (1.0 - kappa) if region_is_known else -1.0
        s[row.REGIONLIMIT + q] = region_limit / (1.0 - kappa)
        s[row.GONE + q], s[row.KNOWN + q] = 1.0 if gone else 0.0, 1.0 if region_is_known else 0.0


@njit(cache=True, error_model="numpy")
def _pixel_boxes(s, n, rules, camera):
    """Compute the pixels where alpha may reach the threshold: rows BOX0 .. BOX3, GONE; reduce tiles to them (G9)."""
    width, height = camera.width, camera.height
    side = _tile_side(rules)
    for q in range(n):
        region_is_known = s[row.KNOWN + q] != 0.0
        extent_x = np.sqrt(2.0 * s[row.REGIONLIMIT + q] * s[row.A + q]) * REGION
        extent_y = np.sqrt(2.0 * s[row.REGIONLIMIT + q] * s[row.C + q]) * REGION
        left, right = s[row.MXLO + q] - extent_x, s[row.MXHI + q] + extent_x
        top, bottom = s[row.MYLO + q] - extent_y, s[row.MYHI + q] + extent_y
        # no pixel centre inside
        outside = region_is_known & ((right < 0.5) | (left > width - 0.5) | (bottom < 0.5) | (top > height - 0.5))
        s[row.GONE + q] = 1.0 if outside else s[row.GONE + q]
        s[row.BOX0 + q] = left if region_is_known else -np.inf
        s[row.BOX1 + q] = right if region_is_known else np.inf
        s[row.BOX2 + q] = top if region_is_known else -np.inf
        s[row.BOX3 + q] = bottom if region_is_known else np.inf
        # tiles without such pixels need not look at it
        s[row.T0 + q] = max(s[row.T0 + q], np.floor(max(left - 0.5, 0.0) / side)) if region_is_known else s[row.T0 + q]
        s[row.T1 + q] = (
            min(s[row.T1 + q], np.floor(min(right - 0.5, width) / side) + 1.0) if region_is_known else s[row.T1 + q]
        )
        s[row.T2 + q] = max(s[row.T2 + q], np.floor(max(top - 0.5, 0.0) / side)) if region_is_known else s[row.T2 + q]
        s[row.T3 + q] = (
            min(s[row.T3 + q], np.floor(min(bottom - 0.5, height) / side) + 1.0) if region_is_known else s[row.T3 + q]
        )
