"""Sets of pictures after rounding to 8 bits: what any program's rounding gives lies in them, and hardly more."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest

from ns_abstract.arithmetic.outward import outward
from ns_abstract.verify.eight_bit import rounded, rounded_sets

Program = Callable[[np.ndarray], np.ndarray]
_ONE = np.float32(1.0)
_LEVELS = np.float32(255.0)

#: Programs that write 8 bits, and what reads them: float32 throughout.
PROGRAMS: dict[str, Program] = {
    "nearest": rounded,
    "cut off": lambda x: np.floor(x * _LEVELS + np.float32(0.5)) / _LEVELS,
    "ties down": lambda x: np.ceil(x * _LEVELS - np.float32(0.5)) / _LEVELS,
    "times the inverse": lambda x: np.minimum(np.rint(x * _LEVELS) * (_ONE / _LEVELS), _ONE),
    "float64": lambda x: (np.rint(x.astype(np.float64) * 255.0) / 255.0).astype(np.float32),
}


def pictures() -> np.ndarray:
    """[n] float32 in [0, 1]: anywhere, at ties and their neighbours, at levels and the ends."""
    rng = np.random.default_rng(0)
    ties = ((np.arange(255) + 0.5) / 255.0).astype(np.float32)
    steps = [np.nextafter(ties, np.float32(k)) for k in (-1.0, 2.0)]
    further = [np.nextafter(step, np.float32(k)) for step, k in zip(steps, (-1.0, 2.0), strict=True)]
    levels = (np.arange(256) / 255.0).astype(np.float32)
    found = np.concatenate([rng.random(20000).astype(np.float32), ties, *steps, *further, levels])
    return np.clip(found, 0.0, 1.0)


def outside(sets: tuple, p: np.ndarray, y: np.ndarray) -> int:
    """Values [n] at parameters [n, d] that leave the interval or the linear sets, in exact arithmetic."""
    (a_lower, b_lower, a_upper, b_upper), lower, upper = sets
    count = int((~((lower <= y) & (y <= upper))).sum())
    for a, b, sign in ((a_lower, b_lower, 1), (a_upper, b_upper, -1)):
        # float64 decides but for near ties, which are looked at exactly
        value = (a.astype(np.float64) * p).sum(axis=-1) + b
        for k in np.flatnonzero(~(sign * (y - value) > 1e-12)):
            exact = sum(
                (Fraction(float(s)) * Fraction(float(q)) for s, q in zip(a[k], p[k], strict=True)),
                Fraction(float(b[k])),
            )
            count += sign * (Fraction(float(y[k])) - exact) < 0
    return count


@pytest.mark.parametrize("program", PROGRAMS.values(), ids=PROGRAMS)
@pytest.mark.parametrize("width", [0.0, 1e-7, 1e-3, 0.1])
def test_sets_hold_rounded_pictures(program: Program, width: float) -> None:
    x, rng = pictures(), np.random.default_rng(1)
    # sets about these values: x = slope . p + offset at some p, give or take
    slope = (width * rng.normal(size=(x.size, 2))).astype(np.float32)
    p = rng.uniform(-1.0, 1.0, (x.size, 2))
    offset = x - (slope * p).sum(axis=-1)
    reach = np.abs(slope).sum(axis=-1)
    a, b = width * rng.random(x.size), width * rng.random(x.size)
    b_lower, b_upper = outward(offset - a - 1e-15, offset + b + 1e-15)
    lower, upper = outward(np.clip(offset - reach - a, 0.0, x), np.clip(offset + reach + b, x, 1.0))
    sets = rounded_sets((slope, b_lower, slope, b_upper), lower, upper)
    assert outside(sets, p, program(x)) == 0
    (_, below, _, above), low, high = sets
    # no wider than half a step on each side, and no wider than the levels that are met
    assert (high - low <= upper - lower + 1.0 / 255.0 + 1e-6).all()
    assert (above - below <= b_upper - b_lower + 1.0 / 255.0 + 2e-6).all()
    if width == 0.0:
        clear = np.abs(255.0 * x - np.floor(255.0 * x) - 0.5) > 1e-3
        assert (high - low)[clear].max() < 1e-6 and (above - below)[clear].max() < 1e-6


def test_wrong_bounds_stay_wrong() -> None:
    """Rounding does not turn bounds that cross, or are no numbers, into good ones."""
    flat = np.zeros((2, 1), np.float32)
    lower, upper = np.array([0.5010, np.nan], np.float32), np.array([0.5009, 0.5], np.float32)
    (_, below, _, _), low, _ = rounded_sets((flat, lower, flat, upper), lower, upper)
    assert np.isnan(low).all() and np.isnan(below[1])
