"""What float32 evaluations of a network and rows may be off (docs/design.md, N2, N20)."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ns_abstract.verify.network.forms import Form
from ns_abstract.verify.network.graph import Network
from ns_abstract.verify.network.layers import Linear, Scale, Sum, Weighted
from ns_abstract.verify.network.sums import partial_sums

#: Unit roundoff of float32: of the bounded evaluation, and of most rows.
UNIT = 2.0**-24
#: Unit roundoff of float64: of sums of offsets, and of rows of outputs in real arithmetic.
DOUBLE_UNIT = 2.0**-53
#: Roundings of rows beside those of their sums: stored weights and slopes, products with them.
SPARE = 24
#: Smallest normal number of float32: what a flush to zero may lose.
FLUSH = 2.0**-126
#: Past this a float32 evaluation may overflow.
OVERFLOW = 2.0**126
#: Roundings of the network beside those of a layer's sums: a batch normalisation's factor (sum, root, quotient),
#: its product with a weight, and as many again.
_FOLDING = 8
#: Sums of fewer additions gain too little by their partial sums to pay for them.
_LONG = 256


def gamma(count: Any, unit: float | None = None) -> Any:
    """What ``count`` roundings, in float32 unless said otherwise, may change, relatively."""
    unit = UNIT if unit is None else unit
    return count * unit / (1.0 - count * unit)


def outward(value: Tensor, side: float) -> Tensor:
    """The float32 neighbour on one side, half a unit away at least; zero stays."""
    near = value.float()
    return torch.where(value == 0.0, near, torch.nextafter(near, torch.full_like(near, side * torch.inf)))


class Rounding:
    """What float32 evaluations of a network's linear layers may be off."""

    def __init__(self, network: Network) -> None:
        self.network = network
        #: by node: roundings of its sums
        self.terms: dict[int, Tensor | int] = {}

    def charge(
        self,
        k: int,
        sources: tuple[int, ...],
        layer: Linear,
        inputs: list[Form],
        size: Tensor,
        end: Callable[[], Tensor],
    ) -> Tensor:
        """What a float32 evaluation of a layer may be off, [m, *shape].

        ``size`` = |W| |x| + |bias|; ``end``: what its values are at most (N2, N20).
        """
        count = self.terms[k] = self._count(sources, layer, inputs)
        folding = _FOLDING if k in self.network.scaled else 0
        few = gamma(folding + 3 + len(inputs)) * size
        if isinstance(layer, Scale):
            # sums before it may start with the offset
            first = torch.zeros(()) if layer.bias is None else layer.bias.abs()
            return gamma(count) * first * (1.0 + gamma(count + _FOLDING)) + few
        if isinstance(layer, Sum):
            # the sum of one input may start with the others
            charges = []
            for i, f in zip(sources, inputs, strict=True):
                others = size - f.interval.size * (1.0 - 2.0**-40)
                own = torch.as_tensor(self.terms.get(i, 0), dtype=torch.float64)
                charges.append(gamma(own) * others * (1.0 + gamma(own + _FOLDING)))
            return few + (torch.maximum(*charges) if len(charges) == 2 else sum(charges))
        if not isinstance(layer, Weighted):
            return gamma(count + _FOLDING) * size
        # partial sums are no larger than the positive products together, or the negative ones
        above, below = inputs[0].interval.upper.clamp(min=0.0), inputs[0].interval.lower.clamp(max=0.0)
        balance = layer([above + below])
        peak = 0.5 * (size + balance.abs()) * (1.0 + 2.0**-40)
        if float(torch.as_tensor(count).max()) < _LONG:
            return gamma(count) * (peak + gamma(count + _FOLDING + 1) * size) + few
        squared = layer.squared
        whole = squared.magnitude([above.square() + below.square()])
        if squared.bias is not None:
            whole = whole + squared.bias.abs()
        squares = 0.5 * (whole + squared([above.square() - below.square()]).abs()) * (1.0 + 2.0**-36)
        together = partial_sums(count, peak, squares, end())
        return gamma(1) * (together + count * gamma(count + _FOLDING + 1) * size) + few

    def _count(self, sources: tuple[int, ...], layer: Linear, inputs: list[Form]) -> Tensor | int:
        """Roundings that a layer's sums may suffer; what is added behind sums may be added within them (N2)."""
        if not isinstance(layer, (Scale, Sum)):
            return layer.roundings([f.active for f in inputs])
        before = [self.network.nodes[i - 1].layer for i in sources if i]
        most = max((b.terms for b in before if isinstance(b, Linear)), default=0)
        counts = [torch.as_tensor(self.terms[i], dtype=torch.float64) for i in sources if i in self.terms]
        found = torch.as_tensor(float(layer.terms - most), dtype=torch.float64)
        return found + functools.reduce(torch.maximum, counts) if counts else found
