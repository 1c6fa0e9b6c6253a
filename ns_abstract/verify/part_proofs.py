"""Decides parts of a cell where the whole cell is not decided (docs/dev/design.md, Q8)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.errors import InputError
from ns_abstract.verify.cell_boxes import divided, meeting, resolved, sub_box_counts
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.network import ImageSets
from ns_abstract.verify.picture_measures import SubBoxEnds
from ns_abstract.verify.picture_sets import sane
from ns_abstract.verify.properties import Claim, Query
from ns_abstract.verify.protocol import DividedImages, FrameImages, PartsModel, PixelSets
from ns_abstract.verify.search_results import FAILURES


@dataclass(frozen=True)
class PartTuning:
    """Preferences on how cells are divided; soundness does not depend on them."""

    #: Most equal parts of a cell, and the part of a box that has to be left for it to become one cell.
    parts: int = 64
    filled: float = 0.75


_TUNING = PartTuning()


@dataclass(frozen=True)
class CellPart:
    """A part of a cell, in whole units.

    Attributes:
        verdict: "certified": the property holds at every pose; "falsified": at none; None: it has to be examined.
        margin: Proved lower bound of the margin of a certified part, proved upper bound of a falsified one's.
    """

    cell: Cell
    verdict: Literal["certified", "falsified"] | None
    margin: float = math.nan


@dataclass(frozen=True)
class PartQuestion:
    """The property to decide for parts of cells.

    Attributes:
        claim: The claim to be proved.
        model: Bounds the claim's outputs.
        query: The claim's rows.
        refute: Whether to search for parts in which the property fails everywhere, too.
    """

    claim: Claim
    model: PartsModel
    query: Query
    refute: bool = True

    def parts(
        self, images: ImageSets, cell: Cell, box: ParameterBox, halves: bool = True, ends: SubBoxEnds | None = None
    ) -> list[CellPart]:
        """Return parts that tile a cell, decided by its linear sets ``images`` (Q8); empty if none is decided.

        ``box``: the cell's parameters. ``halves``: whether halves are refuted, too, not only the whole cell. ``ends``:
        the sub-box bounds that `divided_sets` returns.
        """
        counts = sub_box_counts(cell, self.model.part_counts(images, _TUNING.parts)) if ends is None else ends.counts
        if not resolved(box, counts):
            return []
        bounds, boxes = self.model.bound_parts(images, counts, ends), [box] * int(counts.prod())
        low, high = (
            np.asarray(margins, np.float64).reshape(counts)
            for margins in (self.claim.proved(self.query, bounds, boxes), self.claim.refuted(self.query, bounds, boxes))
        )
        decided = np.isfinite(low) & (low > 0.0), np.isfinite(high) & (high <= 0.0) & self.refute
        if decided[1].all():
            return [CellPart(cell, "falsified", float(high.max()))]
        decided = decided[0], decided[1] & halves
        return list(_tiled(cell, (low, high), decided)) if np.any(decided) else []

    def bounded(self, scene: FrameImages, grid: CellGrid, cell: Cell) -> list[CellPart]:
        """Return `parts` by sets over the cell itself (Q8); its halves where none is decided; empty without sets.

        A part is bounded without rendering: examining a cell takes several times as long as its sets. Small parts are
        not refuted, as each would cost a render.
        """
        check_cancelled()
        box = grid.box_of(cell)
        try:
            (linear, lower, upper, slopes), ends = divided_sets(scene, cell, box)
        except InputError:
            raise
        except FAILURES:
            # the same happens to it as a cell, with a reason
            return []
        if not sane(linear, lower, upper):
            return []
        images = self.model.input_sets(tuple(side[None] for side in linear), lower[None], upper[None])
        return self.parts(images, cell, box, halves=False, ends=ends) or [
            CellPart(half, None) for half in grid.divide(cell, slopes, 0.5, 2)
        ]


def narrowed(scene: FrameImages, cell: Cell, part: Cell, ends: SubBoxEnds | None) -> FrameImages:
    """Return the pictures of a ``part`` of a cell, with bounds narrowed by ``ends`` of the cell's sub-boxes (Q9)."""
    if ends is None or not isinstance(scene, DividedImages):
        return scene
    return scene.narrowed(ends, meeting(cell, ends.counts, part))


def divided_sets(scene: FrameImages, cell: Cell, box: ParameterBox) -> tuple[PixelSets, SubBoxEnds | None]:
    """Return sets of a cell with parameters ``box``, and bounds over its sub-boxes of whole units, or None (Q8)."""
    if isinstance(scene, DividedImages):
        most = scene.sub_box_counts(box, _TUNING.parts)
        if most is not None and resolved(box, counts := sub_box_counts(cell, most)):
            return scene.divided_sets(box, counts)
    return scene.linear_sets(box), None


def _tiled(
    cell: Cell, margins: tuple[np.ndarray, np.ndarray], decided: tuple[np.ndarray, np.ndarray]
) -> Iterator[CellPart]:
    """Yield parts that tile a cell, at most half of it along each divided parameter.

    ``margins`` and ``decided`` [counts]: lower and upper bounds by equal part, and which of them prove something.
    Falsified parts cost a render each, so open parts are not cut for their sake.
    """
    proved, refuted = decided
    counts = np.array(proved.shape)
    units = [(b - a) // n for a, b, n in zip(cell.first, cell.past, proved.shape, strict=True)]
    halves = [[(0, n)] if n == 1 else [(0, n // 2), (n // 2, n)] for n in proved.shape]
    for spans in itertools.product(*halves):
        ends = [[a + unit * span[k] for a, unit, span in zip(cell.first, units, spans, strict=True)] for k in (0, 1)]
        half, within = Cell(tuple(ends[0]), tuple(ends[1])), tuple(slice(*span) for span in spans)
        for part, open_ in divided(half, ~proved[within], _TUNING.filled):
            equal = meeting(cell, counts, part)
            if not open_:
                yield CellPart(part, "certified", float(margins[0][equal].min()))
            elif refuted[equal].all():
                yield CellPart(part, "falsified", float(margins[1][equal].max()))
            else:
                yield CellPart(part, None)
