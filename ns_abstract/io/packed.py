"""Contents of packed files, within a limit."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from pathlib import Path

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size

_CHUNK = 1 << 20


def unpacked(path: Path, limit: int) -> Iterator[bytes]:
    """Contents of a .gz file in parts. Raises InputError where it is damaged, or grows past ``limit`` bytes."""
    total = 0
    file_size(path, "file")
    try:
        with gzip.open(path) as stream:
            while part := stream.read(_CHUNK):
                total += len(part)
                if total > limit:
                    problem = f"unpacks to more than {limit:,} bytes"
                    raise InputError(problem, file=path, fix="check that this is the file meant")
                yield part
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"cannot be unpacked: {error}", file=path, fix="copy it again") from None
