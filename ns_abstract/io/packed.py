"""Contents of packed files, within a limit."""

from __future__ import annotations

import gzip
import hashlib
import io
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from ns_abstract.io.digests import record
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size

_CHUNK = 1 << 20


class _Read(io.RawIOBase):
    """A file whose content is recorded once it was read to its end."""

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self._file, self._path, self._digest = file, path, hashlib.sha256()

    def read(self, size: int = -1, /) -> bytes:
        data = self._file.read(size)
        self._digest.update(data)
        if not data:
            record(self._path, lambda: self._digest)
        return data


def unpacked(path: Path, limit: int) -> Iterator[bytes]:
    """Contents of a .gz file in parts. Raises InputError where it is damaged, or grows past ``limit`` bytes."""
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
