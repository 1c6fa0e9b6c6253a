"""Boxes around cells on a dyadic grid of the set, so that values computed once for a box serve all cells in it (Q5)."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np

from ns_abstract.geometry.box import ParameterBox


@dataclass(frozen=True)
class EnclosingTuning:
    """How much wider enclosing boxes are. None of it decides whether a bound holds."""

    #: Exponent of the least factor (a power of two) by which an enclosing box is wider than the cell, by parameter.
    halvings: int = 1
    #: Most pixels by which the picture moves over an enclosing box; bounds over wider ones are too loose.
    motion: float = 8.0
    #: By how much a cell's end may miss a line of the grid through rounding, as a share of a grid interval; and by how
    #: much a box reaches beyond its lines, likewise, so that such ends lie inside.
    spare: float = 1e-6
    beyond: float = 1e-9
    #: About how many pixels the picture moves by along each parameter over a box of `EnclosingBoxes`, unless a cell is
    #: wider; and most bytes of the values that are kept for them.
    shared_motion: float = 2.0
    most: int = 1 << 27
    #: Most halvings of other parameters before a parameter is halved over which the picture hardly moves.
    deepest: int = 64


_TUNING = EnclosingTuning()


def enclosing_box(cell: ParameterBox, whole: ParameterBox, motion: np.ndarray) -> ParameterBox | None:
    """Return the box around a cell, inside the set ``whole``, two to eight times wider along each parameter (Q5).

    Its ends lie on a dyadic grid of ``whole``, so that neighbouring cells of similar widths share it. ``motion`` [d]
    are pixels by which the picture moves over each range of ``whole``. None: it would move too much over the box.
    """
    levels = [max(0, level - _TUNING.halvings) for level in _levels(cell, whole)]
    return _useful(_aligned(cell, whole, levels), cell, whole, motion)


def shared_box(box: ParameterBox, whole: ParameterBox, motion: np.ndarray) -> ParameterBox | None:
    """Return the wider box around an enclosing ``box``, over which parameters move the picture about equally (Q5).

    Enclosing boxes are as long and narrow as cells; a few shared boxes hold all of them. ``whole``, ``motion``: see
    `enclosing_box`. None: the picture would move too much, or the box is no wider.
    """
    most = float(np.max(motion, initial=0.0))
    if not math.isfinite(most):
        return None
    # halvings of other parameters until the picture moves by less over this one
    spared = [
        min(_TUNING.deepest, math.floor(math.log2(most / moved))) if moved > 0.0 else _TUNING.deepest
        for moved in motion.tolist()
    ]
    level = min((level + less for level, less in zip(_levels(box, whole), spared, strict=True)), default=0)
    aligned = box
    while aligned == box and level >= 0:
        aligned = _aligned(box, whole, [max(0, level - less) for less in spared])
        level -= 1
    return _useful(aligned, box, whole, motion)


def box_of_motion(cell: ParameterBox, whole: ParameterBox, motion: np.ndarray, pixels: float) -> ParameterBox | None:
    """Return the box around a cell, inside ``whole``, in which each parameter moves the picture by about ``pixels``.

    It is at least as much wider than the cell as `enclosing_box` (``motion``: see there). None: it leaves ``whole``.
    """
    if not (whole.contains(np.array(cell.lower)) and whole.contains(np.array(cell.upper))):
        return None
    few = [math.floor(math.log2(moved / pixels)) if moved > pixels else 0 for moved in motion.tolist()]
    widths = zip(_levels(cell, whole), few, strict=True)
    return _aligned(cell, whole, [max(0, min(level - _TUNING.halvings, least)) for level, least in widths])


class InMemory(Protocol):
    """A value whose size in memory is known."""

    @property
    def nbytes(self) -> int: ...


_Value = TypeVar("_Value", bound=InMemory)


class EnclosingBoxes(Generic[_Value]):
    """Cache of values that are computed for boxes around cells (`box_of_motion`); threads may share it.

    Args:
        whole: The parameter box of the pose set.
        motion: Returns pixels [d] by which the picture moves over each parameter's range of a box.
        find: Computes the value of a box.
    """

    def __init__(
        self, whole: ParameterBox, motion: Callable[[ParameterBox], np.ndarray], find: Callable[[ParameterBox], _Value]
    ) -> None:
        self._whole, self._find_motion, self._find = whole, motion, find
        self._kept: dict[ParameterBox, _Value] = {}
        self._lock = threading.Lock()

    def around(self, cell: ParameterBox) -> _Value | None:
        """Return the value of the box around ``cell``, cached by box; None: that box would reach beyond the set."""
        box = box_of_motion(cell, self._whole, self._motion, _TUNING.shared_motion)
        if box is None:
            return None
        with self._lock:
            value = self._kept.pop(box, None)
        value = value or self._find(box)
        with self._lock:
            self._kept[box] = value
            while len(self._kept) > 1 and sum(one.nbytes for one in self._kept.values()) > _TUNING.most:
                del self._kept[next(iter(self._kept))]
        return value

    @cached_property
    def _motion(self) -> np.ndarray:
        return np.nan_to_num(np.asarray(self._find_motion(self._whole), np.float64))


def _levels(cell: ParameterBox, whole: ParameterBox) -> list[int]:
    """Return, by parameter [d], the most halvings of ``whole`` that leave it at least as wide as the cell."""
    widths = zip(cell.lower, cell.upper, whole.lower, whole.upper, strict=True)
    return [
        max(0, math.floor(math.log2((high - low) / (past - first)) + _TUNING.spare)) if past > first else 0
        for first, past, low, high in widths
    ]


def _aligned(cell: ParameterBox, whole: ParameterBox, levels: Sequence[int]) -> ParameterBox:
    """Return the smallest box around the cell whose ends are lines of ``whole`` halved ``levels`` [d] times."""
    box = cell
    for axis, level in enumerate(levels):
        low, high = whole.lower[axis], whole.upper[axis]
        width, parts, first, past = high - low, 1 << level, 0, 1
        if parts > 1:
            first = math.floor((cell.lower[axis] - low) / width * parts + _TUNING.spare)
            past = math.ceil((cell.upper[axis] - low) / width * parts - _TUNING.spare)
        lower = low + width * ((first - _TUNING.beyond) / parts)
        upper = low + width * ((past + _TUNING.beyond) / parts)
        # the cell lies inside, whatever was rounded
        box = box.replace(axis, max(low, min(lower, cell.lower[axis])), min(high, max(upper, cell.upper[axis])))
    return box


def _useful(box: ParameterBox, cell: ParameterBox, whole: ParameterBox, motion: np.ndarray) -> ParameterBox | None:
    """Return ``box`` if it is not the cell and moves the picture by at most `EnclosingTuning.motion`, else None."""
    widths = zip(box.lower, box.upper, whole.lower, whole.upper, motion.tolist(), strict=True)
    moved = [
        pixels * (past - first) / (high - low) if high > low else pixels for first, past, low, high, pixels in widths
    ]
    return box if math.hypot(*moved) <= _TUNING.motion and box != cell else None
