"""Linear bounds of all rays of a frame over cells, from cached bounds over strips of the set (design.md, F12, F13).

The set of poses is cut into strips, narrower at every level. Rays are bounded over whole strips, in groups of
neighbours, and bounds are cached by part of the strip; a cell takes those of the parts that it meets. The bounds of a
strip depend on the strip and the group alone, not on earlier requests.
"""

from __future__ import annotations

import itertools
import math
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ns_abstract.arithmetic.rounding import PART_END_ROUNDING
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import COLOR_SHIFTS, PoseBox
from ns_abstract.methods.nerf.division import Division
from ns_abstract.methods.nerf.hsv import shift_ends, shift_parts
from ns_abstract.methods.nerf.planes import fit_planes
from ns_abstract.methods.nerf.ray_bundle import RayBundle
from ns_abstract.methods.nerf.ray_field import BoundedRays, RayBounds

#: Rays of a group: for compiled kernels, and for torch, which needs many cells at a time.
_GROUP, _GROUP_ON_DEVICE = 8, 64
#: Colour tolerance of each level (`BoundedRays.rays`).
TOLERANCES = (0.02, 0.005, 0.0012, 3e-4)
#: Strips by axis from each level to the next: with one parameter, and with more.
_FINER_LINE, _FINER = 4, 2
#: Most parts of a strip: with one parameter, and with more.
_PARTS_LINE, _PARTS = 512, 2048
#: Halvings of a strip's first cells, with one parameter: planes through finer parts are tighter.
_DEEPER_LINE = 4
#: Most strips along an axis.
_MOST = 1 << 20
#: Parts of the range of hues or saturations at the first level, and factor from level to level.
_SHIFT_PARTS, _SHIFT_FINER = 12, 2
#: Shares of a property's margin: where pixels' widths cost more than the second, rays are refined down to the first.
_AIM, _ENOUGH = 0.2, 0.4
#: Most bytes of bounds in the cache.
_KEPT = 1 << 29
#: Rays and rounds of a trial that measures seconds and the width of first cells.
_TRIED, _ROUNDS = 8, 3

#: Function from arguments of `BoundedRays.rays`, one tuple by group, to its results.
BoundBatches = Callable[[Sequence[tuple]], list[RayBounds]]
PixelWeightSource = Callable[[], "np.ndarray | None"]


@dataclass(frozen=True)
class _StripBounds:
    """Bounds of n rays over a strip: colours [2, n, *parts, 3] by part, opacities' upper bounds [n, samples]."""

    parts: np.ndarray
    alpha: np.ndarray

    @property
    def nbytes(self) -> int:
        return self.parts.nbytes + self.alpha.nbytes


@dataclass(frozen=True)
class StripLayout:
    """How a set is cut into strips.

    Attributes:
        counts: Strips of the first level along each parameter of the poses.
        division: Cells and stored parts of a strip.
        displacement: `BoundedRays.displacement` with which the bounds of every strip begin.
    """

    counts: tuple[int, ...]
    division: Division
    displacement: float


class PoseStrips:
    """Cache of bounds of all rays of a frame over strips of its set (design.md, F13).

    Args:
        pose_set: The frame's set; parameters that shift colours come last in its box.
        pixels: [t, 2] rows and columns of the rays.
        run: Runs `BoundedRays.rays` for each tuple of arguments.
    """

    def __init__(self, bounds: BoundedRays, pose_set: PoseBox, pixels: np.ndarray, run: BoundBatches) -> None:
        self.bounds, self.pose_set, self.geometry = bounds, pose_set, pose_set.geometry
        self.pixels, self.run = pixels, run
        self.poses = self.geometry.box
        self.shifting = tuple(name for name in pose_set.box.names if name in COLOR_SHIFTS)
        group = _GROUP if bounds.compiled else _GROUP_ON_DEVICE
        self.groups = [slice(k, min(k + group, len(pixels))) for k in range(0, len(pixels), group)]
        self._known: OrderedDict[tuple, _StripBounds] = OrderedDict()
        self._bytes = 0
        self._layout: StripLayout | None = None
        self._displacement = bounds.displacement
        #: Number of strips of the first level; 1 until `layout` was called.
        self.count = 1
        #: Seconds that a ray takes over a strip of the first level; None until `layout` measured it.
        self.effort: float | None = None

    def layout(self) -> StripLayout:
        """Return strips narrow enough for the field's bounds, by a trial on a few rays in the middle of the set."""
        if self._layout is None:
            tried = self.pixels[np.unique(np.linspace(0, len(self.pixels) - 1, _TRIED).astype(int))]
            displacement = self._displacement
            for _ in range(_ROUNDS):
                layout_found = self._cut(displacement, tried)
                self.count = math.prod(layout_found.counts)
                strip = self._strip(layout_found.counts, tuple(n // 2 for n in layout_found.counts))
                learned = displacement
                # one ray first, for a measurement even if there is no time for more
                for rays in (tried[len(tried) // 2 :][:1], tried):
                    begin = time.perf_counter()
                    learned = self.run([self._call(strip, rays, layout_found, 0, None)])[0].displacement
                    self.effort = (time.perf_counter() - begin) / len(rays)
                if 0.6 < learned / displacement < 1.7:
                    break
                displacement = learned
            self._layout = layout_found
        return self._layout

    def _cut(self, displacement: float, pixels: np.ndarray) -> StripLayout:
        d = self.poses.dimensions
        counts = [1] * d
        self.bounds.displacement = displacement
        while True:
            box = self._strip(counts, [n // 2 for n in counts])
            bundle = RayBundle(self.geometry, box, pixels, self.bounds.taylor)
            moves = bundle.displacement(self.bounds.distances, self.bounds.lengths)
            line = moves.shape[2] == 1
            most, deeper = (_PARTS_LINE, _DEEPER_LINE) if line else (_PARTS, None)
            division = self.bounds.division(moves, most, deeper)
            if division is not None or max(counts, default=_MOST) >= _MOST:
                break
            widest = np.nan_to_num(moves[..., :d].reshape(-1, d).max(axis=0), nan=np.inf)
            counts[int(np.argmax(widest))] *= 2
        if division is None:
            # nothing is known then
            counts, division = [1] * d, Division((), d)
        return StripLayout(tuple(counts), division, displacement)

    def _strip(self, counts: Sequence[int], place: Sequence[int]) -> ParameterBox:
        """Return the strip ``place`` of ``counts`` along each parameter; neighbours share their ends exactly."""
        box = self.poses
        for axis, (count, k) in enumerate(zip(counts, place, strict=True)):
            ends = self._ends(axis, count, k, k + 1)
            box = box.replace(axis, float(ends[0]), float(ends[1]))
        return box

    def _ends(self, axis: int, count: int, first: int, past: int) -> np.ndarray:
        """Return the edges [past - first + 1] of the strips ``first`` to ``past`` (exclusive) of ``count``."""
        low, high = self.poses.lower[axis], self.poses.upper[axis]
        ends = low + (high - low) * (np.arange(first, past + 1) / count)
        return np.where(np.arange(first, past + 1) == count, high, ends)

    def _counts(self, level: int) -> tuple[int, ...]:
        finer = _FINER_LINE if self.poses.dimensions == 1 else _FINER
        return tuple(n * finer**level for n in self.layout().counts)

    def _shift_ends(self, level: int) -> list[np.ndarray]:
        """Return edges of a level's parts of the ranges of hue and saturation (`hsv.shift_ends`)."""
        return shift_ends(self.pose_set.box, self.pose_set.fixed, _SHIFT_PARTS * _SHIFT_FINER**level)

    def _call(
        self, strip: ParameterBox, pixels: np.ndarray, layout: StripLayout, level: int, known: np.ndarray | None
    ) -> tuple:
        shifts = shift_parts(self._shift_ends(level))
        return self.geometry, strip, pixels, TOLERANCES[level], known, None, shifts, layout.division

    def _ensure(self, level: int, place: tuple[int, ...], groups: Sequence[int]) -> list[_StripBounds]:
        """Return bounds of ``groups`` of rays over the strip ``place`` of a level, cached or computed."""
        computed: dict[int, _StripBounds] = {}
        missing = []
        for group in groups:
            key = (level, place, group)
            if key in self._known:
                self._known.move_to_end(key)
                computed[group] = self._known[key]
            else:
                missing.append(group)
        if missing:
            finer = _FINER_LINE if self.poses.dimensions == 1 else _FINER
            above = None
            if level:
                above = self._ensure(level - 1, tuple(k // finer for k in place), missing)
            strip, layout = self._strip(self._counts(level), place), self.layout()
            calls = []
            for k, group in enumerate(missing):
                known_alpha = None if above is None else above[k].alpha
                calls.append(self._call(strip, self.pixels[self.groups[group]], layout, level, known_alpha))
            self.bounds.displacement = layout.displacement
            for group, result in zip(missing, self.run(calls), strict=True):
                computed[group] = self._keep((level, place, group), result)
        return [computed[group] for group in groups]

    def _keep(self, key: tuple, result: RayBounds) -> _StripBounds:
        assert result.parts is not None
        hues, saturations = (len(ends) - 1 for ends in self._shift_ends(key[0]))
        parts = result.parts
        if parts.shape[2] != 1 or self.shifting:
            # [2, n, shifts, *poses, 3]: shifts behind the poses
            parts = np.moveaxis(parts, 2, -2)
            sizes = [n for n, name in zip((hues, saturations), COLOR_SHIFTS, strict=True) if name in self.shifting]
            parts = parts.reshape(*parts.shape[:-2], *sizes, 3)
        else:
            parts = parts[:, :, 0]
        strip_bounds = _StripBounds(np.ascontiguousarray(parts), result.alpha)
        self._known[key] = strip_bounds
        self._bytes += strip_bounds.nbytes
        while self._bytes > _KEPT and len(self._known) > len(self.groups):
            self._bytes -= self._known.popitem(last=False)[1].nbytes
        return strip_bounds

    def levels(self, box: ParameterBox) -> int:
        """Return the number of useful levels for the cell ``box``: up to strips under half of its width."""
        for level in range(1, len(TOLERANCES)):
            for axis, count in enumerate(self._counts(level)):
                width = (self.poses.upper[axis] - self.poses.lower[axis]) / count
                if box.upper[axis] - box.lower[axis] > 2.0 * width:
                    return level
        return len(TOLERANCES)

    def cell_bounds(
        self, box: ParameterBox, weigh: PixelWeightSource | None, most_rays: int | None = None
    ) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
        """Return linear bounds of t rays over a cell (A_lower, b_lower, A_upper, b_upper), and lower and upper bounds.

        Shapes are [t, 3, d] (A) and [t, 3]. The rays are all, or the first ones: ``most_rays``, or a few more.

        Args:
            most_rays: How many rays to bound; all if None.
            weigh: Returns [t, 3] about which share of the margin a unit of each pixel's width costs. None, returned or
                in its place: no ray is refined.
        """
        groups = [group for group in self.groups if most_rays is None or group.start < most_rays]
        linear, lower, upper = self._level_sets(box, 0, np.arange(len(groups)))
        weights, levels = None, self.levels(box)
        for level in range(1, levels):
            if weights is None:
                weights = None if weigh is None else weigh()
                if weights is None:
                    break
            starts = [group.start for group in groups]
            cost = np.add.reduceat((weights[: len(lower)] * _widths(linear)).sum(axis=1), starts)
            # no refinement if even the finest level would not suffice
            if not _ENOUGH < cost.sum() < TOLERANCES[level - 1] / TOLERANCES[levels - 1]:
                break
            order = np.argsort(-cost, kind="stable")
            left = cost.sum() - np.cumsum(cost[order])
            chosen = np.sort(order[: 1 + int(np.searchsorted(-left, -_AIM))])
            finer, finer_lower, finer_upper = self._level_sets(box, level, chosen)
            rays = np.concatenate([np.arange(len(self.pixels))[groups[k]] for k in chosen])
            for whole, part in zip((*linear, lower, upper), (*finer, finer_lower, finer_upper), strict=True):
                whole[rays] = part
        return linear, lower, upper

    def _level_sets(
        self, box: ParameterBox, level: int, groups: np.ndarray
    ) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
        """Return `cell_bounds` of the rays of the ``groups``, by strips of one ``level``."""
        counts = self._counts(level)
        ranges = [self._overlapped(axis, count, box) for axis, count in enumerate(counts)]
        parts = self.layout().division.parts[: self.poses.dimensions]
        # [2, rays, *parts, 3] of all strips that the cell meets, side by side
        bounds_by_place = {
            place: np.concatenate([k.parts for k in self._ensure(level, place, groups.tolist())], axis=1)
            for place in itertools.product(*(range(a, b) for a, b in ranges))
        }
        values = _joined(bounds_by_place, ranges, 0, ())
        edges = [
            self._part_ends(axis, count, first, past, parts[axis])
            for axis, (count, (first, past)) in enumerate(zip(counts, ranges, strict=True))
        ]
        edges += [
            ends for ends, name in zip(self._shift_ends(level), COLOR_SHIFTS, strict=True) if name in self.shifting
        ]
        ends, slack = [], []
        for axis, lines in enumerate(edges):
            low, high = box.lower[axis], box.upper[axis]
            middle, half = 0.5 * (low + high), 0.5 * (high - low)
            room = PART_END_ROUNDING * max(abs(low), abs(high), abs(lines[0]), abs(lines[-1]))
            first = max(0, int(np.searchsorted(lines, low - room, side="right")) - 1)
            past = min(len(lines) - 1, int(np.searchsorted(lines, high + room, side="left")))
            values = values.take(np.arange(first, past), axis=axis + 2)
            ends.append(np.clip((lines[first : past + 1] - middle) / half, -1.0, 1.0))
            slack.append(room / half)
        linear = fit_planes(values[0], values[1], ends, slack)
        axes = tuple(range(1, values[0].ndim - 1))
        return list(linear), values[0].min(axis=axes), values[1].max(axis=axes)

    def _overlapped(self, axis: int, count: int, box: ParameterBox) -> tuple[int, int]:
        """Return the first and past-the-last number of the strips that overlap the cell by more than an end."""
        low, high = self.poses.lower[axis], self.poses.upper[axis]
        first = math.floor((box.lower[axis] - low) / (high - low) * count)
        past = math.ceil((box.upper[axis] - low) / (high - low) * count)
        first, past = max(0, first - 1), min(count, past + 1)
        ends = self._ends(axis, count, first, past)
        begin = int(np.searchsorted(ends, box.lower[axis], side="right")) - 1
        end = int(np.searchsorted(ends, box.upper[axis], side="left"))
        return first + max(0, begin), first + max(end, begin + 1)

    def _part_ends(self, axis: int, count: int, first: int, past: int, parts: int) -> np.ndarray:
        """Return edges of the parts of the strips from ``first`` to ``past`` (exclusive), in the parameter's unit."""
        ends = self._ends(axis, count, first, past)
        inner = np.arange(parts) / parts
        inner_ends = ends[:-1, None] + (ends[1:] - ends[:-1])[:, None] * inner
        return np.append(inner_ends.ravel(), ends[-1])


def _joined(
    kept: dict[tuple[int, ...], np.ndarray], ranges: list[tuple[int, int]], axis: int, place: tuple[int, ...]
) -> np.ndarray:
    """Concatenate the arrays ``kept`` by place along their axes 2, 3, ..., for all places in ``ranges``.

    ``axis`` and ``place`` are the state of the recursion: 0 and () at first.
    """
    if axis == len(ranges):
        return kept[place]
    rows = [_joined(kept, ranges, axis + 1, (*place, k)) for k in range(*ranges[axis])]
    return np.concatenate(rows, axis=axis + 2)


def _widths(linear: Sequence[np.ndarray]) -> np.ndarray:
    """Return [t, 3] mean distances over the cell between the planes b_lower, b_upper of `PoseStrips.cell_bounds`."""
    return linear[3].astype(np.float64) - linear[1]
