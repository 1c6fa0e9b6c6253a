"""Tangents that lie on one side of a function over an interval (docs/dev/design.md, N10, N14)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import OWN_FUNCTION

#: Halvings of where a tangent may touch; what is off costs its square.
_HALVINGS = 20


class Curve(Protocol):
    """A function of one number that is convex, concave or straight between known points."""

    @property
    def breaks(self) -> Sequence[float]:
        """Where the curvature changes, growing."""
        ...

    @property
    def bends(self) -> Sequence[int]:
        """Curvature before, between and behind the breaks."""
        ...

    #: What the error of a computed slope is relative to, beside the slope.
    slope_scale: ClassVar[float]

    def function(self, z: Tensor) -> Tensor:
        """The value."""
        ...

    def slope(self, z: Tensor) -> Tensor:
        """The derivative on curved parts."""
        ...


@dataclass(frozen=True)
class Tangents:
    """Tangents of a curve, below (``side`` -1) or above (1), that touch a part of the interval that bends that way.

    A tangent is on its side of the part that it touches. If no other part bends that way, the function less the line
    is most extreme at an end of those, wherever it touches; its offset is taken from there where that is farther out.

    Attributes:
        curve, side: The function, and on which side of it the lines are.
        first, last: [...] points between which tangents are on that side as they are; ``first > last`` or NaN: none.
        lower, upper: [...] the interval.
        corners, values: [E, ...] ends of all parts, and the function there.
    """

    curve: Curve
    side: float
    first: Tensor
    last: Tensor
    lower: Tensor
    upper: Tensor
    corners: Tensor
    values: Tensor

    @staticmethod
    def of(curve: Curve, lower: Tensor, upper: Tensor, side: float) -> Tangents:
        """The tangents over [lower, upper]."""
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
        """With first and last points from which the interval's ends are on the right side."""
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
        """Whether the tangent at ``t`` is on its side of the function at an end."""
        return self.side * (self.curve.function(t) + self.curve.slope(t) * (end - t) - value) >= 0.0

    @property
    def known(self) -> Tensor:
        """[...] whether there are tangents."""
        return self.first <= self.last

    def __getitem__(self, at: Tensor) -> Tangents:
        """Those of some intervals, in one row."""
        parts = (self.first[at], self.last[at], self.lower[at], self.upper[at])
        return Tangents(self.curve, self.side, *parts, self.corners[:, at], self.values[:, at])

    def line(self, t: Tensor, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
        """Slope, a number of ``dtype`` in float64, and offset of the line that touches at or near ``t`` [..., *U].

        Sound for any t of the part that bends towards the side.
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
