"""Parts of a cell that are proved where the whole is not (docs/dev/design.md, Q8)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ns_abstract.arithmetic.rounding import SUB_BOX_OVERLAP
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.verify.cell_boxes import divided, meeting, resolved, sub_box_counts
from ns_abstract.verify.cells import Cell
from ns_abstract.verify.network import ImageSets
from ns_abstract.verify.properties import Claim, Query
from ns_abstract.verify.protocol import PartsModel


@dataclass(frozen=True)
class PartTuning:
    """How cells are divided. None of it decides whether a bound holds."""

    #: Most equal parts of a cell, and the part of a box that has to be left for it to become one cell.
    parts: int = 64
    filled: float = 0.75


_TUNING = PartTuning()


@dataclass(frozen=True)
class CellPart:
    """A part of a cell, in whole units.

    Attributes:
        margin: Proven lower bound of the margin; None: it is to be examined.
    """

    cell: Cell
    margin: float | None


def partly_proved(
    claim: Claim, model: PartsModel, query: Query, images: ImageSets, cell: Cell, box: ParameterBox
) -> list[CellPart]:
    """Return parts that tile a cell, by whether its linear sets prove them (Q8); empty if they prove none."""
    counts = sub_box_counts(cell, model.part_counts(images, _TUNING.parts))
    if not resolved(box, counts):
        return []
    bounds = model.bound_parts(images, counts, SUB_BOX_OVERLAP)
    margins = np.asarray(claim.proved(query, bounds, [box] * int(counts.prod())), np.float64).reshape(counts)
    parts = list(_tiled(cell, margins, np.isfinite(margins) & (margins > 0.0)))
    return parts if any(part.margin is not None for part in parts) else []


def _tiled(cell: Cell, margins: np.ndarray, proved: np.ndarray) -> Iterator[CellPart]:
    """Parts that tile a cell, none larger than a half along each parameter that is divided."""
    units = [(b - a) // n for a, b, n in zip(cell.first, cell.past, proved.shape, strict=True)]
    halves = [[(0, n)] if n == 1 else [(0, n // 2), (n // 2, n)] for n in proved.shape]
    for spans in itertools.product(*halves):
        ends = [[a + unit * span[k] for a, unit, span in zip(cell.first, units, spans, strict=True)] for k in (0, 1)]
        half, within = Cell(tuple(ends[0]), tuple(ends[1])), tuple(slice(*span) for span in spans)
        for part, open_ in divided(half, ~proved[within], _TUNING.filled):
            margin = None if open_ else float(margins[meeting(cell, np.array(proved.shape), part)].min())
            yield CellPart(part, margin)
