"""The result of refining one frame: abstract image, inner (sampled) bounds, and trace (design.md, R6)."""

from __future__ import annotations

import bisect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ns_abstract.execution.threads import each
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.tiles import assemble, tile_grid

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]

#: Pixels whose gaps one thread computes at once.
_AT_ONCE = 1 << 15


class ArrayRecord:
    """A record of arrays whose text has their shapes and types in place of their numbers."""

    def __repr__(self) -> str:
        texts = []
        for entry in fields(self):  # pyright: ignore[reportArgumentType]
            value = getattr(self, entry.name)
            if entry.repr:
                text = f"{value.dtype}{list(value.shape)}" if isinstance(value, np.ndarray) else repr(value)
                texts.append(f"{entry.name}={text}")
        return f"{type(self).__name__}({', '.join(texts)})"


@dataclass(frozen=True)
class TracePoint:
    """The state after ``seconds`` of work on a frame and ``cells`` bounded cells.

    ``covered`` is the fraction of the set that the cells cover; while it is below 1, only [0, 1] holds, and ``mpg`` is
    that of [0, 1].
    """

    seconds: float
    cells: int
    mpg: float
    mpg_witness: float
    covered: float = 1.0


@dataclass(frozen=True, repr=False)
class Leaves(ArrayRecord):
    """Linear sets of the leaf cells of one frame, one row per (cell, tile).

    With the parameters of a leaf's box, ends [L, d], scaled to ``p`` in [-1, 1]^d, every pixel and channel of every
    image of the set lies in ``[A_lower p + b_lower, A_upper p + b_upper]``, [L, side, side, 3, d] and [L, side, side,
    3] float32. ``tile`` [L, 2] is the first row and column of the tile's pixels.
    """

    box_lower: Float64Array
    box_upper: Float64Array
    tile: NDArray[np.int32]
    A_lower: Float32Array
    b_lower: Float32Array
    A_upper: Float32Array
    b_upper: Float32Array


@dataclass(frozen=True, repr=False)
class ExtraOutput(ArrayRecord):
    """A further output (depth, accumulation): bounds, sampled bounds and one render, [H, W] float32 each.

    The accumulation is the sum of the blending weights, in [0, 1]. The expected depth is the mean of the depths along
    the viewing axis, in units of the normalised frame, weighted as the colours are (gsplat's RGB+ED); where nothing is
    drawn, it is the largest one of the picture. An upper bound of infinity means that none is known.
    """

    lower: Float32Array
    upper: Float32Array
    witness_lower: Float32Array
    witness_upper: Float32Array
    image: Float32Array

    def mean_gap(self) -> float:
        """Return the mean of ``upper - lower`` over the pixels."""
        return float((self.upper.astype(np.float64) - self.lower).mean())

    def mean_gap_witness(self) -> float:
        """Return the mean of ``witness_upper - witness_lower`` over the pixels."""
        return float((self.witness_upper.astype(np.float64) - self.witness_lower).mean())


#: Arrays of a `ExtraOutput`.
EXTRA_OUTPUT_ARRAYS = tuple(ExtraOutput.__dataclass_fields__)
#: What may be bounded beside the colours.
EXTRA_OUTPUTS = ("depth", "accumulation")


class RenderedMaximum(NamedTuple):
    """The largest value of rendered pictures, over all pixels and channels, and the pose [d] that shows it."""

    value: float
    pose: tuple[float, ...]


def greater(*maxima: RenderedMaximum | None) -> RenderedMaximum | None:
    """Return the first of the greatest ``maxima``; None without any."""
    return max((m for m in maxima if m is not None), key=lambda m: m.value, default=None)


@dataclass(frozen=True, repr=False)
class SampleImages(ArrayRecord):
    """Renders [n, H, W, 3] float32 at parameter values [n, d]; of a group of tiles in tiles."""

    values: Float64Array
    images: Float32Array


@dataclass(frozen=True, repr=False)
class AbstractPicture(ArrayRecord):
    """The abstract image of a frame [H, W, 3], or of some tiles of it [t, side, side, 3], float32.

    Attributes:
        lower, upper: Enclose every image of the set, after background and clamp to [0, 1].
        witness_lower, witness_upper: Least and largest rendered values.
        image: One render, at the middle of the box.
        bounded: False while no bound but [0, 1] is known (the budget ended first).
        leaves: The leaf cells' linear sets, if they were requested.
        layers: Further outputs by name, of `EXTRA_OUTPUTS`.
        views: Renders across the set, where leaves are kept.
        problems: Failed self-checks of the arithmetic of a process that bounded some of it; there is no guarantee then.
        largest: If a largest value was searched for: the largest one rendered, and its parameter values [d].
    """

    index: int
    box: ParameterBox
    lower: Float32Array
    upper: Float32Array
    witness_lower: Float32Array
    witness_upper: Float32Array
    image: Float32Array
    seconds: float
    cells: int
    trace: tuple[TracePoint, ...] = field(default=(), repr=False)
    bounded: bool = True
    leaves: Leaves | None = field(default=None, repr=False)
    layers: Mapping[str, ExtraOutput] = field(default_factory=dict, repr=False)
    views: SampleImages | None = field(default=None, repr=False)
    problems: tuple[str, ...] = ()
    largest: RenderedMaximum | None = None


@dataclass(frozen=True, repr=False)
class FrameResult(AbstractPicture):
    """One frame's abstract image; ``plan``: sentences on what was left out for this frame and why."""

    plan: tuple[str, ...] = ()


@dataclass(frozen=True, repr=False, kw_only=True)
class PartResult(AbstractPicture):
    """Some tiles of a frame's abstract image; depths only where something is drawn, as in a `Frame`.

    Attributes:
        pixels: Number of the tiles' pixels that belong to the image, over which the trace's measures are taken.
        shown: Scene elements that some cell shows in these tiles, or None.
        floor: Light up to this amount was left out of the initial cells; 0: none was.
    """

    tiles: NDArray[np.int64]
    pixels: int
    shown: NDArray[np.int64] | None
    floor: float = 0.0


#: Of a part that has no point yet: [0, 1] everywhere.
_NOTHING = TracePoint(0.0, 0, math.sqrt(3.0), 0.0, 0.0)


def joined(parts: Sequence[PartResult], camera: Any) -> FrameResult:
    """Return the frame whose tiles are divided among ``parts``: cells are added up, its time is the longest.

    Raises:
        ValueError: The parts are of different frames, or a tile is missing or there twice.
    """
    first = parts[0]
    side = first.lower.shape[1]
    across, down = tile_grid(camera, side)
    tiles = np.concatenate([part.tiles for part in parts])
    if not np.array_equal(np.sort(tiles), np.arange(across * down)):
        raise ValueError(f"frame {first.index}: tiles are missing or there twice")
    if any((part.index, part.box) != (first.index, first.box) for part in parts):
        raise ValueError(f"parts of frame {first.index} and of another set")
    order = np.argsort(tiles)

    def whole(name: str) -> np.ndarray:
        return assemble(np.concatenate([getattr(part, name) for part in parts])[order], camera)

    layers: dict[str, ExtraOutput] = {}
    for name in first.layers:
        part_layers = [part.layers[name] for part in parts]
        arrays = (
            np.concatenate([getattr(layer, array) for layer in part_layers])[order] for array in EXTRA_OUTPUT_ARRAYS
        )
        layers[name] = ExtraOutput(*(assemble(array, camera) for array in arrays))
    if layers:
        layers["depth"] = _whole_depth(layers["depth"], layers["accumulation"])
    bounded = all(part.bounded for part in parts)
    return FrameResult(
        index=first.index,
        box=first.box,
        lower=whole("lower"),
        upper=whole("upper"),
        witness_lower=whole("witness_lower"),
        witness_upper=whole("witness_upper"),
        image=whole("image"),
        seconds=max(part.seconds for part in parts),
        cells=sum(part.cells for part in parts),
        trace=_joined_trace(parts),
        bounded=bounded,
        leaves=_joined_leaves([part.leaves for part in parts]) if bounded else None,
        layers=layers,
        views=_joined_views([part.views for part in parts], order, camera) if bounded else None,
        problems=tuple(dict.fromkeys(problem for part in parts for problem in part.problems)),
        largest=greater(*(part.largest for part in parts)),
    )


def _whole_depth(depth: ExtraOutput, accumulation: ExtraOutput) -> ExtraOutput:
    """Return the expected depth [H, W], where nothing is drawn the largest one of the picture (design.md, D4)."""
    never, perhaps = depth.lower > depth.upper, ~(accumulation.lower > 0.0)
    # of every picture of the set, the largest depth lies between these
    most = np.where(never, 0.0, depth.upper).max(initial=0.0)
    least = np.where(perhaps | never, 0.0, depth.lower).max(initial=0.0)
    lower = np.where(never, least, np.where(perhaps, np.minimum(depth.lower, least), depth.lower))
    upper = np.where(never, most, np.where(perhaps, np.maximum(depth.upper, most), depth.upper))
    # of the render at the middle all is known; of others, perhaps some tiles
    empty = np.isnan(depth.image)
    farthest = np.where(empty, 0.0, depth.image).max(initial=0.0)
    image = np.where(empty, farthest, depth.image)
    low = np.where(empty, np.minimum(depth.witness_lower, farthest), depth.witness_lower)
    high = np.where(empty, np.maximum(depth.witness_upper, farthest), depth.witness_upper)
    return ExtraOutput(*(array.astype(np.float32) for array in (lower, upper, low, high, image)))


def _joined_trace(parts: Sequence[PartResult]) -> tuple[TracePoint, ...]:
    """Return the trace of sums of cells and means by pixels, with a point for each point of a part."""
    if len(parts) == 1:
        return parts[0].trace
    times = [[point.seconds for point in part.trace] for part in parts]
    weights = [part.pixels / sum(p.pixels for p in parts) for part in parts]
    points = []
    for now in sorted({second for t in times for second in t}):
        places = [bisect.bisect_right(t, now) - 1 for t in times]
        latest = [part.trace[k] if k >= 0 else _NOTHING for part, k in zip(parts, places, strict=True)]

        def mean(name: str, latest: Sequence[TracePoint] = latest) -> float:
            return math.fsum(w * getattr(point, name) for w, point in zip(weights, latest, strict=True))

        cells = sum(point.cells for point in latest)
        points.append(TracePoint(now, cells, mean("mpg"), mean("mpg_witness"), min(1.0, mean("covered"))))
    return tuple(points)


def _joined_views(parts: Sequence[SampleImages | None], order: NDArray[np.intp], camera: Any) -> SampleImages | None:
    """Return whole renders at the poses that every part has rendered; None where a part has none."""
    available = [part for part in parts if part is not None]
    if len(available) < len(parts):
        return None
    count = min(part.values.shape[0] for part in available)
    tiles = np.concatenate([part.images[:count] for part in available], axis=1)[:, order]
    images = [assemble(picture, camera) for picture in tiles]
    shape = (0, camera.height, camera.width, 3)
    return SampleImages(available[0].values[:count], np.stack(images) if images else np.zeros(shape, np.float32))


def _joined_leaves(parts: Sequence[Leaves | None]) -> Leaves | None:
    """Return all parts' leaves, ordered by box and tile; None where a part has none."""
    available = [part for part in parts if part is not None]
    if len(available) < len(parts):
        return None
    if len(available) == 1:
        return available[0]
    arrays = {name: np.concatenate([getattr(part, name) for part in available]) for name in Leaves.__dataclass_fields__}
    keys = np.concatenate([arrays["box_lower"], arrays["box_upper"], arrays["tile"].astype(np.float64)], axis=1)
    order = np.lexsort(keys.T[::-1])
    return Leaves(**{name: array[order] for name, array in arrays.items()})


def gap(lower: NDArray[np.floating], upper: NDArray[np.floating]) -> Float64Array:
    """Return the Euclidean length [H, W] over RGB of ``upper - lower``."""
    length = np.empty(lower.shape[:-1])
    # a few rows at a time: what is between stays in the processor's cache
    step = max(1, _AT_ONCE * len(length) // max(1, length.size))

    def fill(row: int) -> None:
        part = slice(row, row + step)
        width = upper[part].astype(np.float64) - lower[part]
        width *= width
        # channel by channel: a reduction along an axis of three numbers takes many times as long
        np.sqrt(width[..., 0] + width[..., 1] + width[..., 2], out=length[part])

    each(fill, range(0, len(length), step))
    return length


def mean_pixel_gap(lower: NDArray[np.floating], upper: NDArray[np.floating]) -> float:
    """Return MPG: the mean of `gap` over the pixels."""
    return float(gap(lower, upper).mean())


def max_pixel_gap(lower: NDArray[np.floating], upper: NDArray[np.floating]) -> float:
    """Return XPG: the maximum of `gap` over the pixels."""
    return float(gap(lower, upper).max())


def merged(older: FrameResult, newer: FrameResult) -> FrameResult:
    """Return the intersection of two results for one frame; both enclose the set, so it does.

    Times and cells add up; the trace of ``newer`` follows that of ``older`` and never gets worse.

    Raises:
        ValueError: The two are of different frames, boxes or sizes.
    """
    same = [(r.index, r.box, r.lower.shape, sorted(r.layers)) for r in (older, newer)]
    if same[0] != same[1]:
        raise ValueError(f"frame {newer.index}: the stored result is of another set of images")
    outer = min((point.mpg for point in older.trace), default=math.inf)
    inner = max((point.mpg_witness for point in older.trace), default=0.0)
    covered = max((point.covered for point in older.trace), default=0.0)
    later = tuple(
        TracePoint(
            older.seconds + point.seconds,
            older.cells + point.cells,
            min(outer, point.mpg),
            max(inner, point.mpg_witness),
            max(covered, point.covered),
        )
        for point in newer.trace
    )
    return replace(
        newer,
        lower=np.maximum(older.lower, newer.lower),
        upper=np.minimum(older.upper, newer.upper),
        witness_lower=np.minimum(older.witness_lower, newer.witness_lower),
        witness_upper=np.maximum(older.witness_upper, newer.witness_upper),
        seconds=older.seconds + newer.seconds,
        cells=older.cells + newer.cells,
        trace=older.trace + later,
        bounded=older.bounded or newer.bounded,
        layers={name: _merged_layer(older.layers[name], layer) for name, layer in newer.layers.items()},
        largest=greater(older.largest, newer.largest),
    )


def _merged_layer(older: ExtraOutput, newer: ExtraOutput) -> ExtraOutput:
    return ExtraOutput(
        np.maximum(older.lower, newer.lower),
        np.minimum(older.upper, newer.upper),
        np.minimum(older.witness_lower, newer.witness_lower),
        np.maximum(older.witness_upper, newer.witness_upper),
        newer.image,
    )
