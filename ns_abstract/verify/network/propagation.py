"""Forward propagation of forms through layers, activations and products (docs/dev/design.md, N1-N4, N9, N21, N22)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import (
    DOUBLE_UNIT,
    FLUSH,
    FUNCTION_FLUSHES,
    MAGNITUDES_UP,
    OVERFLOW,
    OWN_FEW,
    OWN_FUNCTION,
    OWN_LINE,
    PRODUCT,
    SPARE,
    UP,
    gamma,
)
from ns_abstract.verify.network.bilinear import Product
from ns_abstract.verify.network.coefficient_source import CoefficientSource
from ns_abstract.verify.network.coefficients import grid
from ns_abstract.verify.network.forms import NodeForm
from ns_abstract.verify.network.intermediate_bounds import IntermediateBounds
from ns_abstract.verify.network.layers import Activation, LeakyRelu, LinearLayer, ScaleLayer, Sum
from ns_abstract.verify.network.relaxations import Relaxations, ReusedRelaxation
from ns_abstract.verify.network.rounding import Rounding
from ns_abstract.verify.network.scalar_function import ScalarFunction
from ns_abstract.verify.network.slope_choices import UnstableNeurons
from ns_abstract.verify.network.sparse_layers import Variance


class ForwardPropagation:
    """Propagates forms through single nodes, and stores their relaxations and rounding in ``intermediate``.

    ``sharing``: references, magnitudes and slopes of other cells. ``chooses``: whether rows of outputs optimise slopes
    (N14).
    """

    def __init__(self, intermediate: IntermediateBounds, sharing: CoefficientSource, chooses: bool) -> None:
        self.intermediate, self.network, self.sharing = intermediate, intermediate.network, sharing
        self.chooses = chooses
        self.rounding = Rounding(intermediate.network)

    def linear(self, k: int, sources: tuple[int, ...], layer: LinearLayer, inputs: list[NodeForm]) -> NodeForm:
        """Return the form of linear node ``k`` (N1, N2)."""
        m, d = self.intermediate.count, self.intermediate.d
        reference = self.sharing.reference(k, lambda: layer([f.reference for f in inputs]))
        stacks = [torch.cat([f.c[:, None], f.a], 1).flatten(0, 1) for f in inputs]
        moved = layer.apply(stacks).reshape(m, 1 + d, *layer.shape)
        # float64's rounding is relative to forms and references, float32's of rows to distances from
        # references, that of the network to its values
        own = 2.0 * (layer.terms + len(inputs) + 8) * DOUBLE_UNIT
        charged = [self.sharing.rounding_form(f) for f in inputs]
        radii, sizes = [], []
        for f, sized in zip(inputs, charged, strict=True):
            # at least what an input may be on one side of zero and on the other together
            size = torch.maximum(sized.interval.spread, sized.reference.abs())
            sizes.append(size)
            radii.append(torch.cat([f.r + own * (f.c.abs() + f.a.abs().sum(1)), sized.width, size]))
        propagated_radius = layer.magnitude(radii) * MAGNITUDES_UP
        radius, width, size = propagated_radius.split([m, *[len(sizes[0])] * 2])
        if layer.bias is not None:
            size = size + layer.bias.abs()
        moves = own * size + (layer.terms + 1) * FLUSH
        moves = moves + layer.inexact(sizes)
        active = None
        if not layer.terms:
            active = layer.magnitude([f.active.double() for f in inputs]) != 0.0
            if layer.bias is not None:
                active = active | (layer.bias != 0.0)
        elif self.intermediate.in_float32:

            def end(moves: Tensor = moves) -> Tensor:
                return (reference + moved[:, 0]).abs() + moved[:, 1:].abs().sum(1) + radius + moves

            moves = moves + self.rounding.charge(k, sources, layer, charged, size, end)
            moves = moves + layer.spare([f.interval.size for f in charged])
        regrouped = self.rounding.regrouped_sizes(k, sources, layer, sizes)
        flushed = self.rounding.flushed(regrouped, layer) if self.intermediate.in_float32 else 0.0
        moves = moves + flushed
        roundings = layer.row_terms + SPARE + max(self.network.readers[i] for i in sources)
        form = NodeForm.ranged(reference, moved[:, 0], moved[:, 1:], radius + moves, active)
        self.intermediate.usable &= self.rounding.bounded(regrouped).numpy()
        tiny = torch.zeros((), dtype=torch.float64)
        for sized, shape in zip(charged, layer.input_shapes, strict=True):
            lost = int(np.prod(shape)) * (layer.row_terms + 2) * FLUSH
            most = sized.width.flatten(1).amax(1)
            self.intermediate.flush += lost * most.numpy()
            # weights below that may be lost when rows store them in float32
            tiny = tiny + max(1, layer.terms) * FLUSH * most.reshape(-1, *[1] * len(layer.shape))
        alone = [i for i in sources if self.intermediate.rounds(i) and self.network.readers[i] == 1]
        folded = alone if isinstance(layer, Sum) else []
        self.intermediate.folded.update(folded)
        for relaxations in self.intermediate.relaxations:
            rows_rounding = gamma(roundings, relaxations.unit)
            noise = ((moves + tiny + rows_rounding * width) * UP).expand(m, *layer.shape)
            for source in folded:
                # one charge instead of several
                noise = noise + relaxations.noise[source]
            relaxations.noise[k] = noise * (UP + relaxations.sums)
        if isinstance(layer, Variance):
            least = layer.least(inputs[0], inputs[1], self.intermediate.in_float32)
            least = least - flushed - own * size - FLUSH * (layer.terms + 1) - OWN_LINE * reference.abs()
            return self.intermediate.within(form, least - reference, form.upper)
        if isinstance(layer, ScaleLayer):
            # what is known of single numbers, beside their form
            ends = torch.stack([layer.factor * inputs[0].lower, layer.factor * inputs[0].upper])
            room = moves + OWN_FEW * ends.abs().amax(0)
            return self.intermediate.within(form, ends.amin(0) - room, ends.amax(0) + room)
        return self.intermediate.within(form, form.lower, form.upper)

    def activation(self, k: int, source: int, layer: Activation, z: NodeForm) -> NodeForm:
        """Return the form of activation node ``k`` (N3, N4)."""
        lower, upper = z.interval
        size = z.interval.size
        reference = self.sharing.reference(k, lambda: layer.function(z.reference))
        room = layer.missing(lower, upper) + OWN_LINE * reference.abs()
        if self.intermediate.in_float32:
            room = room + layer.error(lower, upper)
        band = layer.band(lower, upper)
        s = band.lower_slope
        base = s * z.reference - reference
        middle = 0.5 * (band.lower_offset + band.upper_offset) + base
        half = 0.5 * (band.upper_offset - band.lower_offset) + OWN_FEW * middle.abs() + room
        half = half + OWN_FEW * (band.lower_offset.abs() + band.upper_offset.abs() + s.abs() * z.reference.abs())
        half = half + OWN_LINE * s.abs() * (z.c.abs() + z.a.abs().sum(1))
        radius = s.abs() * z.r * UP + half
        form = NodeForm.ranged(reference, s * z.c + middle, s[:, None] * z.a, radius)
        if isinstance(layer, LeakyRelu) and layer.alpha == 0.0:
            form.active = upper > 0.0
        lines = layer.lines(lower, upper)
        fold = self.intermediate.rounds(source) and self.network.readers[source] == 1

        def stored(chosen: Sequence[tuple[Tensor, Tensor, Tensor]], relaxations: Relaxations) -> np.ndarray:
            """As `pass_activation` wants slope, lower and upper offset for rows of either sign."""
            # the slope as stored, rows' products with it and sums where branches meet
            lines_found, unit = [], (SPARE + self.network.readers[source]) * relaxations.unit
            for (slope, low, high), side in zip(chosen, (-1.0, 1.0), strict=True):
                rounded = slope.to(relaxations.dtype).double()
                base, apart = slope * z.reference - reference, band.lower_slope - slope
                give = ((rounded - slope).abs() + unit * slope.abs()) * z.width + OWN_LINE * apart.abs() * size + room
                give = give + OWN_LINE * (low.abs() + high.abs() + slope.abs() * z.reference.abs())
                if fold:
                    give = give + rounded.abs() * relaxations.noise[source]
                ends = (relaxations.outward(low + base - give, -1.0), relaxations.outward(high + base + give, 1.0))
                lines_found += [rounded.to(relaxations.dtype), *(ends if side < 0.0 else reversed(ends))]
            return torch.stack(lines_found).reshape(6, self.intermediate.count, *grid(layer.shape)).numpy()

        # the other sides of lines with these slopes are the band's
        above = layer.offsets(lines.lower_slope, lower, upper, band)[1]
        below = layer.offsets(lines.upper_slope, lower, upper, band)[0]
        own = (lines.lower_slope, lines.lower_offset, above), (lines.upper_slope, below, lines.upper_offset)
        for relaxations in self.intermediate.relaxations:
            relaxations.lines[k] = stored(own, relaxations)
        reused = self.sharing.slopes(k)
        if reused is not None:
            slopes = [torch.from_numpy(v).double().expand(self.intermediate.count, *layer.shape) for v in reused]
            plain = [layer.offsets(slope, lower, upper, band) for slope in slopes]
            tilted = [_around_slope(slope, z, line) for slope, line in zip(slopes, own, strict=True)]
            # each is there for one side
            better = tilted[0][0] > plain[0][0], tilted[1][1] < plain[1][1]
            offsets, tilts = [], []
            for slope, ends, (low, high, tilt), use in zip(slopes, plain, tilted, better, strict=True):
                offsets.append((slope, torch.where(use, low, ends[0]), torch.where(use, high, ends[1])))
                tilts.append(torch.where(use[:, None], tilt, torch.zeros_like(tilt)))
            offered = stored(offsets, self.intermediate.relaxations[0])
            self.intermediate.reused_relaxations[k] = ReusedRelaxation(offered, torch.stack(tilts).flatten(3).numpy())
        if fold:
            self.intermediate.folded.add(source)
        if self.chooses and isinstance(layer, (LeakyRelu, ScalarFunction)):
            first = self.intermediate.relaxations[-1]
            loose = (SPARE + self.network.readers[source]) * first.unit * z.width
            loose = loose + (first.noise[source] if fold else 0.0)
            arguments = (lower, upper, z.reference, reference, loose, room + torch.zeros_like(lower))
            self.intermediate.unstable[k] = _unstable_neurons(layer, first, arguments)
        lost = int(np.prod(layer.shape)) * 2 * FLUSH
        self.intermediate.flush += lost * z.width.reshape(self.intermediate.count, -1).amax(1).numpy()
        ends = layer.range(lower, upper)
        room = room + OWN_LINE * (ends[0].abs() + ends[1].abs())
        self._limit(torch.maximum(ends[0].abs(), ends[1].abs()))
        return self.intermediate.within(form, ends[0] - reference - room, ends[1] - reference + room)

    def _limit(self, size: Tensor) -> None:
        """Give up cells in which numbers of magnitudes up to ``size`` [m, ...] may overflow (N22)."""
        if not float(size.amax()) < OVERFLOW:
            self.intermediate.usable &= (size.flatten(1).amax(1) < OVERFLOW).numpy()

    def product(self, k: int, sources: tuple[int, ...], layer: Product, x: NodeForm, y: NodeForm) -> NodeForm:
        """Return the form of product node ``k`` (N9)."""
        m, first, second = self.intermediate.count, x.interval, y.interval
        size = first.size * second.size
        reference = self.sharing.reference(k, lambda: x.reference * y.reference)
        plane = layer.plane(first, second)
        alpha, beta = plane.first, plane.second
        base = alpha * x.reference + beta * y.reference - reference
        # roundings of the plane relative to the references, and the network's
        own = alpha.abs() * x.reference.abs() + beta.abs() * y.reference.abs() + reference.abs()
        room = OWN_LINE * (own + plane.low.abs() + plane.high.abs()) + 2 * FLUSH
        if self.intermediate.in_float32:
            room = room + PRODUCT * size + FUNCTION_FLUSHES * FLUSH * (1.0 + first.size + second.size)
        shape = (6, m, *grid(layer.shape))
        for relaxations in self.intermediate.relaxations:
            # rows' products with the slopes, which are float32 numbers, and sums where branches meet
            unit = (SPARE + max(self.network.readers[i] for i in sources)) * relaxations.unit
            give = room + unit * (alpha.abs() * x.width + beta.abs() * y.width)
            low = relaxations.outward(plane.low + base - give, -1.0)
            high = relaxations.outward(plane.high + base + give, 1.0)
            none = torch.zeros_like(low)
            relaxations.products[k] = tuple(
                torch.stack([slope, *ends, slope, *reversed(ends)]).reshape(shape).numpy()
                for slope, ends in (
                    (alpha.to(relaxations.dtype), (low, high)),
                    (beta.to(relaxations.dtype), (none, none)),
                )
            )
        middle, half = 0.5 * (plane.low + plane.high) + base, 0.5 * (plane.high - plane.low)
        moved = alpha.abs() * (x.c.abs() + x.a.abs().sum(1)) + beta.abs() * (y.c.abs() + y.a.abs().sum(1))
        half = half + room + OWN_FEW * middle.abs() + OWN_FUNCTION * moved
        radius = (alpha.abs() * x.r + beta.abs() * y.r) * UP + half
        c, a = alpha * x.c + beta * y.c + middle, alpha[:, None] * x.a + beta[:, None] * y.a
        form = NodeForm.ranged(reference, c, a, radius, x.active & y.active)
        for f in (x, y):
            lost = int(np.prod(layer.shape)) * 2 * FLUSH
            self.intermediate.flush += lost * f.width.reshape(m, -1).amax(1).numpy()
        regrouped = self.rounding.regrouped_product(k, sources, [first.size, second.size])
        self.intermediate.usable &= self.rounding.bounded(regrouped).numpy()
        ends = torch.stack([u * v for u in first for v in second]) - reference
        room = room + OWN_FEW * (size + reference.abs())
        return self.intermediate.within(form, ends.amin(0) - room, ends.amax(0) + room)


def _around_slope(slope: Tensor, z: NodeForm, line: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Return (low, high, tilt [m, d, *shape]): an activation less ``slope`` times its input is in [low, high] + tilt p.

    ``line``: slope and offsets of lines on both sides of the activation, along which the input is followed.
    """
    own, below, above = line
    t = own - slope
    middle, size = t * (z.reference + z.c), z.reference.abs() + z.c.abs() + z.a.abs().sum(1)
    half = t.abs() * (z.r * UP + OWN_LINE * size)
    return below + middle - half, above + middle + half, t[:, None] * z.a


def _unstable_neurons(
    layer: LeakyRelu | ScalarFunction,
    relaxations: Relaxations,
    given: tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor],
) -> UnstableNeurons:
    """Return the neurons [m, *shape] whose slopes may be optimised."""
    lower, upper = given[:2]
    where = (layer.unstable(lower, upper) if isinstance(layer, LeakyRelu) else lower < upper).flatten(1).nonzero()
    at = where[:, 0], where[:, 1]
    lower, upper, reference, image, loose, room = (v.flatten(1)[at].numpy() for v in given)
    cell, flat = (v.numpy() for v in at)
    return UnstableNeurons(cell, flat, lower, upper, reference, image, loose, room, layer, relaxations)
