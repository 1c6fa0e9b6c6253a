"""Choose which neurons before an activation or product are refined (docs/dev/design.md, N6, N13, N17, N18)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ns_abstract.verify.network.coefficient_source import CoefficientSource
from ns_abstract.verify.network.coefficients import grid
from ns_abstract.verify.network.cost_model import TRIALS
from ns_abstract.verify.network.forms import NodeForm
from ns_abstract.verify.network.intermediate_bounds import IntermediateBounds
from ns_abstract.verify.network.layers import Activation, LeakyRelu
from ns_abstract.verify.network.neuron_bounds import NeuronBounds
from ns_abstract.verify.network.stopping import NeuronTarget
from ns_abstract.verify.network.work_budget import WorkBudget

#: So many open numbers of a node are tightened only if some of them gain by it: if not so large a part of these
#: keeps so large a part of its width.
_MANY, _SOME, _GAIN = 1024, 64, 0.95
#: Signs of many units are given up if so few of some are found out, and so many of the layer before were not.
_UNSURE = 0.25
#: Numbers of a node that are probed by rows, and the part of widths past which forms are good enough.
_PROBED, _HALF = 32, 0.5
#: Preferences: lines that are apart by so small a part of a width are one line; by so large a part of what rows leave
#: of it, open.
_STRAIGHT, _BENT = 2.0**-20, 2.0**-5


class NeuronSelection:
    """Chooses the neurons whose bounds are refined; a heuristic, on which soundness does not depend.

    ``used``: by node [*shape], numbers that matter to the outputs; None: all. ``unsure``: fraction of the latest ReLU's
    inputs whose signs are open.
    """

    def __init__(
        self,
        intermediate: IntermediateBounds,
        neuron_bounds: NeuronBounds,
        schedule: WorkBudget,
        sharing: CoefficientSource,
        used: Mapping[int, Tensor] | None = None,
    ) -> None:
        self.used = used
        self.intermediate, self.network, self.neuron_bounds = intermediate, intermediate.network, neuron_bounds
        self.schedule, self.sharing = schedule, sharing
        self.unsure = 0.0

    def better(
        self, index: int, form: NodeForm, unstable: Tensor, apart: Tensor | None, layer: Activation | None = None
    ) -> NodeForm:
        """Return the form of node ``index`` with the unstable neurons before an activation or product (None) refined.

        ``apart``: the relaxation gap of each neuron; None where ``unstable`` says all.
        """
        form, unstable, apart = self.sharing.reuse_bounds(index, form, unstable, apart, layer)
        if self.network.depth[index] < 2:
            return form
        if self.used is not None:
            matters = self.used.get(index, torch.zeros((), dtype=torch.bool))
            unstable, apart = unstable & matters, None if apart is None else apart * matters
        if self.schedule.planned:
            return self._planned(index, form, unstable, layer)
        if apart is not None:
            form, unstable = self._bent(index, form, unstable, apart)
        if self.schedule.deep:
            return self._renew(index, form, unstable, layer)
        return self._tighten(index, form, unstable, isinstance(layer, LeakyRelu))

    def _bent(self, index: int, form: NodeForm, unstable: Tensor, apart: Tensor) -> tuple[NodeForm, Tensor]:
        """Refine some neurons of a curved activation; return the form and which others are worth refining (N6).

        Lines that are close beside the form's width may be far apart beside the width after refining.
        """
        usable = torch.from_numpy(self.intermediate.usable).reshape(-1, *[1] * (unstable.ndim - 1))
        likely = (apart > _STRAIGHT) & ~unstable & usable
        where = likely.reshape(self.intermediate.count, *grid(self.network.shape(index))).nonzero().numpy()
        if not len(where):
            return form, unstable
        some = where[:: -(-len(where) // _PROBED)]
        if self.schedule.deep and not self.schedule.takes(len(some) * self.schedule.costs.row(index)):
            return form, unstable
        bounds = self.neuron_bounds.bounded(index, form, some, None, False)
        at = tuple(torch.from_numpy(some.T))
        shape = self.intermediate.count, *grid(self.network.shape(index))
        before, after = ((f.upper - f.lower).reshape(shape)[at] for f in (form, bounds))
        width_ratio = float((after / before).nan_to_num(nan=1.0).median())
        if width_ratio > _HALF:
            return bounds, unstable
        return bounds, unstable | (likely & (apart > _BENT * width_ratio))

    @property
    def _usable(self) -> Tensor:
        """Cells [m, 1, 1, 1] that are not given up."""
        return torch.from_numpy(self.intermediate.usable).reshape(-1, 1, 1, 1)

    def _tighten(self, index: int, form: NodeForm, unstable: Tensor, decides: bool) -> NodeForm:
        """Return tighter bounds of the unstable numbers of node ``index``; the sign alone may suffice (N6)."""
        item = self.network.shape(index)
        shape = grid(item)
        unstable = unstable.reshape(self.intermediate.count, *shape) & self._usable
        where = unstable.nonzero().numpy()
        if not len(where):
            return form
        if len(where) >= _MANY:
            # some first: where they gain nothing, the others are not worth their rows
            some = tuple(torch.from_numpy(where[:: len(where) // _SOME].T))
            first = torch.zeros_like(unstable)
            first[some] = True
            before, refined = form, self._tighten(index, form, first, decides)
            widths = [(f.upper - f.lower).reshape(unstable.shape)[some] for f in (before, refined)]
            if bool((widths[1] > _GAIN * widths[0]).double().mean() > _GAIN):
                return refined
            lower, upper = (v.reshape(unstable.shape)[some] for v in refined.interval)
            if decides and self.unsure > _UNSURE and float(((lower < 0.0) & (upper > 0.0)).double().mean()) > _GAIN:
                # hardly any sign is found out, nor was it in the layer before: what follows is not worth it
                return refined
            form, unstable = refined, unstable & ~first
            where = unstable.nonzero().numpy()
        return self.neuron_bounds.bounded(index, form, where, NeuronTarget() if decides else None, decides)

    def _renew(self, index: int, form: NodeForm, unstable: Tensor, layer: Activation | None) -> NodeForm:
        """Refine a deep network's node within the allowed work, stable neurons too where that pays (N13, N17).

        Relaxations only need the unstable neurons. But forms lose the correlation of neighbouring neurons: after two or
        three layers nearly all neurons are unstable. There all neurons that matter later are refined, so that forms
        start afresh.
        """
        shape = grid(self.network.shape(index))
        unstable = unstable.reshape(self.intermediate.count, *shape) & self._usable
        count = int(unstable.sum())
        decides = isinstance(layer, LeakyRelu)
        matters = self._usable & torch.ones_like(unstable)
        if isinstance(layer, LeakyRelu) and layer.alpha == 0.0:
            # what is certainly cut off is exact behind the layer
            matters &= form.interval.upper.reshape(unstable.shape) > 0.0
        cost = self.schedule.costs.row(index)
        whole = self.schedule.renews(count / unstable.numel(), int(matters.sum()) * cost)
        if not (count or whole):
            return form
        unstable_indices, phases = unstable.nonzero().numpy(), NeuronTarget() if decides else None
        chosen = matters.nonzero().numpy() if whole else unstable_indices
        if len(chosen) * cost > self.schedule.left:
            chosen, whole = unstable_indices, False
        goal = self._goal(form, len(chosen) * cost, layer) if whole else phases
        if not self.schedule.takes(len(chosen) * cost):
            return form
        if len(chosen) >= _MANY:
            # some first, of the open ones: where they gain nothing, the others are not worth their rows
            some = unstable_indices if count >= _SOME else chosen
            some = some[:: max(1, len(some) // _SOME)]
            bounds = self.neuron_bounds.bounded(index, form, some, None, decides)
            at = tuple(torch.from_numpy(some.T))
            widths = [(f.upper - f.lower).reshape(unstable.shape)[at] for f in (form, bounds)]
            lower, upper = (v.reshape(unstable.shape)[at] for v in bounds.interval)
            form = bounds
            width_ratio = float((widths[1] / widths[0]).median())
            part = count / unstable.numel()
            undecided = float(((lower < 0.0) & (upper > 0.0)).double().mean()) if decides else 0.0
            if self.schedule.vain(width_ratio, undecided, part):
                return form
            if whole and not self.schedule.gains(width_ratio, part):
                self.schedule.spares((len(chosen) - count) * cost)
                chosen, goal = unstable_indices, phases
        spared = self.neuron_bounds.spared
        bounds = self.neuron_bounds.bounded(index, form, chosen, goal, decides)
        # where a sign is not all that is asked, every number has two rows
        self.schedule.spares((self.neuron_bounds.spared - spared) * (1.0 if decides else 0.5))
        return bounds

    def _planned(self, index: int, form: NodeForm, unstable: Tensor, layer: Activation | None) -> NodeForm:
        """Refine all numbers of a node that matter, along routes as long as the network is worth (N18)."""
        shape = grid(self.network.shape(index))
        every = torch.ones((self.intermediate.count, *shape), dtype=torch.bool)
        matters = self._usable & every
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
            bounds = self.neuron_bounds.bounded(index, form, some, None, True, self.intermediate.ready(way))
            radius = float(bounds.r.reshape(matters.shape)[at].mean().log())
            score = radius + rate * len(chosen) * way.price
            if score < least:
                best, least = way, score
        if best is None:
            return form
        self.schedule.left -= len(chosen) * best.price
        return self.neuron_bounds.bounded(index, form, chosen, None, True, best.cut)

    def _goal(self, form: NodeForm, products: float, layer: Activation | None) -> NeuronTarget | None:
        """Return the target of rows for all numbers of a node, given their multiplications to the image (N17)."""
        part = self.schedule.suffices(products)
        if not part:
            return None
        size = float(form.reference.abs().median())
        relu = isinstance(layer, LeakyRelu)
        return NeuronTarget(part * size, relu, relu and layer.alpha == 0.0)
