"""The store ``cells.sqlite`` of a search's finished cells (design.md, V8).

A block's findings are one transaction, which also takes the block off the list of open ones and puts its
children there. So a kill at any moment loses at most the blocks that were being examined, and what arrives
twice (a retried worker) counts once.

Tables ``parameters`` and ``cells`` are for readers; ``search_*`` are the search's own. What was changed by others
since is noticed (`Seal`) and not continued.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import secrets
import sqlite3
import stat
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.atomic import write_atomic
from ns_abstract.io.errors import InputError, first_line
from ns_abstract.io.folder import claim, remove_parts, unwritable
from ns_abstract.io.jsonio import load_json
from ns_abstract.io.version import ADVISORY, stale
from ns_abstract.verify.cells import Cell, Grid
from ns_abstract.verify.scene_margin import Settled
from ns_abstract.verify.search import RANK_FIRST, Findings, Leaf, Verdict

NAME = "cells.sqlite"
VERSION = 5
#: One open block of so many is the one with the largest cells, all others are those nearest to a proof.
_LARGEST_EVERY = 4
#: Folder of the images of counterexamples.
IMAGES = "counterexamples"
_SCHEMA = """
CREATE TABLE parameters(position INTEGER, name TEXT, unit TEXT);
CREATE TABLE cells(frame INTEGER, lower TEXT, upper TEXT, verdict TEXT, margin REAL, seconds REAL, counterexample TEXT);
CREATE TABLE search_state(key TEXT PRIMARY KEY, value TEXT);
CREATE TABLE search_frames(frame INTEGER PRIMARY KEY, units TEXT, coarse TEXT, lower TEXT, upper TEXT, total TEXT,
  certified TEXT, falsified TEXT, unknown TEXT, undecided TEXT, poses INTEGER, holding INTEGER);
CREATE TABLE search_blocks(id INTEGER PRIMARY KEY AUTOINCREMENT, frame INTEGER, volume REAL, rank REAL, depth INTEGER,
  cells TEXT);
CREATE INDEX search_near ON search_blocks(rank, volume, id);
CREATE INDEX search_large ON search_blocks(volume DESC, id);
CREATE TABLE search_reasons(reason TEXT PRIMARY KEY, cells INTEGER);
CREATE TABLE search_trace(seconds REAL, cells INTEGER, certified REAL, falsified REAL, unknown REAL);
CREATE TABLE search_images(name TEXT PRIMARY KEY, sha256 TEXT);
CREATE TABLE search_settled(kind TEXT, radius REAL, frame INTEGER, lower TEXT, upper TEXT, outcome TEXT, reason TEXT,
  slopes TEXT, PRIMARY KEY(kind, radius, frame, lower, upper));
"""
_REPORT_LIMIT = 2**30
#: What a file that others have changed may raise when it is read.
_DAMAGE = (
    sqlite3.DatabaseError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError,
)  # fmt: skip
#: Seconds that another program may keep the file to itself.
_BUSY = 5.0
#: What SQLite says where the disk or another program is in the way.
_PASSING = ("locked", "full", "disk I/O", "readonly", "unable to open")
_CELL = "frame, lower, upper, verdict, margin, seconds, counterexample"
_FRAME = "frame, units, coarse, lower, upper, total, certified, falsified, unknown, undecided, poses, holding"
_BLOCK = "id, frame, volume, rank, depth, cells"
_SETTLED = "kind, radius, frame, lower, upper, outcome, reason, slopes"


@dataclass
class Seal:
    """The count and the sum of the hashes of a table's rows: independent of their order.

    It finds what was damaged or edited; who also writes the seal anew is not found out.
    """

    rows: int = 0
    total: int = 0

    def add(self, row: Sequence[Any], sign: int = 1) -> None:
        """Take in a row as the file holds it, or take it out with ``sign`` -1."""
        digest = hashlib.sha256(json.dumps(list(row)).encode()).digest()
        self.rows += sign
        self.total = (self.total + sign * int.from_bytes(digest, "big")) % (1 << 256)

    @property
    def text(self) -> str:
        """The sum as 64 hexadecimal digits."""
        return f"{self.total:064x}"


@dataclass
class _Seals:
    """Checksums of the finished cells, the open blocks, the frames, and the settled margins."""

    cells: Seal = field(default_factory=Seal)
    blocks: Seal = field(default_factory=Seal)
    frames: Seal = field(default_factory=Seal)
    settled: Seal = field(default_factory=Seal)

    def plain(self) -> dict[str, Any]:
        return {name: [seal.rows, seal.text] for name, seal in vars(self).items()}

    def copy(self) -> _Seals:
        return _Seals(**{name: Seal(seal.rows, seal.total) for name, seal in vars(self).items()})


@dataclass(frozen=True)
class Block:
    """Cells of one frame to examine together; ``depth`` counts the cuts from the first cells."""

    number: int
    frame: int
    depth: int
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Tally:
    """Parts of a frame's parameter volume (V7); what is left is open.

    Attributes:
        frame: Entry of the camera path.
        units, certified, falsified, unknown: Volumes in grid units.
        undecided: The part of unknown in cells with a picture that neither holds nor breaks the property.
        poses: First cells whose middle was rendered, evenly spread over the set.
        holding: At how many of them the property holds.
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
        self._fresh = not resume
        self._turn = 0
        self._names, self._fixed = [name for name, _ in parameters], fixed
        self.folder, self.file = folder, folder / NAME
        self._seals = _Seals()
        self._lock = claim(folder)
        try:
            self.resumed = not self._open_base(fingerprint, parameters, resume)
            self._before = float(self._get("seconds") or 0.0)
        except OSError as error:
            self.close()
            raise unwritable(folder, error) from None
        except InputError:
            self.close()
            raise
        except _DAMAGE as error:
            self.close()
            if isinstance(error, sqlite3.DatabaseError) and (self._fresh or _passes(error)):
                raise self._failure(error) from None
            raise self._damaged(first_line(error)) from None
        except BaseException:
            self.close()
            raise
        self._begun = time.perf_counter()

    def _damaged(self, problem: str) -> InputError:
        return InputError(
            f"cannot be used: {problem}", file=self.file, field="--resume", fix="run without --resume to search again"
        )

    def _failure(self, error: sqlite3.Error) -> InputError:
        """What a user is told when the file cannot be read or written."""
        fix = "make room there and --resume, or choose a folder on another disk; finished cells are kept"
        if "locked" in str(error):
            fix = "end the program that writes to it and --resume; finished cells are kept"
        return InputError(f"cannot be used: {error}", file=self.file, field="--output-dir", fix=fix)

    @contextmanager
    def told(self) -> Iterator[None]:
        """Errors of the file inside the block are told like a user's mistakes.

        Raises:
            InputError: The disk is full, or the file was damaged meanwhile.
        """
        try:
            yield
        except sqlite3.Error as error:
            raise self._failure(error) from None

    def _open_base(self, fingerprint: Mapping[str, Any], parameters: Sequence[tuple[str, str]], resume: bool) -> bool:
        """Open the file; whether it is a new one."""
        fresh = self._fresh = not (resume and os.path.lexists(self.file))
        remove_parts(self.folder)
        images = self.folder / IMAGES
        # what a link leads to is not locked
        if images.is_dir() and not images.is_symlink():
            remove_parts(images)
        if fresh:
            self._remove_images()
            for suffix in ("", "-wal", "-shm"):
                Path(f"{self.file}{suffix}").unlink(missing_ok=True)
            self._create(fingerprint, parameters)
        elif not stat.S_ISREG(self.file.lstat().st_mode):
            # a link would lead to a file of others
            raise self._damaged("it is no regular file")
        self._base = sqlite3.connect(self.file, timeout=_BUSY, isolation_level=None)
        self._check(fingerprint)
        # others may read while cells come in, and a kill leaves whole transactions
        self._base.execute("PRAGMA journal_mode=WAL")
        self._base.execute("PRAGMA synchronous=NORMAL")
        if not fresh:
            self._verify(parameters)
            with self._transaction():
                # what an ended run had left open stands there as unknown; it is examined now
                self._base.execute("DELETE FROM cells WHERE rowid IN (SELECT value FROM json_each(?))", self._left())
                self._put("open_rows", [])
        return fresh

    def _create(self, fingerprint: Mapping[str, Any], parameters: Sequence[tuple[str, str]]) -> None:
        """Write the file without cells, which is seen whole or not at all: a kill may come at any time."""
        part = self.folder / f".{NAME}.{secrets.token_hex(4)}.part"
        try:
            self._base = sqlite3.connect(part, isolation_level=None)
            self._base.execute("PRAGMA journal_mode=OFF")
            with self._transaction():
                for statement in _SCHEMA.split(";\n"):
                    self._base.execute(statement)
                self._put("version", VERSION)
                self._put("fingerprint", dict(fingerprint))
                rows = [(k, *names) for k, names in enumerate(parameters)]
                self._base.executemany("INSERT INTO parameters VALUES (?, ?, ?)", rows)
            self._base.close()
            os.replace(part, self.file)
        except BaseException:
            part.unlink(missing_ok=True)
            raise

    def _left(self) -> tuple[str]:
        """Rows of ``cells`` that stand for open blocks, as a JSON list."""
        return (json.dumps([int(row) for row in self._get("open_rows") or []]),)

    def _verify(self, parameters: Sequence[tuple[str, str]]) -> None:
        """Refuse a file that others have changed.

        Raises:
            InputError: Its rows are not those that were written.
        """
        (state,) = self._base.execute("PRAGMA quick_check(1)").fetchone()
        if state != "ok":
            raise self._damaged(state)
        # a trigger would change rows behind the seals
        with closing(sqlite3.connect(":memory:")) as empty:
            empty.executescript(_SCHEMA)
            parts = _parts_of(empty)
        if _parts_of(self._base) != parts:
            raise self._damaged("its tables are others")
        known = self._base.execute("SELECT * FROM parameters ORDER BY position").fetchall()
        if known != [(k, *names) for k, names in enumerate(parameters)]:
            raise self._damaged("its parameters are others")
        written = self._reported()
        found = _Seals()
        cells = f"SELECT {_CELL} FROM cells WHERE rowid NOT IN (SELECT value FROM json_each(?)) ORDER BY rowid"
        for row in self._base.execute(cells, self._left()):
            found.cells.add(row)
            if written and found.cells.rows == written[0] and found.cells.text != written[1]:
                raise self._damaged("the cells are not those of report.json: they were changed since")
        for row in self._base.execute(f"SELECT {_BLOCK} FROM search_blocks"):
            found.blocks.add(row)
        for row in self._base.execute(f"SELECT {_FRAME} FROM search_frames"):
            found.frames.add(row)
        for row in self._base.execute(f"SELECT {_SETTLED} FROM search_settled"):
            found.settled.add(row)
        if found.plain() != self._get("seals"):
            raise self._damaged("its content was changed since it was written")
        self._seals = found

    def _reported(self) -> tuple[int, str] | None:
        """Number and sum of the cells that report.json speaks of, if it is of this search."""
        try:
            document = load_json(self.folder / "report.json", "report", limit=_REPORT_LIMIT)
            if document["fingerprint"] != self._get("fingerprint"):
                return None
            return int(document["cells_seal"]["rows"]), str(document["cells_seal"]["sum"])
        except (InputError, LookupError, TypeError, ValueError):
            return None

    # ---------------------------------------------------------------- images

    def _remove_images(self) -> None:
        """Remove the images that the search before has written, and none that anyone has put there or changed."""
        if not self.file.exists():
            return
        try:
            # closing() does not commit: nothing is to be written
            with closing(sqlite3.connect(f"file:{quote(str(self.file.absolute()))}?mode=ro", uri=True)) as base:
                known = dict(base.execute("SELECT name, sha256 FROM search_images"))
        except sqlite3.Error:
            return
        for name, digest in known.items():
            file = self._place(name)
            if _digest(file) == digest:
                file.unlink(missing_ok=True)
        with suppress(OSError):
            (self.folder / IMAGES).rmdir()

    def _place(self, name: str) -> Path:
        """Images of counterexamples have a folder of their own."""
        file = self.folder / Path(name).name
        return file.parent / IMAGES / file.name if file.suffix == ".npz" else file

    def keep_image(self, name: str, data: bytes) -> None:
        """Write the image of a counterexample, as `keep` does.

        Raises:
            InputError: It cannot be written.
        """
        self.keep(f"{name}.npz", data)

    def keep(self, name: str, data: bytes) -> Path:
        """Write a file; one of that name that is not ours stays, and ours gets another name.

        Returns:
            The file.

        Raises:
            InputError: It cannot be written.
        """
        file, number = self._place(name), 1
        wanted = file

        def ours() -> bool:
            row = self._base.execute("SELECT sha256 FROM search_images WHERE name = ?", (file.name,)).fetchone()
            return row is not None and row[0] == _digest(file)

        try:
            file.parent.mkdir(exist_ok=True)
            while os.path.lexists(file) and not ours():
                number += 1
                file = wanted.with_stem(f"{wanted.stem}_{number}")
            with self._transaction():
                row = file.name, hashlib.sha256(data).hexdigest()
                self._base.execute("INSERT OR REPLACE INTO search_images VALUES (?, ?)", row)
            write_atomic(file, lambda stream: stream.write(data))
        except OSError as error:
            raise unwritable(file.parent, error) from None
        return file

    def _check(self, fingerprint: Mapping[str, Any]) -> None:
        if self._get("version") != VERSION:
            raise InputError(
                "written by another version of ns-abstract",
                file=self.file,
                field="--resume",
                fix=f"leave it out to search again; {ADVISORY}",
            )
        stored, asked = self._get("fingerprint"), json.loads(json.dumps(dict(fingerprint)))
        if problem := stale(stored, asked):
            raise InputError(
                f"holds a search {problem}",
                file=self.file,
                field="--resume",
                fix=f"leave it out to search again; {ADVISORY}",
            )
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

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        before = self._seals.copy()
        self._base.execute("BEGIN IMMEDIATE")
        try:
            yield
            self._put("seals", self._seals.plain())
            self._base.execute("COMMIT")
        except BaseException:
            self._seals = before
            # a full disk may have ended it already
            if self._base.in_transaction:
                self._base.execute("ROLLBACK")
            raise

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
            row = (
                int(frame),
                *(json.dumps(v) for v in (grid.units, grid.coarse, box.lower, box.upper)),
                str(grid.volume),
            )
            row = (*row, "0", "0", "0", "0", 0, 0)
            self._base.execute(f"INSERT INTO search_frames VALUES ({', '.join('?' * len(row))})", row)
            self._seals.frames.add(row)
            self._open(frame, 0, grid, ((cells, RANK_FIRST) for cells in blocks))

    def _open(self, frame: int, depth: int, grid: Grid, blocks: Iterable[tuple[Sequence[Cell], float]]) -> None:
        for cells, rank in blocks:
            volume = max(c.volume for c in cells) / grid.volume
            row = frame, volume, float(rank), depth, json.dumps([[c.first, c.past] for c in cells])
            query = "INSERT INTO search_blocks(frame, volume, rank, depth, cells) VALUES (?, ?, ?, ?, ?)"
            self._seals.blocks.add((self._base.execute(query, row).lastrowid, *row))

    def pending(self, known: set[int], count: int) -> list[Block]:
        """Up to ``count`` open blocks that are not in ``known``: those nearest to a proof, now and then the largest."""
        found: list[Block] = []
        for _ in range(count):
            self._turn += 1
            order = "volume DESC" if self._turn % _LARGEST_EVERY == 0 else "rank, volume"
            for block in self._listed(f"ORDER BY {order}, id LIMIT {len(known) + len(found) + 1}"):
                if block.number not in known and block not in found:
                    found.append(block)
                    break
            else:
                break
        return found

    def _listed(self, which: str) -> list[Block]:
        rows = self._base.execute(f"SELECT id, frame, depth, cells FROM search_blocks {which}").fetchall()
        return [
            Block(number, frame, depth, tuple(Cell(tuple(a), tuple(b)) for a, b in json.loads(cells)))
            for number, frame, depth, cells in rows
        ]

    @property
    def open_blocks(self) -> int:
        """Number of blocks that are not examined yet."""
        return self._base.execute("SELECT COUNT(*) FROM search_blocks").fetchone()[0]

    def close_block(self, block: Block, findings: Findings, grid: Grid) -> bool:
        """Store what became of a block; false, and nothing changes, if that was stored before."""
        with self._transaction():
            query = f"SELECT {_BLOCK} FROM search_blocks WHERE id = ?"
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
            query = f"SELECT {_FRAME} FROM search_frames WHERE frame = ?"
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
        row = (
            frame,
            self._list(frame, box, box.lower),
            self._list(frame, box, box.upper),
            leaf.verdict,
            None if margin is None else float(margin),
            float(leaf.seconds),
            None if leaf.counterexample is None else self._list(frame, box, leaf.counterexample),
        )
        self._base.execute("INSERT INTO cells VALUES (?, ?, ?, ?, ?, ?, ?)", row)
        self._seals.cells.add(row)

    def settled(self, kind: str, radius: float, frame: int, box: ParameterBox) -> Settled | None:
        """What `keep_settled` was told of a cell, or None."""
        query = "kind = ? AND radius = ? AND frame = ? AND lower = ? AND upper = ?"
        row = self._base.execute(
            f"SELECT outcome, reason, slopes FROM search_settled WHERE {query}", _settled_key(kind, radius, frame, box)
        ).fetchone()
        return None if row is None else Settled(row[0], row[1], np.array(json.loads(row[2]), np.float64))

    def keep_settled(self, kind: str, radius: float, frame: int, box: ParameterBox, found: Settled) -> None:
        """Note what is known of a cell for all scenes of a radius; scenes that break it are found again."""
        if found.outcome == "falsified":
            return
        with self._transaction():
            slopes = np.nan_to_num(np.asarray(found.slopes, np.float64)).tolist()
            row = (*_settled_key(kind, radius, frame, box), found.outcome, found.reason, json.dumps(slopes))
            self._base.execute(f"INSERT INTO search_settled VALUES ({', '.join('?' * len(row))})", row)
            self._seals.settled.add(row)

    def finish(self, grids: Mapping[int, Grid]) -> None:
        """List what is still open as unknown, so that the cells cover the set; `Store` takes it back on resuming."""
        with self._transaction():
            rows = []
            for block in self._listed("ORDER BY id"):
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
    def seal(self) -> Seal:
        """Of the rows of ``cells`` that have a verdict."""
        return self._seals.cells

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
            "SELECT frame, total, certified, falsified, unknown, undecided, poses, holding FROM search_frames "
            "ORDER BY frame"
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


def _settled_key(kind: str, radius: float, frame: int, box: ParameterBox) -> tuple[str, float, int, str, str]:
    return kind, float(radius), int(frame), json.dumps(box.lower), json.dumps(box.upper)


def _parts_of(base: sqlite3.Connection) -> set[tuple[str, str, str]]:
    """Tables and indices, and what else a database defines."""
    rows = base.execute("SELECT type, name, sql FROM sqlite_master WHERE sql IS NOT NULL")
    return {(kind, name, " ".join(text.split())) for kind, name, text in rows}


def _passes(error: sqlite3.DatabaseError) -> bool:
    """Return whether an error leaves the file intact (locked, disk full, ...)."""
    return isinstance(error, sqlite3.OperationalError) and any(word in str(error) for word in _PASSING)


def _digest(file: Path) -> str | None:
    """SHA-256 of a regular file; None of anything else."""
    if not file.is_file() or file.is_symlink():
        return None
    return hashlib.sha256(file.read_bytes()).hexdigest()


def fractions(tally: Tally) -> dict[str, float]:
    """Certified, falsified, unknown (examined to the finest cell) and open parts of a frame's volume."""
    names = ("certified", "falsified", "unknown", "open")
    return {name: getattr(tally, name) / tally.units for name in names}
