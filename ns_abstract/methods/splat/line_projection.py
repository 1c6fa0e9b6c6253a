"""Projects Gaussians over cells of one parameter with forms of order 2 (design.md, G4-G9): one loop over lanes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.forms import logarithm
from ns_abstract.arithmetic.line_forms import (
    LineForm,
    combined,
    ends,
    inverse,
    inverse_root,
    load,
    magnitude,
    multiplied,
    raised,
    scaled,
    store,
)
from ns_abstract.arithmetic.rounding import SUM_ROUNDING, UP
from ns_abstract.methods.splat import projection_errors as row
from ns_abstract.methods.splat.projection_errors import LANES


class _RotationRow(NamedTuple):
    """The forms of one row of the rotation, by column, and the magnitudes of their polynomials."""

    x: LineForm
    y: LineForm
    z: LineForm
    magnitude_x: float
    magnitude_y: float
    magnitude_z: float


@njit(cache=True, error_model="numpy", forceinline=True)
def _column(forms, k):
    """Return column ``k`` of forms [6, n]."""
    return LineForm(forms[0, k], forms[1, k], forms[2, k], forms[3, k])


@njit(cache=True, error_model="numpy", forceinline=True)
def _rotation_row(rotation, k):
    """Return row ``k`` of the rotation [6, 9]."""
    a, b, c = 3 * k, 3 * k + 1, 3 * k + 2
    return _RotationRow(
        _column(rotation, a), _column(rotation, b), _column(rotation, c),
        abs(rotation[0, a]) + rotation[4, a] + rotation[5, a],
        abs(rotation[0, b]) + rotation[4, b] + rotation[5, b],
        abs(rotation[0, c]) + rotation[4, c] + rotation[5, c],
    )  # fmt: skip


@njit(cache=True, error_model="numpy", forceinline=True)
def _rotated(r, x, y, z, shift, shift_size, spread):
    """Return ``r . (x, y, z) + shift`` for exact x, y, z and a form ``shift``, widened (`form_projection.rotate`)."""
    a, b, c = abs(x), abs(y), abs(z)
    radius = r.x.radius * a + r.y.radius * b + r.z.radius * c + shift.radius
    radius += SUM_ROUNDING * (r.magnitude_x * a + r.magnitude_y * b + r.magnitude_z * c + shift_size)
    return LineForm(
        r.x.center * x + r.y.center * y + r.z.center * z + shift.center,
        r.x.slope * x + r.y.slope * y + r.z.slope * z + shift.slope,
        r.x.bend * x + r.y.bend * y + r.z.bend * z + shift.bend,
        radius * UP + spread,
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _negated(a):
    return LineForm(-a.center, -a.slope, -a.bend, a.radius)


@njit(cache=True, error_model="numpy", forceinline=True)
def _clamped(a, low, high, limit_low, limit_high):
    """Return ``min(limit_high, max(-limit_low, a))`` given bounds of ``a`` (`wide_forms.clamp`)."""
    a = raised(a, -limit_low, low, high)
    low, high = max(low, -limit_low), max(high, -limit_low)
    return _negated(raised(_negated(a), -limit_high, -high, -low))


@njit(cache=True, error_model="numpy", forceinline=True)
def _pixels(a, z, ratio, focal):
    """Return a pixel offset times depth, ``focal a - (focal ratio) z``, which vanishes at the middle of the cell."""
    # the pixel offset used later is exactly focal * ratio in float64
    shift = focal * ratio
    radius = focal * a.radius + abs(shift) * z.radius
    radius = radius + SUM_ROUNDING * (focal * magnitude(a) + abs(shift) * magnitude(z))
    return LineForm(
        focal * a.center - shift * z.center, focal * a.slope - shift * z.slope, focal * a.bend - shift * z.bend,
        radius * UP,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", forceinline=True)
def _lowered(c, a, b):
    """Return ``c - a b``."""
    return combined(c, 1.0, multiplied(a, b), -1.0)


@njit(cache=True, error_model="numpy", forceinline=True)
def _sum_of_products(a0, b0, a1, b1, a2, b2):
    return combined(combined(multiplied(a0, b0), 1.0, multiplied(a1, b1), 1.0), 1.0, multiplied(a2, b2), 1.0)


@njit(cache=True, error_model="numpy", forceinline=True)
def _crossed(a, b, c, d):
    """Return ``(a d - b c)^2``."""
    cross = combined(multiplied(a, d), 1.0, multiplied(b, c), -1.0)
    return multiplied(cross, cross)


@njit(cache=True, error_model="numpy", forceinline=True)
def _seen_axis(rows, x, y, z, u, v):
    """Return ``w0 - u w2``, ``w1 - v w2`` and the magnitude of ``w2``, for ``w = R b`` of a scaled axis b."""
    still = LineForm(0.0, 0.0, 0.0, 0.0)
    deep = _rotated(rows[2], x, y, z, still, 0.0, 0.0)
    n0 = _lowered(_rotated(rows[0], x, y, z, still, 0.0, 0.0), u, deep)
    n1 = _lowered(_rotated(rows[1], x, y, z, still, 0.0, 0.0), v, deep)
    return n0, n1, magnitude(deep) + deep.radius


@njit(cache=True, error_model="numpy", forceinline=True)
def _store_whitening(s, q, z, dx, dy, b, c, det):
    """Fill FP .. FW2 of lane ``q`` from the covariance times z^2 and pixel offsets times z (design.md, G7)."""
    # S' = 1/sqrt(c'), P' = sqrt(c'/det'), Q' = P' b'/c'
    root = inverse_root(c)
    along = multiplied(multiplied(c, root), inverse_root(det))
    across = multiplied(along, multiplied(multiplied(b, root), root))
    # P = P' z, Q = Q' z, S = S' z, W1 = P' X^ - Q' Y^, W2 = S' Y^
    store(multiplied(along, z), s, row.FP, LANES, q)
    store(multiplied(across, z), s, row.FQ, LANES, q)
    store(multiplied(root, z), s, row.FS, LANES, q)
    store(combined(multiplied(along, dx), 1.0, multiplied(across, dy), -1.0), s, row.FW1, LANES, q)
    store(multiplied(root, dy), s, row.FW2, LANES, q)


@njit(cache=True, error_model="numpy")
def project_line(s, n, rotation, offset, camera, rules):
    """Compute bounds and forms of ``n`` Gaussians from the rows of `projection_errors.gather` (design.md, G1, G4-G9).

    ``rotation`` [6, 9] and ``offset`` [6, 3] are the pose's forms. Fills the rows ZLO .. HI, DEEP0 .. Y0, and the forms
    FP .. FW2, of K before the logarithm and of the determinant.
    """
    eps2d, margin = rules.eps2d, rules.view_margin
    fx, fy, cx, cy, width, height = camera
    rows = _rotation_row(rotation, 0), _rotation_row(rotation, 1), _rotation_row(rotation, 2)
    offset_x, offset_y, offset_z = _column(offset, 0), _column(offset, 1), _column(offset, 2)
    size_x, size_y, size_z = magnitude(offset_x), magnitude(offset_y), magnitude(offset_z)
    left, right, top, bottom = np.inf, np.inf, np.inf, np.inf
    if margin >= 0.0:
        left, right = cx / fx + margin * 0.5 * width / fx, (width - cx) / fx + margin * 0.5 * width / fx
        top, bottom = cy / fy + margin * 0.5 * height / fy, (height - cy) / fy + margin * 0.5 * height / fy
    for q in range(n):
        v0, v1, v2 = s[row.V0 + q], s[row.V1 + q], s[row.V2 + q]
        x = _rotated(rows[0], v0, v1, v2, offset_x, size_x, s[row.SX + q])
        y = _rotated(rows[1], v0, v1, v2, offset_y, size_y, s[row.SY + q])
        z = _rotated(rows[2], v0, v1, v2, offset_z, size_z, s[row.SZ + q])
        s[row.ZLO + q], s[row.ZHI + q] = ends(z)
        s[row.Z0 + q] = z.center
        inverse_z = inverse(z)
        u, v = multiplied(x, inverse_z), multiplied(y, inverse_z)
        u_low, u_high = ends(u)
        v_low, v_high = ends(v)
        s[row.ULO + q], s[row.UHI + q] = u_low, u_high
        s[row.VLO + q], s[row.VHI + q] = v_low, v_high
        s[row.X0 + q], s[row.Y0 + q] = fx * u.center, fy * v.center
        dx, dy = _pixels(x, z, u.center, fx), _pixels(y, z, v.center, fy)
        # the Jacobian's clamped ratios
        u = _clamped(u, u_low, u_high, left, right)
        v = _clamped(v, v_low, v_high, top, bottom)
        n00, n10, s[row.DEEP0 + q] = _seen_axis(rows, s[row.B00 + q], s[row.B10 + q], s[row.B20 + q], u, v)
        n01, n11, s[row.DEEP1 + q] = _seen_axis(rows, s[row.B01 + q], s[row.B11 + q], s[row.B21 + q], u, v)
        n02, n12, s[row.DEEP2 + q] = _seen_axis(rows, s[row.B02 + q], s[row.B12 + q], s[row.B22 + q], u, v)
        # a' = fx^2 |n0|^2 + eps z^2, c' = fy^2 |n1|^2 + eps z^2, b' = fx fy n0.n1 (covariance times z^2)
        z2 = multiplied(z, z)
        n0 = _sum_of_products(n00, n00, n01, n01, n02, n02)
        n1 = _sum_of_products(n10, n10, n11, n11, n12, n12)
        b = scaled(_sum_of_products(n00, n10, n01, n11, n02, n12), fx * fy)
        # det' = fx^2 fy^2 |n0 x n1|^2 + eps z^2 (fx^2 |n0|^2 + fy^2 |n1|^2) + eps^2 z^4, sums of squares only
        k = combined(_crossed(n00, n01, n10, n11), 1.0, _crossed(n00, n02, n10, n12), 1.0)
        k = scaled(combined(k, 1.0, _crossed(n01, n02, n11, n12), 1.0), (fx * fy) * (fx * fy))
        blurred = combined(combined(n0, fx * fx, n1, fy * fy), eps2d, z2, eps2d * eps2d)
        det = combined(k, 1.0, multiplied(blurred, z2), 1.0)
        a = combined(n0, fx * fx, z2, eps2d)
        c = combined(n1, fy * fy, z2, eps2d)
        s[row.ALO + q], s[row.AHI + q] = ends(a)
        s[row.CLO + q], s[row.CHI + q] = ends(c)
        s[row.BLO + q], s[row.BHI + q] = ends(b)
        s[row.DLO + q], s[row.DHI + q] = ends(det)
        # (a' - c')/2, for the radius
        s[row.LO + q], s[row.HI + q] = ends(combined(a, 0.5, c, -0.5))
        _store_whitening(s, q, z, dx, dy, b, c, det)
        store(k, s, row.FK, LANES, q)
        store(det, s, row.FD, LANES, q)


@njit(cache=True, error_model="numpy")
def compensate_line(s, n, ratios, scratch, out):
    """Compute K = -log(compensation) in rows FK, and bounds of compensation^2 = |n0 x n1|^2 / det' in SQLO and SQHI.

    ``ratios``, ``out`` [6, lanes] and ``scratch`` [5, lanes] are scratch: the logarithm is not vectorised.
    """
    for q in range(n):
        ratio = multiplied(load(s, row.FK, LANES, q), inverse(load(s, row.FD, LANES, q)))
        s[row.SQLO + q], s[row.SQHI + q] = ends(ratio)
        ratios[0, q], ratios[1, q], ratios[2, q], ratios[3, q] = ratio.center, ratio.slope, ratio.bend, ratio.radius
        ratios[4, q], ratios[5, q] = abs(ratio.slope), abs(ratio.bend)
    logarithm(ratios, scratch, out, 1, 2, 3)
    for q in range(n):
        store(scaled(_column(out, q), -0.5), s, row.FK, LANES, q)
