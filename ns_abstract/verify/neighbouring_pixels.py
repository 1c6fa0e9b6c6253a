"""Extremes and means of an image over the neighbourhood of each pixel, and shifted images."""

from __future__ import annotations

import numpy as np


def nearby(image: np.ndarray, radius: int) -> tuple[np.ndarray, np.ndarray]:
    """Return least and greatest values [H, W, ...] of an image within ``radius`` pixels along both axes."""
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
    """Return means of an image [H, W, ...] over squares of ``radius`` pixels to each side, edges repeated."""
    for axis in (0, 1):
        padding = [(radius + 1, radius) if k == axis else (0, 0) for k in range(image.ndim)]
        sums = np.cumsum(np.pad(image.astype(np.float64), padding, mode="edge"), axis=axis)
        count = 2 * radius + 1
        ahead = tuple(slice(count, None) if k == axis else slice(None) for k in range(image.ndim))
        behind = tuple(slice(None, -count) if k == axis else slice(None) for k in range(image.ndim))
        image = (sums[ahead] - sums[behind]) / count
    return image


def filled(image: np.ndarray, known: np.ndarray, radius: int, other: float) -> np.ndarray:
    """Return an image [H, W, ...] with NaN replaced by means over ``known`` [H, W] pixels nearby, or by ``other``."""
    weight = known.reshape(*known.shape, *[1] * (image.ndim - 2)).astype(np.float64)
    number, total = smoothed(weight, radius), smoothed(np.where(weight > 0.0, image, 0.0), radius)
    # sums of whole numbers that should be 0 are not quite
    some = number > 0.5 / (2 * radius + 1) ** 2
    mean = np.where(some, total / np.where(some, number, 1.0), other)
    return np.where(np.isnan(image), mean, image)


def best_shift(image: np.ndarray, other: np.ndarray) -> tuple[int, int]:
    """Return rows and columns by which ``image`` [H, W] matches ``other`` [H, W] best, at most half of its size.

    The mean square difference over the common part is least, by Fourier transforms.
    """
    size = tuple(2 * n for n in image.shape)
    inside = np.fft.rfft2(np.ones(image.shape), size)

    def products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.fft.irfft2(np.conj(a) * b, size)

    middle = 0.5 * (image.mean() + other.mean())
    pair = image - middle, other - middle
    first, second = (np.fft.rfft2(part, size) for part in pair)
    squares = [np.fft.rfft2(part**2, size) for part in pair]
    common = products(inside, inside)
    miss = products(squares[0], inside) + products(inside, squares[1]) - 2.0 * products(first, second)
    miss = np.where(common > 0.25 * image.size, miss / np.maximum(common, 1.0), np.inf)
    place = np.unravel_index(int(np.argmin(miss)), miss.shape)
    rows, columns = (int(k) if 2 * k < n else int(k) - n for k, n in zip(place, size, strict=True))
    return rows, columns


def moved(image: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Return an image [H, W, ...] whose pixels show what lay ``motion`` [H, W, 2] columns and rows before them.

    It is linear between pixels; edges are repeated.
    """
    places, weights = [], []
    for axis, step in ((0, motion[..., 1]), (1, motion[..., 0])):
        size = image.shape[axis]
        index = np.arange(size).reshape((-1, 1) if axis == 0 else (1, -1))
        place = np.clip(index - np.nan_to_num(step), 0.0, size - 1.0)
        first = np.minimum(place.astype(np.int64), max(0, size - 2))
        places.append((first, np.minimum(first + 1, size - 1)))
        weights.append((place - first).reshape(*place.shape, *[1] * (image.ndim - 2)).astype(image.dtype))
    (top, bottom), (left, right) = places
    down, across = weights
    above, below = ((1.0 - across) * image[row, left] + across * image[row, right] for row in (top, bottom))
    return (1.0 - down) * above + down * below


def shifted(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Return an image [H, W, ...] moved down and to the right, edges repeated."""
    down, right = (
        np.clip(np.arange(n) - move, 0, n - 1) for n, move in zip(image.shape[:2], (rows, columns), strict=True)
    )
    return image[down[:, None], right[None, :]]
