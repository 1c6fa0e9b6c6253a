"""The backward pass of CROWN: coefficients propagated from a node to the input (docs/dev/design.md, N5, N17, N18)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ns_abstract.arithmetic.network_charges import DOUBLE_UNIT
from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.verify.network.bilinear import Product
from ns_abstract.verify.network.coefficients import (
    Coefficients,
    Float64,
    Int64,
    charge,
    concretize,
    full,
    grid,
    join,
    pass_activation,
)
from ns_abstract.verify.network.intermediate_bounds import IntermediateBounds
from ns_abstract.verify.network.layers import Activation, LinearLayer
from ns_abstract.verify.network.max_pooling import MaxPool
from ns_abstract.verify.network.relaxations import Relaxations
from ns_abstract.verify.network.slope_optimisation import OptimisedSlopes
from ns_abstract.verify.network.stopping import BackwardBounds, BackwardTrace, StoppingCriterion

#: Bytes of rows that are worked on at a time: they should stay in a processor's cache.
ROWS_AT_ONCE = 24 << 20


@dataclass
class CoefficientBatch:
    """Coefficient rows during a backward pass.

    Attributes:
        waiting: Coefficients that have arrived at a node and are not yet propagated through it, by node.
        cell, number: [R] each row's cell, and its position in the result.
        total: [R, 2] constants below and above that the rows have gathered so far.
        passage: Relaxations of the nodes.
        chosen: Slopes chosen for each row, and memory for the coefficients on the way.
        trace: Memory for the coefficients on the way.
    """

    waiting: dict[int, Coefficients]
    cell: Int64
    total: Float64
    number: Int64
    passage: Relaxations
    chosen: OptimisedSlopes | None = None
    trace: BackwardTrace | None = None

    def __getitem__(self, part: Any) -> CoefficientBatch:
        waiting = {k: rows[part] for k, rows in self.waiting.items()}
        return CoefficientBatch(
            waiting, self.cell[part], self.total[part], self.number[part], self.passage, self.chosen, self.trace
        )

    @property
    def bytes(self) -> int:
        return sum(rows.value.nbytes for rows in self.waiting.values())


class BackwardPass:
    """Propagates coefficients backwards through the relaxations of the nodes, which it does not change.

    ``memory``: approximate limit in bytes. ``deep``: refined neurons of this network are rationed (N13); rows that are
    stored for reuse may then stop early, too.
    """

    def __init__(self, intermediate: IntermediateBounds, memory: int, deep: bool) -> None:
        self.intermediate, self.network = intermediate, intermediate.network
        self.memory, self.deep = memory, deep

    def bound(
        self,
        index: int,
        coefficients: Coefficients,
        cell: Int64,
        enough: StoppingCriterion | None = None,
        trace: BackwardTrace | None = None,
        cut: int = 0,
    ) -> BackwardBounds:
        """Return bounds of coefficient rows on node ``index``, relative to the reference.

        Rows for which ``enough`` holds may stop before the image; ``trace`` records coefficients on the way. All rows
        end at nodes up to ``cut`` (N18).
        """
        bounds = BackwardBounds.unknown(len(cell), self.intermediate.d)
        relaxations = next(
            relaxations for relaxations in self.intermediate.relaxations if relaxations.takes(coefficients)
        )
        batch = CoefficientBatch(
            {index: coefficients}, cell, np.zeros((len(cell), 2)), np.arange(len(cell)), relaxations
        )
        batch.trace = trace
        self.descend(index, index, batch, bounds, enough, cut)
        return bounds

    def descend(
        self,
        start: int,
        at: int,
        batch: CoefficientBatch,
        bounds: BackwardBounds,
        enough: StoppingCriterion | None,
        cut: int = 0,
    ) -> None:
        """Propagate a batch from node ``at`` to the image, or to the nodes up to ``cut``."""
        while at > cut:
            if at not in batch.waiting:
                at -= 1
                continue
            check_cancelled()
            if batch.bytes > min(ROWS_AT_ONCE, self.memory // 16) and len(batch.cell) > 1:
                half = len(batch.cell) // 2
                for part in (slice(0, half), slice(half, None)):
                    self.descend(start, at, batch[part], bounds, enough, cut)
                return
            ends = enough is not None and (batch.trace is None or self.deep)
            if (
                enough is not None
                and ends
                and at != start
                and at in self.intermediate.stops
                and len(batch.waiting) == 1
            ):
                self._bound_rows(batch, bounds)
                going_on = ~enough.done(bounds, batch.number)
                if going_on.mean() < 0.75:
                    bounds.ended[batch.number[~going_on]] = at
                    batch = batch[going_on]
                if not len(batch.cell):
                    return
            here = batch.waiting.pop(at)
            node = self.network.nodes[at - 1]
            if batch.chosen is not None and at in batch.chosen.multiplier_terms:
                flat, gained, offset = batch.chosen.multiplier_terms[at]
                here = full(here, node.layer.shape, force=True)
                here.value.reshape(len(here.value), -1)[:, flat] += gained[batch.number]
                batch.total[:, 0] += offset[batch.number]
            if batch.chosen is not None and not isinstance(node.layer, LinearLayer):
                here = full(here, node.layer.shape, force=True)
                batch.chosen.keep(at, here.value, batch.number, len(bounds.lower))
            gathered = batch.total.copy() if batch.trace is not None else batch.total
            if batch.trace is not None and not batch.trace.short and self._depends(start, at):
                batch.trace.keep(at, here, node.layer.shape, batch.number)
            parts = self._inputs_of(start, at, batch, here)
            if batch.trace is not None and (batch.trace.short or isinstance(node.layer, (MaxPool, Product))):
                batch.trace.fixed[batch.number] += batch.total - gathered
            for source, part in zip(node.inputs, parts, strict=True):
                there = batch.waiting.get(source)
                shape = self.network.shape(source)
                batch.waiting[source] = full(part, shape) if there is None else join(there, part, shape)
        if cut:
            self._bound_rows(batch, bounds, cut=True)
            return
        if batch.chosen is not None and 0 in batch.waiting:
            whole = full(batch.waiting[0], self.network.input_shape, force=True)
            batch.chosen.keep(0, whole.value, batch.number, len(bounds.lower))
        if batch.trace is not None:
            batch.trace.reached[batch.number] = True
            if 0 in batch.waiting:
                batch.trace.keep(0, batch.waiting[0], self.network.input_shape, batch.number)
        self._bound_rows(batch, bounds)

    def _inputs_of(self, start: int, at: int, batch: CoefficientBatch, here: Coefficients) -> list[Coefficients]:
        """Return coefficients on the inputs of node ``at`` for those ``here`` on its output; adds to ``total``."""
        layer = self.network.nodes[at - 1].layer
        if isinstance(layer, Activation):
            lines, which = batch.passage.lines[at], batch.cell
            if batch.chosen is not None and at in batch.chosen.lines:
                lines, which = batch.chosen.lines[at], batch.number
            pass_activation(here.value, here.y, here.x, which, lines, batch.total)
            return [here]
        if isinstance(layer, MaxPool):
            return [batch.passage.maxima[at].backward(here, layer, batch.cell, batch.total)]
        if isinstance(layer, Product):
            # every reader changes its rows in place
            parts = [here, here.replaced(here.value.copy())]
            for part, lines in zip(parts, batch.passage.products[at], strict=True):
                pass_activation(part.value, part.y, part.x, batch.cell, lines, batch.total)
            return parts
        if at == start or at not in self.intermediate.folded:
            shape = grid(layer.shape)
            noise = batch.passage.noise[at].reshape(self.intermediate.count, *shape).contiguous().numpy()
            charge(here.value, here.y, here.x, batch.cell, noise, batch.total)
        return layer.backward(here)

    def _depends(self, start: int, at: int) -> bool:
        """Return whether the constants of rows from node ``start`` at node ``at`` depend on the cell's ranges (N15)."""
        layer = self.network.nodes[at - 1].layer
        charged = isinstance(layer, LinearLayer) and at != start and at not in self.intermediate.folded
        return charged or isinstance(layer, Activation)

    def _bound_rows(self, batch: CoefficientBatch, bounds: BackwardBounds, cut: bool = False) -> None:
        """Concretise a batch on the node of known form that it has arrived at; with ``cut`` on several nodes (N18)."""
        count, total = len(batch.cell), batch.total
        plane, box = np.zeros((count, 2, self.intermediate.d + 1)), np.zeros((count, 2))
        lost = self.intermediate.flush[batch.cell]
        if not batch.waiting:
            plane[:, :, -1] = box[:] = total
        for at, coefficients in batch.waiting.items():
            columns = self.intermediate.stops[at] if at else self.intermediate.columns
            one, two = np.zeros_like(plane), np.zeros_like(box)
            concretize(coefficients.value, coefficients.y, coefficients.x, batch.cell, columns, total, one, two)
            plane += one
            box += two
            total = np.zeros_like(total)
            if cut:
                sizes = np.abs(one).sum((1, 2)) + np.abs(two).sum(1)
                lost = lost + 2.0 * DOUBLE_UNIT * len(batch.waiting) * sizes
        lost = lost[:, None] * np.array([-1.0, 1.0])
        plane[:, :, -1] += lost
        box += lost
        bounds.improve(batch.number, plane, box)
