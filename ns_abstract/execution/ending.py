"""How work ends before it is finished: by a request that long loops look at, or with the process that asked for it."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from multiprocessing.connection import wait


class AbandonedError(Exception):
    """Work was given up at a `checkpoint`."""


def _never() -> bool:
    return False


_over: ContextVar[Callable[[], bool]] = ContextVar("over", default=_never)


@contextmanager
def abandoning(over: Callable[[], bool]) -> Iterator[None]:
    """Inside the block, work that asks `checkpoint` is given up once ``over`` says so."""
    token = _over.set(over)
    try:
        yield
    finally:
        _over.reset(token)


def is_over() -> bool:
    """Whether the work in hand is to be given up."""
    return _over.get()()


def checkpoint() -> None:
    """Called about once a second by work that can be given up.

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
