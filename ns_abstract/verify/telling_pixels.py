"""Which pixels tell most about a cell, and by their channels or by differences of these (docs/dev/design.md, U8, U10).

All of it is a guess from a render: it decides which pixels are bounded, not what their bounds exclude.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ns_abstract.geometry.box import Float64Array
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.tiles import assemble, in_tiles
from ns_abstract.refine.protocol import CHANNEL_DIFFERENCES
from ns_abstract.verify.neighbouring_pixels import nearby, smoothed
from ns_abstract.verify.photo import TiledPhoto

#: What is bounded of a pixel: its channels, or differences of these.
CHANNELS, DIFFERENCES = range(2)
#: Pixels that the looseness of bounds is averaged over, to every side.
_SMOOTH = 4


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


class TellingPixels:
    """Chooses pixels of a photo.

    Args:
        photo: In tiles.
        camera: Of the photo.
        picture: [H, W, 3] in the middle of a typical cell.
        motion: Image motion over that cell, pixels.
        ends: By kind, lower and upper bounds [T, side, side, 3] over that cell; one of `CHANNELS` alone, or both.
    """

    def __init__(
        self, photo: TiledPhoto, camera: PinholeCamera, picture: np.ndarray, motion: float,
        ends: tuple[tuple[np.ndarray, np.ndarray], ...],
    ) -> None:  # fmt: skip
        self.photo, self.camera, self.side = photo, camera, photo.counted.shape[1]
        self._looseness = []
        for kind, (lower, upper) in enumerate(ends):
            least, most = nearby(_values(picture, kind), max(1, round(0.5 * motion)))
            gaps = least - assemble(lower, camera), assemble(upper, camera) - most
            # by how much bounds go below and above what is rendered nearby; no more than all that there is
            self._looseness.append([in_tiles(smoothed(gap.clip(0.0, 2.0), _SMOOTH), self.side) for gap in gaps])
        self._loose = [(below + above).max(axis=-1) for below, above in self._looseness]

    def order(
        self, tiles: np.ndarray, radius: int, scale: float, counted: np.ndarray, most_pixels: int, differences: bool
    ) -> PixelOrder:
        """The pixels to bound of a cell whose middle shows ``tiles``.

        Args:
            radius: Pixels that the picture moves by over half of the cell.
            scale: Part of the typical cell's looseness that is expected of the bounds.
            counted: [T, side, side] pixels that may be chosen.
            most_pixels: So many at most.
            differences: Whether differences may be bounded.
        """
        picture = assemble(tiles, self.camera)[..., :3]
        kinds = range(len(self._looseness) if differences else 1)
        misses = tuple(self._misses(picture, kind, radius, scale) for kind in kinds)
        likely = np.stack([miss.max(axis=-1) for miss in misses])
        gaps = np.stack([self._misses(picture, kind, 1, 0.0).max(axis=-1) for kind in kinds])
        loose = np.stack([self._loose[kind] for kind in kinds])
        worth = np.where(likely > 0.0, likely - loose, -np.inf)
        chosen = np.where((likely > 0.0).any(axis=0), worth.argmax(axis=0), gaps.argmax(axis=0))
        gaps, likely, loose = (np.take_along_axis(part, chosen[None], axis=0)[0] for part in (gaps, likely, loose))
        numbers, sure = telling_order(gaps, likely, loose, counted, most_pixels)
        return PixelOrder(numbers, sure, chosen, misses)

    def _misses(self, picture: np.ndarray, kind: int, radius: int, scale: float) -> Float64Array:
        """See `PixelOrder`: by what the picture shows within ``radius`` pixels, and a part of the looseness."""
        least, most = (in_tiles(end, self.side) for end in nearby(_values(picture, kind), radius))
        below, above = (part * scale for part in self._looseness[kind])
        low, high = self.photo.differences if kind == DIFFERENCES else (self.photo.low, self.photo.high)
        return np.concatenate([least - below - high, low - most - above], axis=-1)


def _values(picture: np.ndarray, kind: int) -> np.ndarray:
    """What is bounded of a picture [H, W, 3]."""
    if kind == CHANNELS:
        return picture
    first, second = (list(side) for side in zip(*CHANNEL_DIFFERENCES, strict=True))
    return picture[..., first] - picture[..., second]


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
