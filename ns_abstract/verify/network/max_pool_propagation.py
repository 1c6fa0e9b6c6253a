"""Forward and backward propagation through max pooling (docs/dev/design.md, N12)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import FLUSH, FLUSHES, OWN_FEW, OWN_SUMS, SPARE, UP
from ns_abstract.verify.network.backward import ROWS_AT_ONCE, BackwardPass
from ns_abstract.verify.network.coefficient_source import CoefficientSource
from ns_abstract.verify.network.coefficients import Coefficients, Int64
from ns_abstract.verify.network.forms import NodeForm, NodeInterval
from ns_abstract.verify.network.intermediate_bounds import IntermediateBounds
from ns_abstract.verify.network.max_pooling import MaxPool, WindowInputs, WindowPlanes, upper_planes
from ns_abstract.verify.network.relaxations import MaxPoolPlanes
from ns_abstract.verify.network.stopping import NeuronTarget, StoppingCriterion
from ns_abstract.verify.network.work_budget import WorkBudget

#: Differences in windows are bounded by rows if so large a part of so many, which are tried first, is decided by it.
_TRIED, _CLOSES = 64, 0.1


class _UncertainWinners(NamedTuple):
    """Pooling windows ``at`` whose largest input is not certain, and planes above them.

    Attributes:
        top: [n] upper bounds of the inputs' excess over the winner.
        candidates, near: Numbers of the inputs, and [n, K] their largest distances from their references.
    """

    at: tuple[Tensor, ...]
    top: Tensor
    candidates: WindowInputs
    near: Tensor
    planes: WindowPlanes


class MaxPoolPropagation:
    """Propagates forms through max pooling and bounds differences of its inputs."""

    def __init__(
        self, intermediate: IntermediateBounds, backward: BackwardPass, schedule: WorkBudget, sharing: CoefficientSource
    ) -> None:
        self.intermediate, self.network, self.backward = intermediate, intermediate.network, backward
        self.schedule, self.sharing = schedule, sharing

    def maximum(self, k: int, source: int, layer: MaxPool, x: NodeForm) -> NodeForm:
        """Return the form of maxima over windows (N12); its reference is that of the input the lower plane follows."""
        m, shape = self.intermediate.count, layer.shape
        interval = x.interval
        lower, upper = (layer.taps(v, -torch.inf) for v in interval)
        winner = self.sharing.winner(k, layer.taps(x.reference + x.c, -torch.inf).argmax(2, keepdim=True))

        def chosen(v: Tensor) -> Tensor:
            return layer.taps(v, 0.0).gather(2, winner)[:, :, 0]

        reference, c, r, width = (chosen(v) for v in (x.reference, x.c, x.r, x.width))
        a = torch.stack([chosen(x.a[:, i]) for i in range(self.intermediate.d)], 1)
        # sums of rows where windows overlap
        count = SPARE + layer.overlaps + self.network.readers[source]
        units = [count * relaxations.unit for relaxations in self.intermediate.relaxations]
        # programs may flush what they compare
        flushed = FLUSHES * FLUSH if self.intermediate.in_float32 else 0.0
        gives = [unit * width + flushed for unit in units]
        offsets = [torch.stack([-give, give, give, -give], 0) for give in gives]
        rivals = upper.scatter(2, winner, -torch.inf).amax(2)
        most, own_upper = upper.amax(2), chosen(interval.upper)
        where = (rivals > chosen(interval.lower)).nonzero()
        which = torch.full(reference.shape, -1, dtype=torch.int64)
        slopes: list[Tensor] = []
        step = max(1, ROWS_AT_ONCE // (8 * len(layer.steps) ** 2 * 4))
        for part in where.split(step):
            exceeded = self._exceeded(source, layer, x, interval, winner[:, :, 0], part)
            if exceeded is None:
                continue
            at, top, candidates, near, planes = exceeded
            which[at] = torch.arange(len(top)) + sum(map(len, slopes))
            base = (planes.slopes * candidates.reference).sum(1) - reference[at]
            room = OWN_SUMS * ((planes.slopes * candidates.reference.abs()).sum(1) + reference[at].abs()) + flushed
            for relaxations, unit, give, offset in zip(
                self.intermediate.relaxations, units, gives, offsets, strict=True
            ):
                rounded = (planes.slopes.to(relaxations.dtype).double() - planes.slopes).abs()
                lost = (rounded * near + unit * planes.slopes * near).sum(1) + room
                offset[1][at] = give[at] + top
                offset[2][at] = planes.high + base + lost
                offset[3][at] = planes.low + base - lost
            slopes.append(planes.slopes)
            # the form between the planes, or the winner and what may be above it
            low, high = planes.low + base - room, planes.high + base + room
            middle = (planes.slopes * candidates.middle).sum(1) + 0.5 * (low + high)
            radius = (planes.slopes * candidates.radius).sum(1) + 0.5 * (high - low)
            radius = (radius + OWN_SUMS * (planes.slopes * candidates.size).sum(1)) * UP
            own = r[at] + 0.5 * top
            better = radius < own
            mixed = (planes.slopes[:, :, None] * candidates.slopes).sum(1)
            c[at] = torch.where(better, middle, c[at] + 0.5 * top)
            r[at] = torch.where(better, radius, own * UP + OWN_SUMS * c[at].abs())
            cells, channels, windows = at
            a[cells, :, channels, windows] = torch.where(better[:, None], mixed, a[cells, :, channels, windows])
            most[at] = torch.minimum(most[at], own_upper[at] + top)
        grown = (m, *shape)
        chosen_slopes = torch.cat(slopes) if slopes else torch.zeros((0, len(layer.steps)))
        followed = winner[:, :, 0].reshape(grown).numpy().astype(np.int16)
        rows_of_slopes = which.reshape(grown).numpy().astype(np.int32)
        for relaxations, offset in zip(self.intermediate.relaxations, offsets, strict=True):
            sides = zip(offset, (-1.0, 1.0, 1.0, -1.0), strict=True)
            outward = [relaxations.outward(v, side) for v, side in sides]
            relaxations.maxima[k] = MaxPoolPlanes(
                followed,
                rows_of_slopes,
                chosen_slopes.to(relaxations.dtype).numpy(),
                torch.stack(outward).reshape(4, *grown).numpy(),
            )
        active = (layer.taps(x.active.double(), 0.0).amax(2) > 0.0).reshape(grown)
        reference, c, r = (v.reshape(grown) for v in (reference, c, r))
        form = NodeForm.ranged(reference, c, a.reshape(m, self.intermediate.d, *shape), r + flushed, active)
        lost = int(np.prod(shape)) * 2 * len(layer.steps) * FLUSH
        self.intermediate.flush += lost * x.width.reshape(m, -1).amax(1).numpy()
        room = OWN_FEW * (reference.abs() + form.width) + flushed
        least = lower.amax(2).reshape(grown)
        return self.intermediate.within(form, least - reference - room, most.reshape(grown) - reference + room)

    def _exceeded(
        self, source: int, layer: MaxPool, x: NodeForm, interval: NodeInterval, winner: Tensor, where: Tensor
    ) -> _UncertainWinners | None:
        """Return upper planes of the windows ``where`` [n, 3] in which an input may exceed ``winner``; None: none."""
        cell, channel, window = where.T
        at = cell, channel, window
        places = layer.places[:, window].T
        inside, number = places >= 0, channel[:, None] * x.c[0, 0].numel() + places.clamp(min=0)

        def gathered(v: Tensor) -> Tensor:
            return v.flatten(1)[cell[:, None], number]

        candidates = WindowInputs(
            inside,
            reference=gathered(x.reference),
            middle=gathered(x.c),
            radius=gathered(x.r),
            slopes=torch.stack([gathered(x.a[:, i]) for i in range(self.intermediate.d)], 2),
            lower=gathered(interval.lower),
            upper=gathered(interval.upper),
            winner=winner[at],
        )
        apart = self._apart(source, layer, where, candidates)
        top = apart[torch.arange(len(where)), :, candidates.winner].amax(1)
        left = top > 0.0
        if not bool(left.any()):
            return None
        candidates = WindowInputs(*(v[left] for v in candidates))
        return _UncertainWinners(
            tuple(v[left] for v in at),
            top[left],
            candidates,
            gathered(x.width)[left],
            upper_planes(candidates, apart[left]),
        )

    def _apart(self, source: int, layer: MaxPool, where: Tensor, candidates: WindowInputs) -> Tensor:
        """Return upper bounds of differences of windows' inputs, by forms, and by backward passes where these help."""
        apart = candidates.relaxation_gap()
        at, winner = np.arange(len(apart)), candidates.winner.numpy()

        def rivals() -> np.ndarray:
            return apart.numpy()[at, :, winner] > 0.0

        # (window, number, number)
        window, number = rivals().nonzero()
        pairs = np.stack([window, winner[window], number], 1)
        cut = 0
        if self.schedule.planned:
            route = self.schedule.longest_affordable(source, len(pairs))
            if route is None:
                return apart
            cut = self.intermediate.ready(route)
        elif self.schedule.deep and not self.schedule.spend(len(pairs) * self.schedule.costs.pass_price(source)):
            return apart
        if len(pairs) > _TRIED:
            first = np.arange(0, len(pairs), len(pairs) // _TRIED)
            if self._differences(source, layer, where.numpy(), candidates, pairs[first], apart, cut) < _CLOSES * len(
                first
            ):
                return apart
            pairs = np.delete(pairs, first, 0)
        self._differences(source, layer, where.numpy(), candidates, pairs, apart, cut)
        # what may be above the winner, among itself
        left = rivals()
        both = np.triu(left[:, :, None] & left[:, None, :], 1)
        self._differences(source, layer, where.numpy(), candidates, np.argwhere(both), apart, cut)
        return apart

    def _differences(
        self, source: int, layer: MaxPool, where: Int64, candidates: WindowInputs, pairs: Int64, apart: Tensor, cut: int
    ) -> int:
        """Tighten ``apart`` for (window, input, input) pairs; return how many second inputs never exceed the first."""
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
            near = candidates.reference[window, one], candidates.reference[window, other]
            ahead = (near[0] - near[1]).numpy()
            room = OWN_FEW * (near[0].abs() + near[1].abs()).numpy()
            coefficients = Coefficients(value, y * layer.stride[0] - layer.pads[0], x * layer.stride[1] - layer.pads[1])
            enough = StoppingCriterion(NeuronTarget(), room - ahead, np.zeros(len(part), bool))
            bounds = self.backward.bound(source, coefficients, np.ascontiguousarray(cell), enough, None, cut)
            above, below = torch.from_numpy(room - ahead - bounds.lower), torch.from_numpy(room + ahead + bounds.upper)
            apart[window, other, one] = torch.minimum(apart[window, other, one], above)
            apart[window, one, other] = torch.minimum(apart[window, one, other], below)
            closed += int((above <= 0.0).sum())
        return closed
