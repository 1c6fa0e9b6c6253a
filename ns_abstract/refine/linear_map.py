"""Linear bounds of a whole picture over a box of parameters, from the linear sets of cells (docs/dev/design.md, R7)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ns_abstract.arithmetic.outward import outward
from ns_abstract.arithmetic.rounding import COVER_DOWN, MAP_ROUNDING
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.refine.result import ArrayRecord, Float32Array, Float64Array, Leaves

#: Leaves of a tile that are worked on at once.
_CHUNK = 128


@dataclass(frozen=True, repr=False)
class LinearImage(ArrayRecord):
    """Linear bounds of every picture of a box of parameters.

    With the box's parameters scaled to ``p`` in [-1, 1]^d, every pixel and channel of the picture at ``p`` lies in
    ``[A_lower p + b_lower, A_upper p + b_upper]``, in real numbers; A [H, W, 3, d], b [H, W, 3] float32.
    """

    box: ParameterBox
    A_lower: Float32Array
    b_lower: Float32Array
    A_upper: Float32Array
    b_upper: Float32Array

    def to_torch(self) -> Any:
        """Return a torch module whose images contain every picture of the box.

        ``module(p, e)`` takes parameters [n, d] and slacks [n, 3, H, W] in [-1, 1], and returns ``A p + b + radius *
        e`` [n, 3, H, W]: for every ``p``, the picture there is the image of some ``e`` (R7). This holds in real
        arithmetic; a float32 evaluation of the module errs as that of any layer.
        """
        from ns_abstract.refine.torch_image import LinearRenderer

        return LinearRenderer(*self.middle())

    def middle(self) -> tuple[Float32Array, Float32Array, Float32Array]:
        """Return A [H, W, 3, d], b, radius [H, W, 3] float32 with ``|picture - (A p + b)| <= radius`` (R7)."""
        lower, upper = self.A_lower.astype(np.float64), self.A_upper.astype(np.float64)
        slope = (0.5 * (lower + upper)).astype(np.float32)
        low = self.b_lower - np.abs(lower - slope).sum(axis=-1)
        high = self.b_upper + np.abs(upper - slope).sum(axis=-1)
        offset = (0.5 * (low + high)).astype(np.float32)
        size = np.abs(self.b_lower) + np.abs(self.b_upper) + (np.abs(lower) + np.abs(upper)).sum(axis=-1)
        radius = np.maximum(high - offset, offset - low) + MAP_ROUNDING * size.astype(np.float64)
        return slope, offset, outward(radius, radius)[1]


@dataclass(frozen=True)
class _Part:
    """The intersection of one leaf with a box, along each axis; all numbers [d], at most 1 in size.

    Attributes:
        scale, shift: On the intersection, the leaf's own parameters are ``shift + scale * t``, t in [-1, 1]^d.
    """

    scale: Float64Array
    shift: Float64Array
    box_scale: Float64Array
    box_shift: Float64Array


def _affine(low: Float64Array, high: Float64Array, start: Float64Array, end: Float64Array) -> tuple[Float64Array, ...]:
    """Return scale and shift of [start, end] within [low, high] as [-1, 1]: six roundings of numbers up to 1 (R7)."""
    width = end - start
    divisor = np.where(width > 0.0, width, 1.0)
    return (high - low) / divisor, ((low - start) + (high - end)) / divisor


def _common_parts(leaves: Leaves, rows: np.ndarray, box: ParameterBox) -> tuple[np.ndarray, _Part]:
    """Return those of ``rows`` that meet the box, and the intersections: arrays [n, d]."""
    start, end = leaves.box_lower[rows], leaves.box_upper[rows]
    box_start, box_end = np.array(box.lower, np.float64), np.array(box.upper, np.float64)
    low, high = np.maximum(start, box_start), np.minimum(end, box_end)
    meets = (low <= high).all(axis=1)
    low, high, start, end = low[meets], high[meets], start[meets], end[meets]
    scale, shift = _affine(low, high, start, end)
    box_scale, box_shift = _affine(low, high, box_start, box_end)
    return rows[meets], _Part(scale, shift, box_scale, box_shift)


def _covers_box(part: _Part, box: ParameterBox) -> bool:
    """Return whether the leaves cover the box."""
    varied = np.array(box.lower) < np.array(box.upper)
    return bool(part.box_scale[:, varied].prod(axis=1).sum() >= COVER_DOWN)


def _chunks(count: int) -> Iterator[slice]:
    return (slice(k, k + _CHUNK) for k in range(0, count, _CHUNK))


def _fitted_slope(A: np.ndarray, b: np.ndarray, rows: np.ndarray, part: _Part, varied: np.ndarray) -> np.ndarray:
    """Return slopes [side, side, 3, d] of the least-squares plane through leaves' planes; any slopes are sound."""
    total = np.zeros(A.shape[1:], np.float64)
    shares = part.box_scale[:, varied].prod(axis=1)
    for some in _chunks(len(rows)):
        slopes, shift = A[rows[some]].astype(np.float64), part.shift[some][:, None, None, None]
        middle = b[rows[some]] + (slopes * shift).sum(axis=-1)
        radius, place, share = part.box_scale[some], part.box_shift[some], shares[some]
        total += np.einsum("nijc,nk->ijck", middle, 3.0 * share[:, None] * place)
        total += np.einsum("nijck,nk->ijck", slopes, share[:, None] * radius * part.scale[some])
    return np.where(varied, total, 0.0).astype(np.float32)


def _offset_below(
    A: np.ndarray, b: np.ndarray, rows: np.ndarray, part: _Part, slope: np.ndarray, sign: float
) -> np.ndarray:
    """Return offsets [side, side, 3] with which ``slope`` stays below every leaf's plane, times ``sign`` (R7)."""
    least = np.full(b.shape[1:], np.inf)
    plane = sign * slope.astype(np.float64)
    for some in _chunks(len(rows)):
        slopes, offsets = sign * A[rows[some]].astype(np.float64), sign * b[rows[some]].astype(np.float64)
        scale, shift, box_scale, box_shift = (
            values[some][:, None, None, None] for values in (part.scale, part.shift, part.box_scale, part.box_shift)
        )
        turn = np.abs(slopes * scale - plane * box_scale).sum(axis=-1)
        value = offsets + (slopes * shift).sum(axis=-1) - (plane * box_shift).sum(axis=-1) - turn
        size = np.abs(offsets) + 2.0 * (np.abs(slopes) + np.abs(plane)).sum(axis=-1)
        least = np.minimum(least, (value - MAP_ROUNDING * size).min(axis=0))
    return least


def _by_tile(leaves: Leaves) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield first row and column of every tile, and its leaves."""
    tiles, group = np.unique(leaves.tile, axis=0, return_inverse=True)
    order = np.argsort(group.reshape(-1), kind="stable")
    ends = np.cumsum(np.bincount(group.reshape(-1), minlength=len(tiles)))
    for (row, column), rows in zip(tiles.tolist(), np.split(order, ends[:-1]), strict=True):
        yield row, column, rows


def linear_image(leaves: Leaves, lower: Float32Array, upper: Float32Array, box: ParameterBox) -> LinearImage:
    """Return one linear map of the whole picture over ``box``, a part of the set (R7).

    ``lower``, ``upper`` [H, W, 3] hold on the whole set; they are used where no plane is tighter on average, and where
    leaves do not cover the box.
    """
    varied = np.array(box.lower) < np.array(box.upper)
    slopes = [np.zeros((*lower.shape, box.dimensions), np.float32) for _ in range(2)]
    offsets = [lower.copy(), upper.copy()]
    for row, column, tile_rows in _by_tile(leaves):
        rows, part = _common_parts(leaves, tile_rows, box)
        if not _covers_box(part, box):
            continue
        for k, (A, b, sign) in enumerate(
            ((leaves.A_lower, leaves.b_lower, 1.0), (leaves.A_upper, leaves.b_upper, -1.0))
        ):
            plane = _fitted_slope(A, b, rows, part, varied)
            for slope in (plane, np.zeros_like(plane)):
                least = _offset_below(A, b, rows, part, slope, sign)
                offset = sign * outward(least, least)[0]
                pixels = slopes[k][row : row + b.shape[1], column : column + b.shape[2]]
                height, width = pixels.shape[:2]
                values = offsets[k][row : row + height, column : column + width]
                # scaled parameters have the mean 0: the offset is the plane's mean over the box
                better = sign * offset[:height, :width] > sign * values
                values[better] = offset[:height, :width][better]
                pixels[better] = slope[:height, :width][better]
    return LinearImage(box, slopes[0], offsets[0], slopes[1], offsets[1])


def bounds_at(
    leaves: Leaves | None, lower: Float32Array, upper: Float32Array, point: Float64Array
) -> tuple[Float32Array, Float32Array]:
    """Return bounds [H, W, 3] float32 of the picture at a point of the set, from the leaves that contain it (R7)."""
    low, high = lower.copy(), upper.copy()
    if leaves is None:
        return low, high
    holds = ((leaves.box_lower <= point) & (point <= leaves.box_upper)).all(axis=1)
    for n in np.flatnonzero(holds):
        _, place = _affine(point, point, leaves.box_lower[n], leaves.box_upper[n])
        row, column = leaves.tile[n]
        for A, b, sign, bound in (
            (leaves.A_lower, leaves.b_lower, 1.0, low),
            (leaves.A_upper, leaves.b_upper, -1.0, high),
        ):
            slope, offset = sign * A[n].astype(np.float64), sign * b[n].astype(np.float64)
            size = np.abs(offset) + 2.0 * np.abs(slope).sum(axis=-1)
            value = offset + (slope * place).sum(axis=-1) - MAP_ROUNDING * size
            rounded = sign * outward(value, value)[0]
            pixels = bound[row : row + rounded.shape[0], column : column + rounded.shape[1]]
            rounded = rounded[: pixels.shape[0], : pixels.shape[1]]
            np.copyto(pixels, np.maximum(sign * pixels, sign * rounded) * np.float32(sign))
    return low, high
