"""Scene margins of certificates and loops (docs/design.md, V13)."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ns_abstract.execution.ending import Deadline
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.verify.scene_margin import Certified, Kind, SceneMargin, Settle, Settled, widest
from ns_abstract.verify.store import Store

#: Part of the time that is kept for margins where they are asked for.
SHARE = 0.5
#: What the key ``scene_margin`` of report.json holds where there is nothing to tell.
NOT_ASKED = "not asked for (--scene-margin)"


class Margins:
    """Finds the scene margins of a search's certified cells, kind by kind.

    Args:
        cells: What is certified.
        settle: Bounds and attacks cells for scenes of a kind.
        store: Keeps what is settled, for a command that goes on; what it holds is not settled again.
        told: Told every margin as it is found.
    """

    def __init__(
        self,
        cells: Sequence[Certified],
        settle: Callable[[Kind], Settle],
        store: Store,
        told: Callable[[SceneMargin], object] = lambda found: None,
    ) -> None:
        self.cells, self._settle, self._store, self._told = cells, settle, store, told
        self.found: list[SceneMargin] = []

    def find(self, deadline: Deadline, kinds: Sequence[Kind]) -> None:
        """Look for them; every kind has the same part of the time that is left then.

        Args:
            deadline: When to end.
            kinds: What varies.
        """
        for number, kind in enumerate(kinds if self.cells else ()):
            part = deadline.within(deadline.left / (len(kinds) - number))
            self.found.append(widest(kind, self.cells, self._remembered(kind), part))
            self._told(self.found[-1])

    def _remembered(self, kind: Kind) -> Settle:
        """Settles what the store does not hold yet."""
        settle = self._settle(kind)

        def remembered(radius: float, frame: int, box: ParameterBox) -> Settled:
            found = self._store.settled(kind.name, radius, frame, box)
            if found is None:
                found = settle(radius, frame, box)
                self._store.keep_settled(kind.name, radius, frame, box, found)
            return found

        return remembered

    def keep(self) -> None:
        """Store the scenes that break what is certified."""
        for found in self.found:
            if found.example is not None:
                buffer = io.BytesIO()
                arrays: dict[str, Any] = dict(found.example)
                np.savez(buffer, **arrays)
                self._store.keep_image(f"scene_margin_{found.kind.name}", buffer.getvalue())

    @property
    def entry(self) -> dict[str, Any]:
        """What report.json holds."""
        skipped = None if self.cells else "nothing is certified"
        return {"skipped": skipped, "kinds": [found.entry for found in self.found]}


def certified_cells(
    rows: Mapping[int, Sequence[Mapping[str, Any]]], boxes: Callable[[int, Mapping[str, Any]], ParameterBox]
) -> list[Certified]:
    """The certified cells of a store, with their parts of the volume.

    Args:
        rows: By frame, rows of ``cells``.
        boxes: The box of a row.
    """
    found = [(frame, row, boxes(frame, row)) for frame, entries in rows.items() for row in entries]
    found = [entry for entry in found if entry[1]["verdict"] == "certified"]
    sizes = [float(np.prod(np.subtract(box.upper, box.lower))) for _, _, box in found]
    return [
        Certified(frame, box, row["margin"], size / sum(sizes))
        for (frame, row, box), size in zip(found, sizes, strict=True)
    ]
