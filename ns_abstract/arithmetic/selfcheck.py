"""Start-up check that this machine's elementary functions are as accurate as the bounds assume.

IEEE 754 fixes division and the square root; the logarithm and the trigonometric functions come from libraries that
differ between machines, and `exp_kernel` relies on a true fused multiply-add. `check_functions` compares them with
stored values, in a millisecond once the kernels are compiled.

The stored values (selfcheck.txt) were computed by python-flint's Arb: for each point x the two neighbouring float64
numbers (equal where the value is one) that enclose f(x). Points are next to zeros and at ends of ranges, and of some 9
000 random ones those whose value lies nearest to the middle of two float64 numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import numpy as np
from numba import njit

from ns_abstract.arithmetic.elementary import exp_kernel
from ns_abstract.arithmetic.forms import Float64Array
from ns_abstract.arithmetic.rounding import EXP_RELATIVE_ERROR, FUNCTION_ROUNDING, UNIT64

#: By function, under its name in brackets: lines of x, lower, upper.
_TABLES = Path(__file__).with_name("selfcheck.txt")
#: Assumed errors: (relative to the value, absolute), by function.
#: exp: `rounding.EXP_RELATIVE_ERROR`. log: `forms.logarithm` charges four units of ``|log x| + 1``. sqrt and
#: reciprocal: one rounding, as everywhere in `forms`. sin, cos: `trigonometry.cos_sin` charges four units.
ASSUMED_ERRORS = {
    "exp": (EXP_RELATIVE_ERROR, 0.0),
    "log": (FUNCTION_ROUNDING, FUNCTION_ROUNDING),
    "sqrt": (UNIT64, 0.0),
    "sin": (0.0, FUNCTION_ROUNDING),
    "cos": (0.0, FUNCTION_ROUNDING),
    "reciprocal": (UNIT64, 0.0),
}


@njit(cache=True, error_model="numpy")
def _exp(x, out):
    for i in range(x.size):
        out[i] = exp_kernel(x[i])


@njit(cache=True, error_model="numpy")
def _log(x, out):
    for i in range(x.size):
        out[i] = np.log(x[i])


@njit(cache=True, error_model="numpy")
def _sqrt(x, out):
    for i in range(x.size):
        out[i] = np.sqrt(x[i])


@njit(cache=True, error_model="numpy")
def _reciprocal(x, out):
    for i in range(x.size):
        out[i] = 1.0 / x[i]


def _sin(x: Float64Array, out: Float64Array) -> None:
    np.sin(x, out=out)


def _cos(x: Float64Array, out: Float64Array) -> None:
    np.cos(x, out=out)


#: What the bounds call: compiled code for the first four, numpy for the angles of a pose.
FUNCTIONS: dict[str, Callable[[Float64Array, Float64Array], None]] = {
    "exp": _exp,
    "log": _log,
    "sqrt": _sqrt,
    "sin": _sin,
    "cos": _cos,
    "reciprocal": _reciprocal,
}


def table(name: str) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return points of one function and the float64 neighbours of its values: x, lower, upper, each [n]."""
    numbers = _TABLES.read_text(encoding="ascii").partition(f"[{name}]\n")[2].partition("[")[0].split()
    x, lower, upper = (np.array([float.fromhex(token) for token in numbers[k::3]]) for k in range(3))
    return x, lower, upper


def check_functions(functions: Mapping[str, Callable[[Float64Array, Float64Array], None]] | None = None) -> list[str]:
    """Return a sentence for each of this machine's functions that is less accurate than the bounds assume.

    ``functions``: ``f(x, out)`` for arrays [n], by the names of `ASSUMED_ERRORS`; those the bounds use if None.
    """
    problems = []
    for name, function in (FUNCTIONS if functions is None else functions).items():
        x, lower, upper = table(name)
        computed = np.empty_like(x)
        function(x, computed)
        relative, absolute = ASSUMED_ERRORS[name]
        # no less than the error: the value lies between its neighbours
        error = np.maximum(np.abs(computed - lower), np.abs(computed - upper))
        allowed = relative * np.minimum(np.abs(lower), np.abs(upper)) + absolute
        if (relative, absolute) == (UNIT64, 0.0):
            # one rounding gives one of the neighbours
            bad = (computed != lower) & (computed != upper)
        else:
            bad = ~(error <= allowed)
        if bad.any():
            first = int(np.argmax(bad))
            at, value, low, high = (float(a[first]) for a in (x, computed, lower, upper))
            problems.append(
                f"{name}({at!r}) is {value!r}, the value lies in [{low!r}, {high!r}]: the error exceeds"
                f" the assumed {relative / UNIT64:g} relative and {absolute / UNIT64:g} absolute units"
            )
    return problems


@cache
def platform_problems() -> tuple[str, ...]:
    """Return one sentence for each fault of this process' arithmetic; with any fault, no result is guaranteed."""
    return tuple(check_functions())
