"""``cells.sqlite``: what a search has found, as it comes.

A block's findings are one transaction, which also takes the block off the list of open ones and puts its
children there. So a kill at any moment loses at most the blocks that were being examined, and what arrives
twice (a retried worker) counts once.

Tables ``parameters`` and ``cells`` are for readers; ``search_*`` are the search's own.
"""

from __future__ import annotations

import fcntl
import json
import math
import sqlite3
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from ns_abstract.errors import InputError
from ns_abstract.sets.box import ParameterBox
from ns_abstract.verify.cells import Cell, Grid
from ns_abstract.verify.search import Findings, Leaf, Verdict

NAME = "cells.sqlite"
VERSION = 1
_SCHEMA = """
CREATE TABLE parameters(position INTEGER, name TEXT, unit TEXT);
CREATE TABLE cells(frame INTEGER, lower TEXT, upper TEXT, verdict TEXT, margin REAL, seconds REAL, counterexample TEXT);
CREATE TABLE search_state(key TEXT PRIMARY KEY, value TEXT);
CREATE TABLE search_frames(frame INTEGER PRIMARY KEY, units TEXT, coarse TEXT, lower TEXT, upper TEXT, total TEXT,
  certified TEXT, falsified TEXT, unknown TEXT, poses INTEGER, holding INTEGER);
CREATE TABLE search_blocks(id INTEGER PRIMARY KEY AUTOINCREMENT, frame INTEGER, volume REAL, depth INTEGER, cells TEXT);
CREATE TABLE search_reasons(reason TEXT PRIMARY KEY, cells INTEGER);
CREATE TABLE search_trace(seconds REAL, cells INTEGER, certified REAL, falsified REAL, unknown REAL);
"""


@dataclass(frozen=True)
class Block:
    """Cells of one frame to examine together; ``depth`` counts the cuts from the first cells."""

    number: int
    frame: int
    depth: int
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Tally:
    """Parts of a frame's parameter volume; what is left is open.

    Attributes:
        frame: Entry of the camera path.
        units, certified, falsified, unknown: Volumes in grid units.
        poses: First cells whose middle was rendered, evenly spread over the set.
        holding: At how many of them the property holds.
    """

    frame: int
    units: int
    certified: int
    falsified: int
    unknown: int
    poses: int
    holding: int

    @property
    def open(self) -> int:
        """Volume without a verdict yet."""
        return self.units - self.certified - self.falsified - self.unknown


class Store:
    """An open ``cells.sqlite``.

    Args:
        folder: Output folder.
        fingerprint: What a stored search must agree with to be continued.
        parameters: Names and units of the parameters of all frames together.
        fixed: By frame, the values of parameters that do not vary in it.
        resume: Whether to go on with what is there; otherwise it is replaced.

    Raises:
        InputError: The folder cannot be written, or the stored search is another one or damaged.
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
        self._base: Any = None
        self._names, self._fixed = [name for name, _ in parameters], fixed
        self.file = folder / NAME
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = _locked(folder / f".{NAME}.lock")
        except OSError as error:
            raise InputError(
                f"cannot be written: {error.strerror}", file=folder, field="--output-dir", fix="choose another folder"
            ) from None
        try:
            fresh = self._open_base(fingerprint, parameters, resume)
        except BaseException as error:
            self.close()
            if isinstance(error, sqlite3.DatabaseError):
                fix = "run without --resume" if resume else "choose another --output-dir"
                raise InputError(f"cannot be used: {error}", file=self.file, fix=fix) from None
            raise
        self.resumed = not fresh
        if self.resumed:
            with self._transaction():
                # what an ended run had left open stands there as unknown; it is examined now
                self._base.execute(
                    "DELETE FROM cells WHERE rowid IN (SELECT value FROM json_each("
                    "(SELECT value FROM search_state WHERE key = 'open_rows')))"
                )
                self._put("open_rows", [])
        self._begun = time.perf_counter()
        self._before = float(self._get("seconds") or 0.0)

    def _open_base(self, fingerprint: Mapping[str, Any], parameters: Sequence[tuple[str, str]], resume: bool) -> bool:
        """Open the file; whether it is a new one."""
        fresh = not (resume and self.file.exists())
        if fresh:
            for suffix in ("", "-wal", "-shm"):
                Path(f"{self.file}{suffix}").unlink(missing_ok=True)
        self._base = sqlite3.connect(self.file, isolation_level=None)
        # others may read while cells come in, and a kill leaves whole transactions
        self._base.execute("PRAGMA journal_mode=WAL")
        self._base.execute("PRAGMA synchronous=NORMAL")
        if fresh:
            with self._transaction():
                for statement in _SCHEMA.split(";\n"):
                    self._base.execute(statement)
                self._put("version", VERSION)
                self._put("fingerprint", dict(fingerprint))
                rows = [(k, *names) for k, names in enumerate(parameters)]
                self._base.executemany("INSERT INTO parameters VALUES (?, ?, ?)", rows)
        self._check(fingerprint)
        return fresh

    def _check(self, fingerprint: Mapping[str, Any]) -> None:
        if self._get("version") != VERSION:
            raise InputError("written by another version", file=self.file, fix="run without --resume")
        stored, asked = self._get("fingerprint"), json.loads(json.dumps(dict(fingerprint)))
        different = [key for key in {**stored, **asked} if stored.get(key) != asked.get(key)]
        if different:
            raise InputError(
                f"holds a search with another {', '.join(different)}",
                file=self.file,
                field="--resume",
                fix="give the same inputs, or run without --resume",
            )

    def close(self) -> None:
        """Close the file; the write-ahead log is folded into it."""
        if self._base is not None:
            self._base.close()
        self._lock.close()

    # ---------------------------------------------------------------- small helpers

    def _transaction(self) -> _Transaction:
        return _Transaction(self._base)

    def _put(self, key: str, value: Any) -> None:
        self._base.execute("INSERT OR REPLACE INTO search_state VALUES (?, ?)", (key, json.dumps(value)))

    def _get(self, key: str) -> Any:
        row = self._base.execute("SELECT value FROM search_state WHERE key = ?", (key,)).fetchone()
        return None if row is None else json.loads(row[0])

    @property
    def seconds(self) -> float:
        """Time spent on the search, earlier runs included."""
        return self._before + time.perf_counter() - self._begun

    # ---------------------------------------------------------------- frames and blocks

    def grid(self, frame: int, box: ParameterBox) -> Grid | None:
        """The grid of a frame that was begun, or None."""
        row = self._base.execute("SELECT units, coarse FROM search_frames WHERE frame = ?", (frame,)).fetchone()
        return None if row is None else Grid(box, tuple(json.loads(row[0])), tuple(json.loads(row[1])))

    def begin(self, frame: int, grid: Grid, blocks: Iterable[Sequence[Cell]]) -> None:
        """Note a frame's first blocks, once."""
        box = grid.box
        with self._transaction():
            self._base.execute(
                "INSERT INTO search_frames VALUES (?, ?, ?, ?, ?, ?, '0', '0', '0', 0, 0)",
                (frame, *(json.dumps(v) for v in (grid.units, grid.coarse, box.lower, box.upper)), str(grid.volume)),
            )
            self._open(frame, 0, grid, blocks)

    def _open(self, frame: int, depth: int, grid: Grid, blocks: Iterable[Sequence[Cell]]) -> None:
        rows = [
            (frame, max(c.volume for c in cells) / grid.volume, depth, json.dumps([[c.first, c.past] for c in cells]))
            for cells in blocks
        ]
        self._base.executemany("INSERT INTO search_blocks(frame, volume, depth, cells) VALUES (?, ?, ?, ?)", rows)

    def pending(self, known: set[int], count: int) -> list[Block]:
        """Up to ``count`` open blocks that are not in ``known``, largest cells first."""
        found: list[Block] = []
        query = "SELECT id, frame, depth, cells FROM search_blocks ORDER BY volume DESC, id LIMIT ?"
        for number, frame, depth, cells in self._base.execute(query, (count + len(known),)):
            if number not in known and len(found) < count:
                found.append(
                    Block(number, frame, depth, tuple(Cell(tuple(a), tuple(b)) for a, b in json.loads(cells)))
                )
        return found

    @property
    def open_blocks(self) -> int:
        """Number of blocks that are not examined yet."""
        return self._base.execute("SELECT COUNT(*) FROM search_blocks").fetchone()[0]

    def settle(self, block: Block, findings: Findings, grid: Grid) -> bool:
        """Store what became of a block; false, and nothing changes, if that was stored before."""
        with self._transaction():
            gone = self._base.execute("DELETE FROM search_blocks WHERE id = ?", (block.number,)).rowcount
            if not gone:
                return False
            volumes: dict[str, int] = {"certified": 0, "falsified": 0, "unknown": 0}
            for leaf in findings.leaves:
                self._add(block.frame, leaf, grid)
                volumes[leaf.verdict] += leaf.cell.volume
                if leaf.verdict == "unknown":
                    self._base.execute(
                        "INSERT INTO search_reasons VALUES (?, 1) ON CONFLICT(reason) DO UPDATE SET cells = cells + 1",
                        (leaf.reason,),
                    )
            self._open(block.frame, block.depth + 1, grid, findings.blocks)
            row = self._base.execute(
                "SELECT certified, falsified, unknown FROM search_frames WHERE frame = ?", (block.frame,)
            ).fetchone()
            sums = [str(int(old) + new) for old, new in zip(row, volumes.values(), strict=True)]
            # the first cells alone are evenly spread
            first = list(findings.samples) if block.depth == 0 else []
            self._base.execute(
                "UPDATE search_frames SET certified = ?, falsified = ?, unknown = ?, poses = poses + ?, "
                "holding = holding + ? WHERE frame = ?",
                (*sums, len(first), sum(holds for _, holds in first), block.frame),
            )
            self._put("seconds", self.seconds)
            self._put("bounded", int(self._get("bounded") or 0) + findings.bounded)
            self._put("work", float(self._get("work") or 0.0) + findings.seconds)
        return True

    def _list(self, frame: int, box: ParameterBox, values: Sequence[float]) -> str:
        """Values in the order of the table ``parameters``; 0 where this frame has none."""
        known = {**self._fixed.get(frame, {}), **dict(zip(box.names, values, strict=True))}
        return json.dumps([known.get(name, 0.0) for name in self._names])

    def _add(self, frame: int, leaf: Leaf, grid: Grid) -> None:
        box = grid.box_of(leaf.cell)
        margin = leaf.margin if leaf.margin is not None and math.isfinite(leaf.margin) else None
        if leaf.verdict == "certified" and (margin is None or not margin > 0.0):
            raise ValueError(f"frame {frame}: certified with margin {leaf.margin}")
        if leaf.verdict == "falsified" and leaf.counterexample is None:
            raise ValueError(f"frame {frame}: falsified without a counterexample")
        self._base.execute(
            "INSERT INTO cells VALUES (?, ?, ?, ?, ?, ?, ?)",
            (
                frame,
                self._list(frame, box, box.lower),
                self._list(frame, box, box.upper),
                leaf.verdict,
                margin,
                leaf.seconds,
                None if leaf.counterexample is None else self._list(frame, box, leaf.counterexample),
            ),
        )

    def finish(self, grids: Mapping[int, Grid]) -> None:
        """List what is still open as unknown, so that the cells cover the set; `Store` takes it back on resuming."""
        with self._transaction():
            rows = []
            for block in self.pending(set(), self.open_blocks):
                grid = grids[block.frame]
                for cell in block.cells:
                    box = grid.box_of(cell)
                    cursor = self._base.execute(
                        "INSERT INTO cells VALUES (?, ?, ?, 'unknown', NULL, 0.0, NULL)",
                        (block.frame, *(self._list(block.frame, box, ends) for ends in (box.lower, box.upper))),
                    )
                    rows.append(cursor.lastrowid)
            self._put("open_rows", rows)
            self._put("seconds", self.seconds)

    # ---------------------------------------------------------------- what was found

    def trace(self) -> None:
        """Note how far the search is."""
        shares = [fractions(tally) for tally in self.tallies()]
        mean = [sum(s[key] for s in shares) / max(1, len(shares)) for key in ("certified", "falsified", "unknown")]
        self._base.execute("INSERT INTO search_trace VALUES (?, ?, ?, ?, ?)", (self.seconds, self.count, *mean))

    @property
    def points(self) -> list[dict[str, float]]:
        """How the fractions rose over time."""
        names = ("seconds", "cells", "certified", "falsified", "unknown")
        rows = self._base.execute("SELECT * FROM search_trace ORDER BY rowid").fetchall()
        return [dict(zip(names, row, strict=True)) for row in rows]

    @property
    def count(self) -> int:
        """Leaf cells stored."""
        return self._base.execute("SELECT COUNT(*) FROM cells").fetchone()[0]

    @property
    def effort(self) -> dict[str, float]:
        """Cells whose network bounds were computed, and seconds that all workers together spent."""
        return {"cells_bounded": int(self._get("bounded") or 0), "worker_seconds": float(self._get("work") or 0.0)}

    @property
    def reasons(self) -> dict[str, int]:
        """Why cells are unknown, and how many of them."""
        return dict(self._base.execute("SELECT reason, cells FROM search_reasons ORDER BY cells DESC, reason"))

    def tallies(self) -> list[Tally]:
        """The frames that were begun, in order."""
        rows = self._base.execute(
            "SELECT frame, total, certified, falsified, unknown, poses, holding FROM search_frames ORDER BY frame"
        )
        return [Tally(row[0], *map(int, row[1:])) for row in rows]

    def leaves(self, frame: int, verdict: Verdict | None = None) -> list[dict[str, Any]]:
        """A frame's rows of ``cells`` in order of their lower ends, JSON read."""
        rows = self._base.execute(
            "SELECT lower, upper, verdict, margin, seconds, counterexample FROM cells WHERE frame = ?", (frame,)
        )
        found = [
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
        return sorted(found, key=lambda row: row["lower"])


def _locked(file: Path) -> BinaryIO:
    """The open file, locked as long as it is open, also against a command that is killed later.

    Raises:
        InputError: Another command holds it.
    """
    stream = open(file, "ab")  # noqa: SIM115 (open as long as the store)
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        stream.close()
        raise InputError(
            "locked by a command that is still running",
            file=file.parent,
            field="--output-dir",
            fix="wait for it, or choose another folder",
        ) from None
    return stream


class _Transaction:
    def __init__(self, base: sqlite3.Connection) -> None:
        self._base = base

    def __enter__(self) -> None:
        self._base.execute("BEGIN IMMEDIATE")

    def __exit__(self, kind: object, *rest: object) -> None:
        self._base.execute("COMMIT" if kind is None else "ROLLBACK")


def fractions(tally: Tally) -> dict[str, float]:
    """Certified, falsified, unknown (examined to the finest cell) and open parts of a frame's volume."""
    names = ("certified", "falsified", "unknown", "open")
    return {name: getattr(tally, name) / tally.units for name in names}
