"""Elementary functions, trigonometric forms and rounding constants against Arb."""

from __future__ import annotations

import math

import flint
import numpy as np
import pytest
from flint import arb, fmpq
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from oracle import escapes, inside, points, rational, value, weights

from ns_abstract.arithmetic.elementary import EXP_HIGHEST, EXP_LOWEST, exp_kernel
from ns_abstract.arithmetic.form_array import FormArray
from ns_abstract.arithmetic.forms import Basis, set_norms
from ns_abstract.arithmetic.rounding import EXP_RELATIVE_ERROR, FLOAT32, REAL, UNIT32, UNIT64, arithmetic, gamma
from ns_abstract.arithmetic.trigonometry import cos_sin


@njit(error_model="numpy")
def exponentials(x):
    out = np.empty_like(x)
    for i in range(x.size):
        out[i] = exp_kernel(x[i])
    return out


def worst_error(x: np.ndarray) -> float:
    """Largest relative error of the kernel, in units of 2^-53, rounded up."""
    y = exponentials(x)
    worst = 0.0
    with flint.ctx.workprec(128):
        for a, b in zip(x.tolist(), y.tolist(), strict=True):
            error = abs(arb(b) / arb(a).exp() - 1)
            worst = max(worst, float(error.upper()))
    return worst / UNIT64


def test_exp_random():
    generator = np.random.default_rng(1)
    x = np.concatenate(
        [
            generator.uniform(EXP_LOWEST, EXP_HIGHEST, 60_000),
            generator.uniform(-60.0, 0.0, 90_000),
            generator.uniform(-1.0, 1.0, 40_000),
            generator.uniform(-1.0, 1.0, 20_000) * 2.0 ** generator.integers(-60, 0, 20_000),
        ]
    )
    assert x.size >= 200_000
    assert worst_error(x) * UNIT64 <= EXP_RELATIVE_ERROR


def test_exp_hard():
    """Around the ends of the reduced range, where the quotient by ln 2 changes its rounding."""
    halves = np.arange(-2019, 2020) * (math.log(2.0) / 2.0)
    ends = np.array([EXP_LOWEST, EXP_HIGHEST, 0.0, -0.0, 5e-324, -5e-324, 2.0**-54, -(2.0**-54), 1.0, -1.0])
    x = np.concatenate([halves, np.nextafter(halves, np.inf), np.nextafter(halves, -np.inf), ends])
    x = x[(x >= EXP_LOWEST) & (x <= EXP_HIGHEST)]
    assert worst_error(x) * UNIT64 <= EXP_RELATIVE_ERROR
    assert exponentials(np.zeros(1))[0] == 1.0


def test_exp_is_sharp():
    """The error is far below the bound: a lost term of the series shows long before it is unsound."""
    x = np.random.default_rng(2).uniform(-20.0, 20.0, 20_000)
    assert worst_error(x) <= 4.0


@given(st.floats(EXP_LOWEST, EXP_HIGHEST))
@settings(max_examples=300, deadline=None)
def test_exp_any(x):
    assert worst_error(np.array([x])) * UNIT64 <= EXP_RELATIVE_ERROR


ANGLES = [
    (0.0, 0.0), (0.0, 1e-9), (0.1, 0.3), (1.5707963267948966, 0.2), (3.141592653589793, 0.5), (-2.0, 1.0),
    (0.0, math.pi), (3.0, math.pi), (1.0, 2 * math.pi), (0.5, 40.0), (1000.0, 0.0), (-1000.0, 0.7), (999.9, 3.0),
    (628.3185307179587, 1e-3), (1e-300, 1e-301), (12.566370614359172, 1.5),
]  # fmt: skip


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("noise", [0.0, 1e-12, 0.05])
def test_cos_sin(order, noise):
    basis = Basis(2, order)
    angle = FormArray.constant(basis, [middle for middle, _ in ANGLES], noise)
    angle.data[1] = [0.75 * half for _, half in ANGLES]
    angle.data[2] = [-0.25 * half for _, half in ANGLES]
    set_norms(angle.data, basis.dimensions, basis.order, basis.monomials)
    cosine, sine = cos_sin(angle)
    assert np.isfinite(cosine.radius).all() and np.isfinite(sine.radius).all()
    generator = np.random.default_rng(3)
    assert escapes(cosine, lambda x: arb(x).cos(), [angle], generator, 8) == []
    assert escapes(sine, lambda x: arb(x).sin(), [angle], generator, 8) == []


@pytest.mark.parametrize("order", [1, 2])
def test_cos_sin_dense(order):
    """Every position of a cell of width 0.8 on the circle: the extrema of both functions fall in all places."""
    basis = Basis(1, order)
    middles = np.linspace(-7.0, 7.0, 141)
    angle = FormArray.constant(basis, middles)
    angle.data[1] = 0.4
    set_norms(angle.data, 1, order, basis.monomials)
    forms = cos_sin(angle)
    for lane in range(middles.size):
        for numerator in range(-4, 5):
            point = [fmpq(numerator, 4)]
            x = value(angle, lane, point, fmpq(0))
            assert inside(forms[0], lane, point, lambda: arb(x).cos())  # noqa: B023
            assert inside(forms[1], lane, point, lambda: arb(x).sin())  # noqa: B023


def test_cos_sin_absolute_error():
    """The angle may be off by four units of |angle| + 1, as its docstring says."""
    basis = Basis(1, 1)
    for middle in (0.0, 1.0, -1.5707963267948966, 30.0, 1e3):
        angle = FormArray.parameter(basis, 0, middle, 0.1)
        cosine, sine = cos_sin(angle)
        error = rational(4.0 * UNIT64 * (abs(middle) + 1.0))
        for point in points(1, 5, np.random.default_rng(4)):
            for side in weights(2, np.random.default_rng(5)):
                x = value(angle, 0, point, fmpq(0)) + side * error
                assert inside(cosine, 0, point, lambda: arb(x).cos())  # noqa: B023
                assert inside(sine, 0, point, lambda: arb(x).sin())  # noqa: B023


def test_cos_sin_width():
    """Widths on a fixed set of angles: the recorded worst ratio to the sampled width."""
    for order, recorded in ((1, RECORDED_1), (2, RECORDED_2)):
        assert trigonometric_ratio(order) <= recorded * 1.001


RECORDED_1 = 1.0848
RECORDED_2 = 1.0074


def trigonometric_ratio(order: int) -> float:
    basis = Basis(1, order)
    angle = FormArray.constant(basis, np.linspace(0.3, 1.2, 10))
    angle.data[1] = 0.1
    set_norms(angle.data, 1, order, basis.monomials)
    worst = 0.0
    p = np.linspace(-1.0, 1.0, 2001)[:, None]
    for form, function in zip(cos_sin(angle), (np.cos, np.sin), strict=True):
        low, high = form.bounds()
        y = function(angle.data[0] + 0.1 * p)
        worst = max(worst, float(np.max((high - low) / (y.max(axis=0) - y.min(axis=0)))))
    return worst


def test_cos_sin_broken():
    """An angle that is not a number leaves nothing known."""
    angle = FormArray.constant(Basis(1, 1), np.array([np.nan, 1.0]), np.array([0.0, np.inf]))
    with np.errstate(invalid="ignore"):
        forms = cos_sin(angle)
    for form in forms:
        assert not np.isfinite(form.radius).any()


@given(st.integers(1, 10**6), st.sampled_from([UNIT32, UNIT64]))
@settings(max_examples=200, deadline=None)
def test_gamma(count, unit):
    """At least ``n u / (1 - n u)``, and at most a few units more."""
    product = count * rational(unit)
    exact = product / (1 - product)
    assert exact <= rational(gamma(count, unit)) <= exact * (1 + 16 * rational(UNIT64))


def test_gamma_refuses():
    assert gamma(0) == 0.0
    for count, unit in ((2**52, UNIT64), (2**60, UNIT64), (2**23, UNIT32), (1, math.nan)):
        with pytest.raises(ValueError):
            gamma(count, unit)


def test_arithmetic_names():
    assert arithmetic("float32") is FLOAT32 and arithmetic("real") is REAL
    assert FLOAT32.unit == 2.0**-24 and REAL.unit == 2.0**-53
    with pytest.raises(KeyError):
        arithmetic("float16")
