"""Pixels of a wide cell are bounded in rounds, the most telling and cheapest first (docs/dev/design.md, U8).

A cell, or one of its sub-boxes, is excluded as soon as the pixels bounded so far exclude it. So most cells are decided
by a small part of the photo's pixels: flat places, whose bounds hardly widen with the cell's image motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ns_abstract.geometry.box import Float64Array
from ns_abstract.refine.protocol import Bounds, LinearSets
from ns_abstract.verify.photo import TiledPhoto


@dataclass(frozen=True)
class RoundTuning:
    """Preferences about rounds. None of them decides whether an excluded cell holds no pose of the photo.

    Attributes:
        first: Pixels of the first round: so many times those that exclude a cell.
        spare: Pixels of a later round: so many times those that are expected to decide it.
        typical: The quantile of sub-boxes that is to be excluded before rounds end.
        hopeless: Part of the needed pixels that has to be expected of the remaining ones for another round.
        few: Part of the sub-boxes of which no more are left when rounds end: a narrower cell holds them.
        least_missing: Part of the needed pixels that a later round looks for at least.
        least_rate: Part of a round's pixels that is taken to exclude at least.
    """

    first: float = 1.35
    spare: float = 1.3
    typical: float = 0.1
    hopeless: float = 0.6
    few: float = 0.25
    least_missing: float = 0.1
    least_rate: float = 0.1


class PixelRounds:
    """Counts for each sub-box of a cell the pixels that exclude it, while these are bounded a part at a time (U8).

    Args:
        order: [n] numbers of the pixels to bound, in the order of `TiledPhoto.counted` flattened, the first one first.
        inherited: [T, side, side] counted pixels that exclude the whole cell by bounds over a larger one (U9); they are
            not bounded again. None: there are none.

    Attributes:
        bounded: [T, side, side] pixels whose bounds were counted, and those inherited.
        numbers: [k] pixels so far that exclude each sub-box.
    """

    def __init__(
        self,
        photo: TiledPhoto,
        order: np.ndarray,
        sub_boxes: int,
        inherited: np.ndarray | None = None,
        tuning: RoundTuning | None = None,
    ) -> None:
        self.photo, self.tuning = photo, tuning or RoundTuning()
        self.inherited = np.zeros(photo.counted.shape, bool) if inherited is None else inherited
        self.bounded = self.inherited.copy()
        self.order = order[~self.bounded.reshape(-1)[order]]
        self.numbers = np.full(sub_boxes, int(self.inherited.sum()), np.int64)
        self._excluding: list[tuple[np.ndarray, np.ndarray]] = []
        self.taken = 0
        self._rate = 1.0

    @property
    def left(self) -> np.ndarray:
        """[k] which sub-boxes are not excluded: no more pixels exclude them than are outliers of the whole photo."""
        return self.numbers <= self.photo.allowed

    @property
    def typical(self) -> float:
        """Number of pixels that exclude a sub-box which few others fall behind."""
        return float(np.quantile(self.numbers, self.tuning.typical))

    @property
    def expected(self) -> float:
        """Pixels that would exclude a typical sub-box if all were bounded, as a part of those that are needed."""
        rest = self._rate * (self.order.size - self.taken)
        return (float(np.median(self.numbers)) + rest) / (self.photo.allowed + 1)

    def following(self) -> np.ndarray | None:
        """[T, side, side] pixels of the next round; None: few sub-boxes are left, or more pixels hardly help."""
        left, needed = float(self.left.mean()), self.photo.allowed + 1
        # a cell without sub-boxes is left as a whole
        if left <= (self.tuning.few if self.numbers.size > 1 else 0.0) or self.taken >= self.order.size:
            return None
        if not self.taken:
            missing = needed - int(self.inherited.sum())
            if self.order.size < missing:
                return None
            count = self.tuning.first * missing
        elif self.expected < self.tuning.hopeless:
            return None
        else:
            missing = max(needed - self.typical, self.tuning.least_missing * needed)
            count = self.tuning.spare * missing / max(self._rate, self.tuning.least_rate)
        past = min(self.taken + max(1, math.ceil(count)), self.order.size)
        chosen = np.zeros(self.bounded.shape, bool)
        chosen.reshape(-1)[self.order[self.taken : past]] = True
        self.taken = past
        return chosen

    @property
    def rest(self) -> np.ndarray:
        """[T, side, side] all counted pixels that were not bounded."""
        return self.photo.counted & ~self.bounded

    def count(self, lower: np.ndarray, upper: np.ndarray, pixels: np.ndarray) -> None:
        """`take` the ``n`` ``pixels`` [T, side, side] with bounds [n, 3, k] of the pictures of each sub-box."""
        self.take(self.photo.excluding(lower, upper, pixels), pixels)

    def take(self, excluding: np.ndarray, pixels: np.ndarray) -> None:
        """Count which of the ``n`` ``pixels`` [T, side, side] exclude which sub-boxes [n, k], each pixel once."""
        fresh = (pixels & ~self.bounded)[pixels]
        excluding = excluding[fresh]
        before = float(np.median(self.numbers))
        self.numbers += excluding.sum(axis=0)
        self._excluding.append((np.flatnonzero(pixels & ~self.bounded), excluding))
        self.bounded |= pixels
        if fresh.any():
            self._rate = (float(np.median(self.numbers)) - before) / int(fresh.sum())

    def excluded(self, sub_boxes: np.ndarray) -> np.ndarray:
        """[T, side, side] the pixels so far that exclude each of some ``sub_boxes`` [k], of which there is one (U9)."""
        pixels = self.inherited.copy()
        for numbers, excluding in self._excluding:
            pixels.reshape(-1)[numbers[excluding[:, sub_boxes].all(axis=1)]] = True
        return pixels


class BoundedPixels:
    """Linear bounds of a cell's pixels, as far as they were bounded; other pixels are NaN and exclude nothing (U8).

    Attributes:
        outliers: [T, side, side] counted pixels that nothing in the cell explains, as far as is known.
    """

    def __init__(self, photo: TiledPhoto, dimensions: int) -> None:
        self.photo = photo
        shape = photo.low.shape
        self.lower, self.upper = np.full(shape, np.nan), np.full(shape, np.nan)
        self.outliers: np.ndarray = np.zeros(shape[:-1], bool)
        slopes = (*shape, dimensions)
        self.linear: LinearSets = (
            np.full(slopes, np.nan), np.full(shape, np.nan), np.full(slopes, np.nan), np.full(shape, np.nan),
        )  # fmt: skip

    def add(self, bounds: Bounds, tiles: np.ndarray, pixels: np.ndarray) -> None:
        """Take the bounds of ``tiles`` [t] at ``pixels`` [T, side, side], all of which lie in these tiles."""
        chosen = pixels[tiles]
        self.lower[pixels], self.upper[pixels] = bounds.lower[chosen], bounds.upper[chosen]
        assert bounds.linear is not None
        for known, part in zip(self.linear, bounds.linear, strict=True):
            known[pixels] = part[chosen]

    @property
    def explained(self) -> int:
        """Number of counted pixels that every picture of the cell explains."""
        return self.photo.explained(self.lower, self.upper, self._tiles)

    @property
    def reach(self) -> tuple[Float64Array, Float64Array]:
        """What the bounded pixels leave of the cell's scaled parameters (U3); see `TiledPhoto.reach`."""
        beyond = self.outliers | self.photo.beyond(self.lower, self.upper, self._tiles)
        return self.photo.reach(self.linear, beyond, self._tiles)

    @property
    def _tiles(self) -> np.ndarray:
        return np.arange(self.photo.counted.shape[0])
