"""The store ``cells.sqlite`` of a search's finished cells (docs/dev/design.md, V8).

A block's result is one transaction, which also replaces the block by its children among the open blocks. So a kill
loses at most the blocks under examination, and a result that arrives twice (a retried worker) counts once. Tables
``parameters`` and ``cells`` are for readers; ``search_*`` are internal. Changes by others are detected
(`TableChecksum`), and such a search is not continued.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.scene_margin import CellOutcome
from ns_abstract.verify.search import RANK_FIRST
from ns_abstract.verify.search_results import BlockResult, FinishedCell, Verdict
from ns_abstract.verify.store_file import BLOCK, FRAME, StoreFile, TableChecksum

#: One open block of so many is the one with the largest cells, all others are those nearest to a proof.
_LARGEST_EVERY = 4


@dataclass(frozen=True)
class CellBlock:
    """Cells of one frame that are examined together; ``depth`` is the number of cuts since the initial cells."""

    number: int
    frame: int
    depth: int
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Tally:
    """Volumes of a frame's parameter box by verdict (V7); the rest is open.

    Attributes:
        units, certified, falsified, unknown: Volumes in grid units; ``units`` is that of the box.
        undecided: The unknown volume in cells with a picture whose margin is not finite.
        poses: Initial cells whose middle was rendered, evenly spread over the set.
        holding: Number of these at which the property holds.
    """

    frame: int
    units: int
    certified: int
    falsified: int
    unknown: int
    undecided: int
    poses: int
    holding: int

    @property
    def open(self) -> int:
        """The volume without a verdict."""
        return self.units - self.certified - self.falsified - self.unknown


class Store(StoreFile):
    """An open ``cells.sqlite``.

    Args:
        fingerprint: A stored search must have the same one to be continued.
        parameters: Names and units of the parameters of all frames together.
        fixed: By frame, the values of parameters that do not vary in it.
        resume: Whether to continue the stored search; otherwise it is replaced.
    """

    def __init__(
        self,
        folder: Path,
        fingerprint: Mapping[str, Any],
        parameters: Sequence[tuple[str, str]],
        fixed: Mapping[int, Mapping[str, float]],
        *,
        resume: bool,
    ) -> None:
        super().__init__(folder, fingerprint, parameters, resume=resume)
        self._turn = 0
        self._names, self._fixed = [name for name, _ in parameters], fixed
        self._begun = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Seconds spent on the search, earlier runs included."""
        return self._before + time.perf_counter() - self._begun

    # ---------------------------------------------------------------- frames and blocks

    def grid(self, frame: int, box: ParameterBox) -> CellGrid | None:
        """Return the grid of a frame that was begun, or None."""
        row = self._base.execute("SELECT units, coarse FROM search_frames WHERE frame = ?", (frame,)).fetchone()
        return None if row is None else CellGrid(box, tuple(json.loads(row[0])), tuple(json.loads(row[1])))

    def begin(self, frame: int, grid: CellGrid, blocks: Iterable[Sequence[Cell]]) -> None:
        """Store a frame's first blocks, once."""
        box = grid.box
        with self._transaction():
            row = (
                int(frame),
                *(json.dumps(v) for v in (grid.units, grid.coarse, box.lower, box.upper)),
                str(grid.volume),
            )
            self._insert("search_frames", (*row, "0", "0", "0", "0", 0, 0), self._seals.frames)
            self._open(frame, 0, grid, ((cells, RANK_FIRST) for cells in blocks))

    def _open(self, frame: int, depth: int, grid: CellGrid, blocks: Iterable[tuple[Sequence[Cell], float]]) -> None:
        for cells, rank in blocks:
            volume = max(c.volume for c in cells) / grid.volume
            row = frame, volume, float(rank), depth, json.dumps([[c.first, c.past, c.outliers] for c in cells])
            query = "INSERT INTO search_blocks(frame, volume, rank, depth, cells) VALUES (?, ?, ?, ?, ?)"
            self._seals.blocks.add((self._base.execute(query, row).lastrowid, *row))

    def pending(self, taken: set[int], count: int) -> list[CellBlock]:
        """Return up to ``count`` open blocks not in ``taken``: those nearest to a proof, sometimes the largest."""
        blocks: list[CellBlock] = []
        for _ in range(count):
            self._turn += 1
            order = "volume DESC" if self._turn % _LARGEST_EVERY == 0 else "rank, volume"
            for block in self._listed(f"ORDER BY {order}, id LIMIT {len(taken) + len(blocks) + 1}"):
                if block.number not in taken and block not in blocks:
                    blocks.append(block)
                    break
            else:
                break
        return blocks

    def _listed(self, which: str) -> list[CellBlock]:
        rows = self._base.execute(f"SELECT id, frame, depth, cells FROM search_blocks {which}").fetchall()
        return [
            CellBlock(number, frame, depth, tuple(Cell(*map(tuple, ends)) for ends in json.loads(cells)))
            for number, frame, depth, cells in rows
        ]

    @property
    def open_blocks(self) -> int:
        """Return the number of blocks that are not examined."""
        return self._base.execute("SELECT COUNT(*) FROM search_blocks").fetchone()[0]

    def close_block(self, block: CellBlock, findings: BlockResult, grid: CellGrid) -> bool:
        """Store a block's result and return True; return False, and change nothing, if it was stored before."""
        with self._transaction():
            query = f"SELECT {BLOCK} FROM search_blocks WHERE id = ?"
            gone = self._base.execute(query, (block.number,)).fetchone()
            if gone is None:
                return False
            self._base.execute("DELETE FROM search_blocks WHERE id = ?", (block.number,))
            self._seals.blocks.add(gone, -1)
            volumes: dict[str, int] = {"certified": 0, "falsified": 0, "unknown": 0, "undecided": 0}
            for leaf in findings.leaves:
                self._add(block.frame, leaf, grid)
                volumes[leaf.verdict] += leaf.cell.volume
                if leaf.verdict == "unknown":
                    volumes["undecided"] += leaf.cell.volume * leaf.undecided
                    self._base.execute(
                        "INSERT INTO search_reasons VALUES (?, 1) ON CONFLICT(reason) DO UPDATE SET cells = cells + 1",
                        (leaf.reason,),
                    )
            ranks = findings.ranks or (0.0,) * len(findings.blocks)
            self._open(block.frame, block.depth + 1, grid, zip(findings.blocks, ranks, strict=True))
            query = f"SELECT {FRAME} FROM search_frames WHERE frame = ?"
            row = self._base.execute(query, (block.frame,)).fetchone()
            sums = [str(int(old) + new) for old, new in zip(row[6:10], volumes.values(), strict=True)]
            # the first cells alone are evenly spread
            first = list(findings.samples) if block.depth == 0 else []
            self._base.execute(
                "UPDATE search_frames SET certified = ?, falsified = ?, unknown = ?, undecided = ?, poses = poses + ?, "
                "holding = holding + ? WHERE frame = ?",
                (*sums, len(first), sum(holds for _, holds in first), block.frame),
            )
            self._seals.frames.add(row, -1)
            self._seals.frames.add(self._base.execute(query, (block.frame,)).fetchone())
            self._put("seconds", self.seconds)
            self._put("bounded", int(self._get("bounded") or 0) + findings.bounded)
            self._put("work", float(self._get("work") or 0.0) + findings.seconds)
        return True

    def _list(self, frame: int, box: ParameterBox, values: Sequence[float]) -> str:
        """Return values in the order of the table ``parameters``, as JSON; 0 where this frame has none."""
        values_by_name = {**self._fixed.get(frame, {}), **dict(zip(box.names, values, strict=True))}
        return json.dumps([values_by_name.get(name, 0.0) for name in self._names])

    def _add(self, frame: int, leaf: FinishedCell, grid: CellGrid) -> None:
        box = grid.box_of(leaf.cell)
        margin = leaf.margin if leaf.margin is not None and math.isfinite(leaf.margin) else None
        if leaf.verdict == "certified" and (margin is None or not margin > 0.0):
            raise ValueError(f"frame {frame}: certified with margin {leaf.margin}")
        if leaf.verdict == "falsified" and leaf.counterexample is None:
            raise ValueError(f"frame {frame}: falsified without a counterexample")
        row = (
            frame,
            self._list(frame, box, box.lower),
            self._list(frame, box, box.upper),
            leaf.verdict,
            None if margin is None else float(margin),
            float(leaf.seconds),
            None if leaf.counterexample is None else self._list(frame, box, leaf.counterexample),
        )
        self._insert("cells", row, self._seals.cells)

    def settled(self, kind: str, radius: float, frame: int, box: ParameterBox) -> CellOutcome | None:
        """Return the outcome that `keep_settled` stored for a cell, or None."""
        query = "kind = ? AND radius = ? AND frame = ? AND lower = ? AND upper = ?"
        row = self._base.execute(
            f"SELECT outcome, reason, slopes FROM search_settled WHERE {query}", _settled_key(kind, radius, frame, box)
        ).fetchone()
        return None if row is None else CellOutcome(row[0], row[1], np.array(json.loads(row[2]), np.float64))

    def keep_settled(self, kind: str, radius: float, frame: int, box: ParameterBox, outcome: CellOutcome) -> None:
        """Store a cell's outcome for all scenes of a radius, without the arrays of scenes that break it."""
        if outcome.outcome == "falsified":
            return
        with self._transaction():
            slopes = np.nan_to_num(np.asarray(outcome.slopes, np.float64)).tolist()
            row = (*_settled_key(kind, radius, frame, box), outcome.outcome, outcome.reason, json.dumps(slopes))
            self._insert("search_settled", row, self._seals.settled)

    def finish(self, grids: Mapping[int, CellGrid]) -> None:
        """List open cells as unknown, so that the table covers the set; `Store` reverts that on resuming."""
        with self._transaction():
            rows = []
            for block in self._listed("ORDER BY id"):
                grid = grids[block.frame]
                for cell in block.cells:
                    box = grid.box_of(cell)
                    ends = (self._list(block.frame, box, end) for end in (box.lower, box.upper))
                    rows.append(self._insert("cells", (block.frame, *ends, "unknown", None, 0.0, None), None))
            self._put("open_rows", rows)
            self._put("seconds", self.seconds)

    # ---------------------------------------------------------------- what was found

    def trace(self) -> None:
        """Store the present fractions as a point of the trace."""
        shares = [fractions(tally) for tally in self.tallies()]
        mean = [sum(s[key] for s in shares) / max(1, len(shares)) for key in ("certified", "falsified", "unknown")]
        self._insert("search_trace", (self.seconds, self.count, *mean), None)

    @property
    def points(self) -> list[dict[str, float]]:
        """Return the trace: fractions over time."""
        names = ("seconds", "cells", "certified", "falsified", "unknown")
        rows = self._base.execute("SELECT * FROM search_trace ORDER BY rowid").fetchall()
        return [dict(zip(names, row, strict=True)) for row in rows]

    @property
    def seal(self) -> TableChecksum:
        """Return the checksum of the rows of ``cells`` with a verdict."""
        return self._seals.cells

    @property
    def count(self) -> int:
        """Return the number of stored leaf cells."""
        return self._base.execute("SELECT COUNT(*) FROM cells").fetchone()[0]

    @property
    def effort(self) -> dict[str, float]:
        """Return the number of cells with network bounds, and the seconds of all workers together."""
        return {"cells_bounded": int(self._get("bounded") or 0), "worker_seconds": float(self._get("work") or 0.0)}

    @property
    def reasons(self) -> dict[str, int]:
        """Return the number of unknown cells by reason."""
        return dict(self._base.execute("SELECT reason, cells FROM search_reasons ORDER BY cells DESC, reason"))

    def tallies(self) -> list[Tally]:
        """Return the tallies of the frames that were begun, in order."""
        rows = self._base.execute(
            "SELECT frame, total, certified, falsified, unknown, undecided, poses, holding FROM search_frames "
            "ORDER BY frame"
        )
        return [Tally(row[0], *map(int, row[1:])) for row in rows]

    def leaves(self, frame: int, verdict: Verdict | None = None) -> list[dict[str, Any]]:
        """Return a frame's rows of ``cells`` in the order of their lower ends, with JSON parsed."""
        rows = self._base.execute(
            "SELECT lower, upper, verdict, margin, seconds, counterexample FROM cells WHERE frame = ?", (frame,)
        )
        leaves = [
            {
                "lower": json.loads(low),
                "upper": json.loads(high),
                "verdict": kind,
                "margin": margin,
                "seconds": seconds,
                "counterexample": None if example is None else json.loads(example),
            }
            for low, high, kind, margin, seconds, example in rows
            if verdict in (None, kind)
        ]
        return sorted(leaves, key=lambda row: row["lower"])


def _settled_key(kind: str, radius: float, frame: int, box: ParameterBox) -> tuple[str, float, int, str, str]:
    return kind, float(radius), int(frame), json.dumps(box.lower), json.dumps(box.upper)


def fractions(tally: Tally) -> dict[str, float]:
    """Return certified, falsified, unknown (examined to the finest cell) and open fractions of a frame's volume."""
    names = ("certified", "falsified", "unknown", "open")
    return {name: getattr(tally, name) / tally.units for name in names}
