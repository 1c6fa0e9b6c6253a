"""SHA-256 of files, taken of the bytes that were read, not of a file that replaced them later."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

_recorded: ContextVar[dict[str, str] | None] = ContextVar("recorded", default=None)


@contextmanager
def recorded(digests: dict[str, str]) -> Iterator[None]:
    """Return a context in which the SHA-256 of every small file read goes into ``digests``, by absolute path."""
    token = _recorded.set(digests)
    try:
        yield
    finally:
        _recorded.reset(token)


def record(path: Path, digest: Callable[[], hashlib._Hash]) -> None:
    """Store the SHA-256 of a file's content inside a `recorded` block; ``digest`` is called only there."""
    digests = _recorded.get()
    if digests is not None:
        digests[key(path)] = digest().hexdigest()


def key(path: str | os.PathLike[str]) -> str:
    """Return the absolute path, under which a file's SHA-256 is stored."""
    return os.path.abspath(path)
