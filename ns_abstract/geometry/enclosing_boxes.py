"""Boxes around cells that depend on the cell and its set alone, so that what is known of them serves many cells."""

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

    #: An enclosing box is at least this power of two wider than the cell, along every parameter.
    halvings: int = 1
    #: Most pixels that the picture moves by over an enclosing box; bounds of wider ones say too little.
    motion: float = 8.0
    #: Halvings of the set that cells are told apart by, and parts of a box that ends of cells may miss a line of the
    #: grid by, as they are rounded; and parts of a box that it reaches beyond its lines, so that these ends lie inside.
    spare: float = 1e-6
    beyond: float = 1e-9
    #: Pixels that the picture moves by along each parameter over the boxes of `EnclosingBoxes`, about, where a cell is
    #: no wider; and most bytes that is kept of them.
    shared_motion: float = 2.0
    most: int = 1 << 27
    #: Most halvings of other parameters before a parameter is halved over which the picture hardly moves.
    deepest: int = 64


_TUNING = EnclosingTuning()


def enclosing_box(cell: ParameterBox, whole: ParameterBox, motion: np.ndarray) -> ParameterBox | None:
    """Return a box of ``whole`` around a cell of it, about two to eight times wider along each parameter.

    Its ends lie on a dyadic grid of ``whole``, so that neighbouring cells of about the same widths share it (Q5). None:
    the picture, which moves by ``motion`` [d] pixels over each parameter's range, would move by too much.
    """
    levels = [max(0, level - _TUNING.halvings) for level in _levels(cell, whole)]
    return _useful(_aligned(cell, whole, levels), cell, whole, motion)


def shared_box(box: ParameterBox, whole: ParameterBox, motion: np.ndarray) -> ParameterBox | None:
    """Return a wider box of ``whole`` around an enclosing one, over which the picture moves about alike by parameter.

    Enclosing boxes are as long and narrow as cells are; few of those around them serve all (Q5). None: it would be too
    wide to be of use, by ``motion`` as in `enclosing_box`, or is no wider.
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
    """Return a box of ``whole`` around a cell of it over which the picture moves by about ``pixels`` along a parameter.

    It is wider than the cell as `enclosing_box` is, and ``motion`` as there. None: the cell reaches beyond ``whole``.
    """
    if not (whole.contains(np.array(cell.lower)) and whole.contains(np.array(cell.upper))):
        return None
    few = [math.floor(math.log2(moved / pixels)) if moved > pixels else 0 for moved in motion.tolist()]
    widths = zip(_levels(cell, whole), few, strict=True)
    return _aligned(cell, whole, [max(0, min(level - _TUNING.halvings, least)) for level, least in widths])


class InMemory(Protocol):
    """What takes memory."""

    @property
    def nbytes(self) -> int: ...


_Value = TypeVar("_Value", bound=InMemory)


class EnclosingBoxes(Generic[_Value]):
    """What is known of boxes around cells, by which a set is divided evenly; the latest are kept.

    Args:
        whole: The set.
        motion: Tells by how many pixels [d] the picture moves over a box.
        find: Finds what is to be known of a box.
    """

    def __init__(
        self,
        whole: ParameterBox,
        motion: Callable[[ParameterBox], np.ndarray],
        find: Callable[[ParameterBox], _Value],
    ) -> None:
        self._whole, self._find_motion, self._find = whole, motion, find
        self._kept: dict[ParameterBox, _Value] = {}
        self._lock = threading.Lock()

    def around(self, cell: ParameterBox) -> _Value | None:
        """What is known of a box around a cell; None: the cell reaches beyond the set."""
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
    """[d] halvings of ``whole`` along each parameter that leave it as wide as the cell or less than twice as wide."""
    widths = zip(cell.lower, cell.upper, whole.lower, whole.upper, strict=True)
    return [
        max(0, math.floor(math.log2((high - low) / (past - first)) + _TUNING.spare)) if past > first else 0
        for first, past, low, high in widths
    ]


def _aligned(cell: ParameterBox, whole: ParameterBox, levels: Sequence[int]) -> ParameterBox:
    """The smallest box around the cell whose ends lie on lines of ``whole`` halved ``levels`` [d] times, or just by."""
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
    """``box`` if it is wider than the cell and the picture moves by little over it."""
    widths = zip(box.lower, box.upper, whole.lower, whole.upper, motion.tolist(), strict=True)
    moved = [
        pixels * (past - first) / (high - low) if high > low else pixels for first, past, low, high, pixels in widths
    ]
    return box if math.hypot(*moved) <= _TUNING.motion and box != cell else None
