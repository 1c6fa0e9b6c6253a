"""Threads of this process that share a cell or a picture; compiled kernels let go of the interpreter meanwhile.

numba's own parallel loops would have each kernel compiled four times: for the type that they count by, in the loop's
body and around it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache


@dataclass
class _Setting:
    """How many threads were asked for; None: as many as there may be."""

    count: int | None = None


_setting = _Setting()


def _most() -> int:
    """As numba sees it: the cores, or fewer by the variable NUMBA_NUM_THREADS."""
    import numba

    return numba.config.NUMBA_NUM_THREADS  # pyright: ignore[reportPrivateImportUsage, reportAttributeAccessIssue]


def threads() -> int:
    """How many work side by side."""
    most = _most()
    return most if _setting.count is None else max(1, min(_setting.count, most))


def use_threads(count: int) -> None:
    """Let ``count`` threads work side by side from now on, at most NUMBA_NUM_THREADS and at least one."""
    _setting.count = count


@lru_cache(maxsize=1)
def _pool(process: int) -> ThreadPoolExecutor:
    """Those of one process: a fork has none."""
    return ThreadPoolExecutor(max(1, _most() - 1), "kernels")


def side_by_side(work: Callable[[int], object], count: int) -> None:
    """Call ``work`` with 0 .. ``count`` - 1, the first in this thread and the others beside it, and wait for all."""
    others = [_pool(os.getpid()).submit(work, number) for number in range(1, count)]
    work(0)
    for other in others:
        other.result()
