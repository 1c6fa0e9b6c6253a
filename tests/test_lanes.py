"""Explicit vectors and pointers: every lane is what the same operation on one float gives, bit for bit."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from ns_abstract.arithmetic.elementary import exp_kernel, fma
from ns_abstract.arithmetic.outward import outward
from ns_abstract.arithmetic.simd.intrinsics import offset_by, pointer, signed
from ns_abstract.arithmetic.simd.lanes import (
    LINE,
    bits,
    load4,
    load8,
    load_line,
    maximum,
    minimum,
    muladd,
    root,
    scatter_columns,
    spans,
    store,
    store_columns,
    where,
)

SPECIAL = [0.0, -0.0, 1.0, -1.0, 1e-310, -1e308, np.inf, -np.inf, np.nan, 3.0, np.nextafter(1.0, 2.0), 1e-16]


def operands() -> tuple[np.ndarray, np.ndarray]:
    pairs = np.array(list(itertools.product(SPECIAL, SPECIAL)))
    rng = np.random.default_rng(5)
    random = rng.standard_normal((304, 2)) * 10.0 ** rng.uniform(-9, 9, (304, 2))
    both = np.concatenate([pairs, random])
    assert len(both) % 8 == 0
    return both[:, 0].copy(), both[:, 1].copy()


@njit(error_model="numpy")
def by_lanes(x_, y_, out_):
    x, y, out = pointer(x_), pointer(y_), pointer(out_)
    n = x_.size
    for q in range(0, n, 8):
        a, b = load8(x, q), load8(y, q)
        results = (
            a + b, a - b, a * b, a / b, -a, abs(a), maximum(a, b), minimum(a, b), root(abs(a)), where(a < b, a, b),
            where((a <= b) & (a >= -1.0), 2.0, b), where((a == b) | (a != 1.0), a, -3.0), maximum(0.0, a),
            minimum(b, 1.0), 2.0 * a, b - 1.0, 1.0 / b, where(a > b, 1.0, 0.0),
        )  # fmt: skip
        for k, result in enumerate(results):
            store(out, k * n + q, result)


@njit(error_model="numpy")
def one_by_one(x, y, out):
    for q in range(x.size):
        a, b = x[q], y[q]
        results = (
            a + b, a - b, a * b, a / b, -a, abs(a), max(a, b), min(a, b), np.sqrt(abs(a)), a if a < b else b,
            2.0 if a <= b and a >= -1.0 else b, a if a == b or a != 1.0 else -3.0, max(0.0, a),
            min(b, 1.0), 2.0 * a, b - 1.0, 1.0 / b, 1.0 if a > b else 0.0,
        )  # fmt: skip
        for k, result in enumerate(results):
            out[k, q] = result


def same(a: np.ndarray, b: np.ndarray) -> bool:
    """Equal bits, but for which number that is none."""
    return bool(np.all((a.view(np.int64) == b.view(np.int64)) | (np.isnan(a) & np.isnan(b))))


def test_operations() -> None:
    x, y = operands()
    lanes, single = np.empty((18, x.size)), np.empty((18, x.size))
    by_lanes(x, y, lanes)
    one_by_one(x, y, single)
    for k in range(18):
        assert same(lanes[k], single[k]), k


@njit(error_model="numpy")
def fused(x_, y_, z_, wide_, narrow):
    x, y, z, wide = pointer(x_), pointer(y_), pointer(z_), pointer(wide_)
    for q in range(0, x_.size, 8):
        store(wide, q, fma(load8(x, q), load8(y, q), load8(z, q)))
    for q in range(x_.size):
        narrow[q] = fma(x[q], y[q], z[q])


def test_fma_rounds_once() -> None:
    """Products that cancel against the third number leave what a second rounding would lose."""
    rng = np.random.default_rng(7)
    x, y = rng.uniform(0.5, 2.0, (2, 256))
    z = -(x * y)
    wide, narrow = np.empty(256), np.empty(256)
    fused(x, y, z, wide, narrow)
    exact = np.array([float(Fraction(a) * Fraction(b) + Fraction(c)) for a, b, c in zip(x, y, z, strict=True)])
    assert np.abs(exact).max() > 0.0
    assert same(wide, exact) and same(narrow, exact)


@njit(error_model="numpy")
def added(x_, y_, z_, lanes_, narrow):
    x, y, z, lanes = pointer(x_), pointer(y_), pointer(z_), pointer(lanes_)
    for q in range(0, x_.size, LINE // x_.itemsize):
        store(lanes, q, muladd(load_line(x, q), load_line(y, q), load_line(z, q)))
    for q in range(x_.size):
        narrow[q] = x[q] * y[q] + z[q]


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_lines_of_either_kind(kind: type) -> None:
    """Products that are added are rounded once or twice, lane by lane."""
    rng = np.random.default_rng(8)
    x, y, z = (rng.uniform(0.5, 2.0, 256).astype(kind) for _ in range(3))
    z[::2] = -(x[::2] * y[::2])
    lanes, twice = np.empty_like(x), np.empty_like(x)
    added(x, y, z, lanes, twice)
    once = np.array(
        [kind(Fraction(float(a)) * Fraction(float(b)) + Fraction(float(c))) for a, b, c in zip(x, y, z, strict=True)]
    )
    assert ((lanes == once) | (lanes == twice)).all()


@njit(error_model="numpy")
def single(x_, y_, out_):
    x, y, out = pointer(x_), pointer(y_), pointer(out_)
    for q in range(0, x_.size, 16):
        a, b = load_line(x, q), load_line(y, q)
        results = (a + b, a - b, a * b, a / b, abs(a), maximum(a, b), minimum(a, b), where(a < b, a, b), a * x[0])
        for k, result in enumerate(results):
            store(out, k * x_.size + q, result)


def test_single_precision() -> None:
    with np.errstate(all="ignore"):
        x, y = (side.astype(np.float32) for side in operands())
        found = np.empty((9, x.size), np.float32)
        single(x, y, found)
        chosen = np.where(y > x, y, x), np.where(y < x, y, x), np.where(x < y, x, y)
        for k, expected in enumerate((x + y, x - y, x * y, x / y, abs(x), *chosen, x * x[0])):
            assert np.array_equal(found[k], expected, equal_nan=True), k


@njit(error_model="numpy")
def exponentials(x_, wide_, narrow):
    x, wide = pointer(x_), pointer(wide_)
    for q in range(0, x_.size, 8):
        store(wide, q, exp_kernel(load8(x, q)))
    for q in range(x_.size):
        narrow[q] = exp_kernel(x[q])


def test_exponential_of_lanes() -> None:
    x = np.concatenate([np.linspace(-700.0, 700.0, 1000), [0.0, -0.0, 1e-300, -60.0, -745e-3, 2.0, -2.0, 0.5]])
    wide, narrow = np.empty_like(x), np.empty_like(x)
    exponentials(x, wide, narrow)
    assert same(wide, narrow)


@njit(error_model="numpy")
def moved(x_, out_, four_):
    x, out, four = pointer(x_), pointer(out_), pointer(four_)
    store_columns(
        out, 3, 10, (load8(x, 0), load8(x, 8), load8(x, 16), load8(x, 24), load8(x, 32), load8(x, 40), load8(x, 48),
        load8(x, 56)),
    )  # fmt: skip
    store(four, 1, load4(offset_by(x, 5), 2))
    return bits(load8(x, 0) < load8(x, 8)), bits(load4(x, 0) >= 0.0)


def test_memory() -> None:
    x = np.random.default_rng(3).standard_normal(64)
    out, four = np.full(90, 7.0), np.full(6, 7.0)
    eight, few = moved(x, out, four)
    rows = out[3:83].reshape(8, 10)
    np.testing.assert_array_equal(rows[:, :8], x.reshape(8, 8).T)
    # and nothing else
    np.testing.assert_array_equal(rows[:, 8:], 7.0)
    assert (out[:3] == 7.0).all() and (out[83:] == 7.0).all()
    np.testing.assert_array_equal(four, [7.0, *x[7:11], 7.0])
    assert eight == sum(1 << k for k in range(8) if x[k] < x[8 + k])
    assert few == sum(1 << k for k in range(4) if x[k] >= 0.0)


@njit(error_model="numpy")
def scattered(x_, places_, out_):
    x, places, out = pointer(x_), pointer(places_), pointer(out_)
    scatter_columns(
        out, places, 2, 10, 1, (load8(x, 0), load8(x, 8), load8(x, 16), load8(x, 24), load8(x, 32), load8(x, 40),
        load8(x, 48), load8(x, 56)),
    )  # fmt: skip


def test_scattered_columns() -> None:
    x = np.random.default_rng(4).standard_normal(64)
    places = np.array([-9, -9, 7, 0, 3, 9, 1, 8, 4, 4])
    x.reshape(8, 8)[:, 7] = x.reshape(8, 8)[:, 6]
    out = np.full((10, 10), 7.0)
    scattered(x, places, out.reshape(-1))
    expected = np.full((10, 10), 7.0)
    expected[places[2:], 1:9] = x.reshape(8, 8).T
    np.testing.assert_array_equal(out, expected)


def test_signed() -> None:
    assert njit(lambda: signed((2 << 63) - 1))() == -1


@njit(error_model="numpy")
def mixed(x_):
    x = pointer(x_)
    return load4(x, 0) + load8(x, 0)


@njit
def loaded(x):
    return bits(load8(x, 0) > 0.0)


@njit
def pointed(x):
    return pointer(x)[0]


@pytest.mark.parametrize(
    ("function", "argument"),
    [(mixed, np.zeros(8)), (loaded, np.zeros(8)), (pointed, np.zeros((4, 4))[:, 1:])],
    ids=["widths differ", "no pointer", "not contiguous"],
)
def test_refused(function: object, argument: np.ndarray) -> None:
    with pytest.raises((TypingError, TypeError)):
        function(argument)  # pyright: ignore[reportCallIssue]


@njit(error_model="numpy")
def spans_of(first_, last_, out):
    first, last = pointer(first_), pointer(last_)
    for k in range(out.size):
        out[k] = spans(load8(first, 8 * k), load8(last, 8 * k))


def test_spans() -> None:
    ends = np.concatenate(
        [np.arange(-1.0, 8.5, 0.5), np.nextafter(np.arange(8.0), 9.0), np.nextafter(np.arange(8.0), -9)]
    )
    pairs = np.array([(a, b) for a, b in itertools.product(ends, ends) if 0.0 <= a <= 8.0 and -1.0 <= b < 8.0])
    pairs = pairs[: len(pairs) // 8 * 8]
    found = np.empty(len(pairs) // 8, np.int64)
    spans_of(pairs[:, 0].copy(), pairs[:, 1].copy(), found)
    columns = np.arange(8.0)
    inside = (columns >= pairs[:, :1]) & (columns <= pairs[:, 1:])
    assert np.array_equal(
        found.view(np.uint8).reshape(-1, 8), np.packbits(inside, axis=1, bitorder="little").reshape(-1, 8)
    )


def test_outward_rounding_is_to_neighbours() -> None:
    rng = np.random.default_rng(0)
    tiny = np.array([0.0, -0.0, 1e-60, -1e-60, 1e-45, -1e-45, 1e300, -1e300, np.inf, -np.inf, np.nan, 1.0, -1.0])
    x = np.concatenate([rng.standard_normal(5000) * 10.0 ** rng.uniform(-50, 42, 5000), tiny])
    with np.errstate(over="ignore", under="ignore"):
        near = x.astype(np.float32)
        below = np.where(near > x, np.nextafter(near, np.float32(-np.inf)), near)
        above = np.where(near < x, np.nextafter(near, np.float32(np.inf)), near)
        lower, upper = outward(x, x)
    assert lower.dtype == upper.dtype == np.float32
    np.testing.assert_array_equal(lower, below)
    np.testing.assert_array_equal(upper, above)
