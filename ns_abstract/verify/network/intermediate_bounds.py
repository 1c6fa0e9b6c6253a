"""Intermediate bounds and relaxations of all nodes over several cells (docs/dev/design.md, N1, N18)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import DOUBLE_UNIT, OWN_LINE, UNIT
from ns_abstract.verify.network.coefficients import Float64, NodeColumns, columns_of, grid
from ns_abstract.verify.network.cost_model import BackwardRoute
from ns_abstract.verify.network.forms import NodeForm
from ns_abstract.verify.network.graph import Network, NetworkArithmetic
from ns_abstract.verify.network.input_planes import ImagePlanes, form_of
from ns_abstract.verify.network.relaxations import Relaxations, ReusedRelaxation
from ns_abstract.verify.network.slope_choices import UnstableNeurons


class IntermediateBounds:
    """Forms and relaxations of the nodes: the forward pass adds them, the backward pass reads them.

    Args:
        network, image: The network, and the planes of the image.
        middle: [m, n] the images' reference.
        usable: [m] cells that are not given up; changed in place.
        arithmetic: As in `ns_abstract.verify.network.bound_outputs`.
        coarse: Whether coefficients are float32, and charged for it, in real arithmetic, too: that takes less than half
            the time.

    Attributes:
        count, d: Cells m and parameters d.
        in_float32: Whether float32 evaluations of the network are bounded.
        image, columns: The image as planes, and laid out for concretising.
        flush: [m] the largest loss of any row by flushing to zero on the way.
        relaxations: Relaxations for rows of intermediate nodes, and, the last, for rows of outputs.
        folded: Nodes whose rounding is charged in that of their only reader.
        forms, stops: By node: its form, while other nodes read it; its planes, where rows may stop.
        unstable: By node: neurons whose lower lines may have other slopes.
        reused_relaxations: By node: lines with slopes of another cell's rows.
    """

    def __init__(
        self,
        network: Network,
        image: ImagePlanes,
        middle: Float64,
        usable: np.ndarray,
        arithmetic: NetworkArithmetic,
        coarse: bool = False,
    ) -> None:
        self.network, self.middle, self.usable = network, middle, usable
        self.count, self.d = len(middle), image.slopes.shape[-1]
        self.in_float32 = arithmetic != "real"
        self.flush = np.zeros(self.count)
        self.image, self.columns = image, columns_of(*image)
        # every number is passed by a few times at most
        sums = 4.0 * DOUBLE_UNIT * (network.neuron_count + len(network.nodes))
        self.relaxations = [Relaxations(torch.float32, UNIT, sums)]
        if not (self.in_float32 or coarse):
            # beside the rounding of a float32 network that of rows is little
            self.relaxations.append(Relaxations(torch.float64, DOUBLE_UNIT, sums))
        self.folded: set[int] = set()
        self.forms: list[NodeForm | None] = []
        self.stops: dict[int, NodeColumns] = {}
        self.unstable: dict[int, UnstableNeurons] = {}
        self.reused_relaxations: dict[int, ReusedRelaxation] = {}

    def image_form(self) -> NodeForm:
        """Return the image as a form."""
        form = form_of(self.image, self.middle, self.network.input_shape)
        lower, upper = torch.from_numpy(self.image.lower), torch.from_numpy(self.image.upper)
        return self.within(form, lower.reshape(form.c.shape), upper.reshape(form.c.shape))

    def rounds(self, source: int) -> bool:
        """Return whether rows are charged for the rounding of node ``source``."""
        return source in self.relaxations[0].noise

    def within(self, form: NodeForm, lower: Tensor, upper: Tensor) -> NodeForm:
        """Return the form intersected with further bounds; a cell where that is empty is given up."""
        low, high = torch.maximum(form.lower, lower), torch.minimum(form.upper, upper)
        fine = low <= high
        for part in (form.reference, form.c, form.r, form.a):
            # sums are finite unless a number, or they, are not
            if not bool(torch.isfinite(part.sum())):
                finite = torch.isfinite(part)
                fine = fine & (finite.all(1) if part.ndim > fine.ndim else finite)
        consistent = fine.reshape(self.count, -1).all(1)
        self.usable &= consistent.numpy()
        form_within = NodeForm(form.reference, form.c, form.a, form.r, low, high, form.active)
        if bool(consistent.all()):
            return form_within

        # what is given up must not slow the others down with NaN
        def clear(t: Tensor) -> Tensor:
            return torch.where(consistent.reshape(-1, *[1] * (t.ndim - 1)), t, torch.zeros_like(t))

        return NodeForm(*(clear(getattr(form_within, name)) for name in NodeForm.__dataclass_fields__))

    def stop(self, index: int, form: NodeForm) -> NodeColumns:
        """Return the planes of node ``index``, for rows that stop there."""
        m, d, shape = self.count, self.d, grid(self.network.shape(index))
        room = OWN_LINE * (form.c.abs() + form.r)
        slopes = form.a.movedim(1, -1).reshape(m, 1, *shape, d).expand(m, 2, *shape, d)
        offsets = torch.stack([form.c - form.r - room, form.c + form.r + room], 1)
        sizes = (m, 2, *shape, d), (m, 2, *shape), (m, *shape), (m, *shape)
        arrays = zip((slopes, offsets, form.lower, form.upper), sizes, strict=True)
        return columns_of(*(t.reshape(size).numpy() for t, size in arrays))

    def ready(self, route: BackwardRoute) -> int:
        """Prepare the planes of all nodes where a route ends, and return its cut."""
        for at, _ in route.ends:
            if at and at not in self.stops:
                form = self.forms[at]
                assert form is not None
                self.stops[at] = self.stop(at, form)
        return route.cut
