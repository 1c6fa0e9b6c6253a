"""Which pixels tell most about a cell, and by their channels or by differences of these (docs/dev/design.md, U8, U10).

All of it is a guess from a render: it decides which pixels are bounded, not what their bounds exclude.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ns_abstract.geometry.box import Float64Array, ParameterBox
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.tiles import assemble, in_tiles
from ns_abstract.refine.protocol import FIRST_CHANNELS, SECOND_CHANNELS, Frame, SubBoxFrame
from ns_abstract.verify.neighbouring_pixels import best_shift, filled, nearby, shifted
from ns_abstract.verify.photo import TiledPhoto

#: What is bounded of a pixel: its channels, or differences of these.
CHANNELS, DIFFERENCES = range(2)
#: Of a typical cell: most pixels that are bounded, how many times as far apart are those whose bounds take more work,
#: and most parts whose middles are drawn.
_MOST_PIXELS, _FEWER, _MOST_PICTURES = 4096, 3, 8
#: What bounds lose at most.
_ALL = 2.0


@dataclass(frozen=True)
class PixelOrder:
    """The pixels to bound of a cell.

    Attributes:
        numbers: [n] in the order of `TiledPhoto.counted` flattened, the most telling and cheapest first.
        sure: How many of them are likely to exclude the cell.
        kinds: [T, side, side] whether `CHANNELS` or `DIFFERENCES` of a pixel tell more.
        misses: By kind, [T, side, side, 6] by how much bounds over the cell are expected to miss the photo: the lower
            ones of three values, which may lie above what the photo allows, then the upper ones.
    """

    numbers: np.ndarray
    sure: int
    kinds: np.ndarray
    misses: tuple[Float64Array, ...]


@dataclass(frozen=True)
class TypicalCell:
    """What bounds over parts of a cell lose.

    Attributes:
        picture: [H, W, 3] in its middle.
        motion: Image motion over a part, pixels.
        losses: By kind, [H, W, 3] by how much bounds go below, and above, what is rendered nearby. There are those of
            `CHANNELS` alone, or both.
    """

    picture: np.ndarray
    motion: float
    losses: tuple[list[Float64Array], ...]


class TellingPixels:
    """Chooses pixels of a photo, by what bounds over a typical cell lose at the same content.

    Args:
        photo: In tiles.
        camera: Of the photo.
        typical: Of a cell in the middle of the set.
    """

    def __init__(self, photo: TiledPhoto, camera: PinholeCamera, typical: TypicalCell) -> None:
        self.photo, self.camera, self.side, self.typical = photo, camera, photo.counted.shape[1], typical

    def order(
        self, tiles: np.ndarray, radius: int, motion: float, counted: np.ndarray, most_pixels: int, differences: bool
    ) -> PixelOrder:
        """The pixels to bound of a cell whose middle shows ``tiles``.

        Args:
            radius: Pixels that the picture moves by over half of the cell.
            motion: Pixels that it moves by over one of its parts.
            counted: [T, side, side] pixels that may be chosen.
            most_pixels: So many at most.
            differences: Whether differences may be bounded.
        """
        picture = assemble(tiles, self.camera)[..., :3]
        kinds = range(len(self.typical.losses) if differences else 1)
        shift = best_shift(self.typical.picture.mean(axis=-1), picture.mean(axis=-1))
        losses = [[in_tiles(shifted(loss, *shift), self.side) for loss in self.typical.losses[kind]] for kind in kinds]
        scale = motion / self.typical.motion
        misses = tuple(self._misses(picture, kind, radius, [scale * loss for loss in losses[kind]]) for kind in kinds)
        likely = np.stack([miss.max(axis=-1) for miss in misses])
        gaps = np.stack([self._misses(picture, kind, 1, [0.0, 0.0]).max(axis=-1) for kind in kinds])
        loose = np.stack([(below + above).max(axis=-1) for below, above in losses])
        # of those that are likely to exclude the tighter one
        worth = np.where(likely > 0.0, likely - loose, -np.inf)
        chosen = np.where((likely > 0.0).any(axis=0), worth.argmax(axis=0), gaps.argmax(axis=0))
        gaps, likely, loose = (np.take_along_axis(part, chosen[None], axis=0)[0] for part in (gaps, likely, loose))
        numbers, sure = telling_order(gaps, likely, loose, counted, most_pixels)
        return PixelOrder(numbers, sure, chosen, misses)

    def _misses(
        self, picture: np.ndarray, kind: int, radius: int, losses: Sequence[Float64Array | float]
    ) -> Float64Array:
        """See `PixelOrder`: by what the picture shows within ``radius`` pixels, and what bounds lose."""
        least, most = (in_tiles(end, self.side) for end in nearby(_values(picture, kind), radius))
        low, high = self.photo.differences if kind == DIFFERENCES else (self.photo.low, self.photo.high)
        return np.concatenate([least - losses[0] - high, low - most - losses[1]], axis=-1)


def typical_cell(
    frame: Frame, cell: ParameterBox, counts: np.ndarray, motion: float, draw: Callable[[Float64Array], np.ndarray]
) -> TypicalCell | None:
    """What bounds over the parts of a cell lose; None: the frame has no bounds over parts of it.

    Args:
        counts: [d] parts along its axes; one part is the cell.
        motion: Image motion over a part, pixels.
        draw: The picture [H, W, 3] at parameters [d].
    """
    camera, parts = frame.camera, int(counts.prod())
    step = math.ceil(math.sqrt(camera.height * camera.width / _MOST_PIXELS))
    # of blocks whose orders are too many, few pixels are bounded whatever the order
    some, few = (_lattice((camera.height, camera.width), k * step) for k in (1, _FEWER))
    chosen, worked = in_tiles(some, frame.side), in_tiles(few, frame.side)
    bounds = _bounds_over_parts(frame, cell, counts, chosen, worked)
    if bounds is None:
        return None
    places = np.unique(np.linspace(0, parts - 1, min(parts, _MOST_PICTURES)).astype(np.int64))
    middles = (2.0 * np.stack(np.unravel_index(places, counts), axis=-1) + 1.0) / counts - 1.0
    pictures = [draw(cell.at(middle)) for middle in middles]
    losses = []
    for kind, (lower, upper) in enumerate(bounds):
        pairs = [
            _losses(_values(picture, kind), motion, lower[..., k], upper[..., k], chosen, camera)
            for k, picture in zip(places, pictures, strict=True)
        ]
        sides = [np.mean([pair[k] for pair in pairs], axis=0) for k in (0, 1)]
        sources = few & np.isfinite(sides[0]).all(axis=-1) & np.isfinite(sides[1]).all(axis=-1)
        losses.append([filled(side, sources, 2 * _FEWER * step, _ALL) for side in sides])
    return TypicalCell(draw(cell.middle), motion, tuple(losses))


def _bounds_over_parts(
    frame: Frame, cell: ParameterBox, counts: np.ndarray, pixels: np.ndarray, worked: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]] | None:
    """By kind, bounds [n, 3, k] of the ``n`` ``pixels`` over the parts of a cell, NaN where nothing is known.

    Those ``worked`` at are bounded whatever the order. None: the frame has no bounds over parts of the cell.
    """
    tiles = np.flatnonzero(pixels.any(axis=(1, 2)))
    if counts.prod() == 1:
        whole = frame.bound(cell, tiles, None)
        return [(whole.lower[pixels[tiles]][..., None], whole.upper[pixels[tiles]][..., None])]
    if not isinstance(frame, SubBoxFrame):
        return None
    ends, bounds = np.repeat(worked[pixels][:, None], 6, axis=1), []
    for kind in (CHANNELS, DIFFERENCES):
        pair = frame.sub_box_ends(cell, counts, tiles, pixels[tiles], ends, kind == DIFFERENCES)
        if pair is None:
            return None
        lower, upper = pair
        # what is known of no end would be known with more work
        vain = (lower <= 0.0) & (upper >= 1.0) | ~(np.isfinite(lower) & np.isfinite(upper))
        nothing = np.logical_and.reduce(vain, axis=1)[:, None]
        bounds.append((np.where(nothing, np.nan, lower), np.where(nothing, np.nan, upper)))
    return bounds


def _lattice(shape: tuple[int, int], step: int) -> np.ndarray:
    """[H, W] every so many pixels, from the middle of the first ones on."""
    pixels = np.zeros(shape, bool)
    pixels[step // 2 :: step, step // 2 :: step] = True
    return pixels


def _losses(
    values: np.ndarray, motion: float, lower: np.ndarray, upper: np.ndarray, pixels: np.ndarray, camera: PinholeCamera
) -> list[Float64Array]:
    """By how much bounds [n, 3] of ``n`` pixels go below and above ``values`` [H, W, 3] nearby; NaN elsewhere."""
    least, most = (in_tiles(end, pixels.shape[1])[pixels] for end in nearby(values, max(1, round(0.5 * motion))))
    losses = []
    for gap in (least - lower, upper - most):
        tiles = np.full((*pixels.shape, 3), np.nan)
        tiles[pixels] = gap.clip(0.0, _ALL)
        losses.append(assemble(tiles, camera))
    return losses


def _values(picture: np.ndarray, kind: int) -> np.ndarray:
    """What is bounded of a picture [H, W, 3]."""
    if kind == CHANNELS:
        return picture
    return picture[..., FIRST_CHANNELS] - picture[..., SECOND_CHANNELS]


def telling_order(
    gaps: Float64Array, likely: Float64Array, loose: Float64Array, counted: np.ndarray, most_pixels: int
) -> tuple[np.ndarray, int]:
    """Numbers of the pixels to bound, at most ``most_pixels``, and how many of them are likely to exclude the cell.

    Args:
        gaps: [T, side, side] by how much the picture in the cell's middle misses the photo there.
        likely: [T, side, side] by how much all bounds over the cell are expected to.
        loose: [T, side, side] expected looseness of bounds: where they are loose they also take longer.
    """
    sure = counted & (likely > 0.0)
    some = counted & (gaps > 0.0) & ~sure
    first, rest = np.flatnonzero(sure), np.flatnonzero(some)
    order = [first[np.argsort((loose - likely).reshape(-1)[first], kind="stable")]]
    order.append(rest[np.argsort(-gaps.reshape(-1)[rest], kind="stable")])
    return np.concatenate(order)[:most_pixels], first.size
