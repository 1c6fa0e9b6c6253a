"""Taylor models: quantities over a parameter box as polynomials of any total degree plus a radius.

A model over ``p in [-1, 1]^d`` encloses a function ``x`` as ``x(p) = sum_a c_a p^a + e(p)``, ``|a| <= degree``,
``|e(p)| <= r`` (design.md, F1), and charges its own float64 rounding to the radius. They describe poses; arrays are
small, so numpy does the work.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ns_abstract.arithmetic.forms import Float64Array
from ns_abstract.arithmetic.rounding import (
    ANGLE_ROUNDING,
    FACTORIAL_UP,
    LOWER_ROUNDING,
    REMAINDER_UP,
    TAYLOR_ROUNDING,
    TAYLOR_UP,
    UNDERFLOW64,
    UNIT64,
    taylor_product_rounding,
)


@dataclass(frozen=True)
class TaylorBasis:
    """The monomials of ``dimensions`` variables up to a total ``degree``, constants first."""

    dimensions: int
    degree: int

    @cached_property
    def exponents(self) -> tuple[tuple[int, ...], ...]:
        """Exponents of every monomial, by total degree."""
        exponents = itertools.product(range(self.degree + 1), repeat=self.dimensions)
        return tuple(sorted((e for e in exponents if sum(e) <= self.degree), key=lambda e: (sum(e), e)))

    @cached_property
    def products(self) -> dict[tuple[int, int], int | None]:
        """Index of the product's monomial by the indices of two monomials; None: it lies above the degree."""
        places = {e: i for i, e in enumerate(self.exponents)}
        return {
            (i, j): places.get(tuple(map(sum, zip(a, b, strict=True))))
            for (i, a), (j, b) in itertools.product(enumerate(self.exponents), repeat=2)
        }


class TaylorArray:
    """An array of Taylor models over one box: coefficients [monomials, *shape] and radius [*shape]."""

    #: numpy arrays on the left of an operator leave it to this class
    __array_ufunc__ = None

    def __init__(self, basis: TaylorBasis, coefficients: Float64Array, radius: Float64Array) -> None:
        self.basis, self.coefficients, self.radius = basis, coefficients, radius

    @classmethod
    def constant(cls, basis: TaylorBasis, values: Float64Array | float) -> TaylorArray:
        """Return the Taylor models of the numbers ``values``."""
        values = np.asarray(values, np.float64)
        coefficients = np.zeros((len(basis.exponents), *values.shape))
        coefficients[0] = values
        return cls(basis, coefficients, np.zeros(values.shape))

    @classmethod
    def parameter(cls, basis: TaylorBasis, index: int, middle: float = 0.0, half_width: float = 1.0) -> TaylorArray:
        """Return the scalar Taylor model ``middle + half_width * p_index``."""
        model = cls.constant(basis, middle)
        place = basis.exponents.index(tuple(int(k == index) for k in range(basis.dimensions)))
        model.coefficients[place] = half_width
        return model

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self.radius.shape

    @property
    def center(self) -> Float64Array:
        """Values at the middle of the box."""
        return self.coefficients[0]

    @property
    def size(self) -> Float64Array:
        """[*shape] bound of the polynomial's absolute value."""
        return np.abs(self.coefficients).sum(axis=0) * TAYLOR_UP

    def widened(self, radius: Float64Array | float) -> TaylorArray:
        """Return the same models with ``radius`` added to their radii."""
        return TaylorArray(self.basis, self.coefficients, (self.radius + radius) * TAYLOR_UP)

    def _lift(self, other: TaylorArray | Float64Array | float) -> TaylorArray:
        return other if isinstance(other, TaylorArray) else TaylorArray.constant(self.basis, other)

    def __neg__(self) -> TaylorArray:
        return TaylorArray(self.basis, -self.coefficients, self.radius)

    def __add__(self, other: TaylorArray | Float64Array | float) -> TaylorArray:
        a, b = self, self._lift(other)
        rank = max(len(a.shape), len(b.shape))
        parts = [x.coefficients.reshape(-1, *(1,) * (rank - len(x.shape)), *x.shape) for x in (a, b)]
        total = parts[0] + parts[1]
        radius = a.radius + b.radius + UNIT64 * np.abs(total).sum(axis=0) * TAYLOR_UP
        return TaylorArray(self.basis, total, radius * TAYLOR_UP + UNDERFLOW64)

    __radd__ = __add__

    def __sub__(self, other: TaylorArray | Float64Array | float) -> TaylorArray:
        return self + (-self._lift(other))

    def __rsub__(self, other: TaylorArray | Float64Array | float) -> TaylorArray:
        return (-self) + other

    def __mul__(self, other: TaylorArray | Float64Array | float) -> TaylorArray:
        a, b = self, self._lift(other)
        shape = np.broadcast_shapes(a.shape, b.shape)
        total = np.zeros((len(self.basis.exponents), *shape))
        dropped = np.zeros(shape)
        present = [[k for k, c in enumerate(x.coefficients) if c.any()] for x in (a, b)]
        for i, j in itertools.product(*present):
            product = a.coefficients[i] * b.coefficients[j]
            place = self.basis.products[i, j]
            if place is None:
                dropped += np.abs(product)
            else:
                total[place] += product
        # a coefficient is a sum of at most as many products as there are monomials
        rounding = taylor_product_rounding(len(self.basis.exponents)) * a.size * b.size
        radius = a.size * b.radius + b.size * a.radius + a.radius * b.radius + dropped + rounding
        return TaylorArray(self.basis, total, radius * TAYLOR_UP + UNDERFLOW64)

    __rmul__ = __mul__

    def __getitem__(self, index: Any) -> TaylorArray:
        index = index if isinstance(index, tuple) else (index,)
        return TaylorArray(self.basis, self.coefficients[(slice(None), *index)], self.radius[index])

    def sum(self, axis: int) -> TaylorArray:
        """Return the sum over one axis."""
        parts = [self[(slice(None),) * axis + (i,)] for i in range(self.shape[axis])]
        return sum(parts[1:], start=parts[0])

    def __matmul__(self, other: TaylorArray | Float64Array) -> TaylorArray:
        other = self._lift(other)
        if len(other.shape) == 1:
            return (self * other[None, :]).sum(1)
        return (self[:, :, None] * other[None, :, :]).sum(1)

    def __rmatmul__(self, other: Float64Array) -> TaylorArray:
        return self._lift(other) @ self

    def compose(self, derivatives: Sequence[Float64Array], last: Float64Array) -> TaylorArray:
        """Return ``f`` of the array by Taylor's formula about the centre.

        ``derivatives`` are ``f^(k)(centre) / k!`` for k up to the degree, each up to a relative rounding of 32 units;
        ``last`` is an upper bound of ``|f^(degree + 1)| / (degree + 1)!`` over the range.
        """
        step = self - self.center
        largest = (step.size + step.radius) * TAYLOR_UP
        total = TaylorArray.constant(self.basis, derivatives[-1])
        for value in reversed(derivatives[:-1]):
            total = total * step + value
        slack = sum(np.abs(v) * largest**k for k, v in enumerate(derivatives)) * TAYLOR_ROUNDING
        # powers of the largest take up to degree + 1 roundings
        return total.widened((slack + last * largest ** (self.basis.degree + 1)) * REMAINDER_UP)

    def rsqrt(self) -> TaylorArray:
        """Return ``1 / sqrt(x)``; not finite where ``x`` may be 0 or below."""
        n = self.basis.degree
        with np.errstate(all="ignore"):
            low = (self.center - (self.size - np.abs(self.center)) - self.radius) * (1.0 - LOWER_ROUNDING)
            low = low - LOWER_ROUNDING * np.abs(self.center)
            low = np.where(low > 0.0, low, np.nan)
            factors = [1.0]
            for k in range(n + 1):
                factors.append(factors[-1] * (-0.5 - k) / (k + 1))
            derivatives = [f * self.center ** (-0.5 - k) for k, f in enumerate(factors[:-1])]
            last = abs(factors[-1]) * low ** (-0.5 - (n + 1)) * REMAINDER_UP
            result = self.compose(derivatives, last)
        result.radius = np.where(np.isfinite(result.radius), result.radius, np.inf)
        return result


def taylor_cos_sin(angle: TaylorArray) -> tuple[TaylorArray, TaylorArray]:
    """Return the cosine and sine of an angle in radians; the libraries' functions are charged four units."""
    n = angle.basis.degree
    middle = angle.center
    cosine, sine = np.cos(middle), np.sin(middle)
    cycle = (cosine, -sine, -cosine, sine)
    last = np.full(angle.shape, 1.0 / math.factorial(n + 1) * FACTORIAL_UP)
    # an absolute error of the centre's function moves every derivative
    largest = np.minimum(angle.size - np.abs(middle) + angle.radius, 700.0)
    slack = ANGLE_ROUNDING * (np.abs(middle) + 2.0) * np.exp(largest)
    results = []
    for offset in (0, 3):
        derivatives = [cycle[(k + offset) % 4] / math.factorial(k) for k in range(n + 1)]
        results.append(angle.compose(derivatives, last).widened(slack))
    return results[0], results[1]
