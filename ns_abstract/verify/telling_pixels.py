"""Chooses the pixels that are likely to exclude most of a cell, and whether to bound channels or their differences.

This is an estimate from a render: it decides which pixels are bounded, not what their bounds exclude
(docs/dev/design.md, U8, U10).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ns_abstract.geometry.box import Float64Array, ParameterBox
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.motion_cells import MotionCells
from ns_abstract.geometry.tiles import assemble, in_tiles
from ns_abstract.refine.protocol import FIRST_CHANNELS, SECOND_CHANNELS, Frame, SubBoxFrame
from ns_abstract.verify.neighbouring_pixels import best_shift, filled, nearby, shifted
from ns_abstract.verify.photo import TiledPhoto

#: What is bounded of a pixel: its channels, or differences of these.
CHANNELS, DIFFERENCES = range(2)
#: Of a typical cell: most pixels that are bounded, and most scene elements that these look at.
_MOST_PIXELS, _MOST_ELEMENTS = 4096, 2_000_000
#: What bounds lose at most, and as which power of their width.
_ALL, _POWER = 2.0, 1.5
#: Worth at which a pixel is as likely to exclude poses as not, and by how much e times the odds have more.
_EVEN, _STEEP = -0.1, 0.2
#: A power of e of the odds beyond which they are no smaller.
_HOPELESS = 100.0
#: Scene elements whose work is that of all else that a pixel takes.
_OTHER_WORK = 3000.0
#: Most scene elements that a cell's pixels look at where there are up to so many times as many pixels.
_LITTLE_WORK, _MORE = 300_000.0, 5


@dataclass(frozen=True)
class PixelOrder:
    """The pixels of a cell to bound, in the order of `TiledPhoto.counted` flattened.

    Attributes:
        steps: [m, 2] columns and rows by which the picture may have moved.
        missed: [m, n] whether bounds of each of ``n`` pixels are likely to miss the photo there.
        numbers: [n] the pixels' numbers.
        worth: [n] secondary order: by how much bounds miss, less how loose they are.
        work: [n] estimated work of each pixel's bounds.
        count: Largest number of pixels, or `_MORE` times as many where these look at few elements.
        kinds: [T, side, side] whether `CHANNELS` or `DIFFERENCES` of a pixel tell more.
        misses: By kind, [T, side, side, 6] how far bounds in the cell's middle are expected to miss the photo: lower
            bounds of three values above what the photo allows, then upper bounds below it.
    """

    steps: np.ndarray
    missed: np.ndarray
    numbers: np.ndarray
    worth: Float64Array
    work: Float64Array
    count: int
    kinds: np.ndarray
    misses: tuple[Float64Array, ...]

    def towards(self, moved: Float64Array) -> tuple[np.ndarray, Float64Array]:
        """Return pixels' numbers, the most telling and cheapest first, and the fraction that each is likely to exclude.

        The fractions are of the poses that move the picture by ``moved`` [k, 2].
        """
        nearest = np.abs(moved[:, None] - self.steps).sum(axis=-1).argmin(axis=1)
        weights = np.bincount(nearest, minlength=len(self.steps)) / max(1, len(moved))
        return self._sorted(weights @ self.missed)

    @property
    def everywhere(self) -> tuple[np.ndarray, Float64Array]:
        """Return the pixels that are likely to exclude all of the cell, and 1 for each."""
        numbers, _ = self._sorted(np.where(self.missed.all(axis=0), 1.0, 0.0))
        return numbers, np.ones(numbers.size)

    def telling(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return [n, 6] the bounds of the ``n`` ``pixels`` [T, side, side] that are expected to miss the photo most.

        The second result [n] is whether they are of `DIFFERENCES`.
        """
        kinds = self.kinds[pixels]
        misses = np.choose(kinds[:, None], [miss[pixels] for miss in self.misses])
        return misses == misses.max(axis=-1, keepdims=True), kinds == DIFFERENCES

    def _sorted(self, shares: Float64Array) -> tuple[np.ndarray, Float64Array]:
        some = np.flatnonzero(shares > 0.0)
        likely = _likely(shares[some], self.worth[some])
        order = np.argsort(-likely / self.work[some], kind="stable")
        light = int(np.searchsorted((self.work[some[order]] - _OTHER_WORK).cumsum(), _LITTLE_WORK))
        order = order[: max(self.count, min(light, _MORE * self.count))]
        return self.numbers[some[order]], likely[order]


@dataclass(frozen=True)
class TypicalCell:
    """The losses of bounds over a cell, or its parts.

    Attributes:
        picture: [H, W, 3] in its middle.
        width: Pixels of image motion by which bounds over it are wide.
        losses: By kind, [H, W, 3] how far bounds lie below, and above, renders nearby; of `CHANNELS`, or of both kinds.
    """

    picture: np.ndarray
    width: float
    losses: tuple[list[Float64Array], ...]


class TellingPixels:
    """Chooses pixels of a photo, by the losses of bounds over a typical cell at the same content.

    Args:
        photo: In tiles.
        camera: Of the photo.
        typical: Of a cell in the middle of the set.
    """

    def __init__(self, photo: TiledPhoto, camera: PinholeCamera, typical: TypicalCell) -> None:
        self.photo, self.camera, self.side, self.typical = photo, camera, photo.counted.shape[1], typical
        pairs = (photo.low, photo.high), photo.differences
        self.ends = [[assemble(end, camera) for end in pair] for pair in pairs]

    def order(
        self, tiles: np.ndarray, radius: int, width: float, counted: np.ndarray, count: int,
        elements: np.ndarray | None,
    ) -> PixelOrder:  # fmt: skip
        """Return the pixels to bound of a cell whose middle shows ``tiles``.

        Args:
            radius: Pixels by which the picture moves over half of the cell.
            width: Pixels of image motion by which bounds over it are wide.
            counted: [T, side, side] pixels that may be chosen.
            count: See `PixelOrder`.
            elements: [H, W] scene elements that each pixel's bounds look at, where these are over parts of the cell and
                may be of differences; None: they are not.
        """
        picture = assemble(tiles, self.camera)[..., :3]
        kinds = range(1 if elements is None else len(self.typical.losses))
        shift = best_shift(self.typical.picture.mean(axis=-1), picture.mean(axis=-1))
        scale = (width / self.typical.width) ** _POWER
        losses = [[scale * shifted(loss, *shift) for loss in self.typical.losses[kind]] for kind in kinds]
        steps = np.array([(x, y) for y in _steps(radius) for x in _steps(radius)])
        ends = [_ends(picture, kind, losses[kind]) for kind in kinds]
        misses = tuple(self._misses(kind, pair) for kind, pair in enumerate(ends))
        everywhere = [self._moved_misses(kind, pair, steps) for kind, pair in enumerate(ends)]
        loose = [in_tiles((below + above).max(axis=-1), self.side)[counted] for below, above in losses]
        missed = np.stack([part[:, counted] for part in everywhere])
        worth = missed.min(axis=1) - np.stack(loose)
        kinds_of = _likely((missed > 0.0).mean(axis=1), worth).argmax(axis=0)
        missed = np.take_along_axis(missed, kinds_of[None, None], axis=0)[0]
        worth = np.take_along_axis(worth, kinds_of[None], axis=0)[0]
        chosen = np.zeros(counted.shape, np.int64)
        chosen[counted] = kinds_of
        work = np.full(len(worth), _OTHER_WORK)
        if elements is not None:
            work += in_tiles(elements, self.side)[counted]
        return PixelOrder(steps, missed > 0.0, np.flatnonzero(counted), worth, work, count, chosen, misses)

    def _moved_misses(self, kind: int, ends: tuple[Float64Array, Float64Array], steps: np.ndarray) -> np.ndarray:
        """Return how far bounds ``ends`` miss the photo where the picture moved by ``steps``, [m, T, side, side]."""
        low, high = self.ends[kind]
        misses = []
        for column, row in steps.tolist():
            below, above = (shifted(end, row, column) for end in ends)
            misses.append(in_tiles(np.maximum(below - high, low - above).max(axis=-1), self.side))
        return np.stack(misses)

    def _misses(self, kind: int, ends: tuple[Float64Array, Float64Array]) -> Float64Array:
        """Return how far bounds ``ends`` miss the photo; see `PixelOrder`."""
        low, high = self.ends[kind]
        return in_tiles(np.concatenate([ends[0] - high, low - ends[1]], axis=-1), self.side)


def typical_cell(
    frame: Frame, cell: ParameterBox, parts: MotionCells | np.ndarray | None, width: float, picture: np.ndarray
) -> TypicalCell:
    """Return the losses of bounds over the parts in the middle of a cell.

    Args:
        parts: Its motion cells, or numbers [d] of sub-boxes; None: it is bounded as a whole.
        width: Pixels of image motion by which bounds over it are wide.
        picture: [H, W, 3] in its middle.
    """
    camera = frame.camera
    step = math.ceil(math.sqrt(camera.height * camera.width / _MOST_PIXELS))
    if parts is not None:
        assert isinstance(frame, SubBoxFrame)
        step = max(step, math.ceil(math.sqrt(float(frame.element_counts(cell).sum()) / _MOST_ELEMENTS)))
    some = _lattice((camera.height, camera.width), step)
    chosen = in_tiles(some, frame.side)
    losses = []
    for kind, (lower, upper) in enumerate(_bounds_in_the_middle(frame, cell, parts, chosen)):
        sides = _losses(_values(picture, kind), width, lower, upper, chosen, camera)
        sources = some & np.isfinite(sides[0]).all(axis=-1) & np.isfinite(sides[1]).all(axis=-1)
        losses.append([filled(side, sources, 2 * step, _ALL) for side in sides])
    return TypicalCell(picture, width, tuple(losses))


def _bounds_in_the_middle(
    frame: Frame, cell: ParameterBox, parts: MotionCells | np.ndarray | None, pixels: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return by kind bounds [n, 3] of the ``n`` ``pixels`` over the middle of a cell, cut into ``parts``."""
    tiles = np.flatnonzero(pixels.any(axis=(1, 2)))
    if parts is None:
        whole = frame.bound(cell, tiles, None)
        return [(whole.lower[pixels[tiles]], whole.upper[pixels[tiles]])]
    assert isinstance(frame, SubBoxFrame)
    # those that meet in the middle
    counts = parts.counts if isinstance(parts, MotionCells) else parts
    middle = np.zeros(counts, bool)
    middle[tuple(slice((n - 1) // 2, n // 2 + 1) for n in counts.tolist())] = True
    middle = middle.ravel()
    goals, bounds = np.full((int(pixels.sum()), 6), np.inf), []
    for kind in (CHANNELS, DIFFERENCES):
        pair = frame.sub_box_ends(cell, parts, tiles, pixels[tiles], goals, np.full(len(goals), kind == DIFFERENCES))
        assert pair is not None
        bounds.append((pair[0][..., middle].mean(axis=-1), pair[1][..., middle].mean(axis=-1)))
    return bounds


def _lattice(shape: tuple[int, int], step: int) -> np.ndarray:
    """Return [H, W] a lattice of pixels ``step`` apart."""
    pixels = np.zeros(shape, bool)
    pixels[step // 2 :: step, step // 2 :: step] = True
    return pixels


def _losses(
    values: np.ndarray, motion: float, lower: np.ndarray, upper: np.ndarray, pixels: np.ndarray, camera: PinholeCamera
) -> list[Float64Array]:
    """Return how far bounds [n, 3] of ``n`` pixels lie below and above ``values`` [H, W, 3] nearby; NaN elsewhere."""
    least, most = (in_tiles(end, pixels.shape[1])[pixels] for end in nearby(values, max(1, round(0.5 * motion))))
    losses = []
    for gap in (least - lower, upper - most):
        tiles = np.full((*pixels.shape, 3), np.nan)
        tiles[pixels] = gap.clip(0.0, _ALL)
        losses.append(assemble(tiles, camera))
    return losses


def _values(picture: np.ndarray, kind: int) -> np.ndarray:
    """Return the bounded values of a picture [H, W, 3]: channels or their differences."""
    if kind == CHANNELS:
        return picture
    return picture[..., FIRST_CHANNELS] - picture[..., SECOND_CHANNELS]


def _ends(picture: np.ndarray, kind: int, losses: Sequence[Float64Array]) -> tuple[Float64Array, Float64Array]:
    """Return expected bounds [H, W, 3] of a picture: its extremes around each pixel, widened by the losses."""
    least, most = nearby(_values(picture, kind), 1)
    return least - losses[0], most + losses[1]


def _likely(shares: Float64Array, worth: Float64Array) -> Float64Array:
    """Return the fraction of a cell that each pixel is likely to exclude, of ``shares`` where bounds may miss."""
    # what bounds lose has no end where a cell is far wider than the typical one
    return shares / (1.0 + np.exp(np.minimum((_EVEN - worth) / _STEEP, _HOPELESS)))


def _steps(radius: int) -> range:
    """Return pixels by which a picture may move along an axis, two apart."""
    return range(1 - radius, radius, 2) if radius > 1 else range(1)
