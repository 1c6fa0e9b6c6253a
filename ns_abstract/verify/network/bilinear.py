"""Products of two values that both depend on the image, relaxed by McCormick planes (docs/dev/design.md, N9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import OWN_FUNCTION, OWN_LINE
from ns_abstract.verify.network.forms import NodeInterval
from ns_abstract.verify.network.layers import Shape

#: A preference: both factors must move by more than this of their sizes to be worth better bounds.
_MOVES = 2.0**-7


@dataclass(frozen=True)
class ProductPlanes:
    """Planes ``low <= x y - first x - second y <= high``; all [m, *shape] float64, slopes are float32 numbers."""

    first: Tensor
    second: Tensor
    low: Tensor
    high: Tensor


@dataclass(frozen=True, eq=False)
class Product:
    """The elementwise product ``x y``; ``shape`` is one item of each factor and of the result."""

    shape: Shape
    mixes: ClassVar[bool] = True

    def __call__(self, inputs: Sequence[Tensor]) -> Tensor:
        return inputs[0] * inputs[1]

    def unstable(self, x: NodeInterval, y: NodeInterval) -> Tensor:
        """Return where tighter bounds of the factors would tighten the planes."""
        return (x.upper - x.lower > _MOVES * x.size) & (y.upper - y.lower > _MOVES * y.size)

    def relaxation_gap(self, x: NodeInterval, y: NodeInterval) -> Tensor:
        """Return the distance of the planes as a fraction of the product's motion along them."""
        plane = self.plane(x, y)
        moves = plane.first.abs() * (x.upper - x.lower) + plane.second.abs() * (y.upper - y.lower)
        moves = moves.clamp(min=2.0**-1000)
        # rounding alone keeps the planes of points apart
        return (plane.high - plane.low - OWN_FUNCTION * (x.size * y.size)).clamp(min=0.0) / moves

    def plane(self, x: NodeInterval, y: NodeInterval) -> ProductPlanes:
        """Return the mean of McCormick's planes; any slopes do, as ``x y - a x - b y`` is extreme at corners."""
        first = (0.5 * (y.lower + y.upper)).float().double()
        second = (0.5 * (x.lower + x.upper)).float().double()
        corners = torch.stack([u * v - first * u - second * v for u in (x.lower, x.upper) for v in (y.lower, y.upper)])
        # three products and two sums at each corner
        room = OWN_LINE * (x.size * y.size + first.abs() * x.size + second.abs() * y.size)
        return ProductPlanes(first, second, corners.amin(0) - room, corners.amax(0) + room)
