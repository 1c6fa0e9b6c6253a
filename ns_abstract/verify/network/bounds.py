"""Bounds of a network's outputs over sets of images (docs/dev/design.md, N, N0)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ns_abstract.verify.network.backward import BackwardPass
from ns_abstract.verify.network.coefficient_source import CoefficientSource
from ns_abstract.verify.network.coefficients import Float64
from ns_abstract.verify.network.dependence import dependence
from ns_abstract.verify.network.forward import ForwardPass
from ns_abstract.verify.network.graph import Network, NetworkArithmetic
from ns_abstract.verify.network.image_sets import ImageSets, OutputBounds
from ns_abstract.verify.network.input_planes import finite, middle_of, planes_of
from ns_abstract.verify.network.intermediate_bounds import IntermediateBounds
from ns_abstract.verify.network.max_pool_propagation import MaxPoolPropagation
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
    """Lower bounds of ``rows @ network(x) + offset`` over every image set.

    Args:
        network: The network.
        images: m cells in d parameters.
        rows: [k, output_size] array or scipy sparse matrix.
        offset: [k], or [m, k] by image set.
        memory: Bytes to stay within, roughly.
        arithmetic: Whether the bounds hold for every float32 evaluation and the exact network, or for that alone.
        slope_steps: Steps towards the best slopes and tangents, for every row of its own (N14); each takes as long as
            two passes of the rows.
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
    """Bounds of one network over several cells: builds the passes and runs them over all nodes.

    ``asked``: [k, output_size] rows of which bounds will be asked, or None; ``coarse``: see `IntermediateBounds`.

    Attributes:
        intermediate: What is known of the nodes.
        last: The form of the last one.
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
        schedule = WorkBudget(network)
        backward = BackwardPass(intermediate, memory, schedule.deep)
        inner = RowAscent(intermediate, backward, 0 if schedule.deep else intermediate_steps, _INNER_STEP)
        neuron_bounds = NeuronBounds(intermediate, backward, schedule, sharing, inner)
        used = None if asked is None else dependence(network, asked)
        selection = NeuronSelection(intermediate, neuron_bounds, schedule, sharing, used)
        pooling = MaxPoolPropagation(intermediate, backward, schedule, sharing)
        propagation = ForwardPropagation(intermediate, sharing, bool(slope_steps or inner.steps))
        self.last = ForwardPass(intermediate, propagation, pooling, selection, schedule).run()
        self.output_rows = OutputRows(intermediate, backward, RowAscent(intermediate, backward, slope_steps))

    def outputs(self, rows: Any, offset: Float64) -> OutputBounds:
        """Bounds of ``rows @ y + offset`` in every cell."""
        return self.output_rows.bound(self.last, rows, offset)
