"""Pixels of a wide cell are bounded in rounds, the most telling and cheapest first (docs/dev/design.md, U8).

A cell, or one of its sub-boxes, is excluded as soon as the pixels bounded so far exclude it. So most cells are decided
by a small part of the photo's pixels: flat places, whose bounds hardly widen with the cell's image motion.
"""

from __future__ import annotations

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
        hopeless: Part of the missing pixels that has to be expected of the remaining ones for another round.
        few: Part of the sub-boxes of which no more are left when rounds end: a narrower cell holds them.
        least_missing: Part of the needed pixels that a later round looks for at least.
        least_rate: Part of the expected pixels that is taken to exclude at least.
    """

    first: float = 1.35
    spare: float = 1.3
    hopeless: float = 0.6
    few: float = 0.25
    least_missing: float = 0.1
    least_rate: float = 0.02


class PixelRounds:
    """Counts for each sub-box of a cell the pixels that exclude it, while these are bounded a part at a time (U8).

    Args:
        inherited: [T, side, side] counted pixels that exclude the whole cell by bounds over a larger one (U9); they are
            not bounded again. None: there are none.

    Attributes:
        bounded: [T, side, side] pixels whose bounds were counted, and those inherited.
        numbers: [k] pixels so far that exclude each sub-box.
        expected: Pixels that would exclude what is left if all were bounded, as a part of those that are needed.
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
        """[k] which sub-boxes are not excluded: no more pixels exclude them than are outliers of the whole photo."""
        return self.numbers <= self.photo.allowed

    def following(self, order: np.ndarray, shares: Float64Array) -> np.ndarray | None:
        """[T, side, side] pixels of the next round; None: few sub-boxes are left, or more pixels hardly help.

        Args:
            order: [n] numbers of pixels, in the order of `TiledPhoto.counted` flattened, the first one first.
            shares: [n] part of what is left that each is likely to exclude.
        """
        left, needed = self.left, self.photo.allowed + 1
        fresh = ~self.bounded.reshape(-1)[order]
        order, foreseen = order[fresh], shares[fresh].cumsum()
        # a cell without sub-boxes is left as a whole
        few = self.tuning.few if left.size > 1 else 0.0
        if not left.any():
            self.expected = 1.0
            return None
        typical = float(np.median(self.numbers[left]))
        rest = self._rate * float(foreseen[-1]) if foreseen.size else 0.0
        self.expected = (typical + rest) / needed
        missing = max(needed - typical, self.tuning.least_missing * needed)
        if not order.size or left.mean() <= few or rest < self.tuning.hopeless * missing:
            return None
        first = not self._excluding
        wanted = (self.tuning.first if first else self.tuning.spare) * missing
        past = min(int(np.searchsorted(self._rate * foreseen, wanted)) + 1, order.size)
        self._ordered, self._shares = order[:past], shares[fresh][:past]
        chosen = np.zeros(self.bounded.shape, bool)
        chosen.reshape(-1)[order[:past]] = True
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

    def best_fit(self, steps: int) -> Float64Array | None:
        """Scaled parameters [d] where the linear bounds' middle explains most, by ``steps`` weighted least squares.

        None: there are none.
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
