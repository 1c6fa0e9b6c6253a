"""Anytime two-sided refinement of one frame (design.md, R1-R4).

The set is covered by cells. Every (cell, tile) pair is a leaf with an outer bound; real renders
give an inner one. What the leaves of a tile leave open beyond the witnesses is the tile's excess,
and the leaves with most of it are split until the ratio of outer to inner gap is reached or the
time is over. The order of splits depends on bounds only, so the result after a given number of
cells is the same on every machine and for every number of threads.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ns_abstract.execution.ending import AbandonedError, abandoning
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.tiles import in_tiles
from ns_abstract.refine.protocol import (
    ACCUMULATION,
    COLORS,
    DEPTH,
    MOST_PARTS,
    Bounds,
    Context,
    Frame,
    PartsFrame,
    Render,
)
from ns_abstract.refine.result import FrameResult, Layer, Leaves, PartResult, TracePoint, Views, gap, joined

#: Part of the whole excess that one round of splitting takes on.
_ROUND_SHARE = 0.8
#: Times in a round that the goal is looked at.
_LOOKS = 16
#: Excess over what the goal allows from which on cells are cut into `MOST_PARTS` rather than two.
_FAR = 4.0
#: Pixels that typical Gaussians move by at most in the first cell of one parameter, and by each of several.
FIRST_MOTION, FIRST_MOTIONS = 0.5, 0.6
#: A first cover of one parameter aims at this part of the excess that the goal, or the ratio if larger, allows.
_AIM_SHARE, _AIM_RATIO = 0.6, 1.05
#: Halving the first cell of one parameter leaves less than this part of its excess, or does not help; an excess from
#: this part of the largest on may be cut off at 0 and 1.
_HELPS, _CUT_OFF = 0.5, 0.25
#: A first cover of several aims at so many times the excess that the goal allows, as long as halving its cells leaves
#: less than this part of theirs. Far from that, so many halvings together may do as little, of which one gained next to
#: nothing: of two axes that matter as much.
_AIM_PART, _STILL_HELPS, _PATIENCE, _FAR_FROM_AIM = 3.0, 0.8, 2, 1.6
#: Part of the gap beyond the witnesses that a goal allows which a leaf may leave open at a pixel for good.
_CLOSED_SHARE = 0.25
#: Leaves whose box is narrower than this part of the set are not split: rounding rules there.
_NARROWEST = 2.0**-40
#: Most corners of the set that are rendered at the start.
_CORNERS = 64
#: About as many of them are rendered before the first cover: both of one parameter.
_EARLY_CORNERS = 4
#: Other scenes of the set that are rendered at the middle, and at every other witness.
_MEMBERS, _MEMBERS_BY_WITNESS = 48, 2
#: Part of the time that the first cover of the set may take.
_COVER_SHARE = 0.7
#: Most cells of the first cover.
_COVER_CELLS = 4096
#: Part of the gap beyond the witnesses that a goal allows which parts of a frame share by their pixels.
_SLACK_SHARE = 0.1
#: Points of the trace while the first cover is made: each of the first cells, then so many by the whole cover.
_FIRST_POINTS, _COVER_POINTS = 8, 32
#: Poses that are rendered where leaves are kept: across the range of one parameter, along each axis of several.
_VIEWS, _AXIS_VIEWS = 9, 4
#: Cells that may still be bounded where their number is not limited.
_PLENTY = 1 << 60


@dataclass(frozen=True)
class Goal:
    """The criterion at which refinement stops.

    Attributes:
        ratio: MPG over witness MPG that is good enough.
        seconds: Time budget of the frame.
        cells: Largest number of cells, or None (for reproducible runs).
        leaf_bytes: Memory that open leaves, or the linear sets that are kept of all leaves, may take.
        slack: MPG beyond ``ratio`` times the witness MPG that is good enough, too.
    """

    ratio: float = 1.05
    seconds: float = 60.0
    cells: int | None = None
    leaf_bytes: int = 4 << 30
    slack: float = 0.0

    def excess(self, mpg_witness: float) -> float:
        """MPG beyond the witness MPG that is good enough."""
        return (self.ratio - 1.0) * mpg_witness + self.slack

    def met(self, point: TracePoint) -> bool:
        """Whether the bounds are good enough."""
        return point.mpg <= self.ratio * point.mpg_witness + self.slack


class _Part(NamedTuple):
    """A sub-box of the set, and whether its ends along each axis [d] are ends of the set."""

    box: ParameterBox
    first: np.ndarray
    last: np.ndarray


class _Cell:
    """A leaf cell: its box, the context for its sub-boxes, and how much the picture varies along each axis [d]."""

    __slots__ = ("context", "narrow", "number", "part", "slopes")

    def __init__(self, number: int, part: _Part, narrow: bool) -> None:
        self.number, self.part, self.narrow = number, part, narrow
        self.context: Context | None = None
        self.slopes = np.zeros(part.box.dimensions)

    @property
    def box(self) -> ParameterBox:
        return self.part.box


@dataclass
class _Change:
    """The change of one tile's leaves in a round: removed rows and their replacements."""

    gone: list[int] = field(default_factory=list)
    cells: list[_Cell] = field(default_factory=list)
    lower: list[np.ndarray] = field(default_factory=list)
    upper: list[np.ndarray] = field(default_factory=list)


@dataclass
class _Tile:
    """The leaves of one tile: [n, side, side, 3] bounds, and everything that is no longer split."""

    closed_lower: np.ndarray
    closed_upper: np.ndarray
    cells: list[_Cell] = field(default_factory=list)
    lower: np.ndarray | None = None
    upper: np.ndarray | None = None

    def replace(self, change: _Change) -> None:
        """Take out the leaves in the rows ``change.gone`` and append the new ones."""
        keep = np.ones(len(self.cells), bool)
        keep[change.gone] = False
        old_lower = [] if self.lower is None else [self.lower[keep]]
        old_upper = [] if self.upper is None else [self.upper[keep]]
        self.cells = [cell for cell, stays in zip(self.cells, keep, strict=True) if stays] + change.cells
        if not self.cells:
            self.lower = self.upper = None
            return
        self.lower = np.concatenate([*old_lower, *(a[None] for a in change.lower)])
        self.upper = np.concatenate([*old_upper, *(a[None] for a in change.upper)])

    def close(self, which: np.ndarray) -> None:
        """Leaves ``which`` [n] (bool) keep their bounds and are not split any more."""
        if self.lower is None or self.upper is None or not which.any():
            return
        self.closed_lower = np.minimum(self.closed_lower, self.lower[which].min(axis=0))
        self.closed_upper = np.maximum(self.closed_upper, self.upper[which].max(axis=0))
        stay = ~which
        self.cells = [cell for cell, s in zip(self.cells, stay, strict=True) if s]
        self.lower, self.upper = (self.lower[stay], self.upper[stay]) if self.cells else (None, None)

    def outer(self, change: _Change | None = None) -> tuple[np.ndarray, np.ndarray]:
        """[side, side, 3] bounds over all leaves, as they will be after ``change``."""
        lower, upper = [self.closed_lower[None]], [self.closed_upper[None]]
        if self.lower is not None and self.upper is not None:
            keep = np.ones(len(self.cells), bool)
            if change is not None:
                keep[change.gone] = False
            lower.append(self.lower[keep])
            upper.append(self.upper[keep])
        if change is not None:
            lower += [a[None] for a in change.lower]
            upper += [a[None] for a in change.upper]
        return np.concatenate(lower).min(axis=0), np.concatenate(upper).max(axis=0)


class Refinement:
    """Refines one frame.

    Args:
        frame: Bounds and renders.
        index: The frame's number.
        goal: When to stop.
        seed: Of the random witnesses.
        keep_leaves: Whether the result carries the leaves' linear sets.
        stopped: Asked between cells; true ends the work with what is known.
        progress: Called with (trace point, covered part of the set) after every cell of the first
            cover and after every round.
        members: Where the scene varies too: other scenes of the set, each as a function like the frame's
            ``render``. They widen the inner bound; only poses are split.
        tiles: Numbers of the tiles that are looked at, ascending; None: all. Everything here counts tiles by
            their place in this list, and measures are those of its pixels (R6).
        known: What was found of the same set before, with bounds: results are no looser, and work goes where it
            leaves most open. Not for ``keep_leaves``: leaves are to be as tight as the result.
    """

    def __init__(
        self,
        frame: Frame,
        index: int,
        goal: Goal,
        *,
        seed: int = 0,
        keep_leaves: bool = False,
        stopped: Callable[[], bool] = lambda: False,
        progress: Callable[[TracePoint, float], None] = lambda point, share: None,
        members: Iterator[Render] | None = None,
        tiles: np.ndarray | None = None,
        known: FrameResult | None = None,
    ) -> None:
        self.members = iter(()) if members is None else members
        self.part = None if tiles is None else np.asarray(tiles, np.int64)
        self.frame, self.index, self.goal = frame, index, goal
        self.keep_leaves, self.stopped, self.progress = keep_leaves, stopped, progress
        self.random = np.random.default_rng([seed, index])
        side = frame.side
        shape = (side, side, frame.channels)
        self.tiles = [
            _Tile(np.full(shape, np.inf, np.float32), np.full(shape, -np.inf, np.float32)) for _ in range(self._count)
        ]
        whole = (self._count, *shape)
        self.outer_lower, self.outer_upper = _usable(np.full(whole, np.nan, np.float32), np.zeros(whole, np.float32))
        self.witness_lower, self.witness_upper = np.full(whole, np.inf, np.float32), np.full(whole, -np.inf, np.float32)
        self.image = np.zeros(whole, np.float32)
        self._known: tuple[np.ndarray, np.ndarray] | None = None
        if known is not None:
            pictures = known.witness_lower, known.witness_upper, known.lower, known.upper
            least, most, lower, upper = (in_tiles(picture, side)[self._numbers_of(None)] for picture in pictures)
            self.witness_lower[..., :COLORS], self.witness_upper[..., :COLORS] = least, most
            self._known = lower, upper
            self._intersect(np.arange(self._count))
        frame.watch(self._numbers_of(None), self.witness_lower, self.witness_upper)
        self.inside = _pixels_inside(frame)[self._numbers_of(None)]
        self.outer_lower[~self.inside] = 0.0
        self.outer_upper[~self.inside] = 0.0
        self.cells = 0
        self.trace: list[TracePoint] = []
        self.start = time.perf_counter()
        self.covered = False
        #: parameters of the first cover's witnesses that are not rendered unless the goal asks for them
        self._unseen: list[np.ndarray] = []
        #: scene elements that some cell of the cover shows, if the frame tells
        self.shown: np.ndarray | None = None
        #: what no more light comes to is left out of the first cover
        self.floor = 0.0
        self.leaf_sets: dict[tuple[int, int], tuple[ParameterBox, tuple[np.ndarray, ...]]] = {}
        self._kept_bytes = 0
        self._held_bytes = 0
        #: what a leaf may leave open at a pixel that it is not bounded at any more; never falls
        self._closed_excess = 0.0
        self._numbers = itertools.count()
        self._views: list[tuple[np.ndarray, np.ndarray]] = []

    # --- tiles ---------------------------------------------------------------------------------

    @property
    def _count(self) -> int:
        return self.frame.tile_count if self.part is None else self.part.size

    def _numbers_of(self, places: np.ndarray | None) -> np.ndarray:
        """The frame's numbers of tiles; of all that are looked at if None."""
        if self.part is None:
            return np.arange(self.frame.tile_count) if places is None else places
        return self.part if places is None else self.part[places]

    def _render(self, render: Callable[..., np.ndarray], values: np.ndarray, places: np.ndarray | None) -> np.ndarray:
        whole = self.part is None and places is None
        return render(values, None if whole else self._numbers_of(places))

    # --- the two sides -------------------------------------------------------------------------

    @property
    def _some_pixels(self) -> bool:
        """Whether leaves are split for some of their pixels.

        Linear sets are kept of all pixels, and nobody looks where layers are open.
        """
        return isinstance(self.frame, PartsFrame) and not self.keep_leaves and self.frame.channels == COLORS

    def _cell(self, part: _Part) -> _Cell:
        return _Cell(next(self._numbers), part, _narrow(part.box, self.frame.box))

    def _cut(self, part: _Part, axis: int, count: int = 2) -> list[_Part]:
        """What ``count`` equal parts of ``part`` along ``axis`` hold of the set, without those that hold nothing."""
        whole, found = part.box, []
        for box in whole.split(axis, count):
            inside = self.frame.feasible(box)
            if inside is not None:
                first = (part.first & np.equal(box.lower, whole.lower)) | np.greater(inside.lower, box.lower)
                last = (part.last & np.equal(box.upper, whole.upper)) | np.less(inside.upper, box.upper)
                found.append(_Part(inside, first, last))
        return found

    def _witness(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        """Render at ``values`` and widen the inner bound."""
        picture = self._render(self.frame.render, values, tiles)
        self._widen(picture, tiles)
        for render in itertools.islice(self.members, _MEMBERS_BY_WITNESS):
            self._widen(self._render(render, values, tiles), tiles)
        return picture

    def _widen(self, picture: np.ndarray, tiles: np.ndarray | None) -> None:
        which = slice(None) if tiles is None else tiles
        low, high = self.witness_lower[which], self.witness_upper[which]
        least, most = np.minimum(low, picture), np.maximum(high, picture)
        # no number: nothing is drawn there
        least[..., DEPTH:], most[..., DEPTH:] = (
            np.fmin(low[..., DEPTH:], picture[..., DEPTH:]), np.fmax(high[..., DEPTH:], picture[..., DEPTH:])
        )  # fmt: skip
        self.witness_lower[which], self.witness_upper[which] = least, most

    def _bound(
        self, cells: list[_Cell], parent: _Cell | None, tiles: np.ndarray, pixels: np.ndarray | None = None
    ) -> list[tuple[np.ndarray, np.ndarray, Bounds]]:
        """Of each cell, lower and upper [t, side, side, 3] that can be relied on, and all that the frame returned.

        Only some ``pixels`` [t, side, side] may be wanted, which must be among those of ``parent``.
        """
        within = None if parent is None else parent.context
        boxes, numbers = [cell.box for cell in cells], self._numbers_of(tiles)
        if isinstance(self.frame, PartsFrame):
            found = self.frame.bound_parts(boxes, numbers, within, self.keep_leaves, pixels)
        else:
            found = [self.frame.bound(box, numbers, within, self.keep_leaves) for box in boxes]
        return [self._take(*both) for both in zip(cells, found, strict=True)]

    def _take(self, cell: _Cell, bounds: Bounds) -> tuple[np.ndarray, np.ndarray, Bounds]:
        self.cells += 1
        cell.context = bounds.context
        cell.slopes = bounds.slopes
        return (*_usable(bounds.lower, bounds.upper), bounds)

    def _halved(self, cell: _Cell, count: int) -> list[_Part]:
        """Up to ``count`` parts of a cell, from halving it again and again."""
        if cell.box.dimensions == 1:
            return self._cut(cell.part, 0, count)
        parts, slopes = [cell.part], cell.slopes.copy()
        for _ in range(count.bit_length() - 1):
            axis = self._axis(cell.box, slopes)
            parts = self._cut_all(parts, axis)
            slopes[axis] *= 0.5
        return parts

    def _cut_all(self, parts: list[_Part], axis: int) -> list[_Part]:
        return [half for part in parts for half in self._cut(part, axis)]

    def _axis(self, box: ParameterBox, slopes: np.ndarray) -> int:
        """The axis that the picture varies most along, of those that can be halved."""
        slopes = np.nan_to_num(slopes, nan=0.0, posinf=float(np.finfo(np.float64).max))
        # a parameter that only moves what the linear part does not see still has to be split
        if not np.any(slopes > 0.0):
            slopes = np.nan_to_num(self.frame.motion(box), nan=0.0)
        return int(np.argmax(np.where(_narrow_axes(box, self.frame.box), -1.0, slopes)))

    def _outlying(self, part: _Part) -> np.ndarray:
        """A point [d] of ``part`` as far out in the set as it reaches, where pixels are likely to be extreme.

        Which end is taken by chance where the part spans the set.
        """
        box = part.box
        last = part.last & (~part.first | (self.random.random(box.dimensions) < 0.5))
        return np.where(last, box.upper, np.where(part.first, box.lower, box.middle))

    def _update_outer(self, tiles: np.ndarray, changes: dict[int, _Change] | None = None) -> None:
        """Update the outer bound of ``tiles``, given what has changed since the round began."""
        for t in tiles:
            self.outer_lower[t], self.outer_upper[t] = self.tiles[t].outer(None if changes is None else changes[t])
        self._intersect(tiles)
        self.outer_lower[tiles], self.outer_upper[tiles] = _usable(self.outer_lower[tiles], self.outer_upper[tiles])

    def _intersect(self, tiles: np.ndarray) -> None:
        """Take what was known before into the outer bound of ``tiles``: both hold (design.md, R5)."""
        if self._known is not None:
            lower, upper = self._known
            low, high = self.outer_lower[..., :COLORS], self.outer_upper[..., :COLORS]
            low[tiles], high[tiles] = np.maximum(low[tiles], lower[tiles]), np.minimum(high[tiles], upper[tiles])

    # --- measures ------------------------------------------------------------------------------

    def _mpg(self, lower: np.ndarray, upper: np.ndarray) -> float:
        return float(gap(lower[..., :COLORS], upper[..., :COLORS])[self.inside].mean())

    def point(self) -> TracePoint:
        """Where the work stands."""
        return TracePoint(
            time.perf_counter() - self.start,
            self.cells,
            self._mpg(self.outer_lower, self.outer_upper),
            self._mpg(self.witness_lower, self.witness_upper),
        )

    def _record(self, share: float, keep: bool = True) -> TracePoint:
        """Tell where the work stands; ``share`` of the set is covered."""
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
        return _PLENTY if self.goal.cells is None else self.goal.cells - self.cells

    # --- the work ------------------------------------------------------------------------------

    def run(self) -> FrameResult:
        """Refine until the goal is reached; sound whenever it ends.

        Raises:
            AbandonedError: ``stopped`` was true before a first picture was there.
        """
        return self._result(self._work())

    def run_part(self) -> PartResult:
        """`run` for tiles that are to be put beside others."""
        return self._part_result(self._work())

    def _work(self) -> TracePoint:
        box = self.frame.box
        self._allow(0.0)
        # the first call compiles kernels; the clock of the trace starts after it
        with abandoning(self.stopped):
            self.image = self._witness(box.middle)
        self.start = time.perf_counter()
        self._record(0.0)
        # where the whole set costs nothing, or rays may be left at [0, 1], the cover keeps to the time
        with abandoning(self._late if self.frame.tilewise else self.stopped), suppress(AbandonedError):
            corners = self._begin()
            if self._cover() and not self._over():
                for render in itertools.islice(self.members, _MEMBERS):
                    self._widen(self._render(render, box.middle, None), None)
                    if self._over():
                        break
                for values in corners:
                    self._witness(values)
                    if self._over():
                        break
                self._refine()
                self._look_around()
        return self._record(1.0 if self.covered else self.trace[-1].covered)

    def _look_around(self) -> None:
        """Render poses across the set, for those who look at what leaves say of them."""
        if not self.keep_leaves:
            return
        for values in _across(self.frame.box):
            if self.stopped():
                return
            self._views.append((values, self._witness(values)))

    def _begin(self) -> np.ndarray:
        """Render what the first cover asks for; returns the corners of the set that are left for later."""
        corners = self._corners()
        if self.frame.tilewise and self.frame.box.dimensions != 1:
            return corners
        early = np.arange(len(corners)) % max(1, len(corners) // _EARLY_CORNERS) == 0
        for values in corners[early]:
            with suppress(AbandonedError):
                self._witness(values)
        if self.frame.box.dimensions == 1 and self.goal.ratio >= _AIM_RATIO:
            # the cover alone may reach the goal; cells that are split had better tell what they hide
            self.floor = self._allow((self.goal.ratio - 1.0) * self._mpg(self.witness_lower, self.witness_upper))
        return corners[~early]

    def proceed(self, goal: Goal) -> FrameResult:
        """Go on after `run` has covered the set; time between the two does not count."""
        self.goal = goal
        self.start = time.perf_counter() - self.trace[-1].seconds
        self._refine()
        return self._result(self._record(1.0))

    def snapshot(self) -> FrameResult:
        """What is known now; sound at any time after the first render."""
        return self._result(self.point())

    def _allow(self, excess: float) -> float:
        """Tell the frame how much looser than the inner bounds cells may be from now on; what it makes of it."""
        return self.frame.allow(excess)

    def _corners(self) -> np.ndarray:
        return _first_corners(self.frame.box, self.random)

    def _cover(self) -> bool:
        """Bound a first cover of the set; False if the work was stopped first."""
        everything = np.arange(self._count)
        parts, first, probe = self._first_parts(everything)
        leaves: list[tuple[_Cell, np.ndarray, np.ndarray]] = []
        for number, part in enumerate(parts):
            if number and self._over():
                if self.stopped():
                    return False
                # slower than expected: one cell for the whole set is better than no bounds
                self.leaf_sets.clear()
                self._kept_bytes = 0
                cell = self._cell(self._whole)
                [(lower, upper, bounds)] = self._bound([cell], None, everything)
                leaves = [(cell, lower, upper)]
                self._keep(cell, bounds, everything)
                break
            cell = self._cell(part)
            known = part.box == first.box
            lower, upper, bounds = self._take(cell, probe) if known else self._bound([cell], None, everything)[0]
            leaves.append((cell, lower, upper))
            self._keep(cell, bounds, everything)
            if number % 2:
                self._witness(part.box.middle)
            elif len(parts) > 1:
                self._unseen.append(part.box.middle)
            if number + 1 < len(parts):
                share = (number + 1) / len(parts)
                due = int(share * _COVER_POINTS) > int(number / len(parts) * _COVER_POINTS)
                self._record(share, keep=number < _FIRST_POINTS or due)
        for t in everything:
            cells, lowers, uppers = zip(*((cell, lower[t], upper[t]) for cell, lower, upper in leaves), strict=True)
            self.tiles[t].replace(_Change([], list(cells), list(lowers), list(uppers)))
        self.covered = True
        elements = [None if cell.context is None else cell.context.shown for cell, _, _ in leaves]
        told = [numbers for numbers in elements if numbers is not None]
        if len(told) == len(elements):
            self.shown = np.unique(np.concatenate(told))
        self._update_outer(everything)
        self._record(1.0)
        return True

    @property
    def _whole(self) -> _Part:
        box = self.frame.box
        return _Part(box, np.ones(box.dimensions, bool), np.ones(box.dimensions, bool))

    def _first_parts(self, everything: np.ndarray) -> tuple[list[_Part], _Part, Bounds]:
        """Parts that cover the set, as many as it takes and time and memory allow; one that was tried, its bounds."""
        frame, parts = self.frame, [self._whole]
        if frame.tilewise or not frame.box.dimensions:
            return parts, parts[0], self._probe(parts[0], everything)[0]
        if frame.box.dimensions == 1:
            return self._equal_parts(everything)
        history = [parts]
        motion = np.nan_to_num(np.array(frame.motion(frame.box), np.float64), nan=0.0)
        while motion.max() > FIRST_MOTIONS and 2 * len(parts) <= _COVER_CELLS:
            axis = int(np.argmax(motion))
            parts = self._cut_all(parts, axis)
            motion[axis] *= 0.5
            history.append(parts)
        first = parts[len(parts) // 2]
        probe, allowed = self._probe(first, everything)
        if len(parts) <= allowed:
            return self._finer_parts(parts, first, probe, allowed, everything)
        while len(parts) > allowed and len(history) > 1:
            history.pop()
            parts = history[-1]
        return parts, first, probe

    def _finer_parts(
        self, parts: list[_Part], first: _Part, probe: Bounds, allowed: float, everything: np.ndarray
    ) -> tuple[list[_Part], _Part, Bounds]:
        """``parts`` halved again along what a cell in the middle varies most along, while its excess asks for it."""
        aim = _AIM_PART * self.goal.excess(self._mpg(self.witness_lower, self.witness_upper))
        best, least, idle = (parts, first, probe), np.inf, 0
        while True:
            excess = self._beyond(first, probe)
            if excess <= aim:
                return parts, first, probe
            if self._helped(excess, least, _STILL_HELPS ** (idle + 1)):
                best, least, idle = (parts, first, probe), excess, 0
            else:
                idle += 1
            patient = idle == 0 or (idle < _PATIENCE and excess > _FAR_FROM_AIM * aim)
            if not patient or 2 * len(parts) > min(allowed, _COVER_CELLS):
                return best
            parts = self._cut_all(parts, self._axis(first.box, probe.slopes))
            first = parts[len(parts) // 2]
            probe, allowed = self._probe(first, everything)

    def _helped(self, excess: float, before: float, share: float) -> bool:
        """Whether smaller cells left at most ``share`` of the excess ``before``, or that may have been cut off."""
        return excess <= share * before or before >= _CUT_OFF * self._mpg(
            np.zeros_like(self.image), np.ones_like(self.image)
        )

    def _beyond(self, part: _Part, probe: Bounds) -> float:
        """MPG of the bounds of ``part`` beyond that of the pictures at its two ends and at the middle of the set."""
        ends = [self._witness(np.array(end)) for end in (part.box.lower, part.box.upper)]
        low, high = np.minimum.reduce([self.image, *ends]), np.maximum.reduce([self.image, *ends])
        return self._mpg(*_usable(probe.lower, probe.upper)) - self._mpg(low, high)

    def _equal_parts(self, everything: np.ndarray) -> tuple[list[_Part], _Part, Bounds]:
        """`_first_parts` of one parameter: as many as the excess of a cell in the middle asks for."""
        motion = float(np.nan_to_num(self.frame.motion(self.frame.box)[0], nan=0.0))
        # odd: the middle of the set, which is rendered, is that of a part
        count, before = 2 * int(min(motion / FIRST_MOTION, _COVER_CELLS) / 2.0) + 1, np.inf
        goal = replace(self.goal, ratio=max(self.goal.ratio, _AIM_RATIO))
        while True:
            part = self._cut(self._whole, 0, count)[count // 2]
            probe, affordable = self._probe(part, everything)
            excess = self._beyond(part, probe)
            aim = _AIM_SHARE * goal.excess(self._mpg(self.witness_lower, self.witness_upper))
            # it falls with the square of the width, and of wider cells faster, where intervals take the place of forms
            share = min(excess / aim, 1e6) if aim > 0.0 < excess else 1.0
            wanted = math.ceil(count * (math.sqrt(share) if share > 1.0 else share**0.25))
            most = int(min(affordable, _COVER_CELLS))
            helped = self._helped(excess, before, _HELPS)
            if wanted < 2 * count or 2 * count > most or not helped:
                return self._cut(self._whole, 0, max(1, min(wanted if helped else count, most))), part, probe
            count, before = 2 * count + 1, excess

    def _probe(self, part: _Part, everything: np.ndarray) -> tuple[Bounds, float]:
        """Bounds of ``part``, and how many such cells time and memory allow."""
        started = time.perf_counter()
        probe = self.frame.bound(part.box, self._numbers_of(everything), None, self.keep_leaves)
        seconds = time.perf_counter() - started
        allowed = _COVER_SHARE * self.goal.seconds / max(seconds, 1e-4)
        if self.goal.cells is not None:
            allowed = self.goal.cells / 2
        size = probe.lower.nbytes + probe.upper.nbytes + _context_bytes(probe.context) + _linear_bytes(probe)
        # half: the leaves are copied once when they are sorted by tile
        return probe, max(1.0, min(allowed, 0.5 * self.goal.leaf_bytes / size))

    def _refine(self) -> None:
        self._allow(0.0)
        # nothing is changed before all that a step needs is there
        with abandoning(self._late), suppress(AbandonedError):
            self._rounds()

    def _rounds(self) -> None:
        while True:
            point = self._record(1.0)
            if self._over() or self.goal.met(point):
                return
            if self._unseen:
                # first what may show that the goal is met already: half of them, then half of the rest
                middles, self._unseen = self._unseen[::2], self._unseen[1::2]
                for values in middles:
                    if not self._over():
                        self._witness(values)
                continue
            # what is kept for the result cannot be given up for room
            if self._kept_bytes >= self.goal.leaf_bytes:
                return
            self._close_excess(point)
            jobs, parts = self._choose()
            changes: dict[int, _Change] = {}
            fresh: set[int] = set()
            added, look = 0, max(1, len(jobs) // _LOOKS)
            for number, (cell, rows) in enumerate(jobs):
                room = self._held_bytes + added < self.goal.leaf_bytes
                count = min(parts, self._cells_left())
                if self._over() or count < 2 or (changes and not room):
                    break
                try:
                    added += self._split(cell, rows, count, changes)
                except AbandonedError:
                    break
                fresh.update(rows)
                # by number, not by time: where a round ends must not depend on the machine
                if (number + 1) % look == 0 and number + 1 < len(jobs):
                    self._update_outer(np.array(sorted(fresh), np.int64), changes)
                    fresh.clear()
                    if self.goal.met(self._record(1.0)):
                        break
            if not changes:
                return
            for t, change in changes.items():
                self.tiles[t].replace(change)
            self._update_outer(np.array(sorted(changes), np.int64))

    def _close_excess(self, point: TracePoint) -> None:
        """Leave pixels of leaves for good that could take little more away from what the goal allows."""
        if self._some_pixels:
            self._closed_excess = max(self._closed_excess, _CLOSED_SHARE * self.goal.excess(point.mpg_witness))

    def _choose(self) -> tuple[list[tuple[_Cell, dict[int, int]]], int]:
        """The cells to split in the next round, each with its row by tile, and into how many parts."""
        while True:
            amounts, owner = self._excess()
            if not owner:
                return [], 2
            order = np.argsort(-amounts, kind="stable")
            if self._held_bytes <= self.goal.leaf_bytes:
                break
            self._close_least(order, owner)
        running = np.cumsum(amounts[order])
        count = int(np.searchsorted(running, _ROUND_SHARE * running[-1])) + 1
        by_cell: dict[int, tuple[_Cell, dict[int, int]]] = {}
        for position in order[:count]:
            t, k = owner[position]
            cell = self.tiles[t].cells[k]
            by_cell.setdefault(cell.number, (cell, {}))[1][t] = k
        jobs = []
        for cell, rows in by_cell.values():
            ordered = sorted(rows.items())
            step = self.frame.tiles_at_once or len(ordered)
            jobs += [(cell, dict(ordered[i : i + step])) for i in range(0, len(ordered), step)]
        # excess falls at least in proportion to the width: far from the goal, levels are skipped
        moved = (self.witness_upper - self.witness_lower)[..., :COLORS]
        allowed = (self.goal.ratio - 1.0) * float(moved[self.inside].sum())
        return jobs, MOST_PARTS if running[-1] > _FAR * allowed else 2

    def _excess(self) -> tuple[np.ndarray, list[tuple[int, int]]]:
        """What every open leaf leaves open beyond the witnesses, and its tile and row.

        Leaves that cannot be improved are closed; the memory of the others is counted.
        """
        excess: list[np.ndarray] = [np.empty(0)]
        owner: list[tuple[int, int]] = []
        contexts: dict[int, Context | None] = {}
        self._held_bytes = 0
        for t, tile in enumerate(self.tiles):
            if tile.lower is None or tile.upper is None:
                continue
            amount = self._open(t, tile.lower, tile.upper).sum(axis=(1, 2), dtype=np.float64)
            done = (amount <= 0.0) | np.array([cell.narrow for cell in tile.cells])
            tile.close(done)
            amount = amount[~done]
            if tile.lower is not None and tile.upper is not None:
                self._held_bytes += tile.lower.nbytes + tile.upper.nbytes
            for cell in tile.cells:
                contexts[id(cell.context)] = cell.context
            excess.append(amount)
            owner.extend((t, k) for k in range(amount.size))
        self._held_bytes += sum(_context_bytes(context) for context in contexts.values())
        return np.concatenate(excess), owner

    def _open(self, t: int, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """[n, side, side] what leaves of tile t leave open beyond the witnesses, where that is not too little.

        A pixel where a leaf has nothing open has nothing open in any part of it, then or later.
        """
        colors = np.s_[..., :COLORS]
        lower, upper = lower[colors], upper[colors]
        if self._known is not None:
            lower, upper = np.maximum(lower, self._known[0][t]), np.minimum(upper, self._known[1][t])
        beyond = np.maximum(0.0, self.witness_lower[t][colors] - lower)
        beyond += np.maximum(0.0, upper - self.witness_upper[t][colors])
        beyond = beyond.sum(axis=-1)
        return np.where(self.inside[t] & (beyond > self._closed_excess), beyond, 0.0)

    def _close_least(self, order: np.ndarray, owner: list[tuple[int, int]]) -> None:
        """Free memory: the half of the leaves that have least excess are not split any more."""
        closing: dict[int, list[int]] = {}
        for position in order[order.size // 2 :]:
            t, k = owner[position]
            closing.setdefault(t, []).append(k)
        for t, which in closing.items():
            mask = np.zeros(len(self.tiles[t].cells), bool)
            mask[which] = True
            self.tiles[t].close(mask)

    def _split(self, cell: _Cell, rows: dict[int, int], parts: int, changes: dict[int, _Change]) -> int:
        """Bound the parts of ``cell`` in the tiles of ``rows``; returns the bytes of the new leaves."""
        tiles = np.array(list(rows), np.int64)
        pixels = self._wanted(rows)
        children = [self._cell(part) for part in self._halved(cell, parts)]
        if cell.box.dimensions > 1:
            if children:
                # one of them: the first corners have shown most of what there is to see
                self._witness(self._outlying(children[self.random.integers(len(children))].part), tiles)
        else:
            steps = self.frame.witnesses
            for number in range(1, steps * len(children)):
                child, step = children[(number - 1) // steps], (number - 1) % steps + 1
                end = np.array(child.box.upper)
                self._witness(end if step == steps else child.box.at(np.array([2.0 * step / steps - 1.0])), tiles)
        found = self._bound(children, cell, tiles, pixels)
        added = 0
        for k, (t, row) in enumerate(rows.items()):
            tile, change = self.tiles[t], changes.setdefault(t, _Change())
            assert tile.lower is not None and tile.upper is not None
            change.gone.append(row)
            for child, (lower, upper, _) in zip(children, found, strict=True):
                # a child lies inside its parent, so both bounds hold
                low, high = _usable(np.maximum(lower[k], tile.lower[row]), np.minimum(upper[k], tile.upper[row]))
                change.cells.append(child)
                change.lower.append(low)
                change.upper.append(high)
                added += low.nbytes + high.nbytes
        for child, (_, _, bounds) in zip(children, found, strict=True):
            self._keep(child, bounds, tiles, cell)
            if child.context is not cell.context:
                added += _context_bytes(child.context)
        return added

    def _wanted(self, rows: dict[int, int]) -> np.ndarray | None:
        """[t, side, side] the pixels that leaves in the tiles and rows ``rows`` are split for; None: all."""
        if not self._some_pixels:
            return None
        found = []
        for t, row in rows.items():
            tile = self.tiles[t]
            assert tile.lower is not None and tile.upper is not None
            found.append(self._open(t, tile.lower[row][None], tile.upper[row][None])[0] > 0.0)
        return np.stack(found)

    # --- results -------------------------------------------------------------------------------

    def _keep(self, cell: _Cell, bounds: Bounds, tiles: np.ndarray, parent: _Cell | None = None) -> None:
        """Remember the linear sets of leaves, in place of their parent's."""
        if not self.keep_leaves or bounds.linear is None:
            return
        linear = _usable_linear(bounds.linear)
        for k, t in enumerate(tiles.tolist()):
            if parent is not None:
                gone = self.leaf_sets.pop((parent.number, t), None)
                self._kept_bytes -= 0 if gone is None else sum(a.nbytes for a in gone[1])
            # copies: a view would keep the bounds of all tiles
            entry = tuple(a[k].copy() for a in linear)
            self.leaf_sets[(cell.number, t)] = (cell.box, entry)
            self._kept_bytes += sum(a.nbytes for a in entry)

    def _leaves(self) -> Leaves | None:
        if not self.keep_leaves:
            return None
        d = self.frame.box.dimensions
        entries = sorted(self.leaf_sets.items(), key=lambda item: (item[1][0].lower, item[1][0].upper, item[0][1]))
        side = self.frame.side
        n = len(entries)
        tiles = self._numbers_of(np.array([e[0][1] for e in entries], np.int64))

        def stack(part: int, shape: tuple[int, ...]) -> np.ndarray:
            rows = [entry[1][1][part] for entry in entries]
            return np.stack(rows) if rows else np.zeros((0, *shape), np.float32)

        slopes, offsets = (side, side, 3, d), (side, side, 3)
        return Leaves(
            np.array([e[1][0].lower for e in entries], np.float64).reshape(n, d),
            np.array([e[1][0].upper for e in entries], np.float64).reshape(n, d),
            np.stack([tiles // self.frame.across * side, tiles % self.frame.across * side], axis=1).astype(np.int32),
            stack(0, slopes),
            stack(1, offsets),
            stack(2, slopes),
            stack(3, offsets),
        )

    def _result(self, point: TracePoint) -> FrameResult:
        if self.part is not None:
            raise ValueError("some tiles are no frame: use run_part")
        return joined([self._part_result(point)], self.frame.camera)

    def _part_result(self, point: TracePoint) -> PartResult:
        pictures = self.outer_lower, self.outer_upper, self.witness_lower, self.witness_upper, self.image
        lower, upper, witness_lower, witness_upper, image = (picture[..., :COLORS] for picture in pictures)
        layers = None
        if self.frame.channels > COLORS:
            places = {"accumulation": ACCUMULATION, "depth": DEPTH}
            layers = {name: Layer(*(picture[..., k] for picture in pictures)) for name, k in places.items()}
        return PartResult(
            index=self.index,
            box=self.frame.box,
            tiles=self._numbers_of(None),
            lower=lower,
            upper=upper,
            witness_lower=witness_lower,
            witness_upper=witness_upper,
            image=image,
            layers=layers,
            pixels=int(self.inside.sum()),
            seconds=point.seconds,
            cells=self.cells,
            trace=tuple(self.trace),
            bounded=self.covered or self._known is not None,
            shown=self.shown,
            floor=self.floor,
            leaves=self._leaves() if self.covered else None,
            views=self._seen() if self.covered else None,
        )

    def _seen(self) -> Views | None:
        if not self.keep_leaves:
            return None
        values = [values for values, _ in self._views]
        images = [picture[..., :COLORS] for _, picture in self._views]
        whole = np.stack(images) if images else np.zeros((0, *self.image.shape[:-1], COLORS), np.float32)
        whole = whole[..., :COLORS]
        return Views(np.array(values, np.float64).reshape(len(values), self.frame.box.dimensions), whole)


def groups(frame: Frame, count: int) -> list[np.ndarray]:
    """The frame's tiles in ``count`` parts of equal number, fewer where there are fewer tiles.

    Runs of tiles, which show few scene elements each; where every ray is a tile of its own, every ``count``-th one,
    so that the parts are alike.
    """
    count = max(1, min(count, frame.tile_count))
    everything = np.arange(frame.tile_count)
    if frame.tilewise:
        return [everything[k::count] for k in range(count)]
    return np.array_split(everything, count)


def shared_goal(frame: Frame, index: int, goal: Goal, seed: int) -> Goal:
    """A goal for each of several parts of a frame: where all reach theirs, the whole frame reaches ``goal`` (R6).

    Parts that hardly move would never come near a ratio; they may miss it by what the others stay below it.
    """
    if frame.tilewise or not frame.box.dimensions:
        return goal
    excess = goal.ratio - 1.0
    # rounding of means must not turn the sum around
    slack = _SLACK_SHARE * excess * spread(frame, index, seed) * (1.0 - 2.0**-20)
    return replace(goal, ratio=1.0 + (1.0 - _SLACK_SHARE) * excess, slack=slack)


def spread(frame: Frame, index: int, seed: int) -> float:
    """Return the MPG between pictures at the middle and two opposite ends of the set: at most the inner gap."""
    corners = _first_corners(frame.box, np.random.default_rng([seed, index]))
    pictures = [frame.render(values) for values in (frame.box.middle, *corners[[0, -1]])]
    least, most = np.minimum.reduce(pictures), np.maximum.reduce(pictures)
    return float(gap(least[..., :COLORS], most[..., :COLORS])[_pixels_inside(frame)].mean())


def _across(box: ParameterBox) -> Iterator[np.ndarray]:
    """Return poses [d] across a set: evenly along each parameter, the others at their middles."""
    count = _VIEWS if box.dimensions == 1 else _AXIS_VIEWS + 1
    for axis in range(box.dimensions):
        for step in np.linspace(-1.0, 1.0, count):
            # the middle of several belongs to all axes
            if step or not axis:
                yield box.at(np.where(np.arange(box.dimensions) == axis, step, 0.0))


def _first_corners(box: ParameterBox, random: np.random.Generator) -> np.ndarray:
    """Corners of the set [n, d] that are rendered at first, some of them where there are many."""
    if not box.dimensions:
        return np.empty((0, 0))
    corners = box.corners()
    if corners.shape[0] > _CORNERS:
        corners = corners[np.sort(random.choice(corners.shape[0], _CORNERS, replace=False))]
    return corners


def _usable(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds clipped to [0, 1]; [0, 1] itself where they are not finite, cross, or miss [0, 1].

    Depths are at least 0, and may be unknown above or nowhere (see `Frame`).
    """
    good = np.isfinite(lower) & np.isfinite(upper) & (lower <= upper) & (lower <= 1.0) & (upper >= 0.0)
    low, high = np.clip(lower, 0.0, 1.0), np.clip(upper, 0.0, 1.0)
    low, high = np.where(good, low, np.zeros_like(low)), np.where(good, high, np.ones_like(high))
    if lower.shape[-1] > DEPTH:
        near, far = lower[..., DEPTH], upper[..., DEPTH]
        known = ((near <= far) & np.isfinite(near) & (near >= 0.0)) | ((near == np.inf) & (far == -np.inf))
        low[..., DEPTH], high[..., DEPTH] = np.where(known, near, 0.0), np.where(known, far, np.inf)
    return low, high


def _usable_linear(linear: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Return the linear sets (A_lower, b_lower, A_upper, b_upper), replaced by 0 and 1 where not finite."""
    found: list[np.ndarray] = []
    for slope, offset, trivial in ((linear[0], linear[1], 0.0), (linear[2], linear[3], 1.0)):
        good = np.isfinite(slope).all(axis=-1) & np.isfinite(offset)
        found.append(np.where(good[..., None], slope, np.zeros_like(slope)))
        found.append(np.where(good, offset, np.full_like(offset, trivial)))
    return tuple(found)


def _context_bytes(context: Context | None) -> int:
    return 0 if context is None else context.nbytes


def _linear_bytes(bounds: Bounds) -> int:
    return 0 if bounds.linear is None else sum(a.nbytes for a in bounds.linear)


def _narrow_axes(box: ParameterBox, root: ParameterBox) -> np.ndarray:
    """Return [d] whether an axis is too narrow to be halved."""
    width, whole = np.array(box.upper) - np.array(box.lower), np.array(root.upper) - np.array(root.lower)
    return width <= _NARROWEST * whole


def _narrow(box: ParameterBox, root: ParameterBox) -> bool:
    """Return whether every axis is too narrow to be halved; true of a single pose."""
    return bool(_narrow_axes(box, root).all())


def _pixels_inside(frame: Frame) -> np.ndarray:
    """Return [T, side, side] whether a tile's pixel lies inside the image."""
    rows = np.arange(frame.down * frame.side) < frame.camera.height
    columns = np.arange(frame.across * frame.side) < frame.camera.width
    grid = (rows[:, None] & columns[None, :]).reshape(frame.down, frame.side, frame.across, frame.side)
    return grid.swapaxes(1, 2).reshape(-1, frame.side, frame.side)
