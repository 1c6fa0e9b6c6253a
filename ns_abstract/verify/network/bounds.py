"""Bounds of a network's outputs over sets of images (docs/design.md, N, N0)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ns_abstract.verify.network.backward import Backward
from ns_abstract.verify.network.forward import Forward
from ns_abstract.verify.network.graph import Network, NetworkArithmetic
from ns_abstract.verify.network.image import finite, middle_of, planes_of
from ns_abstract.verify.network.intermediate import Intermediate
from ns_abstract.verify.network.known import Known
from ns_abstract.verify.network.outputs import Outputs
from ns_abstract.verify.network.pooling import Pooling
from ns_abstract.verify.network.propagation import Propagation
from ns_abstract.verify.network.rows import Float64
from ns_abstract.verify.network.schedule import Schedule
from ns_abstract.verify.network.selection import Selection
from ns_abstract.verify.network.sets import ImageSets, OutputBounds, Signs, Substitution
from ns_abstract.verify.network.sharing import Sharing
from ns_abstract.verify.network.subnormals import subnormals_kept


@subnormals_kept()
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
    """Bounds of one network over several cells: builds the passes and runs them over all nodes.

    Attributes:
        known: What is known of the nodes.
        last: The form of the last one.
    """

    def __init__(
        self,
        network: Network,
        images: ImageSets,
        substitution: Substitution,
        memory: int,
        arithmetic: NetworkArithmetic = "float32",
        slope_steps: int = 0,
        assumed: Sequence[Mapping[int, Signs]] | None = None,
        sharing: Sharing | None = None,
    ) -> None:
        sharing = Sharing() if sharing is None else sharing
        fields, good = finite(images)
        middle = sharing.about(middle_of(fields))
        image = planes_of(fields, middle, network.input_shape, substitution)
        self.known = known = sharing.known = Known(network, image, middle, good, arithmetic, assumed)
        schedule = Schedule(network)
        backward = Backward(known, memory, schedule.deep)
        intermediate = Intermediate(known, backward, schedule, sharing)
        selection = Selection(known, intermediate, schedule, sharing)
        pooling = Pooling(known, backward, schedule, sharing)
        propagation = Propagation(known, sharing, bool(slope_steps))
        self.last = Forward(known, propagation, pooling, selection, schedule).run()
        if substitution == "end":
            known.see(planes_of(fields, middle, network.input_shape, "everywhere"))
        self._outputs = Outputs(known, backward, slope_steps)

    def outputs(self, rows: Any, offset: Float64) -> OutputBounds:
        """Bounds of ``rows @ y + offset`` in every cell."""
        return self._outputs.bound(self.last, rows, offset)
