"""The tiles of a frame that one refinement bounds, and the cells over which they are bounded."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.refine.box_splitter import SubBox
from ns_abstract.refine.protocol import COLORS, DEPTH, Bounds, CellContext, Frame
from ns_abstract.refine.result import gap


class LeafCell:
    """A sub-box of the set, the context for cells inside it, and the picture's variation along each axis [d]."""

    __slots__ = ("context", "narrow", "number", "part", "slopes")

    def __init__(self, number: int, part: SubBox, narrow: bool) -> None:
        self.number, self.part, self.narrow = number, part, narrow
        self.context: CellContext | None = None
        self.slopes = np.zeros(part.box.dimensions)

    @property
    def box(self) -> ParameterBox:
        """The box of parameters."""
        return self.part.box


class FrameTiles:
    """Some tiles of a frame, numbered by their place in the list; measures are those of their pixels (R6)."""

    def __init__(self, frame: Frame, tiles: np.ndarray | None = None, keep_linear: bool = False) -> None:
        self.frame, self.keep_linear = frame, keep_linear
        self.selected = None if tiles is None else np.asarray(tiles, np.int64)
        self.count = frame.tile_count if self.selected is None else self.selected.size
        self.all = np.arange(self.count)
        self.inside = pixels_inside(frame)[self.numbers(None)]

    @property
    def shape(self) -> tuple[int, int, int]:
        """The shape of one tile's values."""
        return self.frame.side, self.frame.side, self.frame.channels

    @property
    def by_pixel(self) -> bool:
        """Whether cells may be split for some of their pixels only: not if linear sets or further outputs are kept."""
        return not self.keep_linear and self.frame.channels == COLORS

    def numbers(self, places: np.ndarray | None) -> np.ndarray:
        """Return the frame's numbers of the tiles at ``places``; None: of all."""
        if self.selected is None:
            return self.all if places is None else places
        return self.selected if places is None else self.selected[places]

    def filled(self, value: float) -> np.ndarray:
        """Return [t, side, side, channels] float32 filled with one value."""
        return np.full((self.count, *self.shape), value, np.float32)

    def render(self, render: Callable[..., np.ndarray], values: np.ndarray, places: np.ndarray | None) -> np.ndarray:
        """Return tiles at ``places`` (None: all) rendered by ``render`` at parameter values [d]."""
        whole = self.selected is None and places is None
        return render(values, None if whole else self.numbers(places))

    def bound(
        self, cells: Sequence[LeafCell], parent: LeafCell | None, places: np.ndarray, pixels: np.ndarray | None = None
    ) -> Sequence[Bounds]:
        """Return bounds of each cell in the tiles at ``places``.

        Args:
            parent: A cell that was bounded in these tiles before, or None.
            pixels: [t, side, side] which pixels are needed, of those that were needed of ``parent``; None: all.
        """
        within = None if parent is None else parent.context
        boxes, numbers = [cell.box for cell in cells], self.numbers(places)
        return self.frame.bound_parts(boxes, numbers, within, self.keep_linear, pixels)

    def mean_gap(self, lower: np.ndarray, upper: np.ndarray, places: np.ndarray | None = None) -> float:
        """Return the MPG between values [t, side, side, channels] of the tiles at ``places`` [t]; None: all."""
        inside = self.inside if places is None else self.inside[places]
        return float(gap(lower[..., :COLORS], upper[..., :COLORS])[inside].mean())


def pixels_inside(frame: Frame) -> np.ndarray:
    """Return [T, side, side] whether a tile's pixel belongs to the image."""
    rows = np.arange(frame.down * frame.side) < frame.camera.height
    columns = np.arange(frame.across * frame.side) < frame.camera.width
    grid = (rows[:, None] & columns[None, :]).reshape(frame.down, frame.side, frame.across, frame.side)
    return grid.swapaxes(1, 2).reshape(-1, frame.side, frame.side)


def usable(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds clipped to [0, 1], depths to 0 on; those that are not finite, cross or miss it become unknown."""
    if lower.shape[-1] <= DEPTH and bool((lower >= 0.0).all() and (lower <= upper).all() and (upper <= 1.0).all()):
        return lower, upper
    good = np.isfinite(lower) & np.isfinite(upper) & (lower <= upper) & (lower <= 1.0) & (upper >= 0.0)
    low, high = np.clip(lower, 0.0, 1.0), np.clip(upper, 0.0, 1.0)
    low, high = np.where(good, low, np.zeros_like(low)), np.where(good, high, np.ones_like(high))
    if lower.shape[-1] > DEPTH:
        near, far = lower[..., DEPTH], upper[..., DEPTH]
        is_range = ((near <= far) & np.isfinite(near) & (near >= 0.0)) | ((near == np.inf) & (far == -np.inf))
        low[..., DEPTH], high[..., DEPTH] = np.where(is_range, near, 0.0), np.where(is_range, far, np.inf)
    return low, high


def context_bytes(context: CellContext | None) -> int:
    """Return the bytes of a context."""
    return 0 if context is None else context.nbytes
