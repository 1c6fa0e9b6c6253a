"""Products of two values that both depend on the image: McCormick's planes (docs/dev/design.md, N9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import OWN_FUNCTION, OWN_LINE
from ns_abstract.verify.network.layers import Shape

#: A preference: both factors must move by more than this of their sizes to be worth better bounds.
_MOVES = 2.0**-7


class IntervalLike(Protocol):
    """Bounds of a node's values, [m, *shape] each."""

    @property
    def lower(self) -> Tensor:
        """Least values."""
        ...

    @property
    def upper(self) -> Tensor:
        """Largest values."""
        ...


@dataclass(frozen=True)
class ProductPlanes:
    """``low <= x y - first x - second y <= high``; all [m, *shape] float64, slopes are float32 numbers."""

    first: Tensor
    second: Tensor
    low: Tensor
    high: Tensor


@dataclass(frozen=True, eq=False)
class Product:
    """``x y`` number by number; ``shape`` is one item of both factors and of the result."""

    shape: Shape
    mixes: ClassVar[bool] = True

    def __call__(self, inputs: Sequence[Tensor]) -> Tensor:
        return inputs[0] * inputs[1]

    def unstable(self, x: IntervalLike, y: IntervalLike) -> Tensor:
        """Where better bounds of the factors would give a better plane."""
        widths, sizes = [], []
        for f in (x, y):
            widths.append(f.upper - f.lower)
            sizes.append(torch.maximum(f.lower.abs(), f.upper.abs()))
        return (widths[0] > _MOVES * sizes[0]) & (widths[1] > _MOVES * sizes[1])

    def relaxation_gap(self, x: IntervalLike, y: IntervalLike) -> Tensor:
        """How far the planes are apart, as a part of what the product moves along them."""
        plane = self.plane(x, y)
        moves = plane.first.abs() * (x.upper - x.lower) + plane.second.abs() * (y.upper - y.lower)
        moves = moves.clamp(min=2.0**-1000)
        # rounding alone keeps the planes of points apart
        return (plane.high - plane.low - OWN_FUNCTION * self._sizes(x, y)).clamp(min=0.0) / moves

    def _sizes(self, x: IntervalLike, y: IntervalLike) -> Tensor:
        return torch.maximum(x.lower.abs(), x.upper.abs()) * torch.maximum(y.lower.abs(), y.upper.abs())

    def plane(self, x: IntervalLike, y: IntervalLike) -> ProductPlanes:
        """The planes half way between McCormick's: any slopes do, as ``x y - a x - b y`` is extreme at corners."""
        first = (0.5 * (y.lower + y.upper)).float().double()
        second = (0.5 * (x.lower + x.upper)).float().double()
        corners = torch.stack([u * v - first * u - second * v for u in (x.lower, x.upper) for v in (y.lower, y.upper)])
        sizes = [torch.maximum(f.lower.abs(), f.upper.abs()) for f in (x, y)]
        # three products and two sums at each corner
        room = OWN_LINE * (sizes[0] * sizes[1] + first.abs() * sizes[0] + second.abs() * sizes[1])
        return ProductPlanes(first, second, corners.amin(0) - room, corners.amax(0) + room)
