"""Bounds of a network's outputs over sets of images (docs/design.md, N, N0-N2, N6, N12-N14, N16-N18, N20)."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ns_abstract.execution.ending import checkpoint
from ns_abstract.verify.network.graph import Network, NetworkArithmetic
from ns_abstract.verify.network.layers import Activation, LeakyRelu, Linear, Scale, Sum, Weighted
from ns_abstract.verify.network.maxima import Candidates, MaxPool, Planes, upper_planes
from ns_abstract.verify.network.products import Product
from ns_abstract.verify.network.rows import (
    Columns,
    Rows,
    charge,
    columns_of,
    concretize,
    full,
    grid,
    join,
    pass_activation,
    pass_maximum,
)
from ns_abstract.verify.network.schedule import TRIALS, Schedule, Way, on_threads
from ns_abstract.verify.network.slopes import Ascent, Chosen, Held, OpenUnits, derivatives
from ns_abstract.verify.network.sums import partial_sums

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Substitution = Literal["everywhere", "end", "box"]

#: Unit roundoff of float32: of the bounded evaluation, and of most rows.
UNIT = 2.0**-24
#: Unit roundoff of float64: of sums of offsets, and of rows of outputs in real arithmetic.
_DOUBLE_UNIT = 2.0**-53
#: Roundings of rows beside those of their sums: stored weights and slopes, products with them.
_SPARE = 24
#: Roundings of the network beside those of a layer's sums: a batch normalisation's factor (sum, root, quotient),
#: its product with a weight, and as many again.
_FOLDING = 8
#: Sums of fewer additions gain too little by their partial sums to pay for them.
_LONG = 256
#: Smallest normal number of float32: what a flush to zero may lose.
_FLUSH = 2.0**-126
#: Past this a float32 evaluation may overflow.
_OVERFLOW = 2.0**126
#: So many open numbers of a node are tightened only if some of them gain by it: if not so large a part of these
#: keeps so large a part of its width.
_MANY, _SOME, _GAIN = 1024, 64, 0.95
#: Signs of many units are given up if so few of some are found out, and so many of the layer before were not.
_UNSURE = 0.25
#: Numbers of a node that are probed by rows, and the part of widths past which forms are good enough.
_PROBED, _HALF = 32, 0.5
#: Lines that are apart by so small a part of a width are one line; by so large a part of what rows leave of it, open.
_STRAIGHT, _BENT = 2.0**-20, 2.0**-5
#: Differences in windows are bounded by rows if so large a part of those tried first is decided by it.
_CLOSES = 0.1
#: Room for rounding of lines relative to references and sizes.
_REFERENCES = 2.0**-46
#: Room for rounding above zero where nothing better is looked for.
_SURE = 1e-9
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


#: Signs that are assumed of a node's numbers: where they are in the node [B], and 1 or -1 [B] for "not negative" or
#: "not positive".
Signs = tuple[Int64, Float64]


@dataclass(frozen=True)
class OutputBounds:
    """Lower bounds of ``rows @ y + offset``; minus infinity where nothing is known, never NaN.

    Attributes:
        lower: [m, k] for every p of the cell; infinite where no image has the signs that are assumed.
        a, b: [m, k, d], [m, k]: ``a p + b`` is a lower bound at p.
        loosest: [m, k, 2] where signs are assumed: the node and the place in it of the input of an open unit that costs
            the row most, about; -1 where no unit is open.
    """

    lower: Float64
    a: Float64
    b: Float64
    loosest: Int64 | None = None


def bound_outputs(
    network: Network,
    images: ImageSets,
    rows: Any,
    offset: Float64,
    *,
    substitution: Substitution = "everywhere",
    memory: int = 1 << 30,
    arithmetic: NetworkArithmetic = "float32",
    slope_steps: int = 0,
    assumed: Sequence[Mapping[int, Signs]] | None = None,
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
        arithmetic: Whether the bounds hold for every float32 evaluation and the exact network, or for that alone.
        slope_steps: Steps towards the best slopes below open ReLUs, for every row of its own (N14); a bound never
            is worse for them, and each takes as long as two passes of the rows.
        assumed: By cell: signs of inputs of (leaky) ReLUs, by node; bounds are of the images for which these numbers
            have them in the evaluation that is bounded (N16). ``slope_steps`` must be positive then.
    """
    offset = np.asarray(offset, np.float64)
    if images.a_lower.shape[1] != network.input_size:
        raise ValueError(f"images of {network.input_size} numbers expected, got {images.a_lower.shape[1]}")
    if rows.shape != (offset.shape[0], network.output_size):
        raise ValueError(f"rows {(offset.shape[0], network.output_size)} expected, got {rows.shape}")
    numbers = 3 * images.dimensions + 14 + (7 if arithmetic == "real" else 0)
    by_cell = sum(int(np.prod(network.shape(k))) for k in range(len(network.nodes) + 1)) * 8 * numbers
    step = max(1, int(0.5 * memory) // by_cell)
    parts = []
    for first in range(0, images.count, step):
        signs = None if assumed is None else assumed[first : first + step]
        cells = _Cells(network, images[first : first + step], substitution, memory, arithmetic, slope_steps, signs)
        parts.append(cells.outputs(rows, offset))
    if not parts:
        k, d = len(offset), images.dimensions
        return OutputBounds(np.zeros((0, k)), np.zeros((0, k, d)), np.zeros((0, k)))
    names = ("lower", "a", "b") if assumed is None else ("lower", "a", "b", "loosest")
    return OutputBounds(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


class _Interval(NamedTuple):
    """What a node's numbers are at least and at most, [m, *shape]."""

    lower: Tensor
    upper: Tensor

    @property
    def size(self) -> Tensor:
        return torch.maximum(self.lower.abs(), self.upper.abs())

    @property
    def spread(self) -> Tensor:
        """What they are above and below zero, together."""
        return self.upper.clamp(min=0.0) - self.lower.clamp(max=0.0)


@dataclass
class _Form:
    """``z = reference + c + a p + e`` with |e| <= r: what is known of a node in every cell (N1).

    Attributes:
        reference: [m, *shape]: the node's exact values are near it; all that follows is relative to it.
        c, r: [m, *shape].
        a: [m, d, *shape].
        lower, upper: [m, *shape]; what ``z - reference`` is at least and at most.
        active: [m, *shape]; False where z is exactly zero.
    """

    reference: Tensor
    c: Tensor
    a: Tensor
    r: Tensor
    lower: Tensor
    upper: Tensor
    active: Tensor

    @property
    def width(self) -> Tensor:
        """How far z may be from the reference."""
        return torch.maximum(self.lower.abs(), self.upper.abs())

    @property
    def interval(self) -> _Interval:
        """What z is at least and at most."""
        room = 2.0**-50 * self.reference.abs()
        low = self.reference + self.lower - room - 2.0**-50 * self.lower.abs()
        return _Interval(low, self.reference + self.upper + room + 2.0**-50 * self.upper.abs())

    @staticmethod
    def ranged(reference: Tensor, c: Tensor, a: Tensor, r: Tensor, active: Tensor | None = None) -> _Form:
        """With the range of the form itself."""
        radius = (a.abs().sum(1) + r) * (1.0 + 2.0**-40) + c.abs() * 2.0**-50
        active = torch.ones_like(c, dtype=torch.bool) if active is None else active
        return _Form(reference, c, a, r, c - radius, c + radius, active)


class _Cells:
    """Bounds of one network over some cells."""

    #: Most rows that are passed back together.
    most_rows = 1 << 30

    def __init__(
        self,
        network: Network,
        images: ImageSets,
        substitution: Substitution,
        memory: int,
        arithmetic: NetworkArithmetic = "float32",
        slope_steps: int = 0,
        assumed: Sequence[Mapping[int, Signs]] | None = None,
    ) -> None:
        self.network = network
        self.slope_steps = slope_steps
        self.assumed = assumed
        #: by cell and node: what rows take of signs that are assumed
        self.held: list[dict[int, Held]] = [{} for _ in range(images.count)]
        #: cells without an image that has the signs assumed
        self.vacant = np.zeros(images.count, bool)
        #: units whose lower lines may have other slopes
        self.open: dict[int, OpenUnits] = {}
        self.count, self.d = images.count, images.dimensions
        self.memory = memory
        self.single = arithmetic == "float32"
        self.schedule = Schedule(network)
        self.good = np.ones(self.count, bool)
        self.flush = np.zeros(self.count)
        fields = self._fields(images)
        self._planes(fields, substitution)
        #: what rows take on their way; rows of outputs take the last, the others the first
        self.passages = [_Passage(torch.float32, UNIT)]
        if not self.single:
            # beside the rounding of a float32 network that of rows is little
            self.passages.append(_Passage(torch.float64, _DOUBLE_UNIT))
        #: what sums of offsets in float64 lose: every number is passed by a few times at most
        numbers = sum(int(np.prod(network.shape(k))) for k in range(len(network.nodes) + 1))
        self.sums = 4.0 * _DOUBLE_UNIT * (numbers + len(network.nodes))
        #: lines with slopes of another cell's rows
        self.offered: dict[int, _Offered] = {}
        #: roundings of sums
        self.terms: dict[int, Tensor | int] = {}
        #: nodes whose rounding is in that of their only reader
        self.folded: set[int] = set()
        #: what rows may stop at
        self.stops: dict[int, Columns] = {}
        #: what is known of nodes, while other nodes read them
        self.forms: list[_Form | None] = []
        #: products that rows have not taken because they ended on the way
        self.spared = 0.0
        #: part of the latest ReLU's inputs whose signs have not been found out
        self.unsure = 0.0
        self.last = self._forward()
        if substitution == "end":
            self._planes(fields, "everywhere")

    def _fields(self, images: ImageSets) -> list[np.ndarray]:
        """Image sets without numbers that are not finite: such a cell is given up."""
        fields = [np.asarray(getattr(images, name), np.float64) for name in images.__dataclass_fields__]
        finite = np.logical_and.reduce([np.isfinite(f).reshape(self.count, -1).all(axis=1) for f in fields])
        finite &= (fields[4] <= fields[5]).all(axis=1)
        self.good &= finite
        fields = [np.where(finite.reshape(-1, *[1] * (f.ndim - 1)), f, 0.0) for f in fields]
        #: the images' reference
        self.middle = self._about(0.5 * (np.maximum(fields[1], fields[4]) + np.minimum(fields[3], fields[5])))
        return fields

    def _about(self, middle: Float64) -> Float64:
        """[m, n] pictures that all is relative to, for the sets' middles: any will do."""
        return middle

    def _reference(self, k: int, passed_on: Callable[[], Tensor]) -> Tensor:
        """[m, *shape] what is relative to at node ``k``: that of its inputs passed on with float64's rounding."""
        return passed_on()

    def _sized(self, form: _Form) -> _Form:
        """The form, or one of more cells, by which rounding is charged: sizes are all that is read of it."""
        return form

    def _winner(self, k: int, winner: Tensor) -> Tensor:
        """[m, C, 1, W] numbers of windows that are followed from below at node ``k``: any will do."""
        return winner

    def _planes(self, fields: list[np.ndarray], substitution: Substitution) -> None:
        """Image sets as rows want them, relative to the reference."""
        shape = grid(self.network.input_shape)
        a_lower, b_lower, a_upper, b_upper, lower, upper = fields
        if substitution != "everywhere":
            a_lower, b_lower, a_upper, b_upper = np.zeros_like(a_lower), lower, np.zeros_like(a_upper), upper
        c = self.middle
        b_lower, lower = (v - c - 2.0**-51 * (np.abs(v) + np.abs(c)) for v in (b_lower, lower))
        b_upper, upper = (v - c + 2.0**-51 * (np.abs(v) + np.abs(c)) for v in (b_upper, upper))
        # numpy keeps the order of axes in memory that the images came with
        self.image = _Planes(
            np.ascontiguousarray(np.stack([a_lower, a_upper], 1)).reshape(self.count, 2, *shape, self.d),
            np.ascontiguousarray(np.stack([b_lower, b_upper], 1)).reshape(self.count, 2, *shape),
            np.ascontiguousarray(lower).reshape(self.count, *shape),
            np.ascontiguousarray(upper).reshape(self.count, *shape),
        )
        self.columns = columns_of(*self.image)

    def _image(self) -> _Form:
        """The image as a form: the middle of its planes."""
        shape = self.network.input_shape
        slopes, offsets = torch.from_numpy(self.image.slopes), torch.from_numpy(self.image.offsets)
        a = slopes.mean(1).movedim(-1, 1).reshape(self.count, self.d, *shape)
        c = offsets.mean(1)
        spread = 0.5 * (offsets[:, 1] - offsets[:, 0]) + 0.5 * (slopes[:, 1] - slopes[:, 0]).abs().sum(-1)
        spread = spread.clamp(min=0.0) + 2.0**-50 * (offsets.abs().amax(1) + slopes.abs().amax(1).sum(-1))
        c, spread = c.reshape(-1, *shape), spread.reshape(-1, *shape)
        reference = torch.from_numpy(self.middle).reshape(-1, *shape)
        form = _Form.ranged(reference, c, a, spread)
        lower, upper = torch.from_numpy(self.image.lower), torch.from_numpy(self.image.upper)
        return self._within(form, lower.reshape(-1, *shape), upper.reshape(-1, *shape))

    def _within(self, form: _Form, lower: Tensor, upper: Tensor) -> _Form:
        """The form with bounds that are known besides; a cell without values in it is given up."""
        low, high = torch.maximum(form.lower, lower), torch.minimum(form.upper, upper)
        fine = low <= high
        for known in (form.reference, form.c, form.r, form.a):
            # sums are finite unless a number, or they, are not
            if not bool(torch.isfinite(known.sum())):
                finite = torch.isfinite(known)
                fine = fine & (finite.all(1) if known.ndim > fine.ndim else finite)
        good = fine.reshape(self.count, -1).all(1)
        if self.assumed is not None and not bool(good.all()):
            # bounds that hold for all images with these signs contradict each other: there are none (N16)
            crossed = torch.isfinite(low) & torch.isfinite(high) & (low > high)
            told = np.array([len(signs) > 0 for signs in self.assumed]) & self.good
            self.vacant |= told & crossed.reshape(self.count, -1).any(1).numpy()
        self.good &= good.numpy()
        found = _Form(form.reference, form.c, form.a, form.r, low, high, form.active)
        if bool(good.all()):
            return found

        # what is given up must not slow the others down with NaN
        def clear(t: Tensor) -> Tensor:
            return torch.where(good.reshape(-1, *[1] * (t.ndim - 1)), t, torch.zeros_like(t))

        return _Form(*(clear(getattr(found, name)) for name in _Form.__dataclass_fields__))

    # ------------------------------------------------------------ forwards

    def _forward(self) -> _Form:
        """Lines and rounding of every node; returns what is known of the last one."""
        forms: list[_Form | None] = [self._image()]
        self.forms = forms
        if self.schedule.planned:
            self._learn(0, False)
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
                source = node.inputs[0]
                inputs[0] = self._assume(source, inputs[0])
                open_, apart = node.layer.open(*inputs[0].interval), node.layer.apart(*inputs[0].interval)
                better = self._known_better(source, inputs[0], open_, apart, node.layer)
                forms[source] = inputs[0] = self._assume(source, better)
                if isinstance(node.layer, LeakyRelu):
                    self.unsure = float(node.layer.open(*inputs[0].interval).double().mean())
                forms.append(self._activate(k, source, node.layer, inputs[0]))
                if self.network.depth[source] > 1:
                    self.stops[source] = self._stop(source, inputs[0])
            elif isinstance(node.layer, Product):
                intervals = inputs[0].interval, inputs[1].interval
                open_, apart = node.layer.open(*intervals), node.layer.apart(*intervals)
                for position, source in enumerate(node.inputs):
                    forms[source] = inputs[position] = self._known_better(source, inputs[position], open_, apart)
                forms.append(self._multiply(k, node.inputs, node.layer, inputs[0], inputs[1]))
            elif isinstance(node.layer, MaxPool):
                forms.append(self._maximum(k, node.inputs[0], node.layer, inputs[0]))
            else:
                forms.append(self._combine(k, node.inputs, node.layer, inputs))
            if self.schedule.planned:
                for index in node.inputs:
                    self._learn(index, isinstance(node.layer, LeakyRelu) and node.layer.alpha == 0.0)
                self._learn(k, False)
            for index in node.inputs:
                left[index] -= 1
                if not left[index] and index != last:
                    self._leave(index)
        end = forms[last]
        assert end is not None
        self.forms = []
        return end

    def _learn(self, index: int, cut: bool) -> None:
        """Tell the schedule how wide bounds of node ``index`` are; ``cut``: those of numbers that are not cut off."""
        form = self.forms[index]
        assert form is not None
        r = form.r
        if cut:
            above = form.interval.upper > 0.0
            r = r[above] if bool(above.any()) else r
        self.schedule.learns(index, float(r.mean()), float(form.reference.abs().mean()))

    def _leave(self, index: int) -> None:
        """Node ``index`` has been read; rows of later ones may end there (N18)."""
        form, self.forms[index] = self.forms[index], None
        if index in self.schedule.rests and index not in self.stops:
            assert form is not None
            self.stops[index] = self._stop(index, form)

    def _assume(self, source: int, z: _Form) -> _Form:
        """What is known of node ``source`` where its numbers have the signs that are assumed (N16)."""
        if self.assumed is None or not any(source in signs for signs in self.assumed):
            return z
        lower, upper = (v.flatten(1).clone() for v in (z.lower, z.upper))
        least, most = (v.flatten(1).numpy() for v in z.interval)
        reference, width = z.reference.flatten(1), z.width.flatten(1).numpy()
        for cell, signs in enumerate(self.assumed):
            if source not in signs or not self.good[cell]:
                continue
            flat, side = signs[source]
            if bool(np.where(side > 0.0, most[cell, flat] < 0.0, least[cell, flat] > 0.0).any()):
                self.vacant[cell] = True
                continue
            at, positive = torch.from_numpy(flat), torch.from_numpy(side > 0.0)
            zero = -reference[cell, at]
            low, high = lower[cell, at], upper[cell, at]
            lower[cell, at] = torch.where(positive, torch.minimum(torch.maximum(low, zero), high), low)
            upper[cell, at] = torch.where(positive, high, torch.maximum(torch.minimum(high, zero), low))
            noise = UNIT * (_SPARE + self.network.readers[source]) * width[cell, flat]
            if self._rounds(source):
                noise = noise + self.passages[0].noise[source].flatten(1).numpy()[cell, flat]
            self.held[cell][source] = Held(flat, side, -zero.numpy(), noise)
        return replace(z, lower=lower.reshape(z.lower.shape), upper=upper.reshape(z.upper.shape))

    def _combine(self, k: int, sources: tuple[int, ...], layer: Linear, inputs: list[_Form]) -> _Form:
        """A linear layer (N1, N2)."""
        m, d = self.count, self.d
        reference = self._reference(k, lambda: layer([f.reference for f in inputs]))
        stacks = [torch.cat([f.c[:, None], f.a], 1).flatten(0, 1) for f in inputs]
        moved = layer.apply(stacks).reshape(m, 1 + d, *layer.shape)
        # float64's rounding is relative to forms and references, float32's of rows to distances from
        # references, that of the network to its values
        own = (layer.terms + len(inputs) + 8) * 2.0**-52
        known = [self._sized(f) for f in inputs]
        radii, sizes = [], []
        for f, sized in zip(inputs, known, strict=True):
            # at least what an input may be on one side of zero and on the other together
            size = torch.maximum(sized.interval.spread, sized.reference.abs())
            sizes.append(size)
            radii.append(torch.cat([f.r + own * (f.c.abs() + f.a.abs().sum(1)), sized.width, size]))
        found = layer.magnitude(radii) * (1.0 + 2.0**-28)
        radius, width, size = found.split([m, *[len(sizes[0])] * 2])
        if layer.bias is not None:
            size = size + layer.bias.abs()
        moves = own * size + (layer.terms + 1) * _FLUSH
        active = None
        if not layer.terms:
            active = layer.magnitude([f.active.double() for f in inputs]) != 0.0
            if layer.bias is not None:
                active = active | (layer.bias != 0.0)
        elif self.single:
            count = self._roundings(sources, layer, known)
            self.terms[k] = count

            def end(moves: Tensor = moves) -> Tensor:
                return (reference + moved[:, 0]).abs() + moved[:, 1:].abs().sum(1) + radius + moves

            moves = moves + self._rounding(k, sources, layer, known, count, size, end) + layer.spare(sizes)
        roundings = layer.row_terms + _SPARE + max(self.network.readers[i] for i in sources)
        form = _Form.ranged(reference, moved[:, 0], moved[:, 1:], radius + moves, active)
        if float(size.amax()) >= _OVERFLOW:
            self.good &= (size.flatten(1).amax(1) < _OVERFLOW).numpy()
        for sized, shape in zip(known, layer.input_shapes, strict=True):
            lost = int(np.prod(shape)) * (layer.row_terms + 2) * _FLUSH
            self.flush += lost * sized.width.flatten(1).amax(1).numpy()
        folded = [i for i in sources if isinstance(layer, Sum) and self._rounds(i) and self.network.readers[i] == 1]
        self.folded.update(folded)
        for passage in self.passages:
            rows = _gamma(roundings, passage.unit)
            noise = ((moves + rows * width) * (1.0 + 2.0**-40)).expand(m, *layer.shape)
            for source in folded:
                # one charge instead of several
                noise = noise + passage.noise[source]
            passage.noise[k] = noise * (1.0 + 2.0**-40 + self.sums)
        return self._within(form, form.lower, form.upper)

    def _rounds(self, source: int) -> bool:
        """Whether rows are charged on node ``source``."""
        return source in self.passages[0].noise

    def _rounding(
        self,
        k: int,
        sources: tuple[int, ...],
        layer: Linear,
        inputs: list[_Form],
        count: Tensor | int,
        size: Tensor,
        end: Callable[[], Tensor],
    ) -> Tensor:
        """What a float32 evaluation of a layer may be off, [m, *shape].

        ``size`` = |W| |x| + |bias|; ``end``: what its values are at most (N2, N20).
        """
        folding = _FOLDING if k in self.network.scaled else 0
        few = _gamma(folding + 3 + len(inputs)) * size
        if isinstance(layer, Scale):
            # sums before it may start with the offset
            first = torch.zeros(()) if layer.bias is None else layer.bias.abs()
            return _gamma(count) * first * (1.0 + _gamma(count + _FOLDING)) + few
        if isinstance(layer, Sum):
            # the sum of one input may start with the others
            charges = []
            for i, f in zip(sources, inputs, strict=True):
                others = size - f.interval.size * (1.0 - 2.0**-40)
                own = torch.as_tensor(self.terms.get(i, 0), dtype=torch.float64)
                charges.append(_gamma(own) * others * (1.0 + _gamma(own + _FOLDING)))
            return few + (torch.maximum(*charges) if len(charges) == 2 else sum(charges))
        if not isinstance(layer, Weighted):
            return _gamma(count + _FOLDING) * size
        # partial sums are no larger than the positive products together, or the negative ones
        above, below = inputs[0].interval.upper.clamp(min=0.0), inputs[0].interval.lower.clamp(max=0.0)
        balance = layer([above + below])
        peak = 0.5 * (size + balance.abs()) * (1.0 + 2.0**-40)
        if float(torch.as_tensor(count).max()) < _LONG:
            return _gamma(count) * (peak + _gamma(count + _FOLDING + 1) * size) + few
        squared = layer.squared
        whole = squared.magnitude([above.square() + below.square()])
        if squared.bias is not None:
            whole = whole + squared.bias.abs()
        squares = 0.5 * (whole + squared([above.square() - below.square()]).abs()) * (1.0 + 2.0**-36)
        together = partial_sums(count, peak, squares, end())
        return _gamma(1) * (together + count * _gamma(count + _FOLDING + 1) * size) + few

    def _roundings(self, sources: tuple[int, ...], layer: Linear, inputs: list[_Form]) -> Tensor | int:
        """Roundings that a layer's sums may suffer; what is added behind sums may be added within them (N2)."""
        if not isinstance(layer, (Scale, Sum)):
            return layer.roundings([f.active for f in inputs])
        before = [self.network.nodes[i - 1].layer for i in sources if i]
        most = max((b.terms for b in before if isinstance(b, Linear)), default=0)
        counts = [torch.as_tensor(self.terms[i], dtype=torch.float64) for i in sources if i in self.terms]
        found = torch.as_tensor(float(layer.terms - most), dtype=torch.float64)
        return found + functools.reduce(torch.maximum, counts) if counts else found

    def _activate(self, k: int, source: int, layer: Activation, z: _Form) -> _Form:
        """An activation (N3, N4)."""
        lower, upper = z.interval
        size = z.interval.size
        reference = self._reference(k, lambda: layer.function(z.reference))
        room = layer.missing(lower, upper) + 2.0**-48 * reference.abs()
        if self.single:
            room = room + layer.error(lower, upper)
        band = layer.band(lower, upper)
        s = band.lower_slope
        base = s * z.reference - reference
        middle = 0.5 * (band.lower_offset + band.upper_offset) + base
        half = 0.5 * (band.upper_offset - band.lower_offset) + 2.0**-50 * middle.abs() + room
        half = half + 2.0**-50 * (band.lower_offset.abs() + band.upper_offset.abs() + s.abs() * z.reference.abs())
        half = half + 2.0**-48 * s.abs() * (z.c.abs() + z.a.abs().sum(1))
        radius = s.abs() * z.r * (1.0 + 2.0**-40) + half
        form = _Form.ranged(reference, s * z.c + middle, s[:, None] * z.a, radius)
        if isinstance(layer, LeakyRelu) and layer.alpha == 0.0:
            form.active = upper > 0.0
        lines = layer.lines(lower, upper)
        fold = self._rounds(source) and self.network.readers[source] == 1

        def stored(chosen: Sequence[tuple[Tensor, Tensor, Tensor]], passage: _Passage) -> np.ndarray:
            """As `pass_activation` wants slope, lower and upper offset for rows of either sign."""
            # the slope as stored, rows' products with it and sums where branches meet
            found, unit = [], (_SPARE + self.network.readers[source]) * passage.unit
            for (slope, low, high), side in zip(chosen, (-1.0, 1.0), strict=True):
                rounded = slope.to(passage.dtype).double()
                base, apart = slope * z.reference - reference, band.lower_slope - slope
                give = ((rounded - slope).abs() + unit * slope.abs()) * z.width + 2.0**-48 * apart.abs() * size + room
                give = give + 2.0**-48 * (low.abs() + high.abs() + slope.abs() * z.reference.abs())
                if fold:
                    give = give + rounded.abs() * passage.noise[source]
                ends = (
                    self._outward(low + base - give, -1.0, passage),
                    self._outward(high + base + give, 1.0, passage),
                )
                found += [rounded.to(passage.dtype), *(ends if side < 0.0 else reversed(ends))]
            return torch.stack(found).reshape(6, self.count, *grid(layer.shape)).numpy()

        # the other sides of lines with these slopes are the band's
        above = layer.offsets(lines.lower_slope, lower, upper, band)[1]
        below = layer.offsets(lines.upper_slope, lower, upper, band)[0]
        own = (lines.lower_slope, lines.lower_offset, above), (lines.upper_slope, below, lines.upper_offset)
        for passage in self.passages:
            passage.lines[k] = stored(own, passage)
        lent = self._lent(k)
        if lent is not None:
            slopes = [torch.from_numpy(v).double().expand(self.count, *layer.shape) for v in lent]
            plain = [layer.offsets(slope, lower, upper, band) for slope in slopes]
            tilted = [_tilted(slope, z, line) for slope, line in zip(slopes, own, strict=True)]
            # each is there for one side
            better = tilted[0][0] > plain[0][0], tilted[1][1] < plain[1][1]
            offsets, tilts = [], []
            for slope, ends, (low, high, tilt), use in zip(slopes, plain, tilted, better, strict=True):
                offsets.append((slope, torch.where(use, low, ends[0]), torch.where(use, high, ends[1])))
                tilts.append(torch.where(use[:, None], tilt, torch.zeros_like(tilt)))
            self.offered[k] = _Offered(stored(offsets, self.passages[0]), torch.stack(tilts).flatten(3).numpy())
        if fold:
            self.folded.add(source)
        if self.slope_steps and isinstance(layer, LeakyRelu):
            first = self.passages[0]
            loose = (_SPARE + self.network.readers[source]) * first.unit * z.width
            loose = loose + (first.noise[source] if fold else 0.0)
            given = (lower, upper, z.reference, reference, loose, room + torch.zeros_like(lower))
            self.open[k] = _open_units(layer, given)
        lost = int(np.prod(layer.shape)) * 2 * _FLUSH
        self.flush += lost * z.width.reshape(self.count, -1).amax(1).numpy()
        ends = layer.range(lower, upper)
        room = room + 2.0**-48 * (ends[0].abs() + ends[1].abs())
        return self._within(form, ends[0] - reference - room, ends[1] - reference + room)

    def _outward(self, value: Tensor, side: float, passage: _Passage) -> Tensor:
        """An offset as rows take it, farther out by what their sums of offsets may lose."""
        if passage.dtype == torch.float32:
            # half a unit of float32 is more than that, up to 2^26 numbers
            return _outward(value, side)
        return value + side * self.sums * value.abs()

    def _lent(self, k: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Slopes [1, *shape] of rows of another cell on node ``k``, not negative and negative ones."""
        return None

    def _multiply(self, k: int, sources: tuple[int, ...], layer: Product, x: _Form, y: _Form) -> _Form:
        """A product of two nodes (N9)."""
        m, first, second = self.count, x.interval, y.interval
        size = first.size * second.size
        reference = self._reference(k, lambda: x.reference * y.reference)
        plane = layer.plane(first, second)
        alpha, beta = plane.first, plane.second
        base = alpha * x.reference + beta * y.reference - reference
        # roundings of the plane relative to the references, and the network's
        own = alpha.abs() * x.reference.abs() + beta.abs() * y.reference.abs() + reference.abs()
        room = 2.0**-48 * (own + plane.low.abs() + plane.high.abs()) + 2 * _FLUSH
        if self.single:
            room = room + 2 * UNIT * size
        shape = (6, m, *grid(layer.shape))
        for passage in self.passages:
            # rows' products with the slopes, which are float32 numbers, and sums where branches meet
            unit = (_SPARE + max(self.network.readers[i] for i in sources)) * passage.unit
            give = room + unit * (alpha.abs() * x.width + beta.abs() * y.width)
            low = self._outward(plane.low + base - give, -1.0, passage)
            high = self._outward(plane.high + base + give, 1.0, passage)
            none = torch.zeros_like(low)
            passage.products[k] = tuple(
                torch.stack([slope, *ends, slope, *reversed(ends)]).reshape(shape).numpy()
                for slope, ends in ((alpha.to(passage.dtype), (low, high)), (beta.to(passage.dtype), (none, none)))
            )
        middle, half = 0.5 * (plane.low + plane.high) + base, 0.5 * (plane.high - plane.low)
        moved = alpha.abs() * (x.c.abs() + x.a.abs().sum(1)) + beta.abs() * (y.c.abs() + y.a.abs().sum(1))
        half = half + room + 2.0**-50 * middle.abs() + 2.0**-44 * moved
        radius = (alpha.abs() * x.r + beta.abs() * y.r) * (1.0 + 2.0**-40) + half
        c, a = alpha * x.c + beta * y.c + middle, alpha[:, None] * x.a + beta[:, None] * y.a
        form = _Form.ranged(reference, c, a, radius, x.active & y.active)
        for f in (x, y):
            lost = int(np.prod(layer.shape)) * 2 * _FLUSH
            self.flush += lost * f.width.reshape(m, -1).amax(1).numpy()
        if float(size.amax()) >= _OVERFLOW:
            self.good &= (size.reshape(m, -1).amax(1) < _OVERFLOW).numpy()
        ends = torch.stack([u * v for u in first for v in second]) - reference
        room = room + 2.0**-50 * (size + reference.abs())
        return self._within(form, ends.amin(0) - room, ends.amax(0) + room)

    def _maximum(self, k: int, source: int, layer: MaxPool, x: _Form) -> _Form:
        """Maxima over windows (N12); the reference is that of the number which the lower plane follows."""
        m, shape = self.count, layer.shape
        interval = x.interval
        lower, upper = (layer.taps(v, -torch.inf) for v in interval)
        winner = self._winner(k, layer.taps(x.reference + x.c, -torch.inf).argmax(2, keepdim=True))

        def chosen(v: Tensor) -> Tensor:
            return layer.taps(v, 0.0).gather(2, winner)[:, :, 0]

        reference, c, r, width = (chosen(v) for v in (x.reference, x.c, x.r, x.width))
        a = torch.stack([chosen(x.a[:, i]) for i in range(self.d)], 1)
        # sums of rows where windows overlap
        units = [(_SPARE + layer.overlaps + self.network.readers[source]) * passage.unit for passage in self.passages]
        gives = [unit * width for unit in units]
        offsets = [torch.stack([-give, give, give, -give], 0) for give in gives]
        rivals = upper.scatter(2, winner, -torch.inf).amax(2)
        most, own_upper = upper.amax(2), chosen(interval.upper)
        where = (rivals > chosen(interval.lower)).nonzero()
        which = torch.full(reference.shape, -1, dtype=torch.int64)
        slopes: list[Tensor] = []
        step = max(1, _ROWS_AT_ONCE // (8 * len(layer.steps) ** 2 * 4))
        for part in where.split(step):
            tilted = self._tilted(source, layer, x, interval, winner[:, :, 0], part)
            if tilted is None:
                continue
            at, top, known, near, planes = tilted
            which[at] = torch.arange(len(top)) + sum(map(len, slopes))
            base = (planes.slopes * known.reference).sum(1) - reference[at]
            room = _REFERENCES * ((planes.slopes * known.reference.abs()).sum(1) + reference[at].abs())
            for passage, unit, give, offset in zip(self.passages, units, gives, offsets, strict=True):
                rounded = (planes.slopes.to(passage.dtype).double() - planes.slopes).abs()
                lost = (rounded * near + unit * planes.slopes * near).sum(1) + room
                offset[1][at] = give[at] + top
                offset[2][at] = planes.high + base + lost
                offset[3][at] = planes.low + base - lost
            slopes.append(planes.slopes)
            # the form between the planes, or the winner and what may be above it
            low, high = planes.low + base - room, planes.high + base + room
            middle = (planes.slopes * known.middle).sum(1) + 0.5 * (low + high)
            radius = (planes.slopes * known.radius).sum(1) + 0.5 * (high - low)
            radius = (radius + _REFERENCES * (planes.slopes * known.size).sum(1)) * (1.0 + 2.0**-40)
            own = r[at] + 0.5 * top
            better = radius < own
            rows = (planes.slopes[:, :, None] * known.slopes).sum(1)
            c[at] = torch.where(better, middle, c[at] + 0.5 * top)
            r[at] = torch.where(better, radius, own * (1.0 + 2.0**-40) + _REFERENCES * c[at].abs())
            cells, channels, windows = at
            a[cells, :, channels, windows] = torch.where(better[:, None], rows, a[cells, :, channels, windows])
            most[at] = torch.minimum(most[at], own_upper[at] + top)
        grown = (m, *shape)
        chosen_slopes = torch.cat(slopes) if slopes else torch.zeros((0, len(layer.steps)))
        followed = winner[:, :, 0].reshape(grown).numpy().astype(np.int16)
        rows_of_slopes = which.reshape(grown).numpy().astype(np.int32)
        for passage, offset in zip(self.passages, offsets, strict=True):
            sides = zip(offset, (-1.0, 1.0, 1.0, -1.0), strict=True)
            outward = [self._outward(v, side, passage) for v, side in sides]
            passage.maxima[k] = _Maxima(
                followed,
                rows_of_slopes,
                chosen_slopes.to(passage.dtype).numpy(),
                torch.stack(outward).reshape(4, *grown).numpy(),
            )
        active = (layer.taps(x.active.double(), 0.0).amax(2) > 0.0).reshape(grown)
        reference, c, r = (v.reshape(grown) for v in (reference, c, r))
        form = _Form.ranged(reference, c, a.reshape(m, self.d, *shape), r, active)
        lost = int(np.prod(shape)) * 2 * len(layer.steps) * _FLUSH
        self.flush += lost * x.width.reshape(m, -1).amax(1).numpy()
        room = 2.0**-50 * (reference.abs() + form.width)
        least = lower.amax(2).reshape(grown)
        return self._within(form, least - reference - room, most.reshape(grown) - reference + room)

    def _tilted(
        self, source: int, layer: MaxPool, x: _Form, interval: _Interval, winner: Tensor, where: Tensor
    ) -> _Tilted | None:
        """Planes above those windows of ``where`` [n, 3] in which something may be above the ``winner``; None: none."""
        cell, channel, window = where.T
        at = cell, channel, window
        places = layer.places[:, window].T
        inside, number = places >= 0, channel[:, None] * x.c[0, 0].numel() + places.clamp(min=0)

        def gathered(v: Tensor) -> Tensor:
            return v.flatten(1)[cell[:, None], number]

        known = Candidates(
            inside,
            reference=gathered(x.reference),
            middle=gathered(x.c),
            radius=gathered(x.r),
            slopes=torch.stack([gathered(x.a[:, i]) for i in range(self.d)], 2),
            lower=gathered(interval.lower),
            upper=gathered(interval.upper),
            winner=winner[at],
        )
        apart = self._apart(source, layer, where, known)
        top = apart[torch.arange(len(where)), :, known.winner].amax(1)
        left = top > 0.0
        if not bool(left.any()):
            return None
        known = Candidates(*(v[left] for v in known))
        return _Tilted(
            tuple(v[left] for v in at), top[left], known, gathered(x.width)[left], upper_planes(known, apart[left])
        )

    def _apart(self, source: int, layer: MaxPool, where: Tensor, known: Candidates) -> Tensor:
        """How far numbers of windows may be above one another, by forms and by rows where these help."""
        apart = known.apart()
        at, winner = np.arange(len(apart)), known.winner.numpy()

        def rivals() -> np.ndarray:
            return apart.numpy()[at, :, winner] > 0.0

        # (window, number, number)
        window, number = rivals().nonzero()
        pairs = np.stack([window, winner[window], number], 1)
        cut = 0
        if self.schedule.planned:
            way = self.schedule.nearest(source, len(pairs))
            if way is None:
                return apart
            cut = self._ready(way)
        elif self.schedule.deep and not self.schedule.takes(len(pairs) * self.schedule.costs.row(source)):
            return apart
        if len(pairs) > _SOME:
            first = np.arange(0, len(pairs), len(pairs) // _SOME)
            if self._differences(source, layer, where.numpy(), known, pairs[first], apart, cut) < _CLOSES * len(first):
                return apart
            pairs = np.delete(pairs, first, 0)
        self._differences(source, layer, where.numpy(), known, pairs, apart, cut)
        # what may be above the winner, among itself
        left = rivals()
        both = np.triu(left[:, :, None] & left[:, None, :], 1)
        self._differences(source, layer, where.numpy(), known, np.argwhere(both), apart, cut)
        return apart

    def _differences(
        self, source: int, layer: MaxPool, where: Int64, known: Candidates, pairs: Int64, apart: Tensor, cut: int
    ) -> int:
        """Bound differences of (window, number, number) by rows, in ``apart``; how many second ones are never above."""
        channels = self.network.shape(source)[0]
        extent = layer.steps.max(0) + 1
        step = max(1, _ROWS_AT_ONCE // (16 * channels * int(np.prod(extent))))
        closed = 0
        for part in np.array_split(pairs, max(1, -(-len(pairs) // step))):
            if not len(part):
                continue
            window, one, other = part.T
            cell, channel, place = where[window].T
            y, x = np.divmod(place, layer.shape[2])
            value = np.zeros((len(part), channels, *extent), np.float32)
            row = np.arange(len(part))
            for chosen, sign in ((one, 1.0), (other, -1.0)):
                i, j = layer.steps[chosen].T
                value[row, channel, i, j] = sign
            near = known.reference[window, one], known.reference[window, other]
            ahead = (near[0] - near[1]).numpy()
            room = 2.0**-50 * (near[0].abs() + near[1].abs()).numpy()
            rows = Rows(value, y * layer.stride[0] - layer.pads[0], x * layer.stride[1] - layer.pads[1])
            enough = _Enough(_Goal(), room - ahead, np.zeros(len(part), bool))
            found = self._backward(source, rows, np.ascontiguousarray(cell), enough, None, cut)
            above, below = torch.from_numpy(room - ahead - found.lower), torch.from_numpy(room + ahead + found.upper)
            apart[window, other, one] = torch.minimum(apart[window, other, one], above)
            apart[window, one, other] = torch.minimum(apart[window, one, other], below)
            closed += int((above <= 0.0).sum())
        return closed

    def _stop(self, index: int, form: _Form) -> Columns:
        """What is known of node ``index``, for rows that arrive there."""
        m, d, shape = self.count, self.d, grid(self.network.shape(index))
        room = 2.0**-48 * (form.c.abs() + form.r)
        slopes = form.a.movedim(1, -1).reshape(m, 1, *shape, d).expand(m, 2, *shape, d)
        offsets = torch.stack([form.c - form.r - room, form.c + form.r + room], 1)
        sizes = (m, 2, *shape, d), (m, 2, *shape), (m, *shape), (m, *shape)
        found = zip((slopes, offsets, form.lower, form.upper), sizes, strict=True)
        return columns_of(*(t.reshape(size).numpy() for t, size in found))

    def _known_better(
        self, index: int, form: _Form, open_: Tensor, apart: Tensor | None, layer: Activation | None = None
    ) -> _Form:
        """The form of node ``index`` with better bounds of what is open before an activation or a product (None)."""
        if self.network.depth[index] < 2:
            return form
        if self.schedule.planned:
            return self._planned(index, form, open_, layer)
        if apart is not None:
            form, open_ = self._bent(index, form, open_, apart)
        if self.schedule.deep:
            return self._renew(index, form, open_, layer)
        return self._tighten(index, form, open_, isinstance(layer, LeakyRelu))

    def _bent(self, index: int, form: _Form, open_: Tensor, apart: Tensor) -> tuple[_Form, Tensor]:
        """The form with some numbers bounded by rows, and what is worth rows by what these have shown (N6).

        Lines that are close beside the form's width may be far apart beside what rows leave of it.
        """
        known = torch.from_numpy(self.good).reshape(-1, *[1] * (open_.ndim - 1))
        likely = (apart > _STRAIGHT) & ~open_ & known
        where = likely.reshape(self.count, *grid(self.network.shape(index))).nonzero().numpy()
        if not len(where):
            return form, open_
        some = where[:: -(-len(where) // _PROBED)]
        if self.schedule.deep and not self.schedule.takes(len(some) * self.schedule.costs.row(index)):
            return form, open_
        found = self._bounded(index, form, some, None, False)
        at = tuple(torch.from_numpy(some.T))
        shape = self.count, *grid(self.network.shape(index))
        before, after = ((f.upper - f.lower).reshape(shape)[at] for f in (form, found))
        kept = float((after / before).nan_to_num(nan=1.0).median())
        if kept > _HALF:
            return found, open_
        return found, open_ | (likely & (apart > _BENT * kept))

    def _tighten(self, index: int, form: _Form, open_: Tensor, decides: bool) -> _Form:
        """Better bounds of the numbers of node ``index`` that are open; a sign may be all that is asked (N6)."""
        item = self.network.shape(index)
        shape = grid(item)
        open_ = open_.reshape(self.count, *shape) & torch.from_numpy(self.good).reshape(-1, 1, 1, 1)
        where = open_.nonzero().numpy()
        if not len(where):
            return form
        if len(where) >= _MANY:
            # some first: where they gain nothing, the others are not worth their rows
            some = tuple(torch.from_numpy(where[:: len(where) // _SOME].T))
            first = torch.zeros_like(open_)
            first[some] = True
            before, found = form, self._tighten(index, form, first, decides)
            widths = [(f.upper - f.lower).reshape(open_.shape)[some] for f in (before, found)]
            if bool((widths[1] > _GAIN * widths[0]).double().mean() > _GAIN):
                return found
            lower, upper = (v.reshape(open_.shape)[some] for v in found.interval)
            if decides and self.unsure > _UNSURE and float(((lower < 0.0) & (upper > 0.0)).double().mean()) > _GAIN:
                # hardly any sign is found out, nor was it in the layer before: what follows is not worth it
                return found
            form, open_ = found, open_ & ~first
            where = open_.nonzero().numpy()
        return self._bounded(index, form, where, _Goal() if decides else None, decides)

    def _renew(self, index: int, form: _Form, open_: Tensor, layer: Activation | None) -> _Form:
        """Better bounds of a deep network's node, within the work allowed; of closed numbers, too (N13, N17).

        Rows for numbers that are open are all that the lines ask for. But forms forget what neighbours share: behind
        two or three layers they leave nearly everything open. Where they leave much open, rows bound all numbers
        that matter further on, so that forms start again from there.
        """
        shape = grid(self.network.shape(index))
        open_ = open_.reshape(self.count, *shape) & torch.from_numpy(self.good).reshape(-1, 1, 1, 1)
        count = int(open_.sum())
        decides = isinstance(layer, LeakyRelu)
        matters = torch.from_numpy(self.good).reshape(-1, 1, 1, 1) & torch.ones_like(open_)
        if isinstance(layer, LeakyRelu) and layer.alpha == 0.0:
            # what is certainly cut off is exact behind the layer
            matters &= form.interval.upper.reshape(open_.shape) > 0.0
        cost = self.schedule.costs.row(index)
        whole = self.schedule.renews(count / open_.numel(), int(matters.sum()) * cost)
        if not (count or whole):
            return form
        opened, signs = open_.nonzero().numpy(), _Goal() if decides else None
        chosen = matters.nonzero().numpy() if whole else opened
        if len(chosen) * cost > self.schedule.left:
            chosen, whole = opened, False
        goal = self._goal(form, len(chosen) * cost, layer) if whole else signs
        if not self.schedule.takes(len(chosen) * cost):
            return form
        if len(chosen) >= _MANY:
            # some first, of the open ones: where they gain nothing, the others are not worth their rows
            some = opened if count >= _SOME else chosen
            some = some[:: max(1, len(some) // _SOME)]
            found = self._bounded(index, form, some, None, decides)
            at = tuple(torch.from_numpy(some.T))
            widths = [(f.upper - f.lower).reshape(open_.shape)[at] for f in (form, found)]
            lower, upper = (v.reshape(open_.shape)[at] for v in found.interval)
            form = found
            kept = float((widths[1] / widths[0]).median())
            part = count / open_.numel()
            undecided = float(((lower < 0.0) & (upper > 0.0)).double().mean()) if decides else 0.0
            if self.schedule.vain(kept, undecided, part):
                return form
            if whole and not self.schedule.gains(kept, part):
                self.schedule.spares((len(chosen) - count) * cost)
                chosen, goal = opened, signs
        spared = self.spared
        found = self._bounded(index, form, chosen, goal, decides)
        # where a sign is not all that is asked, every number has two rows
        self.schedule.spares((self.spared - spared) * (1.0 if decides else 0.5))
        return found

    def _ready(self, way: Way) -> int:
        """Where rows of a way end, when all is known that they end on."""
        for at, _ in way.rests:
            if at and at not in self.stops:
                form = self.forms[at]
                assert form is not None
                self.stops[at] = self._stop(at, form)
        return way.cut

    def _planned(self, index: int, form: _Form, open_: Tensor, layer: Activation | None) -> _Form:
        """Better bounds of all numbers of a node that matter, by rows as long as the network is worth (N18)."""
        shape = grid(self.network.shape(index))
        matters = torch.from_numpy(self.good).reshape(-1, 1, 1, 1) & torch.ones((self.count, *shape), dtype=torch.bool)
        if isinstance(layer, LeakyRelu) and layer.alpha == 0.0:
            matters &= form.interval.upper.reshape(matters.shape) > 0.0
        chosen = matters.nonzero().numpy()
        ways, rate = self.schedule.ways(index, len(chosen)) if len(chosen) else ([], 0.0)
        if not ways:
            return form
        some = chosen[:: -(-len(chosen) // TRIALS)]
        at = tuple(torch.from_numpy(some.T))
        # a row says enough of the other side of its number
        best, least = None, float(form.r.reshape(matters.shape)[at].mean().log())
        for way in ways:
            found = self._bounded(index, form, some, None, True, self._ready(way))
            radius = float(found.r.reshape(matters.shape)[at].mean().log())
            score = radius + rate * len(chosen) * way.price
            if score < least:
                best, least = way, score
        if best is None:
            return form
        self.schedule.left -= len(chosen) * best.price
        return self._bounded(index, form, chosen, None, True, best.cut)

    def _goal(self, form: _Form, products: float, layer: Activation | None) -> _Goal | None:
        """What rows for all numbers of a node, which take so many products to the image, are to find out (N17)."""
        part = self.schedule.suffices(products)
        if not part:
            return None
        size = float(form.reference.abs().median())
        relu = isinstance(layer, LeakyRelu)
        return _Goal(part * size, relu, relu and layer.alpha == 0.0)

    def _bounded(self, index: int, form: _Form, where: Int64, goal: _Goal | None, decides: bool, cut: int = 0) -> _Form:
        """The form with bounds by rows of the numbers ``where`` [R, (cell, channel, row, column)] of node ``index``.

        ``goal``: rows end where it is reached; ``decides``: the other side is not asked for where a sign is found out;
        ``cut``: all rows end on the nodes up to it (N18).
        """
        item = self.network.shape(index)
        cell, flat = where[:, 0], np.ravel_multi_index(tuple(where[:, 1:].T), grid(item))
        at = torch.from_numpy(cell), torch.from_numpy(flat)
        # the likelier side first; what it decides needs no other
        reference = form.reference.flatten(1)[at].numpy()
        sign = np.where(reference + form.c.flatten(1)[at].numpy() >= 0.0, 1.0, -1.0)

        def enough(part: Int64, sign: Float64) -> _Enough | None:
            return None if goal is None else _Enough(goal, -sign * reference[part], sign < 0.0)

        found = self._one_hot(index, where, sign, enough(np.arange(len(where)), sign), cut)
        found.turn(sign < 0.0)
        lower, upper = form.lower.flatten(1).clone(), form.upper.flatten(1).clone()
        low = np.maximum(lower[at].numpy(), found.lower) + reference
        high = np.minimum(upper[at].numpy(), found.upper) + reference
        left = np.flatnonzero((low < 0.0) & (high > 0.0)) if decides else np.arange(len(where))
        again = self._one_hot(index, where[left], -sign[left], enough(left, -sign[left]), cut)
        again.turn(sign[left] > 0.0)
        found.meet(left, again, sign[left] < 0.0)
        c, r = form.c.flatten(1).clone(), form.r.flatten(1).clone()
        a = form.a.flatten(2).movedim(1, -1).clone()
        center, radius = found.middle()
        better = radius < r[at]
        c[at] = torch.where(better, center[:, -1], c[at])
        a[at] = torch.where(better[:, None], center[:, :-1], a[at])
        r[at] = torch.where(better, radius, r[at])
        lower[at] = torch.maximum(lower[at], torch.from_numpy(found.lower))
        upper[at] = torch.minimum(upper[at], torch.from_numpy(found.upper))
        tight = _Form(
            form.reference,
            c.reshape(-1, *item),
            a.movedim(-1, 1).reshape(self.count, self.d, *item),
            r.reshape(-1, *item),
            lower.reshape(-1, *item),
            upper.reshape(-1, *item),
            form.active,
        )
        return self._within(tight, tight.lower, tight.upper)

    # ------------------------------------------------------------ backwards

    def _one_hot(self, index: int, where: Int64, sign: Float64, enough: _Enough | None, cut: int = 0) -> _Reached:
        """Bounds of ``sign`` [R] times single numbers [R, (cell, channel, row, column)] of node ``index``."""
        channels = grid(self.network.shape(index))[0]
        found = _Reached.unknown(len(where), self.d)
        step = min(self.most_rows, max(1, _ROWS_AT_ONCE // (16 * channels)))
        threads = torch.get_num_threads() if self.schedule.deep else 1
        if threads > 1:
            # as many rows as stay together to the image
            step = min(step, max(16, -(-len(where) // (4 * threads))))

        def bound(first: int) -> tuple[Int64, _Reached, Trace | None]:
            number = np.arange(first, min(len(where), first + step))
            cell, channel, y, x = (np.ascontiguousarray(v) for v in where[number].T)
            value = np.zeros((len(cell), channels, 1, 1), np.float32)
            value[np.arange(len(cell)), channel, 0, 0] = sign[number]
            trace = self._trace(len(cell))
            asked = None if enough is None else enough[number]
            part = self._backward(index, Rows(value, y, x), cell, asked, trace, cut)
            return number, part, trace

        for number, part, trace in on_threads(bound, range(0, len(where), step), threads):
            found.put(number, part)
            if self.schedule.deep:
                ends, count = np.unique(part.ended[part.ended > 0], return_counts=True)
                self.spared += sum(n * self.schedule.costs.row(int(at)) for at, n in zip(ends, count, strict=True))
            if trace is not None:
                self._keep(index, where[number], sign[number], trace)
        return found

    def _trace(self, count: int) -> Trace | None:
        """A place for so many rows that are to be kept (N15)."""
        return None

    def _keep(self, index: int, where: Int64, sign: Float64, trace: Trace) -> None:
        """Take notice of rows of ``sign`` times single numbers of node ``index``."""

    def _backward(
        self,
        index: int,
        rows: Rows,
        cell: Int64,
        enough: _Enough | None = None,
        trace: Trace | None = None,
        cut: int = 0,
    ) -> _Reached:
        """Bounds of rows on node ``index``, relative to the reference.

        Those of which ``enough`` is known may stop before the image; ``trace`` takes in what rows are on the way.
        All of them end on the nodes up to ``cut`` (N18).
        """
        found = _Reached.unknown(len(cell), self.d)
        passage = next(passage for passage in self.passages if passage.takes(rows))
        batch = _Batch({index: rows}, cell, np.zeros((len(cell), 2)), np.arange(len(cell)), passage)
        batch.trace = trace
        self._descend(index, index, batch, found, enough, cut)
        return found

    def _descend(
        self, start: int, at: int, batch: _Batch, found: _Reached, enough: _Enough | None, cut: int = 0
    ) -> None:
        """Pass a batch from node ``at`` on to the image, or to the nodes up to ``cut``."""
        checkpoint()
        while at > cut:
            if at not in batch.waiting:
                at -= 1
                continue
            if batch.bytes > min(_ROWS_AT_ONCE, self.memory // 16) and len(batch.cell) > 1:
                half = len(batch.cell) // 2
                for part in (slice(0, half), slice(half, None)):
                    self._descend(start, at, batch[part], found, enough, cut)
                return
            ends = enough is not None and (batch.trace is None or self.schedule.deep)
            if enough is not None and ends and at != start and at in self.stops and len(batch.waiting) == 1:
                self._bound_rows(at, batch, self.stops[at], found)
                going_on = ~enough.done(found, batch.number)
                if going_on.mean() < 0.75:
                    found.ended[batch.number[~going_on]] = at
                    batch = batch[going_on]
                if not len(batch.cell):
                    return
            here = batch.waiting.pop(at)
            node = self.network.nodes[at - 1]
            if batch.chosen is not None and at in batch.chosen.paid:
                flat, gained, offset = batch.chosen.paid[at]
                here = full(here, node.layer.shape, force=True)
                here.value.reshape(len(here.value), -1)[:, flat] += gained[batch.number]
                batch.total[:, 0] += offset[batch.number]
            if batch.chosen is not None and not isinstance(node.layer, Linear):
                here = full(here, node.layer.shape, force=True)
                batch.chosen.keep(at, here.value, batch.number, len(found.lower))
            gathered = batch.total.copy() if batch.trace is not None else batch.total
            if batch.trace is not None and not batch.trace.short and self._depends(start, at):
                batch.trace.keep(at, here, node.layer.shape, batch.number)
            if isinstance(node.layer, Activation):
                lines, which = batch.passage.lines[at], batch.cell
                if batch.chosen is not None and at in batch.chosen.lines:
                    lines, which = batch.chosen.lines[at], batch.number
                pass_activation(here.value, here.y, here.x, which, lines, batch.total)
                parts = [here]
            elif isinstance(node.layer, MaxPool):
                parts = [batch.passage.maxima[at].backward(here, node.layer, batch)]
            elif isinstance(node.layer, Product):
                # every reader changes its rows in place
                parts = [here, Rows(here.value.copy(), here.y, here.x)]
                for part, lines in zip(parts, batch.passage.products[at], strict=True):
                    pass_activation(part.value, part.y, part.x, batch.cell, lines, batch.total)
            else:
                if at == start or at not in self.folded:
                    shape = grid(node.layer.shape)
                    noise = batch.passage.noise[at].reshape(self.count, *shape).contiguous().numpy()
                    charge(here.value, here.y, here.x, batch.cell, noise, batch.total)
                parts = node.layer.backward(here)
            if batch.trace is not None and (batch.trace.short or isinstance(node.layer, (MaxPool, Product))):
                batch.trace.fixed[batch.number] += batch.total - gathered
            for source, part in zip(node.inputs, parts, strict=True):
                known = batch.waiting.get(source)
                shape = self.network.shape(source)
                batch.waiting[source] = full(part, shape) if known is None else join(known, part, shape)
        if cut:
            self._rest_rows(batch, found)
            return
        if batch.chosen is not None and 0 in batch.waiting:
            whole = full(batch.waiting[0], self.network.input_shape, force=True)
            batch.chosen.keep(0, whole.value, batch.number, len(found.lower))
        if batch.trace is not None:
            batch.trace.reached[batch.number] = True
            if 0 in batch.waiting:
                batch.trace.keep(0, batch.waiting[0], self.network.input_shape, batch.number)
        self._bound_rows(0, batch, self.columns, found)

    def _depends(self, start: int, at: int) -> bool:
        """Whether what rows that start at node ``start`` gather at another one depends on the cell's ranges (N15)."""
        layer = self.network.nodes[at - 1].layer
        return isinstance(layer, Activation) or (isinstance(layer, Linear) and at != start and at not in self.folded)

    def _bound_rows(self, at: int, batch: _Batch, known: Columns, found: _Reached) -> None:
        """Bounds of a batch whose rows are all on node ``at``."""
        count = len(batch.cell)
        plane, box = np.zeros((count, 2, self.d + 1)), np.zeros((count, 2))
        rows = batch.waiting.get(at)
        if rows is None:
            plane[:, :, -1] = box[:] = batch.total
        else:
            concretize(rows.value, rows.y, rows.x, batch.cell, known, batch.total, plane, box)
        lost = self.flush[batch.cell][:, None] * np.array([-1.0, 1.0])
        plane[:, :, -1] += lost
        box += lost
        found.improve(batch.number, plane, box)

    def _rest_rows(self, batch: _Batch, found: _Reached) -> None:
        """Bounds of a batch whose rows rest on several nodes, of which forms are known (N18)."""
        count, total = len(batch.cell), batch.total
        plane, box = np.zeros((count, 2, self.d + 1)), np.zeros((count, 2))
        sizes = np.zeros(count)
        for at, rows in batch.waiting.items():
            known = self.stops[at] if at else self.columns
            one, two = np.zeros_like(plane), np.zeros_like(box)
            concretize(rows.value, rows.y, rows.x, batch.cell, known, total, one, two)
            plane += one
            box += two
            sizes += np.abs(one).sum((1, 2)) + np.abs(two).sum(1)
            total = np.zeros_like(total)
        lost = self.flush[batch.cell] + 2.0**-52 * len(batch.waiting) * sizes
        lost = lost[:, None] * np.array([-1.0, 1.0])
        plane[:, :, -1] += lost
        box += lost
        found.improve(batch.number, plane, box)

    def _climb(self, index: int, rows: Rows, cell: Int64, need: Float64) -> tuple[_Reached, Int64]:
        """Bounds below of rows on node ``index``, with the best slopes and multipliers that were tried (N14, N16).

        Where signs are assumed, a cell whose rows are above ``need`` [R] is done. Also returns `OutputBounds.loosest`
        of the rows.
        """
        loosest = np.full((len(cell), 2), -1, np.int64)
        if not self.slope_steps:
            return self._backward(index, rows, cell), loosest
        # slopes are chosen in float32
        start = Rows(rows.value.astype(np.float32), rows.y, rows.x)
        best, lines = self._backward(index, rows, cell), self.passages[0].lines
        for k in np.unique(cell):
            units = {at: opened.of(k) for at, opened in self.open.items()}
            units = {at: opened for at, opened in units.items() if len(opened.flat)}
            own, held = np.flatnonzero(cell == k), self.held[k]
            if not (units or held) or not self.good[k]:
                continue
            first = {at: lines[at][0, k].reshape(-1)[opened.flat] for at, opened in units.items()}
            ascent = Ascent(units, first, len(own), held)
            for _ in range(self.slope_steps + 1):
                if self.assumed is not None and bool((best.lower[own] > need[own]).all()):
                    break
                chosen = ascent.lines(lines, k)
                found = _Reached.unknown(len(own), self.d)
                # rows are changed in place
                part = Rows(start.value[own], start.y[own], start.x[own])
                total, number = np.zeros((len(own), 2)), np.arange(len(own))
                self._descend(
                    index, index, _Batch({index: part}, cell[own], total, number, self.passages[0], chosen), found, None
                )
                better = found.lower > best.lower[own]
                best.lower[own[better]], best.plane[own[better]] = found.lower[better], found.plane[better]
                slopes, forces = self._derivatives(k, chosen, found, units)
                ascent.climb(slopes, forces, {at: self._size(chosen, at) for at in held})
            else:
                loosest[own] = self._loosest(chosen, units, len(own))
        return best, loosest

    def _size(self, chosen: Chosen, source: int) -> float:
        """What coefficients of rows on the readers of node ``source`` are about."""
        found = [
            float(np.abs(chosen.trace[k]).mean())
            for k, node in enumerate(self.network.nodes, 1)
            if source in node.inputs and k in chosen.trace
        ]
        return max(found, default=0.0)

    def _loosest(self, chosen: Chosen, units: Mapping[int, OpenUnits], count: int) -> Int64:
        """[R, 2] the node and place of the input of the open unit that costs each row most."""
        found, most = np.full((count, 2), -1, np.int64), np.full(count, -1.0)
        for k, opened in units.items():
            if k not in chosen.trace:
                continue
            losses = opened.losses(chosen.trace[k].reshape(count, -1)[:, opened.flat])
            at = losses.argmax(1)
            value = losses[np.arange(count), at]
            here = value > most
            most[here] = value[here]
            found[here, 0], found[here, 1] = self.network.nodes[k - 1].inputs[0], opened.flat[at[here]]
        return found

    def _derivatives(
        self, cell: int, chosen: Chosen, found: _Reached, units: Mapping[int, OpenUnits]
    ) -> tuple[dict[int, Float64], dict[int, Float64]]:
        """How the bounds of a cell's rows change with slopes and with multipliers."""
        planes, held = self.image, self.held[cell]
        rows = chosen.trace.get(0)
        if rows is None:
            rows = np.zeros((len(found.lower), *grid(self.network.input_shape)), np.float32)
        p = -np.sign(np.nan_to_num(found.plane[:, 0, :-1]))
        ends = np.einsum("schwd,rd->srchw", planes.slopes[cell], p) + planes.offsets[cell][:, None]
        image = np.where(rows >= 0.0, ends[0], ends[1]).astype(np.float32)
        others: dict[int, Any] = {}
        for k, (one, two) in self.passages[0].products.items():
            others[k] = functools.partial(_product, torch.from_numpy(one[:, cell]), torch.from_numpy(two[:, cell]))
        for k, maxima in self.passages[0].maxima.items():
            layer = self.network.nodes[k - 1].layer
            assert isinstance(layer, MaxPool)
            others[k] = functools.partial(maxima.forward, layer, cell)

        def lines(k: int) -> np.ndarray:
            return chosen.lines[k] if k in chosen.lines else self.passages[0].lines[k][:, cell : cell + 1]

        shaped = torch.from_numpy(image).reshape(-1, *self.network.input_shape)
        return derivatives(self.network, shaped, chosen.trace, lines, units, others, held)

    def outputs(self, rows: Any, offset: Float64) -> OutputBounds:
        """Bounds of ``rows @ y + offset`` in every cell."""
        index = len(self.network.nodes)
        m, k = self.count, len(offset)
        plane, lower = np.zeros((m, k, self.d + 1)), np.zeros((m, k))
        loosest = np.zeros((m, k, 2), np.int64)
        shape = grid(self.network.shape(index))
        dense = np.asarray(rows.toarray() if hasattr(rows, "toarray") else rows, np.float64)
        stored = dense.astype(self.passages[-1].number)
        size = self.last.width.reshape(m, -1).numpy()
        reference = self.last.reference.reshape(m, -1).numpy()
        missing = size @ np.abs(dense - stored).T
        missing += 2.0**-52 * (dense.shape[1] + 2) * (np.abs(reference) @ np.abs(dense).T)
        offset = reference @ dense.T + offset
        need = -offset + _SURE * (1.0 + np.abs(offset))
        for top, left, height, width, number in _windows(stored.reshape(k, *shape)):
            part = stored.reshape(k, *shape)[:, :, top : top + height, left : left + width]
            step = max(1, _ROWS_AT_ONCE // (stored.itemsize * shape[0] * height * width))
            for first in range(0, m * len(number), step):
                which = np.arange(first, min(m * len(number), first + step))
                cell, row = which // len(number), number[which % len(number)]
                rows = Rows(np.ascontiguousarray(part[row]), np.full(len(which), top), np.full(len(which), left))
                found, loosest[cell, row] = self._climb(index, rows, cell, need[cell, row])
                plane[cell, row], lower[cell, row] = found.plane[:, 0], found.lower
        room = 2.0**-48 * (np.abs(plane).sum(-1) + np.abs(offset) + missing) + missing
        lower, b = lower + offset - room, plane[..., -1] + offset - room
        a = plane[..., :-1]
        known = self.good[:, None] & np.isfinite(lower)
        usable = self.good[:, None] & np.isfinite(b) & np.isfinite(a).all(-1)
        lower = np.where(self.vacant[:, None], np.inf, np.where(known, lower, -np.inf))
        return OutputBounds(lower, np.where(usable[..., None], a, 0.0), np.where(usable, b, -np.inf), loosest)


def _tilted(slope: Tensor, z: _Form, line: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """(low, high, tilt [m, d, *shape]): an activation less ``slope`` times its input is between low and high + tilt p.

    ``line``: slope and offsets of lines on both sides of it; the input is followed in between.
    """
    own, below, above = line
    t = own - slope
    middle, size = t * (z.reference + z.c), z.reference.abs() + z.c.abs() + z.a.abs().sum(1)
    half = t.abs() * (z.r * (1.0 + 2.0**-40) + 2.0**-48 * size)
    return below + middle - half, above + middle + half, t[:, None] * z.a


def _open_units(layer: LeakyRelu, given: tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]) -> OpenUnits:
    """The units [m, *shape] of a ReLU that are open, with what `OpenUnits` holds of them."""
    where = layer.open(given[0], given[1]).flatten(1).nonzero()
    at = where[:, 0], where[:, 1]
    lower, upper, reference, image, loose, room = (v.flatten(1)[at].numpy() for v in given)
    cell, flat = (v.numpy() for v in at)
    return OpenUnits(cell, flat, lower, upper, reference, image, loose, room, layer.alpha)


def _product(one: Tensor, two: Tensor, rows: Tensor, inputs: list[Tensor]) -> Tensor:
    """The planes that ``rows`` take of a product's factors."""
    x, y = (v.reshape(rows.shape) for v in inputs)
    offset = torch.where(rows >= 0.0, one[1] + two[1], one[4] + two[4])
    return one[0] * x + two[0] * y + offset


def _windows(rows: np.ndarray) -> list[tuple[int, int, int, int, Int64]]:
    """Windows (top, left, height, width) of rows [k, C, H, W] that are zero elsewhere, and which rows they hold."""
    used = (rows != 0.0).any(axis=1)
    groups: dict[tuple[int, int, int, int], list[int]] = {}
    for k, mask in enumerate(used):
        ys, xs = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        window = (ys[0], xs[0], ys[-1] - ys[0] + 1, xs[-1] - xs[0] + 1) if len(ys) else (0, 0, 1, 1)
        groups.setdefault(tuple(map(int, window)), []).append(k)  # type: ignore[arg-type]
    return [(*window, np.array(number)) for window, number in groups.items()]


class _Planes(NamedTuple):
    """What is known of a node, as rows want it.

    Attributes:
        slopes: [m, 2, C, H, W, d] of the lower and the upper plane.
        offsets: [m, 2, C, H, W].
        lower, upper: [m, C, H, W].
    """

    slopes: Float64
    offsets: Float64
    lower: Float64
    upper: Float64


@dataclass
class _Passage:
    """What rows of one type take on their way through the nodes, with what they lose themselves (N2).

    Attributes:
        dtype: Of rows, slopes and offsets.
        unit: Its unit roundoff.
        lines: By activation, [6, m, C, H, W] as `pass_activation` takes them.
        products: By product: the same for its first and its second factor.
        maxima: By maximum.
        noise: By linear layer: rounding of the network and of rows, [m, *shape] float64.
    """

    dtype: torch.dtype
    unit: float
    lines: dict[int, np.ndarray] = field(default_factory=dict)
    products: dict[int, tuple[np.ndarray, ...]] = field(default_factory=dict)
    maxima: dict[int, _Maxima] = field(default_factory=dict)
    noise: dict[int, Tensor] = field(default_factory=dict)

    @property
    def number(self) -> type[np.floating[Any]]:
        """The type as numpy has it."""
        return np.float32 if self.dtype == torch.float32 else np.float64

    def takes(self, rows: Rows) -> bool:
        """Whether rows are of this type."""
        return rows.value.dtype == self.number


class _Tilted(NamedTuple):
    """Windows whose winner may be exceeded, and planes above them.

    Attributes:
        at: Their cells, channels and numbers, [n] each.
        top: [n] what may be above the winner.
        known: Their numbers.
        near: [n, K] how far these may be from their references.
        planes: One above each.
    """

    at: tuple[Tensor, ...]
    top: Tensor
    known: Candidates
    near: Tensor
    planes: Planes


class _Maxima(NamedTuple):
    """Planes of a maximum's windows, as rows want them (N12).

    Attributes:
        winner: [m, C, H, W] int16, the number that the lower plane follows.
        which: [m, C, H, W] int32, rows of ``slopes``; -1 where the winner is the maximum.
        slopes: [U, K] of upper planes; of the rows' type, as offsets are.
        offsets: [4, m, C, H, W]: lower and upper for coefficients that are not negative, upper and lower
            for negative ones.
    """

    winner: np.ndarray
    which: np.ndarray
    slopes: np.ndarray
    offsets: np.ndarray

    def forward(self, layer: MaxPool, cell: int, rows: Tensor, inputs: list[Tensor]) -> Tensor:
        """The planes that ``rows`` [R, C, H, W] take, of inputs [R, C, H', W'] of one cell."""
        taps = layer.taps(inputs[0], 0.0)
        winner = torch.from_numpy(self.winner[cell].astype(np.int64)).flatten(1)[None, :, None]
        value = taps.gather(2, winner.expand(len(taps), -1, -1, -1))[:, :, 0]
        offsets = torch.from_numpy(self.offsets[:, cell]).flatten(2)
        which = torch.from_numpy(self.which[cell].astype(np.int64)).flatten(1)
        a = rows.flatten(2)
        if len(self.slopes):
            slopes = torch.from_numpy(self.slopes)[which.clamp(min=0)].movedim(2, 1)
            value = torch.where((a >= 0.0) | (which < 0), value, (taps * slopes).sum(2))
        return value + torch.where(a >= 0.0, offsets[0], offsets[2])

    def backward(self, rows: Rows, layer: MaxPool, batch: _Batch) -> Rows:
        """Rows on the input; what they gather on the way goes to the batch."""
        height, width = rows.value.shape[2:]
        (down, right), extent = layer.stride, layer.steps.max(0) + 1
        size = (height - 1) * down + int(extent[0]), (width - 1) * right + int(extent[1])
        target = np.zeros((*rows.value.shape[:2], *size), rows.value.dtype)
        pass_maximum(rows.value, rows.y, rows.x, batch.cell, *self, layer.steps, layer.stride, batch.total, target)
        return Rows(target, rows.y * down - layer.pads[0], rows.x * right - layer.pads[1])


class _Offered(NamedTuple):
    """An activation beside slopes of another cell's rows (N15).

    Attributes:
        lines: [6, m, C, H, W] float32 as `pass_activation` takes them.
        tilts: [2, m, d, n] slopes in the parameters of what is between the offsets, for rows of either sign.
    """

    lines: np.ndarray
    tilts: Float64


class Trace:
    """What rows of one call of `_Cells._backward` are on their way to the image.

    Args:
        count: Rows R.
        short: Whether only what they are on the image is kept.

    Attributes:
        rows: By node: [R, n] float32 rows on outputs of nodes at which they gather what depends on the cell's ranges,
            and on the image (0).
        fixed: [R, 2] what they gather at nodes of which they are not kept, at least and at most.
        reached: [R] which of them reach the image.
    """

    def __init__(self, count: int, short: bool) -> None:
        self.short = short
        self.rows: dict[int, NDArray[np.float32]] = {}
        self.fixed = np.zeros((count, 2))
        self.reached = np.zeros(count, bool)

    def keep(self, at: int, rows: Rows, shape: tuple[int, ...], number: Int64) -> None:
        """Remember rows ``number`` on the output of node ``at``."""
        if at not in self.rows:
            self.rows[at] = np.zeros((len(self.fixed), int(np.prod(shape))), np.float32)
        whole = full(rows, shape, force=True)
        self.rows[at][number] = whole.value.reshape(len(number), -1)


@dataclass
class _Batch:
    """Rows under way.

    Attributes:
        waiting: By node.
        cell: [R] of every row.
        total: [R, 2] what rows gathered so far, at least and at most.
        number: [R] positions in the result.
        passage: What they take.
        chosen: Lines of rows' own, and a place for what rows are on the way.
        trace: A place for what rows are on the way.
    """

    waiting: dict[int, Rows]
    cell: Int64
    total: Float64
    number: Int64
    passage: _Passage
    chosen: Chosen | None = None
    trace: Trace | None = None

    def __getitem__(self, part: Any) -> _Batch:
        waiting = {k: rows[part] for k, rows in self.waiting.items()}
        return _Batch(
            waiting, self.cell[part], self.total[part], self.number[part], self.passage, self.chosen, self.trace
        )

    @property
    def bytes(self) -> int:
        return sum(rows.value.nbytes for rows in self.waiting.values())


class _Goal(NamedTuple):
    """What rows of a node's numbers are to find out; a matter of tightness alone (N6, N17).

    Attributes:
        width: How far apart a number's bounds may be; None: its sign is all that is asked.
        kink: Whether the sign is asked for.
        cut: Whether a number that is certainly not positive may have any bounds.
    """

    width: float | None = None
    kink: bool = True
    cut: bool = True


@dataclass(frozen=True)
class _Enough:
    """When rows of single numbers need not go on to the image.

    Attributes:
        goal: What is asked for.
        zero: [R] what a row is where its number is zero.
        negative: [R] whether a row is its number's negative.
    """

    goal: _Goal
    zero: Float64
    negative: np.ndarray

    def __getitem__(self, chosen: Any) -> _Enough:
        return replace(self, zero=self.zero[chosen], negative=self.negative[chosen])

    def done(self, found: _Reached, number: Int64) -> np.ndarray:
        """Which of the rows ``number`` are done."""
        zero, lower, upper = self.zero[number], found.lower[number], found.upper[number]
        if self.goal.width is None:
            # the other side is asked for by another row
            return lower >= zero
        tight = upper - lower <= self.goal.width
        if not self.goal.kink:
            return tight
        off = np.where(self.negative[number], lower >= zero, upper <= zero) & self.goal.cut
        return off | (tight & ((lower >= zero) | (upper <= zero)))


@dataclass
class _Reached:
    """What rows are at least and at most.

    Attributes:
        plane: [R, 2, d + 1] slopes and offset of a plane below and one above; NaN if unknown.
        lower, upper: [R]; infinite if unknown.
        ended: [R] the node at which they ended; 0 is the image.
    """

    plane: Float64
    lower: Float64
    upper: Float64
    ended: Int64

    @staticmethod
    def unknown(count: int, d: int) -> _Reached:
        infinite = np.full(count, np.inf)
        return _Reached(np.full((count, 2, d + 1), np.nan), -infinite, infinite, np.zeros(count, np.int64))

    def put(self, number: Int64, other: _Reached) -> None:
        self.plane[number], self.lower[number], self.upper[number] = other.plane, other.lower, other.upper
        self.ended[number] = other.ended

    def turn(self, mask: np.ndarray) -> None:
        """Negate the rows of ``mask``."""
        self.plane[mask] = -self.plane[mask][:, ::-1]
        self.lower[mask], self.upper[mask] = -self.upper[mask], -self.lower[mask]

    def meet(self, number: Int64, other: _Reached, below: np.ndarray) -> None:
        """Take in other bounds of the rows ``number``, and their planes below or above."""
        side = np.where(below, 0, 1)
        self.plane[number, side] = other.plane[np.arange(len(number)), side]
        self.lower[number] = np.maximum(self.lower[number], other.lower)
        self.upper[number] = np.minimum(self.upper[number], other.upper)

    def middle(self) -> tuple[Tensor, Tensor]:
        """[R, d + 1] the plane between, and [R] how far the others are from it at most."""
        low, high = self.plane[:, 0], self.plane[:, 1]
        gap = high - low
        radius = 0.5 * (gap[:, -1] + np.abs(gap[:, :-1]).sum(1))
        radius = np.maximum(radius, 0.0) + 2.0**-48 * (np.abs(low).sum(1) + np.abs(high).sum(1))
        return torch.from_numpy(0.5 * (low + high)), torch.from_numpy(radius)

    def improve(self, number: Int64, plane: Float64, box: Float64) -> None:
        """Planes of the latest node; the best numbers of all: a plane's extremes or what the box says."""
        slopes = np.abs(plane[:, :, :-1]).sum(-1)
        room = 2.0**-50 * (np.abs(plane[:, :, -1]) + slopes)
        self.plane[number] = plane
        least = np.fmax(plane[:, 0, -1] - slopes[:, 0] - room[:, 0], box[:, 0])
        most = np.fmin(plane[:, 1, -1] + slopes[:, 1] + room[:, 1], box[:, 1])
        self.lower[number] = np.fmax(self.lower[number], least)
        self.upper[number] = np.fmin(self.upper[number], most)


def _gamma(count: Any, unit: float | None = None) -> Any:
    """What ``count`` roundings, in float32 unless said otherwise, may change, relatively."""
    unit = UNIT if unit is None else unit
    return count * unit / (1.0 - count * unit)


def _outward(value: Tensor, side: float) -> Tensor:
    """The float32 neighbour on one side, half a unit away at least; zero stays."""
    near = value.float()
    return torch.where(value == 0.0, near, torch.nextafter(near, torch.full_like(near, side * torch.inf)))
