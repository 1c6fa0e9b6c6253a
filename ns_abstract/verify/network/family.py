"""Bounds of the parts of a cell by rows of the whole (docs/design.md, N15)."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ns_abstract.verify.network.bounds import (
    Float64,
    ImageSets,
    Int64,
    OutputBounds,
    _Arrived,
    _Cells,
    _Form,
    bound_outputs,
)
from ns_abstract.verify.network.graph import Network, NetworkArithmetic
from ns_abstract.verify.network.layers import Activation
from ns_abstract.verify.network.rows import grid

#: Unit roundoff of the products of rows and pictures, and the smallest normal number of float32.
_UNIT, _FLUSH = 2.0**-24, 2.0**-126
#: Largest images of which rows are kept: their sums' rounding must stay small.
_MOST_NUMBERS = 1 << 19
#: Part of the memory that rows may take.
_ROWS_SHARE = 0.25
#: Room for rounding of a few sums in float64.
_ROOM = 2.0**-46

#: Of which numbers, if the whole's rows leave them open, a part's own rows are passed back: of those before the last
#: activation or product, or before all.
Fresh = Literal["last", "all"]


class Family:
    """Bounds of one cell, and of its parts by the rows that were passed back for the whole.

    Args:
        network: The network.
        whole: One cell.
        memory: Bytes to stay within, roughly.
        arithmetic: As in `ns_abstract.verify.network.bound_outputs`.
    """

    def __init__(
        self, network: Network, whole: ImageSets, *, memory: int = 1 << 30, arithmetic: NetworkArithmetic = "float32"
    ) -> None:
        if whole.count != 1:
            raise ValueError(f"one cell expected, got {whole.count}")
        self.network, self.memory = network, memory
        self.arithmetic: NetworkArithmetic = arithmetic
        self._cell = _Whole(network, whole, memory, arithmetic)

    def whole(self, rows: Any, offset: Float64) -> OutputBounds:
        """Lower bounds of ``rows @ y + offset`` over the cell."""
        return self._cell.outputs(rows, np.asarray(offset, np.float64))

    def parts(self, images: ImageSets, rows: Any, offset: Float64, *, fresh: Fresh = "last") -> OutputBounds:
        """Lower bounds of ``rows @ y + offset`` over parts of the cell.

        Args:
            images: m sets, each in parameters of its own, of images that obey those of the whole as well.
            rows, offset: As in `ns_abstract.verify.network.bound_outputs`.
            fresh: What has rows of the part's own.
        """
        offset = np.asarray(offset, np.float64)
        if not self._cell.good[0]:
            return bound_outputs(self.network, images, rows, offset, memory=self.memory, arithmetic=self.arithmetic)
        shapes = [self.network.shape(k) for k in range(len(self.network.nodes) + 1)]
        by_cell = sum(int(np.prod(shape)) for shape in shapes) * 8 * (3 * images.dimensions + 14)
        step = max(1, int(0.25 * self.memory) // by_cell)
        own = max(self._cell.ranges, default=0) if fresh == "last" else 0
        found = []
        for first in range(0, images.count, step):
            part = _Part(self._cell, images[first : first + step], self.memory, self.arithmetic, own)
            found.append(part.outputs(rows, offset))
        return OutputBounds(*(np.concatenate([getattr(part, name) for part in found]) for name in ("lower", "a", "b")))


class _Known:
    """What a whole cell's rows say of some numbers of a node.

    Attributes:
        flat: [R] which numbers; a number may have two rows.
        rows: [R, n] float32.
        least, most: [R]: number - rows @ (image - reference image) lies between them.
    """

    def __init__(self) -> None:
        self.parts: list[tuple[Int64, NDArray[np.float32], Float64, Float64]] = []

    def joined(self) -> tuple[Int64, NDArray[np.float32], Float64, Float64]:
        """(flat, rows, least, most)."""
        if len(self.parts) > 1:
            flat, rows, least, most = zip(*self.parts, strict=True)
            self.parts = [tuple(np.concatenate(v) for v in (flat, rows, least, most))]  # pyright: ignore[reportAttributeAccessIssue]
        return self.parts[0]


class _Whole(_Cells):
    """One cell that remembers what it finds out about numbers before activations and products."""

    keeps = True

    def __init__(self, network: Network, images: ImageSets, memory: int, arithmetic: NetworkArithmetic) -> None:
        #: by node: rows, and what all numbers are at least and at most
        self.known: dict[int, _Known] = {}
        self.ranges: dict[int, tuple[Tensor, Tensor]] = {}
        self._references: dict[int, Float64] = {}
        self._left = _ROWS_SHARE * memory
        self.keeps = images.lower.shape[1] <= _MOST_NUMBERS
        super().__init__(network, images, "everywhere", memory, arithmetic)

    def _known_better(
        self, index: int, form: _Form, open_: Tensor, apart: Tensor | None, layer: Activation | None = None
    ) -> _Form:
        self._references[index] = form.reference.reshape(-1).numpy()
        found = super()._known_better(index, form, open_, apart, layer)
        lower, upper = found.interval
        self.ranges[index] = lower[0], upper[0]
        return found

    def _keep(self, index: int, where: Int64, sign: Float64, rows: _Arrived) -> None:
        if index not in self._references or rows.value.nbytes > self._left:
            return
        self._left -= rows.value.nbytes
        flat = np.array(np.ravel_multi_index(tuple(where[:, 1:].T), grid(self.network.shape(index))), np.int64)
        low, high = rows.total[:, 0] - self.flush[0], rows.total[:, 1] + self.flush[0]
        low, high = np.where(sign > 0.0, low, -high), np.where(sign > 0.0, high, -low)
        reference = self._references[index][flat]
        room = _ROOM * (np.abs(reference) + np.abs(low) + np.abs(high))
        value: NDArray[np.float32] = rows.value * sign[:, None].astype(np.float32)
        self.known.setdefault(index, _Known()).parts.append(
            (flat, value, reference + low - room, reference + high + room)
        )


class _Part(_Cells):
    """Parts of a cell: rows of the whole are evaluated on their sets (N15).

    From node ``own`` on, rows of the part's own are passed back for what these leave open.
    """

    def __init__(self, whole: _Whole, images: ImageSets, memory: int, arithmetic: NetworkArithmetic, own: int) -> None:
        self.whole, self.own = whole, own
        self._columns: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        super().__init__(whole.network, images, "everywhere", memory, arithmetic)

    def _pictures(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The sets as middles [n, m (d + 1)] and as radii and sizes [n, 2 m], relative to the whole's reference."""
        if self._columns is None:
            m, d = self.count, self.d
            slopes, offsets = self.image.slopes.reshape(m, 2, -1, d), self.image.offsets.reshape(m, 2, -1)
            moved = self.middle - self.whole.middle
            a, b = slopes.mean(1), offsets.mean(1) + moved
            radius = 0.5 * (offsets[:, 1] - offsets[:, 0]) + 0.5 * np.abs(slopes[:, 1] - slopes[:, 0]).sum(-1)
            radius = np.maximum(radius, 0.0) + _ROOM * (
                np.abs(offsets).max(1) + np.abs(slopes).max(1).sum(-1) + np.abs(self.middle) + np.abs(self.whole.middle)
            )
            size = np.abs(a).sum(-1) + np.abs(b)
            middles = np.concatenate([a.transpose(1, 0, 2).reshape(-1, m * d), b.T], 1)
            radii = np.concatenate([radius.T, size.T], 1)
            self._columns = middles.astype(np.float32), radii.astype(np.float32)
        return self._columns

    def _evaluated(self, index: int) -> tuple[Int64, Float64, Float64, Float64, Float64]:
        """What the whole's rows say here: (flat [R], slopes [m, R, d], middle, half, room [m, R]).

        Each number is within ``half`` of ``slopes p + middle``.
        """
        m, d = self.count, self.d
        flat, rows, least, most = self.whole.known[index].joined()
        middles, radii = self._pictures()
        size = np.abs(rows)
        moved, spread = (rows @ middles).astype(np.float64), (size @ radii).astype(np.float64)
        n = rows.shape[1]
        gamma = (n + 2) * _UNIT / (1.0 - (n + 2) * _UNIT)
        tiny = n * _FLUSH * (1.0 + float(size.max(initial=0.0)))
        spread = (spread + tiny) / (1.0 - gamma)
        slopes, base = moved[:, : m * d].reshape(-1, m, d).transpose(1, 0, 2), moved[:, m * d :].T
        middle = base + 0.5 * (least + most)
        # what float32 sums lose is relative to the products' sizes
        half = spread[:, :m].T + gamma * spread[:, m:].T + (d + 1) * tiny + 0.5 * (most - least)
        room = _ROOM * (np.abs(least) + np.abs(most) + np.abs(base) + np.abs(slopes).sum(-1) + half)
        return flat, slopes, middle, half + room, room

    def _known_better(
        self, index: int, form: _Form, open_: Tensor, apart: Tensor | None, layer: Activation | None = None
    ) -> _Form:
        form = self._inherited(index, form)
        if index < self.own:
            return form
        if layer is not None:
            open_, apart = layer.open(*form.interval), layer.apart(*form.interval)
        return super()._known_better(index, form, open_, apart, layer)

    def _inherited(self, index: int, form: _Form) -> _Form:
        """The form with what is known of the whole cell."""
        if index not in self.whole.ranges:
            return form
        low, high = self.whole.ranges[index]
        room = _ROOM * (form.reference.abs() + low.abs() + high.abs())
        form = self._within(form, low - form.reference - room, high - form.reference + room)
        if index not in self.whole.known:
            return form
        m, d, shape = self.count, self.d, form.reference.shape
        flat, slopes, middle, half, room = self._evaluated(index)
        reference = form.reference.reshape(m, -1).numpy()[:, flat]
        middle = middle - reference
        half = half + room + _ROOM * np.abs(reference)
        reach = np.abs(slopes).sum(-1) * (1.0 + _ROOM) + half
        lower, upper, c, r = (np.array(v.reshape(m, -1).numpy()) for v in (form.lower, form.upper, form.c, form.r))
        a = np.array(form.a.reshape(m, d, -1).numpy())
        # a number's first row, then its second one
        _, first = np.unique(flat, return_index=True)
        second = np.setdiff1d(np.arange(len(flat)), first)
        for part in (first, second):
            at = flat[part]
            lower[:, at] = np.fmax(lower[:, at], (middle - reach)[:, part])
            upper[:, at] = np.fmin(upper[:, at], (middle + reach)[:, part])
            better = half[:, part] < r[:, at]
            c[:, at] = np.where(better, middle[:, part], c[:, at])
            r[:, at] = np.where(better, half[:, part], r[:, at])
            a[:, :, at] = np.where(better[:, None], slopes[:, part].transpose(0, 2, 1), a[:, :, at])
        found = _Form(
            form.reference,
            torch.from_numpy(c).reshape(shape),
            torch.from_numpy(a).reshape(form.a.shape),
            torch.from_numpy(r).reshape(shape),
            torch.from_numpy(lower).reshape(shape),
            torch.from_numpy(upper).reshape(shape),
            form.active,
        )
        return self._within(found, found.lower, found.upper)
