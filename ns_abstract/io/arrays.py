"""Untrusted NumPy archives (.npz): shapes and types are checked before any array is read."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size, show
from ns_abstract.io.packed import open_zip

_MEMBERS_LIMIT = 10_000
#: Most bytes of a header: a shape, and a record type of some fields.
_HEADER_LIMIT = 10_000
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


class Archive:
    """An open .npz; ``declared``: shape and dtype of every array by name, from the headers alone."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive
        self.declared: dict[str, tuple[tuple[int, ...], np.dtype]] = {}
        members = archive.infolist()
        if len(members) > _MEMBERS_LIMIT:
            raise InputError(f"{len(members):,} members in the archive")
        for member in members:
            name = member.filename.removesuffix(".npy")
            if name == member.filename or name in self.declared:
                raise InputError(f"member {show(member.filename)} stands twice or is no array")
            if member.compress_type not in _METHODS:
                raise InputError(f"array {show(name)} is compressed in a way that numpy does not write")
            self.declared[name] = self._header(member)

    def _header(self, member: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype]:
        """Return the shape and dtype of an array of the archive. Raises InputError if its data have another size."""
        with self._archive.open(member) as stream:
            version = np.lib.format.read_magic(stream)
            if version not in ((1, 0), (2, 0)):
                raise InputError(f"array {show(member.filename)} has format {version}")
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, kind = read(stream, max_header_size=_HEADER_LIMIT)
            begin = stream.tell()
        if kind.hasobject:
            raise InputError(f"array {show(member.filename)} holds Python objects")
        if any(n < 0 for n in shape) or math.prod(shape) * kind.itemsize != member.file_size - begin:
            problem = f"array {show(member.filename)} claims {list(shape)[:8]} of {kind}"
            raise InputError(f"{problem} in {member.file_size - begin:,} bytes")
        return shape, kind

    def read(self, name: str) -> np.ndarray:
        """Return the array ``name``; check its size in ``declared`` first."""
        with self._archive.open(f"{name}.npy") as stream:
            return np.lib.format.read_array(stream, allow_pickle=False, max_header_size=_HEADER_LIMIT)


@contextmanager
def open_archive(path: Path, what: str, fix: str) -> Iterator[Archive]:
    """Open an .npz inside a ``with`` block; any error of reading it becomes an InputError that names the file.

    Raises InputError: the file is absent, not a regular file or damaged, or an array claims more than is stored.
    """
    file_size(path, what)
    try:
        with open_zip(path) as archive:
            yield Archive(archive)
    except InputError as error:
        raise InputError(error.problem, file=error.file or path, field=error.field, fix=error.fix or fix) from None
    except MemoryError:
        raise
    except Exception as error:  # zipfile, zlib and numpy raise many types on damaged files
        problem = f"cannot be read ({type(error).__name__}: {show(str(error))})"
        raise InputError(problem, file=path, fix=fix) from None
