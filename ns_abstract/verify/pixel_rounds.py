"""Bounds the pixels of a wide cell in rounds, the most telling and cheapest first (docs/dev/design.md, U8).

A cell, or one of its sub-boxes, is excluded as soon as the pixels bounded so far exclude it. So most cells are decided
by a small fraction of the photo's pixels: flat areas, whose bounds hardly widen with the cell's image motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ns_abstract.geometry.box import Float64Array
from ns_abstract.refine.protocol import Bounds, LinearSets
from ns_abstract.verify.photo import TiledPhoto


@dataclass(frozen=True)
class RoundTuning:
    """Preferences about rounds; soundness of excluding a cell does not depend on them.

    Attributes:
        first: Pixels of the first round, as a multiple of those that exclude a cell.
        spare: Pixels of a later round, as a multiple of those that are expected to decide the cell.
        hopeless: Fraction of the missing pixels that the remaining ones must be expected to give for another round.
        few: Rounds end when only this fraction of the sub-boxes remains: a narrower cell contains them.
        least_missing: Least fraction of the needed pixels that a later round looks for.
        least_rate: Least fraction of the expected pixels that is assumed to exclude.
    """

    first: float = 1.35
    spare: float = 1.3
    hopeless: float = 0.6
    few: float = 0.25
    least_missing: float = 0.1
    least_rate: float = 0.02


class PixelRounds:
    """Counts for each sub-box of a cell the pixels that exclude it, while these are bounded round by round (U8).

    Args:
        inherited: [T, side, side] counted pixels that exclude the whole cell by bounds over an enclosing one (U9); they
            are not bounded again. None: there are none.

    Attributes:
        bounded: [T, side, side] pixels that were counted, and those inherited.
        numbers: [k] pixels so far that exclude each sub-box.
        expected: Expected number of excluding pixels if all were bounded, as a multiple of the needed ones.
    """

    def __init__(
        self, photo: TiledPhoto, sub_boxes: int, inherited: np.ndarray | None = None, tuning: RoundTuning | None = None
    ) -> None:
        self.photo, self.tuning = photo, tuning or RoundTuning()
        self.inherited = np.zeros(photo.counted.shape, bool) if inherited is None else inherited
        self.bounded = self.inherited.copy()
        self.numbers = np.full(sub_boxes, int(self.inherited.sum()), np.int64)
        self.expected = 1.0
        self._excluding: list[tuple[np.ndarray, np.ndarray]] = []
        self._rate = 1.0
        self._ordered, self._shares = np.zeros(0, np.int64), np.zeros(0)

    @property
    def left(self) -> np.ndarray:
        """Which sub-boxes [k] are not excluded: the pixels that exclude them are no more than the photo's outliers."""
        return self.numbers <= self.photo.allowed

    def following(self, order: np.ndarray, shares: Float64Array) -> np.ndarray | None:
        """Return the pixels [T, side, side] of the next round; None: few sub-boxes remain, or more pixels hardly help.

        Args:
            order: [n] numbers of pixels, best first, in the order of `TiledPhoto.counted` flattened.
            shares: [n] fraction of the remaining sub-boxes that each is likely to exclude.
        """
        left, needed = self.left, self.photo.allowed + 1
        fresh = ~self.bounded.reshape(-1)[order]
        order, likely_so_far = order[fresh], shares[fresh].cumsum()
        # a cell without sub-boxes is left as a whole
        few = self.tuning.few if left.size > 1 else 0.0
        if not left.any():
            self.expected = 1.0
            return None
        typical = float(np.median(self.numbers[left]))
        remaining = self._rate * float(likely_so_far[-1]) if likely_so_far.size else 0.0
        self.expected = (typical + remaining) / needed
        missing = max(needed - typical, self.tuning.least_missing * needed)
        if not order.size or left.mean() <= few or remaining < self.tuning.hopeless * missing:
            return None
        first = not self._excluding
        wanted = (self.tuning.first if first else self.tuning.spare) * missing
        past = min(int(np.searchsorted(self._rate * likely_so_far, wanted)) + 1, order.size)
        self._ordered, self._shares = order[:past], shares[fresh][:past]
        chosen = np.zeros(self.bounded.shape, bool)
        chosen.reshape(-1)[order[:past]] = True
        return chosen

    @property
    def rest(self) -> np.ndarray:
        """Return all counted pixels [T, side, side] that were not bounded."""
        return self.photo.counted & ~self.bounded

    def count(self, lower: np.ndarray, upper: np.ndarray, pixels: np.ndarray) -> None:
        """Count ``n`` ``pixels`` [T, side, side] by their bounds [n, 3, k] over each sub-box; see `take`."""
        self.take(self.photo.excluding(lower, upper, pixels), pixels)

    def take(self, excluding: np.ndarray, pixels: np.ndarray) -> None:
        """Count which of ``n`` ``pixels`` exclude which sub-boxes: ``excluding`` [n, k], each pixel once."""
        fresh = (pixels & ~self.bounded)[pixels]
        excluding = excluding[fresh]
        more = excluding.sum(axis=0)
        self.numbers += more
        self._excluding.append((np.flatnonzero(pixels & ~self.bounded), excluding))
        self.bounded |= pixels
        # the last half of the round tells what comes next
        last = slice(self._ordered.size // 2, None)
        if self.left.any() and self._shares[last].sum() > 0.0:
            late = np.isin(self._excluding[-1][0], self._ordered[last])
            found = float(excluding[late][:, self.left].sum(axis=0).mean())
            self._rate = max(found / float(self._shares[last].sum()), self.tuning.least_rate)

    def excluded(self, sub_boxes: np.ndarray) -> np.ndarray:
        """Return the pixels [T, side, side] so far that exclude every one of some ``sub_boxes`` [k] (U9)."""
        pixels = self.inherited.copy()
        for numbers, excluding in self._excluding:
            pixels.reshape(-1)[numbers[excluding[:, sub_boxes].all(axis=1)]] = True
        return pixels


class BoundedPixels:
    """Linear bounds of the bounded pixels of a cell; other pixels are NaN and exclude nothing (U8).

    Attributes:
        outliers: [T, side, side] counted pixels that no picture of the cell explains, so far.
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
        """Add the bounds of ``tiles`` [t] at ``pixels`` [T, side, side], all of which lie in these tiles."""
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
        """Return the ends of the scaled parameters that the bounded pixels do not exclude; see `TiledPhoto.reach`."""
        beyond = self.outliers | self.photo.beyond(self.lower, self.upper, self._tiles)
        return self.photo.reach(self.linear, beyond, self._tiles)

    def best_fit(self, steps: int) -> Float64Array | None:
        """Return scaled parameters [d] at which the linear bounds' middle explains most pixels; None: there are none.

        They are found by ``steps`` weighted least squares.
        """
        counted, d = self.photo.counted, self.linear[0].shape[-1]
        b = 0.5 * (self.linear[1].astype(np.float64) + self.linear[3])[counted].reshape(-1)
        a = 0.5 * (self.linear[0].astype(np.float64) + self.linear[2])[counted].reshape(b.size, d)
        low, high = (end[counted].reshape(-1) for end in (self.photo.low, self.photo.high))
        target, room = 0.5 * (low + high) - b, 0.5 * (high - low)
        good = np.isfinite(a).all(axis=-1) & np.isfinite(target) & (np.abs(a).sum(axis=-1) > 0.0)
        if not good.any():
            return None
        a, target, room = a[good], target[good], room[good]
        p = np.zeros(d)
        for _ in range(steps):
            weight = 1.0 / np.maximum(np.abs(a @ p - target), room) ** 2
            p = np.linalg.lstsq(a * np.sqrt(weight)[:, None], target * np.sqrt(weight), rcond=None)[0]
            if not np.isfinite(p).all():
                return None
        return np.clip(p, -1.0, 1.0).astype(np.float64)

    @property
    def _tiles(self) -> np.ndarray:
        return np.arange(self.photo.counted.shape[0])
