"""Cancellation: long work checks whether it is cancelled, and worker processes end with their parent."""

from __future__ import annotations

import math
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from multiprocessing.connection import wait


class WorkCancelledError(Exception):
    """Raised by `check_cancelled` when the work was cancelled."""


def _never() -> bool:
    return False


_cancelled: ContextVar[Callable[[], bool]] = ContextVar("cancelled", default=_never)


class Deadline:
    """The end of some work: a time, or an earlier request to stop. Calling it returns whether the work has to end now.

    Args:
        seconds: From now on; infinite: there is no time limit.
        request: Returns whether to stop early, such as `ns_abstract.execution.stopping.StopRequest` after a signal.
    """

    def __init__(self, seconds: float = math.inf, request: Callable[[], bool] = _never) -> None:
        self.end, self.request = time.perf_counter() + seconds, request

    def __call__(self) -> bool:
        return self.request() or self.late

    @property
    def late(self) -> bool:
        """Return whether the time is over."""
        return time.perf_counter() >= self.end

    @property
    def left(self) -> float:
        """Seconds until the time is over; negative afterwards."""
        return self.end - time.perf_counter()

    def within(self, seconds: float) -> Deadline:
        """Return a deadline with the same request, and at most ``seconds`` from now on."""
        return Deadline(min(seconds, self.left), self.request)

    def before(self, seconds: float) -> Deadline:
        """Return a deadline with the same request, ``seconds`` earlier."""
        return Deadline(self.left - seconds, self.request)

    def extended(self, seconds: float) -> Deadline:
        """Return a deadline with the same request, ``seconds`` later."""
        return Deadline(self.left + seconds, self.request)

    @contextmanager
    def enforced(self) -> Iterator[None]:
        """Cancel work inside the block once the deadline is reached (`cancel_when`)."""
        with cancel_when(self):
            yield


@contextmanager
def cancel_when(over: Callable[[], bool]) -> Iterator[None]:
    """Cancel work inside the block, at its next `check_cancelled`, once ``over`` returns True."""
    token = _cancelled.set(over)
    try:
        yield
    finally:
        _cancelled.reset(token)


def is_cancelled() -> bool:
    """Return whether the current work is cancelled."""
    return _cancelled.get()()


def check_cancelled() -> None:
    """Raise `WorkCancelledError` if the current work is cancelled; long loops call it about once a second."""
    if is_cancelled():
        raise WorkCancelledError


def end_with_parent() -> None:
    """Let this process end as soon as its parent process has ended, whatever it is doing."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    sentinel = parent.sentinel

    def watch() -> None:
        wait([sentinel])
        os._exit(1)

    threading.Thread(target=watch, name="end with parent", daemon=True).start()
