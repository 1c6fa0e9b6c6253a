"""Measure what the correlation between a picture's pixels gains for a certificate (docs/design.md, V9).

Verdicts come from bounds into which the parameters are substituted everywhere; here certified cells are bounded
again in the weaker ways as well.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import Substitution
from ns_abstract.verify.search import FAILURES, Search

#: Ways to use the linear sets, and what they mean.
MODES: dict[Substitution, str] = {
    "everywhere": "parameters substituted into every intermediate bound; the verdicts rest on this",
    "end": "intermediate bounds from the pixels' intervals, parameters substituted into the result alone",
    "box": "pixels as independent intervals",
}
#: Half-widths that are tried are the cell's times powers of this, up to so many.
STEP, _LADDER = math.sqrt(2.0), 8


@dataclass(frozen=True)
class Comparison:
    """One certified cell.

    Attributes:
        box: The cell.
        margins: By mode, the proven lower bound of the margin on the cell; -inf where nothing is known.
        factors: By mode, the largest certified half-width about the cell's middle as a multiple of the cell's, on a
            ladder of steps of `STEP`; None if the narrowest step is not certified.
        open_ended: Modes whose widest step, or the whole set, is certified.
    """

    box: ParameterBox
    margins: dict[Substitution, float]
    factors: dict[Substitution, float | None]
    open_ended: tuple[Substitution, ...]


class _LateError(Exception):
    """Raised when the deadline has passed."""


class _Ladder:
    """Margins of boxes of different widths about the middle of a cell."""

    def __init__(self, search: Search, cell: ParameterBox, deadline: float) -> None:
        self.search, self.cell, self.deadline = search, cell, deadline
        self.known: dict[tuple[int, Substitution], float] = {}
        self.sets: dict[int, tuple[ParameterBox, tuple[np.ndarray, ...], np.ndarray, np.ndarray] | None] = {}
        self.query = search.claim.query(search.margins([(cell.middle, None)])[1])

    def box(self, step: int) -> ParameterBox:
        """The box of a step, no wider than the set."""
        if step == 0:
            return self.cell
        whole, found = self.search.grid.box, self.cell
        for axis, middle in enumerate(self.cell.middle.tolist()):
            half = 0.5 * (self.cell.upper[axis] - self.cell.lower[axis]) * STEP**step
            low, high = max(whole.lower[axis], middle - half), min(whole.upper[axis], middle + half)
            found = found.replace(axis, low, high)
        return found

    def margin(self, step: int, mode: Substitution) -> float:
        """Proven lower bound of the margin; -inf where nothing is known.

        Raises:
            _LateError: The time is over.
        """
        if (step, mode) not in self.known:
            if time.perf_counter() >= self.deadline:
                raise _LateError
            self.known[step, mode] = self._margin(step, mode)
        return self.known[step, mode]

    def _margin(self, step: int, mode: Substitution) -> float:
        search = self.search
        try:
            if step not in self.sets:
                self.sets[step] = None
                box = self.box(step)
                linear, lower, upper, _ = search.scene.sets(box)
                self.sets[step] = box, linear, lower, upper
            kept = self.sets[step]
            if kept is None:
                return -math.inf
            box, linear, lower, upper = kept
            images = search.model.input_sets(tuple(a[None] for a in linear), lower[None], upper[None])
            found = float(search.claim.proved(self.query, search.model.bound(images, self.query, mode), [box])[0])
        except InputError:
            raise
        except FAILURES:
            return -math.inf
        return found if math.isfinite(found) else -math.inf

    def largest(self, mode: Substitution) -> tuple[float | None, bool]:
        """The largest certified multiple before one that is not, and whether the ladder or the set ended first."""
        if self.margin(0, mode) > 0.0:
            for step in range(1, _LADDER + 1):
                if self.box(step - 1) == self.search.grid.box:
                    return STEP ** (step - 1), True
                if not self.margin(step, mode) > 0.0:
                    return STEP ** (step - 1), False
            return STEP**_LADDER, True
        for step in range(-1, -_LADDER - 1, -1):
            if self.margin(step, mode) > 0.0:
                return STEP**step, False
        return None, False


def compare(search: Search, cell: ParameterBox, deadline: float) -> Comparison | None:
    """Bound a cell in every mode; None if the time ends first.

    Args:
        search: Of the cell's frame.
        cell: A box with at least one parameter.
        deadline: Of `time.perf_counter`.
    """
    ladder = _Ladder(search, cell, deadline)
    margins: dict[Substitution, float] = {}
    factors: dict[Substitution, float | None] = {}
    ended: list[Substitution] = []
    try:
        for mode in MODES:
            margins[mode] = ladder.margin(0, mode)
        for mode in MODES:
            factors[mode], at_end = ladder.largest(mode)
            if at_end:
                ended.append(mode)
    except _LateError:
        return None
    return Comparison(cell, margins, factors, tuple(ended))


def gains(comparisons: Sequence[Comparison]) -> dict[Substitution, float | None]:
    """Return, by weaker mode, the geometric mean of how much wider the cells are that the strongest mode certifies.

    Cells where a width is unknown or ended by the ladder or the set are left out.
    """
    found: dict[Substitution, float | None] = {}
    for mode in MODES:
        if mode == "everywhere":
            continue
        logs = []
        for entry in comparisons:
            most, other = entry.factors["everywhere"], entry.factors[mode]
            if most is not None and other is not None and "everywhere" not in entry.open_ended:
                logs.append(math.log(most / other))
        found[mode] = math.exp(sum(logs) / len(logs)) if logs else None
    return found


def spread_by_volume(volumes: Sequence[float], count: int) -> list[int]:
    """Numbers of cells that hold ``count`` evenly spread places of their common volume, the middle ones first."""
    ends = np.cumsum(volumes)
    if not len(ends) or not ends[-1] > 0.0:
        return []
    order = sorted(range(count), key=lambda k: abs(2 * k + 1 - count))
    places = [(k + 0.5) / count for k in order]
    chosen = [int(min(np.searchsorted(ends, place * ends[-1], side="right"), len(ends) - 1)) for place in places]
    return list(dict.fromkeys(chosen))
