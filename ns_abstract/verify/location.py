"""The search for poses that explain a photo, one block of cells at a time (docs/dev/design.md, U).

Parameters may be sheared: cells with the same image motion are far larger then. A cell is excluded ("certified" in the
store), or its pose explains the photo ("falsified"), or it is cut.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.geometry.box import Float64Array, ParameterBox, shared_out
from ns_abstract.geometry.motion_cells import MotionCells
from ns_abstract.geometry.tiles import assemble
from ns_abstract.refine.protocol import Bounds, Frame, SubBoxFrame
from ns_abstract.verify.cell_boxes import (
    aligned,
    between,
    divided,
    inner_cell,
    meeting,
    resolved,
    slabs,
    sub_box_counts,
)
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.motion_boxes import MotionBoxes
from ns_abstract.verify.moved_pictures import FoundPose, MovedPictures
from ns_abstract.verify.photo import Photo, TiledPhoto
from ns_abstract.verify.pixel_rounds import BoundedPixels, PixelRounds, RoundTuning
from ns_abstract.verify.search_results import BlockResult, FinishedCell
from ns_abstract.verify.telling_pixels import PixelOrder, TellingPixels, typical_cell

#: Grid units along each parameter, as a power of two.
UNITS = 20


@dataclass(frozen=True)
class LocationTuning:
    """Preferences of the search; soundness of excluding a cell does not depend on them."""

    #: From so many parameters on, pixels are bounded over cells of the image motion, so many along its two axes; part
    #: of it widens bounds all the same. Sub-boxes then cost a look at each pixel's motion cells, no bounds.
    many: int = 4
    motion_cells: tuple[int, int] = (8, 8)
    motion_share: float = 0.25
    sub_boxes: int = 4096
    #: In sets of fewer, sub-boxes along the two parameters that move the picture most: these move it more beside the
    #: motion of what a pixel shows.
    along: int = 8
    #: `LocationSearch.widths` beyond which cells are cut without bounds, in sets of few parameters and of many.
    coarse: tuple[float, float] = 4.0, 1.8
    #: Rounds of pixels. What a cell takes whatever its pixels are is most of the work, and a first round of more pixels
    #: excludes more at once.
    pixel_rounds: RoundTuning = field(default_factory=lambda: RoundTuning(first=1.3))
    #: The part of a box of sub-boxes that has to be left for it to become one cell.
    filled: float = 0.5
    #: Grid lines that cells begin and end at, as a power of two of their width.
    aligned: int = 5
    contracted: float = 0.3
    #: Pixels that are bounded to exclude a cell: so many times those that may show anything.
    surplus: float = 2.0
    #: Width of the cell whose bounds tell how loose they are, without parts, with sub-boxes and with motion cells.
    reference: tuple[float, float, float] = 2.4, 1.8, 0.9
    #: Pixels that must be likely to be excluded, as a part of those that exclude a cell, for it to be bounded.
    promise: float = 0.6
    #: Image motion below which a parameter counts as one that moves nothing.
    still: float = 1e-12
    #: How many pixels bounds exclude, about, as a power of their width; ends of the part of it that cuts aim at.
    power: float = 2.5
    least_aim: float = 0.35
    most_aim: tuple[float, float] = 0.85, 0.65
    #: Part of a cell's volume that a contraction must take for it to be bounded again, and how often.
    worth: float = 0.4
    rounds: int = 4
    #: A cell is not cut any more where its volume is that of a box of this part of every range.
    finest: float = 2.0**-10
    #: Most cells that one is cut into.
    parts: int = 16
    #: Pixels that a picture may miss beyond those allowed, as a part of all, where a better pose is looked for nearby.
    hopeful: float = 0.3
    steps: int = 12


@dataclass(frozen=True)
class LocationResult(BlockResult):
    """The result of a block of cells. ``best``: the rendered pose of fewest outliers; None: nothing was rendered."""

    best: FoundPose | None = None


class LocationSearch:
    """Examines cells of one pose set.

    Args:
        frame: The frame that is searched and bounded; its parameters may be sheared.
        plain: The frame of the same set in its own parameters, for renders.
    """

    def __init__(
        self, frame: Frame, plain: Frame, photo: Photo, *, contract: bool = True, tuning: LocationTuning | None = None
    ) -> None:
        self.frame, self.plain, self.photo, self.contract = frame, plain, photo, contract
        self.tuning = tuning or LocationTuning()
        box = frame.box
        self.grid = CellGrid(box, (1 << UNITS,) * box.dimensions, (1,) * box.dimensions)

    @cached_property
    def tiled(self) -> TiledPhoto:
        """The photo in the tiles of pictures."""
        return self.photo.tiled(self.frame.side)

    @cached_property
    def _motion_per_unit(self) -> Float64Array:
        """Image motion [d] in pixels of typical scene elements by unit of each parameter."""
        box = self.frame.box
        motion = np.nan_to_num(np.asarray(self.frame.motion(box), np.float64), nan=0.0, posinf=0.0)
        # what moves nothing is cut for the bounds' sake now and then
        motion = np.maximum(motion, 1e-3 * max(1.0, float(motion.max(initial=0.0))))
        return motion / (np.array(box.upper) - np.array(box.lower))

    @cached_property
    def _width_per_unit(self) -> Float64Array:
        """The same [d] for the motion that widens bounds; see `widths`. It may take seconds for large pictures."""
        box = self.frame.box
        if not self.by_motion:
            return self._motion_per_unit / self.along(box)
        assert isinstance(self.frame, SubBoxFrame)
        parallax = self.frame.parallax(box) / (np.array(box.upper) - np.array(box.lower))
        return parallax + self.tuning.motion_share * self._motion_per_unit

    @property
    def sub_box_frame(self) -> SubBoxFrame | None:
        """The frame, if cells are contracted and it can bound pixels over their sub-boxes; else None."""
        return self.frame if self.contract and isinstance(self.frame, SubBoxFrame) else None

    @property
    def by_motion(self) -> bool:
        """Whether wide cells are bounded over cells of the image motion (U11)."""
        return self.has_parts and self.frame.box.dimensions >= self.tuning.many

    def along(self, box: ParameterBox) -> np.ndarray:
        """Return the numbers [d] of sub-boxes along the parameters of a cell."""
        if self.by_motion:
            return shared_out(self.moved(box), self.tuning.sub_boxes)
        counts = np.ones(box.dimensions, np.int64)
        if self.sub_box_frame is not None:
            counts[np.argsort(-self.moved(self.frame.box), kind="stable")[:2]] = self.tuning.along
        return counts

    def first_cells(self) -> list[Cell]:
        """Return the set's initial cell, or its parts where it is too wide for bounds: these run side by side."""
        (root,) = self.grid.roots()
        if self.width(self.grid.box) <= self.tuning.coarse[self.by_motion]:
            return [root]
        examination = _Examination(self, root, self.tiled.chosen(()))
        examination.cut()
        return examination.children

    def moved(self, box: ParameterBox) -> Float64Array:
        """Return the estimated image motion [d] in pixels of typical scene elements over a cell."""
        return self._motion_per_unit * (np.array(box.upper) - np.array(box.lower))

    def widths(self, box: ParameterBox) -> Float64Array:
        """Return the estimated pixels [d] by which parameters widen bounds: motion that sub-boxes do not follow."""
        return self._width_per_unit * (np.array(box.upper) - np.array(box.lower))

    def width(self, box: ParameterBox) -> float:
        """Return the norm of the `widths`."""
        return float(np.linalg.norm(self.widths(box)))

    @cached_property
    def telling(self) -> TellingPixels:
        """The pixels of a cell that are bounded first: a heuristic, from one cell in the middle of the set."""
        box, least = self.frame.box, self.tuning.still
        reference = self.tuning.reference[self.has_parts + self.by_motion]
        side = np.minimum(1.0, reference / math.sqrt(max(1, box.dimensions)) / np.maximum(self.widths(box), least))
        cell = between(box, -side, side)
        picture = assemble(self.plain.render(self.original(cell.middle)), self.frame.camera)[..., :3]
        typical = typical_cell(self.frame, cell, self.parts(cell), max(self.width(cell), least), picture)
        return TellingPixels(self.tiled, self.frame.camera, typical)

    def motion_cells(self, box: ParameterBox) -> MotionCells | None:
        """Return the motion cells of a cell, if the frame can bound pixels over them; else None."""
        frame = self.sub_box_frame
        if frame is None or box.dimensions < 2:
            return None
        return frame.motion_field(box).cells(np.array(self.tuning.motion_cells))

    @cached_property
    def moved_pictures(self) -> MovedPictures | None:
        """Pictures near the middles of cells, for frames that bound pixels over sub-boxes; None for others."""
        frame = self.sub_box_frame
        if frame is None:
            return None
        return MovedPictures(self.frame, frame.motion_field, self.look)

    def look(self, values: Float64Array) -> tuple[np.ndarray, FoundPose]:
        """Render the pose at sheared values; return its tiles, and the pose with its outliers."""
        pose = self.original(values)
        picture = self.plain.render(pose)
        return picture, FoundPose(tuple(pose.tolist()), int(self.tiled.outside(picture).sum()))

    @property
    def has_parts(self) -> bool:
        """Whether pixels of wide cells are bounded over parts of them."""
        return self.sub_box_frame is not None and self.frame.box.dimensions > 1

    def parts(self, box: ParameterBox) -> MotionCells | np.ndarray | None:
        """Return the parts of a cell: motion cells, or numbers [d] of sub-boxes; None: it has none."""
        if not self.has_parts:
            return None
        return self.motion_cells(box) if self.by_motion else self.along(box)

    def examine(self, cells: Sequence[Cell]) -> LocationResult:
        """Exclude the cells, or cut them, and return the result."""
        begin = time.perf_counter()
        reports = [_Examination(self, cell, self.tiled.chosen(cell.outliers)) for cell in cells]
        for report in reports:
            report.run()
        children = [report.with_known_outliers(part) for report in reports for part in report.children]
        poses = [pose for report in reports for pose in (report.best, report.nearby) if pose is not None]
        return LocationResult(
            leaves=tuple(leaf for report in reports for leaf in report.leaves),
            blocks=tuple((part,) for part in children),
            # the largest first
            ranks=tuple(-part.volume / self.grid.volume for part in children),
            samples=(),
            bounded=sum(report.bounded for report in reports),
            seconds=time.perf_counter() - begin,
            best=min(poses, key=lambda pose: pose.outliers, default=None),
        )

    def original(self, values: Float64Array) -> Float64Array:
        """Return the set's own parameters [d] at sheared ``values`` [d], clipped to the set."""
        box = self.plain.box
        by_name = dict(zip(self.frame.box.names, np.asarray(values, np.float64).tolist(), strict=True))
        for name, factors in self.frame.pose_set.shear.items():
            by_name[name] += sum(factor * by_name[other] for other, factor in factors.items())
        return np.clip([by_name[name] for name in box.names], box.lower, box.upper)


@dataclass
class _Examination:
    """The examination of one cell.

    Attributes:
        inherited: [T, side, side] counted pixels that are outliers at all poses, by bounds over an enclosing cell (U9).
    """

    search: LocationSearch
    cell: Cell
    inherited: np.ndarray
    leaves: list[FinishedCell] = field(default_factory=list)
    children: list[Cell] = field(default_factory=list)
    best: FoundPose | None = None
    #: A pose that was rendered for cells around; it may lie beside this cell.
    nearby: FoundPose | None = None
    bounded: int = 0
    #: Pixels that were excluded, as a part of those that would have excluded the cell.
    share: float = 1.0
    #: The last sub-boxes that were bounded: of which cell, their numbers along axes, and their pixels.
    divisions: tuple[Cell, np.ndarray, PixelRounds] | None = None

    def run(self) -> None:
        """Exclude the cell, or contract and cut it."""
        search, tuning = self.search, self.search.tuning
        if self.inherited.sum() > search.tiled.allowed:
            return self._exclude(1.0)
        for _ in range(tuning.rounds):
            before = self.cell.volume
            feasible = search.frame.feasible(search.grid.box_of(self.cell))
            if feasible is None:
                return self._exclude(1.0)
            self._shrink(feasible)
            box = search.grid.box_of(self.cell)
            if box.dimensions and search.width(box) > tuning.coarse[search.by_motion]:
                break
            moved = float(np.linalg.norm(search.moved(box))) if search.by_motion else search.width(box)
            if moved > tuning.contracted:
                excluded = self._exclude_sub_boxes(box)
                if excluded:
                    return None
                if excluded is False:
                    break
            picture, outliers = self._look(box.middle)
            if not self._bound_whole(box, picture, outliers) or self.cell.volume > (1.0 - tuning.worth) * before:
                break
        if not self.done:
            self.cut()
        return None

    @property
    def done(self) -> bool:
        """Whether every remaining part of the cell has a verdict."""
        return bool(self.leaves) and self.leaves[-1].cell == self.cell

    def _exclude_sub_boxes(self, box: ParameterBox) -> bool | None:
        """Exclude sub-boxes of the cell; return whether any was, or None if the frame cannot bound sub-boxes."""
        search, tuning = self.search, self.search.tuning
        frame, cells = search.sub_box_frame, search.motion_cells(box)
        counts = sub_box_counts(self.cell, search.along(box))
        if frame is None or cells is None or not resolved(box, counts):
            return None
        boxes, parts = MotionBoxes(cells, counts, search.frame.camera), cells if search.by_motion else counts
        rounds, order = self._rounds(box, self._approximate_tiles(box), counts)
        while (chosen := rounds.following(*order.towards(boxes.moved[rounds.left]))) is not None:
            self.bounded += 1
            tiles, (telling, differences) = np.flatnonzero(chosen.any(axis=(1, 2))), order.telling(chosen)
            goals = np.where(telling, search.tiled.goals(chosen, differences), np.nan)
            ends = frame.sub_box_ends(box, parts, tiles, chosen[tiles], goals, differences)
            if ends is None:
                return None
            excluding = search.tiled.excluding(*ends, chosen, differences)
            rounds.take(boxes.excluded(excluding, chosen) if search.by_motion else excluding, chosen)
        self.share = min(1.0, rounds.expected)
        self.divisions = self.cell, counts, rounds
        left = rounds.left.reshape(counts)
        if left.all():
            return False
        remaining: list[Cell] = []
        for cell, has_left in divided(self.cell, left, tuning.filled):
            if has_left:
                remaining.append(cell)
            else:
                self.leaves.append(FinishedCell(cell, "certified", 1.0, 0.0))
        if len(remaining) == 1 and remaining[0].volume > (1.0 - tuning.worth) * self.cell.volume:
            self.cell = remaining[0]
            self.cut()
        else:
            self.children = remaining
        return True

    def with_known_outliers(self, part: Cell) -> Cell:
        """Return a part of the cell, with the pixels that are known to be outliers at all of its poses (U9)."""
        pixels = self.inherited
        if self.divisions is not None:
            cell, counts, rounds = self.divisions
            pixels = pixels | rounds.excluded(meeting(cell, counts, part).reshape(-1))
        return replace(part, outliers=tuple(np.flatnonzero(pixels).tolist()))

    def _exclude(self, margin: float) -> None:
        self.leaves.append(FinishedCell(self.cell, "certified", margin, 0.0))

    def _shrink(self, box: ParameterBox) -> None:
        """Exclude the cell outside of ``box``, in whole grid units."""
        inner = inner_cell(self.search.grid, self.cell, box)
        if float(np.linalg.norm(self.search.moved(box))) > self.search.tuning.contracted:
            inner = aligned(self.cell, inner, self.search.tuning.aligned)
        self.leaves += [FinishedCell(slab, "certified", 1.0, 0.0) for slab in slabs(self.cell, inner)]
        self.cell = inner

    def _look(self, values: Float64Array) -> tuple[np.ndarray, int]:
        """Render the pose at sheared values; return its tiles, and the number of outliers."""
        picture, pose = self.search.look(values)
        if self.best is None or pose.outliers < self.best.outliers:
            self.best = pose
        return picture, pose.outliers

    def _approximate_tiles(self, box: ParameterBox) -> np.ndarray:
        """Return approximate tiles of the picture at the middle of a cell."""
        moved = self.search.moved_pictures
        nearby = None if moved is None else moved.near(box)
        if nearby is None:
            return self._look(box.middle)[0]
        picture, self.nearby = nearby
        return picture

    @property
    def explained(self) -> bool:
        """Whether a rendered pose explains the photo."""
        return self.best is not None and self.best.outliers <= self.search.tiled.allowed

    def _bound_whole(self, box: ParameterBox, picture: np.ndarray, outliers: int) -> bool:
        """Bound the cell without sub-boxes, in rounds of pixels, and exclude or contract it (U8).

        Returns:
            Whether the cell was contracted.
        """
        search, tiled, tuning = self.search, self.search.tiled, self.search.tuning
        before = self.cell.volume
        linear = search.contract and float(np.linalg.norm(search.moved(box))) <= tuning.contracted
        (rounds, telling), linear_bounds = self._rounds(box, picture, np.ones(box.dimensions, np.int64)), None
        order = telling.everywhere
        if order[0].size < tuning.promise * (tiled.allowed + 1 - int(self.inherited.sum())):
            order = order[0][:0], order[1][:0]
        while True:
            chosen = rounds.following(*order)
            last = chosen is None
            if chosen is None:
                if not linear:
                    return False
                chosen = rounds.rest
            tiles = np.flatnonzero(chosen.any(axis=(1, 2)))
            bounds = self._bound(box, tiles, linear, chosen[tiles])
            lower, upper = (end[chosen[tiles]][..., None] for end in (bounds.lower, bounds.upper))
            rounds.count(lower, upper, chosen)
            self.share = min(1.0, rounds.expected)
            self.inherited = rounds.excluded(np.ones(1, bool))
            if not rounds.left.any():
                self._exclude(float(rounds.numbers[0] - tiled.allowed))
                return False
            if not linear:
                continue
            linear_bounds = linear_bounds or BoundedPixels(tiled, box.dimensions)
            linear_bounds.outliers = self.inherited
            linear_bounds.add(bounds, tiles, chosen)
            if last:
                if self._finish_explained(linear_bounds):
                    return False
                if tiled.allowed < outliers < tuning.hopeful * search.photo.counted.sum():
                    fit = linear_bounds.best_fit(tuning.steps)
                    if fit is not None:
                        self._look(box.at(fit))
            if not self._contract(box, linear_bounds):
                return False
            if last or self.cell.volume <= (1.0 - tuning.worth) * before:
                return True

    def _rounds(self, box: ParameterBox, picture: np.ndarray, counts: np.ndarray) -> tuple[PixelRounds, PixelOrder]:
        """Return rounds of pixels for the sub-boxes [counts] of the cell, and the order of candidate pixels."""
        search, tiled, tuning = self.search, self.search.tiled, self.search.tuning
        moved, needed = float(np.linalg.norm(search.moved(box))), tiled.allowed + 1 - int(self.inherited.sum())
        parts, frame = bool(counts.prod() > 1), search.sub_box_frame
        chosen = search.telling.order(
            picture, max(1, round(0.5 * moved)), search.width(box) if parts else moved,
            tiled.counted & ~self.inherited, round(tuning.surplus * needed),
            frame.element_counts(box) if parts and frame is not None else None,
        )  # fmt: skip
        return PixelRounds(tiled, int(np.prod(counts)), self.inherited, tuning.pixel_rounds), chosen

    def _bound(self, box: ParameterBox, tiles: np.ndarray, linear: bool, pixels: np.ndarray | None = None) -> Bounds:
        """Return bounds of ``tiles``, or of ``pixels`` in them alone where the frame supports that."""
        check_cancelled()
        self.bounded += 1
        frame = self.search.frame
        within = frame.enclosing(box) if isinstance(frame, SubBoxFrame) else None
        return frame.bound_parts([box], tiles, within, linear, pixels)[0]

    def _finish_explained(self, linear_bounds: BoundedPixels) -> bool:
        """Finish the cell and return True if every pose of it explains the photo."""
        tiled = self.search.tiled
        if int(tiled.counted.sum()) - linear_bounds.explained > tiled.allowed or not self.explained:
            return False
        self._finish()
        return True

    def _contract(self, box: ParameterBox, linear_bounds: BoundedPixels) -> bool:
        """Exclude the part of the cell that the pixels' linear bounds rule out; return whether anything remains."""
        least, most = linear_bounds.reach
        if (least > most).any():
            self._exclude(1.0)
            return False
        self._shrink(between(box, least, most))
        return True

    def _finish(self) -> None:
        """Finish the cell without cutting it: possible if a rendered pose explains the photo."""
        if self.explained:
            assert self.best is not None
            margin = float(self.best.outliers - self.search.tiled.allowed)
            leaf = FinishedCell(self.cell, "falsified", min(margin, 0.0), 0.0, counterexample=self.best.values)
        else:
            leaf = FinishedCell(self.cell, "unknown", None, 0.0, reason="the finest cell")
        self.leaves.append(leaf)

    def cut(self) -> None:
        """Cut the remaining cell where the picture moves most."""
        search, tuning = self.search, self.search.tuning
        if self.cell.volume <= max(1.0, tuning.finest ** len(self.cell.first) * search.grid.volume):
            return self._finish()
        moved = search.widths(search.grid.box_of(self.cell))
        total = float(np.linalg.norm(moved))
        aim = tuning.coarse[search.by_motion]
        if total <= aim:
            most = tuning.most_aim[search.by_motion]
            aim = total * min(max(self.share ** (1.0 / tuning.power), tuning.least_aim), most)
        parts = [1] * len(moved)
        sizes = [past - first for first, past in zip(self.cell.first, self.cell.past, strict=True)]
        while np.prod(parts) < 2 or (2 * np.prod(parts) <= tuning.parts and total > aim):
            free = [k for k in range(len(moved)) if sizes[k] >= 2 * parts[k]]
            if not free:
                break
            axis = max(free, key=lambda k: moved[k])
            parts[axis] *= 2
            moved[axis] *= 0.5
            total = float(np.linalg.norm(moved))
        if np.prod(parts) == 1:
            return self._finish()
        self.children = search.grid.cut(self.cell, parts)
        return None
