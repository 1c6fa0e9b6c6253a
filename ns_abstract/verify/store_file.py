"""The file ``cells.sqlite``: opened, checked for changes by others, and sealed; and files beside it (V8)."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import sqlite3
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ns_abstract.io.atomic import write_atomic
from ns_abstract.io.errors import InputError, first_line
from ns_abstract.io.folder import claim, remove_parts, unwritable
from ns_abstract.io.jsonio import load_json
from ns_abstract.io.version import ADVISORY, stale

NAME = "cells.sqlite"
VERSION = 5
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
#: Columns of tables, in order.
CELL = "frame, lower, upper, verdict, margin, seconds, counterexample"
FRAME = "frame, units, coarse, lower, upper, total, certified, falsified, unknown, undecided, poses, holding"
BLOCK = "id, frame, volume, rank, depth, cells"
SETTLED = "kind, radius, frame, lower, upper, outcome, reason, slopes"


@dataclass
class TableChecksum:
    """Number and sum of the hashes of a table's rows, in any order; it detects damage and edits."""

    rows: int = 0
    total: int = 0

    def add(self, row: Sequence[Any], sign: int = 1) -> None:
        """Add a row as stored in the file, or remove it with ``sign`` -1."""
        digest = hashlib.sha256(json.dumps(list(row)).encode()).digest()
        self.rows += sign
        self.total = (self.total + sign * int.from_bytes(digest, "big")) % (1 << 256)

    @property
    def text(self) -> str:
        """Return the sum as 64 hexadecimal digits."""
        return f"{self.total:064x}"


@dataclass
class _Checksums:
    """Checksums of cells with a verdict, of open blocks, of frames, and of scene margins."""

    cells: TableChecksum = field(default_factory=TableChecksum)
    blocks: TableChecksum = field(default_factory=TableChecksum)
    frames: TableChecksum = field(default_factory=TableChecksum)
    settled: TableChecksum = field(default_factory=TableChecksum)

    def plain(self) -> dict[str, Any]:
        return {name: [seal.rows, seal.text] for name, seal in vars(self).items()}

    def copy(self) -> _Checksums:
        return _Checksums(**{name: TableChecksum(seal.rows, seal.total) for name, seal in vars(self).items()})


class StoreFile:
    """An open ``cells.sqlite`` whose rows have been checked to be those that were written.

    Raises:
        InputError: The folder cannot be written, or the stored search is another one or damaged.
    """

    def __init__(
        self, folder: Path, fingerprint: Mapping[str, Any], parameters: Sequence[tuple[str, str]], *, resume: bool
    ) -> None:
        self._base: Any = None
        self._fresh = not resume
        self.folder, self.file = folder, folder / NAME
        self._seals = _Checksums()
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
            if isinstance(error, sqlite3.DatabaseError) and (self._fresh or _may_pass(error)):
                raise self._failure(error) from None
            raise self._damaged(first_line(error)) from None
        except BaseException:
            self.close()
            raise

    def _damaged(self, problem: str) -> InputError:
        return InputError(
            f"cannot be used: {problem}", file=self.file, field="--resume", fix="run without --resume to search again"
        )

    def _failure(self, error: sqlite3.Error) -> InputError:
        """Return the error to report when the file cannot be read or written."""
        fix = "make room there and --resume, or choose a folder on another disk; finished cells are kept"
        if "locked" in str(error):
            fix = "end the program that writes to it and --resume; finished cells are kept"
        return InputError(f"cannot be used: {error}", file=self.file, field="--output-dir", fix=fix)

    @contextmanager
    def errors_as_input(self) -> Iterator[None]:
        """Turn errors of the file inside the block into InputError: a full disk, or a file damaged meanwhile."""
        try:
            yield
        except sqlite3.Error as error:
            raise self._failure(error) from None

    def _open_base(self, fingerprint: Mapping[str, Any], parameters: Sequence[tuple[str, str]], resume: bool) -> bool:
        """Open the file, and return whether it is a new one."""
        fresh = self._fresh = not (resume and os.path.lexists(self.file))
        report = self.folder / "report.json"
        if fresh and resume and os.path.lexists(report):
            # every search that has reported has a file: this is another command's result
            problem, fix = "is of no search that is stored here", "run without --resume to search here, or give another"
            raise InputError(problem, file=report, field="--resume", fix=f"{fix} --output-dir")
        remove_parts(self.folder)
        images = self.folder / IMAGES
        # what a link leads to is not locked
        if images.is_dir() and not images.is_symlink():
            remove_parts(images)
        if fresh:
            self._remove_images()
            # a report would speak of another search while this one has none
            for name in (*(f"{NAME}{suffix}" for suffix in ("", "-wal", "-shm")), report.name, "report.html"):
                (self.folder / name).unlink(missing_ok=True)
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
        """Write the file without cells atomically: a kill may come at any time."""
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
        """Return the rows of ``cells`` that stand for open blocks, as a JSON list."""
        return (json.dumps([int(row) for row in self._get("open_rows") or []]),)

    def _verify(self, parameters: Sequence[tuple[str, str]]) -> None:
        """Raise InputError for a file whose rows are not those that were written."""
        (state,) = self._base.execute("PRAGMA quick_check(1)").fetchone()
        if state != "ok":
            raise self._damaged(state)
        # a trigger would change rows behind the seals
        with closing(sqlite3.connect(":memory:")) as empty:
            empty.executescript(_SCHEMA)
            parts = _definitions(empty)
        if _definitions(self._base) != parts:
            raise self._damaged("its tables are others")
        names_stored = self._base.execute("SELECT * FROM parameters ORDER BY position").fetchall()
        if names_stored != [(k, *names) for k, names in enumerate(parameters)]:
            raise self._damaged("its parameters are others")
        written = self._reported()
        checksums = _Checksums()
        cells = f"SELECT {CELL} FROM cells WHERE rowid NOT IN (SELECT value FROM json_each(?)) ORDER BY rowid"
        for row in self._base.execute(cells, self._left()):
            checksums.cells.add(row)
            if written and checksums.cells.rows == written[0] and checksums.cells.text != written[1]:
                raise self._damaged("the cells are not those of report.json: they were changed since")
        for row in self._base.execute(f"SELECT {BLOCK} FROM search_blocks"):
            checksums.blocks.add(row)
        for row in self._base.execute(f"SELECT {FRAME} FROM search_frames"):
            checksums.frames.add(row)
        for row in self._base.execute(f"SELECT {SETTLED} FROM search_settled"):
            checksums.settled.add(row)
        if checksums.plain() != self._get("seals"):
            raise self._damaged("its content was changed since it was written")
        self._seals = checksums

    def _reported(self) -> tuple[int, str] | None:
        """Return number and sum of the cells in report.json, if it is of this search; else None."""
        try:
            document = load_json(self.folder / "report.json", "report", limit=_REPORT_LIMIT)
            if document["fingerprint"] != self._get("fingerprint"):
                return None
            return int(document["cells_seal"]["rows"]), str(document["cells_seal"]["sum"])
        except (InputError, LookupError, TypeError, ValueError):
            return None

    # ---------------------------------------------------------------- images

    def _remove_images(self) -> None:
        """Remove the images that the earlier search wrote, and none that others added or changed."""
        if not self.file.exists():
            return
        try:
            # closing() does not commit: nothing is to be written
            with closing(sqlite3.connect(f"file:{quote(os.fsencode(self.file.absolute()))}?mode=ro", uri=True)) as base:
                digests = dict(base.execute("SELECT name, sha256 FROM search_images"))
        except sqlite3.Error:
            return
        for name, digest in digests.items():
            file = self._path_of(name)
            if _digest(file) == digest:
                file.unlink(missing_ok=True)
        with suppress(OSError):
            (self.folder / IMAGES).rmdir()

    def _path_of(self, name: str) -> Path:
        """Return the path of a file beside the store; images of counterexamples have their own folder."""
        file = self.folder / Path(name).name
        return file.parent / IMAGES / file.name if file.suffix == ".npz" else file

    def keep_image(self, name: str, data: bytes) -> None:
        """Write the image of a counterexample, as `keep` does."""
        self.keep(f"{name}.npz", data)

    def keep(self, name: str, data: bytes) -> Path:
        """Write a file and return its path; another file of that name stays, and this one gets another name."""
        file, number = self._path_of(name), 1
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
        stored, expected = self._get("fingerprint"), json.loads(json.dumps(dict(fingerprint)))
        # other keys are those of another command, whose rules have numbers of their own
        comparable = set(stored) == set(expected) or stored.get("ns_abstract") != expected.get("ns_abstract")
        if comparable and (problem := stale(stored, expected)):
            raise InputError(
                f"holds a search {problem}",
                file=self.file,
                field="--resume",
                fix=f"leave it out to search again; {ADVISORY}",
            )
        different = [key for key in {**stored, **expected} if stored.get(key) != expected.get(key)]
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

    def _insert(self, table: str, row: tuple[Any, ...], seal: TableChecksum | None) -> int:
        """Insert a row into ``table``, sealed unless it stands for an open block; return its number."""
        number = self._base.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * len(row))})", row).lastrowid
        if seal is not None:
            seal.add(row)
        return number

    def _put(self, key: str, value: Any) -> None:
        self._base.execute("INSERT OR REPLACE INTO search_state VALUES (?, ?)", (key, json.dumps(value)))

    def _get(self, key: str) -> Any:
        row = self._base.execute("SELECT value FROM search_state WHERE key = ?", (key,)).fetchone()
        return None if row is None else json.loads(row[0])


def _definitions(base: sqlite3.Connection) -> set[tuple[str, str, str]]:
    """Return the tables, indices and other objects that a database defines."""
    rows = base.execute("SELECT type, name, sql FROM sqlite_master WHERE sql IS NOT NULL")
    return {(kind, name, " ".join(text.split())) for kind, name, text in rows}


def _may_pass(error: sqlite3.DatabaseError) -> bool:
    """Return whether an error means that the file is intact but cannot be used now."""
    return isinstance(error, sqlite3.OperationalError) and any(word in str(error) for word in _PASSING)


def _digest(file: Path) -> str | None:
    """Return the SHA-256 digest of a regular file; None for anything else."""
    if not file.is_file() or file.is_symlink():
        return None
    return hashlib.sha256(file.read_bytes()).hexdigest()
