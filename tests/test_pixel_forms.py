"""Forms of single alphas and blends of several parameters against exact arithmetic (design.md, B3, B7, B10)."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from numba import njit

from ns_abstract.arithmetic.rounding import REAL, charges
from ns_abstract.arithmetic.simd.intrinsics import pointer
from ns_abstract.arithmetic.simd.lanes import load8, store
from ns_abstract.methods.splat.alphas import _Exponent, _fitted_exponential, _Limits
from ns_abstract.methods.splat.blend import blend_several
from ns_abstract.methods.splat.block import (
    ALPHA_HIGH,
    ALPHA_LOW,
    FORM,
    LISTED,
    Fragments,
    Palette,
    color_ends,
    color_size,
    fragment_width,
)
from ns_abstract.methods.splat.stage_data import FormShape


@njit(error_model="numpy")
def _fitted(exponent_, limits, charged, out_):
    exponent, out = pointer(exponent_), pointer(out_)
    zero = 0.0 * load8(exponent, 0)
    alpha = _fitted_exponential(
        _Exponent(
            load8(exponent, 0), load8(exponent, 8), load8(exponent, 16), zero, load8(exponent, 24), zero
        ),
        limits, charged,
    )  # fmt: skip
    store(out, 0, alpha.center)
    store(out, 8, alpha.radius)
    store(out, 16, alpha.weight)
    store(out, 24, alpha.curve)


@pytest.mark.parametrize("middle", [1.0, 2.0, 4.0])
def test_a_straight_exponent_is_fitted(middle):
    """exp of an exponent that is linear in one parameter: only the fit's remainder and rounding are left (B3)."""
    slopes = np.array([1e-3, 0.01, 0.1, 0.25, 0.4, 0.6, 0.8, 1.0]) * min(1.0, middle)
    exponent = np.stack([middle - slopes, middle + slopes, np.full(8, middle), slopes]).ravel()
    out = np.zeros(32)
    limits = _Limits(1.0, 1.0, 0.0, 60.0, 1e-12, 1e-12, 0.999, 1.0)
    _fitted(exponent, limits, charges(REAL), out)
    center, radius, weight, curve = out.reshape(4, 8)
    for lane, slope in enumerate(slopes):
        off = 0.0
        for p in np.linspace(-1.0, 1.0, 41):
            at = slope * p
            form = center[lane] + weight[lane] * at + curve[lane] * at * at
            off = max(off, abs(form - math.exp(-middle - at)))
        # what math.exp and the lines above round
        assert off <= radius[lane] + 1e-15
        # a jump at a threshold of 1e-12 is charged as well, and the rounding of exp
        assert radius[lane] <= 1.3 * off + 1e-11


@njit(error_model="numpy")
def _blended(values_, lists_, colors_, background_, shape, forms, count, t_, out_):
    values, lists, colors, background = pointer(values_), pointer(lists_), pointer(colors_), pointer(background_)
    nothing = pointer(out_)
    bends = shape.dimensions * (shape.dimensions + 1) // 2
    fragments = Fragments(values, fragment_width(shape), bends, lists, lists, 64, values)
    palette = Palette(colors, forms, background, background)
    radius, ends = blend_several(0, count, fragments, palette, values, pointer(t_), shape.monomials)
    store(nothing, 0, radius)
    store(nothing, 4, ends.low)
    store(nothing, 8, ends.high)


def _polynomial(coefficients, p, d):
    """Exact value at ``p`` of center, linear and quadratic coefficients in the order of the fragments' columns."""
    value = Fraction(coefficients[0])
    for k in range(d):
        value += Fraction(coefficients[1 + k]) * p[k]
    for number, (i, k) in enumerate(itertools.combinations_with_replacement(range(d), 2)):
        value += Fraction(coefficients[1 + d + number]) * p[i] * p[k]
    return value


@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
@pytest.mark.parametrize("d", [1, 2, 3, 6])
def test_blends_of_exact_alphas(d, moving):
    """Alphas that are polynomials, without radii: what is dropped of their products is charged, and hardly more."""
    generator = np.random.default_rng(10 * d + moving)
    shape = FormShape(d, 1, d + 1)
    count, width, forms = 4, int(fragment_width(shape)), d + 1 if moving else 1
    for size in (0.02, 0.3):
        values = np.zeros((count, width))
        colors = np.zeros((count, color_size(forms) // 4, 4))
        lists = np.zeros((count, LISTED), np.uint32)
        alphas = []
        for e in range(count):
            linear = generator.uniform(-1.0, 1.0, d) * size / d
            bend = generator.uniform(-1.0, 1.0, d * (d + 1) // 2) * size / d**2
            middle = generator.uniform(0.4, 0.6)
            spread = np.abs(linear).sum() + np.abs(bend).sum()
            values[e, FORM : FORM + d + 1] = [middle, *linear]
            values[e, FORM + d + 2 : FORM + d + 2 + bend.size] = bend
            values[e, ALPHA_LOW], values[e, ALPHA_HIGH] = max(0.0, middle - spread), min(1.0, middle + spread)
            alphas.append([middle, *linear, *bend])
            colors[e, 0, :3] = generator.random(3)
            if moving:
                colors[e, 1 : 1 + d, :3] = generator.uniform(-0.1, 0.1, (d, 3)) / d
            drift = np.abs(colors[e, 1:forms, :3]).sum(axis=0)
            ends = color_ends(forms) // 4
            colors[e, ends, :3], colors[e, ends + 1, :3] = colors[e, 0, :3] - drift, colors[e, 0, :3] + drift
            lists[e, :2] = e, e
        background = np.array([0.2, 0.9, 0.5, 0.0])
        t, out = np.zeros(4 * (3 * shape.monomials + 4 + d * (d + 1) // 2)), np.zeros(12)
        _blended(values.ravel(), lists.ravel(), colors.ravel(), background, shape, forms, count, t, out)
        linear, radius, low, high = t.reshape(-1, 4)[: d + 1], out[:4], out[4:8], out[8:12]
        least, most = [Fraction(10)] * 3, [Fraction(-10)] * 3
        places = [*generator.choice([-1.0, 1.0], (40, d)), *generator.uniform(-1.0, 1.0, (40, d)), np.zeros(d)]
        for place in places:
            p = [Fraction(x) for x in place]
            for channel in range(3):
                value = Fraction(background[channel])
                for e in reversed(range(count)):
                    color = Fraction(colors[e, 0, channel])
                    color += sum((Fraction(colors[e, r, channel]) * p[r - 1] for r in range(1, forms)), Fraction(0))
                    value += _polynomial(alphas[e], p, d) * (color - value)
                assert Fraction(low[channel]) - Fraction(1e-15) <= value <= Fraction(high[channel]) + Fraction(1e-15)
                form = Fraction(linear[0, channel])
                form += sum((Fraction(linear[1 + k, channel]) * p[k] for k in range(d)), Fraction(0))
                off = value - form
                assert abs(off) <= Fraction(radius[channel])
                least[channel], most[channel] = min(least[channel], off), max(most[channel], off)
        if size < 0.1:
            found = sum(float(most[channel] - least[channel]) for channel in range(3))
            assert 2.0 * radius[:3].sum() < (2.5 if d < 6 else 8.0) * found
