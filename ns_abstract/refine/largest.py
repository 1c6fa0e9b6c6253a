"""Bounds the largest value of a `DifferenceFrame`, then all of its pixels (docs/dev/design.md, Y4)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ns_abstract.arithmetic.outward import outward
from ns_abstract.execution.cancellation import WorkCancelledError, cancel_when
from ns_abstract.geometry.tiles import assemble, in_tiles
from ns_abstract.refine.difference import DifferenceFrame
from ns_abstract.refine.engine import Refinement
from ns_abstract.refine.frame_tiles import pixels_inside
from ns_abstract.refine.goal import RefinementGoal
from ns_abstract.refine.leaves import BoundedCell
from ns_abstract.refine.result import FrameResult, PartResult, TracePoint, greater


@dataclass(frozen=True)
class LargestTuning:
    """How the time of a frame is divided; soundness does not depend on it.

    Attributes:
        poses: Random poses rendered in the search for the largest value.
        corners: Largest number of corners of the set rendered there.
        starts: Best poses from which the search climbs.
        first_step: Its first step, as a fraction of each parameter's range.
        halvings: How often the step is halved.
        search_share: Fraction of the time that the search may take.
        cover_share: Fraction of the remaining time that the first pass may take.
        accepted_ratios: A pass leaves values open up to this multiple of the largest rendered value, one pass each,
            before the multiple of the goal.
        room: Least excess over the largest rendered value that a pass leaves open.
        pass_share: Fraction of the remaining time that a pass may take if others follow.
        gain: Fraction of a pass's excess that it has to remove within `patience` more cells.
        patience: Multiple of the cells that the pass had when it last gained as much, and more cells in addition.
    """

    poses: int = 48
    corners: int = 16
    starts: int = 3
    first_step: float = 0.125
    halvings: int = 7
    search_share: float = 0.15
    cover_share: float = 0.7
    accepted_ratios: tuple[float, ...] = (1.3,)
    room: float = 1e-3
    pass_share: float = 0.7
    gain: float = 0.01
    patience: tuple[float, int] = (2.0, 512)


TUNING = LargestTuning()


class GainWatch:
    """Watches whether a pass still gains: the excess of the narrowest cells takes ever more cells in vain."""

    def __init__(self, tuning: LargestTuning = TUNING) -> None:
        self.tuning, self.idle = tuning, False
        self._open, self._cells = float("inf"), 0

    def look(self, cells: int, left_open: float) -> None:
        """Record the number of cells so far, and their mean excess."""
        multiple, more = self.tuning.patience
        if left_open < (1.0 - self.tuning.gain) * self._open:
            self._open, self._cells = left_open, cells
        self.idle = cells > multiple * self._cells + more


def search_largest(frame: DifferenceFrame, seed: int, over: Callable[[], bool], tuning: LargestTuning = TUNING) -> None:
    """Render poses where the difference may be largest; the best one becomes ``frame.largest``."""
    box, random = frame.box, np.random.default_rng(seed)

    def look(values: np.ndarray) -> float:
        return float(frame.render(values)[inside].max(initial=0.0))

    inside = pixels_inside(frame)
    if not box.dimensions:
        return
    corners = box.corners() if box.dimensions <= 4 else box.corners()[random.permutation(2**box.dimensions)]
    scored: list[tuple[float, np.ndarray]] = []
    for values in (box.middle, *corners[: tuning.corners], *box.sample(tuning.poses, random)):
        if over():
            break
        scored.append((look(values), values))
    scored.sort(key=lambda entry: -entry[0])
    low, high = np.array(box.lower), np.array(box.upper)
    for value, values in scored[: tuning.starts]:
        step = tuning.first_step * (high - low)
        for _ in range(tuning.halvings):
            for values_near in _neighbours(values, step, low, high):
                if over():
                    return
                if (nearby := look(values_near)) > value:
                    value, values = nearby, values_near
            step = 0.5 * step


def _neighbours(values: np.ndarray, step: np.ndarray, low: np.ndarray, high: np.ndarray) -> Iterator[np.ndarray]:
    for axis in range(values.size):
        for sign in (1.0, -1.0):
            moved = values.copy()
            moved[axis] = np.clip(values[axis] + sign * step[axis], low[axis], high[axis])
            yield moved


class LargestDifference:
    """Bounds a difference's largest value and every pixel of it (docs/dev/design.md, Y4).

    A pass is a `Refinement` that leaves accepted values open: cells and pixels up to that value cost nothing. Passes
    accept less and less, the last one nothing. The results of all passes hold, so the least bound is taken.

    Args:
        whole: The difference over the set, in the set's own parameters; its renders are searched for the worst pose.
        frame: The difference that is bounded: ``whole``, or one whose box has other parameters.
        goal: When to stop: ``ratio`` is of the largest bound to the largest value rendered, then of the means.
        tolerance: The work ends once it is decided whether all values stay below it.
        progress: Called with (trace point, covered fraction of the set); ``mpg`` and ``mpg_witness`` of its points are
            the largest bound and the largest value rendered.
    """

    def __init__(
        self,
        whole: DifferenceFrame,
        frame: DifferenceFrame,
        index: int,
        goal: RefinementGoal,
        *,
        seed: int = 0,
        tolerance: float | None = None,
        stopped: Callable[[], bool] = lambda: False,
        progress: Callable[[TracePoint, float], None] = lambda point, share: None,
        tiles: np.ndarray | None = None,
        earlier: FrameResult | None = None,
        tuning: LargestTuning = TUNING,
    ) -> None:
        self.whole, self.frame, self.index, self.goal, self.seed = whole, frame, index, goal, seed
        self.tolerance, self.stopped, self.progress, self.tuning = tolerance, stopped, progress, tuning
        self.tiles = np.arange(frame.tile_count) if tiles is None else np.asarray(tiles, np.int64)
        shape = frame.tile_count, frame.side, frame.side, frame.channels
        self.upper, self.rendered = np.ones(shape, np.float32), np.zeros(shape, np.float32)
        self.inside = pixels_inside(frame)
        self.bounded = False
        self.before = None if earlier is None else earlier.largest
        if earlier is not None:
            self.upper, self.rendered = (in_tiles(p, frame.side) for p in (earlier.upper, earlier.witness_upper))
            self.bounded = earlier.bounded
        self.cells, self.trace = 0, []
        #: the cells of the first pass, with bounds of all tiles in ``self.tiles``
        self._cover: list[BoundedCell] = []
        self.begin = time.perf_counter()

    def _late(self) -> bool:
        return self.stopped() or self._left() <= 0.0

    def _left(self) -> float:
        return self.goal.seconds - (time.perf_counter() - self.begin)

    def _most(self, pictures: np.ndarray) -> float:
        """Return the largest value of the bounded tiles."""
        return float(pictures[self.tiles][self.inside[self.tiles]].max(initial=0.0))

    @property
    def _largest_rendered(self) -> float:
        """Return the largest rendered value of the whole picture, so that groups of tiles have one goal."""
        return float(self.rendered[self.inside].max(initial=0.0))

    def run(self) -> PartResult:
        """Search, then bound until the goal is reached, and return the result; it is sound whenever it ends.

        Raises:
            WorkCancelledError: ``stopped`` was true before there was a first picture.
        """
        with cancel_when(self.stopped):
            # the first call compiles kernels, and the clock starts after it
            middle = self.whole.render(self.whole.box.middle)
            self.begin = time.perf_counter()
            search = self.tuning.search_share * self.goal.seconds
            with suppress(WorkCancelledError):
                search_largest(
                    self.whole,
                    self.seed,
                    lambda: self._late() or self._left() < self.goal.seconds - search,
                    self.tuning,
                )
            self.rendered = np.maximum(self.rendered, self.whole.greatest)
        self._record()
        # every pixel once, as a whole
        self._bound(0.0, self.tuning.cover_share, lambda refinement: refinement.covered)
        for accepted, time_share in self._passes():
            if self._late():
                break
            self._bound(accepted, time_share)
        return self._result(middle)

    def _passes(self) -> Iterator[tuple[float, float]]:
        """Yield each pass's largest accepted value and fraction of the remaining time, until the goal is reached."""
        if self.tolerance is not None:
            if not self._decided:
                yield self.tolerance, 1.0
            return
        ratios = (*(ratio for ratio in self.tuning.accepted_ratios if ratio > self.goal.ratio), self.goal.ratio)
        for ratio in ratios:
            accepted = max(ratio * self._largest_rendered, self._largest_rendered + self.tuning.room)
            if self._most(self.upper) > accepted:
                yield accepted, self.tuning.pass_share
        yield 0.0, 1.0

    @property
    def _decided(self) -> bool:
        """Return whether all values surely stay within the tolerance, or one surely does not."""
        assert self.tolerance is not None
        return self._most(self.upper) <= self.tolerance or self._largest_rendered > self.tolerance

    def _bound(
        self, accepted: float, time_share: float, enough: Callable[[Refinement], bool] = lambda refinement: False
    ) -> None:
        """Bound the tiles above the accepted value once, in a fraction of the time left, or until ``enough``."""
        # what is rounded up would stay above the accepted value
        camera, (least,) = self.frame.camera, outward(np.array([accepted]), np.zeros(1))[0]
        # nothing above the accepted value is to be left open; where it is 0, means are measured
        ratio = self.goal.ratio if accepted == 0.0 else 1.0
        loose = self.upper > np.maximum(ratio * self.rendered, least)
        some = (loose & self.inside[..., None])[self.tiles].any(axis=(1, 2, 3))
        first = not self._cover
        tiles = self.tiles if first else self.tiles[some]
        if not tiles.size:
            return
        cover = [(cell, np.maximum(l[some], least), np.maximum(u[some], least)) for cell, l, u in self._cover]
        upper, rendered = (assemble(np.maximum(p, least), camera) for p in (self.upper, self.rendered))
        lowest = np.full_like(upper, least)
        before = FrameResult(self.index, self.frame.box, lowest, upper, lowest, rendered, rendered, 0.0, 0)
        started = time.perf_counter()

        def report(point: TracePoint, covered: float) -> None:
            watch.look(point.cells, point.mpg)
            most = float(refinement.leaves.upper[refinement.tiles.inside].max(initial=0.0))
            most = min(self._most(self.upper), max(most, others))
            seconds = started - self.begin + point.seconds
            now = TracePoint(seconds, self.cells + point.cells, most, self._largest_rendered, covered)
            self.progress(now, 1.0 if self.bounded else covered)

        watch = GainWatch(self.tuning)
        others = self._most(np.where(np.isin(np.arange(len(self.upper)), tiles)[:, None, None, None], 0.0, self.upper))
        goal = replace(self.goal, ratio=ratio, seconds=time_share * self._left())
        frame = self.frame.above(float(least))
        refinement = Refinement(
            frame, self.index, goal, seed=self.seed,
            stopped=lambda: (
                self._late() or enough(refinement) or (time_share < 1.0 and refinement.covered and watch.idle)
            ),
            progress=report, tiles=tiles, earlier=before, initial=self._cover if first else cover,
        )  # fmt: skip
        try:
            part = refinement.run_part()
        except WorkCancelledError:
            return
        self.cells += part.cells
        self.rendered = np.maximum(self.rendered, frame.greatest)
        if self.frame is self.whole:
            # poses of the same parameters
            self.whole.largest = greater(self.whole.largest, frame.largest)
        if not refinement.covered:
            return
        self.bounded = self.bounded or tiles.size == self.tiles.size
        self.upper[tiles] = np.minimum(self.upper[tiles], part.upper)
        self._record()

    def _record(self) -> None:
        seconds = time.perf_counter() - self.begin
        self.trace.append(
            TracePoint(seconds, self.cells, self._most(self.upper), self._largest_rendered, float(self.bounded))
        )

    def _result(self, middle: np.ndarray) -> PartResult:
        tiles = self.tiles
        lower = np.zeros_like(self.upper[tiles])
        # what lies beyond the image is 0 in every picture
        upper, rendered = (np.where(self.inside[tiles][..., None], p[tiles], 0.0) for p in (self.upper, self.rendered))
        return PartResult(
            index=self.index,
            box=self.frame.box,
            tiles=tiles,
            lower=lower,
            upper=upper.astype(np.float32),
            witness_lower=lower,
            witness_upper=rendered.astype(np.float32),
            image=middle[tiles],
            pixels=int(self.inside[tiles].sum()),
            seconds=time.perf_counter() - self.begin,
            cells=self.cells,
            trace=tuple(self.trace),
            bounded=self.bounded,
            shown=None,
            largest=greater(self.before, self.whole.largest),
        )
