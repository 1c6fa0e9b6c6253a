"""Bounds of linear functions of the outputs, with optimised slopes and multipliers (docs/design.md, N14, N16)."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import DOUBLE_UNIT, OWN_LINE
from ns_abstract.verify.network.backward import ROWS_AT_ONCE, BackwardPass, CoefficientBatch
from ns_abstract.verify.network.coefficients import Coefficients, Float64, Int64, grid
from ns_abstract.verify.network.forms import NodeForm
from ns_abstract.verify.network.image_sets import OutputBounds
from ns_abstract.verify.network.intermediate_bounds import IntermediateBounds
from ns_abstract.verify.network.max_pooling import MaxPool
from ns_abstract.verify.network.slope_optimisation import (
    DualAscent,
    OptimisedSlopes,
    UnstableNeurons,
    slope_derivatives,
)
from ns_abstract.verify.network.stopping import BackwardBounds

#: Room for rounding above zero where nothing better is looked for.
_SURE = 1e-9


class OutputRows:
    """Bounds linear functions of the outputs once all intermediate bounds are there.

    Args:
        intermediate: What is known of the nodes.
        backward: Passes rows back over it.
        slope_steps: As in `ns_abstract.verify.network.bound_outputs`.
    """

    def __init__(self, intermediate: IntermediateBounds, backward: BackwardPass, slope_steps: int) -> None:
        self.intermediate, self.network, self.backward = intermediate, intermediate.network, backward
        self.slope_steps = slope_steps

    def bound(self, last: NodeForm, rows: Any, offset: Float64) -> OutputBounds:
        """Bounds of ``rows @ y + offset`` in every cell, y as ``last`` says."""
        index = len(self.network.nodes)
        m, k = self.intermediate.count, len(offset)
        plane, lower = np.zeros((m, k, self.intermediate.d + 1)), np.zeros((m, k))
        loosest = np.zeros((m, k, 2), np.int64)
        shape = grid(self.network.shape(index))
        dense = np.asarray(rows.toarray() if hasattr(rows, "toarray") else rows, np.float64)
        stored = dense.astype(self.intermediate.relaxations[-1].number)
        size = last.width.reshape(m, -1).numpy()
        reference = last.reference.reshape(m, -1).numpy()
        missing = size @ np.abs(dense - stored).T
        missing += 2.0 * DOUBLE_UNIT * (dense.shape[1] + 2) * (np.abs(reference) @ np.abs(dense).T)
        offset = reference @ dense.T + offset
        need = -offset + _SURE * (1.0 + np.abs(offset))
        for top, left, height, width, number in _windows(stored.reshape(k, *shape)):
            part = stored.reshape(k, *shape)[:, :, top : top + height, left : left + width]
            step = max(1, ROWS_AT_ONCE // (stored.itemsize * shape[0] * height * width))
            for first in range(0, m * len(number), step):
                which = np.arange(first, min(m * len(number), first + step))
                cell, row = which // len(number), number[which % len(number)]
                rows = Coefficients(
                    np.ascontiguousarray(part[row]), np.full(len(which), top), np.full(len(which), left)
                )
                bounds, loosest[cell, row] = self._climb(index, rows, cell, need[cell, row])
                plane[cell, row], lower[cell, row] = bounds.plane[:, 0], bounds.lower
        room = OWN_LINE * (np.abs(plane).sum(-1) + np.abs(offset) + missing) + missing
        lower, b = lower + offset - room, plane[..., -1] + offset - room
        a = plane[..., :-1]
        finite = self.intermediate.good[:, None] & np.isfinite(lower)
        usable = self.intermediate.good[:, None] & np.isfinite(b) & np.isfinite(a).all(-1)
        lower = np.where(self.intermediate.infeasible[:, None], np.inf, np.where(finite, lower, -np.inf))
        return OutputBounds(lower, np.where(usable[..., None], a, 0.0), np.where(usable, b, -np.inf), loosest)

    def _climb(self, index: int, rows: Coefficients, cell: Int64, need: Float64) -> tuple[BackwardBounds, Int64]:
        """Bounds below of rows on node ``index``, with the best slopes and multipliers that were tried (N14, N16).

        Where signs are assumed, a cell whose rows are above ``need`` [R] is done. Also returns `OutputBounds.loosest`
        of the rows.
        """
        loosest = np.full((len(cell), 2), -1, np.int64)
        if not self.slope_steps:
            return self.backward.bound(index, rows, cell), loosest
        # slopes are chosen in float32
        start = Coefficients(rows.value.astype(np.float32), rows.y, rows.x)
        best, lines = self.backward.bound(index, rows, cell), self.intermediate.relaxations[0].lines
        for k in np.unique(cell):
            units = {at: neurons.of(k) for at, neurons in self.intermediate.unstable.items()}
            units = {at: neurons for at, neurons in units.items() if len(neurons.flat)}
            own, held = np.flatnonzero(cell == k), self.intermediate.split[k]
            if not (units or held) or not self.intermediate.good[k]:
                continue
            first = {at: lines[at][0, k].reshape(-1)[neurons.flat] for at, neurons in units.items()}
            ascent = DualAscent(units, first, len(own), held)
            for _ in range(self.slope_steps + 1):
                if self.intermediate.assumed is not None and bool((best.lower[own] > need[own]).all()):
                    break
                chosen = ascent.lines(lines, k)
                bounds = BackwardBounds.unknown(len(own), self.intermediate.d)
                # rows are changed in place
                part = Coefficients(start.value[own], start.y[own], start.x[own])
                total, number = np.zeros((len(own), 2)), np.arange(len(own))
                batch = CoefficientBatch(
                    {index: part}, cell[own], total, number, self.intermediate.relaxations[0], chosen
                )
                self.backward.descend(index, index, batch, bounds, None)
                better = bounds.lower > best.lower[own]
                best.lower[own[better]], best.plane[own[better]] = bounds.lower[better], bounds.plane[better]
                slopes, forces = self._derivatives(k, chosen, bounds, units)
                ascent.climb(slopes, forces, {at: self._size(chosen, at) for at in held})
            else:
                loosest[own] = self._loosest(chosen, units, len(own))
        return best, loosest

    def _size(self, chosen: OptimisedSlopes, source: int) -> float:
        """What coefficients of rows on the readers of node ``source`` are about."""
        sizes = [
            float(np.abs(chosen.trace[k]).mean())
            for k, node in enumerate(self.network.nodes, 1)
            if source in node.inputs and k in chosen.trace
        ]
        return max(sizes, default=0.0)

    def _loosest(self, chosen: OptimisedSlopes, units: Mapping[int, UnstableNeurons], count: int) -> Int64:
        """[R, 2] the node and place of the input of the open unit that costs each row most."""
        loosest, most = np.full((count, 2), -1, np.int64), np.full(count, -1.0)
        for k, neurons in units.items():
            if k not in chosen.trace:
                continue
            losses = neurons.losses(chosen.trace[k].reshape(count, -1)[:, neurons.flat])
            at = losses.argmax(1)
            value = losses[np.arange(count), at]
            here = value > most
            most[here] = value[here]
            loosest[here, 0], loosest[here, 1] = self.network.nodes[k - 1].inputs[0], neurons.flat[at[here]]
        return loosest

    def _derivatives(
        self, cell: int, chosen: OptimisedSlopes, found: BackwardBounds, units: Mapping[int, UnstableNeurons]
    ) -> tuple[dict[int, Float64], dict[int, Float64]]:
        """How the bounds of a cell's rows change with slopes and with multipliers."""
        planes, held = self.intermediate.image, self.intermediate.split[cell]
        rows = chosen.trace.get(0)
        if rows is None:
            rows = np.zeros((len(found.lower), *grid(self.network.input_shape)), np.float32)
        p = -np.sign(np.nan_to_num(found.plane[:, 0, :-1]))
        ends = np.einsum("schwd,rd->srchw", planes.slopes[cell], p) + planes.offsets[cell][:, None]
        image = np.where(rows >= 0.0, ends[0], ends[1]).astype(np.float32)
        others: dict[int, Any] = {}
        for k, (one, two) in self.intermediate.relaxations[0].products.items():
            others[k] = functools.partial(_product, torch.from_numpy(one[:, cell]), torch.from_numpy(two[:, cell]))
        for k, maxima in self.intermediate.relaxations[0].maxima.items():
            layer = self.network.nodes[k - 1].layer
            assert isinstance(layer, MaxPool)
            others[k] = functools.partial(maxima.forward, layer, cell)

        def lines(k: int) -> np.ndarray:
            return (
                chosen.lines[k] if k in chosen.lines else self.intermediate.relaxations[0].lines[k][:, cell : cell + 1]
            )

        shaped = torch.from_numpy(image).reshape(-1, *self.network.input_shape)
        return slope_derivatives(self.network, shaped, chosen.trace, lines, units, others, held)


def _product(one: Tensor, two: Tensor, rows: Tensor, inputs: list[Tensor]) -> Tensor:
    """The planes that ``rows`` take of a product's factors."""
    x, y = (v.reshape(rows.shape) for v in inputs)
    offset = torch.where(rows >= 0.0, one[1] + two[1], one[4] + two[4])
    return one[0] * x + two[0] * y + offset


def _windows(rows: np.ndarray) -> list[tuple[int, int, int, int, Int64]]:
    """Windows (top, left, height, width) of rows [k, C, H, W] that are zero elsewhere, and which rows they hold."""
    used = (rows != 0.0).any(axis=1)
    groups: dict[tuple[int, int, int, int], list[int]] = {}
    for k, mask in enumerate(used):
        ys, xs = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        window = (ys[0], xs[0], ys[-1] - ys[0] + 1, xs[-1] - xs[0] + 1) if len(ys) else (0, 0, 1, 1)
        groups.setdefault(tuple(map(int, window)), []).append(k)  # type: ignore[arg-type]
    return [(*window, np.array(number)) for window, number in groups.items()]
