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

#: Preferences: so many unstable neurons are refined only after a sample of so many; not if the last fraction of these
#: keeps the last fraction of its width.
_MANY, _SOME, _GAIN = 1024, 64, 0.95
#: Preference: a ReLU's other neurons are left if a sample stays unstable and this fraction of the last ReLU's did.
_UNSURE = 0.25
#: Preferences: neurons of a curved activation that are tried, and the fraction of widths past which forms suffice.
_PROBED, _HALF = 32, 0.5
#: Preferences: relaxation gaps, relative to the width before and after refining, from which a neuron is refined.
_STRAIGHT, _BENT = 2.0**-20, 2.0**-5


class NeuronSelection:
    """Chooses the neurons whose bounds are refined; a heuristic, on which soundness does not depend.

    ``used``: by node [*shape], neurons that affect the outputs; None: all. ``unsure``: fraction of the latest ReLU's
    neurons that are unstable.
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

    def refine(
        self, index: int, form: NodeForm, unstable: Tensor, gaps: Tensor | None, layer: Activation | None = None
    ) -> NodeForm:
        """Return the form of node ``index`` with the unstable neurons before an activation or product (None) refined.

        ``gaps``: the relaxation gap of each neuron; None where ``unstable`` says all.
        """
        form, unstable, gaps = self.sharing.reuse_bounds(index, form, unstable, gaps, layer)
        if self.network.depth[index] < 2:
            return form
        if self.used is not None:
            matters = self.used.get(index, torch.zeros((), dtype=torch.bool))
            unstable, gaps = unstable & matters, None if gaps is None else gaps * matters
        if self.schedule.planned:
            return self._refine_by_plan(index, form, unstable, layer)
        if gaps is not None:
            form, unstable = self._refine_curved(index, form, unstable, gaps)
        if self.schedule.deep:
            return self._refine_deep(index, form, unstable, layer)
        return self._refine_unstable(index, form, unstable, isinstance(layer, LeakyRelu))

    def _refine_curved(self, index: int, form: NodeForm, unstable: Tensor, gaps: Tensor) -> tuple[NodeForm, Tensor]:
        """Refine a sample of a curved activation's neurons; return the form, and the neurons worth refining (N6).

        A gap that is small relative to the form's width may be large relative to the width after refining.
        """
        usable = torch.from_numpy(self.intermediate.usable).reshape(-1, *[1] * (unstable.ndim - 1))
        likely = (gaps > _STRAIGHT) & ~unstable & usable
        where = likely.reshape(self.intermediate.count, *grid(self.network.shape(index))).nonzero().numpy()
        if not len(where):
            return form, unstable
        some = where[:: -(-len(where) // _PROBED)]
        if self.schedule.deep and not self.schedule.spend(len(some) * self.schedule.costs.pass_price(index)):
            return form, unstable
        bounds = self.neuron_bounds.bounded(index, form, some, None, False)
        at = tuple(torch.from_numpy(some.T))
        shape = self.intermediate.count, *grid(self.network.shape(index))
        before, after = ((f.upper - f.lower).reshape(shape)[at] for f in (form, bounds))
        width_ratio = float((after / before).nan_to_num(nan=1.0).median())
        if width_ratio > _HALF:
            return bounds, unstable
        return bounds, unstable | (likely & (gaps > _BENT * width_ratio))

    @property
    def _usable(self) -> Tensor:
        """Cells [m, 1, 1, 1] that are not given up."""
        return torch.from_numpy(self.intermediate.usable).reshape(-1, 1, 1, 1)

    def _refine_unstable(self, index: int, form: NodeForm, unstable: Tensor, decides: bool) -> NodeForm:
        """Return the form of node ``index`` with unstable neurons refined; ``decides``: only their sign counts (N6)."""
        item = self.network.shape(index)
        shape = grid(item)
        unstable = unstable.reshape(self.intermediate.count, *shape) & self._usable
        where = unstable.nonzero().numpy()
        if not len(where):
            return form
        if len(where) >= _MANY:
            # a sample first: where it gains nothing, the others are not worth their passes
            some = tuple(torch.from_numpy(where[:: len(where) // _SOME].T))
            first = torch.zeros_like(unstable)
            first[some] = True
            before, refined = form, self._refine_unstable(index, form, first, decides)
            widths = [(f.upper - f.lower).reshape(unstable.shape)[some] for f in (before, refined)]
            if bool((widths[1] > _GAIN * widths[0]).double().mean() > _GAIN):
                return refined
            lower, upper = (v.reshape(unstable.shape)[some] for v in refined.interval)
            if decides and self.unsure > _UNSURE and float(((lower < 0.0) & (upper > 0.0)).double().mean()) > _GAIN:
                # hardly any neuron becomes stable, as in the layer before
                return refined
            form, unstable = refined, unstable & ~first
            where = unstable.nonzero().numpy()
        return self.neuron_bounds.bounded(index, form, where, NeuronTarget() if decides else None, decides)

    def _refine_deep(self, index: int, form: NodeForm, unstable: Tensor, layer: Activation | None) -> NodeForm:
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
            # neurons that are surely clipped are exact behind the layer
            matters &= form.interval.upper.reshape(unstable.shape) > 0.0
        cost = self.schedule.costs.pass_price(index)
        whole = self.schedule.refines_all(count / unstable.numel(), int(matters.sum()) * cost)
        if not (count or whole):
            return form
        unstable_indices, phases = unstable.nonzero().numpy(), NeuronTarget() if decides else None
        chosen = matters.nonzero().numpy() if whole else unstable_indices
        if len(chosen) * cost > self.schedule.left:
            chosen, whole = unstable_indices, False
        target = self._target(form, len(chosen) * cost, layer) if whole else phases
        if not self.schedule.spend(len(chosen) * cost):
            return form
        if len(chosen) >= _MANY:
            # a sample of unstable ones first: where it gains nothing, the others are not worth their passes
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
            if self.schedule.is_futile(width_ratio, undecided, part):
                return form
            if whole and not self.schedule.pays(width_ratio, part):
                self.schedule.refund((len(chosen) - count) * cost)
                chosen, target = unstable_indices, phases
        spared = self.neuron_bounds.spared
        bounds = self.neuron_bounds.bounded(index, form, chosen, target, decides)
        # a neuron has two rows unless its sign suffices
        self.schedule.refund((self.neuron_bounds.spared - spared) * (1.0 if decides else 0.5))
        return bounds

    def _refine_by_plan(self, index: int, form: NodeForm, unstable: Tensor, layer: Activation | None) -> NodeForm:
        """Refine all neurons of a node that affect the outputs, along the route that pays best in a trial (N18)."""
        shape = grid(self.network.shape(index))
        every = torch.ones((self.intermediate.count, *shape), dtype=torch.bool)
        matters = self._usable & every
        if isinstance(layer, LeakyRelu) and layer.alpha == 0.0:
            matters &= form.interval.upper.reshape(matters.shape) > 0.0
        chosen = matters.nonzero().numpy()
        routes, rate = self.schedule.routes(index, len(chosen)) if len(chosen) else ([], 0.0)
        if not routes:
            return form
        some = chosen[:: -(-len(chosen) // TRIALS)]
        at = tuple(torch.from_numpy(some.T))
        # one row of a neuron tells its width
        best, least = None, float(form.r.reshape(matters.shape)[at].mean().log())
        for route in routes:
            bounds = self.neuron_bounds.bounded(index, form, some, None, True, self.intermediate.ready(route))
            radius = float(bounds.r.reshape(matters.shape)[at].mean().log())
            score = radius + rate * len(chosen) * route.price
            if score < least:
                best, least = route, score
        if best is None:
            return form
        self.schedule.left -= len(chosen) * best.price
        return self.neuron_bounds.bounded(index, form, chosen, None, True, best.cut)

    def _target(self, form: NodeForm, products: float, layer: Activation | None) -> NeuronTarget | None:
        """Return the stopping target of all passes of a node, which take ``products``; None: they end at the image."""
        part = self.schedule.stopping_width(products)
        if not part:
            return None
        size = float(form.reference.abs().median())
        relu = isinstance(layer, LeakyRelu)
        return NeuronTarget(part * size, relu, relu and layer.alpha == 0.0)
