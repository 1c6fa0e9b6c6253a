"""Boxes in a set's own parameters that contain all poses of sheared cells (docs/dev/design.md, U4)."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from ns_abstract.arithmetic.rounding import POSE_ROUNDING
from ns_abstract.geometry.box import Float64Array, ParameterBox
from ns_abstract.verify.cell_boxes import inner_cell, slabs
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.location import UNITS

#: Most cells of a cover that are left, and by how much their volume may exceed that of what they hold.
MOST, SPARE = 1500, 1.03
#: Parts along each parameter that turns make up for, where the volume of what lies in a set is summed.
_PARTS = 8


@dataclass(frozen=True)
class PoseCover:
    """A set cut into cells that tile it: those with possible poses, and those without."""

    grid: CellGrid
    left: tuple[Cell, ...]
    excluded: tuple[Cell, ...]

    @property
    def volume(self) -> float:
        """The fraction of the set in cells with possible poses."""
        return sum(cell.volume for cell in self.left) / self.grid.volume

    @property
    def hull(self) -> ParameterBox | None:
        """The smallest box of the set around all cells with possible poses; None: there are none."""
        if not self.left:
            return None
        first = tuple(min(cell.first[k] for cell in self.left) for k in range(len(self.grid.units)))
        past = tuple(max(cell.past[k] for cell in self.left) for k in range(len(self.grid.units)))
        return self.grid.box_of(Cell(first, past))


class ShearedBoxes:
    """Boxes of sheared parameters, and enclosures of them in the set's own parameters.

    Args:
        shear: As of `PoseBox`: name to other to factor.
    """

    def __init__(
        self, lower: Float64Array, upper: Float64Array, names: tuple[str, ...], shear: Mapping[str, Mapping[str, float]]
    ) -> None:
        self.lower, self.upper, self.volumes = lower, upper, np.prod(upper - lower, axis=1)
        self._terms = [
            (names.index(name), [(names.index(other), factor) for other, factor in factors.items()])
            for name, factors in shear.items()
        ]

    def volume_within(self, box: ParameterBox) -> float:
        """Return an upper bound of the volume of the boxes' poses in ``box``, a sum over parts of the boxes."""
        lower, upper = (np.array(end) for end in (box.lower, box.upper))
        sheared = [axis for axis, _ in self._terms]
        plain = [axis for axis in range(len(lower)) if axis not in sheared]
        shifts = sorted({other for _, terms in self._terms for other, _ in terms})
        # what of the other parameters goes with turns of the set
        chosen, *ends = self.within(box, np.arange(len(self.lower)))
        own_lower, own_upper = self.lower[chosen], self.upper[chosen]
        own_lower[:, plain], own_upper[:, plain] = (end[:, plain] for end in ends)
        steps, total = (own_upper - own_lower)[:, shifts] / _PARTS, 0.0
        for part in itertools.product(range(_PARTS), repeat=len(shifts)):
            least, most = own_lower.copy(), own_upper.copy()
            least[:, shifts] = own_lower[:, shifts] + steps * part
            most[:, shifts] = least[:, shifts] + steps
            lengths = (most - least).clip(0.0)
            for axis, terms in self._terms:
                # at each pose of the part, what the set leaves of the turn, which the parameters in terms go with
                moved = [(factor * least[:, other], factor * most[:, other]) for other, factor in terms]
                low, high = (sum(pick(a, b) for a, b in moved) for pick in (np.minimum, np.maximum))
                first, last = lower[axis] - least[:, axis], upper[axis] - most[:, axis]
                # the two overlap by most where their middles meet
                shift = (0.5 * (first + last)).clip(low, high)
                beyond = np.maximum(first - shift, shift - last).clip(0.0)
                lengths[:, axis] = np.minimum(lengths[:, axis] - beyond, upper[axis] - lower[axis]).clip(0.0)
            total += float(lengths.prod(axis=1).sum())
        return total

    def within(self, box: ParameterBox, chosen: np.ndarray) -> tuple[np.ndarray, Float64Array, Float64Array]:
        """Return which boxes of ``chosen`` [m] may have poses in ``box``, and ends [m, d] around these poses."""
        box_lower, box_upper = np.array(box.lower), np.array(box.upper)
        own_lower, own_upper = self.lower[chosen], self.upper[chosen]
        lower, upper = np.maximum(own_lower, box_lower), np.minimum(own_upper, box_upper)
        for axis, terms in self._terms:
            least, most = own_lower[:, axis].copy(), own_upper[:, axis].copy()
            size = np.abs(least) + np.abs(most)
            for other, factor in terms:
                a, b = factor * lower[:, other], factor * upper[:, other]
                least, most, size = least + np.minimum(a, b), most + np.maximum(a, b), size + np.abs(a) + np.abs(b)
            room = POSE_ROUNDING * (size + abs(box_lower[axis]) + abs(box_upper[axis]))
            lower[:, axis] = np.maximum(least - room, box_lower[axis])
            upper[:, axis] = np.minimum(most + room, box_upper[axis])
            for other, factor in terms:
                # what the other terms leave of the rotation's range
                a, b = factor * lower[:, other], factor * upper[:, other]
                rest_least, rest_most = least - np.minimum(a, b), most - np.maximum(a, b)
                ends = (lower[:, axis] - rest_most - room) / factor, (upper[:, axis] - rest_least + room) / factor
                extra = room / abs(factor)
                lower[:, other] = np.maximum(lower[:, other], np.minimum(*ends) - extra)
                upper[:, other] = np.minimum(upper[:, other], np.maximum(*ends) + extra)
        some = (lower <= upper).all(axis=1)
        return chosen[some], lower[some], upper[some]


def cover(
    box: ParameterBox, boxes: ShearedBoxes, most_cells: int = MOST, late: Callable[[], bool] = lambda: False
) -> PoseCover:
    """Return a tiling of a set by cells of its own parameters, about ``most_cells`` of which meet ``boxes``.

    ``late``: whether the time is over; cells are not cut from then on.
    """
    d = box.dimensions
    grid = CellGrid(box, (1 << UNITS,) * d, (1,) * d)
    excluded: list[Cell] = []
    finished: list[Cell] = []
    queue: list[tuple[int, int, Cell, np.ndarray]] = []
    count = 0

    def add(cell: Cell, chosen: np.ndarray) -> None:
        nonlocal count
        chosen, lower, upper = boxes.within(grid.box_of(cell), chosen)
        if not chosen.size:
            excluded.append(cell)
            return
        inner = inner_cell(grid, cell, box.with_ends(lower.min(axis=0), upper.max(axis=0)))
        excluded.extend(slabs(cell, inner))
        count += 1
        # a slanted box fills less than the box around it
        filled = float(np.minimum(np.prod(upper - lower, axis=1), boxes.volumes[chosen]).sum())
        taken = float(np.prod(np.array(grid.box_of(inner).upper) - np.array(grid.box_of(inner).lower)))
        if taken <= SPARE * filled or inner.volume == 1:
            finished.append(inner)
        else:
            heapq.heappush(queue, (-inner.volume, count, inner, chosen))

    add(Cell((0,) * d, grid.units), np.arange(len(boxes.lower)))
    while queue and len(queue) + len(finished) < most_cells and not late():
        _, _, cell, chosen = heapq.heappop(queue)
        halves = min(
            (grid.cut(cell, [2 if k == axis else 1 for k in range(d)]) for axis in range(d)),
            key=lambda parts: _hull_volume(grid, boxes, parts, chosen),
        )
        if len(halves) == 1:
            finished.append(cell)
            continue
        for half in halves:
            add(half, chosen)
    return PoseCover(grid, (*finished, *(entry[2] for entry in queue)), tuple(excluded))


def _hull_volume(grid: CellGrid, boxes: ShearedBoxes, parts: list[Cell], chosen: np.ndarray) -> float:
    """Return the summed volume of the hulls of the boxes ``chosen`` in each of the cells ``parts``; inf for one."""
    if len(parts) == 1:
        return np.inf
    total = 0.0
    for part in parts:
        some, lower, upper = boxes.within(grid.box_of(part), chosen)
        if some.size:
            total += float(np.prod(upper.max(axis=0) - lower.min(axis=0)))
    return total
