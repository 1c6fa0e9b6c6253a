"""Bounds of a network's outputs over sets of images (docs/dev/design.md, N, N0, N1, N18)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ns_abstract.verify.network.backward import BackwardPass
from ns_abstract.verify.network.bilinear import Product
from ns_abstract.verify.network.coefficient_source import CoefficientSource
from ns_abstract.verify.network.coefficients import Float64
from ns_abstract.verify.network.dependence import dependence
from ns_abstract.verify.network.forms import NodeForm
from ns_abstract.verify.network.graph import Network, NetworkArithmetic
from ns_abstract.verify.network.image_sets import ImageSets, OutputBounds
from ns_abstract.verify.network.input_planes import finite, middle_of, planes_of
from ns_abstract.verify.network.intermediate_bounds import IntermediateBounds
from ns_abstract.verify.network.layers import Activation, LeakyRelu
from ns_abstract.verify.network.max_pool_propagation import MaxPoolPropagation
from ns_abstract.verify.network.max_pooling import MaxPool
from ns_abstract.verify.network.neuron_bounds import NeuronBounds
from ns_abstract.verify.network.neuron_selection import NeuronSelection
from ns_abstract.verify.network.output_bounds import OutputRows
from ns_abstract.verify.network.propagation import ForwardPropagation
from ns_abstract.verify.network.row_ascent import RowAscent
from ns_abstract.verify.network.subnormals import subnormals_kept
from ns_abstract.verify.network.work_budget import WorkBudget

#: The first step's size of lines for intermediate bounds, for which there are few steps.
_INNER_STEP = 0.6


@subnormals_kept()
def bound_outputs(
    network: Network,
    images: ImageSets,
    rows: Any,
    offset: Float64,
    *,
    memory: int = 1 << 30,
    arithmetic: NetworkArithmetic = "float32",
    slope_steps: int = 0,
    intermediate_steps: int = 0,
) -> OutputBounds:
    """Return lower bounds of ``rows @ network(x) + offset`` over every image set.

    Args:
        network: The network.
        images: m cells in d parameters.
        rows: [k, output_size] array or scipy sparse matrix.
        offset: [k], or [m, k] by image set.
        memory: Approximate limit in bytes.
        arithmetic: "float32": bounds hold for the exact network and every float32 evaluation; "real": for the former.
        slope_steps: Optimisation steps of slopes and tangents, for every row (N14); a step takes as long as two
            backward passes.
        intermediate_steps: The same for intermediate bounds, but in deep networks.
    """
    offset = np.asarray(offset, np.float64)
    if images.a_lower.shape[1] != network.input_size:
        raise ValueError(f"images of {network.input_size} numbers expected, got {images.a_lower.shape[1]}")
    if rows.shape != (offset.shape[-1], network.output_size):
        raise ValueError(f"rows {(offset.shape[-1], network.output_size)} expected, got {rows.shape}")
    arrays = 3 * images.dimensions + 14 + (7 if arithmetic == "real" else 0)
    by_cell = network.neuron_count * 8 * arrays
    step = max(1, int(0.5 * memory) // by_cell)
    parts = []
    for first in range(0, images.count, step):
        part = images[first : first + step]
        cells = NetworkBounds(network, part, memory, arithmetic, slope_steps, None, intermediate_steps)
        parts.append(cells.outputs(rows, offset[first : first + step] if offset.ndim > 1 else offset))
    if not parts:
        k, d = offset.shape[-1], images.dimensions
        return OutputBounds(np.zeros((0, k)), np.zeros((0, k, d)), np.zeros((0, k)))
    return OutputBounds(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("lower", "a", "b")))


class NetworkBounds:
    """Bounds one network over several cells: propagates forms forwards, and refines neurons where that pays.

    ``asked``: [k, output_size] rows that will be bounded, or None; ``coarse``: see `IntermediateBounds`.

    Attributes:
        intermediate: Forms and relaxations of the nodes.
        last: The form of the last node.
        output_rows: Bounds rows of the outputs.
    """

    def __init__(
        self,
        network: Network,
        images: ImageSets,
        memory: int,
        arithmetic: NetworkArithmetic = "float32",
        slope_steps: int = 0,
        sharing: CoefficientSource | None = None,
        intermediate_steps: int = 0,
        asked: Float64 | None = None,
        coarse: bool = False,
    ) -> None:
        sharing = CoefficientSource() if sharing is None else sharing
        fields, usable = finite(images)
        middle = sharing.about(middle_of(fields))
        image = planes_of(fields, middle, network.input_shape)
        self.intermediate = intermediate = sharing.intermediate = IntermediateBounds(
            network, image, middle, usable, arithmetic, coarse
        )
        self._network, self._schedule = network, (schedule := WorkBudget(network))
        backward = BackwardPass(intermediate, memory, schedule.deep)
        inner = RowAscent(intermediate, backward, 0 if schedule.deep else intermediate_steps, _INNER_STEP)
        neuron_bounds = NeuronBounds(intermediate, backward, schedule, sharing, inner)
        used = None if asked is None else dependence(network, asked)
        self._selection = NeuronSelection(intermediate, neuron_bounds, schedule, sharing, used)
        self._pooling = MaxPoolPropagation(intermediate, backward, schedule, sharing)
        self._propagation = ForwardPropagation(intermediate, sharing, bool(slope_steps or inner.steps))
        self.last = self._propagate()
        self.output_rows = OutputRows(intermediate, backward, RowAscent(intermediate, backward, slope_steps))

    def outputs(self, rows: Any, offset: Float64) -> OutputBounds:
        """Return bounds of ``rows @ y + offset`` in every cell."""
        return self.output_rows.bound(self.last, rows, offset)

    def _propagate(self) -> NodeForm:
        """Propagate forms through the nodes in order, refining neurons where that pays, and return the last form."""
        forms: list[NodeForm | None] = [self.intermediate.image_form()]
        self.intermediate.forms = forms
        if self._schedule.planned:
            self._learn(0, False)
        for k, node, inputs in self._network.walk(forms, leave=self._leave):
            if isinstance(node.layer, Activation):
                # what is known better of the input is also known to its other readers
                source = node.inputs[0]
                interval = inputs[0].interval
                unstable, apart = node.layer.unstable(*interval), node.layer.relaxation_gap(*interval)
                forms[source] = inputs[0] = self._selection.refine(source, inputs[0], unstable, apart, node.layer)
                if isinstance(node.layer, LeakyRelu):
                    self._selection.unsure = float(node.layer.unstable(*inputs[0].interval).double().mean())
                forms.append(self._propagation.activation(k, source, node.layer, inputs[0]))
                if self._network.depth[source] > 1:
                    self.intermediate.stops[source] = self.intermediate.stop(source, inputs[0])
            elif isinstance(node.layer, Product):
                intervals = inputs[0].interval, inputs[1].interval
                unstable, apart = node.layer.unstable(*intervals), node.layer.relaxation_gap(*intervals)
                for position, source in enumerate(node.inputs):
                    forms[source] = inputs[position] = self._selection.refine(source, inputs[position], unstable, apart)
                forms.append(self._propagation.product(k, node.inputs, node.layer, inputs[0], inputs[1]))
            elif isinstance(node.layer, MaxPool):
                forms.append(self._pooling.maximum(k, node.inputs[0], node.layer, inputs[0]))
            else:
                forms.append(self._propagation.linear(k, node.inputs, node.layer, inputs))
            if self._schedule.planned:
                for index in node.inputs:
                    self._learn(index, isinstance(node.layer, LeakyRelu) and node.layer.alpha == 0.0)
                self._learn(k, False)
        end = forms[-1]
        assert end is not None
        self.intermediate.forms = []
        return end

    def _learn(self, index: int, cut: bool) -> None:
        """Pass the widths of node ``index`` to the cost model; ``cut``: only those of numbers that are not clipped."""
        form = self.intermediate.forms[index]
        assert form is not None
        r = form.r
        if cut:
            above = form.interval.upper > 0.0
            r = r[above] if bool(above.any()) else r
        self._schedule.record_width(index, float(r.mean()), float(form.reference.abs().mean()))

    def _leave(self, index: int) -> None:
        """Record that every reader of node ``index`` has read it; later rows may end there (N18)."""
        form = self.intermediate.forms[index]
        if index in self._schedule.end_nodes and index not in self.intermediate.stops:
            assert form is not None
            self.intermediate.stops[index] = self.intermediate.stop(index, form)
