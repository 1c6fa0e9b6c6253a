"""Bounds of linear functions of the outputs, with optimised slopes and multipliers (docs/dev/design.md, N14)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ns_abstract.arithmetic.network_charges import DOUBLE_UNIT, OWN_LINE
from ns_abstract.verify.network.backward import ROWS_AT_ONCE, BackwardPass
from ns_abstract.verify.network.coefficients import Coefficients, Float64, Floats, Int64, grid
from ns_abstract.verify.network.forms import NodeForm
from ns_abstract.verify.network.image_sets import OutputBounds
from ns_abstract.verify.network.intermediate_bounds import IntermediateBounds
from ns_abstract.verify.network.row_ascent import RowAscent


class ShiftedRows(NamedTuple):
    """Rows on the outputs' distances from their reference.

    Attributes:
        stored: [k, n] in the rows' type.
        missing, offset: [m, k] errors of numbers that the stored rows round, and the offset.
    """

    stored: Floats
    missing: Float64
    offset: Float64

    def room(self, plane: Float64) -> Float64:
        """Return the charge [m, k] for sums of ``plane`` [m, k, d + 1] and the offset."""
        return OWN_LINE * (np.abs(plane).sum(-1) + np.abs(self.offset) + self.missing) + self.missing


class OutputRows:
    """Bounds linear functions of the outputs once all intermediate bounds are computed."""

    def __init__(self, intermediate: IntermediateBounds, backward: BackwardPass, ascent: RowAscent) -> None:
        self.intermediate, self.network, self.backward = intermediate, intermediate.network, backward
        self.ascent = ascent

    def shifted(self, last: NodeForm, rows: Any, offset: Float64) -> ShiftedRows:
        """Return ``rows @ y + offset`` [k] or [m, k] as rows on the distance from the reference of ``last``."""
        dense = np.asarray(rows.toarray() if hasattr(rows, "toarray") else rows, np.float64)
        stored = dense.astype(self.intermediate.relaxations[-1].number)
        size = last.width.reshape(self.intermediate.count, -1).numpy()
        reference = last.reference.reshape(self.intermediate.count, -1).numpy()
        missing = size @ np.abs(dense - stored).T
        missing += 2.0 * DOUBLE_UNIT * (dense.shape[1] + 2) * (np.abs(reference) @ np.abs(dense).T)
        return ShiftedRows(stored, missing, reference @ dense.T + offset)

    def bound(self, last: NodeForm, rows: Any, offset: Float64) -> OutputBounds:
        """Return bounds of ``rows @ y + offset`` in every cell, with y enclosed by ``last``."""
        index = len(self.network.nodes)
        m, k = self.intermediate.count, offset.shape[-1]
        plane, lower = np.zeros((m, k, self.intermediate.d + 1)), np.zeros((m, k))
        shape = grid(self.network.shape(index))
        shifted = self.shifted(last, rows, offset)
        stored, offset = shifted.stored, shifted.offset
        for top, left, height, width, number in windows(stored.reshape(k, *shape)):
            part = stored.reshape(k, *shape)[:, :, top : top + height, left : left + width]
            step = max(1, ROWS_AT_ONCE // (stored.itemsize * shape[0] * height * width))
            for first in range(0, m * len(number), step):
                which = np.arange(first, min(m * len(number), first + step))
                cell, row = which // len(number), number[which % len(number)]
                rows = Coefficients(
                    np.ascontiguousarray(part[row]), np.full(len(which), top), np.full(len(which), left)
                )
                bounds = self.backward.bound(index, rows.replaced(rows.value.copy()), cell)
                if self.ascent.steps:
                    self.ascent.climb(index, rows, cell, bounds)
                plane[cell, row], lower[cell, row] = bounds.plane[:, 0], bounds.lower
        room = shifted.room(plane)
        lower, b = lower + offset - room, plane[..., -1] + offset - room
        a = plane[..., :-1]
        finite = self.intermediate.usable[:, None] & np.isfinite(lower)
        usable = self.intermediate.usable[:, None] & np.isfinite(b) & np.isfinite(a).all(-1)
        lower = np.where(finite, lower, -np.inf)
        return OutputBounds(lower, np.where(usable[..., None], a, 0.0), np.where(usable, b, -np.inf))


def windows(rows: np.ndarray) -> list[tuple[int, int, int, int, Int64]]:
    """Return windows (top, left, height, width) outside of which rows [k, C, H, W] are zero, with their rows."""
    used = (rows != 0.0).any(axis=1)
    groups: dict[tuple[int, int, int, int], list[int]] = {}
    for k, mask in enumerate(used):
        ys, xs = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        window = (ys[0], xs[0], ys[-1] - ys[0] + 1, xs[-1] - xs[0] + 1) if len(ys) else (0, 0, 1, 1)
        groups.setdefault(tuple(map(int, window)), []).append(k)  # type: ignore[arg-type]
    return [(*window, np.array(number)) for window, number in groups.items()]
