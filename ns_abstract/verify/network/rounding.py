"""Rounding errors of float32 evaluations and of the backward pass (docs/dev/design.md, N2, N20-N22)."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import (
    FLUSH,
    FLUSHES,
    FOLDED_SHIFT,
    FOLDING,
    MAGNITUDES_UP,
    OVERFLOW,
    PRODUCTS,
    UP,
    gamma,
)
from ns_abstract.verify.network.forms import NodeForm
from ns_abstract.verify.network.graph import Network
from ns_abstract.verify.network.layers import LinearLayer, ScaleLayer, Sum, Weighted
from ns_abstract.verify.network.max_pooling import MaxPool
from ns_abstract.verify.network.sparse_layers import Variance

#: A preference: sums of fewer additions gain too little by their partial sums to pay for them.
_LONG = 256


def outward(value: Tensor, side: float) -> Tensor:
    """Return the float32 neighbour on one side, at least half a unit away; zero stays."""
    near = value.float()
    return torch.where(value == 0.0, near, torch.nextafter(near, torch.full_like(near, side * torch.inf)))


def partial_sums(count: Tensor | int, peak: Tensor, squares: Tensor, end: Tensor) -> Tensor:
    """Return an upper bound of the sum of magnitudes of all partial sums of ``count`` additions, in any order (N20).

    ``peak``: upper bound of the sum of the positive numbers and of that of the negative ones, in magnitude;
    ``squares``: the same of their squares; ``end``: upper bound of the whole sum's magnitude.
    """
    number = torch.as_tensor(count, dtype=torch.float64)
    root = squares.sqrt() * UP

    def largest(leaves: Tensor) -> Tensor:
        """Return a bound of the sum, over n up to ``leaves``, of the magnitude of n numbers of one sign together."""
        # for small n by the sum of squares (Cauchy-Schwarz), else by the sum of all
        few = torch.minimum(leaves, (peak / root).square().nan_to_num(nan=0.0, posinf=0.0).floor())
        return (2.0 / 3.0 * few * few.sqrt() + few.sqrt()) * root + (leaves - few) * peak

    half = (0.5 * (number + 1.0)).ceil()
    least = torch.minimum(largest(number + 1.0), 2.0 * largest(half) + peak + half * end)
    return torch.minimum(number * peak, least * UP)


class RegroupedSizes(NamedTuple):
    """Upper bounds [m] or [1] of magnitudes in programs that regroup the factors applied before a node (N21).

    ``scales``: for factors since the last activation or layer that mixes neurons; ``sums``: for earlier ones.
    """

    scales: Tensor
    sums: Tensor


class Rounding:
    """Bounds the float32 rounding errors of a network's linear layers."""

    def __init__(self, network: Network) -> None:
        self.network = network
        #: by node: roundings of its sums
        self.terms: dict[int, Tensor | int] = {}
        #: by linear node and product
        self.regrouped: dict[int, RegroupedSizes] = {}
        #: by node, where a program may fold shifts into the next layer: their sizes together, one item (N21)
        self.shifts: dict[int, Tensor] = {}

    def regrouped_sizes(
        self, k: int, sources: tuple[int, ...], layer: LinearLayer, sizes: list[Tensor]
    ) -> RegroupedSizes:
        """Return `RegroupedSizes` of linear node k for inputs up to ``sizes`` [m or 1, *input_shapes[i]]; cached."""
        most = [size.flatten(1).amax(1) for size in sizes]
        before = [self._before(i, size) for i, size in zip(sources, most, strict=True)]
        scales = sum(e.scales + size + 1.0 for e, size in zip(before, most, strict=True))
        sums = sum(e.sums for e in before)
        assert isinstance(scales, Tensor) and isinstance(sums, Tensor)
        if isinstance(layer, Variance):
            # one pass sums the squares of the numbers themselves
            scales = torch.maximum(most[0], most[1].square()) + 1.0
        if layer.mixes and not isinstance(layer, Sum):
            scales, sums = torch.zeros_like(scales), layer.gain * scales
        else:
            scales, sums = layer.gain * scales, layer.gain * sums
        offset = 0.0 if layer.bias is None else float(layer.bias.abs().max())
        regrouped = self.regrouped[k] = RegroupedSizes(scales + offset, sums + offset)
        return regrouped

    def regrouped_product(self, k: int, sources: tuple[int, ...], sizes: list[Tensor]) -> RegroupedSizes:
        """Return `RegroupedSizes` of product node k: the scales of either factor may move to the other (N21)."""
        most = [size.flatten(1).amax(1) for size in sizes]
        one, two = (self._before(i, size) for i, size in zip(sources, most, strict=True))
        scales = (one.scales + most[0] + 1.0) * (two.scales + most[1] + 1.0)
        sums = one.sums * (two.scales + most[1] + 1.0) + two.sums * (one.scales + most[0] + 1.0)
        regrouped = self.regrouped[k] = RegroupedSizes(scales, sums)
        return regrouped

    def _before(self, index: int, like: Tensor) -> RegroupedSizes:
        """Return `RegroupedSizes` of a node's input; positive scales pass through maxima."""
        while index and isinstance(self.network.nodes[index - 1].layer, MaxPool):
            index = self.network.nodes[index - 1].inputs[0]
        zero = torch.zeros_like(like)
        return self.regrouped.get(index, RegroupedSizes(zero, zero))

    @staticmethod
    def bounded(regrouped: RegroupedSizes) -> Tensor:
        """Return whether no grouping overflows, [m or 1] (N22)."""
        return regrouped.scales + regrouped.sums < OVERFLOW

    @staticmethod
    def flushed(regrouped: RegroupedSizes, layer: LinearLayer) -> Tensor:
        """Return an upper bound [m or 1, 1, ...] of the error by flushing to zero, over all groupings (N21)."""
        lost = FLUSHES * FLUSH * (regrouped.scales + regrouped.sums + layer.gain + 1.0) * MAGNITUDES_UP
        return lost.reshape(-1, *[1] * len(layer.shape))

    def shifted(self, k: int, sources: tuple[int, ...], layer: LinearLayer) -> Tensor | float:
        """Return the further error of node k, one item, if shifts before it are folded into its sums (N21)."""
        input_shifts = [self.shifts.get(i) for i in sources]
        if isinstance(layer, ScaleLayer):
            carried = 0.0 if input_shifts[0] is None else input_shifts[0] * layer.factor.abs()
            own = 0.0 if layer.offset is None else layer.offset.abs()
            if input_shifts[0] is not None or layer.offset is not None:
                self.shifts[k] = torch.as_tensor(carried + own).expand(layer.shape)
            return 0.0
        if all(shift is None for shift in input_shifts):
            return 0.0
        shapes = layer.input_shapes
        parts = [
            torch.zeros((1, *shape), dtype=torch.float64) if shift is None else shift[None].contiguous()
            for shift, shape in zip(input_shifts, shapes, strict=True)
        ]
        moved = layer.magnitude(parts)[0] * MAGNITUDES_UP
        if not isinstance(layer, Weighted):
            if not layer.mixes or isinstance(layer, Sum):
                self.shifts[k] = moved
            return 0.0
        bias = 0.0 if layer.bias is None else layer.bias.abs()
        return gamma(layer.terms + FOLDING + 1) * (FOLDED_SHIFT * moved + bias)

    def charge(
        self,
        k: int,
        sources: tuple[int, ...],
        layer: LinearLayer,
        inputs: list[NodeForm],
        size: Tensor,
        end: Callable[[], Tensor],
    ) -> Tensor:
        """Return an upper bound [m, *shape] of the error of a layer's float32 evaluation.

        ``size`` = |W| |x| + |bias|; ``end`` returns upper bounds of its values' magnitudes (N2, N20).
        """
        count = self.terms[k] = self._rounding_count(sources, layer, inputs)
        folding = FOLDING if k in self.network.scaled else 0
        few = gamma(folding + PRODUCTS + len(inputs)) * size
        few = few + (shifts := self.shifted(k, sources, layer))
        if isinstance(layer, ScaleLayer):
            # sums before it may start with the offset
            first = torch.zeros(()) if layer.bias is None else layer.bias.abs()
            return gamma(count) * first * (1.0 + gamma(count + FOLDING)) + few
        if isinstance(layer, Sum):
            # the sum of one input may start with the others
            charges = []
            for i, f in zip(sources, inputs, strict=True):
                others = size - f.interval.size * (2.0 - UP)
                own = torch.as_tensor(self.terms.get(i, 0), dtype=torch.float64)
                charges.append(gamma(own) * others * (1.0 + gamma(own + FOLDING)))
            return few + (torch.maximum(*charges) if len(charges) == 2 else sum(charges))
        if not isinstance(layer, Weighted):
            return gamma(count + FOLDING) * size + shifts
        # partial sums are no larger than the positive products together, or the negative ones
        above, below = inputs[0].interval.upper.clamp(min=0.0), inputs[0].interval.lower.clamp(max=0.0)
        balance = layer([above + below])
        peak = 0.5 * (size + balance.abs()) * UP
        if float(torch.as_tensor(count).max()) < _LONG:
            return gamma(count) * (peak + gamma(count + FOLDING + 1) * size) + few
        squared = layer.squared
        whole = squared.magnitude([above.square() + below.square()])
        if squared.bias is not None:
            whole = whole + squared.bias.abs()
        squares = 0.5 * (whole + squared([above.square() - below.square()]).abs()) * MAGNITUDES_UP
        together = partial_sums(count, peak, squares, end())
        return gamma(1) * (together + count * gamma(count + FOLDING + 1) * size) + few

    def _rounding_count(self, sources: tuple[int, ...], layer: LinearLayer, inputs: list[NodeForm]) -> Tensor | int:
        """Return the largest number of roundings in one sum of the layer (N2).

        A program may fold a scale or a sum of branches into the sums before it, so these count with it.
        """
        if not isinstance(layer, (ScaleLayer, Sum)):
            return layer.roundings([f.active for f in inputs])
        before = [self.network.nodes[i - 1].layer for i in sources if i]
        most = max((b.terms for b in before if isinstance(b, LinearLayer)), default=0)
        counts = [torch.as_tensor(self.terms[i], dtype=torch.float64) for i in sources if i in self.terms]
        count = torch.as_tensor(float(layer.terms - most), dtype=torch.float64)
        return count + functools.reduce(torch.maximum, counts) if counts else count
