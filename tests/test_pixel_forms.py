"""Forms of single alphas and blends of several parameters against exact arithmetic (design.md, B3, B7, B10)."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from blends import blended
from numba import njit

from ns_abstract.arithmetic.rounding import REAL, charges
from ns_abstract.arithmetic.simd.intrinsics import offset_by, pointer
from ns_abstract.arithmetic.simd.lanes import load8, store
from ns_abstract.methods.splat.alpha_ranges import Exponent, Limits, cubic_exponential, fitted_exponential
from ns_abstract.methods.splat.alphas import _affine_forms, _exponent_of_several, _set_curvature
from ns_abstract.methods.splat.blend import flattened
from ns_abstract.methods.splat.pixel_block import (
    ALPHA_HIGH,
    ALPHA_LOW,
    BEND,
    BEND_SPREAD,
    FORM,
    LISTED,
    ThresholdCrossings,
    bends_of,
    color_ends,
    color_size,
    fragment_width,
)
from ns_abstract.methods.splat.projection_errors import FORMS, columns
from ns_abstract.methods.splat.stage_data import FormShape


@njit(error_model="numpy")
def _alpha(exponent_, limits, charged):
    exponent = pointer(exponent_)
    zero = 0.0 * load8(exponent, 0)
    return fitted_exponential(
        Exponent(
            load8(exponent, 0), load8(exponent, 8), load8(exponent, 16), zero, load8(exponent, 24),
            load8(exponent, 32), load8(exponent, 40),
        ),
        limits, charged,
    )  # fmt: skip


@njit(error_model="numpy")
def _fitted(exponent_, limits, charged, out_):
    out, alpha = pointer(out_), _alpha(exponent_, limits, charged)
    store(out, 0, alpha.center)
    store(out, 8, alpha.radius)
    store(out, 16, alpha.weight)
    store(out, 24, alpha.curve)


@pytest.mark.slow
@pytest.mark.parametrize("middle", [1.0, 2.0, 4.0])
def test_a_straight_exponent_is_fitted(middle):
    """exp of an exponent that is linear in one parameter: only the fit's remainder and rounding are left (B3)."""
    slopes = np.array([1e-3, 0.01, 0.1, 0.25, 0.4, 0.6, 0.8, 1.0]) * min(1.0, middle)
    straight = np.zeros(8)
    exponent = np.stack([middle - slopes, middle + slopes, np.full(8, middle), slopes, straight, straight]).ravel()
    out = np.zeros(32)
    limits = Limits(1.0, 1.0, 0.0, 60.0, 1e-12, 1e-12, 0.999, 1.0)
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


@pytest.mark.parametrize("distance", [0.3, 1.0, 2.5])
@pytest.mark.parametrize("toward", [0.0, 0.7, 1.0])
def test_a_bent_exponent_is_fitted(distance, toward):
    """exp of half a squared distance that moves ``toward`` the mean or past it: half of what is dropped is kept."""
    moved = np.array([1e-3, 0.01, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5]) * min(1.0, distance)
    # y = (distance + toward moved p, sqrt(1 - toward^2) moved p)
    slopes, bends = distance * toward * moved, 0.5 * moved * moved
    middle = 0.5 * distance * distance
    share = slopes**2 / (2.0 * distance**2 * bends)
    out = np.zeros(32)
    limits = Limits(1.0, 1.0, 0.0, 60.0, 1e-12, 1e-12, 0.9999999, 1.0)
    for turn in (bends, bends * (1.0 + 0.5 * share)):
        low = np.maximum(0.0, middle - slopes)
        exponent = np.stack([low, middle + slopes + bends, np.full(8, middle), slopes, bends, turn])
        _fitted(exponent.ravel(), limits, charges(REAL), out)
        center, radius, weight, curve = out.reshape(4, 8)
        for lane in range(8):
            off = 0.0
            for p in np.linspace(-1.0, 1.0, 81):
                linear, square = slopes[lane] * p, bends[lane] * p * p
                form = center[lane] + weight[lane] * (linear + square) + curve[lane] * linear * linear
                off = max(off, abs(form - math.exp(-middle - linear - square)))
            assert off <= radius[lane] + 1e-15, (turn[lane], lane)
            if toward == 1.0 and turn is not bends and weight[lane] != 0.0:
                # moving along its own offset
                assert radius[lane] <= 3.0 * off + 1e-11


@njit(error_model="numpy")
def _cubic(exponent_, limits, charged, out_):
    exponent, out = pointer(exponent_), pointer(out_)
    alpha, tilt, bend = cubic_exponential(
        load8(exponent, 0), load8(exponent, 8), load8(exponent, 16), load8(exponent, 24), load8(exponent, 32),
        load8(exponent, 40), limits, charged,
    )  # fmt: skip
    store(out, 0, alpha.low)
    store(out, 8, alpha.high)
    store(out, 16, alpha.center)
    store(out, 24, tilt)
    store(out, 32, bend)
    store(out, 40, alpha.radius)


@pytest.mark.parametrize("off", [0.0, 0.01])
@pytest.mark.parametrize("bend", [-0.6, -0.2, 0.0, 0.2, 0.6, 1.2])
def test_an_exponent_of_one_parameter_is_fitted(bend, off):
    """exp of an exponent of order 2 that bends either way, and is ``off`` by a radius: held, hardly more (B3)."""
    middle, slopes = 3.0, np.array([0.0, 1e-3, 0.05, 0.1, 0.3, 0.6, 0.9, 1.2])
    grid = np.linspace(-1.0, 1.0, 201)
    exact = middle + slopes[:, None] * grid + bend * grid * grid
    radius = np.full(8, off)
    ones = np.ones(8)
    exponent = [exact.min(axis=1) - off, exact.max(axis=1) + off, middle * ones, radius, slopes, bend * ones]
    # the least and greatest on the grid are not those in between
    exponent[0] -= 1e-3
    exponent[1] += 1e-3
    out = np.zeros(48)
    limits = Limits(1.0, 1.0, 0.0, 60.0, 1e-12, 1e-12, 0.9999999, 1.0)
    _cubic(np.stack(exponent).ravel(), limits, charges(REAL), out)
    low, high, center, tilt, curve, radius = out.reshape(6, 8)
    form = center[:, None] + tilt[:, None] * grid + curve[:, None] * grid * grid
    found, size = np.zeros(8), np.exp(-exact.min(axis=1))
    for shift in (-off, 0.0, off):
        alpha = np.exp(-exact - shift)
        # what np.exp and the lines above round
        assert (np.abs(form - alpha) <= radius[:, None] + 1e-15).all()
        assert (low[:, None] <= alpha).all() and (alpha <= high[:, None]).all()
        found = np.maximum(found, np.abs(form - alpha).max(axis=1))
    # terms of the remainder seldom meet at their largest
    assert radius.sum() <= 1.6 * found.sum() + 0.003 * size.sum()


def test_the_fit_of_degree_three_holds_everywhere():
    """exp(-t) of straight exponents up to the widest that are fitted (B3)."""
    slopes = np.linspace(0.25, 1.999, 8)
    grid = np.linspace(-1.0, 1.0, 401)
    zero, out = np.zeros(8), np.zeros(48)
    exponent = np.stack([2.0 - slopes, 2.0 + slopes, np.full(8, 2.0), zero, slopes, zero])
    limits = Limits(1.0, 1.0, 0.0, 60.0, 1e-12, 1e-12, 2.0, 1.0)
    _cubic(exponent.ravel(), limits, charges(REAL), out)
    _, _, center, tilt, curve, radius = out.reshape(6, 8)
    assert (tilt[:-1] < 0.0).all()
    off = center[:, None] + tilt[:, None] * grid + curve[:, None] * grid * grid - np.exp(-2.0 - slopes[:, None] * grid)
    assert (np.abs(off) <= radius[:, None] + 1e-15).all()
    assert (radius <= 1.4 * np.abs(off).max(axis=1) + 1e-11).all()


@njit(error_model="numpy")
def _moved(record_, offsets_, rows_, limits, charged, m, out_):
    record, offsets, rows, out = pointer(record_), pointer(offsets_), pointer(rows_), pointer(out_)
    exponent = _exponent_of_several(
        record, _affine_forms(record, m, False), load8(offsets, 0), load8(offsets, 8), rows, 8 * 24, m, False
    )
    alpha = fitted_exponential(exponent, limits, charged)
    store(out, 0, alpha.center)
    store(out, 8, alpha.radius)
    store(out, 16, alpha.weight)
    store(out, 24, alpha.curve)


@pytest.mark.slow
@pytest.mark.parametrize("across", [0.0, 0.3, 1.0])
def test_what_moves_along_or_across_its_offset(across):
    """Of offsets that two parameters move, the curvature stands for no more of itself than it may (B3)."""
    m, moved = 3, 0.6
    record = np.zeros(int(columns(5, m)))
    record[FORMS], record[FORMS + 2 * (m + 1)] = 1.0, 1.0
    # the mean moves to the right with the first parameter, and up with the second
    record[FORMS + 3 * (m + 1) + 1], record[FORMS + 4 * (m + 1) + 2] = moved, across * moved
    offsets = np.array([[0.1, 0.5, 1.0, 1.5, 2.0, 1.0, 0.2, 0.7], [0.0, 0.1, 0.0, 0.5, 0.3, 1.0, 1.5, 0.7]])
    rows, out = np.zeros(8 * 64), np.zeros(32)
    limits = Limits(1.0, 1.0, 0.0, 60.0, 1e-12, 1e-12, 0.9999999, 1.0)
    _moved(record, offsets.ravel(), rows, limits, charges(REAL), m, out)
    center, radius, weight, curve = out.reshape(4, 8)
    slopes, bends = rows.reshape(-1, 8)[FORM + 1 : FORM + 3], rows.reshape(-1, 8)[FORM + m + 1 : FORM + m + 4]
    for lane in range(8):
        for p, q in itertools.product(np.linspace(-1.0, 1.0, 21), repeat=2):
            linear = slopes[0, lane] * p + slopes[1, lane] * q
            square = bends[0, lane] * p * p + bends[1, lane] * p * q + bends[2, lane] * q * q
            form = center[lane] + weight[lane] * (linear + square) + curve[lane] * linear * linear
            x, y = offsets[0, lane] - moved * p, offsets[1, lane] - across * moved * q
            assert abs(form - math.exp(-0.5 * (x * x + y * y))) <= radius[lane] + 1e-15, (lane, p, q)


@njit(error_model="numpy")
def _curved(exponent_, limits, charged, rows_, scratch, m):
    _set_curvature(_alpha(exponent_, limits, charged), pointer(rows_), scratch, m)


@pytest.mark.slow
@pytest.mark.parametrize("d", [1, 2, 3, 6])
def test_the_range_of_alpha_s_curvature(d):
    """What products of parameters add to alpha stays within its range, which is that of squares alone exactly (B10)."""
    generator = np.random.default_rng(d)
    m, bends = d + 1, d * (d + 1) // 2
    pairs = list(itertools.combinations_with_replacement(range(d), 2))
    for mixed in (0.0, 1.0):
        rows = np.zeros((FORM + m + 1 + bends + 2 * m, 8))
        rows[FORM + 1 : FORM + m] = generator.uniform(-0.2, 0.2, (d, 8)) * mixed
        for number, (i, k) in enumerate(pairs):
            rows[FORM + m + 1 + number] = generator.uniform(-0.3, 0.3, 8) * (1.0 if i == k else mixed)
        slopes, sizes = np.abs(rows[FORM + 1 : FORM + m]).sum(axis=0), np.abs(rows[FORM + m + 1 :]).sum(axis=0)
        exponent = np.stack([1.0 - slopes, 1.0 + slopes + sizes, np.ones(8), slopes, sizes, 0.0 * sizes])
        limits = Limits(1.0, 1.0, 0.0, 60.0, 1e-12, 1e-12, 0.9999999, 1.0)
        flat = rows.ravel()
        _curved(exponent.ravel(), limits, charges(REAL), flat, 8 * (FORM + m + 1 + bends), m)
        found = flat.reshape(-1, 8)
        middle, spread = found[BEND], found[BEND_SPREAD]
        bend = found[FORM + m + 1 : FORM + m + 1 + bends]
        assert np.abs(bend).max() > 0.01
        least, most = np.zeros(8), np.zeros(8)
        corners = itertools.product([-1.0, 0.0, 1.0], repeat=d)
        for p in [*corners, *generator.uniform(-1.0, 1.0, (50, d))]:
            value = sum(bend[number] * p[i] * p[k] for number, (i, k) in enumerate(pairs))
            least, most = np.minimum(least, value), np.maximum(most, value)
        assert np.all(middle - spread <= least + 1e-15) and np.all(most <= middle + spread + 1e-15)
        if mixed == 0.0 or d == 1:
            assert np.allclose(middle - spread, least, atol=1e-15) and np.allclose(middle + spread, most, atol=1e-15)


@njit(error_model="numpy")
def _blended(values, lists, colors, background, shape, forms, count, t_, out_):
    nothing, t, m = pointer(out_), pointer(t_), shape.monomials
    # fragments are blended as they are, skipped or not
    unused = ThresholdCrossings(pointer(np.empty(1, np.int64)), t, t, 0)
    _, blend = blended(values, lists, colors, background, shape, forms, count, t, unused, False)
    radius, ends = blend.radius, blend.ends
    if shape.order == 1:
        radius = flattened(t, radius, offset_by(t, 4 * (m + bends_of(shape))), m)
    store(nothing, 0, radius)
    store(nothing, 4, ends.low)
    store(nothing, 8, ends.high)


@pytest.mark.slow
@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
@pytest.mark.parametrize("size, count, most", [(0.02, 4, 2.0), (0.3, 2, 1.6), (0.3, 24, 4.0)])
def test_blends_of_exact_quadratic_alphas(size, count, most, moving):
    """Alphas that are polynomials of one parameter: what products lose is charged, and hardly more (B7)."""
    generator = np.random.default_rng(count + moving)
    shape = FormShape(1, 2, 3)
    forms = 3 if moving else 1
    values, lists = np.zeros((count, int(fragment_width(shape)))), np.zeros((count, LISTED), np.uint32)
    colors = np.zeros((count, color_size(forms) // 4, 4))
    linear, bend = generator.uniform(-0.5, 0.5, (2, count)) * size
    middle, spread = generator.uniform(0.4, 0.6, count), np.abs(linear) + np.abs(bend)
    values[:, FORM : FORM + 3] = np.stack([middle, linear, bend], axis=1)
    values[:, ALPHA_LOW], values[:, ALPHA_HIGH] = middle - spread, middle + spread
    colors[:, 0, :3] = generator.random((count, 3))
    if moving:
        colors[:, 1:3, :3] = generator.uniform(-0.1, 0.1, (count, 2, 3))
    drift, ends = np.abs(colors[:, 1:forms, :3]).sum(axis=1), color_ends(forms) // 4
    colors[:, ends, :3], colors[:, ends + 1, :3] = colors[:, 0, :3] - drift, colors[:, 0, :3] + drift
    shades = np.zeros((count, 3, 3))
    shades[:, :forms] = colors[:, :forms, :3]
    lists[:, :2] = np.arange(count)[:, None]
    background = np.array([0.2, 0.9, 0.5, 0.0])
    t, out = np.zeros(12), np.zeros(12)
    _blended(values.ravel(), lists.ravel(), colors.ravel(), background, shape, forms, count, t, out)
    form, (radius, low, high) = t.reshape(3, 4), out.reshape(3, 4)
    found = np.zeros(3)
    for place in np.linspace(-1.0, 1.0, 65):
        p = [Fraction(place)]
        for channel in range(3):
            value = Fraction(background[channel])
            for e in reversed(range(count)):
                color = _polynomial(shades[e, :, channel], p, 1)
                value += _polynomial(values[e, FORM : FORM + 3], p, 1) * (color - value)
            off = abs(value - _polynomial(form[:, channel], p, 1))
            # the radius' own rounding is added by the caller
            assert off <= Fraction(radius[channel]) * Fraction(1 + 1e-12)
            assert Fraction(low[channel] - 1e-15) <= value <= Fraction(high[channel] + 1e-15)
            found[channel] = max(found[channel], float(off))
    assert radius[:3].sum() <= most * found.sum()


def _bend_range(bends, d):
    """Middle and half-width of the range of a quadratic part: `|p q|` is at most half of `p p + q q`."""
    own, shared = np.zeros(d), np.zeros(d)
    for bend, (i, k) in zip(bends, itertools.combinations_with_replacement(range(d), 2), strict=True):
        if i == k:
            own[i] = bend
        else:
            shared[[i, k]] += 0.5 * abs(bend)
    low, high = np.minimum(0.0, own - shared).sum(), np.maximum(0.0, own + shared).sum()
    return 0.5 * (low + high), 0.5 * (high - low)


def _polynomial(coefficients, p, d):
    """Exact value at ``p`` of center, linear and quadratic coefficients in the order of the fragments' columns."""
    value = Fraction(coefficients[0])
    for k in range(d):
        value += Fraction(coefficients[1 + k]) * p[k]
    for number, (i, k) in enumerate(itertools.combinations_with_replacement(range(d), 2)):
        value += Fraction(coefficients[1 + d + number]) * p[i] * p[k]
    return value


@pytest.mark.slow
@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
@pytest.mark.parametrize("d", [1, 2, 3, 6])
def test_blends_of_exact_alphas(d, moving):
    """Alphas that are polynomials, without radii: what is dropped of their products is charged, and hardly more."""
    generator = np.random.default_rng(10 * d + moving)
    shape = FormShape(d, 1, d + 1)
    width, forms = int(fragment_width(shape)), d + 1 if moving else 1
    for size, count in ((0.02, 4), (0.3, 4), (0.3, 24)):
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
            values[e, BEND], values[e, BEND_SPREAD] = _bend_range(bend, d)
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
        t, out = np.zeros(4 * (3 * shape.monomials + 5 + d * (d + 1) // 2)), np.zeros(12)
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


def _two_layers(front, behind, radius=0.0, bounds=None):
    """Polynomials and radii of two layers of two parameters and one channel; alphas are [6] coefficients."""
    d, m = 2, 3
    shape = FormShape(d, 1, m)
    width = int(fragment_width(shape))
    values, colors, lists = np.zeros((2, width)), np.zeros((2, color_size(1) // 4, 4)), np.zeros((2, LISTED), np.uint32)
    for e, alpha in enumerate((front, behind)):
        spread = np.abs(alpha[1:]).sum()
        values[e, FORM : FORM + m], values[e, FORM + m + 1 : FORM + m + 4] = alpha[:3], alpha[3:]
        values[e, FORM + m] = radius
        values[e, BEND], values[e, BEND_SPREAD] = _bend_range(alpha[3:], d)
        ends = (alpha[0] - spread, alpha[0] + spread) if bounds is None else bounds
        values[e, ALPHA_LOW], values[e, ALPHA_HIGH] = ends
        colors[e, :, 0] = 1.0 - e
        colors[e, 1, 0] = 0.0
        lists[e, :2] = e, e
    t, out = np.zeros(4 * (3 * m + 5 + 3)), np.zeros(12)
    background = np.array([0.5, 0.0, 0.0, 0.0])
    _blended(values.ravel(), lists.ravel(), colors.ravel(), background, shape, 1, 2, t, out)
    return t.reshape(-1, 4)[:m, 0], out[0], out[4], out[8]


@pytest.mark.slow
@pytest.mark.parametrize("straight", [0.0, 0.1])
def test_curvatures_of_two_layers(straight):
    """Whatever products of parameters two alphas bend by, also where they never bend together (B10)."""
    shapes = 0.05 * np.array([[2, 0, 0], [0, 2, 0], [0, 0, 2], [-2, 0, 0], [1, 2, 1], [1, -2, 1]])
    grid = list(itertools.product(np.linspace(-1.0, 1.0, 9), repeat=2))
    for first, second in itertools.product(shapes, repeat=2):
        front, behind = [0.5, straight, -straight, *first], [0.5, -straight, straight, *second]
        form, radius, low, high = _two_layers(np.array(front), np.array(behind))
        for p, q in grid:
            monomials = [1.0, p, q, p * p, p * q, q * q]
            over, under = np.dot(front, monomials), np.dot(behind, monomials)
            value = 0.5 + under * (0.0 - 0.5)
            value += over * (1.0 - value)
            assert abs(value - np.dot(form, monomials[:3])) <= radius + 1e-15, (first, second, p, q)
            assert low - 1e-15 <= value <= high + 1e-15


@pytest.mark.slow
def test_an_interval_replaces_a_form_that_says_less():
    """Bounds of alpha that are narrower than its form's radius: the pixel's radius is that of the interval (B7)."""
    alpha = np.array([0.5, 0.01, 0.02, 0.0, 0.0, 0.0])
    form, radius, low, high = _two_layers(alpha, alpha, 0.4, (0.45, 0.55))
    assert 2.0 * radius <= (high - low) * (1.0 + 1e-12)
    for over, under in itertools.product([0.45, 0.5, 0.55], repeat=2):
        value = 0.5 - 0.5 * under
        value += over * (1.0 - value)
        assert low - 1e-15 <= value <= high + 1e-15
        assert abs(value - form[0]) <= radius + 1e-15
