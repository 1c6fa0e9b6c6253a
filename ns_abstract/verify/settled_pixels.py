"""Finds the pixels whose bounds over a box do not yet decide a claim (docs/dev/design.md, Q5)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ns_abstract.verify.picture_measures import Measure


@dataclass(frozen=True)
class SettledTuning:
    """When a pixel's bounds are tight enough; soundness does not depend on it."""

    #: How far from a limit a pixel has to stay, so that margins which rest on it are not lost to rounding.
    room: float = 2.0**-8


_TUNING = SettledTuning()


@dataclass(frozen=True)
class LimitedMeasure:
    """A measure, the first channel of its plane in pictures, and the finite limits of the claim."""

    measure: Measure
    place: int
    limits: tuple[float, ...]

    @property
    def counts(self) -> bool:
        """Whether only the number of pixels beyond a limit matters, not their values."""
        measure = self.measure
        plain = measure.minus is None and measure.channels == (1.0,) and math.isinf(measure.cap)
        return measure.rank is not None and plain


def unsettled(measures: Sequence[LimitedMeasure], lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return [H, W] bool: the pixels whose bounds [H, W, C] do not settle what they add to a claim (Q5).

    All pictures within the bounds that agree at these pixels have the same verdict. ``measures`` are all that the claim
    uses.
    """
    still_open = np.zeros(lower.shape[:2], bool)
    flat, low, high = still_open.reshape(-1), lower.reshape(-1, lower.shape[-1]), upper.reshape(-1, upper.shape[-1])
    for one in measures:
        measure = one.measure
        if not one.counts:
            flat[measure.pixels] = True
            if measure.minus is not None:
                flat[measure.minus] = True
            continue
        assert measure.rank is not None
        ends = low[measure.pixels, one.place], high[measure.pixels, one.place]
        total = measure.pixels.size
        needed = total - measure.rank + 1 if measure.least else measure.rank
        for limit in one.limits:
            above, below = ends[0] > limit + _TUNING.room, ends[1] < limit - _TUNING.room
            # as many surely above as it takes, or so few that may be
            if int(above.sum()) < needed <= total - int(below.sum()):
                flat[measure.pixels[~(above | below)]] = True
    return still_open
