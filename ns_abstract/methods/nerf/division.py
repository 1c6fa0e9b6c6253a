"""Nested uniform subdivisions of a box of poses, and the parts for which bounds are stored."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Division:
    """Nested uniform subdivisions of a box, and the parts for which bounds are stored.

    With one parameter there are levels of 3, 6, 12, ... cells between those of 2, 4, 8, ...: cells are then closer to
    the largest width that bounds of the network bear.

    Attributes:
        axes: Axis that is halved from each level to the next; with one parameter, to the level with twice as many
            cells.
        finer: Halvings of the deepest level's cells into parts, by axis.
    """

    axes: tuple[int, ...]
    dimensions: int
    finer: int = 0

    @cached_property
    def _levels(self) -> list[tuple[int, ...]]:
        """Cells by axis of every level."""
        halved = len(self.axes)
        level_counts = [
            tuple(1 << self.axes[:level].count(j) for j in range(self.dimensions)) for level in range(halved + 1)
        ]
        if self.dimensions == 1:
            level_counts += [(3 << k,) for k in range(halved - 1)]
        return sorted(level_counts, key=math.prod)

    @property
    def levels(self) -> int:
        """The deepest level."""
        return len(self._levels) - 1

    def counts(self, level: int) -> tuple[int, ...]:
        """Return cells by axis of a level."""
        return self._levels[level]

    @cached_property
    def below(self) -> tuple[int, ...]:
        """The level that halves the cells of each level, or -1."""
        level_of = {math.prod(counts): level for level, counts in enumerate(self._levels)}
        return tuple(level_of.get(2 * cells, -1) for cells in level_of)

    @cached_property
    def parts(self) -> tuple[int, ...]:
        """Parts by axis of the whole box."""
        # cells of halves and of thirds are made of the same parts
        finer = (3 if self.dimensions == 1 else 1) << self.finer
        return tuple(finer * n for n in self.counts(self.levels))

    def inner(self, level: int) -> tuple[int, ...]:
        """Return the numbers of parts by axis of one cell of a level."""
        return tuple(p // c for p, c in zip(self.parts, self.counts(level), strict=True))

    def boxes(self, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Return [cells, d] lower and upper ends in [-1, 1] of a level's cells."""
        counts = np.array(self.counts(level), np.int64)
        cell_places = list(np.ndindex(*counts.tolist()))
        places = np.array(cell_places, np.float64).reshape(len(cell_places), self.dimensions)
        return 2.0 * places / counts - 1.0, 2.0 * (places + 1.0) / counts - 1.0

    def members(self, level: int) -> np.ndarray:
        """Return [cells, parts of a cell] flat numbers of the parts of every cell of a level."""
        counts, inner = self.counts(level), self.inner(level)
        whole = np.arange(math.prod(self.parts)).reshape([n for pair in zip(counts, inner, strict=True) for n in pair])
        order = [*range(0, 2 * self.dimensions, 2), *range(1, 2 * self.dimensions, 2)]
        return whole.transpose(order).reshape(math.prod(counts), math.prod(inner))

    def first(self, moves: np.ndarray, displacement: float) -> np.ndarray:
        """Return [...] the first level whose cells suit samples that move by ``moves`` [..., d] over the box."""
        inverse = (1.0 / np.array(self.counts(level), np.float64) for level in range(self.levels))
        first_levels = np.zeros(moves.shape[:-1], np.int64)
        for level, row in enumerate(inverse):
            first_levels[(first_levels == level) & (moves @ row > displacement)] = level + 1
        return first_levels

    def children(self, level: int, cells: np.ndarray) -> np.ndarray:
        """Return [2 n] cells of the level `below` inside ``cells`` [n]."""
        counts, halves = self.counts(level), self.counts(self.below[level])
        axis = int(np.argmax(np.array(halves) > counts))
        places = np.array(np.unravel_index(cells, counts)).reshape(self.dimensions, -1)
        child_numbers = []
        for half in (0, 1):
            inside = places.copy()
            inside[axis] = 2 * inside[axis] + half
            child_numbers.append(np.ravel_multi_index(tuple(inside), halves))
        return np.concatenate(child_numbers)


def division_for(
    moves: np.ndarray, displacement: float, most_parts: int, deeper: int, finer: int, swept: bool = False
) -> Division | None:
    """Return the subdivision whose cells keep samples within ``displacement``; ``moves`` [n, samples, d] over the box.

    ``finer``: see `Division`. ``swept``: whether the last axis is a sample's own interval, which is as wide in any box.
    Returns None where there would be more than ``most_parts`` parts and narrower boxes would need fewer.
    """
    d = moves.shape[2]
    if d == 0:
        return Division((), 0)
    widest = moves.reshape(-1, d).max(axis=0)
    if not np.isfinite(widest).all():
        return None
    levels = (most_parts // 3 if d == 1 else most_parts).bit_length() - 1 - deeper - d * finer
    axes: list[int] = []
    while widest.sum() > displacement:
        if len(axes) >= levels:
            if widest[: d - swept].sum() > displacement:
                return None
            break
        axis = int(np.argmax(widest))
        axes.append(axis)
        widest[axis] *= 0.5
    for _ in range(deeper):
        axis = int(np.argmax(widest))
        axes.append(axis)
        widest[axis] *= 0.5
    return Division(tuple(axes), d, finer)


@dataclass(frozen=True)
class RayCells:
    """Cells of one level, each of a ray and perhaps of one of its samples: numbers [k]."""

    ray: np.ndarray
    cell: np.ndarray
    sample: Any = None

    def __len__(self) -> int:
        return self.ray.size

    def take(self, which: np.ndarray | slice) -> RayCells:
        """Return the cells numbered ``which``."""
        parts: list[Any] = [None if part is None else part[which] for part in vars(self).values()]
        return RayCells(*parts)

    def chunks(self, size: int) -> Iterator[RayCells]:
        """Yield the cells in chunks of at most ``size``."""
        return (self.take(slice(start, start + size)) for start in range(0, len(self), size))


def join_cells(parts: Sequence[RayCells]) -> RayCells:
    """Return all cells of ``parts``, at least one, of samples or of whole rays."""
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    whole: list[Any] = [None if column[0] is None else np.concatenate(column) for column in columns]
    return RayCells(*whole)


#: What lower and upper bounds of several parts become.
ENDS = (np.minimum, np.maximum)


def regroup_parts(values: np.ndarray, end: np.ufunc, counts: tuple[int, ...]) -> np.ndarray:
    """Return bounds [n, shifts, *parts, 3] of equal parts of a box for other parts, ``counts`` by axis.

    ``end`` (minimum or maximum) combines the bounds of all parts that a new part meets.
    """
    for axis, count in enumerate(counts, start=2):
        size = values.shape[axis]
        starts = np.arange(count) * size // count
        stops = -(-(np.arange(count) + 1) * size // count)
        met = (values.take(np.arange(a, b), axis=axis) for a, b in zip(starts, stops, strict=True))
        values = np.stack([end.reduce(some, axis=axis) for some in met], axis=axis)
    return values
