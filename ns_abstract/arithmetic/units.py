"""Rounding units and the error constants that bounds are charged with.

This is the only place that knows how large a rounding error is.

A floating-point evaluation of ``x op y`` returns ``(x op y)(1 + d)``, ``|d| <= k u``, with
``u`` the unit of the format and ``k`` the error of the operation in units of ``u``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

#: Unit roundoff of IEEE binary64, round to nearest.
UNIT64 = 2.0**-53
#: Unit roundoff of IEEE binary32, round to nearest.
UNIT32 = 2.0**-24
#: Larger than any absolute error that gradual underflow adds to a short sum of products
#: in binary64 (one operation: 2**-1075).
UNDERFLOW64 = 2.0**-1060
#: Larger than any absolute error that flushing binary32 subnormals to zero (``-ftz=true``)
#: adds to a short sum of products (one operation: 2**-126).
UNDERFLOW32 = 2.0**-116


@dataclass(frozen=True)
class Arithmetic:
    """What the bounded program computes with.

    Every error is in units of ``unit``; the pair ``(unit, flush)`` says which floating-point
    evaluations of the gsplat formulas the bounds enclose. The real-number renderer and the
    package's own float64 evaluation are enclosed in both cases.

    Sources for the ``float32`` figures: CUDA C++ Programming Guide 12, "Mathematical Functions",
    tables of maximum ulp errors, with ``--use_fast_math`` (division 2 ulp, ``sqrt.approx`` 1 ulp on
    compute capability >= 5.2 and 3 ulp before, ``rsqrt`` 2 ulp, ``__expf(x)`` 2 + floor(|1.173 x|)
    ulp, ``expf`` 2 ulp under PyTorch's default flags). One ulp is at most 2 units.
    """

    name: Literal["float32", "real"]
    unit: float
    flush: float
    #: units of error of one operation
    division: float = 4.0
    sqrt: float = 6.0
    rsqrt: float = 4.0
    exp: float = 4.0
    fast_exp: float = 4.0
    #: products beyond this may overflow
    overflow: float = 2.0**1000
    fast_exp_per_unit_argument: float = 2.346


FLOAT32 = Arithmetic("float32", UNIT32, UNDERFLOW32, overflow=2.0**120)
REAL = Arithmetic("real", UNIT64, UNDERFLOW64)


def arithmetic(name: str) -> Arithmetic:
    """The arithmetic called ``name`` ("float32" or "real")."""
    return {"float32": FLOAT32, "real": REAL}[name]


def gamma(operations: int, unit: float = UNIT64) -> float:
    """Relative error of ``operations`` successive roundings, ``n u / (1 - n u)`` (Higham, Lemma 3.1)."""
    product = operations * unit
    if not product < 0.5:
        raise ValueError(f"{operations} roundings of unit {unit} leave no digit")
    return product / (1.0 - product) * (1.0 + 4.0 * UNIT64)
