"""Forms of eight quantities side by side: the rules of the array kernels, exactly enclosed and no looser."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from oracle import escapes, random_forms, rational
from test_forms import BINARY, POSITIVE, SIZES, layout

from ns_abstract.arithmetic.form_array import FormArray
from ns_abstract.arithmetic.forms import Basis, clamp_below, logarithm, negate, set_norms
from ns_abstract.arithmetic.simd import wide_forms
from ns_abstract.arithmetic.simd.intrinsics import pointer
from ns_abstract.arithmetic.simd.lanes import load8, store

BASES = [Basis(1, 1), Basis(2, 1), Basis(6, 1), Basis(8, 1)]
#: What is linear, and bounds, are there for order 2, too.
BOUNDED = [*BASES, Basis(1, 2), Basis(3, 2)]
_A, _B, _OUT = range(3)


@njit(error_model="numpy")
def _product(w, a, b, out, d, order, m):
    wide_forms.multiply(pointer(w), a, b, out, m)


@njit(error_model="numpy")
def _square(w, a, b, out, d, order, m):
    wide_forms.square(pointer(w), a, out, m)


@njit(error_model="numpy")
def _sum(w, a, b, out, d, order, m):
    wide_forms.scale_add(pointer(w), a, 0.1, b, -0.7, 0.3, out, m)


@njit(error_model="numpy")
def _sum_of_products(w, a, b, out, d, order, m):
    wide_forms.clear(pointer(w), out, m)
    wide_forms.add_product(pointer(w), a, b, 1.0, out, m)
    wide_forms.add_product(pointer(w), b, b, -1.0, out, m)
    wide_forms.add_square(pointer(w), a, out, m)
    wide_forms.set_norms(pointer(w), out, m)


@njit(error_model="numpy")
def _products(w, a, b, out, d, order, m):
    wide_forms.clear(pointer(w), out, m)
    wide_forms.add_product(pointer(w), a, b, 1.0, out, m)
    wide_forms.add_product(pointer(w), b, b, -1.0, out, m)
    wide_forms.set_norms(pointer(w), out, m)


@njit(error_model="numpy")
def _inverse(w, a, b, out, d, order, m):
    wide_forms.reciprocal(pointer(w), a, out, m)


@njit(error_model="numpy")
def _inverse_root(w, a, b, out, d, order, m):
    wide_forms.reciprocal_square_root(pointer(w), a, out, m)


@njit(error_model="numpy")
def _log(w, a, b, out, d, order, m):
    wide_forms.logarithm(pointer(w), a, out, m)


@njit(error_model="numpy")
def _clamped(w, a, b, out, d, order, m):
    f = pointer(w)
    low, high = wide_forms.bounds(f, a, m, order, d)
    for k in range(m + 3):
        store(f, out + 8 * k, load8(f, a + 8 * k))
    wide_forms.clamp(f, out, -0.25, 0.5, low, high, m)


@njit(error_model="numpy")
def _bounds(w, a, b, out, d, order, m):
    f = pointer(w)
    low, high = wide_forms.bounds(f, a, m, order, d)
    store(f, out, low)
    store(f, out + 8, high)


def apply(function, a: FormArray, b: FormArray | None = None) -> np.ndarray:
    """[rows, 8] that ``function`` writes."""
    basis = a.basis
    d, order, m = layout(basis)
    rows = m + 3
    # what stands in the result's place before must not matter
    w = np.full(4 * 8 * rows, np.nan)
    w[: 8 * rows] = a.data.ravel()
    w[8 * rows : 16 * rows] = (b or a).data.ravel()
    if order == 1:
        for form in (_A, _B):
            w[8 * rows * (form + 1) - 8 : 8 * rows * (form + 1)] = np.nan
    function(w, _A * 8 * rows, _B * 8 * rows, _OUT * 8 * rows, d, order, m)
    assert wide_forms.size(m) == 8 * rows
    return w[16 * rows : 24 * rows].reshape(rows, 8)


def result(function, a: FormArray, b: FormArray | None = None) -> FormArray:
    data = apply(function, a, b)
    kept = data[-2:].copy()
    found = FormArray(a.basis, data, (8,))
    set_norms(found.data, *layout(a.basis))
    if a.basis.order == 1:
        kept[1] = 0.0
    finite = np.isfinite(found.radius)
    # the rows of sums are bounds of what they sum, and no looser
    assert (kept[:, finite] >= found.data[-2:, finite] * (1.0 - 1e-13)).all()
    assert (kept[:, finite] <= found.data[-2:, finite] * (1.0 + 1e-10)).all()
    return found


def forms(seed: int, size: str, basis: Basis, **options) -> FormArray:
    return random_forms(basis, 8, np.random.default_rng([seed, len(size)]), **SIZES[size], **options)


def same(found: FormArray, kernel: FormArray) -> bool:
    """The same polynomial up to rounding, and a radius that is hardly larger."""
    m = found.basis.monomials
    scale = np.abs(kernel.data[:m]).sum(axis=0) + np.abs(kernel.radius)
    with np.errstate(invalid="ignore"):
        polynomial = np.abs(found.data[:m] - kernel.data[:m]) <= 64.0 * np.finfo(float).eps * scale + 1e-300
    finite = np.isfinite(kernel.radius)
    return bool(
        polynomial[:, finite].all()
        and (found.radius[finite] <= kernel.radius[finite] * (1.0 + 1e-10) + 4e-15 * scale[finite] + 1e-300).all()
        and np.array_equal(finite, np.isfinite(found.radius))
    )


PAIRS = {
    "multiply": (_product, *BINARY["mul"]),
    "scale_add": (
        _sum, lambda a, b: a * 0.1 - b * 0.7 + 0.3,
        lambda x, y: rational(0.1) * x + rational(-0.7) * y + rational(0.3),
    ),
    "square": (_square, lambda a, b: a.square(), lambda x, y: x * x),
    "sum of products": (
        _sum_of_products, lambda a, b: a * b - b * b + a.square(), lambda x, y: x * y - y * y + x * x,
    ),
    "products": (_products, lambda a, b: a * b - b * b, lambda x, y: x * y - y * y),
}  # fmt: skip
SINGLE = {
    "reciprocal": (_inverse, *POSITIVE["reciprocal"]),
    "rsqrt": (_inverse_root, *POSITIVE["rsqrt"]),
}


@pytest.mark.slow_cases(every=8)
@pytest.mark.parametrize("basis", BASES, ids=str)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", PAIRS)
def test_pairs(name, size, basis):
    a, b = forms(1, size, basis), forms(2, size, basis)
    function, kernel, exact = PAIRS[name]
    found = result(function, a, b)
    assert escapes(found, exact, [a, b], np.random.default_rng(3), 4) == []
    assert "products" in name or same(found, kernel(a, b))


@pytest.mark.parametrize("basis", BASES, ids=str)
@pytest.mark.parametrize("size", ["plain", "exact", "narrow", "constant", "uncertain"])
@pytest.mark.parametrize("name", SINGLE)
def test_functions(name, size, basis):
    a = forms(4, size, basis, positive=True)
    function, kernel, exact = SINGLE[name]
    found = result(function, a)
    assert np.isfinite(found.radius).all()
    assert escapes(found, exact, [a], np.random.default_rng(5), 4) == []
    assert same(found, kernel(a))


@pytest.mark.parametrize("basis", BASES, ids=str)
def test_logarithm_is_the_kernels(basis):
    for size in ("plain", "exact", "narrow", "constant", "uncertain"):
        a = forms(6, size, basis, positive=True)
        kernel = FormArray(basis, np.empty_like(a.data), (8,))
        logarithm(a.data, np.empty((5, 8)), kernel.data, *layout(basis))
        assert same(result(_log, a), kernel)


@pytest.mark.parametrize("name", SINGLE)
def test_domain(name):
    """A quantity that may be 0 or below has no bound; its neighbours keep theirs."""
    for basis in BASES:
        a = forms(7, "plain", basis, positive=True)
        a.data[0, 3] = 0.0
        a.data[0, 5] = np.nan
        found = apply(SINGLE[name][0], a)[basis.monomials]
        assert not np.isfinite(found[[3, 5]]).any()
        assert np.isfinite(np.delete(found, [3, 5])).all()


@pytest.mark.parametrize("basis", BOUNDED, ids=str)
def test_bounds_are_the_kernels(basis):
    for size in SIZES:
        a = forms(8, size, basis)
        low, high = a.bounds()
        found = apply(_bounds, a)
        scale = np.abs(a.data[: basis.monomials + 1]).sum(axis=0)
        np.testing.assert_array_less(np.abs(found[0] - low), 64.0 * np.finfo(float).eps * scale + 1e-300)
        np.testing.assert_array_less(np.abs(found[1] - high), 64.0 * np.finfo(float).eps * scale + 1e-300)


@pytest.mark.parametrize("basis", BASES, ids=str)
def test_clamp(basis):
    for seed, size in enumerate(SIZES):
        a = forms(20 + seed, size, basis)
        found = result(_clamped, a)

        def clamped(x):
            return min(max(x, rational(-0.25)), rational(0.5))

        assert escapes(found, clamped, [a], np.random.default_rng(9), 4) == []
        kernel = FormArray(basis, a.data.copy(), (8,))
        for sign, floor in ((1.0, -0.25), (-1.0, -0.5)):
            if sign < 0.0:
                negate(kernel.data, basis.monomials)
            low, high = a.bounds() if sign > 0.0 else tuple(-np.maximum(x, -0.25) for x in reversed(a.bounds()))
            clamp_below(kernel.data, floor, low, high, *layout(basis))
            if sign < 0.0:
                negate(kernel.data, basis.monomials)
        assert same(found, kernel)
