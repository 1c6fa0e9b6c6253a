"""Colours over cells of one parameter, as forms of order 2: the vector loops of `colors.moving_colors` (C2)."""

from __future__ import annotations

from numba import njit

from ns_abstract.arithmetic.line_forms import (
    LineForm,
    combined,
    ends,
    inverse_root,
    load,
    magnitude,
    multiplied,
    scaled,
    store,
)
from ns_abstract.arithmetic.rounding import SUM_ROUNDING, UP
from ns_abstract.methods.splat.projection_errors import LANES

# Slots of the scratch of `colors.moving_colors` in one row; a slot has 6 rows of lanes.
_X, _Y, _Z, _Z2, _C1, _S1, _C2, _S2, _BASIS, _SPARE, _RED = range(6 * 6 * LANES, 17 * 6 * LANES, 6 * LANES)
_SLOT = 6 * LANES


@njit(cache=True, error_model="numpy")
def directions_line(s, n, degree, low):
    """Compute unit directions and their products, as forms, from the vectors in slots 0 to 2 of the scratch ``s``.

    ``low``: lower bounds of the squared lengths.
    """
    for q in range(n):
        x, y, z = load(s, 0, LANES, q), load(s, _SLOT, LANES, q), load(s, 2 * _SLOT, LANES, q)
        length2 = combined(combined(multiplied(x, x), 1.0, multiplied(y, y), 1.0), 1.0, multiplied(z, z), 1.0)
        # by way of the scratch: stores to one array only are known not to overlap
        s[3 * _SLOT + q], _ = ends(length2)
        inverse = inverse_root(length2)
        x, y, z = multiplied(x, inverse), multiplied(y, inverse), multiplied(z, inverse)
        store(x, s, _X, LANES, q)
        store(y, s, _Y, LANES, q)
        store(z, s, _Z, LANES, q)
    for q in range(n):
        low[q] = s[3 * _SLOT + q]
    if degree >= 2:
        for q in range(n):
            x, y, z = load(s, _X, LANES, q), load(s, _Y, LANES, q), load(s, _Z, LANES, q)
            store(multiplied(z, z), s, _Z2, LANES, q)
            store(combined(multiplied(x, x), 1.0, multiplied(y, y), -1.0), s, _C1, LANES, q)
            store(scaled(multiplied(x, y), 2.0), s, _S1, LANES, q)
    if degree >= 3:
        for q in range(n):
            x, y = load(s, _X, LANES, q), load(s, _Y, LANES, q)
            c1, s1 = load(s, _C1, LANES, q), load(s, _S1, LANES, q)
            store(combined(multiplied(x, c1), 1.0, multiplied(y, s1), -1.0), s, _C2, LANES, q)
            store(combined(multiplied(x, s1), 1.0, multiplied(y, c1), 1.0), s, _S2, LANES, q)


@njit(cache=True, error_model="numpy", forceinline=True)
def _multiple(s, n, source, factor):
    for q in range(n):
        store(scaled(load(s, source, LANES, q), factor), s, _BASIS, LANES, q)


@njit(cache=True, error_model="numpy", forceinline=True)
def _product(s, n, left, right, factor):
    for q in range(n):
        product = multiplied(load(s, left, LANES, q), load(s, right, LANES, q))
        store(scaled(product, factor), s, _BASIS, LANES, q)


@njit(cache=True, error_model="numpy", forceinline=True)
def _shifted_square(s, n, left, factor, shift):
    """Return ``left (factor z^2 + shift)``."""
    for q in range(n):
        inner = combined(load(s, _Z2, LANES, q), factor, LineForm(shift, 0.0, 0.0, 0.0), 1.0)
        store(multiplied(load(s, left, LANES, q), inner), s, _BASIS, LANES, q)


@njit(cache=True, error_model="numpy")
def basis_line(s, n, k):
    """Compute basis function ``k`` >= 1 in its slot (`colors.sh_basis`)."""
    if k == 1:
        _multiple(s, n, _Y, -0.48860251190292)
    elif k == 2:
        _multiple(s, n, _Z, 0.48860251190292)
    elif k == 3:
        _multiple(s, n, _X, -0.48860251190292)
    elif k == 4:
        _multiple(s, n, _S1, 0.5462742152960395)
    elif k == 5:
        _product(s, n, _Z, _Y, -1.092548430592079)
    elif k == 6:
        for q in range(n):
            shift = LineForm(-0.3153915652525201, 0.0, 0.0, 0.0)
            store(combined(load(s, _Z2, LANES, q), 0.9461746957575601, shift, 1.0), s, _BASIS, LANES, q)
    elif k == 7:
        _product(s, n, _Z, _X, -1.092548430592079)
    elif k == 8:
        _multiple(s, n, _C1, 0.5462742152960395)
    elif k == 9:
        _multiple(s, n, _S2, -0.5900435899266435)
    elif k == 10:
        _product(s, n, _Z, _S1, 1.445305721320277)
    elif k == 11:
        _shifted_square(s, n, _Y, -2.285228997322329, 0.4570457994644658)
    elif k == 12:
        _shifted_square(s, n, _Z, 1.865881662950577, -1.119528997770346)
    elif k == 13:
        _shifted_square(s, n, _X, -2.285228997322329, 0.4570457994644658)
    elif k == 14:
        _product(s, n, _Z, _C1, 1.445305721320277)
    else:
        _multiple(s, n, _C2, -0.5900435899266435)


@njit(cache=True, error_model="numpy")
def accumulate_line(s, n, weights, channel):
    """Add ``weights[q]`` times the basis function to a channel (`colors._accumulate`)."""
    # where a loop writes has to be a constant: three loops
    if channel == 0:
        _accumulated(s, n, weights, _RED)
    elif channel == 1:
        _accumulated(s, n, weights, _RED + _SLOT)
    else:
        _accumulated(s, n, weights, _RED + 2 * _SLOT)


@njit(cache=True, error_model="numpy", forceinline=True)
def _accumulated(s, n, weights, target):
    for q in range(n):
        w = abs(weights[q])
        basis = load(s, _BASIS, LANES, q)
        sum_form = load(s, target, LANES, q)
        c = sum_form.center + weights[q] * basis.center
        g, b = sum_form.slope + weights[q] * basis.slope, sum_form.bend + weights[q] * basis.bend
        added = w * magnitude(basis)
        radius = (sum_form.radius + w * basis.radius + SUM_ROUNDING * (added + abs(c) + added)) * UP
        store(LineForm(c, g, b, radius), s, target, LANES, q)
