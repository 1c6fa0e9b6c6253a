"""Contexts of enclosing cells: the few Gaussians that are visible on the requested pixels (docs/dev/design.md, U8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class VisibleContext:
    """The Gaussians that a cell may show on the requested pixels, reused for cells inside it.

    Attributes:
        visible: [n] scene indices.
        reach: [n, 4] int32 first and past columns, first and past rows of the pixels on which they may be visible.
    """

    visible: np.ndarray
    reach: np.ndarray

    @property
    def nbytes(self) -> int:
        """The bytes that it holds."""
        return self.visible.nbytes + self.reach.nbytes

    @property
    def shown(self) -> np.ndarray:
        """Numbers [n] of the Gaussians that the cell may show."""
        return self.visible


@dataclass(frozen=True)
class EnclosingContext(VisibleContext):
    """The context of an enclosing cell, on all pixels.

    Attributes:
        counts: [H, W] number of the Gaussians that may be visible on each pixel.
    """

    counts: np.ndarray

    @property
    def nbytes(self) -> int:
        return super().nbytes + self.counts.nbytes
