"""Interval arithmetic with outward rounding.

An `Interval` is an array of closed intervals of real numbers. Every operation returns an interval
that holds the exact result for all real operands: each end is computed in binary64 and moved one
number outward unless it is known to be exact (IEEE 1788-2015, 12.10.1, "accurate" mode). An
operation that is undefined somewhere on its operands returns ``[-inf, inf]``, never NaN.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from ns_abstract.arithmetic.elementary import EXP_HIGHEST, exp_kernel
from ns_abstract.arithmetic.rounding import EXP_DOWN, EXP_UP

Float64Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def round_down(values: ArrayLike) -> Float64Array:
    """Return the next smaller binary64 number."""
    with np.errstate(over="ignore", under="ignore"):
        return np.nextafter(values, -np.inf)


def round_up(values: ArrayLike) -> Float64Array:
    """Return the next larger binary64 number."""
    with np.errstate(over="ignore", under="ignore"):
        return np.nextafter(values, np.inf)


def _sum_ends(a: Float64Array, b: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return numbers just below and just above ``a + b`` (equal where the sum is exact; Knuth's TwoSum)."""
    with np.errstate(invalid="ignore", over="ignore"):
        total = a + b
        part = total - a
        error = (a - (total - part)) + (b - part)
    down = np.where(error >= 0.0, total, round_down(total))
    up = np.where(error <= 0.0, total, round_up(total))
    return down, up


def _product_ends(a: Float64Array, b: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return numbers just below and just above ``a * b``; zero times an unbounded end is zero."""
    with np.errstate(invalid="ignore", over="ignore", under="ignore"):
        product = a * b
    zero = (a == 0.0) | (b == 0.0)
    product = np.where(zero, 0.0, product)
    exact = zero | (np.abs(a) == 1.0) | (np.abs(b) == 1.0)
    return np.where(exact, product, round_down(product)), np.where(exact, product, round_up(product))


def _quotient_ends(a: Float64Array, b: Float64Array) -> tuple[Float64Array, Float64Array]:
    with np.errstate(invalid="ignore", over="ignore", under="ignore", divide="ignore"):
        quotient = a / b
    exact = (np.abs(b) == 1.0) | ((a == 0.0) & (b != 0.0))
    return np.where(exact, quotient, round_down(quotient)), np.where(exact, quotient, round_up(quotient))


@njit(cache=True, error_model="numpy")
def _exp_values(x, out):
    for q in range(x.size):
        out[q] = exp_kernel(x[q])


def _exp_ends(x: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return numbers below and above ``exp(x)``; beyond the kernel's domain as the square of ``exp(x / 2)``."""
    far = np.abs(x) > EXP_HIGHEST
    argument = np.clip(np.where(far, 0.5 * x, x), -EXP_HIGHEST, EXP_HIGHEST)
    value = np.empty(argument.size)
    _exp_values(np.ascontiguousarray(argument).ravel(), value)
    value = value.reshape(x.shape)
    down, up = value * EXP_DOWN, value * EXP_UP
    # exp(x) < exp(-1400) below the clip; the square of its bound is rounded up from 0
    with np.errstate(over="ignore", under="ignore"):
        down = np.where(far, np.maximum(round_down(down * down), 0.0), down)
        up = np.where(far, round_up(up * up), up)
    up = np.where(x > 2.0 * EXP_HIGHEST, np.inf, up)
    down = np.where(x < -2.0 * EXP_HIGHEST, 0.0, down)
    return np.where(x == 0.0, 1.0, down), np.where(x == 0.0, 1.0, up)


def _power_ends(x: Float64Array, exponent: int) -> tuple[Float64Array, Float64Array]:
    """Return numbers just below and just above ``x ** exponent``."""
    size = np.abs(x)
    down = up = np.ones(x.shape)
    for _ in range(exponent):
        down, up = np.maximum(_product_ends(down, size)[0], 0.0), _product_ends(up, size)[1]
    negative = (x < 0.0) & (exponent % 2 == 1)
    return np.where(negative, -up, down), np.where(negative, -down, up)


def _defers(operation: Callable[[Interval, Any], Interval]) -> Callable[[Interval, Any], Interval]:
    """Leave operands that carry more than a range to their own class."""

    @functools.wraps(operation)
    def wrapped(self: Interval, other: Any) -> Interval:
        return NotImplemented if getattr(other, "outranks_intervals", False) else operation(self, other)

    return wrapped


class Interval:
    """An array of closed intervals ``[lower, upper]``, float64, infinite where unbounded.

    Numbers and arrays of numbers mix with intervals by broadcasting and stand for themselves. An interval with an end
    that is not a number is taken as ``[-inf, inf]``.

    Raises:
        ValueError: An interval is empty: its ends are reversed, or it starts at ``inf`` or ends at ``-inf``.
    """

    __array_ufunc__ = None

    def __init__(self, lower: ArrayLike, upper: ArrayLike | None = None) -> None:
        low = np.asarray(lower, np.float64)
        high = low if upper is None else np.asarray(upper, np.float64)
        low, high = np.broadcast_arrays(low, high)
        unknown = np.isnan(low) | np.isnan(high)
        self.lower: Float64Array = np.where(unknown, -np.inf, low)
        self.upper: Float64Array = np.where(unknown, np.inf, high)
        if np.any((self.lower > self.upper) | (self.lower == np.inf) | (self.upper == -np.inf)):
            raise ValueError("an interval's lower end lies above its upper end, or both ends are infinite alike")

    @classmethod
    def lift(cls, value: Interval | ArrayLike) -> Interval:
        """Return ``value`` itself if it is an interval, else the degenerate interval."""
        return value if isinstance(value, Interval) else cls(value)

    @classmethod
    def entire(cls, shape: tuple[int, ...] = ()) -> Interval:
        """Return ``[-inf, inf]``."""
        return cls(np.full(shape, -np.inf), np.full(shape, np.inf))

    @classmethod
    def stack(cls, parts: list[Interval]) -> Interval:
        """Return intervals of one shape along a new first axis."""
        return cls(np.stack([part.lower for part in parts]), np.stack([part.upper for part in parts]))

    def __repr__(self) -> str:
        return f"Interval({self.lower!r}, {self.upper!r})"

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self.lower.shape

    @property
    def middle(self) -> Float64Array:
        """A number inside each interval, near its middle."""
        big = np.finfo(np.float64).max
        low, high = np.maximum(self.lower, -big), np.minimum(self.upper, big)
        return np.clip(0.5 * low + 0.5 * high, low, high)

    @property
    def width(self) -> Float64Array:
        """``upper - lower``, rounded up."""
        return _sum_ends(self.upper, -self.lower)[1]

    @property
    def magnitude(self) -> Float64Array:
        """Largest absolute value."""
        return np.maximum(np.abs(self.lower), np.abs(self.upper))

    @property
    def radius(self) -> Float64Array:
        """Distance from `middle` to the farther end, rounded up."""
        middle = self.middle
        return np.maximum(_sum_ends(self.upper, -middle)[1], _sum_ends(middle, -self.lower)[1])

    def bounds(self) -> tuple[Float64Array, Float64Array]:
        return self.lower, self.upper

    def contains(self, values: ArrayLike) -> bool:
        """Whether every interval holds its value."""
        values = np.asarray(values, np.float64)
        return bool(np.all((self.lower <= values) & (values <= self.upper)))

    def encloses(self, other: Interval) -> bool:
        """Whether every interval holds the other."""
        return bool(np.all((self.lower <= other.lower) & (other.upper <= self.upper)))

    def __getitem__(self, index: Any) -> Interval:
        return Interval(self.lower[index], self.upper[index])

    def _map(self, change: Callable[[Float64Array], Float64Array]) -> Interval:
        return Interval(change(self.lower), change(self.upper))

    def reshape(self, *shape: int) -> Interval:
        """Return the same intervals in another shape."""
        return self._map(lambda end: end.reshape(*shape))

    def broadcast_to(self, shape: tuple[int, ...]) -> Interval:
        return self._map(lambda end: np.broadcast_to(end, shape))

    def transpose(self) -> Interval:
        """Return the interval with the last two axes swapped."""
        return self._map(lambda end: np.swapaxes(end, -1, -2))

    def intersect(self, other: Interval | ArrayLike) -> Interval:
        """Return the common part. Raises ValueError where there is none somewhere."""
        other = Interval.lift(other)
        return Interval(np.maximum(self.lower, other.lower), np.minimum(self.upper, other.upper))

    def __neg__(self) -> Interval:
        return Interval(-self.upper, -self.lower)

    @_defers
    def __add__(self, other: Interval | ArrayLike) -> Interval:
        other = Interval.lift(other)
        return Interval(_sum_ends(self.lower, other.lower)[0], _sum_ends(self.upper, other.upper)[1])

    __radd__ = __add__

    @_defers
    def __sub__(self, other: Interval | ArrayLike) -> Interval:
        return self + (-Interval.lift(other))

    def __rsub__(self, other: ArrayLike) -> Interval:
        return (-self) + other

    @_defers
    def __mul__(self, other: Interval | ArrayLike) -> Interval:
        other = Interval.lift(other)
        ends = [_product_ends(a, b) for a in self.bounds() for b in other.bounds()]
        return Interval(np.minimum.reduce([low for low, _ in ends]), np.maximum.reduce([high for _, high in ends]))

    __rmul__ = __mul__

    def reciprocal(self) -> Interval:
        """Return ``1 / x``; unbounded where ``x`` reaches 0, ``[-inf, inf]`` where 0 is inside or all of it."""
        low, high = _quotient_ends(np.ones(()), self.upper)[0], _quotient_ends(np.ones(()), self.lower)[1]
        inside = ((self.lower < 0.0) & (self.upper > 0.0)) | ((self.lower == 0.0) & (self.upper == 0.0))
        low = np.where(inside | (self.upper == 0.0), -np.inf, low)
        high = np.where(inside | (self.lower == 0.0), np.inf, high)
        return Interval(low, high)

    @_defers
    def __truediv__(self, other: Interval | ArrayLike) -> Interval:
        other = Interval.lift(other)
        product = self * other.reciprocal()
        ends = [_quotient_ends(a, b) for a in self.bounds() for b in other.bounds()]
        direct = (other.lower > 0.0) | (other.upper < 0.0)
        for end in (*self.bounds(), *other.bounds()):
            direct = direct & np.isfinite(end)
        low = np.minimum.reduce([low for low, _ in ends])
        high = np.maximum.reduce([high for _, high in ends])
        return Interval(np.where(direct, low, product.lower), np.where(direct, high, product.upper))

    def __rtruediv__(self, other: ArrayLike) -> Interval:
        return Interval.lift(other) / self

    @_defers
    def __matmul__(self, other: Interval | ArrayLike) -> Interval:
        """Return the matrix product of the last two axes."""
        other = Interval.lift(other)
        return (self[..., :, :, None] * other[..., None, :, :]).sum(-2)

    def __rmatmul__(self, other: ArrayLike) -> Interval:
        return Interval.lift(other) @ self

    def _reduce(self, axis: int, combine: Callable[[Interval, Interval], Interval], empty: float) -> Interval:
        """Combine along one axis, in halves."""
        rest = Interval(np.moveaxis(self.lower, axis, 0), np.moveaxis(self.upper, axis, 0))
        if rest.shape[0] == 0:
            return Interval(np.full(rest.shape[1:], empty))
        while (n := rest.shape[0]) > 1:
            joined = combine(rest[: n // 2], rest[n // 2 : 2 * (n // 2)])
            if n % 2:
                last = rest[n - 1 :]
                joined = Interval(
                    np.concatenate([joined.lower, last.lower]), np.concatenate([joined.upper, last.upper])
                )
            rest = joined
        return rest[0]

    def sum(self, axis: int = -1) -> Interval:
        return self._reduce(axis, lambda a, b: a + b, 0.0)

    def prod(self, axis: int = -1) -> Interval:
        return self._reduce(axis, lambda a, b: a * b, 1.0)

    def absolute(self) -> Interval:
        reaches = (self.lower <= 0.0) & (self.upper >= 0.0)
        least = np.minimum(np.abs(self.lower), np.abs(self.upper))
        return Interval(np.where(reaches, 0.0, least), self.magnitude)

    def square(self) -> Interval:
        """Return ``x * x``."""
        size = self.absolute()
        return Interval(
            np.maximum(_product_ends(size.lower, size.lower)[0], 0.0), _product_ends(size.upper, size.upper)[1]
        )

    def power(self, exponent: int) -> Interval:
        """Return ``x ** exponent`` for an integer ``exponent >= 0``; ``x ** 0`` is 1.

        Raises:
            ValueError: The exponent is negative.
        """
        if exponent < 0:
            raise ValueError(f"the exponent must not be negative, got {exponent}")
        # odd powers increase; even ones do on |x|
        base = self if exponent % 2 else self.absolute()
        return Interval(_power_ends(base.lower, exponent)[0], _power_ends(base.upper, exponent)[1])

    def sqrt(self) -> Interval:
        with np.errstate(invalid="ignore"):
            low, high = np.sqrt(self.lower), np.sqrt(self.upper)
        down = np.where(self.lower == 0.0, 0.0, round_down(low))
        up = np.where(self.upper == 0.0, 0.0, round_up(high))
        outside = self.lower < 0.0
        return Interval(np.where(outside, -np.inf, down), np.where(outside, np.inf, up))

    def exp(self) -> Interval:
        return Interval(_exp_ends(self.lower)[0], _exp_ends(self.upper)[1])

    def norm(self) -> Interval:
        return self.square().reshape(-1).sum(0).sqrt()

    def indicator(self) -> Interval:
        """Return 1 where ``x > 0``, else 0; ``[0, 1]`` where both happen."""
        return Interval((self.lower > 0.0).astype(np.float64), (self.upper > 0.0).astype(np.float64))
