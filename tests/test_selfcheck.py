"""The start-up check: its table is right, it passes here, and it reports worse functions."""

from __future__ import annotations

import math

import flint
import numpy as np
import pytest
from flint import arb

from ns_abstract.arithmetic import selfcheck
from ns_abstract.arithmetic.rounding import UNIT64
from ns_abstract.arithmetic.selfcheck import ASSUMED_ERRORS, FUNCTIONS, check_functions, table

EXACT = {
    "exp": arb.exp,
    "log": arb.log,
    "sqrt": arb.sqrt,
    "sin": arb.sin,
    "cos": arb.cos,
    "reciprocal": lambda x: 1 / x,
}


def test_passes_here():
    assert check_functions() == []
    # every start pays for them: milliseconds
    assert sum(table(name)[0].size for name in FUNCTIONS) < 500


@pytest.mark.parametrize("name", EXACT)
def test_table(name):
    """Neighbouring float64 numbers around the value, at 3000 bits."""
    x, lower, upper = table(name)
    assert x.size >= 50 and np.unique(x).size == x.size
    with flint.ctx.workprec(3000):
        for point, low, high in zip(x.tolist(), lower.tolist(), upper.tolist(), strict=True):
            y = EXACT[name](arb(point))
            assert (y == arb(low) == arb(high)) if low == high else arb(low) < y < arb(high)
            assert high in (low, math.nextafter(low, math.inf))


def test_names():
    assert set(FUNCTIONS) == set(ASSUMED_ERRORS) == set(EXACT)


def off(name: str, units: float):
    """The function with an error of ``units`` more, relative where the assumption is relative."""

    original = FUNCTIONS[name]

    def function(x, out):
        original(x, out)
        relative, _ = ASSUMED_ERRORS[name]
        out += units * UNIT64 * (np.abs(out) if relative else 1.0)

    return function


@pytest.mark.parametrize(
    "name, units", [("exp", 9), ("log", 9), ("sqrt", 3), ("sin", 7), ("cos", 7), ("reciprocal", 3)]
)
def test_reports_worse(name, units, monkeypatch):
    for worse in (off(name, units), off(name, -units)):
        monkeypatch.setitem(selfcheck.FUNCTIONS, name, worse)
        (problem,) = check_functions()
        assert problem.startswith(f"{name}(")


def test_reports_nonsense():
    def broken(x, out):
        out[:] = math.nan

    def single(x, out):
        out[:] = np.cos(x.astype(np.float32))

    def flushed(x, out):
        np.sqrt(np.where(np.abs(x) < 2.3e-308, 0.0, x), out=out)

    for name, function in (("exp", broken), ("cos", single), ("sqrt", flushed)):
        with np.errstate(all="ignore"):
            assert len(check_functions({name: function})) == 1
