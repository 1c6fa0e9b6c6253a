"""High-precision oracle for the tests: exact rationals, and Arb balls where a function is not rational.

A float64 is a rational number, so the value of a polynomial form at a rational point of its box is
computed exactly. Other functions are evaluated by python-flint's Arb, whose balls contain the result;
a comparison answers only once the balls are apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import flint
import mpmath
import numpy as np
from flint import arb, fmpq

from ns_abstract.arithmetic.form_array import FormArray
from ns_abstract.arithmetic.forms import Basis, Float64Array, set_norms

BITS = 200
_MOST_BITS = 6400

Number = fmpq | arb


def rational(x: float) -> fmpq:
    """The finite float64 ``x``, exactly."""
    return fmpq(*float(x).as_integer_ratio())


def ball(x: Number) -> arb:
    """``x`` as an Arb ball at the current precision."""
    return arb(x) if isinstance(x, fmpq) else x


def big(x: float | fmpq) -> mpmath.mpf:
    """A float64 or rational as an mpmath number, rounded to mpmath's precision."""
    if isinstance(x, fmpq):
        return mpmath.mpf(int(x.p)) / int(x.q)
    return mpmath.mpf(float(x))


def rational_of(x: mpmath.mpf) -> fmpq:
    """An mpmath number, exactly."""
    sign, mantissa, exponent, _ = x._mpf_
    value = fmpq(int(mantissa)) * fmpq(2) ** int(exponent)
    return -value if sign else value


def polynomial(form: FormArray, lane: int, point: Sequence[fmpq]) -> fmpq:
    """Exact value of one form's polynomial at ``point`` of [-1, 1]^d."""
    column = form.data[:, lane]
    d = form.basis.dimensions
    total = rational(column[0])
    for k in range(d):
        total += rational(column[1 + k]) * point[k]
    for row, (k, l) in enumerate(form.basis.pairs):
        total += rational(column[1 + d + row]) * point[k] * point[l]
    return total


def radius(form: FormArray, lane: int) -> float:
    """The radius of one form."""
    return float(form.data[form.basis.monomials, lane])


def value(form: FormArray, lane: int, point: Sequence[fmpq], weight: fmpq) -> fmpq:
    """The number that the form stands for at ``point`` when its error term is ``weight`` * radius."""
    return polynomial(form, lane, point) + weight * rational(radius(form, lane))


def at_most(make: Callable[[], Number], limit: fmpq) -> bool:
    """Whether the number that ``make`` computes is at most ``limit``; raises the precision until it is decided."""
    bits = BITS
    while bits <= _MOST_BITS:
        with flint.ctx.workprec(bits):
            x = make()
            if isinstance(x, fmpq):
                return x <= limit
            if x <= arb(limit):
                return True
            if x > arb(limit):
                return False
        bits *= 2
    raise ArithmeticError("not decided: the two numbers may be equal")


def inside(form: FormArray, lane: int, point: Sequence[fmpq], make: Callable[[], Number]) -> bool:
    """Whether the form encloses, at ``point``, the number that ``make`` computes.

    A radius that is not finite claims nothing, so it encloses everything.
    """
    r = radius(form, lane)
    if not math.isfinite(r):
        return True
    middle, half = polynomial(form, lane, point), rational(r)
    return at_most(make, middle + half) and at_most(lambda: -make(), half - middle)


def between(low: float, high: float, make: Callable[[], Number]) -> bool:
    """Whether ``low <= make() <= high`` for float64 bounds; infinite bounds are passed."""
    below = low == -math.inf or at_most(lambda: -make(), -rational(low))
    return below and (high == math.inf or at_most(make, rational(high)))


def random_forms(
    basis: Basis,
    lanes: int,
    generator: np.random.Generator,
    *,
    center: float = 1.0,
    spread: float = 1.0,
    noise: float = 0.1,
    positive: bool = False,
) -> FormArray:
    """Forms with coefficients of all signs; some lanes have no polynomial part or no radius.

    Args:
        center, spread, noise: Sizes of the constant, of all other coefficients together, of the radius.
        positive: Keep every value above 0.
    """
    m = basis.monomials
    data = np.zeros((basis.rows, lanes))
    data[0] = generator.uniform(-1.0, 1.0, lanes) * center
    data[1:m] = generator.uniform(-1.0, 1.0, (m - 1, lanes)) * (spread / max(m - 1, 1))
    data[m] = generator.uniform(0.0, 1.0, lanes) * noise
    data[1:m, lanes // 4 : lanes // 3] = 0.0
    data[m, lanes // 3 : lanes // 2] = 0.0
    form = FormArray(basis, data, (lanes,))
    set_norms(data, basis.dimensions, basis.order, m)
    if positive:
        data[0] = np.abs(data[0]) + (data[m] + data[m + 1] + data[m + 2]) * (1.0 + generator.uniform(1e-6, 1.0, lanes))
    return form


def points(dimensions: int, count: int, generator: np.random.Generator) -> list[list[fmpq]]:
    """Points of [-1, 1]^d: the middle, corners, edges and random ones, as exact rationals."""
    rows = [np.zeros(dimensions), np.ones(dimensions), -np.ones(dimensions)]
    while len(rows) < count:
        row = generator.uniform(-1.0, 1.0, dimensions)
        ends = generator.random(dimensions) < 0.4
        rows.append(np.where(ends, np.sign(row), row))
    return [[rational(x) for x in row] for row in rows[:count]]


def weights(count: int, generator: np.random.Generator) -> list[fmpq]:
    """Positions in [-1, 1] of an error term, ends included."""
    return [rational(x) for x in [1.0, -1.0, *generator.uniform(-1.0, 1.0, max(count - 2, 0))]][:count]


def escapes(
    result: FormArray,
    exact: Callable[..., Number],
    operands: Sequence[FormArray],
    generator: np.random.Generator,
    count: int = 5,
) -> list[tuple[int, list[fmpq]]]:
    """Lanes and points where ``result`` does not enclose ``exact(*operands)`` for some admitted operand values."""
    found = []
    for lane in range(result.data.shape[1]):
        for point in points(result.basis.dimensions, count, generator):
            sides = [weights(3, generator) for _ in operands]
            for k in range(3):
                numbers = [value(form, lane, point, side[k]) for form, side in zip(operands, sides, strict=True)]
                if not inside(result, lane, point, lambda numbers=numbers: exact(*numbers)):
                    found.append((lane, point))
    return found


def sampled_range(form: FormArray, function: Callable[[Float64Array], Float64Array], count: int = 4001) -> tuple:
    """Float64 range of ``function`` over a one-parameter form, by sampling (for tightness only)."""
    p = np.linspace(-1.0, 1.0, count)[:, None]
    x = form.data[0] + form.data[1] * p
    if form.basis.order == 2:
        x = x + form.data[2] * p * p
    y = function(x)
    return y.min(axis=0), y.max(axis=0)
