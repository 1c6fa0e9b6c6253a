"""Where a cell takes references, slopes and coefficients from: from itself, or from another cell (design.md, N15)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from torch import Tensor

from ns_abstract.verify.network.coefficients import Float64, Int64
from ns_abstract.verify.network.forms import NodeForm
from ns_abstract.verify.network.intermediate_bounds import IntermediateBounds
from ns_abstract.verify.network.layers import Activation
from ns_abstract.verify.network.stopping import BackwardTrace


class CoefficientSource:
    """Lets every cell use its own coefficients; subclasses store coefficients, or reuse stored ones.

    ``intermediate``: the cells' intermediate bounds, set before any method but `about` is called.
    """

    intermediate: IntermediateBounds
    #: Most rows that are passed back together.
    most_rows = 1 << 30

    def about(self, middle: Float64) -> Float64:
        """Return the reference pictures [m, n], given the sets' middles; any pictures are sound."""
        return middle

    def reference(self, k: int, passed_on: Callable[[], Tensor]) -> Tensor:
        """Return the reference [m, *shape] of node ``k``; ``passed_on`` computes it from its inputs' references."""
        return passed_on()

    def rounding_form(self, form: NodeForm) -> NodeForm:
        """Return the form whose magnitudes rounding is charged by: the cell's own, or one that holds for more cells."""
        return form

    def winner(self, k: int, winner: Tensor) -> Tensor:
        """Return the inputs [m, C, 1, W] that lower planes of pooling windows at node ``k`` follow; any are sound."""
        return winner

    def slopes(self, k: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Return another cell's slopes [1, *shape] at node ``k``, for coefficients >= 0 and < 0, or None."""
        return None

    def reuse_bounds(
        self, index: int, form: NodeForm, unstable: Tensor, gaps: Tensor | None, layer: Activation | None
    ) -> tuple[NodeForm, Tensor, Tensor | None]:
        """Return the form of node ``index``, tightened by reused coefficients, its unstable neurons and their gaps."""
        return form, unstable, gaps

    def trace(self, count: int) -> BackwardTrace | None:
        """Return memory that receives the coefficients of ``count`` rows; None if they are not to be reused (N15)."""
        return None

    def keep(self, index: int, where: Int64, sign: Float64, trace: BackwardTrace) -> None:
        """Store coefficients for other cells: of rows ``sign`` times the neurons ``where`` of node ``index``."""
