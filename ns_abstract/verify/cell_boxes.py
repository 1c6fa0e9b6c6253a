"""Boxes of whole grid units inside a cell: excluded slabs, and remaining sub-boxes (docs/dev/design.md, U3, U5)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ns_abstract.arithmetic.rounding import CUT_VALUE_ROUNDING, HALF_UP, SUB_BOX_LINE_ROUNDING, SUB_BOX_LINES
from ns_abstract.geometry.box import Float64Array, ParameterBox
from ns_abstract.verify.cells import Cell, CellGrid


def inner_cell(grid: CellGrid, cell: Cell, box: ParameterBox) -> Cell:
    """Return the smallest part of a cell, in whole units, that contains the intersection with ``box`` (U3)."""
    first, past = list(cell.first), list(cell.past)
    for k in range(grid.box.dimensions):
        low, high = grid.box.lower[k], grid.box.upper[k]
        scale = grid.units[k] / (high - low)
        a = min(max(int((box.lower[k] - low) * scale), first[k]), past[k] - 1)
        # the ends themselves are compared, whatever the product was rounded to
        while a > first[k] and grid.end(k, a) > box.lower[k]:
            a -= 1
        b = max(min(int((box.upper[k] - low) * scale) + 1, past[k]), a + 1)
        while b < past[k] and grid.end(k, b) < box.upper[k]:
            b += 1
        first[k], past[k] = a, b
    return Cell(tuple(first), tuple(past))


def slabs(cell: Cell, inner: Cell) -> Iterator[Cell]:
    """Yield cells that tile ``cell`` without ``inner``."""
    for k in range(len(cell.first)):
        if cell.first[k] < inner.first[k]:
            yield replace(cell, past=(*cell.past[:k], inner.first[k], *cell.past[k + 1 :]))
        if inner.past[k] < cell.past[k]:
            yield replace(cell, first=(*cell.first[:k], inner.past[k], *cell.first[k + 1 :]))
        first = (*cell.first[:k], inner.first[k], *cell.first[k + 1 :])
        cell = Cell(first, (*cell.past[:k], inner.past[k], *cell.past[k + 1 :]))


def aligned(cell: Cell, inner: Cell, bits: int) -> Cell:
    """Return ``inner`` grown within ``cell`` to multiples of 2^bits grid units, so that it can be halved."""
    first, past = list(inner.first), list(inner.past)
    for k, (a, b) in enumerate(zip(cell.first, cell.past, strict=True)):
        step = 1 << max(0, (b - a).bit_length() - bits)
        first[k], past[k] = max(a, first[k] // step * step), min(b, -(-past[k] // step) * step)
    return Cell(tuple(first), tuple(past))


def sub_box_counts(cell: Cell, most: np.ndarray) -> np.ndarray:
    """Return numbers [d] of sub-boxes along a cell's axes: powers of two that divide its units, up to ``most`` [d]."""
    sizes = np.array(cell.past, np.int64) - np.array(cell.first, np.int64)
    # the largest power of two that divides
    return np.minimum(sizes & -sizes, most)


def meeting(cell: Cell, counts: np.ndarray, part: Cell) -> np.ndarray:
    """Return [counts] which sub-boxes of a cell, whose units ``counts`` divide, meet its ``part`` (U9)."""
    chosen = np.zeros(counts, bool)
    spans = []
    for first, past, n, a, b in zip(cell.first, cell.past, counts.tolist(), part.first, part.past, strict=True):
        unit = (past - first) // n
        spans.append(slice((a - first) // unit, -((first - b) // unit)))
    chosen[tuple(spans)] = True
    return chosen


def resolved(box: ParameterBox, counts: np.ndarray) -> bool:
    """Return whether the overlap of a cell's sub-boxes exceeds the rounding of grid lines (B12, U5)."""
    low, high = np.array(box.lower), np.array(box.upper)
    rounding = SUB_BOX_LINE_ROUNDING * (np.abs(low) + np.abs(high))
    return bool(counts.prod() >= 8 and (rounding <= SUB_BOX_LINES * 0.5 * (high - low)).all())


def divided(cell: Cell, left: np.ndarray, filled: float) -> Iterator[tuple[Cell, bool]]:
    """Yield cells that tile ``cell``, each with whether some of its sub-boxes remain (U5).

    ``left`` [counts]: which of its equal sub-boxes remain; counts divide the cell's units. ``filled``: the fraction of
    a box that must remain for it to become one cell.
    """
    if not left.any():
        yield cell, False
        return
    units = [(b - a) // n for a, b, n in zip(cell.first, cell.past, left.shape, strict=True)]
    places = np.argwhere(left)
    spans = list(zip(places.min(axis=0).tolist(), (places.max(axis=0) + 1).tolist(), strict=True))
    inner = Cell(
        tuple(a + unit * start for a, unit, (start, _) in zip(cell.first, units, spans, strict=True)),
        tuple(a + unit * stop for a, unit, (_, stop) in zip(cell.first, units, spans, strict=True)),
    )
    yield from ((slab, False) for slab in slabs(cell, inner))
    part = left[tuple(slice(*span) for span in spans)]
    if part.mean() >= filled:
        yield inner, True
        return
    axis = int(np.argmax(part.shape))
    half = part.shape[axis] // 2
    line = inner.first[axis] + units[axis] * half
    before, behind = np.split(part, [half], axis=axis)
    yield from divided(replace(inner, past=(*inner.past[:axis], line, *inner.past[axis + 1 :])), before, filled)
    yield from divided(replace(inner, first=(*inner.first[:axis], line, *inner.first[axis + 1 :])), behind, filled)


def between(box: ParameterBox, least: Float64Array, most: Float64Array) -> ParameterBox:
    """Return the part of a box whose scaled parameters lie in [least, most], rounded outward (U3)."""
    for k in range(box.dimensions):
        low, high = box.lower[k], box.upper[k]
        middle = 0.5 * (low + high)
        half = max(high - middle, middle - low) * HALF_UP
        room = CUT_VALUE_ROUNDING * (abs(low) + abs(high))
        first = low if least[k] <= -1.0 else max(low, middle + half * float(least[k]) - room)
        last = high if most[k] >= 1.0 else min(high, middle + half * float(most[k]) + room)
        # a cut at an end leaves that end
        first, last = min(first, high), max(last, low)
        box = box.replace(k, first, last)
    return box
