"""Cameras whose response is off (design.md, V14): contained exactly, tight, and noticed where a bound is wrong."""

from __future__ import annotations

import itertools
from fractions import Fraction
from typing import Any

import mpmath
import numpy as np
import pytest

from ns_abstract.verify.camera_response import CameraResponse, ResponseName

NAMES: tuple[ResponseName, ...] = ("brightness", "white balance", "gamma")


def linear_sets(width: float, seed: int) -> tuple[Any, np.ndarray, np.ndarray]:
    """Sets of 40 pixels over one parameter: float32 lines about a picture, and their range inside [0, 1]."""
    rng = np.random.default_rng(seed)
    middle = rng.choice([0.0, 1e-6, 0.2, 0.5, 0.9, 1.0], (40, 1, 3))
    slope = (width * rng.uniform(-1.0, 1.0, (40, 1, 3, 1))).astype(np.float32)
    room = 0.2 * width * rng.random((40, 1, 3))
    below, above = (middle - room).astype(np.float32), (middle + room).astype(np.float32)
    steep = np.abs(slope[..., 0])
    lower = np.clip(below - steep * 1.000001, 0.0, 1.0).astype(np.float32)
    upper = np.clip(above + steep * 1.000001, 0.0, 1.0).astype(np.float32)
    return (slope, below, slope, above), lower, upper


def exact(response: CameraResponse, x: Fraction, value: float) -> Any:
    """What a camera shows, in 200 bits."""
    number = mpmath.mpf(x.numerator) / x.denominator
    found = mpmath.power(number, mpmath.mpf(value)) if response.name == "gamma" else number * mpmath.mpf(value)
    return min(max(found, mpmath.mpf(0)), mpmath.mpf(1))


@pytest.mark.slow_cases(every=14)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("radius", [1e-9, 0.01, 0.3, 0.9])
@pytest.mark.parametrize("width", [0.0, 1e-3, 0.3])
def test_every_camera_is_contained(name: ResponseName, radius: float, width: float) -> None:
    response, rng = CameraResponse(name, radius), np.random.default_rng(2)
    linear, lower, upper = linear_sets(width, 1)
    (a, b, c, d), low, high = response.applied_to_sets(linear, lower, upper)
    compared = 0
    with mpmath.workprec(200):
        for pixel, channel in itertools.product(range(40), range(3)):
            for p in (-1.0, 0.25, 1.0):
                line = [Fraction(float(linear[k][pixel, 0, channel, 0])) * Fraction(p) for k in (0, 2)]
                ends = [line[k] + Fraction(float(linear[2 * k + 1][pixel, 0, channel])) for k in (0, 1)]
                ends[0] = max(ends[0], Fraction(float(lower[pixel, 0, channel])))
                ends[1] = min(ends[1], Fraction(float(upper[pixel, 0, channel])))
                # lines of a clipped picture may lie beside it: no such picture is meant
                if ends[0] > ends[1]:
                    continue
                compared += 1
                values = [1.0 - radius, 1.0 + radius, float(rng.uniform(1.0 - radius, 1.0 + radius))]
                for x, value in itertools.product(ends, values):
                    found = exact(response, x, value)
                    stored = response.applied(np.array([float(x)]), np.array(value))[0]
                    for seen in (found, mpmath.mpf(float(stored))):
                        assert low[pixel, 0, channel] <= seen <= high[pixel, 0, channel]
                        at = [mpmath.mpf(float(k[pixel, 0, channel, 0])) * p for k in (a, c)]
                        assert at[0] + mpmath.mpf(float(b[pixel, 0, channel])) <= seen
                        assert seen <= at[1] + mpmath.mpf(float(d[pixel, 0, channel]))
    assert compared > 200


@pytest.mark.parametrize("name", NAMES)
def test_sets_are_tight(name: ResponseName) -> None:
    """No wider than the cameras need, but for rounding."""
    response = CameraResponse(name, 0.1)
    x = np.full((40, 1, 3), 0.5, np.float32)
    still = np.zeros((*x.shape, 1), np.float32)
    (_, below, _, above), low, high = response.applied_to_sets((still, x, still, x), x, x)
    ends = [response.applied(x, np.full(3, value)) for value in (0.9, 1.1)]
    width = np.abs(ends[1] - ends[0])
    assert (high - low <= width * 1.0001).all() and (above - below <= width * 1.0001 + 1e-5).all()


def test_sets_that_cross_or_are_no_numbers_stay_so() -> None:
    response = CameraResponse("brightness", 0.1)
    still, x = np.zeros((1, 1, 3, 1), np.float32), np.full((1, 1, 3), 0.5, np.float32)
    _, low, _ = response.applied_to_sets((still, x, still, x), x + np.float32(0.1), x)
    assert np.isnan(low).all()
    _, low, _ = response.applied_to_sets((still, x, still, x), x * np.float32(np.nan), x)
    assert np.isnan(low).all()
