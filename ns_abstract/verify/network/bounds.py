"""Bounds of a network's outputs over sets of images (docs/design.md, N)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ns_abstract.verify.network.graph import Network
from ns_abstract.verify.network.layers import Activation, Linear
from ns_abstract.verify.network.rows import Rows, charge, full, grid, join, pass_activation, reach_image

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Substitution = Literal["everywhere", "end", "box"]

#: Unit roundoff of float32: of the bounded evaluation, and of rows.
UNIT = 2.0**-24
#: Roundings that are charged beside those of a layer's sums: folding of scales into weights, own float64
#: arithmetic, sums of rows where branches meet.
_SPARE = 24
#: Smallest normal number of float32: what a flush to zero may lose.
_FLUSH = 2.0**-126
#: Past this a float32 evaluation may overflow.
_OVERFLOW = 2.0**126
#: Bytes of rows that are worked on at a time: they should stay in a processor's cache.
_ROWS_AT_ONCE = 24 << 20


@dataclass(frozen=True)
class ImageSets:
    """``m`` linear sets of the network's input, flattened to ``n = prod(input_shape)`` numbers.

    For every p in [-1, 1]^d the images x(p) of cell k obey both
    ``a_lower[k] p + b_lower[k] <= x(p) <= a_upper[k] p + b_upper[k]`` and ``lower[k] <= x(p) <= upper[k]``;
    the arrays contain whatever rounding produced the images.

    Attributes:
        a_lower, a_upper: [m, n, d] float64.
        b_lower, b_upper, lower, upper: [m, n] float64.
    """

    a_lower: Float64
    b_lower: Float64
    a_upper: Float64
    b_upper: Float64
    lower: Float64
    upper: Float64

    def __post_init__(self) -> None:
        m, n, d = self.a_lower.shape
        for name in ("a_upper", "b_lower", "b_upper", "lower", "upper"):
            shape = (m, n, d) if name.startswith("a") else (m, n)
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} {shape} expected, got {getattr(self, name).shape}")

    @property
    def count(self) -> int:
        """Number of cells m."""
        return self.a_lower.shape[0]

    @property
    def dimensions(self) -> int:
        """Number of parameters d."""
        return self.a_lower.shape[2]

    def __getitem__(self, cells: slice) -> ImageSets:
        return ImageSets(*(getattr(self, name)[cells] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class OutputBounds:
    """Lower bounds of ``rows @ y + offset``; minus infinity where nothing is known, never NaN.

    Attributes:
        lower: [m, k] for every p of the cell.
        a, b: [m, k, d], [m, k]: ``a p + b`` is a lower bound at p.
    """

    lower: Float64
    a: Float64
    b: Float64


def bound_outputs(
    network: Network,
    images: ImageSets,
    rows: Any,
    offset: Float64,
    *,
    substitution: Substitution = "everywhere",
    memory: int = 1 << 30,
) -> OutputBounds:
    """Lower bounds of ``rows @ network(x) + offset`` over every image set.

    Args:
        network: The network.
        images: m cells in d parameters.
        rows: [k, output_size] array or scipy sparse matrix.
        offset: [k].
        substitution: Where the parameters' correlation is used: in every intermediate bound
            ("everywhere"), only in the result ("end"), or not at all ("box").
        memory: Bytes to stay within, roughly; cells and rows are worked on in parts.
    """
    offset = np.asarray(offset, np.float64)
    if images.a_lower.shape[1] != network.input_size:
        raise ValueError(f"images of {network.input_size} numbers expected, got {images.a_lower.shape[1]}")
    if rows.shape != (offset.shape[0], network.output_size):
        raise ValueError(f"rows {(offset.shape[0], network.output_size)} expected, got {rows.shape}")
    by_cell = sum(int(np.prod(network.shape(k))) for k in range(len(network.nodes) + 1)) * 8 * (images.dimensions + 9)
    step = max(1, int(0.5 * memory) // by_cell)
    parts = []
    for first in range(0, images.count, step):
        cells = _Cells(network, images[first : first + step], substitution, memory)
        parts.append(cells.outputs(rows, offset))
    if not parts:
        d = images.dimensions
        return OutputBounds(np.zeros((0, len(offset))), np.zeros((0, len(offset), d)), np.zeros((0, len(offset))))
    return OutputBounds(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("lower", "a", "b")))


@dataclass
class _Form:
    """``c + a p + e`` with |e| <= r, and lower, upper: what is known of a node in every cell (N1).

    Attributes:
        c, r, lower, upper: [m, *shape].
        a: [m, d, *shape].
    """

    c: Tensor
    a: Tensor
    r: Tensor
    lower: Tensor
    upper: Tensor

    @property
    def size(self) -> Tensor:
        return torch.maximum(self.lower.abs(), self.upper.abs())

    @staticmethod
    def ranged(c: Tensor, a: Tensor, r: Tensor) -> _Form:
        """With the range of the form itself."""
        reach = (a.abs().sum(1) + r) * (1.0 + 2.0**-40) + c.abs() * 2.0**-50
        return _Form(c, a, r, c - reach, c + reach)


class _Cells:
    """Bounds of one network over some cells."""

    def __init__(self, network: Network, images: ImageSets, substitution: Substitution, memory: int) -> None:
        self.network = network
        self.count, self.d = images.count, images.dimensions
        self.memory = memory
        self.good = np.ones(self.count, bool)
        self.flush = np.zeros(self.count)
        self._planes(images, substitution)
        self.lines: dict[int, list[np.ndarray]] = {}
        self.noise: dict[int, np.ndarray] = {}
        self.biases: dict[int, np.ndarray] = {}
        self._row_bytes: dict[int, int] = {}
        self.last = self._forward()
        if substitution == "end":
            self._planes(images, "everywhere")

    def _planes(self, images: ImageSets, substitution: Substitution) -> None:
        """Image sets in the order that rows want; a cell with a number that is not finite is given up."""
        shape = grid(self.network.input_shape)
        fields = [np.asarray(getattr(images, name), np.float64) for name in images.__dataclass_fields__]
        finite = np.logical_and.reduce([np.isfinite(f).reshape(self.count, -1).all(axis=1) for f in fields])
        finite &= (fields[4] <= fields[5]).all(axis=1)
        self.good &= finite
        a_lower, b_lower, a_upper, b_upper, lower, upper = (
            np.where(finite.reshape(-1, *[1] * (f.ndim - 1)), f, 0.0) for f in fields
        )
        if substitution != "everywhere":
            a_lower, b_lower, a_upper, b_upper = np.zeros_like(a_lower), lower, np.zeros_like(a_upper), upper
        self.slopes = np.stack([a_lower, a_upper], 1).reshape(self.count, 2, *shape, self.d)
        self.offsets = np.stack([b_lower, b_upper], 1).reshape(self.count, 2, *shape)
        self.lower, self.upper = lower.reshape(self.count, *shape), upper.reshape(self.count, *shape)

    def _image(self) -> _Form:
        """The image as a form: the middle of its planes."""
        shape = self.network.input_shape
        slopes, offsets = torch.from_numpy(self.slopes), torch.from_numpy(self.offsets)
        a = slopes.mean(1).movedim(-1, 1)
        c = offsets.mean(1)
        spread = 0.5 * (offsets[:, 1] - offsets[:, 0]) + 0.5 * (slopes[:, 1] - slopes[:, 0]).abs().sum(-1)
        spread = spread.clamp(min=0.0) + 2.0**-50 * (offsets.abs().amax(1) + slopes.abs().amax(1).sum(-1))
        form = _Form.ranged(c.reshape(-1, *shape), a.reshape(-1, self.d, *shape), spread.reshape(-1, *shape))
        return self._within(
            form, torch.from_numpy(self.lower).reshape(-1, *shape), torch.from_numpy(self.upper).reshape(-1, *shape)
        )

    def _within(self, form: _Form, lower: Tensor, upper: Tensor) -> _Form:
        """The form with bounds that are known besides; a cell without values in it is given up."""
        low, high = torch.maximum(form.lower, lower), torch.minimum(form.upper, upper)
        fine = (low <= high) & torch.isfinite(form.c) & torch.isfinite(form.r) & torch.isfinite(form.a).all(1)
        good = fine.reshape(self.count, -1).all(1)
        self.good &= good.numpy()
        if bool(good.all()):
            return _Form(form.c, form.a, form.r, low, high)

        # what is given up must not slow the others down with NaN
        def clear(t: Tensor) -> Tensor:
            return torch.where(good.reshape(-1, *[1] * (t.ndim - 1)), t, torch.zeros_like(t))

        return _Form(clear(form.c), clear(form.a), clear(form.r), clear(low), clear(high))

    # ------------------------------------------------------------ forwards

    def _forward(self) -> _Form:
        """Lines and rounding of every node; returns what is known of the last one."""
        forms: list[_Form | None] = [self._image()]
        left = list(self.network.readers)
        last = len(self.network.nodes)
        for k, node in enumerate(self.network.nodes, 1):
            inputs = []
            for index in node.inputs:
                form = forms[index]
                assert form is not None
                inputs.append(form)
            if isinstance(node.layer, Activation):
                # what is known better of the input is also known to its other readers
                forms[node.inputs[0]] = inputs[0] = self._tighten(node.inputs[0], inputs[0], node.layer)
                forms.append(self._activate(k, node.layer, inputs[0]))
            else:
                forms.append(self._combine(k, node.layer, inputs, [self.network.readers[i] for i in node.inputs]))
            for index in node.inputs:
                left[index] -= 1
                if not left[index] and index != last:
                    forms[index] = None
        end = forms[last]
        assert end is not None
        return end

    def _combine(self, k: int, layer: Linear, inputs: list[_Form], readers: list[int]) -> _Form:
        """A linear layer (N1, N2)."""
        m, d = self.count, self.d
        stacks = [torch.cat([f.c[:, None], f.a], 1).flatten(0, 1) for f in inputs]
        moved = layer.apply(stacks).reshape(m, 1 + d, *layer.shape)
        # own float64 rounding is relative to the form, that of the network to its values
        radii = [torch.cat([f.r + 2.0**-28 * (f.c.abs() + f.a.abs().sum(1)), f.size]) for f in inputs]
        magnitude = layer.magnitude(radii).reshape(2, m, *layer.shape)
        bias = layer.bias
        c, size = moved[:, 0], magnitude[1]
        if bias is not None:
            c, size = c + bias, size + bias.abs()
        count = layer.terms + layer.row_terms + _SPARE + max(readers)
        noise = size * (count * UNIT / (1.0 - count * UNIT)) + (layer.terms + 1) * _FLUSH
        form = _Form.ranged(c, moved[:, 1:], magnitude[0] * (1.0 + 2.0**-28) + noise)
        if float(size.amax()) >= _OVERFLOW:
            self.good &= (size.reshape(m, -1).amax(1) < _OVERFLOW).numpy()
        for f, shape in zip(inputs, layer.input_shapes, strict=True):
            lost = int(np.prod(shape)) * (layer.row_terms + 2) * _FLUSH
            self.flush += lost * f.size.reshape(m, -1).amax(1).numpy()
        self.noise[k] = (noise * (1.0 + 2.0**-20)).float().reshape(m, *grid(layer.shape)).numpy()
        whole = torch.zeros(layer.shape, dtype=torch.float64) if bias is None else bias.expand(layer.shape)
        self.biases[k] = whole.reshape(grid(layer.shape)).contiguous().numpy()
        return self._within(form, form.lower, form.upper)

    def _activate(self, k: int, layer: Activation, z: _Form) -> _Form:
        """An activation (N3, N4)."""
        size = z.size
        room = layer.error(size) + 2.0**-40 * size
        band = layer.band(z.lower, z.upper)
        s = band.lower_slope
        middle, half = 0.5 * (band.lower_offset + band.upper_offset), 0.5 * (band.upper_offset - band.lower_offset)
        half = half + 2.0**-50 * middle.abs() + room + 2.0**-48 * s * (z.c.abs() + z.a.abs().sum(1))
        form = _Form.ranged(s * z.c + middle, s[:, None] * z.a, s * z.r * (1.0 + 2.0**-40) + half)
        lines = layer.lines(z.lower, z.upper)
        stored = []
        for slope, offset, side in (
            (lines.lower_slope, lines.lower_offset, -1.0),
            (lines.upper_slope, lines.upper_offset, 1.0),
        ):
            rounded = slope.float()
            # the slope as stored, rows' products with it and sums where branches meet
            give = (rounded - slope).abs() + (
                _SPARE + self.network.readers[self.network.nodes[k - 1].inputs[0]]
            ) * UNIT * slope
            moved = offset + side * (give * size + room)
            near = moved.float()
            out = torch.nextafter(near, torch.full_like(near, side * torch.inf))
            stored += [rounded, torch.where(moved == 0.0, near, out)]
        self.lines[k] = [t.reshape(self.count, *grid(layer.shape)).contiguous().numpy() for t in stored]
        self.flush += int(np.prod(layer.shape)) * 2 * _FLUSH * size.reshape(self.count, -1).amax(1).numpy()
        return self._within(form, layer.function(z.lower) - room, layer.function(z.upper) + room)

    def _tighten(self, index: int, form: _Form, layer: Activation) -> _Form:
        """Better bounds of the numbers of node ``index`` where they would give better lines (N6)."""
        if self.network.depth[index] < 2:
            return form
        shape = grid(layer.shape)
        open_ = layer.open(form.lower, form.upper).reshape(self.count, *shape)
        open_ &= torch.from_numpy(self.good).reshape(-1, 1, 1, 1)
        where = open_.nonzero().numpy()
        if not len(where):
            return form
        low = self._one_hot(index, where, 1.0)
        high = self._one_hot(index, where, -1.0)
        cell, flat = where[:, 0], np.ravel_multi_index(tuple(where[:, 1:].T), shape)
        at = torch.from_numpy(cell), torch.from_numpy(flat)
        c, r = form.c.flatten(1).clone(), form.r.flatten(1).clone()
        a = form.a.flatten(2).movedim(1, -1).clone()
        lower, upper = form.lower.flatten(1).clone(), form.upper.flatten(1).clone()
        slopes = torch.from_numpy(0.5 * (low.plane[:, :-1] - high.plane[:, :-1]))
        apart = np.abs(low.plane[:, :-1] + high.plane[:, :-1]).sum(1)
        center = torch.from_numpy(0.5 * (low.plane[:, -1] - high.plane[:, -1]))
        radius = 0.5 * (-high.plane[:, -1] - low.plane[:, -1] + apart)
        size = np.abs(low.plane).sum(1) + np.abs(high.plane).sum(1)
        radius = torch.from_numpy(np.maximum(radius, 0.0) + 2.0**-48 * size)
        better = radius < r[at]
        c[at] = torch.where(better, center, c[at])
        a[at] = torch.where(better[:, None], slopes, a[at])
        r[at] = torch.where(better, radius, r[at])
        lower[at] = torch.maximum(lower[at], torch.from_numpy(low.lower))
        upper[at] = torch.minimum(upper[at], torch.from_numpy(-high.lower))
        item = layer.shape
        tight = _Form(
            c.reshape(-1, *item),
            a.movedim(-1, 1).reshape(-1, self.d, *item),
            r.reshape(-1, *item),
            lower.reshape(-1, *item),
            upper.reshape(-1, *item),
        )
        return self._within(tight, tight.lower, tight.upper)

    # ------------------------------------------------------------ backwards

    def _one_hot(self, index: int, where: Int64, sign: float) -> _Reached:
        """Bounds of ``sign`` times single numbers [R, (cell, channel, row, column)] of node ``index``."""
        channels = grid(self.network.shape(index))[0]
        parts = []
        step = self._rows_at_once(index, (1, 1))
        for first in range(0, len(where), step):
            cell, channel, y, x = where[first : first + step].T
            value = np.zeros((len(cell), channels, 1, 1), np.float32)
            value[np.arange(len(cell)), channel] = sign
            rows = Rows(value, np.ascontiguousarray(y), np.ascontiguousarray(x))
            parts.append(self._backward(index, rows, np.ascontiguousarray(cell)))
        return _Reached.joined(parts)

    def _rows_at_once(self, index: int, window: tuple[int, int]) -> int:
        """Rows that fit: what one row on node ``index`` needs is found by passing one of zeros back."""
        channels, height, width = grid(self.network.shape(index))
        rows = Rows(np.zeros((1, channels, *window), np.float32), np.full(1, height // 2), np.full(1, width // 2))
        if window == (height, width):
            rows = Rows.whole(rows.value)
        largest = 0
        for _, _, live in self._walk(index, rows, np.zeros(1, np.int64), np.zeros(1)):
            largest = max(largest, live)
        return max(1, min(_ROWS_AT_ONCE, self.memory // 4) // max(1, 2 * largest))

    def _backward(self, index: int, rows: Rows, cell: Int64) -> _Reached:
        """Bounds of rows on node ``index``."""
        count = len(cell)
        total = np.zeros(count)
        image = None
        for at, found, _ in self._walk(index, rows, cell, total):
            image = found if at == 0 else None
        plane, box = np.zeros((count, self.d + 1)), np.zeros(count)
        if image is None:
            plane[:, -1] = box[:] = total
        else:
            reach_image(
                image.value,
                image.y,
                image.x,
                cell,
                self.slopes,
                self.offsets,
                self.lower,
                self.upper,
                total,
                plane,
                box,
            )
        plane[:, -1] -= self.flush[cell]
        box -= self.flush[cell]
        return _Reached.from_planes(plane, box)

    def _walk(self, index: int, rows: Rows, cell: Int64, total: Float64) -> Iterator[tuple[int, Rows, int]]:
        """Pass rows from node ``index`` to the image; yields (node, its rows, bytes that are held)."""
        waiting = {index: rows}
        for at in range(index, 0, -1):
            here = waiting.pop(at, None)
            if here is None:
                continue
            node = self.network.nodes[at - 1]
            if isinstance(node.layer, Activation):
                pass_activation(here.value, here.y, here.x, cell, *self.lines[at], total=total)
                found = [here]
            else:
                charge(here.value, here.y, here.x, cell, self.biases[at], self.noise[at], total)
                found = node.layer.backward(here)
            for source, part in zip(node.inputs, found, strict=True):
                known = waiting.get(source)
                shape = self.network.shape(source)
                waiting[source] = full(part, shape) if known is None else join(known, part, shape)
            yield at, here, sum(r.value.nbytes for r in waiting.values()) + here.value.nbytes
        if 0 in waiting:
            yield 0, waiting[0], waiting[0].value.nbytes

    def outputs(self, rows: Any, offset: Float64) -> OutputBounds:
        """Bounds of ``rows @ y + offset`` in every cell."""
        index = len(self.network.nodes)
        m, k = self.count, len(offset)
        plane, lower = np.zeros((m, k, self.d + 1)), np.zeros((m, k))
        shape = grid(self.network.shape(index))
        size = self.last.size.reshape(m, -1).numpy()
        dense = np.asarray(rows.toarray() if hasattr(rows, "toarray") else rows, np.float64)
        single = dense.astype(np.float32)
        missing = size @ np.abs(dense - single).T
        step = self._rows_at_once(index, shape[1:])
        for first in range(0, m * k, step):
            number = np.arange(first, min(m * k, first + step))
            cell, row = number // k, number % k
            found = self._backward(index, Rows.whole(single[row].reshape(-1, *shape)), cell)
            plane[cell, row], lower[cell, row] = found.plane, found.lower
        room = 2.0**-48 * (np.abs(plane).sum(-1) + np.abs(offset) + missing) + missing
        lower, b = lower + offset - room, plane[..., -1] + offset - room
        a = plane[..., :-1]
        known = self.good[:, None] & np.isfinite(lower)
        usable = self.good[:, None] & np.isfinite(b) & np.isfinite(a).all(-1)
        return OutputBounds(
            np.where(known, lower, -np.inf), np.where(usable[..., None], a, 0.0), np.where(usable, b, -np.inf)
        )


@dataclass
class _Reached:
    """What rows are at least: planes [R, d + 1] (slopes, offset) and numbers [R]."""

    plane: Float64
    lower: Float64

    @staticmethod
    def from_planes(plane: Float64, box: Float64) -> _Reached:
        """The better of a plane's least value and what is known from the box."""
        slopes = np.abs(plane[:, :-1]).sum(1)
        least = plane[:, -1] - slopes - 2.0**-50 * (np.abs(plane[:, -1]) + slopes)
        lower = np.fmax(least, box)
        return _Reached(plane, np.where(np.isnan(lower), -np.inf, lower))

    @staticmethod
    def joined(parts: list[_Reached]) -> _Reached:
        return _Reached(np.concatenate([p.plane for p in parts]), np.concatenate([p.lower for p in parts]))
