"""Two-sided linear bounds: the relaxation the paper takes from CROWN.

A quantity over ``p in [-1, 1]^d`` is enclosed by ``A_l p + b_l <= x(p) <= A_u p + b_u`` ("Abstract
Rendering", section 3.1, piecewise linear relation). Products are bounded by McCormick's planes

    x y >= w (y_l x + x_l y - x_l y_l) + (1 - w) (y_u x + x_u y - x_u y_u)
    x y <= w (y_u x + x_l y - x_l y_u) + (1 - w) (y_l x + x_u y - x_u y_l),    0 <= w <= 1,

with one weight ``w`` for all elements of a product; any weight is sound. Lines are forms of order 1
whose radius holds their own rounding.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ns_abstract.arithmetic.form_array import FormArray
from ns_abstract.arithmetic.forms import Basis, Float64Array
from ns_abstract.paper import lines
from ns_abstract.paper.affine import Enclosure
from ns_abstract.paper.interval import BoolArray, Interval


def _select(mask: BoolArray, form: FormArray, otherwise: Float64Array) -> FormArray:
    """``form`` where ``mask``, else numbers."""
    constant = FormArray.constant(form.basis, otherwise)
    return FormArray(form.basis, np.where(mask.ravel(), form.data, constant.data), form.shape)


#: Weights of McCormick's planes in the next products of two bounds; 1 where there are none left.
_WEIGHTS: list[float] = []


@contextmanager
def weighted(*weights: float) -> Iterator[None]:
    """Give the products of two `LinearBounds` made inside these weights, one after another."""
    _WEIGHTS[:] = weights
    try:
        yield
    finally:
        _WEIGHTS.clear()


def _next_weight(other: Any) -> float:
    return _WEIGHTS.pop(0) if _WEIGHTS and isinstance(other, LinearBounds) else 1.0


class LinearBounds:
    """An array of quantities between two lines each.

    Attributes:
        lower: Forms of order 1; the quantity is at least the form minus its radius.
        upper: Forms of order 1; the quantity is at most the form plus its radius.
    """

    __array_ufunc__ = None
    outranks_intervals = True

    def __init__(self, lower: FormArray, upper: FormArray) -> None:
        if lower.basis.order != 1 or upper.basis != lower.basis or upper.shape != lower.shape:
            raise ValueError("the two lines must be forms of order 1 of one shape over one box")
        self.lower = lower
        self.upper = upper

    @classmethod
    def of(cls, basis: Basis, values: Interval | ArrayLike) -> LinearBounds:
        """Quantities of which nothing but ``values`` is known."""
        values = Interval.lift(values)
        sides = []
        for end in values.bounds():
            finite = np.isfinite(end)
            sides.append(FormArray.constant(basis, np.where(finite, end, 0.0), np.where(finite, 0.0, np.inf)))
        return cls(*sides)

    @classmethod
    def parameters(cls, box: Interval) -> LinearBounds:
        """One parameter per element of ``box``, each running over its interval."""
        form = Enclosure.parameters(box).form
        return cls(form, form)

    @classmethod
    def stack(cls, parts: list[LinearBounds]) -> LinearBounds:
        """Bounds of one shape along a new first axis."""
        sides = []
        for side in ("lower", "upper"):
            forms = [getattr(part, side) for part in parts]
            data = np.stack([form.data for form in forms], axis=1).reshape(forms[0].basis.rows, -1)
            sides.append(FormArray(forms[0].basis, data, (len(parts), *parts[0].shape)))
        return cls(*sides)

    @property
    def basis(self) -> Basis:
        """Monomials of the lines."""
        return self.lower.basis

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self.lower.shape

    @property
    def range(self) -> Interval:
        """Bounds over the box."""
        with np.errstate(invalid="ignore"):
            low, high = self.lower.bounds()[0], self.upper.bounds()[1]
        # an overflow inside a line leaves an end that says nothing
        return Interval(np.where(low < np.inf, low, -np.inf), np.where(high > -np.inf, high, np.inf))

    def bounds(self) -> tuple[Float64Array, Float64Array]:
        """Lower and upper bounds over the box."""
        return self.range.bounds()

    def __getitem__(self, index: Any) -> LinearBounds:
        return LinearBounds(self.lower[index], self.upper[index])

    def reshape(self, *shape: int) -> LinearBounds:
        """The same quantities in another shape."""
        target = np.empty(self.shape).reshape(*shape).shape
        return LinearBounds(*(FormArray(self.basis, form.data, target) for form in (self.lower, self.upper)))

    def broadcast_to(self, shape: tuple[int, ...]) -> LinearBounds:
        """The quantities repeated to ``shape``."""
        return LinearBounds(self.lower.broadcast_to(shape), self.upper.broadcast_to(shape))

    def _lift(self, value: LinearBounds | Interval | ArrayLike) -> LinearBounds:
        return value if isinstance(value, LinearBounds) else LinearBounds.of(self.basis, value)

    def __neg__(self) -> LinearBounds:
        return LinearBounds(-self.upper, -self.lower)

    def __add__(self, other: LinearBounds | Interval | ArrayLike) -> LinearBounds:
        other = self._lift(other)
        return LinearBounds(self.lower + other.lower, self.upper + other.upper)

    __radd__ = __add__

    def __sub__(self, other: LinearBounds | Interval | ArrayLike) -> LinearBounds:
        return self + (-self._lift(other))

    def __rsub__(self, other: Interval | ArrayLike) -> LinearBounds:
        return (-self) + other

    def scale(self, factor: ArrayLike) -> LinearBounds:
        """The product with numbers of either sign."""
        factor = np.asarray(factor, np.float64)
        rising, falling = np.maximum(factor, 0.0), np.minimum(factor, 0.0)
        return LinearBounds(self.lower * rising + self.upper * falling, self.upper * rising + self.lower * falling)

    def multiply(self, other: LinearBounds | Interval | ArrayLike, weight: float = 1.0) -> LinearBounds:
        """The product, between McCormick's planes mixed by ``weight`` in [0, 1]."""
        if isinstance(other, Interval):
            other = self._lift(other)
        if not isinstance(other, LinearBounds):
            return self.scale(other)
        shape = np.broadcast_shapes(self.shape, other.shape)
        x, y = self.range.broadcast_to(shape), other.range.broadcast_to(shape)
        bounded = np.isfinite(x.magnitude) & np.isfinite(y.magnitude)
        if not np.all(bounded):
            # elements without planes are multiplied as zeros and widened afterwards
            zero, unknown = np.zeros(shape), np.where(bounded, 0.0, np.inf)
            products = [
                LinearBounds(*(_select(bounded, side.broadcast_to(shape), zero) for side in (v.lower, v.upper)))
                for v in (self, other)
            ]
            return products[0].multiply(products[1], weight) + Interval(-unknown, unknown)

        def plane(x_end: Float64Array, y_end: Float64Array) -> LinearBounds:
            # (x - x_end)(y - y_end) has a known sign when the ends are chosen so
            return self.scale(y_end) + other.scale(x_end) - Interval(x_end) * y_end

        first, second = plane(x.lower, y.lower).lower, plane(x.upper, y.upper).lower
        lower = first * weight + second * (1.0 - weight)
        first, second = plane(x.lower, y.upper).upper, plane(x.upper, y.lower).upper
        return LinearBounds(lower, first * weight + second * (1.0 - weight))

    def __mul__(self, other: LinearBounds | Interval | ArrayLike) -> LinearBounds:
        return self.multiply(other, _next_weight(other))

    __rmul__ = __mul__

    def sum(self, axis: int = -1) -> LinearBounds:
        """Sum along one axis."""
        axis %= len(self.shape)
        return LinearBounds(self.lower.sum(axis), self.upper.sum(axis))

    def matmul(self, other: LinearBounds | NDArray[Any], weight: float = 1.0) -> LinearBounds:
        """Product of two matrices."""
        n, k = self.shape
        m = other.shape[1]
        left = self.reshape(n, k, 1).broadcast_to((n, k, m))
        if isinstance(other, LinearBounds):
            return left.multiply(other.reshape(1, k, m).broadcast_to((n, k, m)), weight).sum(1)
        return left.scale(np.asarray(other, np.float64)[None]).sum(1)

    def __matmul__(self, other: LinearBounds | NDArray[Any]) -> LinearBounds:
        return self.matmul(other, _next_weight(other))

    def __rmatmul__(self, other: ArrayLike) -> LinearBounds:
        other = np.asarray(other, np.float64)
        n, k = other.shape
        m = self.shape[1]
        return self.reshape(1, k, m).broadcast_to((n, k, m)).scale(other[:, :, None]).sum(1)

    def _curve(self, curve: lines.ConvexFunction, domain: BoolArray) -> LinearBounds:
        """The chord on one side and the tangent at the middle of the range on the other."""
        x = self.range
        domain = domain & np.isfinite(x.lower) & np.isfinite(x.upper)
        inside = Interval(np.where(domain, x.lower, 1.0), np.where(domain, x.upper, 1.0))
        chord = lines.chord_slope(curve, inside)
        tangent = curve.slope(Interval(inside.middle)).middle
        # the chord of a convex function bounds it from above, its tangent from below
        chord_offset = lines.chord_side(curve, inside, chord)
        tangent_offset = lines.tangent_side(curve, inside, tangent, at=inside.middle)
        on_chord, on_tangent = self.scale(chord), self.scale(tangent)
        if curve.convex:
            lower, upper = on_tangent.lower + tangent_offset, on_chord.upper + chord_offset
        else:
            lower, upper = on_chord.lower + chord_offset, on_tangent.upper + tangent_offset
        unknown = np.where(domain, 0.0, np.inf).ravel()
        lower.data[lower.basis.monomials] += unknown
        upper.data[upper.basis.monomials] += unknown
        return LinearBounds(lower, upper)

    def reciprocal(self) -> LinearBounds:
        """``1 / x`` for ``x > 0``; nothing is known where ``x`` may not be positive."""
        return self._curve(lines.RECIPROCAL, self.range.lower > 0.0)

    def exp(self) -> LinearBounds:
        """``exp(x)``."""
        return self._curve(lines.EXP, np.abs(self.range.middle) < 600.0)


def sumcumprod_lines(alphas: LinearBounds, colors: Float64Array, behind: float = 0.0) -> LinearBounds:
    """SUMCUMPROD (Algorithm 5) as `sumcumprod` has it, between lines."""
    result = LinearBounds.of(alphas.basis, np.full(alphas.shape[1:], behind))
    for i in reversed(range(alphas.shape[0])):
        result = alphas[i].scale(colors[i]) + (1.0 - alphas[i]) * result
    return result
