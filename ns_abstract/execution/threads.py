"""Threads of this process that share the work on one cell or picture; compiled kernels release the GIL."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextvars import ContextVar, copy_context
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, TypeVar

T = TypeVar("T")
R = TypeVar("R")


@dataclass
class _Setting:
    """The requested number of threads; None: as many as there are."""

    count: int | None = None


_setting = _Setting()


class _ThreadGroup(NamedTuple):
    """One of several calls that run side by side: its number, and the threads that it owns."""

    number: int
    threads: int


_group: ContextVar[_ThreadGroup | None] = ContextVar("thread group", default=None)


def most_threads() -> int:
    """Return the largest number of threads: the cores, or fewer by the variable NUMBA_NUM_THREADS."""
    import numba

    return numba.config.NUMBA_NUM_THREADS  # pyright: ignore[reportPrivateImportUsage, reportAttributeAccessIssue]


def thread_group() -> int:
    """Return the number of the calling group among those of `each`; 0 outside of one."""
    current = _group.get()
    return 0 if current is None else current.number


def threads() -> int:
    """Return the number of threads that the calling group may use side by side."""
    current = _group.get()
    if current is not None:
        return current.threads
    most = most_threads()
    return most if _setting.count is None else max(1, min(_setting.count, most))


def use_threads(count: int) -> None:
    """Set the number of threads from now on, at least one and at most NUMBA_NUM_THREADS."""
    _setting.count = count


@lru_cache(maxsize=1)
def _pool(process: int) -> ThreadPoolExecutor:
    """Return the thread pool of the process with this number, as a fork cannot use its parent's."""
    return ThreadPoolExecutor(max(1, most_threads() - 1), "kernels")


def side_by_side(work: Callable[[int], object], count: int) -> None:
    """Call ``work`` with 0 .. ``count`` - 1 side by side, the first in this thread, in copies of its context."""
    others: list[Future[object]] = []
    try:
        others = [_pool(os.getpid()).submit(copy_context().run, work, number) for number in range(1, count)]
        copy_context().run(work, 0)
    finally:
        # whatever ended this one: they write into memory that is used again
        wait(others)
    for other in others:
        other.result()


def each(work: Callable[[T], R], items: Sequence[T]) -> list[R]:
    """Return ``work`` of every item, computed side by side in groups that share the threads.

    Raises:
        Exception: What ``work`` raised for the first item for which it raised; all others have ended.
    """
    mine = threads()
    groups = min(mine, len(items))
    if groups < 2:
        return [work(item) for item in items]
    results: dict[int, R] = {}
    raised: dict[int, Exception] = {}
    turns = itertools.count()

    def run(number: int) -> None:
        _group.set(_ThreadGroup(number, mine // groups))
        while not raised and (turn := next(turns)) < len(items):
            try:
                results[turn] = work(items[turn])
            except Exception as error:
                raised[turn] = error

    side_by_side(run, groups)
    if raised:
        raise raised[min(raised)]
    return [results[turn] for turn in range(len(items))]
