"""The forward pass: affine forms of all nodes, tighter bounds of unstable neurons (design.md, N1, N18)."""

from __future__ import annotations

from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.verify.network.bilinear import Product
from ns_abstract.verify.network.forms import NodeForm
from ns_abstract.verify.network.intermediate_bounds import IntermediateBounds
from ns_abstract.verify.network.layers import Activation, LeakyRelu
from ns_abstract.verify.network.max_pool_propagation import MaxPoolPropagation
from ns_abstract.verify.network.max_pooling import MaxPool
from ns_abstract.verify.network.neuron_selection import NeuronSelection
from ns_abstract.verify.network.propagation import ForwardPropagation
from ns_abstract.verify.network.work_budget import WorkBudget


class ForwardPass:
    """Propagates forms through the nodes in order and refines intermediate bounds.

    Args:
        intermediate: What is known, to begin with of the image alone.
        propagation, pooling: Pass forms through a node.
        selection: Bounds its inputs better before.
        schedule: Learns how wide bounds are.
    """

    def __init__(
        self,
        intermediate: IntermediateBounds,
        propagation: ForwardPropagation,
        pooling: MaxPoolPropagation,
        selection: NeuronSelection,
        schedule: WorkBudget,
    ) -> None:
        self.intermediate, self.network = intermediate, intermediate.network
        self.propagation, self.pooling, self.selection = propagation, pooling, selection
        self.schedule = schedule

    def run(self) -> NodeForm:
        """Lines and rounding of every node; returns what is known of the last one."""
        forms: list[NodeForm | None] = [self.intermediate.image_form()]
        self.intermediate.forms = forms
        if self.schedule.planned:
            self._learn(0, False)
        left = list(self.network.readers)
        last = len(self.network.nodes)
        for k, node in enumerate(self.network.nodes, 1):
            check_cancelled()
            inputs = []
            for index in node.inputs:
                form = forms[index]
                assert form is not None
                inputs.append(form)
            if isinstance(node.layer, Activation):
                # what is known better of the input is also known to its other readers
                source = node.inputs[0]
                unstable, apart = (
                    node.layer.unstable(*inputs[0].interval),
                    node.layer.relaxation_gap(*inputs[0].interval),
                )
                forms[source] = inputs[0] = self.selection.better(source, inputs[0], unstable, apart, node.layer)
                if isinstance(node.layer, LeakyRelu):
                    self.selection.unsure = float(node.layer.unstable(*inputs[0].interval).double().mean())
                forms.append(self.propagation.activation(k, source, node.layer, inputs[0]))
                if self.network.depth[source] > 1:
                    self.intermediate.stops[source] = self.intermediate.stop(source, inputs[0])
            elif isinstance(node.layer, Product):
                intervals = inputs[0].interval, inputs[1].interval
                unstable, apart = node.layer.unstable(*intervals), node.layer.relaxation_gap(*intervals)
                for position, source in enumerate(node.inputs):
                    forms[source] = inputs[position] = self.selection.better(source, inputs[position], unstable, apart)
                forms.append(self.propagation.product(k, node.inputs, node.layer, inputs[0], inputs[1]))
            elif isinstance(node.layer, MaxPool):
                forms.append(self.pooling.maximum(k, node.inputs[0], node.layer, inputs[0]))
            else:
                forms.append(self.propagation.linear(k, node.inputs, node.layer, inputs))
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
        self.intermediate.forms = []
        return end

    def _learn(self, index: int, cut: bool) -> None:
        """Tell the schedule how wide bounds of node ``index`` are; ``cut``: those of numbers that are not cut off."""
        form = self.intermediate.forms[index]
        assert form is not None
        r = form.r
        if cut:
            above = form.interval.upper > 0.0
            r = r[above] if bool(above.any()) else r
        self.schedule.learns(index, float(r.mean()), float(form.reference.abs().mean()))

    def _leave(self, index: int) -> None:
        """Node ``index`` has been read; rows of later ones may end there (N18)."""
        form, self.intermediate.forms[index] = self.intermediate.forms[index], None
        if index in self.schedule.rests and index not in self.intermediate.stops:
            assert form is not None
            self.intermediate.stops[index] = self.intermediate.stop(index, form)
