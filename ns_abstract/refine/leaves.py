"""The leaves of a refinement: bounds of every (cell, tile) pair, and the outer bound that they form."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.refine.frame_tiles import FrameTiles, LeafCell, context_bytes, usable
from ns_abstract.refine.goal import RefinementGoal
from ns_abstract.refine.inner import InnerBound
from ns_abstract.refine.protocol import COLORS, MOST_PARTS, Bounds, CellContext, LinearSets
from ns_abstract.refine.result import Leaves
from ns_abstract.refine.tuning import TUNING, Tuning

#: A cell with lower and upper bounds [t, side, side, channels] of all tiles.
BoundedCell = tuple[LeafCell, np.ndarray, np.ndarray]


@dataclass
class Change:
    """A round's change of the leaves of one tile: removed rows, and the new leaves."""

    gone: list[int] = field(default_factory=list)
    cells: list[LeafCell] = field(default_factory=list)
    lower: list[np.ndarray] = field(default_factory=list)
    upper: list[np.ndarray] = field(default_factory=list)


@dataclass
class TileLeaves:
    """The leaves of one tile: bounds [n, side, side, channels], and the union of leaves that are no longer split."""

    closed_lower: np.ndarray
    closed_upper: np.ndarray
    cells: list[LeafCell] = field(default_factory=list)
    lower: np.ndarray | None = None
    upper: np.ndarray | None = None

    def replace(self, change: Change) -> None:
        """Remove the leaves in the rows ``change.gone`` and append the new ones."""
        keep = np.ones(len(self.cells), bool)
        keep[change.gone] = False
        old_lower = [] if self.lower is None else [self.lower[keep]]
        old_upper = [] if self.upper is None else [self.upper[keep]]
        self.cells = [cell for cell, stays in zip(self.cells, keep, strict=True) if stays] + change.cells
        if not self.cells:
            self.lower = self.upper = None
            return
        self.lower = np.concatenate([*old_lower, *(a[None] for a in change.lower)])
        self.upper = np.concatenate([*old_upper, *(a[None] for a in change.upper)])

    def close(self, which: np.ndarray) -> None:
        """Close the leaves ``which`` [n] (bool): they keep their bounds and are not split any more."""
        if self.lower is None or self.upper is None or not which.any():
            return
        self.closed_lower = np.minimum(self.closed_lower, self.lower[which].min(axis=0))
        self.closed_upper = np.maximum(self.closed_upper, self.upper[which].max(axis=0))
        stay = ~which
        self.cells = [cell for cell, s in zip(self.cells, stay, strict=True) if s]
        self.lower, self.upper = (self.lower[stay], self.upper[stay]) if self.cells else (None, None)

    def outer(self, change: Change | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds [side, side, channels] over all leaves, as they will be after ``change``."""
        lower, upper = [self.closed_lower[None]], [self.closed_upper[None]]
        if self.lower is not None and self.upper is not None:
            keep = np.ones(len(self.cells), bool)
            if change is not None:
                keep[change.gone] = False
            lower.append(self.lower[keep])
            upper.append(self.upper[keep])
        if change is not None:
            lower += [a[None] for a in change.lower]
            upper += [a[None] for a in change.upper]
        return np.concatenate(lower).min(axis=0), np.concatenate(upper).max(axis=0)


class LeafBounds:
    """The leaves of all tiles, and the choice of those to split next.

    Args:
        earlier: [t, side, side, 3] earlier bounds of the same set; None: there are none.

    Attributes:
        bytes: Memory of open leaves, as `next_round` has counted it.
    """

    def __init__(
        self,
        tiles: FrameTiles,
        inner: InnerBound,
        earlier: tuple[np.ndarray, np.ndarray] | None = None,
        tuning: Tuning = TUNING,
    ) -> None:
        self.tiles, self.inner, self.earlier, self.tuning = tiles, inner, earlier, tuning
        self.by_tile = [
            TileLeaves(np.full(tiles.shape, np.inf, np.float32), np.full(tiles.shape, -np.inf, np.float32))
            for _ in range(tiles.count)
        ]
        self.lower, self.upper = usable(tiles.filled(np.nan), tiles.filled(0.0))
        self._intersect(tiles.all)
        self.lower[~tiles.inside] = 0.0
        self.upper[~tiles.inside] = 0.0
        self._mean_gap: float | None = None
        self.bytes = 0
        #: cells that cover the set, until their tiles are split one by one
        self._taken: list[BoundedCell] = []
        #: what a leaf may leave open at a pixel that it is not bounded at any more; never falls
        self._closed_excess = 0.0

    @property
    def mean_gap(self) -> float:
        """MPG of the outer bound."""
        if self._mean_gap is None:
            self._mean_gap = self.tiles.mean_gap(self.lower, self.upper)
        return self._mean_gap

    def begin(self) -> None:
        """Drop the cells that were taken."""
        self._taken.clear()

    def take(self, cell: LeafCell, lower: np.ndarray, upper: np.ndarray) -> None:
        """Store the bounds of a cell in all tiles; call `cover` when all cells are stored."""
        self._taken.append((cell, lower, upper))

    def cover(self) -> None:
        """Set the outer bound to that of the stored cells."""
        _, lower, upper = self._taken[0]
        self.lower[:], self.upper[:] = lower, upper
        for _, lower, upper in self._taken[1:]:
            np.minimum(self.lower, lower, out=self.lower)
            np.maximum(self.upper, upper, out=self.upper)
        self._tighten(self.tiles.all)

    def update(self, places: np.ndarray, changes: dict[int, Change] | None = None) -> None:
        """Update the outer bound of the tiles at ``places``, given the changes since the round began."""
        for t in places:
            self.lower[t], self.upper[t] = self.by_tile[t].outer(None if changes is None else changes[t])
        self._tighten(places)

    def _tighten(self, places: np.ndarray) -> None:
        """Make the outer bound of the tiles ``places`` usable, and intersect it with the earlier one."""
        self._intersect(places)
        self.lower[places], self.upper[places] = usable(self.lower[places], self.upper[places])
        self._mean_gap = None

    def _divide(self) -> None:
        """Move the stored cells' bounds to the leaves of each tile."""
        cells = [cell for cell, _, _ in self._taken]
        for tile in self.by_tile:
            tile.cells = list(cells)
            # memory is taken where it is written
            tile.lower, tile.upper = (np.empty((len(cells), *self.tiles.shape), np.float32) for _ in range(2))
        while self._taken:
            # what is copied may be given back before the next is
            _, lower, upper = self._taken.pop()
            row = len(self._taken)
            for tile, low, high in zip(self.by_tile, lower, upper, strict=True):
                assert tile.lower is not None and tile.upper is not None
                tile.lower[row], tile.upper[row] = low, high

    def apply(self, changes: dict[int, Change]) -> None:
        """End a round with its changes."""
        for t, change in changes.items():
            self.by_tile[t].replace(change)
        self.update(np.array(sorted(changes), np.int64))

    def _intersect(self, places: np.ndarray) -> None:
        """Intersect the outer bound of the tiles ``places`` with the earlier one: both hold (design.md, R5)."""
        if self.earlier is not None:
            lower, upper = self.earlier
            low, high = self.lower[..., :COLORS], self.upper[..., :COLORS]
            low[places], high[places] = np.maximum(low[places], lower[places]), np.minimum(high[places], upper[places])

    def row(self, t: int, row: int) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds [side, side, channels] of one leaf of tile t."""
        tile = self.by_tile[t]
        assert tile.lower is not None and tile.upper is not None
        return tile.lower[row], tile.upper[row]

    def wanted(self, rows: dict[int, int]) -> np.ndarray | None:
        """Return [t, side, side] the pixels for which leaves in the tiles and rows ``rows`` are split; None: all."""
        if not self.tiles.by_pixel:
            return None
        return np.stack([self._excess(t, *(side[None] for side in self.row(t, k)))[0] > 0.0 for t, k in rows.items()])

    def close_excess(self, allowed: float) -> None:
        """Close pixels of leaves that could reduce the excess by little, compared with the ``allowed`` one."""
        if self.tiles.by_pixel:
            self._closed_excess = max(self._closed_excess, self.tuning.closed_share * allowed)

    def next_round(self, goal: RefinementGoal) -> tuple[list[tuple[LeafCell, dict[int, int]]], int]:
        """Return the cells to split in the next round, each with its row by tile, and the number of parts."""
        if self._taken:
            self._divide()
        while True:
            amounts, owner = self._open_excess()
            if not owner:
                return [], 2
            order = np.argsort(-amounts, kind="stable")
            if self.bytes <= goal.leaf_bytes:
                break
            self._close_least(order, owner)
        running = np.cumsum(amounts[order])
        count = int(np.searchsorted(running, self.tuning.round_share * running[-1])) + 1
        by_cell: dict[int, tuple[LeafCell, dict[int, int]]] = {}
        for position in order[:count]:
            t, k = owner[position]
            cell = self.by_tile[t].cells[k]
            by_cell.setdefault(cell.number, (cell, {}))[1][t] = k
        jobs = []
        for cell, rows in by_cell.values():
            ordered = sorted(rows.items())
            step = self.tiles.frame.tiles_at_once or len(ordered)
            jobs += [(cell, dict(ordered[i : i + step])) for i in range(0, len(ordered), step)]
        # excess falls at least in proportion to the width: far from the goal, levels are skipped
        moved = (self.inner.upper - self.inner.lower)[..., :COLORS]
        allowed = (goal.ratio - 1.0) * float(moved[self.tiles.inside].sum())
        return jobs, MOST_PARTS if running[-1] > self.tuning.wide_split_excess * allowed else 2

    def _open_excess(self) -> tuple[np.ndarray, list[tuple[int, int]]]:
        """Return every open leaf's excess over the inner bound, and its tile and row.

        Leaves that cannot be improved are closed; the memory of the others is counted.
        """
        excess: list[np.ndarray] = [np.empty(0)]
        owner: list[tuple[int, int]] = []
        contexts: dict[int, CellContext | None] = {}
        self.bytes = 0
        for t, tile in enumerate(self.by_tile):
            if tile.lower is None or tile.upper is None:
                continue
            amount = self._excess(t, tile.lower, tile.upper).sum(axis=(1, 2), dtype=np.float64)
            done = (amount <= 0.0) | np.array([cell.narrow for cell in tile.cells])
            tile.close(done)
            amount = amount[~done]
            if tile.lower is not None and tile.upper is not None:
                self.bytes += tile.lower.nbytes + tile.upper.nbytes
            for cell in tile.cells:
                contexts[id(cell.context)] = cell.context
            excess.append(amount)
            owner.extend((t, k) for k in range(amount.size))
        self.bytes += sum(context_bytes(context) for context in contexts.values())
        return np.concatenate(excess), owner

    def _excess(self, t: int, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Return the excess [n, side, side] of leaves of tile t over the inner bound, zero where it is too small."""
        colors = np.s_[..., :COLORS]
        lower, upper = lower[colors], upper[colors]
        if self.earlier is not None:
            lower, upper = np.maximum(lower, self.earlier[0][t]), np.minimum(upper, self.earlier[1][t])
        beyond = np.maximum(0.0, self.inner.lower[t][colors] - lower)
        beyond += np.maximum(0.0, upper - self.inner.upper[t][colors])
        beyond = beyond.sum(axis=-1)
        return np.where(self.tiles.inside[t] & (beyond > self._closed_excess), beyond, 0.0)

    def _close_least(self, order: np.ndarray, owner: list[tuple[int, int]]) -> None:
        """Free memory: close the half of the leaves with the least excess."""
        closing: dict[int, list[int]] = {}
        for position in order[order.size // 2 :]:
            t, k = owner[position]
            closing.setdefault(t, []).append(k)
        for t, which in closing.items():
            mask = np.zeros(len(self.by_tile[t].cells), bool)
            mask[which] = True
            self.by_tile[t].close(mask)


# ---------------------------------------------------------------- linear sets, which some results carry


class LeafSets:
    """The linear sets of every (cell, tile) leaf of ``tiles``; empty unless the bounds have linear sets."""

    def __init__(self, tiles: FrameTiles) -> None:
        self.tiles, self.bytes = tiles, 0
        self._sets: dict[tuple[int, int], tuple[ParameterBox, tuple[np.ndarray, ...]]] = {}

    def clear(self) -> None:
        """Drop all sets."""
        self._sets.clear()
        self.bytes = 0

    def keep(
        self, cell: LeafCell, linear: LinearSets | None, places: np.ndarray, parent: LeafCell | None = None
    ) -> None:
        """Store the ``linear`` sets of ``cell`` in the tiles at ``places``, replacing those of its ``parent``."""
        if not self.tiles.keep_linear or linear is None:
            return
        linear = _usable_linear(linear)
        for k, t in enumerate(places.tolist()):
            if parent is not None:
                gone = self._sets.pop((parent.number, t), None)
                self.bytes -= 0 if gone is None else sum(a.nbytes for a in gone[1])
            # copies: a view would keep the bounds of all tiles
            entry = tuple(a[k].copy() for a in linear)
            self._sets[(cell.number, t)] = (cell.box, entry)
            self.bytes += sum(a.nbytes for a in entry)

    def keep_unknown(self, cell: LeafCell, others: LinearSets | None, places: np.ndarray) -> None:
        """Store the sets [0, 1] in the tiles at ``places``, where ``others`` have sets."""
        if others is not None:
            a, b, c, d = (np.full((len(places), *part.shape[1:]), np.nan, part.dtype) for part in others)
            self.keep(cell, (a, b, c, d), places)

    def leaves(self) -> Leaves:
        """Return the linear bounds of all leaves, ordered by box and tile."""
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
    """Return the bytes of a cell's linear sets."""
    return 0 if bounds.linear is None else sum(a.nbytes for a in bounds.linear)


def _usable_linear(linear: LinearSets) -> LinearSets:
    """Return linear sets (A_lower, b_lower, A_upper, b_upper) with [0, 1] where a number is not finite."""
    parts: list[np.ndarray] = []
    for slope, offset, trivial in ((linear[0], linear[1], 0.0), (linear[2], linear[3], 1.0)):
        good = np.isfinite(slope).all(axis=-1) & np.isfinite(offset)
        parts.append(np.where(good[..., None], slope, np.zeros_like(slope)))
        parts.append(np.where(good, offset, np.full_like(offset, trivial)))
    return parts[0], parts[1], parts[2], parts[3]
