"""Cells of a set of poses on an integer grid, which tile the set exactly (docs/dev/design.md, V6, V7)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.errors import InputError

#: Halvings of a first cell along each parameter.
HALVINGS = 10
#: Most first cells of a frame.
_MOST_FIRST = 1 << 16
#: Most grid units of a frame's fixed partition.
_MOST_UNITS = 10**9


@dataclass(frozen=True)
class CutTuning:
    """Preferences on how cells are cut; soundness does not depend on them."""

    #: Part of a goal that cuts may miss it by, so that rounding does not cut once more.
    spare: float = 1e-9


@dataclass(frozen=True)
class Cell:
    """Units ``first[k]`` to ``past[k]`` (exclusive) of the grid along each parameter; empty for a single pose.

    Attributes:
        outliers: Numbers of a photo's pixels that are outliers at every pose of the cell (U9); ignored by comparisons.
    """

    first: tuple[int, ...]
    past: tuple[int, ...]
    outliers: tuple[int, ...] = field(default=(), compare=False, repr=False)

    @property
    def volume(self) -> int:
        """Number of grid units."""
        return math.prod(b - a for a, b in zip(self.first, self.past, strict=True))


@dataclass(frozen=True)
class CellGrid:
    """The grid of a frame: each parameter's range cut into ``units[k]`` equal units, of which cells consist.

    The search begins with ``coarse[k]`` cells along each.
    """

    box: ParameterBox
    units: tuple[int, ...]
    coarse: tuple[int, ...]

    @classmethod
    def adaptive(cls, box: ParameterBox, coarse: Sequence[int]) -> CellGrid:
        """Return a grid whose units are initial cells halved `HALVINGS` times."""
        return cls(box, tuple(n << HALVINGS for n in coarse), tuple(coarse))

    @classmethod
    def fixed(cls, box: ParameterBox, partitions: Sequence[int], coarse: Sequence[int]) -> CellGrid:
        """Return the grid of a fixed partition, as in the paper."""
        if len(partitions) != box.dimensions:
            raise InputError(
                f"{len(partitions)} numbers, the set has {box.dimensions} parameters: {', '.join(box.names) or 'none'}",
                field="partitions",
                fix="write one number by parameter",
            )
        if math.prod(partitions) > _MOST_UNITS:
            raise InputError(f"found {math.prod(partitions)} partitions", field="partitions", fix="write fewer")
        return cls(box, tuple(partitions), tuple(min(n, c) for n, c in zip(partitions, coarse, strict=True)))

    @property
    def volume(self) -> int:
        """Number of units."""
        return math.prod(self.units)

    def end(self, axis: int, position: int) -> float:
        """Return the parameter's value at a grid line."""
        low, high = self.box.lower[axis], self.box.upper[axis]
        return high if position == self.units[axis] else low + (high - low) * (position / self.units[axis])

    def box_of(self, cell: Cell) -> ParameterBox:
        """Return the cell as a box of parameters; neighbours share their ends exactly."""
        lower, upper = (tuple(itertools.starmap(self.end, enumerate(ends))) for ends in (cell.first, cell.past))
        return ParameterBox(self.box.names, self.box.units, lower, upper)

    def roots(self) -> list[Cell]:
        """Return the initial cells in order."""
        lines = [[n * i // c for i in range(c + 1)] for n, c in zip(self.units, self.coarse, strict=True)]
        spans = [list(itertools.pairwise(line)) for line in lines]
        return [Cell(tuple(a for a, _ in part), tuple(b for _, b in part)) for part in itertools.product(*spans)]

    def divide(self, cell: Cell, slopes: np.ndarray, shrink: float, most_parts: int) -> list[Cell]:
        """Return parts of the cell, halved repeatedly along the parameter of the largest slope; empty for one unit.

        ``slopes`` [d]: gain of a cut along each parameter. The cell is halved at least once, until the slopes' sum is
        ``shrink`` times smaller or there are ``most_parts`` parts.
        """
        gains = np.where(np.isfinite(slopes), slopes, 0.0)
        sizes = np.array(cell.past, np.int64) - np.array(cell.first, np.int64)
        if not gains.any():
            # halves all in turn
            gains = sizes.astype(np.float64)
        parts = [1] * len(gains)
        goal = shrink * float(gains.sum())
        while True:
            free = np.flatnonzero(sizes > 1)
            count = math.prod(parts)
            if not free.size or 2 * count > most_parts or (count > 1 and gains.sum() <= goal * (1.0 + CutTuning.spare)):
                break
            axis = int(free[np.lexsort((-sizes[free], -gains[free]))[0]])
            parts[axis] *= 2
            gains[axis] *= 0.5
            sizes[axis] //= 2
        return [] if math.prod(parts) == 1 else self.cut(cell, parts)

    def cut(self, cell: Cell, parts: Sequence[int]) -> list[Cell]:
        """Return the cell cut into ``parts[k]`` parts along each parameter, at most into its units."""
        sizes = [past - first for first, past in zip(cell.first, cell.past, strict=True)]
        parts = [min(n, size) for n, size in zip(parts, sizes, strict=True)]
        spans = [
            [(first + (past - first) * i // n, first + (past - first) * (i + 1) // n) for i in range(n)]
            for first, past, n in zip(cell.first, cell.past, parts, strict=True)
        ]
        return [Cell(tuple(a for a, _ in part), tuple(b for _, b in part)) for part in itertools.product(*spans)]


def initial_divisions(motion: np.ndarray, pixels: float) -> tuple[int, ...]:
    """Return the numbers of initial cells along each parameter such that the picture moves by ``pixels`` in one.

    They are fewer where there would be too many: in several parameters the search finds where fine cells are needed.
    """
    counts = [max(1, math.ceil(m / pixels)) if np.isfinite(m) else 1 for m in motion]
    while math.prod(counts) > _MOST_FIRST:
        counts[int(np.argmax(counts))] //= 2
    return tuple(counts)
