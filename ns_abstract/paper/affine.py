"""The affine version of the paper's rules: forms with their ranges, which narrow each other."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ns_abstract.arithmetic.form_array import FormArray
from ns_abstract.arithmetic.forms import Basis, Float64Array, set_norms
from ns_abstract.arithmetic.rounding import LARGEST_CUBED, SMALLEST_CUBED
from ns_abstract.paper import lines
from ns_abstract.paper.interval import BoolArray, Interval

# arguments of exp whose values are between them
_MODERATE = 100.0


def _as_range(form: FormArray) -> Interval:
    with np.errstate(invalid="ignore"):
        low, high = form.bounds()
    # an overflow inside a form leaves ends that say nothing
    unknown = (low == np.inf) | (high == -np.inf)
    return Interval(np.where(unknown, -np.inf, low), np.where(unknown, np.inf, high))


def form_of(basis: Basis, values: Interval) -> FormArray:
    """Return forms without polynomial part that enclose ``values``."""
    return FormArray.constant(basis, values.middle, values.radius)


def _merge(mask: BoolArray, first: FormArray, second: FormArray) -> FormArray:
    """Return ``first`` where ``mask``, else ``second``."""
    return FormArray(first.basis, np.where(mask.ravel(), first.data, second.data), first.shape)


class Enclosure:
    """An array of quantities over a box ``p in [-1, 1]^d``, as forms and as intervals at once.

    ``range``, never wider than the forms' bounds, holds them over the whole box; ``range_`` is what else is known.
    """

    __array_ufunc__ = None
    outranks_intervals = True

    def __init__(self, form: FormArray, range_: Interval | None = None) -> None:
        bounds = _as_range(form)
        self.range = bounds if range_ is None else bounds.intersect(range_)
        finite = np.isfinite(form.data).all(axis=0).reshape(form.shape)
        dominated = ~finite | ~(form.radius < self.range.radius)
        self.form = _merge(dominated, form_of(form.basis, self.range), form) if np.any(dominated) else form

    @classmethod
    def of(cls, basis: Basis, values: Interval | ArrayLike) -> Enclosure:
        """Return enclosures of ``values`` without a relation to parameters."""
        values = Interval.lift(values)
        return cls(form_of(basis, values), values)

    @classmethod
    def lift(cls, value: Enclosure | FormArray | Interval | ArrayLike, basis: Basis | None = None) -> Enclosure:
        """Return ``value`` as an enclosure; numbers and intervals need ``basis``. Raises TypeError without one."""
        if isinstance(value, Enclosure):
            return value
        if isinstance(value, FormArray):
            return cls(value)
        if basis is None:
            raise TypeError("numbers and intervals have no basis of their own: name one")
        return cls.of(basis, value)

    @classmethod
    def parameters(cls, box: Interval, order: int = 1) -> Enclosure:
        """Return one parameter per element of ``box``, each running over its interval."""
        count = int(np.prod(box.shape))
        basis = Basis(count, order)
        middle, radius = box.middle.ravel(), box.radius.ravel()
        form = FormArray.constant(basis, middle)
        form.data[1 + np.arange(count), np.arange(count)] = radius
        set_norms(form.data, basis.dimensions, basis.order, basis.monomials)
        return cls(FormArray(basis, form.data, box.shape), box)

    @classmethod
    def stack(cls, parts: list[Enclosure]) -> Enclosure:
        """Return enclosures of one shape along a new first axis."""
        rows = parts[0].form.basis.rows
        shape = (len(parts), *parts[0].shape)
        data = np.stack([part.form.data for part in parts], axis=1).reshape(rows, -1)
        return cls(FormArray(parts[0].form.basis, data, shape), Interval.stack([part.range for part in parts]))

    @property
    def basis(self) -> Basis:
        """Monomials of the forms."""
        return self.form.basis

    @property
    def shape(self) -> tuple[int, ...]:
        return self.form.shape

    def bounds(self) -> tuple[Float64Array, Float64Array]:
        """Lower and upper bounds over the box."""
        return self.range.bounds()

    def meet(self, other: Interval) -> Enclosure:
        """Return the same quantity intersected with ``other``."""
        return Enclosure(self.form, self.range.intersect(other))

    def __getitem__(self, index: Any) -> Enclosure:
        return Enclosure(self.form[index], self.range[index])

    def reshape(self, *shape: int) -> Enclosure:
        """Return the same quantities in another shape."""
        range_ = self.range.reshape(*shape)
        return Enclosure(FormArray(self.basis, self.form.data, range_.shape), range_)

    def broadcast_to(self, shape: tuple[int, ...]) -> Enclosure:
        """Return the quantities repeated to ``shape``."""
        return Enclosure(self.form.broadcast_to(shape), self.range.broadcast_to(shape))

    def transpose(self) -> Enclosure:
        return Enclosure(self.form.transpose(), self.range.transpose())

    def _lift(self, value: Enclosure | Interval | ArrayLike) -> Enclosure:
        return Enclosure.lift(value, self.basis)

    def __neg__(self) -> Enclosure:
        return Enclosure(-self.form, -self.range)

    def __add__(self, other: Enclosure | Interval | ArrayLike) -> Enclosure:
        other = self._lift(other)
        return Enclosure(self.form + other.form, self.range + other.range)

    __radd__ = __add__

    def __sub__(self, other: Enclosure | Interval | ArrayLike) -> Enclosure:
        other = self._lift(other)
        return Enclosure(self.form - other.form, self.range - other.range)

    def __rsub__(self, other: Interval | ArrayLike) -> Enclosure:
        return (-self) + other

    def __mul__(self, other: Enclosure | Interval | ArrayLike) -> Enclosure:
        if other is self:
            return self.square()
        other = self._lift(other)
        return Enclosure(self.form * other.form, self.range * other.range)

    __rmul__ = __mul__

    def __matmul__(self, other: Enclosure | Interval | ArrayLike) -> Enclosure:
        other = self._lift(other)
        (n, k), (_, m) = self.shape, other.shape
        return (self.reshape(n, k, 1).broadcast_to((n, k, m)) * other.reshape(1, k, m)).sum(1)

    def __rmatmul__(self, other: Interval | ArrayLike) -> Enclosure:
        return self._lift(other) @ self

    def sum(self, axis: int = -1) -> Enclosure:
        axis %= len(self.shape)
        if self.shape[axis] == 0:
            return Enclosure.of(self.basis, self.range.sum(axis))
        return Enclosure(self.form.sum(axis), self.range.sum(axis))

    def prod(self, axis: int = -1) -> Enclosure:
        """Return the product along one axis, front to back."""
        axis %= len(self.shape)
        whole = self.range.prod(axis)
        if self.shape[axis] == 0:
            return Enclosure.of(self.basis, whole)
        before = (slice(None),) * axis
        result = self[(*before, 0)]
        for i in range(1, self.shape[axis]):
            result = result * self[(*before, i)]
        return result.meet(whole)

    def square(self) -> Enclosure:
        """Return ``x * x``."""
        return Enclosure(self.form.square(), self.range.square())

    def power(self, exponent: int) -> Enclosure:
        whole = self.range.power(exponent)
        result = Enclosure.of(self.basis, np.ones(self.shape))
        base = self
        while exponent:
            if exponent & 1:
                result = result * base
            exponent >>= 1
            base = base.square() if exponent else base
        return result.meet(whole)

    def _curve(self, curve: lines.ConvexFunction, domain: BoolArray, taylor: FormArray | None) -> Enclosure:
        """Return a convex or concave function of this: a band, or the Taylor polynomial where that has less width."""
        whole = curve.value(self.range)
        domain = domain & np.isfinite(self.range.lower) & np.isfinite(self.range.upper)
        inside = Interval(np.where(domain, self.range.lower, 1.0), np.where(domain, self.range.upper, 1.0))
        slope, offset = lines.band(curve, inside)
        form = self.form * slope + form_of(self.basis, offset)
        if taylor is not None:
            # exp looks after its own argument
            safe = (
                domain
                if curve is lines.EXP
                else domain & (self.range.lower > SMALLEST_CUBED) & (self.range.upper < LARGEST_CUBED)
            )
            better = safe & np.isfinite(taylor.data).all(axis=0).reshape(self.shape) & (taylor.radius < form.radius)
            form = _merge(better, taylor, form)
        return Enclosure(_merge(domain, form, form_of(self.basis, whole)), whole)

    def exp(self) -> Enclosure:
        """Return ``exp(x)``."""
        finite = np.isfinite(self.range.upper) & (np.abs(self.range.middle) < 600.0)
        return self._curve(lines.EXP, finite, None if self.basis.order == 1 else self._exp_taylor())

    def _exp_taylor(self) -> FormArray:
        center, farthest = self.form.center, np.maximum(self.form.center, self.range.upper)
        moderate = (np.abs(center) < _MODERATE) & (farthest < _MODERATE)
        value = Interval(np.where(moderate, center, 0.0)).exp()
        f0 = value.middle
        # the third derivative over 6, between the centre and every value
        third = Interval(np.where(moderate, farthest, 0.0)).exp() / 6.0
        form = self.form.compose(f0, f0, 0.5 * f0, 0.5 * f0, np.where(moderate, third.upper, np.inf))
        # the kernel's error in exp(c) multiplies 1 + t + t^2 / 2, t = x - c
        t = Interval(np.where(moderate, (self.range - center).magnitude, 0.0))
        form.data[form.basis.monomials] += (Interval(value.width) * (1.0 + t + t.square()) * 2.0).upper.ravel()
        return form

    def reciprocal(self) -> Enclosure:
        """Return ``1 / x``; unbounded where ``x`` may be 0."""
        negative = self.range.upper < 0.0
        sign = np.where(negative, -1.0, 1.0)
        positive = Enclosure(self.form * sign, self.range * sign)
        taylor = positive.form.reciprocal() if self.basis.order == 2 else None
        result = positive._curve(lines.RECIPROCAL, positive.range.lower > 0.0, taylor)
        return Enclosure(result.form * sign, self.range.reciprocal())

    def __truediv__(self, other: Enclosure | Interval | ArrayLike) -> Enclosure:
        other = self._lift(other)
        return (self * other.reciprocal()).meet(self.range / other.range)

    def __rtruediv__(self, other: Interval | ArrayLike) -> Enclosure:
        return self._lift(other) / self

    def sqrt(self) -> Enclosure:
        """Return ``sqrt(x)``; unbounded where ``x`` may be negative."""
        taylor = self.form.sqrt() if self.basis.order == 2 else None
        return self._curve(lines.SQRT, (self.range.lower >= 0.0) & (self.range.upper > 0.0), taylor)

    def norm(self) -> Enclosure:
        """Return the Frobenius norm over all elements, a scalar."""
        return self.square().reshape(-1).sum(0).sqrt().meet(self.range.norm())

    def indicator(self) -> Enclosure:
        """Return 1 where ``x > 0``, else 0; both where undecided (no slope narrows the unit step's range)."""
        return Enclosure.of(self.basis, self.range.indicator())


#: Intervals, or forms with their ranges: a result of a rule has the face of its operands.
Face = TypeVar("Face", Interval, Enclosure)


def range_of(x: Interval | Enclosure) -> Interval:
    """Return the intervals that hold ``x``."""
    return x if isinstance(x, Interval) else x.range


def constant_like(like: Face, values: Interval) -> Face:
    """Return constants that enclose ``values``, in the arithmetic and basis of ``like``."""
    return type(like).lift(values) if isinstance(like, Interval) else type(like).of(like.basis, values)
