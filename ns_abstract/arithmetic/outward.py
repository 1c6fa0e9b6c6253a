"""Bounds in single precision."""

from __future__ import annotations

import numpy as np
from numba import njit


def outward(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Float32 neighbours of ``lower`` from below and ``upper`` from above."""
    return _below(lower), -_below(-upper)


def _below(values: np.ndarray) -> np.ndarray:
    """The largest float32 numbers that are not above ``values``."""
    values = np.ascontiguousarray(values, np.float64)
    nearest = values.astype(np.float32)
    flat = nearest.reshape(-1)
    _step_down(values.reshape(-1), flat, flat.view(np.int32))
    return nearest


@njit(cache=True, error_model="numpy")
def _step_down(values, nearest, bits):
    """Replace each of ``nearest`` that is above its value by the number below; ``bits`` is the same memory."""
    for q in range(values.size):
        # numbers of one sign are ordered as their bits are; below 0 comes the first negative number
        down = np.int32(-1) if bits[q] > 0 else np.int32(1)
        start = bits[q] if bits[q] != 0 else np.int32(-2147483648)
        bits[q] = start + down if nearest[q] > values[q] else bits[q]
