"""Spherical harmonics as forms over cells of any number of parameters, eight Gaussians at a time (design.md, C2)."""

from __future__ import annotations

from numba import njit

from ns_abstract.arithmetic.elementary import fma
from ns_abstract.arithmetic.rounding import SUM_ROUNDING, UP
from ns_abstract.arithmetic.simd.lanes import load8, store
from ns_abstract.arithmetic.simd.wide_forms import (
    bounds,
    magnitude,
    multiply,
    reciprocal_square_root,
    scale_add,
    size,
    square,
)
from ns_abstract.methods.splat.projection_errors import LANES

# numbers of the forms in the workspace: directions, then unit ones and their products
(
    _DX, _DY, _DZ, _LENGTH, _SPARE, _INVERSE, _X, _Y, _Z, _Z2, _C1, _S1, _C2, _S2, _BASIS, _RED,
) = range(16)  # fmt: skip
WORKSPACE = 18


@njit(cache=True, error_model="numpy")
def form_colors(w, rows, low, sh, weights, indices, degree, m):
    """Add bands 1 to ``degree`` to the colours of eight Gaussians.

    Args:
        w: Scratch for `WORKSPACE` forms.
        rows: Rows [., LANES], flat, from the first of the eight lanes on: forms of m + 3 rows each. Forms 0 to 2 are
            the directions, not of unit length; forms 16 to 18 are the channels, which are added to, without rows of
            sums.
        low: Receives lower bounds of the squared lengths, from the first of the eight on.
        sh: [N, K, 3] coefficients; ``indices`` [8] the Gaussians' numbers.
        weights: [8] scratch.
    """
    one = size(m)
    for axis in range(3):
        for k in range(m + 3):
            store(w, axis * one + 8 * k, load8(rows, (axis * (m + 3) + k) * LANES))
    for channel in range(3):
        for k in range(m + 3):
            store(w, (_RED + channel) * one + 8 * k, load8(rows, ((16 + channel) * (m + 3) + k) * LANES))
    _directions(w, low, degree, m)
    for k in range(1, (degree + 1) * (degree + 1)):
        _basis(w, k, m)
        for channel in range(3):
            for q in range(8):
                weights[q] = sh[indices[q], k, channel]
            _accumulate(w, (_RED + channel) * one, _BASIS * one, load8(weights, 0), m)
    for channel in range(3):
        for k in range(m + 1):
            store(rows, ((16 + channel) * (m + 3) + k) * LANES, load8(w, (_RED + channel) * one + 8 * k))


@njit(cache=True, error_model="numpy", forceinline=True)
def _accumulate(w, target, form, weight, m):
    """Write ``target += weight * form``, without the rows of sums."""
    for k in range(m):
        store(w, target + 8 * k, fma(weight, load8(w, form + 8 * k), load8(w, target + 8 * k)))
    weight = abs(weight)
    added = weight * magnitude(w, form, m)
    rounding = SUM_ROUNDING * (2.0 * added + abs(load8(w, target)))
    radius = load8(w, target + 8 * m) + weight * load8(w, form + 8 * m) + rounding
    store(w, target + 8 * m, radius * UP)


@njit(cache=True, error_model="numpy")
def _directions(w, low, degree, m):
    """Compute unit directions and their products from the directions."""
    one = size(m)
    spare, length, inverse = _SPARE * one, _LENGTH * one, _INVERSE * one
    square(w, _DX * one, length, m)
    for axis in range(1, 3):
        square(w, axis * one, spare, m)
        scale_add(w, length, 1.0, spare, 1.0, 0.0, length, m)
    least, _ = bounds(w, length, m)
    store(low, 0, least)
    reciprocal_square_root(w, length, inverse, m)
    for axis in range(3):
        multiply(w, axis * one, inverse, (_X + axis) * one, m)
    x, y, c1, s1 = _X * one, _Y * one, _C1 * one, _S1 * one
    if degree >= 2:
        square(w, _Z * one, _Z2 * one, m)
        square(w, x, c1, m)
        square(w, y, spare, m)
        scale_add(w, c1, 1.0, spare, -1.0, 0.0, c1, m)
        multiply(w, x, y, spare, m)
        scale_add(w, spare, 2.0, spare, 0.0, 0.0, s1, m)
    if degree >= 3:
        c2, s2 = _C2 * one, _S2 * one
        multiply(w, x, c1, c2, m)
        multiply(w, y, s1, spare, m)
        scale_add(w, c2, 1.0, spare, -1.0, 0.0, c2, m)
        multiply(w, x, s1, s2, m)
        multiply(w, y, c1, spare, m)
        scale_add(w, s2, 1.0, spare, 1.0, 0.0, s2, m)


@njit(cache=True, error_model="numpy", forceinline=True)
def _scaled(w, a, s, shift, out, m):
    """Write ``out = s a + shift``."""
    scale_add(w, a, s, a, 0.0, shift, out, m)


@njit(cache=True, error_model="numpy")
def _basis(w, k, m):
    """Compute basis function ``k`` >= 1 from the products of `_directions`."""
    one = size(m)
    x, y, z, z2, spare, out = _X * one, _Y * one, _Z * one, _Z2 * one, _SPARE * one, _BASIS * one
    c1, s1, c2, s2 = _C1 * one, _S1 * one, _C2 * one, _S2 * one
    if k == 1:
        _scaled(w, y, -0.48860251190292, 0.0, out, m)
    elif k == 2:
        _scaled(w, z, 0.48860251190292, 0.0, out, m)
    elif k == 3:
        _scaled(w, x, -0.48860251190292, 0.0, out, m)
    elif k == 4:
        _scaled(w, s1, 0.5462742152960395, 0.0, out, m)
    elif k == 5 or k == 7:
        multiply(w, z, y if k == 5 else x, spare, m)
        _scaled(w, spare, -1.092548430592079, 0.0, out, m)
    elif k == 6:
        _scaled(w, z2, 0.9461746957575601, -0.3153915652525201, out, m)
    elif k == 8:
        _scaled(w, c1, 0.5462742152960395, 0.0, out, m)
    elif k == 9:
        _scaled(w, s2, -0.5900435899266435, 0.0, out, m)
    elif k == 10 or k == 14:
        multiply(w, z, s1 if k == 10 else c1, spare, m)
        _scaled(w, spare, 1.445305721320277, 0.0, out, m)
    elif k == 11 or k == 13:
        _scaled(w, z2, -2.285228997322329, 0.4570457994644658, spare, m)
        multiply(w, spare, y if k == 11 else x, out, m)
    elif k == 12:
        _scaled(w, z2, 1.865881662950577, -1.119528997770346, spare, m)
        multiply(w, z, spare, out, m)
    else:
        _scaled(w, c2, -0.5900435899266435, 0.0, out, m)
