"""Linear sets of a refinement's leaves, which some results carry."""

from __future__ import annotations

import numpy as np

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.refine.frame_tiles import FrameTiles, LeafCell
from ns_abstract.refine.protocol import Bounds
from ns_abstract.refine.result import Leaves


class LeafSets:
    """The linear sets of every (cell, tile) leaf of ``tiles``; nothing is kept unless its bounds carry them."""

    def __init__(self, tiles: FrameTiles) -> None:
        self.tiles, self.bytes = tiles, 0
        self._sets: dict[tuple[int, int], tuple[ParameterBox, tuple[np.ndarray, ...]]] = {}

    def clear(self) -> None:
        """Give up all of them."""
        self._sets.clear()
        self.bytes = 0

    def keep(self, cell: LeafCell, bounds: Bounds, places: np.ndarray, parent: LeafCell | None = None) -> None:
        """Take those of ``cell`` in the tiles at ``places``, in place of those of its ``parent``."""
        if not self.tiles.keep_linear or bounds.linear is None:
            return
        linear = _usable_linear(bounds.linear)
        for k, t in enumerate(places.tolist()):
            if parent is not None:
                gone = self._sets.pop((parent.number, t), None)
                self.bytes -= 0 if gone is None else sum(a.nbytes for a in gone[1])
            # copies: a view would keep the bounds of all tiles
            entry = tuple(a[k].copy() for a in linear)
            self._sets[(cell.number, t)] = (cell.box, entry)
            self.bytes += sum(a.nbytes for a in entry)

    def leaves(self) -> Leaves:
        """The linear bounds of all leaves, ordered by box and tile."""
        frame = self.tiles.frame
        d, side = frame.box.dimensions, frame.side
        entries = sorted(
            ((box, tile, linear) for (_, tile), (box, linear) in self._sets.items()),
            key=lambda entry: (entry[0].lower, entry[0].upper, entry[1]),
        )
        n = len(entries)
        tiles = self.tiles.numbers(np.array([tile for _, tile, _ in entries], np.int64))

        def stack(part: int, shape: tuple[int, ...]) -> np.ndarray:
            arrays = [linear[part] for _, _, linear in entries]
            return np.stack(arrays) if arrays else np.zeros((0, *shape), np.float32)

        slopes, offsets = (side, side, 3, d), (side, side, 3)
        return Leaves(
            np.array([box.lower for box, _, _ in entries], np.float64).reshape(n, d),
            np.array([box.upper for box, _, _ in entries], np.float64).reshape(n, d),
            np.stack([tiles // frame.across * side, tiles % frame.across * side], axis=1).astype(np.int32),
            stack(0, slopes),
            stack(1, offsets),
            stack(2, slopes),
            stack(3, offsets),
        )


def linear_bytes(bounds: Bounds) -> int:
    """Memory of a cell's linear sets."""
    return 0 if bounds.linear is None else sum(a.nbytes for a in bounds.linear)


def _usable_linear(linear: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Linear sets (A_lower, b_lower, A_upper, b_upper) with 0 and 1 where a number is not finite."""
    parts: list[np.ndarray] = []
    for slope, offset, trivial in ((linear[0], linear[1], 0.0), (linear[2], linear[3], 1.0)):
        good = np.isfinite(slope).all(axis=-1) & np.isfinite(offset)
        parts.append(np.where(good[..., None], slope, np.zeros_like(slope)))
        parts.append(np.where(good, offset, np.full_like(offset, trivial)))
    return tuple(parts)
