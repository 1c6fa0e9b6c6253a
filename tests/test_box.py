"""Boxes of parameters: samples, corners, and parts that cover exactly."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ns_abstract.geometry.box import ParameterBox

ends = st.floats(-1e6, 1e6)


@st.composite
def boxes(draw, least: int = 0, most: int = 6) -> ParameterBox:
    d = draw(st.integers(least, most))
    intervals = [sorted((draw(ends), draw(ends))) for _ in range(d)]
    return ParameterBox(
        tuple(f"p{k}" for k in range(d)), ("m",) * d, tuple(a for a, _ in intervals), tuple(b for _, b in intervals)
    )


@given(boxes(least=1), st.integers(0, 2**32 - 1))
@settings(max_examples=80, deadline=None)
def test_samples_and_corners(box, seed):
    generator = np.random.default_rng(seed)
    samples, corners = box.sample(7, generator), box.corners()
    assert samples.shape == (7, box.dimensions) and corners.shape == (2**box.dimensions, box.dimensions)
    assert all(box.contains(row) for row in [*samples, *corners, box.middle])
    for row in corners:
        assert all(x in pair for x, *pair in zip(row, box.lower, box.upper, strict=True))
    if box.dimensions and all(a < b for a, b in zip(box.lower, box.upper, strict=True)):
        assert len({tuple(row) for row in corners}) == 2**box.dimensions


def test_no_parameters():
    box = ParameterBox((), (), (), ())
    assert box.sample(3, np.random.default_rng(0)).shape == (3, 0) and box.contains(np.empty(0))


def test_corners_no_parameters():
    assert ParameterBox((), (), (), ()).corners().shape == (1, 0)


@given(boxes(least=1), st.integers(1, 9), st.data())
@settings(max_examples=80, deadline=None)
def test_split(box, parts, data):
    """The parts share their ends, so that no number of the box lies in none of them."""
    axis = data.draw(st.integers(0, box.dimensions - 1))
    cells = box.split(axis, parts)
    assert len(cells) == parts
    assert cells[0].lower[axis] == box.lower[axis] and cells[-1].upper[axis] == box.upper[axis]
    for cell, following in itertools.pairwise(cells):
        assert cell.upper[axis] == following.lower[axis]
    for cell in cells:
        assert cell.lower[axis] <= cell.upper[axis]
        assert cell.names == box.names and cell.units == box.units
        for other in range(box.dimensions):
            if other != axis:
                assert (cell.lower[other], cell.upper[other]) == (box.lower[other], box.upper[other])
    for row in box.sample(5, np.random.default_rng(0)):
        assert any(cell.contains(row) for cell in cells)


@given(boxes(least=1), st.integers(2, 9))
@settings(max_examples=40, deadline=None)
def test_split_evenly(box, parts):
    width = box.upper[0] - box.lower[0]
    for cell in box.split(0, parts):
        assert cell.upper[0] - cell.lower[0] <= width / parts + 4 * math.ulp(max(abs(box.lower[0]), abs(box.upper[0])))


@pytest.mark.parametrize("low", [0.0, 0.1, -1e-300, 1e300, 3.0])
def test_split_one_ulp(low):
    """An interval that holds no number inside still splits into parts that cover it."""
    high = math.nextafter(low, math.inf)
    cells = ParameterBox(("x",), ("m",), (low,), (high,)).split(0, 3)
    assert cells[0].lower == (low,) and cells[-1].upper == (high,)
    assert all(a.upper == b.lower for a, b in itertools.pairwise(cells))
    assert all(low <= cell.lower[0] <= cell.upper[0] <= high for cell in cells)


def test_at():
    box = ParameterBox(("x", "y"), ("m", "m"), (-1.0, 2.0), (3.0, 2.0))
    assert np.array_equal(box.at(np.array([[-1.0, -1.0], [1.0, 1.0], [0.0, 0.3]])), [[-1, 2], [3, 2], [1, 2]])
    assert np.array_equal(box.at(np.array([5.0, -5.0])), [3.0, 2.0])
    assert np.array_equal(box.middle, [1.0, 2.0])


@given(boxes(least=1), st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6))
@settings(max_examples=80, deadline=None)
def test_at_stays_inside(box, scaled):
    assert box.contains(box.at(np.array(scaled[: box.dimensions])))


def test_contains():
    box = ParameterBox(("x", "y"), ("m", "m"), (0.0, 0.0), (1.0, 1.0))
    assert box.contains(np.array([0.0, 1.0]))
    for outside in ([math.nextafter(1.0, 2.0), 0.5], [0.5, -5e-324], [math.nan, 0.5], [0.5, math.inf]):
        assert not box.contains(np.array(outside))


def test_replace():
    box = ParameterBox(("x", "y"), ("m", "rad"), (0.0, 0.0), (1.0, 1.0)).replace(1, -2.0, 5.0)
    assert box == ParameterBox(("x", "y"), ("m", "rad"), (0.0, -2.0), (1.0, 5.0))
