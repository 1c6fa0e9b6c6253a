"""Cuts the box of parameters of a pose set into sub-boxes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.refine.protocol import Frame


class SubBox(NamedTuple):
    """A part of the set, and whether its lower and upper ends along each axis [d] are ends of the set."""

    box: ParameterBox
    first: np.ndarray
    last: np.ndarray


class BoxSplitter:
    """Cuts the box of a frame's parameters; boxes narrower than the fraction ``narrowest`` of the set are not cut."""

    def __init__(self, frame: Frame, narrowest: float) -> None:
        self.frame, self.narrowest = frame, narrowest

    @property
    def whole(self) -> SubBox:
        """The whole set."""
        box = self.frame.box
        return SubBox(box, np.ones(box.dimensions, bool), np.ones(box.dimensions, bool))

    def cut(self, part: SubBox, axis: int, count: int = 2) -> list[SubBox]:
        """Return ``count`` equal parts of ``part`` along ``axis``, reduced to poses of the set, without empty ones."""
        whole, parts = part.box, []
        for box in whole.split(axis, count):
            inside = self.frame.feasible(box)
            if inside is not None:
                first = (part.first & np.equal(box.lower, whole.lower)) | np.greater(inside.lower, box.lower)
                last = (part.last & np.equal(box.upper, whole.upper)) | np.less(inside.upper, box.upper)
                parts.append(SubBox(inside, first, last))
        return parts

    def cut_all(self, parts: list[SubBox], axis: int) -> list[SubBox]:
        """Return the halves of all ``parts`` along ``axis``."""
        return [half for part in parts for half in self.cut(part, axis)]

    def halved(self, part: SubBox, slopes: np.ndarray, count: int) -> list[SubBox]:
        """Return up to ``count`` parts by halving ``part`` repeatedly along the axis of the largest of ``slopes``."""
        if part.box.dimensions == 1:
            return self.cut(part, 0, count)
        parts, slopes = [part], slopes.copy()
        for _ in range(count.bit_length() - 1):
            axis = self.steepest_axis(part.box, slopes)
            parts = self.cut_all(parts, axis)
            slopes[axis] *= 0.5
        return parts

    def steepest_axis(self, box: ParameterBox, slopes: np.ndarray) -> int:
        """Return the axis along which the picture varies most, of those that can be halved."""
        slopes = np.nan_to_num(slopes, nan=0.0, posinf=float(np.finfo(np.float64).max))
        # a parameter that only moves what the linear part does not see still has to be split
        if not np.any(slopes > 0.0):
            slopes = np.nan_to_num(self.frame.motion(box), nan=0.0)
        return int(np.argmax(np.where(self._narrow_axes(box), -1.0, slopes)))

    def is_narrow(self, box: ParameterBox) -> bool:
        """Return whether no axis can be halved sensibly; true for a single pose."""
        return bool(self._narrow_axes(box).all())

    def _narrow_axes(self, box: ParameterBox) -> np.ndarray:
        """Return [d] whether an axis cannot be halved sensibly."""
        root = self.frame.box
        width, whole = np.array(box.upper) - np.array(box.lower), np.array(root.upper) - np.array(root.lower)
        return width <= self.narrowest * whole
