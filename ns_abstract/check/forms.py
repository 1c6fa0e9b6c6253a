"""First-order affine forms with a remainder, in float64: the checker's own arithmetic.

A form encloses a function of ``s`` in [-1, 1]^d: ``c + g . s`` with an error of at most ``r``. Every operation adds its
own rounding to ``r``: an operation in float64 errs by at most ``U`` times the size of its result.
"""

from __future__ import annotations

from typing import Any

import numpy as np

#: Unit roundoff of float64, and what underflow may add.
U, TINY = 2.0**-53, 1e-290
#: Relative error, in units, of numpy's exponential, sine and cosine; the libraries' own figure is 4 at most.
FUNCTION = 8.0
#: What a flushed number of float32 loses at most, and what its sums and products stay below without overflow.
_FLUSH, _OVERFLOW = 2.0**-126, 2.0**126

Array = Any


class Affine:
    """Forms of many functions side by side: centres ``c`` [...], slopes ``g`` [d, ...] and radii ``r`` [...]."""

    __slots__ = ("c", "g", "r")

    def __init__(self, c: Array, g: Array, r: Array) -> None:
        self.c, self.g, self.r = c, g, r

    @classmethod
    def constant(cls, c: Array, like: Affine, r: Array = 0.0) -> Affine:
        """Return the form of a constant ``c`` with error at most ``r``, in the shape of ``like``."""
        shape = like.c.shape
        return cls(np.broadcast_to(np.float64(c), shape), np.zeros_like(like.g), np.broadcast_to(np.float64(r), shape))

    @property
    def slope(self) -> Array:
        """Sum of the absolute slopes."""
        return np.abs(self.g).sum(axis=0)

    @property
    def width(self) -> Array:
        """Upper bound of the distance between the function and its centre."""
        return (self.slope + self.r) * (1.0 + (16.0 + 2.0 * len(self.g)) * U)

    def range(self) -> tuple[Array, Array]:
        """Return a lower and an upper bound of the function."""
        w = self.width + 2.0 * U * np.abs(self.c)
        return self.c - w, self.c + w

    def size(self) -> Array:
        """Return an upper bound of the function's absolute value."""
        return np.abs(self.c) + self.width

    def wider(self, r: Array) -> Affine:
        """Return the form with a radius that is larger by ``r``."""
        return Affine(self.c, self.g, (self.r + r) * (1.0 + 2.0 * U))

    def __neg__(self) -> Affine:
        return Affine(-self.c, -self.g, self.r)

    def __add__(self, other: Affine | float | Array) -> Affine:
        if not isinstance(other, Affine):
            c = self.c + other
            return Affine(c, self.g, (self.r + 2.0 * U * np.abs(c)) * (1.0 + 2.0 * U))
        # sums do not underflow
        c, g = self.c + other.c, self.g + other.g
        size = np.abs(c) + np.abs(g).sum(axis=0)
        return Affine(c, g, (self.r + other.r + 4.0 * U * size) * (1.0 + 4.0 * U))

    def __sub__(self, other: Affine | float | Array) -> Affine:
        return self + (-other)

    def __mul__(self, other: Affine | float | Array) -> Affine:
        if not isinstance(other, Affine):
            c, g = self.c * other, self.g * other
            size = np.abs(c) + np.abs(g).sum(axis=0)
            return Affine(c, g, (self.r * np.abs(other) + 4.0 * U * size) * (1.0 + 4.0 * U) + TINY)
        # (g . s)(h . s) has g_k h_k s_k^2 with s_k^2 in [0, 1]
        half = 0.5 * self.g * other.g
        a, b = self.slope, other.slope
        p, q = np.abs(self.c) + a, np.abs(other.c) + b
        c = self.c * other.c + half.sum(axis=0)
        g = self.c * other.g + other.c * self.g
        # sum |half| is at most half of a b, so that the difference keeps half of it
        r = (a * b - np.abs(half).sum(axis=0)) + p * other.r + q * self.r + self.r * other.r + 32.0 * U * p * q
        return Affine(c, g, r * (1.0 + 32.0 * U) + TINY)

    __radd__, __rmul__ = __add__, __mul__

    def square(self) -> Affine:
        """Return the form of the square."""
        a = self.slope
        p, half = np.abs(self.c) + a, 0.5 * a * a
        # (g . s)^2 lies in [0, a^2]
        r = half + self.r * (2.0 * p + self.r) + 32.0 * U * p * p
        return Affine(self.c * self.c + half, 2.0 * self.c * self.g, r * (1.0 + 32.0 * U) + TINY)

    def taylor(self, f: Array, slope: Array, low: Array, high: Array, bad: Array = False) -> Affine:
        """Return the form of f(self) by Taylor's formula of second order.

        ``f`` and ``slope`` are value and derivative at the centre; half the second derivative lies in [low, high]. The
        form is unbounded where ``bad``.
        """
        w = self.width
        low, high = np.minimum(low, 0.0) * (w * w), np.maximum(high, 0.0) * (w * w)
        size = np.abs(f) + np.abs(slope) * w + high - low
        r = (np.abs(slope) * self.r + 0.5 * (high - low) + 4.0 * FUNCTION * U * size) * (1.0 + 32.0 * U) + TINY
        bad = bad | ~(np.isfinite(r) & np.isfinite(f))
        f = f + 0.5 * (high + low)
        return Affine(np.where(bad, 0.0, f), np.where(bad, 0.0, slope * self.g), np.where(bad, np.inf, r))

    def power(self, k: float) -> Affine:
        """Return the form of the power ``k``, -1, -1/2 or 1/2; unbounded where the base may be 0 or negative."""
        ends = np.stack(self.range())
        bad = ~(ends[0] > 0.0)
        ends, c = np.where(bad, 1.0, ends), np.where(bad, 1.0, self.c)
        # the second derivative has one sign, and falls with the argument
        bends = 0.5 * k * (k - 1.0) * ends ** (k - 2.0) * (1.0 + 32.0 * U)
        return self.taylor(c**k, k * c ** (k - 1.0), bends.min(axis=0), bends.max(axis=0), bad)

    def exp(self) -> Affine:
        """Return the form of the exponential."""
        high = self.range()[1]
        f = np.exp(np.minimum(self.c, 700.0))
        top = 0.5 * np.exp(np.minimum(high, 700.0)) * (1.0 + 16.0 * FUNCTION * U)
        return self.taylor(f, f, 0.0 * f, top, ~(high <= 690.0))

    def sine(self) -> tuple[Affine, Affine]:
        """Return the forms of sine and cosine."""
        s, c = np.sin(self.c), np.cos(self.c)
        half, room = 0.5 * (1.0 + 8.0 * U), 0.5 * self.width + 1e-15
        # the second derivative moves by no more than the angle
        a, b = (
            self.taylor(f, slope, np.maximum(-0.5 * f - room, -half), np.minimum(-0.5 * f + room, half))
            for f, slope in ((s, c), (c, -s))
        )
        return a, b

    def replaced(self, where: Array, low: Array, high: Array) -> Affine:
        """Return the form, replaced by the interval [low, high] where ``where`` is true."""
        middle = 0.5 * (low + high)
        radius = np.maximum(high - middle, middle - low) * (1.0 + 4.0 * U) + TINY
        return Affine(np.where(where, middle, self.c), np.where(where, 0.0, self.g), np.where(where, radius, self.r))

    def narrowed(self, low: Array, high: Array) -> Affine:
        """Return the form, or the interval [low, high], which also holds, where that is clearly narrower."""
        return self.replaced(~(2.0 * self.width <= 1.5 * (high - low)), low, high)

    def clamped(self, low: float | Array, high: float | Array) -> Affine:
        """Return the form of min(max(self, low), high), with the slope of the chord.

        The value less ``slope`` times the argument is piecewise linear, so it is extreme at the argument's ends or at
        the limits between them.
        """
        least, most = self.range()
        bottom, top = np.clip(least, low, high), np.clip(most, low, high)
        with np.errstate(all="ignore"):
            slope = np.where(most > least, np.clip((top - bottom) / (most - least), 0.0, 1.0), 1.0)
            places = np.stack([least, most, np.clip(low, least, most), np.clip(high, least, most)])
            rest = np.clip(places, low, high) - slope * places
            rounding = 4.0 * U * (np.abs(least) + np.abs(most) + np.abs(bottom) + np.abs(top))
            small, large = rest.min(axis=0) - rounding, rest.max(axis=0) + rounding
            form = (self * slope + 0.5 * (small + large)).wider(0.5 * (large - small) * (1.0 + 4.0 * U))
        return form.replaced(~(np.isfinite(form.r) & np.isfinite(form.c)), bottom, top)

    def linear(self, f: Any, absolute: Any, bias: Array, terms: int, unit: float = 0.0, largest: float = 1.0) -> Affine:
        """Return the form of a linear map ``f`` plus ``bias``; ``absolute`` is the map of the absolute coefficients.

        A sum of ``terms`` products, in any order, errs by ``terms`` + 2 roundings of the sum of their sizes. ``unit``
        is the roundoff of the program that evaluates the map (0: exact). With it, ``largest`` bounds the coefficients:
        numbers may be flushed to zero, and the form is unbounded where they may overflow.
        """
        size = absolute(self.size()) + np.abs(bias)
        charge = (terms + 4.0) * (unit + 2.0 * U) + 2.0 * U * (len(self.g) + 16.0)
        r = (absolute(self.r) + charge * size) * (1.0 + 2.0 * U * (terms + 16.0)) + TINY
        if unit:
            peak = (terms + 4.0) * (1.0 + largest) * (1.0 + self.size().max() + np.abs(bias).max())
            r = r + (8.0 * _FLUSH * peak if peak < _OVERFLOW else np.inf)
        return Affine(f(self.c) + bias, f(self.g), r)

    def dense(self, weight: Array, bias: Array, unit: float = 0.0) -> Affine:
        """Return the form of ``weight`` [out, in] times the last axis, plus ``bias``; see `linear`."""
        size = np.abs(weight).T
        return self.linear(lambda a: a @ weight.T, lambda a: a @ size, bias, weight.shape[1], unit, size.max())

    def relu(self, most: int) -> Affine:
        """Return the form of a ReLU; unstable neurons get symbols of their own (`with_symbols`)."""
        low, high = self.range()
        return self.clamped(0.0, np.inf).with_symbols(most, where=(low < 0.0) & (high > 0.0))

    def with_symbols(self, most: int, part: float = 0.0, where: Array = True) -> Affine:
        """Return the form with new symbols, behind the others, for the ``most`` largest radii along the last axis.

        Operations that follow keep these errors correlated. Radii below ``part`` of the largest one stay radii.
        """
        own = np.where(where, self.r, 0.0)
        own = np.where(own > part * own.max(axis=-1, keepdims=True), own, 0.0)
        count = min(most, int((own > 0.0).sum(axis=-1).max(initial=0)))
        place = np.argsort(-own, axis=-1)[..., :count, None]
        g = np.moveaxis(np.where(place == np.arange(own.shape[-1]), own[..., None, :], 0.0), -2, 0)
        return Affine(self.c, np.concatenate([self.g, g]), np.where(g.any(axis=0), 0.0, self.r))

    def padded(self, count: int) -> Affine:
        """Return the form with ``count`` symbols, the new ones with slope 0."""
        return Affine(self.c, np.concatenate([self.g, np.zeros((count - len(self.g), *self.c.shape))]), self.r)

    def keep_symbols(self, count: int) -> Affine:
        """Return the form with its first ``count`` symbols; the slopes of the others are added to the radius."""
        r = self.r + np.abs(self.g[count:]).sum(axis=0)
        return Affine(self.c, self.g[:count], r * (1.0 + 2.0 * U * (len(self.g) + 8.0)))

    @staticmethod
    def joined(forms: Any, axis: int, join: Any = np.concatenate) -> Affine:
        """Return forms concatenated, or stacked, along an axis that is counted from the last one."""
        return Affine(*(join([getattr(f, name) for f in forms], axis=axis) for name in ("c", "g", "r")))

    def apply(self, pick: Any) -> Affine:
        """Return the form with ``pick`` applied to its three arrays; it must count axes from the last one."""
        return Affine(pick(self.c), pick(self.g), pick(self.r))

    def reshaped(self, *shape: int) -> Affine:
        """Return the form in another shape of the same size."""
        return self.apply(lambda a: a.reshape(*a.shape[: a.ndim - self.c.ndim], *shape))


def parameters(middle: Array, half: Array) -> list[Affine]:
    """Return forms [B] of the d parameters over boxes ``middle`` +- ``half`` [B, d]; one constant form if d is 0."""
    d = middle.shape[1]
    g = np.eye(d)[:, :, None] * half.T[:, None]
    room = 4.0 * U * (np.abs(middle) + half)
    forms = [Affine(middle[:, k], g[:, k], room[:, k]) for k in range(d)]
    return forms or [Affine(np.zeros(len(middle)), np.zeros((0, len(middle))), np.zeros(len(middle)))]


def product(a: list[list[Affine]], b: list[list[Affine]]) -> list[list[Affine]]:
    """Return the product of two matrices of forms."""
    return [[total(row[k] * b[k][j] for k in range(len(b))) for j in range(len(b[0]))] for row in a]


def total(items: Any) -> Affine:
    """Return the sum of forms."""
    first, *rest = items
    for item in rest:
        first = first + item
    return first


def rotation(axis: Array, angle: Affine, error: float = 0.0) -> list[list[Affine]]:
    """Return Rodrigues' rotation matrix about a unit vector, I + sin K + (1 - cos) K^2, entries within ``error``."""
    x, y, z = (float(v) for v in axis)
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    kk, (s, c), one = k @ k, angle.sine(), np.eye(3)
    rest = -c + 1.0
    return [[(s * k[i, j] + rest * kk[i, j] + one[i, j]).wider(error) for j in range(3)] for i in range(3)]


def fixed(matrix: Array, like: Affine, r: float = 0.0) -> list[list[Affine]]:
    """Return a constant matrix as forms with radius ``r``."""
    return [[Affine.constant(v, like, r) for v in row] for row in np.atleast_2d(matrix)]
