"""Excludes sub-boxes of a cell of poses by pixels that exclude cells of the image motion (docs/dev/design.md, U11)."""

from __future__ import annotations

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import SUB_BOX_OVERLAP
from ns_abstract.geometry.box import Float64Array, part_middles
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.motion_cells import MotionCells, square_numbers


class MotionBoxes:
    """Sub-boxes of a cell, and the motion cells that each may show at each pixel (docs/dev/design.md, U11).

    Args:
        cells: Motion cells of the cell.
        counts: [d] sub-boxes along its axes.
        camera: Of the picture.

    Attributes:
        moved: [k, 2] columns and rows by which the picture moves from the cell's middle to that of each sub-box.
    """

    def __init__(self, cells: MotionCells, counts: np.ndarray, camera: PinholeCamera) -> None:
        self.cells, self._width = cells, camera.width
        self._middles: Float64Array = np.ascontiguousarray(part_middles(counts).T)
        self._half: Float64Array = 1.0 / counts + SUB_BOX_OVERLAP
        self.moved = self._middles @ cells.typical.T

    def excluded(self, excluding: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """Return [n, k] which of the ``n`` ``pixels`` [T, side, side] exclude which of ``k`` sub-boxes.

        A pixel excludes a sub-box if it excludes, by ``excluding`` [n, cells], all motion cells that the sub-box meets.
        """
        rows, columns = self.cells.counts.tolist()
        # cells that are kept before each line
        kept = np.zeros((len(excluding), rows + 1, columns + 1), np.int32)
        kept[:, 1:, 1:] = (~excluding).reshape(-1, rows, columns).cumsum(axis=1).cumsum(axis=2)
        tiles, row, column = np.nonzero(pixels)
        side = pixels.shape[1]
        down, across = np.divmod(tiles, -(-self._width // side))
        numbers = square_numbers(across * side + column, down * side + row, self._width, self.cells.side)
        out = np.empty((len(excluding), len(self._middles)), bool)
        _excluded(kept, self.cells.motion[numbers], self._middles, self._half, out)
        return out


@njit(cache=True, error_model="numpy", nogil=True)
def _excluded(kept, motion, middles, half, out):
    """Set ``out`` [n, k]: whether all motion cells that box ``middles`` [k, d] +- ``half`` meets are excluded.

    ``kept``: the motion cells that are not. The rounding of ends is far below the overlap of the cells.
    """
    rows, columns, d = kept.shape[1] - 1, kept.shape[2] - 1, half.size
    for pixel in range(out.shape[0]):
        sums = kept[pixel]
        reach0, reach1 = 0.0, 0.0
        for k in range(d):
            reach0 += abs(motion[pixel, 0, k]) * half[k]
            reach1 += abs(motion[pixel, 1, k]) * half[k]
        for box in range(out.shape[1]):
            q0, q1 = 1.0, 1.0
            for k in range(d):
                q0 += motion[pixel, 0, k] * middles[box, k]
                q1 += motion[pixel, 1, k] * middles[box, k]
            top = min(max(int(0.5 * rows * (q0 - reach0)), 0), rows - 1)
            bottom = min(max(int(0.5 * rows * (q0 + reach0)), 0), rows - 1) + 1
            left = min(max(int(0.5 * columns * (q1 - reach1)), 0), columns - 1)
            right = min(max(int(0.5 * columns * (q1 + reach1)), 0), columns - 1) + 1
            out[pixel, box] = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left] == 0


def warm_up() -> None:
    """Compile the kernels of `MotionBoxes.excluded`."""
    _excluded(np.zeros((1, 9, 9), np.int32), np.zeros((1, 4, 2)), np.zeros((1, 2)), np.ones(2), np.empty((1, 1), bool))
