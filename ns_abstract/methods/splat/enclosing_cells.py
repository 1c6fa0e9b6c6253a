"""What the cells around a cell show: few Gaussians may be seen on the pixels that are wanted (design.md, U8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class VisibleContext:
    """The Gaussians that a cell may show on the requested pixels, reused for the cells inside it.

    Attributes:
        visible: [n] scene indices.
        reach: [n, 4] int32 first and past columns, first and past rows of the pixels on which they may be seen.
    """

    visible: np.ndarray
    reach: np.ndarray

    @property
    def nbytes(self) -> int:
        """Memory that it holds."""
        return self.visible.nbytes + self.reach.nbytes

    @property
    def shown(self) -> np.ndarray:
        """Numbers [n] of the Gaussians that the cell may show."""
        return self.visible


@dataclass(frozen=True)
class EnclosingContext(VisibleContext):
    """The context of an enclosing cell, on all pixels.

    Attributes:
        counts: [H, W] how many of the Gaussians may be seen on each pixel.
    """

    counts: np.ndarray

    @property
    def nbytes(self) -> int:
        return super().nbytes + self.counts.nbytes
