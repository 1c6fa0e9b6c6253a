"""Backward coefficients of one cell, reused to bound others (docs/dev/design.md, N15)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ns_abstract.arithmetic.network_charges import FLUSH, OWN_SUMS, gamma
from ns_abstract.verify.network.bilinear import Product
from ns_abstract.verify.network.bounds import NetworkBounds, bound_outputs
from ns_abstract.verify.network.coefficient_source import CoefficientSource
from ns_abstract.verify.network.coefficients import Float64, Int64, grid
from ns_abstract.verify.network.forms import NodeForm
from ns_abstract.verify.network.graph import Network, NetworkArithmetic
from ns_abstract.verify.network.image_sets import ImageSets, OutputBounds
from ns_abstract.verify.network.layers import Activation, LeakyRelu
from ns_abstract.verify.network.max_pooling import MaxPool
from ns_abstract.verify.network.stopping import BackwardTrace
from ns_abstract.verify.network.subnormals import subnormals_kept

#: Largest images whose coefficients are stored, as rounding of their sums must stay small; largest networks (neurons)
#: whose coefficients are stored at every node; bytes of coefficients that are passed back together.
_MOST_NUMBERS, _MOST_TRACED, _TOGETHER = 1 << 19, 1 << 16, 16 << 20
#: Preference: share of the memory for stored coefficients.
_ROWS_SHARE = 0.25
#: Preference: rows that are multiplied at a time; their absolute values should stay in a processor's cache.
_ROWS_AT_ONCE = 256
#: Preference: the first cell also refines neurons that miss being unstable by this fraction of their width.
_NEARLY = 0.25


def reusable_anywhere(network: Network) -> bool:
    """Return whether one cell's coefficients are valid for cells outside it: no maxima and products, and few."""
    local = any(isinstance(node.layer, (MaxPool, Product)) for node in network.nodes)
    return not local and network.neuron_count <= _MOST_TRACED


class SharedCoefficients:
    """Bounds one cell, and other cells with that cell's backward coefficients; ``memory``: bytes, approximately."""

    @subnormals_kept()
    def __init__(
        self, network: Network, first: ImageSets, *, memory: int = 1 << 30, arithmetic: NetworkArithmetic = "float32"
    ) -> None:
        if first.count != 1:
            raise ValueError(f"one cell expected, got {first.count}")
        self.network, self.memory = network, memory
        self.arithmetic: NetworkArithmetic = arithmetic
        self._first = _ReferenceCell(network, first, memory, arithmetic)

    @subnormals_kept()
    def first(self, rows: Any, offset: Float64) -> OutputBounds:
        """Return lower bounds of ``rows @ y + offset`` over the first cell."""
        return self._first.cells.outputs(rows, np.asarray(offset, np.float64))

    @subnormals_kept()
    def others(self, images: ImageSets, rows: Any, offset: Float64, *, fresh: bool = False) -> OutputBounds:
        """Return lower bounds of ``rows @ y + offset`` over other cells, m sets in parameters of their own.

        Their images must lie in the first cell's set, too, unless the network is `reusable_anywhere`. ``fresh``:
        unstable neurons before the last activation or product have backward passes of the cell's own.
        """
        offset = np.asarray(offset, np.float64)
        if not self._first.intermediate.usable[0]:
            return bound_outputs(self.network, images, rows, offset, memory=self.memory, arithmetic=self.arithmetic)
        by_cell = self.network.neuron_count * 8 * (3 * images.dimensions + 18)
        step = max(1, int(0.25 * self.memory) // by_cell)
        bounds = []
        for first in range(0, images.count, step):
            part = _ReusingCells(self._first, images[first : first + step], self.memory, self.arithmetic, fresh)
            bounds.append(part.cells.outputs(rows, offset))
        return OutputBounds(*(np.concatenate([getattr(part, name) for part in bounds]) for name in ("lower", "a", "b")))


@dataclass
class _StoredCoefficients:
    """Stored backward coefficients of one cell, for neurons of one node.

    Attributes:
        flat: [R] flat positions of the neurons; one may have two rows.
        sign: [R] 1, or -1 where the row is of the neuron's negative.
        by_node: By node: [R, n] float32 as in `BackwardTrace`.
        fixed: [R, 2] as in `BackwardTrace`.
    """

    flat: Int64
    sign: Float64
    by_node: dict[int, NDArray[np.float32]]
    fixed: Float64

    def joined(self, other: _StoredCoefficients) -> _StoredCoefficients:
        """Return these and another object's coefficients together."""
        rows = {}
        for at in self.by_node.keys() | other.by_node.keys():
            both = [
                stored.by_node[at] if at in stored.by_node else np.zeros((len(stored.flat), width), np.float32)
                for width in [(self.by_node if at in self.by_node else other.by_node)[at].shape[1]]
                for stored in (self, other)
            ]
            rows[at] = np.concatenate(both)
        one, two = self, other
        return _StoredCoefficients(
            np.concatenate([one.flat, two.flat]), np.concatenate([one.sign, two.sign]), rows,
            np.concatenate([one.fixed, two.fixed]),
        )  # fmt: skip


class _ReferenceCell(CoefficientSource):
    """The cell whose coefficients are stored, for neurons before activations and products."""

    def __init__(self, network: Network, images: ImageSets, memory: int, arithmetic: NetworkArithmetic) -> None:
        self.network = network
        #: by node
        self.stored: dict[int, _StoredCoefficients] = {}
        self._left = _ROWS_SHARE * memory
        size, neuron_count = images.lower.shape[1], network.neuron_count
        self._short = neuron_count > _MOST_TRACED
        self._by_row = 4 * (size if self._short else neuron_count)
        self._keeps = size <= _MOST_NUMBERS
        if self._keeps:
            self.most_rows = max(16, _TOGETHER // self._by_row)
        #: by node: the reference, and the inputs that lower planes of pooling windows follow
        self.references: dict[int, Tensor] = {}
        self.winners: dict[int, Tensor] = {}
        self.cells = NetworkBounds(network, images, memory, arithmetic, sharing=self)

    def reference(self, k: int, passed_on: Callable[[], Tensor]) -> Tensor:
        self.references[k] = passed_on()
        return self.references[k]

    def winner(self, k: int, winner: Tensor) -> Tensor:
        self.winners[k] = winner
        return winner

    def reuse_bounds(
        self, index: int, form: NodeForm, unstable: Tensor, apart: Tensor | None, layer: Activation | None
    ) -> tuple[NodeForm, Tensor, Tensor | None]:
        if isinstance(layer, LeakyRelu):
            # they may be unstable in other cells
            lower, upper = form.interval
            near = _NEARLY * (upper - lower)
            unstable = (lower < near) & (upper > -near)
        return form, unstable, apart

    def trace(self, count: int) -> BackwardTrace | None:
        return BackwardTrace(count, self._short) if self._keeps and count * self._by_row <= self._left else None

    def keep(self, index: int, where: Int64, sign: Float64, trace: BackwardTrace) -> None:
        size = sum(rows.nbytes for rows in trace.by_node.values())
        if not trace.reached.any():
            return
        self._left -= size
        flat = np.array(np.ravel_multi_index(tuple(where[:, 1:].T), grid(self.network.shape(index))), np.int64)
        stored = _StoredCoefficients(flat, np.asarray(sign, np.float64), trace.by_node, trace.fixed)
        if not trace.reached.all():
            reaching = trace.reached
            stored = _StoredCoefficients(
                flat[reaching],
                stored.sign[reaching],
                {at: rows[reaching] for at, rows in trace.by_node.items()},
                trace.fixed[reaching],
            )
        self.stored[index] = self.stored[index].joined(stored) if index in self.stored else stored


class _ReusedBounds(NamedTuple):
    """Bounds of neurons from stored coefficients: within ``half`` [m, R] of ``slopes p + middle`` about the reference.

    Slopes are [m, R, d]; ``lower`` and ``upper`` [m, R] are bounds over all p.
    """

    slopes: Float64
    middle: Float64
    half: Float64
    lower: Float64
    upper: Float64


class _ReusingCells(CoefficientSource):
    """Cells that are bounded with the stored coefficients of another cell (N15)."""

    def __init__(
        self, first: _ReferenceCell, images: ImageSets, memory: int, arithmetic: NetworkArithmetic, fresh: bool
    ) -> None:
        self.first = first
        self._last = max(first.stored, default=0) if fresh else None
        self._factors: dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}
        self._count = images.count
        self.cells = NetworkBounds(first.network, images, memory, arithmetic, sharing=self)

    def about(self, middle: Float64) -> Float64:
        # offsets that were summed at maxima and products are relative to the first cell's references
        return np.repeat(self.first.intermediate.middle, len(middle), axis=0)

    def reference(self, k: int, passed_on: Callable[[], Tensor]) -> Tensor:
        reference = self.first.references[k]
        return reference.expand(self._count, *reference.shape[1:])

    def rounding_form(self, form: NodeForm) -> NodeForm:
        # neighbours are of one size: rounding is charged by all of them at once
        ends = form.lower.amin(0, keepdim=True), form.upper.amax(0, keepdim=True)
        active = form.active.any(0, keepdim=True)
        return NodeForm(form.reference[:1], form.c[:1], form.a[:1], form.r[:1], *ends, active)

    def winner(self, k: int, winner: Tensor) -> Tensor:
        return self.first.winners[k].expand_as(winner).contiguous()

    def slopes(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        shape = self.first.network.shape(k)
        lines = self.first.intermediate.relaxations[0].lines[k]
        return lines[0, 0].reshape(shape), lines[3, 0].reshape(shape)

    def _node_factors(self, at: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return what coefficients on node ``at`` multiply [n, m k], and what their magnitudes multiply [n, m l + 1].

        Columns of one kind are adjacent. On the image, coefficients multiply slopes [d], the planes' middle and the
        interval's middle; magnitudes half the distances of planes and of the interval's ends. At activations both
        multiply slopes [d], middle and half-width; at linear layers magnitudes multiply the rounding. Magnitudes'
        last column is the largest sum of all terms' sizes, for rounding.
        """
        if at not in self._factors:
            intermediate = self.intermediate
            m, d = intermediate.count, intermediate.d
            signed: list[Float64] = []
            if at == 0:
                slopes, offsets = (
                    intermediate.image.slopes.reshape(m, 2, -1, d),
                    intermediate.image.offsets.reshape(m, 2, -1),
                )
                half = 0.5 * (offsets[:, 1] - offsets[:, 0]) + 0.5 * np.abs(slopes[:, 1] - slopes[:, 0]).sum(-1)
                half = np.maximum(half, 0.0) + OWN_SUMS * (np.abs(offsets).max(1) + np.abs(slopes).max(1).sum(-1))
                low, high = intermediate.image.lower.reshape(m, -1), intermediate.image.upper.reshape(m, -1)
                box = 0.5 * (high - low) + OWN_SUMS * (np.abs(low) + np.abs(high))
                signed = [*np.moveaxis(slopes.mean(1), -1, 0), offsets.mean(1), 0.5 * (low + high)]
                sized = [half, box]
            elif at in intermediate.reused_relaxations:
                offered = intermediate.reused_relaxations[at]
                _, low, high, _, above, below = offered.lines.reshape(6, m, -1).astype(np.float64)
                one, two = np.moveaxis(offered.tilts, 2, 1)
                # a row a gathers (a + |a|) / 2 times what stands first and (a - |a|) / 2 times the other
                pairs = [*zip(one, two, strict=True), (0.5 * (low + high), 0.5 * (above + below))]
                half, least = 0.5 * (high - low), 0.5 * (above - below)
                signed = [*(0.5 * (x + y) for x, y in pairs), 0.5 * (half - least)]
                sized = [*(0.5 * (x - y) for x, y in pairs), 0.5 * (half + least)]
            else:
                sized = [intermediate.relaxations[0].noise[at].reshape(m, -1).numpy()]
            most = np.sum([np.abs(v) for v in (*signed, *sized)], axis=0).max(axis=0)
            n = len(most)
            one, two = (np.reshape(v, (-1, n)).T for v in (signed, sized))
            two = np.concatenate([two, most[:, None]], axis=1)
            self._factors[at] = one.astype(np.float32, order="C"), two.astype(np.float32, order="C")
        return self._factors[at]

    def _stored_bounds(self, index: int) -> _ReusedBounds:
        """Return bounds of node ``index`` in these cells by the first cell's stored coefficients."""
        intermediate = self.intermediate
        m, d = intermediate.count, intermediate.d
        stored = self.first.stored[index]
        count = len(stored.flat)
        # bounds by intervals have no slopes but those between an activation's two offsets
        signed, tilted = np.zeros((count, d + 2, m)), np.zeros((count, d + 1, m))
        half, spread, lost = np.zeros((count, 2, m)), np.zeros((count, m)), np.zeros((count, m))
        for at, rows in stored.by_node.items():
            n = rows.shape[1]
            loses = gamma(n + 4)
            one, two = self._node_factors(at)
            tiny = n * FLUSH * (1.0 + float(np.abs(rows).max(initial=0.0)))
            for first in range(0, count, _ROWS_AT_ONCE):
                part, here = rows[first : first + _ROWS_AT_ONCE], slice(first, first + _ROWS_AT_ONCE)
                sums, sizes = part @ one, np.abs(part) @ two
                most, sizes = sizes[:, -1:], sizes[:, :-1].reshape(len(part), -1, m)
                sums = sums.reshape(len(part), -1, m)
                if at == 0:
                    signed[here] += sums
                    half[here] += sizes
                elif at in intermediate.reused_relaxations:
                    tilted[here] += sums[:, :-1]
                    tilted[here] += sizes[:, :-1]
                    spread[here] += sums[:, -1]
                    spread[here] += sizes[:, -1]
                else:
                    spread[here] += sizes[:, 0]
                # rounding of float32 sums is relative to the sizes of the products
                lost[here] += loses / (1.0 - loses) * most
                lost[here] += tiny * (d + 5)
        signed, tilted, half = (np.moveaxis(v, (1, 2), (0, 1)) for v in (signed, tilted, half))
        spread, lost = spread.T, lost.T
        tilts, gathered = tilted[:d], tilted[d]
        slopes, middle, moved = signed[:d] + tilts, signed[d] + gathered, signed[d + 1] + gathered
        low, high = stored.fixed.T
        if intermediate.rounds(index):
            # rounding of the node itself
            lost += intermediate.relaxations[0].noise[index].reshape(m, -1).numpy()[:, stored.flat]
        spread = spread + 0.5 * (high - low) + lost + intermediate.flush[:, None]
        middle, moved = middle + 0.5 * (low + high), moved + 0.5 * (low + high)
        half, box = half[0] + spread, half[1] + spread + np.abs(tilts).sum(0)
        for width, center in ((half, middle), (box, moved)):
            width += OWN_SUMS * (np.abs(low) + np.abs(high) + np.abs(center) + np.abs(slopes).sum(0) + width + lost)
        np.maximum(half, 0.0, out=half)
        reach = half + np.abs(slopes).sum(0)
        reach += OWN_SUMS * (reach + np.abs(middle))
        lower, upper = np.maximum(middle - reach, moved - box), np.minimum(middle + reach, moved + box)
        turned = stored.sign < 0.0
        ends = np.where(turned, -upper, lower), np.where(turned, -lower, upper)
        return _ReusedBounds(np.moveaxis(slopes, 0, -1) * stored.sign[:, None], middle * stored.sign, half, *ends)

    def reuse_bounds(
        self, index: int, form: NodeForm, unstable: Tensor, apart: Tensor | None, layer: Activation | None
    ) -> tuple[NodeForm, Tensor, Tensor | None]:
        form = self._narrowed(index, form)
        if layer is not None:
            unstable, apart = layer.unstable(*form.interval), layer.relaxation_gap(*form.interval)
        if index in self.first.stored and index != self._last:
            # neurons without stored coefficients get passes of their own
            bounded = torch.zeros(form.reference[0].numel(), dtype=torch.bool)
            bounded[torch.from_numpy(self.first.stored[index].flat)] = True
            unstable, apart = unstable & ~bounded.reshape(form.reference.shape[1:]), None
        return form, unstable, apart

    def _narrowed(self, index: int, form: NodeForm) -> NodeForm:
        """Return the form intersected with the bounds by the first cell's stored coefficients."""
        if index not in self.first.stored:
            return form
        flat, sign = self.first.stored[index].flat, self.first.stored[index].sign
        slopes, middle, half, least, most = self._stored_bounds(index)
        m, d, shape = self.intermediate.count, self.intermediate.d, form.reference.shape
        lower, upper, c, r = (np.array(v.reshape(m, -1).numpy()) for v in (form.lower, form.upper, form.c, form.r))
        a = np.array(form.a.reshape(m, d, -1).numpy())
        order = np.argsort(flat, kind="stable")
        twice = flat[order[1:]] == flat[order[:-1]]
        one, two = order[:-1][twice], order[1:][twice]
        below, above = np.where(sign[one] > 0.0, one, two), np.where(sign[one] > 0.0, two, one)
        unpaired = np.setdiff1d(np.arange(len(flat)), np.concatenate([one, two]))
        low, high = middle - half, middle + half
        # each row is best on one side
        for first, other in ((unpaired, unpaired), (below, above)):
            at, apart = flat[first], slopes[:, other] - slopes[:, first]
            center, tilt = 0.5 * (low[:, first] + high[:, other]), 0.5 * (slopes[:, first] + slopes[:, other])
            radius = 0.5 * (high[:, other] - low[:, first]) + 0.5 * np.abs(apart).sum(-1)
            radius = np.maximum(radius, 0.0) + OWN_SUMS * (
                np.abs(low[:, first]) + np.abs(high[:, other]) + np.abs(tilt).sum(-1)
            )
            for side in (first, other):
                lower[:, at] = np.fmax(lower[:, at], least[:, side])
                upper[:, at] = np.fmin(upper[:, at], most[:, side])
            better = radius < r[:, at]
            c[:, at] = np.where(better, center, c[:, at])
            r[:, at] = np.where(better, radius, r[:, at])
            a[:, :, at] = np.where(better[:, None], tilt.transpose(0, 2, 1), a[:, :, at])
        c, r, lower, upper = (torch.from_numpy(v).reshape(shape) for v in (c, r, lower, upper))
        reused = replace(form, c=c, a=torch.from_numpy(a).reshape(form.a.shape), r=r, lower=lower, upper=upper)
        return self.intermediate.within(reused, reused.lower, reused.upper)
