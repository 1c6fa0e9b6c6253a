"""Activations that are convex, concave or linear between known points (docs/dev/design.md, N10, N21).

One relaxation serves them all. The interval is cut at evenly spaced points and at the known ones, so that every
part has one curvature. A line with any slope becomes a sound one by the greatest or least distance of the function
from it: on a part, the ends are extreme on one side and the two tangents at the ends bound the other.
The slope is that of the concave (or convex) envelope at the middle, where a line's height is its area.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import (
    AFFINE,
    ATTENTION,
    ATTENTION_BLOCKS,
    FLUSH,
    FUNCTION_FLUSHES,
    HARD,
    LARGEST_EXPONENT,
    LIBRARY,
    LOST_SHARE,
    OWN_FUNCTION,
    QUOTIENT,
    ROOT,
    SQUARE,
)
from ns_abstract.verify.network.layers import Activation, LinearRelaxation
from ns_abstract.verify.network.tangents import Tangents

#: Intervals worked on at a time.
_TOGETHER = 1 << 13
#: A softmax's terms, relative to one of them, and their sum are cut off at exp(this).
CAP = 30.0
#: Even parts of an interval where a function bends.
_PARTS = 16
#: Steps towards the best slope; any slope is sound.
_STEPS = 6
#: What a number that is flushed to zero may change in a function whose slopes are 1 at most.
_FLUSHED = FUNCTION_FLUSHES * FLUSH
#: A preference: better bounds of the input are asked for where the lines are this part of the width apart.
_APART = 2.0**-6
#: A preference: intervals of at most this part of their ends count as points.
_POINT = 2.0**-36


class _SampledFunction(NamedTuple):
    """Samples of a function at ascending points [K, ...].

    Attributes:
        z, value, slope: [K, ...].
        bend: [K - 1, ...] 1 convex, 0 straight, -1 concave between.
        size: [...] for the rounding of everything.
    """

    z: Tensor
    value: Tensor
    slope: Tensor
    bend: Tensor
    size: Tensor


@dataclass(frozen=True, eq=False)
class ScalarFunction(Activation):
    """An activation that is piecewise convex, concave or linear."""

    @property
    def breaks(self) -> tuple[float, ...]:
        """Where the curvature changes, growing; kinks and poles are such."""
        return ()

    @property
    def bends(self) -> tuple[int, ...]:
        """Curvature before, between and behind the breaks: 1 convex, 0 straight, -1 concave."""
        raise AssertionError

    #: Values of the input that are known to be impossible lie below.
    least_input: ClassVar[float] = -math.inf
    #: What the error of a computed slope is relative to, beside the slope.
    slope_scale: ClassVar[float] = 1.0

    def slope(self, z: Tensor) -> Tensor:
        """The derivative on curved parts."""
        raise AssertionError

    def _cuts(self, lower: Tensor, upper: Tensor) -> _SampledFunction:
        parts = _PARTS if any(self.bends) else 2
        width = upper - lower
        points = [lower + width * (k / parts) for k in range(parts)]
        points += [upper, *(torch.clamp(lower.new_tensor(b), lower, upper) for b in self.breaks)]
        z = torch.stack(points)
        # rounding may put a point past an end
        z = torch.minimum(torch.maximum(z, lower), upper)
        if self.breaks:
            z = z.sort(0).values
        breaks, bends = lower.new_tensor(self.breaks), torch.tensor(self.bends, device=lower.device)
        bend = bends[torch.bucketize((0.5 * (z[1:] + z[:-1])).contiguous(), breaks)]
        value = self.function(z)
        slope = self.slope(z) if any(self.bends) else torch.zeros_like(z)
        size = value.abs().amax(0) + (slope.abs().amax(0) + self.slope_scale) * width + OWN_FUNCTION
        return _SampledFunction(z, value, slope, bend, size)

    @staticmethod
    def _extreme(cuts: _SampledFunction, line: Tensor, side: float) -> Tensor:
        """Bound of ``f(z) - line z`` below (``side`` -1) or above (1)."""
        value = -side * (cuts.value - line * cuts.z)
        slope = -side * (cuts.slope - line)
        a, b = slope[:-1], slope[1:]
        ends = torch.minimum(value[:-1], value[1:])
        # convex with a minimum inside: the mean of both tangents that has no slope
        inside = (a < 0.0) & (b > 0.0) & (cuts.bend == (1 if side < 0.0 else -1))
        part = torch.where(inside, b / (b - a), torch.ones_like(a))
        dip = part * value[:-1] + (1.0 - part) * value[1:] + part * a * (cuts.z[1:] - cuts.z[:-1])
        least = torch.where(inside, torch.minimum(ends, dip), ends).amin(0)
        room = OWN_FUNCTION * (cuts.size + line.abs() * cuts.z.abs().amax(0))
        return -side * (least - room)

    def _tangent(self, cuts: _SampledFunction, side: float) -> Tensor:
        """Slope of the envelope above (``side`` 1) or below (-1) at the middle, by Newton's method."""
        low, high = cuts.z[0], cuts.z[-1]
        middle = 0.5 * (low + high)
        value, away = side * cuts.value, middle - cuts.z
        far = torch.full_like(value, -math.inf)
        chord = side * (cuts.value[-1] - cuts.value[0]) / (high - low)
        best, least = chord, (value + chord * away).amax(0)
        line = side * self.slope(middle) if any(self.bends) else chord
        for _ in range(_STEPS):
            height = value + line * away
            most = height.amax(0)
            # a line that is not a number is never better
            better = most < least
            best, least = torch.where(better, line, best), torch.where(better, most, least)
            i = torch.where(away > 0.0, height, far).argmax(0, keepdim=True)
            j = torch.where(away < 0.0, height, far).argmax(0, keepdim=True)
            rise = value.gather(0, j) - value.gather(0, i)
            line = (rise / (cuts.z.gather(0, j) - cuts.z.gather(0, i)))[0]
        return torch.where(torch.isfinite(best), side * best, torch.zeros_like(best))

    def _inside(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        """The interval without what is known to be impossible."""
        least = self.least_input
        return (lower, upper) if least == -math.inf else (lower.clamp(min=least), upper.clamp(min=least))

    def straight(self, z: Tensor) -> Tensor:
        """The slope at ``z`` of a function without curved parts."""
        raise AssertionError

    #: The greatest slope of a function without curved parts.
    steepest: ClassVar[float] = 1.0

    def lines(self, lower: Tensor, upper: Tensor) -> LinearRelaxation:
        return self._by_parts(self._lines, lower, upper)

    def band(self, lower: Tensor, upper: Tensor) -> LinearRelaxation:
        return self._by_parts(self._band, lower, upper)

    def range(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        level = self._by_parts(self._level, lower, upper)
        return level.lower_offset, level.upper_offset

    def _by_parts(
        self, work: Callable[[Tensor, Tensor], LinearRelaxation], lower: Tensor, upper: Tensor
    ) -> LinearRelaxation:
        """Lines of many intervals: as many at a time as a processor's cache holds, straight parts by themselves."""
        low, high = lower.reshape(-1), upper.reshape(-1)
        if any(self.bends):
            parts = [work(*ends) for ends in zip(low.split(_TOGETHER), high.split(_TOGETHER), strict=True)]
            results = [torch.cat(v) for v in zip(*(_fields(part) for part in parts), strict=True)]
            return LinearRelaxation(*(v.reshape(lower.shape) for v in results))
        middle = 0.5 * (low + high)
        slope, value = self.straight(middle), self.function(middle)
        # a stored kink is off by a rounding
        room = OWN_FUNCTION * (value.abs() + self.steepest * _size(low, high) + OWN_FUNCTION)
        if work == self._level:
            ends = self.function(low), self.function(high)
            room = room + OWN_FUNCTION * _size(*ends)
            results = [torch.zeros_like(low), torch.minimum(*ends) - room, slope, torch.maximum(*ends) + room]
        else:
            offset = value - slope * middle
            results = [slope, offset - room, slope.clone(), offset + room]
        kinked = torch.zeros_like(low, dtype=torch.bool)
        for point in self.breaks:
            kinked |= (low < point) & (high > point)
        at = kinked.nonzero()[:, 0]
        for part in at.split(_TOGETHER):
            for whole, own in zip(results, _fields(work(low[part], high[part])), strict=True):
                whole[part] = own
        return LinearRelaxation(*(v.reshape(lower.shape) for v in results))

    def _lines(self, lower: Tensor, upper: Tensor) -> LinearRelaxation:
        cuts = self._cuts(*self._inside(lower, upper))
        lines = []
        for side in (-1.0, 1.0):
            slope = self._tangent(cuts, side)
            offset = self._extreme(cuts, slope, side)
            if -side in self.bends:
                tangents = Tangents.of(self, cuts.z[0], cuts.z[-1], side)
                middle = 0.5 * (cuts.z[0] + cuts.z[-1])
                exact = tangents.line(torch.minimum(torch.maximum(middle, tangents.first), tangents.last))
                known = tangents.known & torch.isfinite(exact[1])
                slope, offset = (torch.where(known, *pair) for pair in zip(exact, (slope, offset), strict=True))
            lines += [slope, offset]
        return LinearRelaxation(*lines)

    def _band(self, lower: Tensor, upper: Tensor) -> LinearRelaxation:
        cuts = self._cuts(*self._inside(lower, upper))
        width = cuts.z[-1] - cuts.z[0]
        slope = torch.where(width > 0.0, (cuts.value[-1] - cuts.value[0]) / width, torch.zeros_like(width))
        slope = torch.where(torch.isfinite(slope), slope, torch.zeros_like(slope))
        return LinearRelaxation(slope, self._extreme(cuts, slope, -1.0), slope, self._extreme(cuts, slope, 1.0))

    def _level(self, lower: Tensor, upper: Tensor) -> LinearRelaxation:
        """Lines without a slope."""
        cuts = self._cuts(*self._inside(lower, upper))
        flat = torch.zeros_like(lower)
        return LinearRelaxation(flat, self._extreme(cuts, flat, -1.0), flat, self._extreme(cuts, flat, 1.0))

    def relaxation_gap(self, lower: Tensor, upper: Tensor) -> Tensor | None:
        band = self.band(lower, upper)
        width = upper - lower
        # rounding alone keeps the lines of a point apart
        wide = ~(width <= _POINT * _size(lower, upper))
        return torch.where(wide, (band.upper_offset - band.lower_offset) / width, torch.zeros_like(width))

    def unstable(self, lower: Tensor, upper: Tensor) -> Tensor:
        gap = self.relaxation_gap(lower, upper)
        return torch.ones_like(lower, dtype=torch.bool) if gap is None else ~(gap <= _APART)


class LibraryFunction(ScalarFunction):
    """An activation whose float32 evaluation calls a library's exponential, logarithm or error function."""


def _fields(lines: LinearRelaxation) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return lines.lower_slope, lines.lower_offset, lines.upper_slope, lines.upper_offset


def _size(lower: Tensor, upper: Tensor) -> Tensor:
    return torch.maximum(lower.abs(), upper.abs())


# ---------------------------------------------------------------- straight parts


@dataclass(frozen=True, eq=False)
class Clip(ScalarFunction):
    """``min(max(slope z + offset, least), most)``; ReLU6, clamp, HardSigmoid."""

    least: float = 0.0
    most: float = 1.0
    factor: float = 1.0
    offset: float = 0.0

    @property
    def steepest(self) -> float:  # type: ignore[override]
        return self.factor

    @property
    def breaks(self) -> tuple[float, ...]:
        return (self.least - self.offset) / self.factor, (self.most - self.offset) / self.factor

    @property
    def bends(self) -> tuple[int, ...]:
        return 0, 0, 0

    def function(self, z: Tensor) -> Tensor:
        return (self.factor * z + self.offset).clamp(self.least, self.most)

    def straight(self, z: Tensor) -> Tensor:
        low, high = self.breaks
        return torch.where((z >= low) & (z <= high), torch.full_like(z, self.factor), torch.zeros_like(z))

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        flushed = _FLUSHED * (1.0 + self.factor + _size(lower, upper))
        if (self.factor, self.offset) == (1.0, 0.0):
            return flushed
        return AFFINE * (self.factor * _size(lower, upper) + abs(self.offset)) + flushed


@dataclass(frozen=True, eq=False)
class Abs(ScalarFunction):
    """``|z|``."""

    @property
    def breaks(self) -> tuple[float, ...]:
        return (0.0,)

    @property
    def bends(self) -> tuple[int, ...]:
        return 0, 0

    def function(self, z: Tensor) -> Tensor:
        return z.abs()

    def straight(self, z: Tensor) -> Tensor:
        return torch.where(z >= 0.0, torch.ones_like(z), -torch.ones_like(z))

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        return _FLUSHED


# ---------------------------------------------------------------- algebraic


@dataclass(frozen=True, eq=False)
class HardSwish(ScalarFunction):
    """``z min(max(z / 6 + 1 / 2, 0), 1)``."""

    @property
    def breaks(self) -> tuple[float, ...]:
        return -3.0, 3.0

    @property
    def bends(self) -> tuple[int, ...]:
        return 0, 1, 0

    def function(self, z: Tensor) -> Tensor:
        return z * (z + 3.0).clamp(0.0, 6.0) / 6.0

    def slope(self, z: Tensor) -> Tensor:
        return (2.0 * z + 3.0) / 6.0

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        return HARD * _size(lower, upper) + _FLUSHED


@dataclass(frozen=True, eq=False)
class Power(ScalarFunction):
    """``z^exponent`` for a whole exponent of at least 2."""

    exponent: int = 2

    @property
    def breaks(self) -> tuple[float, ...]:
        return (0.0,) if self.exponent % 2 else ()

    @property
    def bends(self) -> tuple[int, ...]:
        return (-1, 1) if self.exponent % 2 else (1,)

    def function(self, z: Tensor) -> Tensor:
        return z**self.exponent

    def slope(self, z: Tensor) -> Tensor:
        return self.exponent * z ** (self.exponent - 1)

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        # a square is one product; others may be a library's power
        relative = SQUARE if self.exponent == 2 else LIBRARY
        size = _size(lower, upper)
        return relative * size**self.exponent + _FLUSHED * (1.0 + size)


@dataclass(frozen=True, eq=False)
class Reciprocal(ScalarFunction):
    """``1 / z``; known where an interval holds no 0, with ``floor`` a bound that the input is known to obey."""

    # two operations that keep all digits, however small the slope is
    slope_scale: ClassVar[float] = 0.0
    floor: float = -math.inf

    @property
    def least_input(self) -> float:  # type: ignore[override]
        return self.floor

    @property
    def breaks(self) -> tuple[float, ...]:
        return (0.0,)

    @property
    def bends(self) -> tuple[int, ...]:
        return -1, 1

    def function(self, z: Tensor) -> Tensor:
        return 1.0 / z

    def slope(self, z: Tensor) -> Tensor:
        return -1.0 / z.square()

    def _cuts(self, lower: Tensor, upper: Tensor) -> _SampledFunction:
        return super()._cuts(*_unknown(lower, upper, (lower <= 0.0) & (upper >= 0.0)))

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        lower, upper = self._inside(lower, upper)
        return QUOTIENT / torch.minimum(lower.abs(), upper.abs()) + _FLUSHED


class SoftmaxReciprocal(Reciprocal):
    """The reciprocal in a softmax: of a sum of capped exponentials (N11)."""

    def missing(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        # the share and this are both less than exp(-CAP) and its roundings there; sums keep half their size
        return torch.where(upper > 0.5 * math.exp(CAP), LOST_SHARE, 0.0)


def _unknown(lower: Tensor, upper: Tensor, where: Tensor) -> tuple[Tensor, Tensor]:
    """Return NaN where the function has no bound; the cell is then given up."""
    nan = torch.full_like(lower, math.nan)
    return torch.where(where, nan, lower), torch.where(where, nan, upper)


@dataclass(frozen=True, eq=False)
class Root(ScalarFunction):
    """``sqrt(z)``, or ``1 / sqrt(z)`` if ``inverse``, for inputs above 0; ``floor`` is known to bound them."""

    floor: float = -math.inf
    inverse: bool = False

    @property
    def least_input(self) -> float:  # type: ignore[override]
        return self.floor

    @property
    def bends(self) -> tuple[int, ...]:
        return (1,) if self.inverse else (-1,)

    def function(self, z: Tensor) -> Tensor:
        return z.rsqrt() if self.inverse else z.sqrt()

    def slope(self, z: Tensor) -> Tensor:
        return -0.5 * z.rsqrt() / z if self.inverse else 0.5 * z.rsqrt()

    def _cuts(self, lower: Tensor, upper: Tensor) -> _SampledFunction:
        # a number below may be flushed to zero, whose root is far from its own
        return super()._cuts(*_unknown(lower, upper, ~(lower >= FLUSH)))

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        lower, upper = self._inside(lower, upper)
        return ROOT * (lower.rsqrt() if self.inverse else upper.sqrt()) + _FLUSHED


# ---------------------------------------------------------------- with exponentials


@dataclass(frozen=True, eq=False)
class Exp(LibraryFunction):
    """The exponential."""

    @property
    def bends(self) -> tuple[int, ...]:
        return (1,)

    def function(self, z: Tensor) -> Tensor:
        return z.exp()

    def slope(self, z: Tensor) -> Tensor:
        return z.exp()

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        representable = upper < LARGEST_EXPONENT
        return torch.where(representable, 2.0 * LIBRARY * upper.exp() + _FLUSHED, torch.full_like(upper, math.nan))


@dataclass(frozen=True, eq=False)
class CappedExp(Exp):
    """``min(exp(z), exp(cap))``: of terms of a softmax, whose sums are as good as infinite past that (N11).

    Attributes:
        count: Terms of a sum.
    """

    count: int = 1
    cap: ClassVar[float] = CAP

    @property
    def breaks(self) -> tuple[float, ...]:
        return (self.cap,)

    @property
    def bends(self) -> tuple[int, ...]:
        return 1, 0

    def function(self, z: Tensor) -> Tensor:
        return z.clamp(max=self.cap).exp()

    def slope(self, z: Tensor) -> Tensor:
        return z.clamp(max=self.cap).exp()

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        # the smaller of a number and the cap is the cap where any evaluation is past it
        capped = lower > self.cap + 1.0
        relative = ATTENTION + ATTENTION_BLOCKS * self.count
        return torch.where(capped, 0.0, relative * upper.clamp(max=self.cap).exp() + _FLUSHED)


@dataclass(frozen=True, eq=False)
class Log(LibraryFunction):
    """The natural logarithm; ``floor`` is known to bound the input."""

    floor: float = -math.inf

    @property
    def least_input(self) -> float:  # type: ignore[override]
        return self.floor

    @property
    def bends(self) -> tuple[int, ...]:
        return (-1,)

    def function(self, z: Tensor) -> Tensor:
        return z.log()

    def slope(self, z: Tensor) -> Tensor:
        return 1.0 / z

    def _cuts(self, lower: Tensor, upper: Tensor) -> _SampledFunction:
        # a number below may be flushed to zero, whose root is far from its own
        return super()._cuts(*_unknown(lower, upper, ~(lower >= FLUSH)))

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        lower, upper = self._inside(lower, upper)
        return LIBRARY * (1.0 + torch.maximum(lower.log().abs(), upper.log().abs()))


@dataclass(frozen=True, eq=False)
class Softplus(LibraryFunction):
    """``log(1 + exp(z))``."""

    @property
    def bends(self) -> tuple[int, ...]:
        return (1,)

    def function(self, z: Tensor) -> Tensor:
        return torch.logaddexp(z, torch.zeros_like(z))

    def slope(self, z: Tensor) -> Tensor:
        return torch.sigmoid(z)

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        return 2.0 * LIBRARY * (1.0 + _size(lower, upper))


@dataclass(frozen=True, eq=False)
class Elu(LibraryFunction):
    """``scale z`` above 0 and ``scale alpha (exp(z / width) - 1)`` below; ELU, SELU and CELU."""

    alpha: float = 1.0
    scale: float = 1.0
    width: float = 1.0

    @property
    def breaks(self) -> tuple[float, ...]:
        return (0.0,)

    @property
    def bends(self) -> tuple[int, ...]:
        return 1, 0

    def function(self, z: Tensor) -> Tensor:
        below = self.alpha * torch.expm1(z.clamp(max=0.0) / self.width)
        return self.scale * torch.where(z > 0.0, z, below)

    def slope(self, z: Tensor) -> Tensor:
        return self.scale * self.alpha / self.width * torch.exp(z.clamp(max=0.0) / self.width)

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        size = _size(lower, upper)
        flushed = _FLUSHED * (1.0 + self.scale) * (1.0 + self.alpha) * (1.0 + size)
        return 2.0 * LIBRARY * self.scale * (self.alpha + size) + flushed


@dataclass(frozen=True, eq=False)
class Erf(LibraryFunction):
    """The error function."""

    @property
    def breaks(self) -> tuple[float, ...]:
        return (0.0,)

    @property
    def bends(self) -> tuple[int, ...]:
        return 1, -1

    def function(self, z: Tensor) -> Tensor:
        return torch.erf(z)

    def slope(self, z: Tensor) -> Tensor:
        return 2.0 / math.sqrt(math.pi) * torch.exp(-z.square())

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        return 2.0 * LIBRARY


class _Sigmoidal(ScalarFunction):
    """An increasing function between -1 and 1 that is convex below 0 and concave above."""

    @property
    def breaks(self) -> tuple[float, ...]:
        return (0.0,)

    @property
    def bends(self) -> tuple[int, ...]:
        return 1, -1

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        return LIBRARY

    def range(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        return self.function(lower) - OWN_FUNCTION, self.function(upper) + OWN_FUNCTION

    def relaxation_gap(self, lower: Tensor, upper: Tensor) -> Tensor | None:
        return None

    def unstable(self, lower: Tensor, upper: Tensor) -> Tensor:
        return lower < upper


@dataclass(frozen=True, eq=False)
class Sigmoid(_Sigmoidal):
    """``1 / (1 + exp(-z))``."""

    def function(self, z: Tensor) -> Tensor:
        return torch.sigmoid(z)

    def slope(self, z: Tensor) -> Tensor:
        return torch.sigmoid(z) * torch.sigmoid(-z)


@dataclass(frozen=True, eq=False)
class Tanh(_Sigmoidal):
    """Hyperbolic tangent."""

    def function(self, z: Tensor) -> Tensor:
        return torch.tanh(z)

    def slope(self, z: Tensor) -> Tensor:
        return 1.0 / torch.cosh(z).square()


class _Gated(LibraryFunction):
    """``z g(z)`` with a gate g from 0 to 1: concave, convex, concave."""

    @property
    def bends(self) -> tuple[int, ...]:
        return -1, 1, -1

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        # the gate may be made of two such functions, and of constants that are float32 numbers
        return 4.0 * LIBRARY * _size(lower, upper) + _FLUSHED


@dataclass(frozen=True, eq=False)
class Silu(_Gated):
    """``z / (1 + exp(-z))``."""

    @property
    def breaks(self) -> tuple[float, ...]:
        # z tanh(z / 2) = 2
        return -2.3993572805154676, 2.3993572805154676

    def function(self, z: Tensor) -> Tensor:
        return z * torch.sigmoid(z)

    def slope(self, z: Tensor) -> Tensor:
        gate = torch.sigmoid(z)
        return gate + z * gate * torch.sigmoid(-z)


@dataclass(frozen=True, eq=False)
class Gelu(_Gated):
    """``z (1 + erf(z / sqrt(2))) / 2``."""

    @property
    def breaks(self) -> tuple[float, ...]:
        return -math.sqrt(2.0), math.sqrt(2.0)

    def function(self, z: Tensor) -> Tensor:
        return 0.5 * z * torch.special.erfc(-z * math.sqrt(0.5))

    def slope(self, z: Tensor) -> Tensor:
        density = torch.exp(-0.5 * z.square()) / math.sqrt(2.0 * math.pi)
        return 0.5 * torch.special.erfc(-z * math.sqrt(0.5)) + z * density


#: Where the second derivatives of the following two are 0 (mpmath, 40 digits).
_GELU_TANH = (-1.4185040087908283, 1.4185040087908283)
_MISH = (-2.256376396360793, 1.4905711794854284)
_CUBIC = 0.044715
_RATE = math.sqrt(2.0 / math.pi)


@dataclass(frozen=True, eq=False)
class GeluTanh(_Gated):
    """``z (1 + tanh(sqrt(2 / pi) (z + 0.044715 z^3))) / 2``."""

    @property
    def breaks(self) -> tuple[float, ...]:
        return _GELU_TANH

    def function(self, z: Tensor) -> Tensor:
        return z * torch.sigmoid(2.0 * _RATE * (z + _CUBIC * z**3))

    def slope(self, z: Tensor) -> Tensor:
        inner = 2.0 * _RATE * (z + _CUBIC * z**3)
        gate = torch.sigmoid(inner)
        return gate + z * gate * torch.sigmoid(-inner) * 2.0 * _RATE * (1.0 + 3.0 * _CUBIC * z.square())


@dataclass(frozen=True, eq=False)
class Mish(_Gated):
    """``z tanh(log(1 + exp(z)))``."""

    @property
    def breaks(self) -> tuple[float, ...]:
        return _MISH

    def function(self, z: Tensor) -> Tensor:
        return z * torch.tanh(torch.logaddexp(z, torch.zeros_like(z)))

    def slope(self, z: Tensor) -> Tensor:
        gate = torch.tanh(torch.logaddexp(z, torch.zeros_like(z)))
        return gate + z * (1.0 - gate.square()) * torch.sigmoid(z)
