"""Ends and means of an image over the neighbourhood of each pixel."""

from __future__ import annotations

import numpy as np


def nearby(image: np.ndarray, radius: int) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest values [H, W, ...] of an image within so many pixels along both axes."""
    least, most = image.copy(), image.copy()
    for axis in (0, 1):
        low, high = least.copy(), most.copy()
        for step in range(1, min(radius, image.shape[axis] - 1) + 1):
            ahead = tuple(slice(step, None) if k == axis else slice(None) for k in range(image.ndim))
            behind = tuple(slice(None, -step) if k == axis else slice(None) for k in range(image.ndim))
            for here, there in ((ahead, behind), (behind, ahead)):
                low[here] = np.minimum(low[here], least[there])
                high[here] = np.maximum(high[here], most[there])
        least, most = low, high
    return least, most


def smoothed(image: np.ndarray, radius: int) -> np.ndarray:
    """Means of an image [H, W, ...] over squares of so many pixels to every side, repeated beyond its edges."""
    for axis in (0, 1):
        padding = [(radius + 1, radius) if k == axis else (0, 0) for k in range(image.ndim)]
        sums = np.cumsum(np.pad(image.astype(np.float64), padding, mode="edge"), axis=axis)
        count = 2 * radius + 1
        ahead = tuple(slice(count, None) if k == axis else slice(None) for k in range(image.ndim))
        behind = tuple(slice(None, -count) if k == axis else slice(None) for k in range(image.ndim))
        image = (sums[ahead] - sums[behind]) / count
    return image
