"""Shares a kernel's work among threads: each takes the next piece that no other thread has taken."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ns_abstract.execution.threads import side_by_side, threads

#: Gaussians that are taken at once.
CHUNK = 1024


class ThreadShare(NamedTuple):
    """One thread's share of a picture.

    Attributes:
        thread: Its number.
        sequence: [t] numbers of all tiles, those with most work first.
        counter: [1] int64, the number of tiles taken.
    """

    thread: int
    sequence: np.ndarray
    counter: np.ndarray


def run_by_tiles(kernel: Callable[..., object], sequence: np.ndarray, count: int, *arguments: object) -> None:
    """Run ``kernel(share, *arguments)`` in ``count`` threads; each takes the next tile of ``sequence``."""
    counter = np.zeros(1, np.int64)
    side_by_side(lambda thread: kernel(ThreadShare(thread, sequence, counter), *arguments), count)


def run_in_chunks(kernel: Callable[..., object], count: int, *arguments: object) -> None:
    """Run ``kernel(counter, *arguments)`` in as many threads as there is work for.

    The kernel takes chunks of `CHUNK` of the ``count`` Gaussians, numbered by the counter, int64 [1].
    """
    counter = np.zeros(1, np.int64)
    side_by_side(lambda _: kernel(counter, *arguments), max(1, min(threads(), -(-count // CHUNK))))
