"""Scene margins of certificates and loops (docs/dev/design.md, V13)."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ns_abstract.execution.cancellation import Deadline
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.verify.scene_margin import (
    CellOutcome,
    CertifiedBox,
    ProveCell,
    SceneMargin,
    VariationKind,
    largest_radius,
)
from ns_abstract.verify.store import Store

#: Part of the time that is kept for margins where they are asked for.
SHARE = 0.5
#: What the key ``scene_margin`` of report.json holds where there is nothing to tell.
NOT_ASKED = "not asked for (--scene-margin)"


class Margins:
    """Finds the scene margins of a search's certified cells, kind by kind.

    Args:
        prover: Bounds and attacks cells for scenes of a kind.
        store: Keeps what is settled, for a command that goes on; what it holds is not settled again.
    """

    def __init__(
        self,
        cells: Sequence[CertifiedBox],
        prover: Callable[[VariationKind], ProveCell],
        store: Store,
        on_progress: Callable[[SceneMargin], object] = lambda margin: None,
    ) -> None:
        self.cells, self._prover, self._store, self._told = cells, prover, store, on_progress
        self.results: list[SceneMargin] = []

    def find(self, deadline: Deadline, kinds: Sequence[VariationKind]) -> None:
        """Find the margins; the remaining time is divided equally among the remaining kinds."""
        for number, kind in enumerate(kinds if self.cells else ()):
            part = deadline.within(deadline.left / (len(kinds) - number))
            self.results.append(largest_radius(kind, self.cells, self._remembered(kind), part))
            self._told(self.results[-1])

    def _remembered(self, kind: VariationKind) -> ProveCell:
        """Returns a cell prover for variations of ``kind`` that reads outcomes from the store, and stores new ones."""
        prove = self._prover(kind)

        def remembered(radius: float, frame: int, box: ParameterBox) -> CellOutcome:
            stored = self._store.settled(kind.name, radius, frame, box)
            if stored is None:
                stored = prove(radius, frame, box)
                self._store.keep_settled(kind.name, radius, frame, box, stored)
            return stored

        return remembered

    def keep(self) -> None:
        """Write the files of scenes that falsify a certified cell."""
        for margin in self.results:
            if margin.example is not None:
                buffer = io.BytesIO()
                arrays: dict[str, Any] = dict(margin.example)
                np.savez(buffer, **arrays)
                self._store.keep_image(f"scene_margin_{margin.kind.name}", buffer.getvalue())

    @property
    def entry(self) -> dict[str, Any]:
        """Return the entry `scene_margin` of report.json."""
        skipped = None if self.cells else "nothing is certified"
        return {"skipped": skipped, "kinds": [margin.entry for margin in self.results]}


def certified_cells(
    rows: Mapping[int, Sequence[Mapping[str, Any]]], boxes: Callable[[int, Mapping[str, Any]], ParameterBox]
) -> list[CertifiedBox]:
    """Return the certified cells of a store, with their parts of the volume; ``rows``: by frame, rows of ``cells``."""
    certified = [(frame, row, boxes(frame, row)) for frame, entries in rows.items() for row in entries]
    certified = [entry for entry in certified if entry[1]["verdict"] == "certified"]
    sizes = [float(np.prod(np.subtract(box.upper, box.lower))) for _, _, box in certified]
    return [
        CertifiedBox(frame, box, row["margin"], size / sum(sizes))
        for (frame, row, box), size in zip(certified, sizes, strict=True)
    ]
