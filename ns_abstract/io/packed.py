"""Readers of .gz files and zip archives that limit the memory that a file can claim."""

from __future__ import annotations

import gzip
import hashlib
import io
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from ns_abstract.io.digests import record
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size

_CHUNK = 1 << 20
#: Bytes that the list of an archive's members may take: Python's objects of it take ten times as much.
_LIST_LIMIT = 16 << 20


class _Read(io.RawIOBase):
    """A binary stream that records the SHA-256 of the file (`digests.record`) at its end."""

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self._file, self._path, self._digest = file, path, hashlib.sha256()

    def read(self, size: int = -1, /) -> bytes:
        data = self._file.read(size)
        self._digest.update(data)
        if not data:
            record(self._path, lambda: self._digest)
        return data


def unpacked(path: Path, limit: int) -> Iterator[bytes]:
    """Return contents of a .gz file in parts. Raises InputError where it is damaged, or grows past ``limit`` bytes."""
    total = 0
    file_size(path, "file")
    try:
        with path.open("rb") as file, gzip.GzipFile(fileobj=_Read(file, path)) as stream:
            while part := stream.read(_CHUNK):
                total += len(part)
                if total > limit:
                    problem = f"unpacks to more than {limit:,} bytes"
                    raise InputError(problem, file=path, fix="check that this is the file meant")
                yield part
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"cannot be unpacked: {error}", file=path, fix="copy it again") from None


class _LimitedReader(io.BufferedReader):
    """A file of which not more than ``limit`` bytes are read at once."""

    limit: int | None = _LIST_LIMIT

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._path, self._size = path, path.stat().st_size

    def read(self, size: int | None = -1, /) -> bytes:
        wanted = size if size is not None and size >= 0 else self._size - self.tell()
        if self.limit is not None and wanted > self.limit:
            problem = f"an archive whose list of members takes {wanted:,} bytes, more than {self.limit:,}"
            raise InputError(problem, file=self._path, fix="check that this is the file meant")
        return super().read(size)


@contextmanager
def open_zip(path: Path) -> Iterator[zipfile.ZipFile]:
    """Return a zip archive, open inside the block.

    Raises InputError where its list of members, which zipfile reads whole, is too long. Raises what zipfile raises of
    damaged files.
    """
    with _LimitedReader(path) as stream, zipfile.ZipFile(stream) as archive:
        stream.limit = None
        yield archive
