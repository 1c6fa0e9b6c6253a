"""Stamps that identify files by name, size and SHA-256."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size

#: Bytes that are read at a time.
_CHUNK = 2**20


def file_stamp(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the identity of a file by content: ``name``, ``bytes`` and ``sha256``; a moved file keeps it.

    Raises InputError: the file is absent or cannot be read.
    """
    path = Path(path)
    size = file_size(path, "file")
    digest = hashlib.sha256()
    try:
        with path.open("rb") as stream:
            while chunk := stream.read(_CHUNK):
                digest.update(chunk)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", file=path, fix="check the permissions") from None
    return {"name": path.name, "bytes": size, "sha256": digest.hexdigest()}
