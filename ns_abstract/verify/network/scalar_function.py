"""One relaxation for all functions of one number, and their tangents (docs/dev/design.md, N10, N14).

The interval is cut at evenly spaced points and where the function's curvature changes, so that every piece has one
curvature. A line with any slope becomes sound by the extreme distance of the function from it: on a piece, the ends are
extreme on one side, and the two tangents at the ends bound the other. The slope is that of the concave (or convex)
envelope at the middle, where a line's height is its area.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import OWN_FUNCTION
from ns_abstract.verify.network.layers import Activation, LinearRelaxation

#: Intervals worked on at a time.
_TOGETHER = 1 << 13

#: Even parts of an interval where a function bends.
_PARTS = 16

#: Steps towards the best slope; any slope is sound.
_STEPS = 6

#: A preference: better bounds of the input are asked for where the lines are this part of the width apart.
_APART = 2.0**-6

#: Halvings of where a tangent may touch; what is off costs its square.
_HALVINGS = 20

#: A preference: intervals of at most this part of their ends count as points.
_POINT = 2.0**-36


class _SampledFunction(NamedTuple):
    """Samples z, value, slope [K, ...] of a function at ascending points.

    ``bend`` [K - 1, ...] is 1 where the function is convex between points, 0 straight, -1 concave; ``size`` is the
    magnitude for rounding.
    """

    z: Tensor
    value: Tensor
    slope: Tensor
    bend: Tensor
    size: Tensor


@dataclass(frozen=True, eq=False)
class ScalarFunction(Activation):
    """An activation that is convex, concave or linear piece by piece."""

    #: Where the curvature changes, growing; kinks and poles are such.
    breaks: ClassVar[tuple[float, ...]] = ()
    #: Curvature before, between and behind the breaks: 1 convex, 0 straight, -1 concave.
    bends: ClassVar[tuple[int, ...]]
    #: What the error of a computed slope is relative to, beside the slope.
    slope_scale: ClassVar[float] = 1.0

    def slope(self, z: Tensor) -> Tensor:
        """Return the derivative on curved pieces."""
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
        """Return a bound of ``f(z) - line z`` below (``side`` -1) or above (1)."""
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
        """Return the slope at the middle of the envelope above (``side`` 1) or below (-1), by Newton's method."""
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
        """Return the interval intersected with the function's domain."""
        return lower, upper

    def straight(self, z: Tensor) -> Tensor:
        """Return the slope at ``z`` of a function without curved pieces."""
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
        """Return the relaxations ``work`` of many intervals in cache-sized batches, or the lines of linear pieces."""
        low, high = lower.reshape(-1), upper.reshape(-1)
        if any(self.bends):
            parts = [work(*ends) for ends in zip(low.split(_TOGETHER), high.split(_TOGETHER), strict=True)]
            results = [torch.cat(v) for v in zip(*parts, strict=True)]
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
            for whole, own in zip(results, work(low[part], high[part]), strict=True):
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
                exists = tangents.known & torch.isfinite(exact[1])
                slope, offset = (torch.where(exists, *pair) for pair in zip(exact, (slope, offset), strict=True))
            lines += [slope, offset]
        return LinearRelaxation(*lines)

    def _band(self, lower: Tensor, upper: Tensor) -> LinearRelaxation:
        cuts = self._cuts(*self._inside(lower, upper))
        width = cuts.z[-1] - cuts.z[0]
        slope = torch.where(width > 0.0, (cuts.value[-1] - cuts.value[0]) / width, torch.zeros_like(width))
        slope = torch.where(torch.isfinite(slope), slope, torch.zeros_like(slope))
        return LinearRelaxation(slope, self._extreme(cuts, slope, -1.0), slope, self._extreme(cuts, slope, 1.0))

    def _level(self, lower: Tensor, upper: Tensor) -> LinearRelaxation:
        """Return constant lines."""
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


@dataclass(frozen=True)
class Tangents:
    """Tangents of a function below (``side`` -1) or above (1) it, which touch a piece of the interval curved that way.

    A tangent is on its side of the piece that it touches. If no other piece is curved that way, the function less the
    line is extreme at an end of a piece, wherever the line touches; its offset is taken from there if that is farther
    out.

    Attributes:
        curve, side: The function, and the side of the lines.
        first, last: [...] points between which tangents are sound without a shift; ``first > last`` or NaN: none.
        lower, upper: [...] the interval.
        corners, values: [E, ...] ends of all pieces, and the function there.
    """

    curve: ScalarFunction
    side: float
    first: Tensor
    last: Tensor
    lower: Tensor
    upper: Tensor
    corners: Tensor
    values: Tensor

    @staticmethod
    def of(curve: ScalarFunction, lower: Tensor, upper: Tensor, side: float) -> Tangents:
        """Return the tangents over [lower, upper]."""
        edges = [lower, *(torch.clamp(lower.new_tensor(b), lower, upper) for b in curve.breaks), upper]
        first, last = torch.full_like(lower, math.nan), torch.full_like(lower, math.nan)
        parts = torch.zeros_like(lower)
        for before, after, bend in zip(edges[:-1], edges[1:], curve.bends, strict=True):
            if bend == -side:
                here = after > before
                first, last = torch.where(here, before, first), torch.where(here, after, last)
                parts = parts + here
        first = torch.where(parts == 1.0, first, math.nan)
        corners = torch.stack([edges[0], edges[-1], *edges[1:-1]])
        tangents = Tangents(curve, side, first, last, lower, upper, corners, curve.function(corners))
        # functions without such parts may have no slope
        return tangents._narrowed() if -side in curve.bends else tangents

    def _narrowed(self) -> Tangents:
        """Return the tangents with first and last points at which the interval's ends are on the right side."""
        points = []
        for start, stop, end, value in (
            (self.first, self.last, self.lower, self.values[0]),
            (self.last, self.first, self.upper, self.values[1]),
        ):
            wrong = ~self._clear(start, end, value)
            point = start.clone()
            at = wrong & ~start.isnan()
            if bool(at.any()):
                failing, holding, end, value = start[at], stop[at], end[at], value[at]
                none = ~self._clear(holding, end, value)
                for _ in range(_HALVINGS):
                    middle = 0.5 * (failing + holding)
                    fine = self._clear(middle, end, value)
                    failing, holding = torch.where(fine, failing, middle), torch.where(fine, middle, holding)
                point[at] = torch.where(none, math.nan, holding)
            points.append(point)
        return replace(self, first=points[0], last=points[1])

    def _clear(self, t: Tensor, end: Tensor, value: Tensor) -> Tensor:
        """Return whether the tangent at ``t`` is on its side of the function at an end of the interval."""
        return self.side * (self.curve.function(t) + self.curve.slope(t) * (end - t) - value) >= 0.0

    @property
    def known(self) -> Tensor:
        """Whether there are tangents, [...]."""
        return self.first <= self.last

    def __getitem__(self, at: Tensor) -> Tangents:
        """Return the tangents of the intervals numbered ``at``, flattened."""
        parts = (self.first[at], self.last[at], self.lower[at], self.upper[at])
        return Tangents(self.curve, self.side, *parts, self.corners[:, at], self.values[:, at])

    def line(self, t: Tensor, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
        """Return slope (a number of ``dtype`` in float64) and offset of the line touching at or near ``t`` [..., *U].

        It is sound for any t of the piece that is curved towards the side.
        """
        value, tangent = self.curve.function(t), self.curve.slope(t)
        slope = tangent.to(dtype).double()
        width = self.upper - self.lower
        touch = self.side * (value - slope * t) + (slope - tangent).abs() * width
        for corner, height in zip(self.corners, self.values, strict=True):
            touch = torch.maximum(touch, self.side * (height - slope * corner))
        far = torch.maximum(self.lower.abs(), self.upper.abs())
        size = self.values.abs().amax(0) + value.abs() + (slope.abs() + self.curve.slope_scale) * width + OWN_FUNCTION
        return slope, self.side * (touch + OWN_FUNCTION * (size + slope.abs() * far))


def _size(lower: Tensor, upper: Tensor) -> Tensor:
    return torch.maximum(lower.abs(), upper.abs())
