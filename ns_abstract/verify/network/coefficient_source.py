"""Where a cell takes references, slopes and coefficients from: by default from itself (docs/dev/design.md, N15)."""

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
    """Bounds every cell by itself; subclasses store coefficients for other cells or reuse stored ones.

    ``intermediate`` is what is known of the cells, before anything but `about` is asked.
    """

    intermediate: IntermediateBounds
    #: Most rows that are passed back together.
    most_rows = 1 << 30

    def about(self, middle: Float64) -> Float64:
        """[m, n] pictures that all is relative to, for the sets' middles: any will do."""
        return middle

    def reference(self, k: int, passed_on: Callable[[], Tensor]) -> Tensor:
        """[m, *shape] what is relative to at node ``k``: that of its inputs passed on with float64's rounding."""
        return passed_on()

    def rounding_form(self, form: NodeForm) -> NodeForm:
        """The form, or one of more cells, by which rounding is charged: sizes are all that is read of it."""
        return form

    def winner(self, k: int, winner: Tensor) -> Tensor:
        """[m, C, 1, W] numbers of windows that are followed from below at node ``k``: any will do."""
        return winner

    def slopes(self, k: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Slopes [1, *shape] of rows of another cell on node ``k``, not negative and negative ones."""
        return None

    def reuse_bounds(
        self, index: int, form: NodeForm, unstable: Tensor, apart: Tensor | None, layer: Activation | None
    ) -> tuple[NodeForm, Tensor, Tensor | None]:
        """Return bounds of node ``index``, its unstable neurons, and their relaxation gaps (see `NeuronSelection`)."""
        return form, unstable, apart

    def trace(self, count: int) -> BackwardTrace | None:
        """A place for so many rows that are to be kept (N15)."""
        return None

    def keep(self, index: int, where: Int64, sign: Float64, trace: BackwardTrace) -> None:
        """Take notice of rows of ``sign`` times single numbers of node ``index``."""
