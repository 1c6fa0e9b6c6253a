"""SHA-256 of files as they were read: a file that is replaced afterwards does not lend its own to what was read."""

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
    """Inside, the SHA-256 of every small file that is read goes into ``digests``, by absolute path."""
    token = _recorded.set(digests)
    try:
        yield
    finally:
        _recorded.reset(token)


def record(path: Path, digest: Callable[[], hashlib._Hash]) -> None:
    """Note what was read from a file; ``digest``: SHA-256 of it, asked for where it is recorded."""
    digests = _recorded.get()
    if digests is not None:
        digests[key(path)] = digest().hexdigest()


def key(path: str | os.PathLike[str]) -> str:
    """What a file is recorded under."""
    return os.path.abspath(path)
