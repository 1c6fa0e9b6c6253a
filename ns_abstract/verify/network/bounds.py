"""Bounds of a network's outputs over sets of images (docs/design.md, N, N0-N2, N6, N12-N14, N16-N18, N20)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ns_abstract.verify.network.backward import ROWS_AT_ONCE, Backward
from ns_abstract.verify.network.forms import Form, Interval
from ns_abstract.verify.network.graph import Network, NetworkArithmetic
from ns_abstract.verify.network.image import finite, middle_of, planes_of
from ns_abstract.verify.network.known import Known
from ns_abstract.verify.network.layers import Activation, LeakyRelu, Linear, Sum
from ns_abstract.verify.network.maxima import Candidates, MaxPool, Planes, upper_planes
from ns_abstract.verify.network.outputs import Outputs
from ns_abstract.verify.network.passages import Maxima, Offered, Passage
from ns_abstract.verify.network.products import Product
from ns_abstract.verify.network.reached import Enough, Goal, Reached, Trace
from ns_abstract.verify.network.rounding import FLUSH, OVERFLOW, SPARE, UNIT, Rounding, gamma
from ns_abstract.verify.network.rows import (
    Float64,
    Int64,
    Rows,
    grid,
)
from ns_abstract.verify.network.schedule import TRIALS, Schedule, on_threads
from ns_abstract.verify.network.sets import ImageSets, OutputBounds, Signs, Substitution
from ns_abstract.verify.network.slopes import Held, OpenUnits

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
        fields, good = finite(images)
        middle = self._about(middle_of(fields))
        image = planes_of(fields, middle, network.input_shape, substitution)
        self.network = network
        self.known = Known(network, image, middle, good, arithmetic, assumed)
        self.slope_steps = slope_steps
        self.schedule = Schedule(network)
        self.backward = Backward(self.known, memory, self.schedule.deep)
        self.rounding = Rounding(network)
        #: products that rows have not taken because they ended on the way
        self.spared = 0.0
        #: part of the latest ReLU's inputs whose signs have not been found out
        self.unsure = 0.0
        self.last = self._forward()
        if substitution == "end":
            self.known.see(planes_of(fields, middle, network.input_shape, "everywhere"))

    def outputs(self, rows: Any, offset: Float64) -> OutputBounds:
        """Bounds of ``rows @ y + offset`` in every cell."""
        return Outputs(self.known, self.backward, self.slope_steps).bound(self.last, rows, offset)

    def _about(self, middle: Float64) -> Float64:
        """[m, n] pictures that all is relative to, for the sets' middles: any will do."""
        return middle

    def _reference(self, k: int, passed_on: Callable[[], Tensor]) -> Tensor:
        """[m, *shape] what is relative to at node ``k``: that of its inputs passed on with float64's rounding."""
        return passed_on()

    def _sized(self, form: Form) -> Form:
        """The form, or one of more cells, by which rounding is charged: sizes are all that is read of it."""
        return form

    def _winner(self, k: int, winner: Tensor) -> Tensor:
        """[m, C, 1, W] numbers of windows that are followed from below at node ``k``: any will do."""
        return winner

    # ------------------------------------------------------------ forwards

    def _forward(self) -> Form:
        """Lines and rounding of every node; returns what is known of the last one."""
        forms: list[Form | None] = [self.known.first()]
        self.known.forms = forms
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
                    self.known.stops[source] = self.known.stop(source, inputs[0])
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
        self.known.forms = []
        return end

    def _learn(self, index: int, cut: bool) -> None:
        """Tell the schedule how wide bounds of node ``index`` are; ``cut``: those of numbers that are not cut off."""
        form = self.known.forms[index]
        assert form is not None
        r = form.r
        if cut:
            above = form.interval.upper > 0.0
            r = r[above] if bool(above.any()) else r
        self.schedule.learns(index, float(r.mean()), float(form.reference.abs().mean()))

    def _leave(self, index: int) -> None:
        """Node ``index`` has been read; rows of later ones may end there (N18)."""
        form, self.known.forms[index] = self.known.forms[index], None
        if index in self.schedule.rests and index not in self.known.stops:
            assert form is not None
            self.known.stops[index] = self.known.stop(index, form)

    def _assume(self, source: int, z: Form) -> Form:
        """What is known of node ``source`` where its numbers have the signs that are assumed (N16)."""
        if self.known.assumed is None or not any(source in signs for signs in self.known.assumed):
            return z
        lower, upper = (v.flatten(1).clone() for v in (z.lower, z.upper))
        least, most = (v.flatten(1).numpy() for v in z.interval)
        reference, width = z.reference.flatten(1), z.width.flatten(1).numpy()
        for cell, signs in enumerate(self.known.assumed):
            if source not in signs or not self.known.good[cell]:
                continue
            flat, side = signs[source]
            if bool(np.where(side > 0.0, most[cell, flat] < 0.0, least[cell, flat] > 0.0).any()):
                self.known.vacant[cell] = True
                continue
            at, positive = torch.from_numpy(flat), torch.from_numpy(side > 0.0)
            zero = -reference[cell, at]
            low, high = lower[cell, at], upper[cell, at]
            lower[cell, at] = torch.where(positive, torch.minimum(torch.maximum(low, zero), high), low)
            upper[cell, at] = torch.where(positive, high, torch.maximum(torch.minimum(high, zero), low))
            noise = UNIT * (SPARE + self.network.readers[source]) * width[cell, flat]
            if self.known.rounds(source):
                noise = noise + self.known.passages[0].noise[source].flatten(1).numpy()[cell, flat]
            self.known.held[cell][source] = Held(flat, side, -zero.numpy(), noise)
        return replace(z, lower=lower.reshape(z.lower.shape), upper=upper.reshape(z.upper.shape))

    def _combine(self, k: int, sources: tuple[int, ...], layer: Linear, inputs: list[Form]) -> Form:
        """A linear layer (N1, N2)."""
        m, d = self.known.count, self.known.d
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
        moves = own * size + (layer.terms + 1) * FLUSH
        active = None
        if not layer.terms:
            active = layer.magnitude([f.active.double() for f in inputs]) != 0.0
            if layer.bias is not None:
                active = active | (layer.bias != 0.0)
        elif self.known.single:

            def end(moves: Tensor = moves) -> Tensor:
                return (reference + moved[:, 0]).abs() + moved[:, 1:].abs().sum(1) + radius + moves

            moves = moves + self.rounding.charge(k, sources, layer, known, size, end) + layer.spare(sizes)
        roundings = layer.row_terms + SPARE + max(self.network.readers[i] for i in sources)
        form = Form.ranged(reference, moved[:, 0], moved[:, 1:], radius + moves, active)
        if float(size.amax()) >= OVERFLOW:
            self.known.good &= (size.flatten(1).amax(1) < OVERFLOW).numpy()
        for sized, shape in zip(known, layer.input_shapes, strict=True):
            lost = int(np.prod(shape)) * (layer.row_terms + 2) * FLUSH
            self.known.flush += lost * sized.width.flatten(1).amax(1).numpy()
        folded = [
            i for i in sources if isinstance(layer, Sum) and self.known.rounds(i) and self.network.readers[i] == 1
        ]
        self.known.folded.update(folded)
        for passage in self.known.passages:
            rows = gamma(roundings, passage.unit)
            noise = ((moves + rows * width) * (1.0 + 2.0**-40)).expand(m, *layer.shape)
            for source in folded:
                # one charge instead of several
                noise = noise + passage.noise[source]
            passage.noise[k] = noise * (1.0 + 2.0**-40 + passage.sums)
        return self.known.within(form, form.lower, form.upper)

    def _activate(self, k: int, source: int, layer: Activation, z: Form) -> Form:
        """An activation (N3, N4)."""
        lower, upper = z.interval
        size = z.interval.size
        reference = self._reference(k, lambda: layer.function(z.reference))
        room = layer.missing(lower, upper) + 2.0**-48 * reference.abs()
        if self.known.single:
            room = room + layer.error(lower, upper)
        band = layer.band(lower, upper)
        s = band.lower_slope
        base = s * z.reference - reference
        middle = 0.5 * (band.lower_offset + band.upper_offset) + base
        half = 0.5 * (band.upper_offset - band.lower_offset) + 2.0**-50 * middle.abs() + room
        half = half + 2.0**-50 * (band.lower_offset.abs() + band.upper_offset.abs() + s.abs() * z.reference.abs())
        half = half + 2.0**-48 * s.abs() * (z.c.abs() + z.a.abs().sum(1))
        radius = s.abs() * z.r * (1.0 + 2.0**-40) + half
        form = Form.ranged(reference, s * z.c + middle, s[:, None] * z.a, radius)
        if isinstance(layer, LeakyRelu) and layer.alpha == 0.0:
            form.active = upper > 0.0
        lines = layer.lines(lower, upper)
        fold = self.known.rounds(source) and self.network.readers[source] == 1

        def stored(chosen: Sequence[tuple[Tensor, Tensor, Tensor]], passage: Passage) -> np.ndarray:
            """As `pass_activation` wants slope, lower and upper offset for rows of either sign."""
            # the slope as stored, rows' products with it and sums where branches meet
            found, unit = [], (SPARE + self.network.readers[source]) * passage.unit
            for (slope, low, high), side in zip(chosen, (-1.0, 1.0), strict=True):
                rounded = slope.to(passage.dtype).double()
                base, apart = slope * z.reference - reference, band.lower_slope - slope
                give = ((rounded - slope).abs() + unit * slope.abs()) * z.width + 2.0**-48 * apart.abs() * size + room
                give = give + 2.0**-48 * (low.abs() + high.abs() + slope.abs() * z.reference.abs())
                if fold:
                    give = give + rounded.abs() * passage.noise[source]
                ends = (
                    passage.outward(low + base - give, -1.0),
                    passage.outward(high + base + give, 1.0),
                )
                found += [rounded.to(passage.dtype), *(ends if side < 0.0 else reversed(ends))]
            return torch.stack(found).reshape(6, self.known.count, *grid(layer.shape)).numpy()

        # the other sides of lines with these slopes are the band's
        above = layer.offsets(lines.lower_slope, lower, upper, band)[1]
        below = layer.offsets(lines.upper_slope, lower, upper, band)[0]
        own = (lines.lower_slope, lines.lower_offset, above), (lines.upper_slope, below, lines.upper_offset)
        for passage in self.known.passages:
            passage.lines[k] = stored(own, passage)
        lent = self._lent(k)
        if lent is not None:
            slopes = [torch.from_numpy(v).double().expand(self.known.count, *layer.shape) for v in lent]
            plain = [layer.offsets(slope, lower, upper, band) for slope in slopes]
            tilted = [_tilted(slope, z, line) for slope, line in zip(slopes, own, strict=True)]
            # each is there for one side
            better = tilted[0][0] > plain[0][0], tilted[1][1] < plain[1][1]
            offsets, tilts = [], []
            for slope, ends, (low, high, tilt), use in zip(slopes, plain, tilted, better, strict=True):
                offsets.append((slope, torch.where(use, low, ends[0]), torch.where(use, high, ends[1])))
                tilts.append(torch.where(use[:, None], tilt, torch.zeros_like(tilt)))
            self.known.offered[k] = Offered(
                stored(offsets, self.known.passages[0]), torch.stack(tilts).flatten(3).numpy()
            )
        if fold:
            self.known.folded.add(source)
        if self.slope_steps and isinstance(layer, LeakyRelu):
            first = self.known.passages[0]
            loose = (SPARE + self.network.readers[source]) * first.unit * z.width
            loose = loose + (first.noise[source] if fold else 0.0)
            given = (lower, upper, z.reference, reference, loose, room + torch.zeros_like(lower))
            self.known.open[k] = _open_units(layer, given)
        lost = int(np.prod(layer.shape)) * 2 * FLUSH
        self.known.flush += lost * z.width.reshape(self.known.count, -1).amax(1).numpy()
        ends = layer.range(lower, upper)
        room = room + 2.0**-48 * (ends[0].abs() + ends[1].abs())
        return self.known.within(form, ends[0] - reference - room, ends[1] - reference + room)

    def _lent(self, k: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Slopes [1, *shape] of rows of another cell on node ``k``, not negative and negative ones."""
        return None

    def _multiply(self, k: int, sources: tuple[int, ...], layer: Product, x: Form, y: Form) -> Form:
        """A product of two nodes (N9)."""
        m, first, second = self.known.count, x.interval, y.interval
        size = first.size * second.size
        reference = self._reference(k, lambda: x.reference * y.reference)
        plane = layer.plane(first, second)
        alpha, beta = plane.first, plane.second
        base = alpha * x.reference + beta * y.reference - reference
        # roundings of the plane relative to the references, and the network's
        own = alpha.abs() * x.reference.abs() + beta.abs() * y.reference.abs() + reference.abs()
        room = 2.0**-48 * (own + plane.low.abs() + plane.high.abs()) + 2 * FLUSH
        if self.known.single:
            room = room + 2 * UNIT * size
        shape = (6, m, *grid(layer.shape))
        for passage in self.known.passages:
            # rows' products with the slopes, which are float32 numbers, and sums where branches meet
            unit = (SPARE + max(self.network.readers[i] for i in sources)) * passage.unit
            give = room + unit * (alpha.abs() * x.width + beta.abs() * y.width)
            low = passage.outward(plane.low + base - give, -1.0)
            high = passage.outward(plane.high + base + give, 1.0)
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
        form = Form.ranged(reference, c, a, radius, x.active & y.active)
        for f in (x, y):
            lost = int(np.prod(layer.shape)) * 2 * FLUSH
            self.known.flush += lost * f.width.reshape(m, -1).amax(1).numpy()
        if float(size.amax()) >= OVERFLOW:
            self.known.good &= (size.reshape(m, -1).amax(1) < OVERFLOW).numpy()
        ends = torch.stack([u * v for u in first for v in second]) - reference
        room = room + 2.0**-50 * (size + reference.abs())
        return self.known.within(form, ends.amin(0) - room, ends.amax(0) + room)

    def _maximum(self, k: int, source: int, layer: MaxPool, x: Form) -> Form:
        """Maxima over windows (N12); the reference is that of the number which the lower plane follows."""
        m, shape = self.known.count, layer.shape
        interval = x.interval
        lower, upper = (layer.taps(v, -torch.inf) for v in interval)
        winner = self._winner(k, layer.taps(x.reference + x.c, -torch.inf).argmax(2, keepdim=True))

        def chosen(v: Tensor) -> Tensor:
            return layer.taps(v, 0.0).gather(2, winner)[:, :, 0]

        reference, c, r, width = (chosen(v) for v in (x.reference, x.c, x.r, x.width))
        a = torch.stack([chosen(x.a[:, i]) for i in range(self.known.d)], 1)
        # sums of rows where windows overlap
        units = [
            (SPARE + layer.overlaps + self.network.readers[source]) * passage.unit for passage in self.known.passages
        ]
        gives = [unit * width for unit in units]
        offsets = [torch.stack([-give, give, give, -give], 0) for give in gives]
        rivals = upper.scatter(2, winner, -torch.inf).amax(2)
        most, own_upper = upper.amax(2), chosen(interval.upper)
        where = (rivals > chosen(interval.lower)).nonzero()
        which = torch.full(reference.shape, -1, dtype=torch.int64)
        slopes: list[Tensor] = []
        step = max(1, ROWS_AT_ONCE // (8 * len(layer.steps) ** 2 * 4))
        for part in where.split(step):
            tilted = self._tilted(source, layer, x, interval, winner[:, :, 0], part)
            if tilted is None:
                continue
            at, top, known, near, planes = tilted
            which[at] = torch.arange(len(top)) + sum(map(len, slopes))
            base = (planes.slopes * known.reference).sum(1) - reference[at]
            room = _REFERENCES * ((planes.slopes * known.reference.abs()).sum(1) + reference[at].abs())
            for passage, unit, give, offset in zip(self.known.passages, units, gives, offsets, strict=True):
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
        for passage, offset in zip(self.known.passages, offsets, strict=True):
            sides = zip(offset, (-1.0, 1.0, 1.0, -1.0), strict=True)
            outward = [passage.outward(v, side) for v, side in sides]
            passage.maxima[k] = Maxima(
                followed,
                rows_of_slopes,
                chosen_slopes.to(passage.dtype).numpy(),
                torch.stack(outward).reshape(4, *grown).numpy(),
            )
        active = (layer.taps(x.active.double(), 0.0).amax(2) > 0.0).reshape(grown)
        reference, c, r = (v.reshape(grown) for v in (reference, c, r))
        form = Form.ranged(reference, c, a.reshape(m, self.known.d, *shape), r, active)
        lost = int(np.prod(shape)) * 2 * len(layer.steps) * FLUSH
        self.known.flush += lost * x.width.reshape(m, -1).amax(1).numpy()
        room = 2.0**-50 * (reference.abs() + form.width)
        least = lower.amax(2).reshape(grown)
        return self.known.within(form, least - reference - room, most.reshape(grown) - reference + room)

    def _tilted(
        self, source: int, layer: MaxPool, x: Form, interval: Interval, winner: Tensor, where: Tensor
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
            slopes=torch.stack([gathered(x.a[:, i]) for i in range(self.known.d)], 2),
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
            cut = self.known.ready(way)
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
        step = max(1, ROWS_AT_ONCE // (16 * channels * int(np.prod(extent))))
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
            enough = Enough(Goal(), room - ahead, np.zeros(len(part), bool))
            found = self.backward.bound(source, rows, np.ascontiguousarray(cell), enough, None, cut)
            above, below = torch.from_numpy(room - ahead - found.lower), torch.from_numpy(room + ahead + found.upper)
            apart[window, other, one] = torch.minimum(apart[window, other, one], above)
            apart[window, one, other] = torch.minimum(apart[window, one, other], below)
            closed += int((above <= 0.0).sum())
        return closed

    def _known_better(
        self, index: int, form: Form, open_: Tensor, apart: Tensor | None, layer: Activation | None = None
    ) -> Form:
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

    def _bent(self, index: int, form: Form, open_: Tensor, apart: Tensor) -> tuple[Form, Tensor]:
        """The form with some numbers bounded by rows, and what is worth rows by what these have shown (N6).

        Lines that are close beside the form's width may be far apart beside what rows leave of it.
        """
        known = torch.from_numpy(self.known.good).reshape(-1, *[1] * (open_.ndim - 1))
        likely = (apart > _STRAIGHT) & ~open_ & known
        where = likely.reshape(self.known.count, *grid(self.network.shape(index))).nonzero().numpy()
        if not len(where):
            return form, open_
        some = where[:: -(-len(where) // _PROBED)]
        if self.schedule.deep and not self.schedule.takes(len(some) * self.schedule.costs.row(index)):
            return form, open_
        found = self._bounded(index, form, some, None, False)
        at = tuple(torch.from_numpy(some.T))
        shape = self.known.count, *grid(self.network.shape(index))
        before, after = ((f.upper - f.lower).reshape(shape)[at] for f in (form, found))
        kept = float((after / before).nan_to_num(nan=1.0).median())
        if kept > _HALF:
            return found, open_
        return found, open_ | (likely & (apart > _BENT * kept))

    def _tighten(self, index: int, form: Form, open_: Tensor, decides: bool) -> Form:
        """Better bounds of the numbers of node ``index`` that are open; a sign may be all that is asked (N6)."""
        item = self.network.shape(index)
        shape = grid(item)
        open_ = open_.reshape(self.known.count, *shape) & torch.from_numpy(self.known.good).reshape(-1, 1, 1, 1)
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
        return self._bounded(index, form, where, Goal() if decides else None, decides)

    def _renew(self, index: int, form: Form, open_: Tensor, layer: Activation | None) -> Form:
        """Better bounds of a deep network's node, within the work allowed; of closed numbers, too (N13, N17).

        Rows for numbers that are open are all that the lines ask for. But forms forget what neighbours share: behind
        two or three layers they leave nearly everything open. Where they leave much open, rows bound all numbers
        that matter further on, so that forms start again from there.
        """
        shape = grid(self.network.shape(index))
        open_ = open_.reshape(self.known.count, *shape) & torch.from_numpy(self.known.good).reshape(-1, 1, 1, 1)
        count = int(open_.sum())
        decides = isinstance(layer, LeakyRelu)
        matters = torch.from_numpy(self.known.good).reshape(-1, 1, 1, 1) & torch.ones_like(open_)
        if isinstance(layer, LeakyRelu) and layer.alpha == 0.0:
            # what is certainly cut off is exact behind the layer
            matters &= form.interval.upper.reshape(open_.shape) > 0.0
        cost = self.schedule.costs.row(index)
        whole = self.schedule.renews(count / open_.numel(), int(matters.sum()) * cost)
        if not (count or whole):
            return form
        opened, signs = open_.nonzero().numpy(), Goal() if decides else None
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

    def _planned(self, index: int, form: Form, open_: Tensor, layer: Activation | None) -> Form:
        """Better bounds of all numbers of a node that matter, by rows as long as the network is worth (N18)."""
        shape = grid(self.network.shape(index))
        matters = torch.from_numpy(self.known.good).reshape(-1, 1, 1, 1) & torch.ones(
            (self.known.count, *shape), dtype=torch.bool
        )
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
            found = self._bounded(index, form, some, None, True, self.known.ready(way))
            radius = float(found.r.reshape(matters.shape)[at].mean().log())
            score = radius + rate * len(chosen) * way.price
            if score < least:
                best, least = way, score
        if best is None:
            return form
        self.schedule.left -= len(chosen) * best.price
        return self._bounded(index, form, chosen, None, True, best.cut)

    def _goal(self, form: Form, products: float, layer: Activation | None) -> Goal | None:
        """What rows for all numbers of a node, which take so many products to the image, are to find out (N17)."""
        part = self.schedule.suffices(products)
        if not part:
            return None
        size = float(form.reference.abs().median())
        relu = isinstance(layer, LeakyRelu)
        return Goal(part * size, relu, relu and layer.alpha == 0.0)

    def _bounded(self, index: int, form: Form, where: Int64, goal: Goal | None, decides: bool, cut: int = 0) -> Form:
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

        def enough(part: Int64, sign: Float64) -> Enough | None:
            return None if goal is None else Enough(goal, -sign * reference[part], sign < 0.0)

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
        tight = Form(
            form.reference,
            c.reshape(-1, *item),
            a.movedim(-1, 1).reshape(self.known.count, self.known.d, *item),
            r.reshape(-1, *item),
            lower.reshape(-1, *item),
            upper.reshape(-1, *item),
            form.active,
        )
        return self.known.within(tight, tight.lower, tight.upper)

    # ------------------------------------------------------------ backwards

    def _one_hot(self, index: int, where: Int64, sign: Float64, enough: Enough | None, cut: int = 0) -> Reached:
        """Bounds of ``sign`` [R] times single numbers [R, (cell, channel, row, column)] of node ``index``."""
        channels = grid(self.network.shape(index))[0]
        found = Reached.unknown(len(where), self.known.d)
        step = min(self.most_rows, max(1, ROWS_AT_ONCE // (16 * channels)))
        threads = torch.get_num_threads() if self.schedule.deep else 1
        if threads > 1:
            # as many rows as stay together to the image
            step = min(step, max(16, -(-len(where) // (4 * threads))))

        def bound(first: int) -> tuple[Int64, Reached, Trace | None]:
            number = np.arange(first, min(len(where), first + step))
            cell, channel, y, x = (np.ascontiguousarray(v) for v in where[number].T)
            value = np.zeros((len(cell), channels, 1, 1), np.float32)
            value[np.arange(len(cell)), channel, 0, 0] = sign[number]
            trace = self._trace(len(cell))
            asked = None if enough is None else enough[number]
            part = self.backward.bound(index, Rows(value, y, x), cell, asked, trace, cut)
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


def _tilted(slope: Tensor, z: Form, line: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
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
