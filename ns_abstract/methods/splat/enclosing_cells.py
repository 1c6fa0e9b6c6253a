"""What the cells around a cell show: few Gaussians may be seen on the pixels that are wanted (design.md, U8)."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ns_abstract.geometry.box import ParameterBox


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
class EnclosingTuning:
    """Preferences about enclosing cells. None of them decides whether a bound holds."""

    #: Pixels that the picture may move by over one, along each parameter, or so many times what it does over the cell.
    motion: float = 2.0
    times: float = 2.0
    #: Most bytes that are kept.
    most: int = 1 << 27


_TUNING = EnclosingTuning()


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
        context: Callable[[ParameterBox], VisibleContext],
    ) -> None:
        self._box, self._find_motion, self._context = box, motion, context
        self._moved: list[float] = []
        self._kept: dict[ParameterBox, VisibleContext] = {}
        self._lock = threading.Lock()

    def around(self, box: ParameterBox) -> VisibleContext | None:
        """What a cell around ``box`` may show; None: ``box`` reaches beyond the set."""
        enclosing = self._enclosing(box)
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

    def _enclosing(self, box: ParameterBox) -> ParameterBox | None:
        """The narrowest of the cells around ``box`` that are wide enough to be of use for others."""
        if not self._moved:
            self._moved = np.nan_to_num(np.asarray(self._find_motion(self._box), np.float64)).tolist()
        around = self._box
        for k, (low, high) in enumerate(zip(self._box.lower, self._box.upper, strict=True)):
            if not low <= box.lower[k] <= box.upper[k] <= high:
                return None
            width = high - low
            if not 0.0 < width < math.inf:
                continue
            least = _TUNING.times * (box.upper[k] - box.lower[k]) / width
            parts = 1 << max(
                0, math.floor(-math.log2(max(least, _TUNING.motion / max(self._moved[k], _TUNING.motion))))
            )
            while parts > 1:
                step = math.floor((box.lower[k] - low) / width * parts)
                first, last = low + width * (step / parts), low + width * ((step + 1) / parts)
                if first <= box.lower[k] and box.upper[k] <= last:
                    around = around.replace(k, max(first, low), min(last, high))
                    break
                parts //= 2
        return around
