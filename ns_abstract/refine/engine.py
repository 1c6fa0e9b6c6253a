"""Anytime refinement of one frame, with outer and inner bounds (docs/dev/design.md, R1-R4).

The set is covered by cells. Every (cell, tile) pair is a leaf with an outer bound; renders give the inner bound. The
leaves with the largest excess are split until the target ratio of outer to inner gap is reached or the time is over.
The order of splits depends on bounds only, so the result after a number of cells is the same on every machine.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from dataclasses import replace

import numpy as np

from ns_abstract.arithmetic.rounding import MEAN_DOWN
from ns_abstract.execution.cancellation import Deadline, WorkCancelledError, cancel_when
from ns_abstract.geometry.tiles import in_tiles
from ns_abstract.refine.box_splitter import BoxSplitter, SubBox
from ns_abstract.refine.frame_tiles import FrameTiles, LeafCell, context_bytes, usable
from ns_abstract.refine.goal import RefinementGoal
from ns_abstract.refine.initial import InitialPartition, Partition
from ns_abstract.refine.inner import InnerBound, sampled_gap
from ns_abstract.refine.leaves import BoundedCell, Change, LeafBounds, LeafSets
from ns_abstract.refine.protocol import ACCUMULATION, COLORS, DEPTH, Bounds, Frame, Render
from ns_abstract.refine.result import ExtraOutput, FrameResult, PartResult, TracePoint, joined
from ns_abstract.refine.tuning import TUNING, Tuning

#: Part of the gap beyond the witnesses that a goal allows which parts of a frame share by their pixels.
_SLACK_SHARE = 0.1
#: Cells that may still be bounded where their number is not limited.
_UNLIMITED = 1 << 60


class Refinement:
    """Refines one frame.

    Args:
        progress: Called with (trace point, covered fraction of the set) after every initial cell and every round.
        scene_samples: Where the scene varies too: other scenes of the set, each as a function like the frame's
            ``render``. They widen the inner bound; only poses are split.
        tiles: Numbers of the refined tiles, ascending; None: all. Measures are those of their pixels (R6).
        earlier: An earlier result of the same set, with bounds: results are no looser, and work goes where it has the
            largest excess. Not where leaves are kept: these are to be as tight as the result.
        initial: Takes the cells of the initial partition with their bounds in these tiles; if it holds some, they are
            the initial partition.

    Attributes:
        covered: Whether the initial partition is bounded; before, only [0, 1] is known.
        shown: Scene elements that some initial cell shows, if the frame tells.
        floor: Light up to this amount is left out of the initial cells.
    """

    def __init__(
        self,
        frame: Frame,
        index: int,
        goal: RefinementGoal,
        *,
        seed: int = 0,
        stopped: Callable[[], bool] = lambda: False,
        progress: Callable[[TracePoint, float], None] = lambda point, share: None,
        scene_samples: Iterator[Render] | None = None,
        tiles: np.ndarray | None = None,
        earlier: FrameResult | None = None,
        initial: list[BoundedCell] | None = None,
        tuning: Tuning = TUNING,
    ) -> None:
        self.frame, self.index, self.goal, self.tuning = frame, index, goal, tuning
        self.stopped, self.progress = stopped, progress
        self.tiles = FrameTiles(frame, tiles, goal.keep_leaves)
        scenes = iter(()) if scene_samples is None else scene_samples
        self.inner = InnerBound(self.tiles, np.random.default_rng([seed, index]), scenes, tuning)
        bounds: tuple[np.ndarray, np.ndarray] | None = None
        if earlier is not None:
            pictures = earlier.witness_lower, earlier.witness_upper, earlier.lower, earlier.upper
            least, most, lower, upper = (
                in_tiles(picture, frame.side)[self.tiles.numbers(None)] for picture in pictures
            )
            self.inner.lower[..., :COLORS], self.inner.upper[..., :COLORS] = least, most
            bounds = lower, upper
        self.inner.observed()
        self.leaves = LeafBounds(self.tiles, self.inner, bounds, tuning)
        self.leaf_sets = LeafSets(self.tiles)
        self.splitter = BoxSplitter(frame, tuning.narrowest)
        self.cells = 0
        self.trace: list[TracePoint] = []
        self.start = time.perf_counter()
        self.covered = False
        self.shown: np.ndarray | None = None
        self.floor = 0.0
        self.initial = initial
        #: cells are told apart by their numbers
        self._numbers = itertools.count(1 + max((cell.number for cell, _, _ in initial or ()), default=-1))
        #: middles of initial cells that are not rendered unless the goal asks for them
        self._unrendered: list[np.ndarray] = []

    # --- measures ------------------------------------------------------------------------------

    def point(self) -> TracePoint:
        """Return the present state as a trace point."""
        seconds = time.perf_counter() - self.start
        return TracePoint(seconds, self.cells, self.leaves.mean_gap, self.inner.mean_gap)

    def _record(self, share: float, keep: bool = True) -> TracePoint:
        """Report the present state, in which ``share`` of the set is covered; ``keep``: whether the trace keeps it."""
        point = replace(self.point(), covered=share)
        if keep:
            self.trace.append(point)
        self.progress(point, share)
        return point

    def _late(self) -> bool:
        return self.stopped() or time.perf_counter() - self.start >= self.goal.seconds

    def _over(self) -> bool:
        return self._late() or self._cells_left() < 1

    def _cells_left(self) -> int:
        return _UNLIMITED if self.goal.cells is None else self.goal.cells - self.cells

    # --- the work ------------------------------------------------------------------------------

    def run(self) -> FrameResult:
        """Refine until the goal is reached, and return the result; it is sound whenever it ends.

        Raises:
            WorkCancelledError: ``stopped`` was true before there was a first picture.
        """
        return self._result(self._work())

    def run_part(self) -> PartResult:
        """Run the refinement of some tiles, and return their part of the frame's result."""
        return self._part_result(self._work())

    def proceed(self, goal: RefinementGoal) -> FrameResult:
        """Continue after `run` has covered the set; time between the two does not count."""
        self.goal = goal
        self.start = time.perf_counter() - self.trace[-1].seconds
        self._refine()
        return self._result(self._record(1.0))

    def snapshot(self) -> FrameResult:
        """Return the result so far; sound at any time after the first render."""
        return self._result(self.point())

    def _work(self) -> TracePoint:
        self.frame.set_tolerance(0.0)
        # the first call compiles kernels; the clock of the trace starts after it
        with cancel_when(self.stopped):
            self.inner.render_middle()
        self.start = time.perf_counter()
        self._record(0.0)
        # where the whole set costs nothing, or rays may be left at [0, 1], the cover keeps to the time
        with cancel_when(self._late if self.frame.tilewise else self.stopped), suppress(WorkCancelledError):
            corners = self._begin()
            if self._cover() and not self._over():
                self.inner.render_scenes(self._over)
                self.inner.render_all(corners, self._over)
                self._refine()
                if self.tiles.keep_linear:
                    self.inner.look_around(self.stopped)
        return self._record(1.0 if self.covered else self.trace[-1].covered)

    def _begin(self) -> np.ndarray:
        """Render what the initial partition needs; return the corners of the set that are left for later."""
        corners, dimensions = self.inner.corners(), self.frame.box.dimensions
        if self.frame.tilewise and dimensions != 1:
            return corners
        early = np.arange(len(corners)) % max(1, len(corners) // self.tuning.early_corners) == 0
        for values in corners[early]:
            with suppress(WorkCancelledError):
                self.inner.render(values)
        if dimensions == 1 and self.goal.ratio >= self.tuning.aim_ratio:
            # the cover alone may reach the goal; cells that are split had better tell what they hide
            self.floor = self.frame.set_tolerance((self.goal.ratio - 1.0) * self.inner.mean_gap)
        return corners[~early]

    def _cell(self, part: SubBox) -> LeafCell:
        return LeafCell(next(self._numbers), part, self.splitter.is_narrow(part.box))

    def _bound(
        self, cells: list[LeafCell], parent: LeafCell | None, places: np.ndarray, pixels: np.ndarray | None = None
    ) -> list[tuple[np.ndarray, np.ndarray, Bounds]]:
        """Return usable bounds [t, side, side, channels] of each cell in tiles ``places``, and the frame's `Bounds`."""
        bounds = self.tiles.bound(cells, parent, places, pixels)
        return [self._take(*both) for both in zip(cells, bounds, strict=True)]

    def _take(self, cell: LeafCell, bounds: Bounds) -> tuple[np.ndarray, np.ndarray, Bounds]:
        self.cells += 1
        cell.context = bounds.context
        cell.slopes = bounds.slopes
        return (*usable(bounds.lower, bounds.upper), bounds)

    def _cover(self) -> bool:
        """Bound an initial partition of the set; return False if the work was stopped first."""
        if self.initial:
            for leaf in self.initial:
                self.leaves.take(*leaf)
            return self._covered([cell for cell, _, _ in self.initial])
        if self._may_be_late() and (leaf := self._cell_in_groups()) is not None:
            self.leaves.take(*leaf)
            return self._covered([leaf[0]])
        partition = InitialPartition(self.tiles, self.splitter, self.inner, self.goal, self.tuning).choose()
        parts = partition.parts
        cells: list[LeafCell] = []
        # bounds of all cells only where somebody keeps them
        bounded_leaves: list[BoundedCell] = []
        for number, part in enumerate(parts):
            if number and self._over():
                if self.stopped():
                    return False
                # slower than expected: one cell for the whole set is better than no bounds
                self.leaf_sets.clear()
                self.leaves.begin()
                leaf = self._initial_cell(self.splitter.whole, None)
                cells, bounded_leaves = [leaf[0]], [leaf]
                break
            leaf = self._initial_cell(part, partition)
            cells.append(leaf[0])
            if self.initial is not None:
                bounded_leaves.append(leaf)
            if number % 2:
                self.inner.render(part.box.middle)
            elif len(parts) > 1:
                self._unrendered.append(part.box.middle)
            if number + 1 < len(parts):
                share, points = (number + 1) / len(parts), self.tuning.initial_points
                due = int(share * points) > int(number / len(parts) * points)
                self._record(share, keep=number < self.tuning.first_points or due)
        if self.initial is not None:
            self.initial.extend(bounded_leaves)
        return self._covered(cells)

    def _may_be_late(self) -> bool:
        """Return whether a cell may take longer than the remaining time, estimated from a render."""
        longest = self.tuning.most_cell_pictures * self.inner.picture_seconds
        return not self.frame.tilewise and longest > self.goal.seconds and self.tiles.count >= self.tuning.cover_groups

    def _cell_in_groups(self) -> BoundedCell | None:
        """Return the whole set as a cell, bounded in one group of tiles after another until the time is over (R6).

        Tiles that are left stay at [0, 1]. None: by the first group there is time for all tiles at once.
        """
        cell, begin = self._cell(self.splitter.whole), time.perf_counter()
        left = max(self.start + self.goal.seconds - begin, 0.0)
        deadline = Deadline(left + self.tuning.cover_seconds, self.stopped)
        lower, upper = self.tiles.filled(np.nan), self.tiles.filled(np.nan)
        # first what least is known of
        known = -(self.leaves.upper - self.leaves.lower)[..., :COLORS].sum(axis=(1, 2, 3))
        groups = np.array_split(np.argsort(known, kind="stable"), self.tuning.cover_groups)
        for number, group in enumerate(groups):
            places = np.sort(group)
            try:
                # the first tells how long all take
                with deadline.enforced() if number else nullcontext():
                    [bounds] = self.tiles.bound([cell], None, places)
            except WorkCancelledError:
                if not number:
                    raise
                self.leaf_sets.keep_unknown(cell, bounds.linear, np.concatenate(groups[number:]))
                break
            if not number and len(groups) * (time.perf_counter() - begin) < left:
                return None
            lower[places], upper[places] = bounds.lower, bounds.upper
            self.leaf_sets.keep(cell, bounds.linear, places)
            self._record((number + 1) / len(groups), keep=False)
        self.cells += 1
        cell.slopes = bounds.slopes
        return cell, *usable(lower, upper)

    def _covered(self, cells: list[LeafCell]) -> bool:
        """Continue with ``cells`` that cover the set, whose bounds the leaves have; return True."""
        self.leaves.cover()
        self.covered = True
        elements = [None if cell.context is None else cell.context.shown for cell in cells]
        numbered = [numbers for numbers in elements if numbers is not None]
        if len(numbered) == len(elements):
            self.shown = np.flatnonzero(np.bincount(np.concatenate(numbered)))
        self._record(1.0)
        return True

    def _initial_cell(self, part: SubBox, partition: Partition | None) -> BoundedCell:
        """Return a cell of the initial partition with its bounds, computed unless ``partition`` has tried them."""
        cell, everything = self._cell(part), self.tiles.all
        if partition is not None and part.box == partition.tried.box:
            lower, upper, bounds = self._take(cell, partition.bounds)
        else:
            [(lower, upper, bounds)] = self._bound([cell], None, everything)
        self.leaves.take(cell, lower, upper)
        self.leaf_sets.keep(cell, bounds.linear, everything)
        return cell, lower, upper

    def _refine(self) -> None:
        self.frame.set_tolerance(0.0)
        # nothing is changed before all that a step needs is there
        with cancel_when(self._late), suppress(WorkCancelledError):
            while self._round():
                pass

    def _round(self) -> bool:
        """Render or split the leaves of largest excess; return False if the goal is reached, or nothing can be done."""
        point = self._record(1.0)
        if self._over() or self.goal.met(point):
            return False
        if self._unrendered:
            # first what may show that the goal is met already: half of them, then half of the rest
            middles, self._unrendered = self._unrendered[::2], self._unrendered[1::2]
            for values in middles:
                if not self._over():
                    self.inner.render(values)
            return True
        # what is kept for the result cannot be given up for room
        if self.leaf_sets.bytes >= self.goal.leaf_bytes:
            return False
        self.leaves.close_excess(self.goal.excess(point.mpg_witness))
        jobs, parts = self.leaves.next_round(self.goal)
        changes: dict[int, Change] = {}
        fresh: set[int] = set()
        added, look = 0, max(1, len(jobs) // self.tuning.looks)
        for number, (cell, rows) in enumerate(jobs):
            room = self.leaves.bytes + added < self.goal.leaf_bytes
            count = min(parts, self._cells_left())
            if self._over() or count < 2 or (changes and not room):
                break
            try:
                added += self._split(cell, rows, count, changes)
            except WorkCancelledError:
                break
            fresh.update(rows)
            # by number, not by time: where a round ends must not depend on the machine
            if (number + 1) % look == 0 and number + 1 < len(jobs):
                self.leaves.update(np.array(sorted(fresh), np.int64), changes)
                fresh.clear()
                if self.goal.met(self._record(1.0)):
                    break
        if not changes:
            return False
        self.leaves.apply(changes)
        return True

    def _split(self, cell: LeafCell, rows: dict[int, int], parts: int, changes: dict[int, Change]) -> int:
        """Bound the parts of ``cell`` in the tiles of ``rows``; return the bytes of the new leaves."""
        places = np.array(list(rows), np.int64)
        pixels = self.leaves.wanted(rows)
        children = [self._cell(part) for part in self.splitter.halved(cell.part, cell.slopes, parts)]
        self.inner.render_children(cell, children, places)
        bounded = self._bound(children, cell, places, pixels)
        added = 0
        for k, (t, row) in enumerate(rows.items()):
            change = changes.setdefault(t, Change())
            parent_lower, parent_upper = self.leaves.row(t, row)
            change.gone.append(row)
            for child, (lower, upper, _) in zip(children, bounded, strict=True):
                # a child lies inside its parent, so both bounds hold
                low, high = usable(np.maximum(lower[k], parent_lower), np.minimum(upper[k], parent_upper))
                change.cells.append(child)
                change.lower.append(low)
                change.upper.append(high)
                added += low.nbytes + high.nbytes
        for child, (_, _, bounds) in zip(children, bounded, strict=True):
            self.leaf_sets.keep(child, bounds.linear, places, cell)
            if child.context is not cell.context:
                added += context_bytes(child.context)
        return added

    # --- results -------------------------------------------------------------------------------

    def _result(self, point: TracePoint) -> FrameResult:
        if self.tiles.selected is not None:
            raise ValueError("some tiles are no frame: use run_part")
        return joined([self._part_result(point)], self.frame.camera)

    def _part_result(self, point: TracePoint) -> PartResult:
        pictures = self.leaves.lower, self.leaves.upper, self.inner.lower, self.inner.upper, self.inner.image
        lower, upper, witness_lower, witness_upper, image = (picture[..., :COLORS] for picture in pictures)
        layers: dict[str, ExtraOutput] = {}
        if self.frame.channels > COLORS:
            places = {"accumulation": ACCUMULATION, "depth": DEPTH}
            layers = {name: ExtraOutput(*(picture[..., k] for picture in pictures)) for name, k in places.items()}
        keeps = self.tiles.keep_linear and self.covered
        return PartResult(
            index=self.index,
            box=self.frame.box,
            tiles=self.tiles.numbers(None),
            lower=lower,
            upper=upper,
            witness_lower=witness_lower,
            witness_upper=witness_upper,
            image=image,
            layers=layers,
            pixels=int(self.tiles.inside.sum()),
            seconds=point.seconds,
            cells=self.cells,
            trace=tuple(self.trace),
            bounded=self.covered or self.leaves.earlier is not None,
            shown=self.shown,
            floor=self.floor,
            leaves=self.leaf_sets.leaves() if keeps else None,
            views=self.inner.views if keeps else None,
        )


def groups(frame: Frame, count: int) -> list[np.ndarray]:
    """Return the frame's tiles in ``count`` groups of equal number, fewer where there are fewer tiles.

    Adjacent tiles show few scene elements each; where every ray is a tile, every ``count``-th one makes groups alike.
    """
    count = max(1, min(count, frame.tile_count))
    everything = np.arange(frame.tile_count)
    if frame.tilewise:
        return [everything[k::count] for k in range(count)]
    return np.array_split(everything, count)


def shared_goal(frame: Frame, index: int, goal: RefinementGoal, seed: int) -> RefinementGoal:
    """Return a goal for each group of a frame's tiles: if all groups reach theirs, the frame reaches ``goal`` (R6).

    Groups that hardly move would never come near a ratio; they may miss it by what the others stay below it.
    """
    if frame.tilewise or not frame.box.dimensions:
        return goal
    excess = goal.ratio - 1.0
    # rounding of means must not turn the sum around
    slack = _SLACK_SHARE * excess * sampled_gap(frame, index, seed) * MEAN_DOWN
    return replace(goal, ratio=1.0 + (1.0 - _SLACK_SHARE) * excess, slack=slack)
