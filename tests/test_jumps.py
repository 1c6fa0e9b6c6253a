"""Fragments that some poses skip, against exact arithmetic (design.md, B11, B13)."""

from __future__ import annotations

import itertools
from fractions import Fraction
from typing import NamedTuple

import numpy as np
import pytest
from blends import CAPACITY, blended
from numba import njit

from ns_abstract.arithmetic.rounding import SUB_BOX_OVERLAP
from ns_abstract.arithmetic.simd.intrinsics import offset_by, pointer
from ns_abstract.arithmetic.simd.lanes import load4, store
from ns_abstract.methods.splat.blend import flattened
from ns_abstract.methods.splat.form_sub_boxes import bound_sub_boxes
from ns_abstract.methods.splat.pixel_block import (
    ALPHA_HIGH,
    ALPHA_LOW,
    BEND,
    BEND_SPREAD,
    FORM,
    LISTED,
    PART_ENDS,
    ThresholdCrossings,
    bends_of,
    color_ends,
    color_size,
    crossing_column,
    crossing_rows,
    fragment_width,
)
from ns_abstract.methods.splat.stage_data import FormShape, Parts, cell_parts
from ns_abstract.methods.splat.threshold_crossings import bound_by_parts, gather_crossings, set_blend

THRESHOLD = 2.0**-8


@njit(error_model="numpy")
def _bounds(values, lists, colors, background, shape, count, limit, crossings_, t_, out_):
    """Three channels by parts into the first 8 of ``out_``, then by constants; last the number of crossings."""
    t, out = pointer(t_), pointer(out_)
    entries, distances, rows = crossings_
    crossings = ThresholdCrossings(pointer(entries), pointer(distances), pointer(rows), rows.shape[1])
    d, m = shape.dimensions, shape.monomials
    u = offset_by(t, 4 * (m + bends_of(shape)))
    fragments, blend = blended(values, lists, colors, background, shape, 1, count, t, crossings, True)
    up = 1.0 + 2.0**-40
    store(out, 0, blend.radius * up)
    set_blend(t, out, crossings, d)
    store(out, 20, blend.since)
    gather_crossings(0, count, blend.crossings, offset_by(out, 20), fragments, crossings, out, shape)
    falls, rises = load4(out, 0), load4(out, 4)
    r = blend.radius
    if shape.order == 1:
        r = flattened(t, r, u, m)
    reach = r * up
    for k in range(1, m):
        reach = reach + abs(load4(t, 4 * k))
    store(out, 8, load4(t, 0) - reach - falls)
    store(out, 12, load4(t, 0) + reach + rises)
    store(out, 0, falls)
    store(out, 4, rises)
    bound_by_parts(blend.crossings, limit, crossings, out, d)
    out[24] = blend.crossings


class _SubBoxInputs(NamedTuple):
    """What of `PixelInputs` sub-boxes need."""

    parts: Parts
    shape: FormShape


@njit(error_model="numpy")
def _by_sub_box(values, lists, colors, background, inputs, count, limit, crossings_, t_, out_, ends_):
    """Three channels over sub-boxes into ``ends_``, as `PixelBlock.part_ends` has them."""
    t, out, ends = pointer(t_), pointer(out_), pointer(ends_)
    entries, distances, rows = crossings_
    crossings = ThresholdCrossings(pointer(entries), pointer(distances), pointer(rows), rows.shape[1])
    fragments, blend = blended(values, lists, colors, background, inputs.shape, 1, count, t, crossings, True)
    store(out, 0, blend.radius * (1.0 + 2.0**-40))
    set_blend(t, out, crossings, inputs.shape.dimensions)
    store(out, 20, blend.since)
    gather_crossings(0, count, blend.crossings, offset_by(out, 20), fragments, crossings, out, inputs.shape)
    parts = inputs.parts
    given = Parts(pointer(parts.middles), pointer(parts.half), parts.slope, parts.levels, parts.motion, parts.side)
    bound_sub_boxes(blend.crossings, limit, out, crossings, _SubBoxInputs(given, inputs.shape), ends)
    return blend.crossings


def _fragments(shape, alphas, radii, colors):
    """Values, lists and colours of fragments whose alphas are polynomials, within ``radii`` of them."""
    d, m, count = shape.dimensions, shape.monomials, len(alphas)
    values = np.zeros((count, int(fragment_width(shape))))
    palette, lists = np.zeros((count, color_size(1) // 4, 4)), np.zeros((count, LISTED), np.uint32)
    ends = color_ends(1) // 4
    for e, (alpha, radius) in enumerate(zip(alphas, radii, strict=True)):
        spread = np.abs(alpha[1:]).sum() + radius
        low, high = max(0.0, alpha[0] - spread), min(1.0, alpha[0] + spread)
        skips = low < THRESHOLD
        crossing = min(THRESHOLD, high) if skips else 0.0
        values[e, int(crossing_column(shape))] = THRESHOLD if skips else 0.0
        values[e, ALPHA_LOW], values[e, ALPHA_HIGH] = 0.0 if skips else low, high
        values[e, FORM : FORM + 1 + d] = alpha[: 1 + d]
        values[e, FORM] -= 0.5 * crossing
        values[e, FORM + m] = (radius + 0.5 * crossing) * (1.0 + 2.0**-46)
        if shape.order == 2:
            values[e, FORM + 2] = alpha[2]
        else:
            values[e, FORM + m + 1 : FORM + m + 1 + alpha.size - 1 - d] = alpha[1 + d :]
            sizes = np.abs(alpha[1 + d :]).sum()
            values[e, BEND], values[e, BEND_SPREAD] = 0.0, sizes
        palette[e, 0, :3] = palette[e, ends, :3] = palette[e, ends + 1, :3] = colors[e]
        lists[e, :2] = e, e
    return values, palette, lists


def _monomials(place, d):
    return [
        Fraction(1),
        *place,
        *(place[i] * place[k] for i, k in itertools.combinations_with_replacement(range(d), 2)),
    ]


def _picture(alphas, errors, colors, background, place, d):
    """The exact blend at a place: what is below the threshold is skipped."""
    terms = _monomials([Fraction(float(x)) for x in place], d)
    shown = [Fraction(float(b)) for b in background]
    for alpha, error, color in reversed(list(zip(alphas, errors, colors, strict=True))):
        value = sum((Fraction(float(c)) * t for c, t in zip(alpha, terms, strict=True)), Fraction(float(error)))
        if value < Fraction(THRESHOLD):
            continue
        shown = [old + value * (Fraction(float(c)) - old) for c, old in zip(color, shown, strict=True)]
    return shown


def _case(d, count, generator, size=0.8, radius=0.0):
    """Alphas about the threshold, a few far above it, and colours."""
    pairs = d * (d + 1) // 2
    alphas, radii = [], np.full(count, radius * THRESHOLD)
    for e in range(count):
        if e % 5 == 4:
            middle, reach = generator.uniform(0.1, 0.3), 0.02
        else:
            middle, reach = generator.uniform(0.9, 1.6) * THRESHOLD, size * THRESHOLD
        linear = generator.uniform(-1.0, 1.0, d)
        linear *= reach / np.abs(linear).sum()
        bend = generator.uniform(-1.0, 1.0, pairs) * 0.05 * reach / pairs
        alphas.append(np.maximum(np.array([middle, *linear, *bend]), -1.0))
    return alphas, radii, generator.random((count, 3))


def _bounded(d, order, alphas, radii, colors, background):
    shape = FormShape(d, order, 3 if order == 2 else d + 1)
    values, palette, lists = _fragments(shape, alphas, radii, colors)
    crossings = np.zeros(CAPACITY, np.int64), np.zeros(8 * CAPACITY), np.zeros((int(crossing_rows(shape)), 272))
    t, out = np.zeros(4 * (3 * shape.monomials + 5 + d * (d + 1) // 2)), np.zeros(25)
    _bounds(
        values.ravel(), lists.ravel(), palette.ravel(), background, shape, len(alphas), THRESHOLD * (1.0 - 2.0**-52),
        crossings, t, out,
    )  # fmt: skip
    low, high = out[0:3], out[4:7]
    return low, high, out[8:11], out[12:15], int(out[24])


def _over_sub_boxes(counts, order, alphas, radii, colors, background, levels=()):
    """Lower and upper bounds [3, parts] over sub-boxes, and the parts."""
    d, number = len(counts), int(np.prod(counts))
    parts = cell_parts(np.array(counts), SUB_BOX_OVERLAP, levels)
    shape = FormShape(d, order, 3 if order == 2 else d + 1, 0, number)
    values, palette, lists = _fragments(shape, alphas, radii, colors)
    crossings = np.zeros(CAPACITY, np.int64), np.zeros(8 * CAPACITY), np.zeros((int(crossing_rows(shape)), 272))
    t, out = np.zeros(4 * (3 * shape.monomials + 5 + d * (d + 1) // 2)), np.zeros(25)
    ends = np.full(PART_ENDS + 6 * number, np.nan)
    _by_sub_box(
        values.ravel(), lists.ravel(), palette.ravel(), background, _SubBoxInputs(parts, shape), len(alphas),
        THRESHOLD * (1.0 - 2.0**-52), crossings, t, out, ends,
    )  # fmt: skip
    low, high = ends[PART_ENDS:].reshape(2, 3, number)
    return low, high, parts


@pytest.mark.slow_cases(every=3)
@pytest.mark.parametrize("radius", [0.0, 0.05])
@pytest.mark.parametrize("counts, order", [((2, 8, 2), 1), ((8,), 2), ((8,), 1), ((4, 2), 1), ((2, 1, 2, 1, 2, 1), 1)])
def test_sub_boxes_hold_their_own_pictures(counts, order, radius):
    """No pose of a sub-box is outside of its bounds, which say more than those of the cell (B13)."""
    d = len(counts)
    generator = np.random.default_rng(10 * d + order)
    shares = []
    for count in (1, 3, 12, 40):
        alphas, radii, colors = _case(d, count, generator, radius=radius)
        background = np.array([*generator.random(3), 0.0])
        low, high, parts = _over_sub_boxes(counts, order, alphas, radii, colors, background)
        whole_low, whole_high, flat_low, flat_high, _ = _bounded(d, order, alphas, radii, colors, background)
        exact = [[Fraction(float(x)) for x in side.ravel()] for side in (low, high)]
        for number in range(parts.middles.shape[1]):
            middle, half = parts.middles[:, number], parts.half
            places = [*generator.choice([-1.0, 1.0], (4, d)), *generator.uniform(-1.0, 1.0, (6, d))]
            for place in [np.clip(middle + half * p, -1.0, 1.0) for p in places]:
                errors = radii * generator.choice([-1.0, 0.0, 1.0], count)
                shown = _picture(alphas, errors, colors, background[:3], place, d)
                for channel in range(3):
                    at = channel * low.shape[1] + number
                    assert exact[0][at] <= shown[channel] <= exact[1][at], (count, number, place)
        whole = np.minimum(whole_high, flat_high) - np.maximum(whole_low, flat_low)
        shares.append(float(((high - low) / whole[:, None]).mean()))
    assert max(shares) < {1: 0.8, 2: 0.8, 3: 0.8, 6: 1.0}[d], shares


@pytest.mark.parametrize("counts, order", [((2, 4, 2), 1), ((8,), 2)])
def test_sub_boxes_are_refined_about_levels(counts, order):
    """Where a level lies between the simple ends they are those that are asked for everywhere; else these hold, too."""
    generator = np.random.default_rng(3)
    refined, simple = 0, 0
    for _ in range(6):
        case = (*_case(len(counts), 12, generator), np.array([*generator.random(3), 0.0]))
        low, high, _ = _over_sub_boxes(counts, order, *case)
        loose_low, loose_high, _ = _over_sub_boxes(counts, order, *case, (2.0,))
        levels = (float(np.sort(loose_low[0])[2]), float(np.sort(loose_high[2])[-3]))
        some_low, some_high, _ = _over_sub_boxes(counts, order, *case, levels)
        assert (loose_low <= some_low).all() and (some_low <= low).all()
        assert (high <= some_high).all() and (some_high <= loose_high).all()
        between = np.any([(loose_low <= level) & (level <= loose_high) for level in levels], axis=0).any(axis=0)
        np.testing.assert_array_equal(some_low, np.where(between, low, loose_low))
        np.testing.assert_array_equal(some_high, np.where(between, high, loose_high))
        refined, simple = refined + int(between.sum()), simple + int((~between).sum())
    assert refined > 0 < simple


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.0, 0.05])
@pytest.mark.parametrize("d, order", [(1, 2), (1, 1), (2, 1), (3, 1), (6, 1)])
def test_skipped_fragments(d, order, radius):
    """No pose is outside; bounds by parts say more than by constants (B11)."""
    generator = np.random.default_rng(10 * d + order)
    shares = []
    for count in (1, 3, 12, 40):
        alphas, radii, colors = _case(d, count, generator, radius=radius)
        background = np.array([*generator.random(3), 0.0])
        low, high, flat_low, flat_high, crossings = _bounded(d, order, alphas, radii, colors, background)
        assert crossings > 0
        least, most = np.full(3, np.inf), np.full(3, -np.inf)
        places = [*generator.choice([-1.0, 1.0], (40, d)), *generator.uniform(-1.0, 1.0, (100, d)), np.zeros(d)]
        for place in places:
            errors = radii * generator.choice([-1.0, 0.0, 1.0], count)
            shown = _picture(alphas, errors, colors, background[:3], place, d)
            for channel in range(3):
                value = shown[channel]
                assert Fraction(float(low[channel])) <= value <= Fraction(float(high[channel])), (count, place)
                assert Fraction(float(flat_low[channel])) <= value <= Fraction(float(flat_high[channel]))
            shown = np.array([float(x) for x in shown])
            least, most = np.minimum(least, shown), np.maximum(most, shown)
        low, high = np.maximum(low, flat_low), np.minimum(high, flat_high)
        if count > 3:
            excess = (high - low).sum() - (most - least).sum()
            shares.append(excess / ((flat_high - flat_low).sum() - (most - least).sum()))
    if radius == 0.0:
        assert max(shares) < {1: 0.35, 2: 0.6, 3: 0.75, 6: 0.9}[d], shares


@pytest.mark.parametrize("d, order", [(1, 2), (3, 1)])
def test_skipped_fragments_over_what_moves(d, order):
    """Fragments that are skipped in front of one that fades: what they take away is not the same everywhere."""
    generator = np.random.default_rng(d)
    for _ in range(20):
        # drawn but near the first corner, where what is behind differs most
        toward = generator.choice([-1.0, 1.0], d)
        pairs = np.zeros(d * (d + 1) // 2)
        front = np.array([1.5 * THRESHOLD, *(0.9 * THRESHOLD / d * toward), *pairs])
        behind = np.array([0.5, *(0.4 / d * -toward * generator.choice([-1.0, 1.0])), *pairs])
        colors, background = np.array([[0.5, 0.2, 0.9], [1.0, 0.0, 0.3]]), np.array([0.0, 1.0, 0.8, 0.0])
        low, high, flat_low, flat_high, crossings = _bounded(d, order, [front, behind], np.zeros(2), colors, background)
        assert crossings == 1
        for place in [*generator.choice([-1.0, 1.0], (30, d)), *generator.uniform(-1.0, 1.0, (30, d))]:
            shown = _picture([front, behind], [0.0, 0.0], colors, background[:3], place, d)
            for channel in range(3):
                assert Fraction(float(low[channel])) <= shown[channel] <= Fraction(float(high[channel])), place
                assert Fraction(float(flat_low[channel])) <= shown[channel] <= Fraction(float(flat_high[channel]))
