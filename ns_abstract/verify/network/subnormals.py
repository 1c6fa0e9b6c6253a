"""Keeps subnormal numbers in the package's own arithmetic, whatever mode the calling program has set (N2, N21)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from ns_abstract.arithmetic.network_charges import FLUSH
from ns_abstract.io.errors import InputError

#: Numbers of an operation that torch gives to one thread.
_BY_THREAD = 1 << 15


def _flushed() -> bool:
    """Return whether this thread flushes subnormal numbers to zero, as results or as operands."""
    tiny = np.float32(FLUSH)
    half = tiny * np.float32(0.5)
    return bool(half + half != tiny)


def _flushed_by_workers() -> bool:
    """Return whether one of torch's worker threads flushes subnormal numbers to zero."""
    count = torch.get_num_threads()
    return count > 1 and bool((torch.full((count * _BY_THREAD,), FLUSH) * 0.5 == 0.0).any())


@contextmanager
def subnormals_kept() -> Iterator[None]:
    """Keep subnormal numbers in a block or function: numbers are moved outward to their neighbours there.

    Raises:
        InputError: Torch's worker threads flush them.
    """
    flushed = _flushed()
    if flushed:
        torch.set_flush_denormal(False)
    try:
        if _flushed() or _flushed_by_workers():
            raise InputError(
                "this process flushes subnormal numbers to zero, and bounds would be wrong",
                fix="call torch.set_flush_denormal(True) after bounding, or torch.set_num_threads(1) before it",
            )
        yield
    finally:
        if flushed:
            torch.set_flush_denormal(True)
