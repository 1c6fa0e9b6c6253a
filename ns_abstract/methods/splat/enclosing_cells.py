"""What the cells around a cell show: few Gaussians may be seen on the pixels that are wanted (design.md, U8)."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.enclosing_boxes import box_of_motion


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


@dataclass(frozen=True)
class ContextTuning:
    """Preferences about the contexts of enclosing cells. None of them decides whether a bound holds."""

    #: Pixels that the picture may move by over a cell along each parameter, about, where that is enough.
    motion: float = 2.0
    #: Most bytes that are kept.
    most: int = 1 << 27


_TUNING = ContextTuning()


class EnclosingCells:
    """Cells around others, by which a set is divided evenly; the latest are kept.

    Args:
        box: The set.
        motion: Tells by how many pixels [d] the picture moves over a box.
        context: Tells what a box may show.
    """

    def __init__(
        self,
        box: ParameterBox,
        motion: Callable[[ParameterBox], np.ndarray],
        context: Callable[[ParameterBox], EnclosingContext],
    ) -> None:
        self._box, self._find_motion, self._context = box, motion, context
        self._kept: dict[ParameterBox, EnclosingContext] = {}
        self._lock = threading.Lock()

    def around(self, box: ParameterBox) -> EnclosingContext | None:
        """What a cell around ``box`` may show; None: ``box`` reaches beyond the set."""
        enclosing = box_of_motion(box, self._box, self._motion, _TUNING.motion)
        if enclosing is None:
            return None
        with self._lock:
            context = self._kept.pop(enclosing, None)
        context = context or self._context(enclosing)
        with self._lock:
            self._kept[enclosing] = context
            while len(self._kept) > 1 and sum(kept.nbytes for kept in self._kept.values()) > _TUNING.most:
                del self._kept[next(iter(self._kept))]
        return context

    @cached_property
    def _motion(self) -> np.ndarray:
        return np.nan_to_num(np.asarray(self._find_motion(self._box), np.float64))
