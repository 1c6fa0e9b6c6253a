"""Bounds of linear functions of the outputs, with optimised slopes and multipliers (docs/design.md, N14, N16)."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import DOUBLE_UNIT, OWN_LINE
from ns_abstract.verify.network.backward import ROWS_AT_ONCE, Backward, Batch
from ns_abstract.verify.network.forms import Form
from ns_abstract.verify.network.known import Known
from ns_abstract.verify.network.maxima import MaxPool
from ns_abstract.verify.network.reached import Reached
from ns_abstract.verify.network.rows import Float64, Int64, Rows, grid
from ns_abstract.verify.network.sets import OutputBounds
from ns_abstract.verify.network.slopes import Ascent, Chosen, OpenUnits, derivatives

#: Room for rounding above zero where nothing better is looked for.
_SURE = 1e-9


class Outputs:
    """Bounds linear functions of the outputs once all intermediate bounds are there.

    Args:
        known: What is known of the nodes.
        backward: Passes rows back over it.
        slope_steps: As in `ns_abstract.verify.network.bound_outputs`.
    """

    def __init__(self, known: Known, backward: Backward, slope_steps: int) -> None:
        self.known, self.network, self.backward = known, known.network, backward
        self.slope_steps = slope_steps

    def bound(self, last: Form, rows: Any, offset: Float64) -> OutputBounds:
        """Bounds of ``rows @ y + offset`` in every cell, y as ``last`` says."""
        index = len(self.network.nodes)
        m, k = self.known.count, len(offset)
        plane, lower = np.zeros((m, k, self.known.d + 1)), np.zeros((m, k))
        loosest = np.zeros((m, k, 2), np.int64)
        shape = grid(self.network.shape(index))
        dense = np.asarray(rows.toarray() if hasattr(rows, "toarray") else rows, np.float64)
        stored = dense.astype(self.known.passages[-1].number)
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
                rows = Rows(np.ascontiguousarray(part[row]), np.full(len(which), top), np.full(len(which), left))
                found, loosest[cell, row] = self._climb(index, rows, cell, need[cell, row])
                plane[cell, row], lower[cell, row] = found.plane[:, 0], found.lower
        room = OWN_LINE * (np.abs(plane).sum(-1) + np.abs(offset) + missing) + missing
        lower, b = lower + offset - room, plane[..., -1] + offset - room
        a = plane[..., :-1]
        finite = self.known.good[:, None] & np.isfinite(lower)
        usable = self.known.good[:, None] & np.isfinite(b) & np.isfinite(a).all(-1)
        lower = np.where(self.known.vacant[:, None], np.inf, np.where(finite, lower, -np.inf))
        return OutputBounds(lower, np.where(usable[..., None], a, 0.0), np.where(usable, b, -np.inf), loosest)

    def _climb(self, index: int, rows: Rows, cell: Int64, need: Float64) -> tuple[Reached, Int64]:
        """Bounds below of rows on node ``index``, with the best slopes and multipliers that were tried (N14, N16).

        Where signs are assumed, a cell whose rows are above ``need`` [R] is done. Also returns `OutputBounds.loosest`
        of the rows.
        """
        loosest = np.full((len(cell), 2), -1, np.int64)
        if not self.slope_steps:
            return self.backward.bound(index, rows, cell), loosest
        # slopes are chosen in float32
        start = Rows(rows.value.astype(np.float32), rows.y, rows.x)
        best, lines = self.backward.bound(index, rows, cell), self.known.passages[0].lines
        for k in np.unique(cell):
            units = {at: opened.of(k) for at, opened in self.known.open.items()}
            units = {at: opened for at, opened in units.items() if len(opened.flat)}
            own, held = np.flatnonzero(cell == k), self.known.held[k]
            if not (units or held) or not self.known.good[k]:
                continue
            first = {at: lines[at][0, k].reshape(-1)[opened.flat] for at, opened in units.items()}
            ascent = Ascent(units, first, len(own), held)
            for _ in range(self.slope_steps + 1):
                if self.known.assumed is not None and bool((best.lower[own] > need[own]).all()):
                    break
                chosen = ascent.lines(lines, k)
                found = Reached.unknown(len(own), self.known.d)
                # rows are changed in place
                part = Rows(start.value[own], start.y[own], start.x[own])
                total, number = np.zeros((len(own), 2)), np.arange(len(own))
                batch = Batch({index: part}, cell[own], total, number, self.known.passages[0], chosen)
                self.backward.descend(index, index, batch, found, None)
                better = found.lower > best.lower[own]
                best.lower[own[better]], best.plane[own[better]] = found.lower[better], found.plane[better]
                slopes, forces = self._derivatives(k, chosen, found, units)
                ascent.climb(slopes, forces, {at: self._size(chosen, at) for at in held})
            else:
                loosest[own] = self._loosest(chosen, units, len(own))
        return best, loosest

    def _size(self, chosen: Chosen, source: int) -> float:
        """What coefficients of rows on the readers of node ``source`` are about."""
        found = [
            float(np.abs(chosen.trace[k]).mean())
            for k, node in enumerate(self.network.nodes, 1)
            if source in node.inputs and k in chosen.trace
        ]
        return max(found, default=0.0)

    def _loosest(self, chosen: Chosen, units: Mapping[int, OpenUnits], count: int) -> Int64:
        """[R, 2] the node and place of the input of the open unit that costs each row most."""
        found, most = np.full((count, 2), -1, np.int64), np.full(count, -1.0)
        for k, opened in units.items():
            if k not in chosen.trace:
                continue
            losses = opened.losses(chosen.trace[k].reshape(count, -1)[:, opened.flat])
            at = losses.argmax(1)
            value = losses[np.arange(count), at]
            here = value > most
            most[here] = value[here]
            found[here, 0], found[here, 1] = self.network.nodes[k - 1].inputs[0], opened.flat[at[here]]
        return found

    def _derivatives(
        self, cell: int, chosen: Chosen, found: Reached, units: Mapping[int, OpenUnits]
    ) -> tuple[dict[int, Float64], dict[int, Float64]]:
        """How the bounds of a cell's rows change with slopes and with multipliers."""
        planes, held = self.known.image, self.known.held[cell]
        rows = chosen.trace.get(0)
        if rows is None:
            rows = np.zeros((len(found.lower), *grid(self.network.input_shape)), np.float32)
        p = -np.sign(np.nan_to_num(found.plane[:, 0, :-1]))
        ends = np.einsum("schwd,rd->srchw", planes.slopes[cell], p) + planes.offsets[cell][:, None]
        image = np.where(rows >= 0.0, ends[0], ends[1]).astype(np.float32)
        others: dict[int, Any] = {}
        for k, (one, two) in self.known.passages[0].products.items():
            others[k] = functools.partial(_product, torch.from_numpy(one[:, cell]), torch.from_numpy(two[:, cell]))
        for k, maxima in self.known.passages[0].maxima.items():
            layer = self.network.nodes[k - 1].layer
            assert isinstance(layer, MaxPool)
            others[k] = functools.partial(maxima.forward, layer, cell)

        def lines(k: int) -> np.ndarray:
            return chosen.lines[k] if k in chosen.lines else self.known.passages[0].lines[k][:, cell : cell + 1]

        shaped = torch.from_numpy(image).reshape(-1, *self.network.input_shape)
        return derivatives(self.network, shaped, chosen.trace, lines, units, others, held)


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
