"""Bounds rounded outward to float32."""

from __future__ import annotations

import numpy as np
from numba import njit

from ns_abstract.execution.threads import side_by_side, threads

#: Numbers of a picture from which on threads share them.
_SHARED = 1 << 18


def outward(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``lower`` rounded down and ``upper`` rounded up to float32."""
    return _beside(lower, 1.0), _beside(upper, -1.0)


def _beside(values: np.ndarray, sign: float) -> np.ndarray:
    """Return ``values`` rounded down to float32, or up for ``sign`` -1."""
    values = np.ascontiguousarray(values, np.float64)
    neighbours = np.empty(values.shape, np.float32)
    flat, out = values.reshape(-1), neighbours.reshape(-1)
    count = threads() if flat.size >= _SHARED else 1
    ends = [flat.size * k // count for k in range(count + 1)]
    side_by_side(lambda k: _round_towards(flat[ends[k] : ends[k + 1]], sign, out[ends[k] : ends[k + 1]]), count)
    return neighbours


@njit(cache=True, error_model="numpy", nogil=True)
def _round_towards(values, sign, out):
    """Write to ``out`` [n] the largest float32 numbers with ``sign * out <= sign * values``; ``sign`` is 1 or -1."""
    for q in range(values.size):
        value = sign * values[q]
        nearest = np.float32(value)
        bits = nearest.view(np.int32)
        # numbers of one sign are ordered as their bits are; below 0 comes the first negative number
        down = np.int32(-1) if bits > 0 else np.int32(1)
        start = bits if bits != 0 else np.int32(-2147483648)
        below = np.int32(start + down) if nearest > value else bits
        # the cast gives the two branches one name, which `view` needs to compile
        out[q] = np.float32(sign) * np.int32(below).view(np.float32)
