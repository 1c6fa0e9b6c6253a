"""Cancellation: long work checks whether it was cancelled, and worker processes end with their parent."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from multiprocessing.connection import wait


class AbandonedError(Exception):
    """Raised by `checkpoint` when the work was cancelled."""


def _never() -> bool:
    return False


_over: ContextVar[Callable[[], bool]] = ContextVar("over", default=_never)


@contextmanager
def abandoning(over: Callable[[], bool]) -> Iterator[None]:
    """Cancel work inside the block, at its next `checkpoint`, once ``over`` returns True."""
    token = _over.set(over)
    try:
        yield
    finally:
        _over.reset(token)


def is_over() -> bool:
    """Return whether the current work is cancelled."""
    return _over.get()()


def checkpoint() -> None:
    """Raise `AbandonedError` if the current work is cancelled; long loops call it about once a second.

    Raises:
        AbandonedError: It is given up.
    """
    if is_over():
        raise AbandonedError


def end_with_parent() -> None:
    """End this process when the one that started it has ended, whatever it is doing."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    sentinel = parent.sentinel

    def watch() -> None:
        wait([sentinel])
        os._exit(1)

    threading.Thread(target=watch, name="end with parent", daemon=True).start()
