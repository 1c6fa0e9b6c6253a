"""Projects Gaussians over cells of any number of parameters, eight forms at a time (docs/dev/design.md, G4-G9)."""

from __future__ import annotations

from numba import njit

from ns_abstract.arithmetic.rounding import SUM_ROUNDING, UP
from ns_abstract.arithmetic.simd.lanes import load8, store
from ns_abstract.arithmetic.simd.wide_forms import (
    add_product,
    add_square,
    bounds,
    clamp,
    clear,
    logarithm,
    magnitude,
    multiply,
    reciprocal,
    reciprocal_square_root,
    scale_add,
    set_norms,
    size,
    square,
)
from ns_abstract.methods.splat import projection_errors as row
from ns_abstract.methods.splat.projection_errors import LANES

# numbers of the forms in the workspace; behind _LOG stands the logarithm's scratch
(
    _X, _Y, _Z, _RZ, _U, _V, _DX, _DY, _W0, _W1, _W2, _N0, _N1, _N2, _N3, _N4, _N5,
    _A, _B, _C, _DET, _K, _T0, _T1, _T2, _P, _Q, _S, _LOG,
) = range(29)  # fmt: skip
WORKSPACE = 30


@njit(cache=True, error_model="numpy")
def rotate(w, rotation, r, v, offset, shifted, spread, out, shape):
    """Compute row ``r`` of the rotation times an exact vector ``v``, plus the offset if ``shifted``, within ``spread``.

    ``rotation`` [rows, 9] and ``offset`` [rows, 3], both flat, are the pose's forms.
    """
    d, order, m = shape.dimensions, shape.order, shape.monomials
    x, y, z = v
    a, b, c = 3 * r, 3 * r + 1, 3 * r + 2
    for k in range(m):
        total = rotation[9 * k + a] * x + rotation[9 * k + b] * y + rotation[9 * k + c] * z
        if shifted:
            total = total + offset[3 * k + r]
        store(w, out + 8 * k, total)
    x, y, z = abs(x), abs(y), abs(z)
    linear, curved = 9 * (m + 1), 9 * (m + 2)
    size_a = abs(rotation[a]) + rotation[linear + a] + rotation[curved + a]
    size_b = abs(rotation[b]) + rotation[linear + b] + rotation[curved + b]
    size_c = abs(rotation[c]) + rotation[linear + c] + rotation[curved + c]
    radius = rotation[9 * m + a] * x + rotation[9 * m + b] * y + rotation[9 * m + c] * z
    rounding = size_a * x + size_b * y + size_c * z
    if shifted:
        radius = radius + offset[3 * m + r]
        rounding = rounding + (abs(offset[r]) + offset[3 * (m + 1) + r] + offset[3 * (m + 2) + r])
    store(w, out + 8 * m, (radius + SUM_ROUNDING * rounding) * UP + spread)
    set_norms(w, out, m, order, d)


@njit(cache=True, error_model="numpy", forceinline=True)
def _keep_bounds(w, a, s, low, high, q, m):
    """Write the bounds of a form to two rows, and return them."""
    bottom, top = bounds(w, a, m)
    store(s, low + q, bottom)
    store(s, high + q, top)
    return bottom, top


@njit(cache=True, error_model="numpy", forceinline=True)
def _pixels(w, a, z, ratio, focal, out, m):
    """Compute a pixel offset times depth, ``focal a - (focal ratio) z``, which vanishes at the middle of the cell.

    ``ratio`` is a form; returns the focal length times its centre.
    """
    # the pixel offset used later is exactly focal * ratio in float64
    shift = focal * load8(w, ratio)
    for k in range(m):
        store(w, out + 8 * k, focal * load8(w, a + 8 * k) - shift * load8(w, z + 8 * k))
    rounding = focal * magnitude(w, a, m) + abs(shift) * magnitude(w, z, m)
    radius = focal * load8(w, a + 8 * m) + abs(shift) * load8(w, z + 8 * m) + SUM_ROUNDING * rounding
    store(w, out + 8 * m, radius * UP)
    set_norms(w, out, m)
    return shift


@njit(cache=True, error_model="numpy")
def _lower(w, a, b, out, m):
    """Write ``out -= a b``."""
    # the subtraction's own rounding, for what it starts from
    store(w, out + 8 * m, load8(w, out + 8 * m) + SUM_ROUNDING * magnitude(w, out, m))
    add_product(w, a, b, -1.0, out, m)
    set_norms(w, out, m)


@njit(cache=True, error_model="numpy", forceinline=True)
def _keep(w, a, s, f, q, m):
    """Write form number ``f`` of a record."""
    for k in range(m + 1):
        store(s, row.FP + (f * (m + 1) + k) * LANES + q, load8(w, a + 8 * k))


@njit(cache=True, error_model="numpy", forceinline=True)
def _project_means(w, s, rotation, offset, camera, q, shape):
    """Compute camera coordinates, ratios u = x / z, v = y / z, and pixel offsets times depth: _X .. _DY.

    Returns bounds of u and v.
    """
    m = shape.monomials
    one = size(m)
    x, y, z, inverse, u, v = _X * one, _Y * one, _Z * one, _RZ * one, _U * one, _V * one
    mean = load8(s, row.V0 + q), load8(s, row.V1 + q), load8(s, row.V2 + q)
    rotate(w, rotation, 0, mean, offset, True, load8(s, row.SX + q), x, shape)
    rotate(w, rotation, 1, mean, offset, True, load8(s, row.SY + q), y, shape)
    rotate(w, rotation, 2, mean, offset, True, load8(s, row.SZ + q), z, shape)
    _keep_bounds(w, z, s, row.ZLO, row.ZHI, q, m)
    store(s, row.Z0 + q, load8(w, z))
    reciprocal(w, z, inverse, m)
    multiply(w, x, inverse, u, m)
    multiply(w, y, inverse, v, m)
    u_range = _keep_bounds(w, u, s, row.ULO, row.UHI, q, m)
    v_range = _keep_bounds(w, v, s, row.VLO, row.VHI, q, m)
    store(s, row.X0 + q, _pixels(w, x, z, u, camera.fx, _DX * one, m))
    store(s, row.Y0 + q, _pixels(w, y, z, v, camera.fy, _DY * one, m))
    return u_range, v_range


@njit(cache=True, error_model="numpy", forceinline=True)
def _clamp_ratios(w, u_range, v_range, camera, margin, m):
    """Clamp the ratios that the Jacobian is evaluated at."""
    fx, fy, cx, cy, width, height = camera
    one = size(m)
    extra = margin * 0.5 * width / fx
    clamp(w, _U * one, -(cx / fx + extra), (width - cx) / fx + extra, u_range[0], u_range[1], m)
    extra = margin * 0.5 * height / fy
    clamp(w, _V * one, -(cy / fy + extra), (height - cy) / fy + extra, v_range[0], v_range[1], m)


@njit(cache=True, error_model="numpy", forceinline=True)
def _project_axes(w, s, rotation, offset, q, shape):
    """Compute w = R B, then n0 = w0 - u w2 and n1 = w1 - v w2: _N0 .. _N5."""
    m = shape.monomials
    one = size(m)
    deep = _W2 * one
    none = 0.0 * load8(s, row.V0 + q)
    for column in range(3):
        at = row.B00 + 3 * column * LANES + q
        axis = load8(s, at), load8(s, at + LANES), load8(s, at + 2 * LANES)
        n0, n1 = (_N0 + column) * one, (_N3 + column) * one
        rotate(w, rotation, 0, axis, offset, False, none, n0, shape)
        rotate(w, rotation, 1, axis, offset, False, none, n1, shape)
        rotate(w, rotation, 2, axis, offset, False, none, deep, shape)
        store(s, row.DEEP0 + column * LANES + q, magnitude(w, deep, m) + load8(w, deep + 8 * m))
        _lower(w, _U * one, deep, n0, m)
        _lower(w, _V * one, deep, n1, m)


@njit(cache=True, error_model="numpy", forceinline=True)
def _covariance(w, s, camera, eps2d, q, m):
    """Compute the blurred covariance times z^2, and determinants times z^4 with and without blur: _A, _B, _C, _DET, _K.

    a' = fx^2 |n0|^2 + eps z^2, c' = fy^2 |n1|^2 + eps z^2, b' = fx fy n0.n1, and, of sums of squares only, det' = fx^2
    fy^2 |n0 x n1|^2 + eps z^2 (fx^2 |n0|^2 + fy^2 |n1|^2) + eps^2 z^4.
    """
    one = size(m)
    a, b, c, det, k, z2 = _A * one, _B * one, _C * one, _DET * one, _K * one, _T2 * one
    t0, t1 = _T0 * one, _T1 * one
    fx, fy = camera.fx, camera.fy
    square(w, _Z * one, z2, m)
    clear(w, a, m)
    clear(w, b, m)
    clear(w, c, m)
    for column in range(3):
        n0, n1 = (_N0 + column) * one, (_N3 + column) * one
        add_square(w, n0, a, m)
        add_square(w, n1, c, m)
        add_product(w, n0, n1, 1.0, b, m)
    set_norms(w, a, m)
    set_norms(w, b, m)
    set_norms(w, c, m)
    scale_add(w, b, fx * fy, b, 0.0, 0.0, b, m)
    clear(w, k, m)
    for column in range(3):
        i, j = (column + 1) % 3, (column + 2) % 3
        clear(w, t0, m)
        add_product(w, (_N0 + i) * one, (_N3 + j) * one, 1.0, t0, m)
        add_product(w, (_N0 + j) * one, (_N3 + i) * one, -1.0, t0, m)
        set_norms(w, t0, m)
        add_square(w, t0, k, m)
    set_norms(w, k, m)
    scale_add(w, k, (fx * fy) * (fx * fy), k, 0.0, 0.0, k, m)
    scale_add(w, a, fx * fx, c, fy * fy, 0.0, t0, m)
    scale_add(w, t0, eps2d, z2, eps2d * eps2d, 0.0, t1, m)
    scale_add(w, k, 1.0, k, 0.0, 0.0, det, m)
    add_product(w, t1, z2, 1.0, det, m)
    set_norms(w, det, m)
    scale_add(w, a, fx * fx, z2, eps2d, 0.0, a, m)
    scale_add(w, c, fy * fy, z2, eps2d, 0.0, c, m)
    _keep_bounds(w, a, s, row.ALO, row.AHI, q, m)
    _keep_bounds(w, c, s, row.CLO, row.CHI, q, m)
    _keep_bounds(w, b, s, row.BLO, row.BHI, q, m)
    _keep_bounds(w, det, s, row.DLO, row.DHI, q, m)
    # (a' - c')/2, for the radius
    scale_add(w, a, 0.5, c, -0.5, 0.0, t1, m)
    _keep_bounds(w, t1, s, row.LO, row.HI, q, m)


@njit(cache=True, error_model="numpy", forceinline=True)
def _compensate(w, s, q, m):
    """Compute K = -log(compensation), with compensation^2 = |n0 x n1|^2 / det', and bounds of the latter."""
    one = size(m)
    k, t0, t1 = _K * one, _T0 * one, _T1 * one
    reciprocal(w, _DET * one, t0, m)
    multiply(w, k, t0, t1, m)
    _keep_bounds(w, t1, s, row.SQLO, row.SQHI, q, m)
    logarithm(w, t1, _LOG * one, m)
    scale_add(w, _LOG * one, -0.5, _LOG * one, 0.0, 0.0, k, m)
    _keep(w, k, s, 5, q, m)


@njit(cache=True, error_model="numpy", forceinline=True)
def _whiten(w, s, q, m):
    """Compute the forms of a record: P = P' z, Q = Q' z, S = S' z, W1 = P' X^ - Q' Y^, W2 = S' Y^."""
    one = size(m)
    z, p, across, root = _Z * one, _P * one, _Q * one, _S * one
    t0 = _T0 * one
    multiply(w, p, z, t0, m)
    _keep(w, t0, s, 0, q, m)
    multiply(w, across, z, t0, m)
    _keep(w, t0, s, 1, q, m)
    multiply(w, root, z, t0, m)
    _keep(w, t0, s, 2, q, m)
    clear(w, t0, m)
    add_product(w, p, _DX * one, 1.0, t0, m)
    add_product(w, across, _DY * one, -1.0, t0, m)
    _keep(w, t0, s, 3, q, m)
    multiply(w, root, _DY * one, t0, m)
    _keep(w, t0, s, 4, q, m)


@njit(cache=True, error_model="numpy", forceinline=True)
def _factor(w, m):
    """Compute the factors of the inverse covariance, S' = 1/sqrt(c'), P' = sqrt(c'/det'), Q' = P' b'/c': _S, _P, _Q."""
    one = size(m)
    b, c, p, root, t0, t1 = _B * one, _C * one, _P * one, _S * one, _T0 * one, _T1 * one
    reciprocal_square_root(w, c, root, m)
    reciprocal_square_root(w, _DET * one, t0, m)
    multiply(w, c, root, t1, m)
    multiply(w, t1, t0, p, m)
    multiply(w, b, root, t0, m)
    multiply(w, t0, root, t1, m)
    multiply(w, p, t1, _Q * one, m)


@njit(cache=True, error_model="numpy")
def project_forms(w, s, rotation, offset, camera, rules, shape):
    """Do `line_projection.project_line` and its `compensate_line` with forms of order 1 in any number of parameters.

    See design.md, G1, G4. ``w`` is scratch for `WORKSPACE` forms; the forms of a record go to the rows from FP, m + 1
    each.
    """
    m = shape.monomials
    for q in range(0, LANES, 8):
        u_range, v_range = _project_means(w, s, rotation, offset, camera, q, shape)
        if rules.view_margin >= 0.0:
            _clamp_ratios(w, u_range, v_range, camera, rules.view_margin, m)
        _project_axes(w, s, rotation, offset, q, shape)
        _covariance(w, s, camera, rules.eps2d, q, m)
        _factor(w, m)
        if rules.antialiased:
            _compensate(w, s, q, m)
        _whiten(w, s, q, m)
