"""8-bit pictures, as files and cameras store them: rounding, and enclosures after rounding (design.md, V10)."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ns_abstract.arithmetic.network_charges import QUOTIENT, STEP
from ns_abstract.verify.picture_sets import flatter_where_better

#: What a network is shown: the renderer's floats, or these rounded to multiples of 1/255.
Picture = Literal["float", "8-bit"]

_STEPS = 255.0


def rounded(image: np.ndarray) -> np.ndarray:
    """Return ``round(255 x) / 255`` of pictures in [0, 1], float32 of the same shape; x is clipped first."""
    levels = np.rint(np.clip(np.asarray(image, np.float32), 0.0, 1.0) * np.float32(_STEPS))
    return (levels / np.float32(_STEPS)).astype(np.float32)


def rounded_sets(
    linear: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], lower: np.ndarray, upper: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
    """Return sets that contain the rounded pictures of those in ``linear``, ``lower`` and ``upper`` (V10).

    Any program is enclosed that computes 255 x + 1/2 with two roundings and truncates, or rounds to the nearest whole
    number. Linear sets keep their slopes and are half a step wider on each side; where the constant bound is tighter at
    the middle of the cell, it is taken. All are float32, rounded outward: A_lower [..., d], b_lower [...], A_upper,
    b_upper; lower, upper [...].
    """
    low, high = (np.clip(np.asarray(bound, np.float64), 0.0, 1.0) * _STEPS for bound in (lower, upper))
    least = np.maximum(np.ceil(low - 0.5 - STEP), 0.0) / _STEPS * (1.0 - QUOTIENT)
    most = np.minimum(np.floor(high + 0.5 + STEP), _STEPS) / _STEPS * (1.0 + QUOTIENT)
    # rounding must not hide what is wrong: bounds that cross are no numbers afterwards
    least = np.where(lower <= upper, least, np.nan)
    a_lower, b_lower, a_upper, b_upper = linear
    half = (0.5 + STEP) / _STEPS + QUOTIENT
    below, above = np.asarray(b_lower, np.float64) - half, np.asarray(b_upper, np.float64) + half
    slopes = np.asarray(a_lower, np.float32), np.asarray(a_upper, np.float32)
    return flatter_where_better(slopes, (below, above), least, most)
