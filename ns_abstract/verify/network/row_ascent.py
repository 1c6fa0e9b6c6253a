"""Bounds of rows with slopes and multipliers optimised for each row (docs/dev/design.md, N14, N16)."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ns_abstract.verify.network.backward import BackwardPass, CoefficientBatch
from ns_abstract.verify.network.coefficients import Coefficients, Float64, Int64, grid
from ns_abstract.verify.network.cost_model import on_threads
from ns_abstract.verify.network.intermediate_bounds import IntermediateBounds
from ns_abstract.verify.network.max_pooling import MaxPool
from ns_abstract.verify.network.slope_choices import LineChoice, ascending
from ns_abstract.verify.network.slope_optimisation import FIRST_STEP, DualAscent, OptimisedSlopes, slope_derivatives
from ns_abstract.verify.network.stopping import BackwardBounds

#: Bytes of lines of rows' own that are worked on at a time.
_LINES_AT_ONCE = 32 << 20
#: Rows of a cell from which on several threads share them.
_ROWS_OF_A_THREAD = 32


class RowAscent:
    """Bounds rows with slopes and multipliers optimised for each.

    ``steps`` of optimisation, the first of size ``first``; rows have the type of the outputs' rows.
    """

    def __init__(
        self, intermediate: IntermediateBounds, backward: BackwardPass, steps: int, first: float = FIRST_STEP
    ) -> None:
        self.intermediate, self.network, self.backward = intermediate, intermediate.network, backward
        self.steps, self.first = steps, first

    def climb(self, index: int, coefficients: Coefficients, cell: Int64, best: BackwardBounds) -> None:
        """Raise ``best.lower`` of rows on node ``index``, with their planes, where optimised slopes give more."""
        for k in np.unique(cell):
            choices, own = ascending(self.intermediate.unstable, k), np.flatnonzero(cell == k)
            if not choices or not self.intermediate.usable[k]:
                continue
            parts, threads = self._shares(own, choices, coefficients.value.itemsize)
            for _ in on_threads(functools.partial(self._climb, index, coefficients, k, choices, best), parts, threads):
                pass

    def _shares(
        self, own: Int64, choices: Mapping[int, Sequence[LineChoice]], itemsize: int
    ) -> tuple[list[Int64], int]:
        """Return rows ``own`` in parts whose lines fit into memory, and the number of threads that share them."""
        size = sum(6 * itemsize * int(np.prod(self.network.shape(at))) for at in choices)
        step = max(1, _LINES_AT_ONCE // max(1, size))
        threads = torch.get_num_threads() if len(own) >= _ROWS_OF_A_THREAD else 1
        if threads > 1:
            step = min(step, -(-len(own) // threads))
        return [own[first : first + step] for first in range(0, len(own), step)], threads

    def _climb(
        self,
        index: int,
        coefficients: Coefficients,
        k: int,
        choices: Mapping[int, Sequence[LineChoice]],
        best: BackwardBounds,
        own: Int64,
    ) -> None:
        """`climb` for rows ``own`` of cell k."""
        start = coefficients[own]
        lines = {at: self.intermediate.relaxations[-1].lines[at][:, k] for at in choices}
        ascent = DualAscent(choices, lines, len(own), step=self.first)
        for number in range(self.steps + 1):
            chosen, bounds = self.evaluate(index, start, k, ascent)
            better = bounds.lower > best.lower[own]
            best.lower[own[better]], best.plane[own[better]] = bounds.lower[better], bounds.plane[better]
            if number < self.steps:
                self.move(index, k, chosen, bounds, ascent)

    def evaluate(
        self, index: int, start: Coefficients, k: int, ascent: DualAscent
    ) -> tuple[OptimisedSlopes, BackwardBounds]:
        """Return the present slopes of rows of cell ``k``, and the rows' bounds with them."""
        count = len(start.value)
        chosen, bounds = ascent.lines(), BackwardBounds.unknown(count, self.intermediate.d)
        # rows are changed in place
        part = start.replaced(start.value.copy())
        total, number = np.zeros((count, 2)), np.arange(count)
        relaxations = self.intermediate.relaxations[-1]
        batch = CoefficientBatch({index: part}, np.full(count, k), total, number, relaxations, chosen)
        self.backward.descend(index, index, batch, bounds, None)
        return chosen, bounds

    def move(self, index: int, k: int, chosen: OptimisedSlopes, bounds: BackwardBounds, ascent: DualAscent) -> None:
        """Take one optimisation step from the slopes in ``chosen``."""
        slopes, forces = self._derivatives(index, k, chosen, bounds, ascent)
        ascent.climb(slopes, forces, {at: self._size(chosen, at) for at in ascent.split})

    def _size(self, chosen: OptimisedSlopes, source: int) -> float:
        """Return the typical magnitude of the coefficients in ``chosen`` at the readers of node ``source``."""
        sizes = [
            float(np.abs(chosen.trace[k]).mean())
            for k, node in enumerate(self.network.nodes, 1)
            if source in node.inputs and k in chosen.trace
        ]
        return max(sizes, default=0.0)

    def _derivatives(
        self, index: int, cell: int, chosen: OptimisedSlopes, found: BackwardBounds, ascent: DualAscent
    ) -> tuple[dict[int, list[Float64]], dict[int, Float64]]:
        """Return the derivatives of a cell's bounds by the slopes and multipliers in ``chosen``, by node."""
        planes, relaxations = self.intermediate.image, self.intermediate.relaxations[-1]
        on_image = chosen.trace.get(0)
        if on_image is None:
            on_image = np.zeros((len(found.lower), *grid(self.network.input_shape)), np.float32)
        p = -np.sign(np.nan_to_num(found.plane[:, 0, :-1]))
        ends = np.einsum("schwd,rd->srchw", planes.slopes[cell], p) + planes.offsets[cell][:, None]
        image = np.where(on_image >= 0.0, ends[0], ends[1]).astype(np.float32)
        others: dict[int, Any] = {}
        for k, (one, two) in relaxations.products.items():
            others[k] = functools.partial(_product, torch.from_numpy(one[:, cell]), torch.from_numpy(two[:, cell]))
        for k, maxima in relaxations.maxima.items():
            layer = self.network.nodes[k - 1].layer
            assert isinstance(layer, MaxPool)
            others[k] = functools.partial(maxima.forward, layer, cell)

        def lines(k: int) -> np.ndarray:
            return chosen.lines[k] if k in chosen.lines else relaxations.lines[k][:, cell : cell + 1]

        shaped = torch.from_numpy(image).reshape(-1, *self.network.input_shape)
        return slope_derivatives(self.network, shaped, chosen.trace, lines, ascent, others, index)


def _product(one: Tensor, two: Tensor, coefficients: Tensor, inputs: list[Tensor]) -> Tensor:
    """Return values, at the factors, of the planes of a product that ``coefficients`` choose."""
    x, y = (v.reshape(coefficients.shape) for v in inputs)
    offset = torch.where(coefficients >= 0.0, one[1] + two[1], one[4] + two[4])
    return one[0] * x + two[0] * y + offset
