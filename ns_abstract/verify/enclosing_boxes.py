"""Boxes around cells that depend on the cell and its set alone, so that what is known of them serves many cells."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ns_abstract.geometry.box import ParameterBox


@dataclass(frozen=True)
class EnclosingTuning:
    """How much wider enclosing boxes are. None of it decides whether a bound holds."""

    #: An enclosing box is at least this power of two wider than the cell, along every parameter.
    halvings: int = 1
    #: Most pixels that the picture moves by over an enclosing box; bounds of wider ones say too little.
    motion: float = 8.0
    #: Halvings of the set that cells are told apart by, and parts of a box that ends of cells may miss a line of the
    #: grid by, as they are rounded; and parts of a box that it reaches beyond its lines, so that these ends lie inside.
    spare: float = 1e-6
    beyond: float = 1e-9


_TUNING = EnclosingTuning()


def enclosing_box(cell: ParameterBox, whole: ParameterBox, motion: np.ndarray) -> ParameterBox | None:
    """Return a box of ``whole`` around a cell of it, about two to eight times wider along each parameter.

    Its ends lie on a dyadic grid of ``whole``, so that neighbouring cells of about the same widths share it (Q5). None:
    it would be too wide to be of use.

    Args:
        cell: A box inside of ``whole``.
        motion: [d] pixels that the picture moves by over each parameter's range.
    """
    box, moved = cell, 0.0
    for axis in range(whole.dimensions):
        low, high = whole.lower[axis], whole.upper[axis]
        width, own = high - low, cell.upper[axis] - cell.lower[axis]
        level = math.floor(math.log2(width / own) + _TUNING.spare) if own > 0.0 else 0
        parts = 1 << max(0, level - _TUNING.halvings)
        if parts == 1:
            first, past = 0, 1
        else:
            first = math.floor((cell.lower[axis] - low) / width * parts + _TUNING.spare)
            past = math.ceil((cell.upper[axis] - low) / width * parts - _TUNING.spare)
        moved = math.hypot(moved, float(motion[axis]) * (past - first) / parts)
        lower = low + width * ((first - _TUNING.beyond) / parts)
        upper = low + width * ((past + _TUNING.beyond) / parts)
        # the cell lies inside, whatever was rounded
        box = box.replace(axis, max(low, min(lower, cell.lower[axis])), min(high, max(upper, cell.upper[axis])))
    return box if moved <= _TUNING.motion and box != cell else None
