"""The store ``cells.sqlite`` of a search for poses (docs/dev/design.md, U4).

While the search runs, its cells count parameters as the frame that is searched does; the table ``cells`` is written at
its end, in the set's own parameters.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping

import numpy as np

from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.location_cover import PoseCover
from ns_abstract.verify.moved_pictures import FoundPose
from ns_abstract.verify.search_results import BlockResult, FinishedCell
from ns_abstract.verify.store import CellBlock, Store

#: Poses that explain the photo which are kept, by frame.
_POSES = 500
_CELL, _POSE = "location cell", "location pose"


class LocationStore(Store):
    """A `Store` of cells of sheared parameters.

    Attributes:
        cover: Makes cells in a frame's own parameters from the possible cells; set before `finish`.
    """

    cover: Callable[[int], PoseCover]
    allowed: int = 0

    def _add(self, frame: int, leaf: FinishedCell, grid: CellGrid) -> None:
        # what is excluded is known by what is left
        if leaf.verdict != "certified":
            ends = json.dumps(leaf.cell.first), json.dumps(leaf.cell.past)
            row = _CELL, 0.0, int(frame), *ends, leaf.verdict, leaf.reason, "[]"
            self._insert("search_settled", row, self._seals.settled)

    def close_block(self, block: CellBlock, findings: BlockResult, grid: CellGrid) -> bool:
        best: FoundPose | None = getattr(findings, "best", None)
        if not super().close_block(block, findings, grid):
            return False
        if best is not None:
            stored = self.poses(block.frame)
            better = not stored or best.outliers < stored[0].outliers
            if better or (best.outliers <= self.allowed and len(stored) < _POSES and best not in stored):
                with self._transaction():
                    ends = json.dumps(best.values), "[]"
                    row = _POSE, float(best.outliers), int(block.frame), *ends, "", "", "[]"
                    self._insert("search_settled", row, self._seals.settled)
        return True

    def poses(self, frame: int) -> list[FoundPose]:
        """Return rendered poses of a frame, the best first, in the order of its parameters."""
        query = "SELECT radius, lower FROM search_settled WHERE kind = ? AND frame = ? ORDER BY radius, rowid"
        return [
            FoundPose(tuple(json.loads(values)), int(outliers))
            for outliers, values in self._base.execute(query, (_POSE, int(frame)))
        ]

    def left(self, frame: int) -> list[Cell]:
        """Return the cells of the search that are not excluded."""
        rows = self._base.execute(
            "SELECT lower, upper FROM search_settled WHERE kind = ? AND frame = ?", (_CELL, int(frame))
        ).fetchall()
        cells = [Cell(tuple(json.loads(first)), tuple(json.loads(past))) for first, past in rows]
        return cells + [cell for block in self._listed("ORDER BY id") if block.frame == frame for cell in block.cells]

    def finish(self, grids: Mapping[int, CellGrid]) -> None:
        """Write the table ``cells``; `Store` reverts that on resuming."""
        covers = {frame: self.cover(frame) for frame in grids}
        with self._transaction():
            rows = []
            for frame, cover in covers.items():
                box = cover.grid.box
                poses = [pose for pose in self.poses(frame) if pose.outliers <= self.allowed]
                for cells, excluded in ((cover.left, False), (cover.excluded, True)):
                    for cell in cells:
                        part = cover.grid.box_of(cell)
                        pose = None if excluded else next((p for p in poses if part.contains(np.array(p.values))), None)
                        verdict = "excluded" if excluded else "unknown" if pose is None else "possible"
                        row = (
                            frame,
                            *(self._list(frame, box, ends) for ends in (part.lower, part.upper)),
                            verdict,
                            None if pose is None else float(pose.outliers - self.allowed),
                            0.0,
                            None if pose is None else self._list(frame, box, pose.values),
                        )
                        rows.append(self._insert("cells", row, None))
            self._put("open_rows", rows)
            self._put("seconds", self.seconds)
