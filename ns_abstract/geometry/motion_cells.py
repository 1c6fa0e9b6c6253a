"""Cells of the image motion at each square of pixels of a picture (docs/dev/design.md, B16)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ns_abstract.arithmetic.rounding import MOTION_SCALE
from ns_abstract.geometry.box import Float64Array


@dataclass(frozen=True)
class MotionCellTuning:
    """Preferences of motion cells. None of them decides whether a bound holds."""

    #: Regularisation of the pseudo-inverse: what is added to the diagonal of A A^T, as a share of its trace.
    regular: float = 1e-6


@dataclass(frozen=True, eq=False)
class MotionCells:
    """Equal cells of the scaled image motion q at each square of ``side`` pixels of a picture (design.md, B16).

    At a square ``q = A p`` lies in [-1, 1]^2 for the scaled parameters p in [-1, 1]^d of a cell of poses.

    Attributes:
        counts: [2] numbers of cells along the axes, powers of two, at least 8 together.
        motion: [squares, 4, d] two rows of A (absolute entries sum to at most 1), two of its transposed
            pseudo-inverse; squares row by row.
        side: Pixels across a square.
        typical: [2, d] columns and rows that the picture moves by for each parameter (an estimate).
    """

    counts: np.ndarray
    motion: Float64Array
    side: int
    typical: Float64Array


@dataclass(frozen=True, eq=False)
class MotionField:
    """By how much each square of ``side`` pixels of a picture moves over a cell of poses (an estimate).

    Attributes:
        pixels: [squares, 2, d] columns and rows that a square's content moves by over half of each parameter's range;
            squares row by row.
        side: Pixels across a square.
    """

    pixels: Float64Array
    side: int

    def cells(self, counts: np.ndarray) -> MotionCells:
        """Return `MotionCells` of this motion, ``counts`` [2] of them along the axes."""
        size = np.abs(self.pixels).sum(axis=-1, keepdims=True)
        rows = MOTION_SCALE * self.pixels / np.where(size > 0.0, size, 1.0)
        motion = np.ascontiguousarray(np.concatenate([rows, _inverse(rows)], axis=1))
        return MotionCells(counts, motion, self.side, self.pixels.mean(axis=0))

    def at(self, scaled: Float64Array, height: int, width: int) -> Float64Array:
        """[H, W, 2] columns and rows by which pixels move from the cell's middle to its parameters ``scaled`` [d]."""
        squares = (self.pixels @ scaled).reshape(-(-height // self.side), -(-width // self.side), 2)
        return squares.repeat(self.side, axis=0).repeat(self.side, axis=1)[:height, :width]


def square_numbers(columns: np.ndarray, rows: np.ndarray, width: int, side: int) -> np.ndarray:
    """Return row-major numbers of the squares of ``side`` pixels that hold pixels of a picture ``width`` wide."""
    return rows // side * -(-width // side) + columns // side


def _inverse(rows: Float64Array) -> Float64Array:
    """Return the transposed, regularised pseudo-inverses [n, 2, d] of matrices ``rows`` [n, 2, d]."""
    products = rows @ rows.swapaxes(1, 2)
    trace = np.trace(products, axis1=1, axis2=2)[:, None, None]
    return np.linalg.solve(products + (MotionCellTuning.regular * trace + (trace == 0.0)) * np.eye(2), rows)
