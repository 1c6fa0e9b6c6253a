"""Bounds of hierarchically sampled rays that follow every sample along its path (design.md, F16).

On a cell of poses the coarse pass tells where each sample may be: on a line in the pose, but for a short rest. The fine
field is bounded there and nowhere else, with the place in the rest as one more parameter of its polynomials.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ns_abstract.arithmetic.rounding import DIRECTION_ROUNDING, FOLLOWED_UP, LINE_ROUNDING, NONZERO, SAMPLE_ROUNDING
from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.methods.nerf.division import Division, RayCells, join_cells
from ns_abstract.methods.nerf.hsv import Range, shifted_bounds
from ns_abstract.methods.nerf.layer_polynomials import PostActivation, PreActivation
from ns_abstract.methods.nerf.occupancy import OccupancyGrid
from ns_abstract.methods.nerf.outputs import bounds_by_part, brightness, density, opacity
from ns_abstract.methods.nerf.ray_bundle import TAYLOR, RayBundle
from ns_abstract.methods.nerf.render import Sampling
from ns_abstract.methods.nerf.samples import composite, edge_bounds
from ns_abstract.methods.nerf.zonotope import FieldBounds

#: Parts of a cell, by axis and number of parameters: samples are told apart by them at no cost.
_INNER = {1: 16, 2: 4}
_INNER_MORE = 2


@dataclass(frozen=True)
class FollowTuning:
    """Preferences of what follows samples. None of them decides whether a bound holds."""

    #: Rays' cells that are worked on together, and samples of theirs between two looks at the light that is left.
    cells: int = 16
    block: int = 48
    #: Light that does not matter any more, and light from a sample whose colour does not, as shares of the tolerance.
    dark: float = 2.0**-4
    negligible: float = 2.0**-9
    #: Shares of first cells that were halved above and below which later ones begin narrower and wider, by these
    #: factors; fewer cells tell nothing.
    many_lost: float = 0.5
    narrower: float = 0.6
    few_lost: float = 0.15
    wider: float = 1.25
    few: int = 8
    #: What an open part of a cell may leave without an aim, in tolerances.
    enough: float = 2.0


_TUNING = FollowTuning()


@dataclass(frozen=True)
class SampleLines:
    """Linear bounds of sample midpoints on cells: ``|m - (middle + slope p)| <= rest`` for p in [-1, 1]^d.

    Attributes:
        middle, rest: [k, S].
        slope: [k, S, d].
    """

    middle: np.ndarray
    slope: np.ndarray
    rest: np.ndarray

    @staticmethod
    def around(low: np.ndarray, high: np.ndarray, counts: tuple[int, ...], straight: bool, far: float) -> SampleLines:
        """Lines through the bounds [k, parts, S] of places on equal parts of cells, ``counts`` of them by axis.

        ``straight``: without slopes. ``far``: the largest distance.
        """
        d = len(counts)
        places = np.array(list(np.ndindex(*counts)), np.float64).reshape(low.shape[1], d)
        middles = (2.0 * places + 1.0) / np.array(counts) - 1.0
        slope = np.zeros((low.shape[0], low.shape[2], d))
        if d and not straight:
            size = np.square(middles).sum(axis=0)
            slope = np.einsum("pj,kps->ksj", middles / np.maximum(size, NONZERO), 0.5 * (low + high))
        # a part's places may be those of any of its poses
        room = (np.abs(slope) / np.array(counts)).sum(axis=2)
        along = np.einsum("pj,ksj->kps", middles, slope)
        least, most = (low - along).min(axis=1) - room, (high - along).max(axis=1) + room
        rest = 0.5 * (most - least)
        return SampleLines(0.5 * (least + most), slope, rest * FOLLOWED_UP + LINE_ROUNDING * far)


class SamplePaths:
    """Bounds of a scene's rays by following their samples.

    The ``coarse`` pass' field is by pose, the ``fine`` one by pose and one more parameter; the ``sampling`` is
    hierarchical; ``occupancy`` tells where density is declared 0.
    """

    def __init__(
        self, coarse: FieldBounds, fine: FieldBounds, sampling: Sampling, occupancy: OccupancyGrid | None, batch: int
    ) -> None:
        self.coarse, self.fine, self.sampling, self.occupancy, self.batch = coarse, fine, sampling, occupancy, batch

    @cached_property
    def degree(self) -> int:
        """Of the Taylor models of poses: along a line in the pose a point has one more."""
        return max(1, min(TAYLOR, self.fine.basis.degree - 1))

    @property
    def straight(self) -> bool:
        """Whether the polynomials do not hold a sample that moves along a line."""
        return self.degree >= self.fine.basis.degree

    def edges(
        self, origin: np.ndarray, direction: np.ndarray, radii: tuple[np.ndarray, np.ndarray], counts: tuple[int, ...]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Bounds [k, parts, S + 1] of the fine samples' edges by parts of cells (design.md, F14).

        Args:
            origin, direction: [k, nodes, 3] of rays at the nodes of the coarse field's polynomials.
            radii: [3] and [k, 3], what they are off by.
            counts: Parts of every cell by axis.
        """
        field, parts, (distances, lengths) = self.coarse, math.prod(counts), self.sampling.bins
        samples, bernstein = distances.size, field.bernstein(counts)
        low, high = np.zeros((len(origin), samples, parts)), np.ones((len(origin), samples, parts))
        cell, place = (a.ravel() for a in np.mgrid[: len(origin), :samples])
        for first in range(0, cell.size, self.batch):
            check_cancelled()
            k, i = cell[first : first + self.batch], place[first : first + self.batch]
            there = distances[i]
            nodes = origin[k] + there[:, None, None] * direction[k]
            radius = radii[0] + there[:, None] * radii[1][k]
            visible, sure = self.look(field, nodes, radius)
            high[k[~visible], i[~visible]] = 0.0
            k, i, nodes, radius, sure = k[visible], i[visible], nodes[visible], radius[visible], sure[visible]
            if not k.size:
                continue
            z = self.base(field, nodes, radius)[1]
            ends = bounds_by_part(z, bernstein)
            length = torch.from_numpy(lengths[i]).to(field.device)[:, None]
            least, most = (opacity(ends[up][..., 0], length, up=bool(up)).cpu().numpy() for up in (0, 1))
            good = ~z.failed.cpu().numpy()[:, None] & (least <= most)
            low[k, i] = np.where(good & sure[:, None], least, 0.0)
            high[k, i] = np.where(good, most, 1.0)
        low, high = (np.moveaxis(a, 1, 2).reshape(-1, samples) for a in (low, high))
        least, most = edge_bounds(low, high, self.sampling)
        return least.reshape(len(origin), parts, -1), most.reshape(len(origin), parts, -1)

    @staticmethod
    def base(field: FieldBounds, nodes: np.ndarray, radius: np.ndarray) -> tuple[PostActivation, PreActivation]:
        """`FieldBounds.base` of points [k, nodes, 3]."""
        there, around = (torch.from_numpy(a).to(field.device) for a in (nodes, radius))
        return field.base(*field.encode(there, around, field.position))

    def look(self, field: FieldBounds, nodes: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[k] whether some of the points may, and whether all must, lie where density is not declared 0 (F11)."""
        if self.occupancy is None:
            return np.ones(len(nodes), bool), np.ones(len(nodes), bool)
        rows, rest = field.basis.interpolation
        poly = rows @ nodes
        spread = np.abs(poly[:, 1:]).sum(axis=1) + np.abs(rest @ nodes).sum(axis=1) + radius
        spread = spread + field.basis.interpolation_rounding * (np.abs(poly[:, 0]) + spread)
        empty, sure = self.occupancy.look(poly[:, 0] - spread, poly[:, 0] + spread)
        return ~empty, sure


class _Level(NamedTuple):
    """The cells of one level of a `Division`.

    Attributes:
        boxes: [cells, d] lower and upper ends in [-1, 1].
        members: [cells, kept parts of a cell] flat numbers of the parts that are kept.
        counts: Parts by axis that a cell is bounded by.
        part: [kept parts of a cell] the one of ``counts`` that each lies in.
    """

    boxes: tuple[np.ndarray, np.ndarray]
    members: np.ndarray
    counts: tuple[int, ...]
    part: np.ndarray

    @staticmethod
    def of(division: Division, level: int) -> _Level:
        """See `_Level`."""
        inner, most = division.inner(level), _INNER.get(division.dimensions, _INNER_MORE)
        counts = tuple(max(k for k in range(1, most + 1) if n % k == 0) for n in inner)
        part = np.arange(math.prod(counts)).reshape(counts)
        for axis, (n, k) in enumerate(zip(inner, counts, strict=True)):
            part = part.repeat(n // k, axis=axis)
        return _Level(division.boxes(level), division.members(level), counts, part.ravel())


class BundleBounds:
    """The bounds of one bundle of rays, cell after cell, halved where they are too wide.

    Args:
        bundle: The rays over a box of poses; not swept.
        division: Cells of the box, and the parts that are kept.
        start: [n] the level of each ray's first cells.
        aim: [n, 3] lower and upper colours; bounds between them are good enough (before the shifts).
        shifts: Intervals of hue and saturation that are added to all colours.
    """

    def __init__(
        self, owner: SamplePaths, bundle: RayBundle, division: Division, start: np.ndarray, tolerance: float,
        aim: tuple[np.ndarray, np.ndarray] | None, shifts: list[tuple[Range, Range]],
    ) -> None:  # fmt: skip
        self.owner, self.bundle, self.division, self.tolerance, self.aim = owner, bundle, division, tolerance, aim
        self.start, self.shifts = start, shifts
        self._radii = bundle.rounded
        rows = len(start), math.prod(division.parts), max(1, len(shifts)), 3
        #: Bounds [n, parts, shifts, 3].
        self.lower, self.upper = np.zeros(rows), np.ones(rows)
        #: First cells, those of them that were too wide, and cells in all.
        self.tried = self.lost = self.cells = 0
        self._levels: dict[int, _Level] = {}

    def run(self) -> None:
        """Bound all rays."""
        waiting = {int(k): [self._first(int(k))] for k in np.unique(self.start)}
        for level in range(self.division.levels + 1):
            if level not in waiting:
                continue
            cells = join_cells(waiting.pop(level))
            below, again = self.division.below[level], []
            for chunk in cells.chunks(_TUNING.cells):
                again.append(chunk.take(self._bound(level, chunk)))
            if below < 0:
                continue
            for chunk in again:
                halves = RayCells(np.tile(chunk.ray, 2), self.division.children(level, chunk.cell))
                waiting.setdefault(below, []).append(halves)

    def _first(self, level: int) -> RayCells:
        rays = np.flatnonzero(self.start == level)
        cells = math.prod(self.division.counts(level))
        return RayCells(np.repeat(rays, cells), np.tile(np.arange(cells), rays.size))

    def samples(self, level: int, cells: RayCells) -> FollowedSamples:
        """What the samples of cells of one level are."""
        owner, radii = self.owner, (self._radii[0], self._radii[1][cells.ray])
        counts = self._level(level).counts
        low, high = owner.edges(*self._at(owner.coarse, level, cells), radii, counts)
        return FollowedSamples(owner, self._at(owner.fine, level, cells), radii, low, high, counts, self.tolerance)

    def _level(self, level: int) -> _Level:
        if level not in self._levels:
            self._levels[level] = _Level.of(self.division, level)
        return self._levels[level]

    def _at(self, field: FieldBounds, level: int, cells: RayCells) -> tuple[np.ndarray, np.ndarray]:
        """Origins and directions [k, nodes, 3] of ``cells`` at a field's nodes."""
        d = self.division.dimensions
        low, high = (ends[cells.cell] for ends in self._level(level).boxes)
        places = 0.5 * (low + high)[:, None] + 0.5 * (high - low)[:, None] * field.basis.nodes[:, :d]
        monomials = np.prod(places[:, :, None, :] ** self.bundle.exponents, axis=-1)
        return monomials @ self.bundle.origin, monomials @ self.bundle.direction[cells.ray]

    def _bound(self, level: int, cells: RayCells) -> NDArray[np.bool_]:
        """Bound cells of one level; [k] whether they are too wide."""
        check_cancelled()
        self.cells += len(cells)
        samples, there = self.samples(level, cells), self._level(level)
        plain = samples.composite(None)
        composites = [samples.composite(shift) for shift in self.shifts] or [plain]
        rows = cells.ray[:, None], there.members[cells.cell]
        self.lower[rows] = np.maximum(self.lower[rows], np.stack([low for low, _ in composites], axis=2)[:, there.part])
        self.upper[rows] = np.minimum(
            self.upper[rows], np.stack([high for _, high in composites], axis=2)[:, there.part]
        )
        low, high = plain
        if self.aim is None:
            wide = np.any((high - low) > _TUNING.enough * self.tolerance, axis=(1, 2))
        else:
            least, most = (end[cells.ray, None] for end in self.aim)
            wide = np.any((high > most) | (low < least), axis=(1, 2))
        first = self.start[cells.ray] == level
        self.tried += int(first.sum())
        self.lost += int((first & wide).sum())
        return wide

    @property
    def factor(self) -> float:
        """How much wider first cells had better be: a cell that is halved costs three, two narrow ones two."""
        if self.tried < _TUNING.few:
            return 1.0
        share = self.lost / self.tried
        return _TUNING.narrower if share > _TUNING.many_lost else _TUNING.wider if share < _TUNING.few_lost else 1.0


class FollowedSamples:
    """Bounds of the samples of several cells: densities and colours by part.

    ``rays``: origins and directions [k, nodes, 3] at the fine field's nodes, off by ``radii``; ``low``, ``high`` [k,
    parts, S + 1]: the samples' edges; ``counts``: parts by axis.
    """

    def __init__(
        self, owner: SamplePaths, rays: tuple[np.ndarray, np.ndarray], radii: tuple[np.ndarray, np.ndarray],
        low: np.ndarray, high: np.ndarray, counts: tuple[int, ...], tolerance: float,
    ) -> None:  # fmt: skip
        self.owner, self.rays, self.radii, self.low, self.high = owner, rays, radii, low, high
        least, most = (0.5 * (side[..., 1:] + side[..., :-1]) for side in (low, high))
        self.lines = SampleLines.around(least, most, counts, owner.straight, owner.sampling.far)
        k, parts, samples = low.shape[0], low.shape[1], low.shape[2] - 1
        self.bernstein = owner.fine.bernstein((*counts, 1))
        self.negligible = _TUNING.negligible * tolerance
        self.density = np.zeros((2, k, parts, samples))
        self.density[1] = np.inf
        self.color = np.zeros((2, k, parts, samples, 3))
        self.color[1] = 1.0
        # bounds of light that samples of which the colours do not count add
        self.price = np.zeros((k, parts))
        light = np.ones((k, parts))
        for start in range(0, samples, _TUNING.block):
            block = slice(start, min(samples, start + _TUNING.block))
            bright = np.flatnonzero(light.max(axis=1) > _TUNING.dark * tolerance)
            if not bright.size:
                break
            self._block(block, bright, light)
            length = np.maximum(self.low[..., 1:] - self.high[..., :-1], 0.0)[..., block]
            light *= np.exp(-(length * self.density[0][..., block]).sum(axis=-1)) * FOLLOWED_UP

    def _block(self, block: slice, bright: np.ndarray, light: np.ndarray) -> None:
        """The samples ``block`` of the cells ``bright``, which ``light`` [k, parts] reaches at most."""
        cell, sample = (a.ravel() for a in np.meshgrid(bright, np.arange(block.start, block.stop), indexing="ij"))
        batch = self.owner.batch
        for first in range(0, cell.size, batch):
            check_cancelled()
            self._batch(cell[first : first + batch], sample[first : first + batch], light)

    def _batch(self, k: np.ndarray, i: np.ndarray, light: np.ndarray) -> None:
        """Sample ``i`` of cell ``k``, [b] each."""
        owner, field, lines = self.owner, self.owner.fine, self.lines
        (origin, direction), d = self.rays, lines.slope.shape[2]
        there = (
            lines.middle[k, i][:, None]
            + lines.slope[k, i] @ field.basis.nodes[:, :d].T
            + lines.rest[k, i][:, None] * field.basis.nodes[:, d]
        )
        nodes = origin[k] + there[..., None] * direction[k]
        far = np.abs(lines.middle[k, i]) + np.abs(lines.slope[k, i]).sum(axis=1) + lines.rest[k, i]
        radius = self.radii[0] + far[:, None] * self.radii[1][k]
        field_values, sure = owner.look(field, nodes, radius)
        gone = k[~field_values], slice(None), i[~field_values]
        self.density[1][gone], self.color[0][gone], self.color[1][gone] = 0.0, np.inf, -np.inf
        k, i, nodes, radius, sure = (
            k[field_values],
            i[field_values],
            nodes[field_values],
            radius[field_values],
            sure[field_values],
        )
        if not k.size:
            return
        pieces, z = owner.base(field, nodes, radius)
        low, high, _ = bounds_by_part(z, self.bernstein)
        least, most = density(low[..., 0], up=False).cpu().numpy(), density(high[..., 0], up=True).cpu().numpy()
        good = ~z.failed.cpu().numpy()[:, None] & (least <= most)
        least, most = np.where(good & sure[:, None], least, 0.0), np.where(good, most, np.inf)
        self.density[0][k, :, i], self.density[1][k, :, i] = least, most
        length = np.maximum(self.high[k, :, i + 1] - self.low[k, :, i], 0.0)
        with np.errstate(invalid="ignore"):
            weight = light[k] * -np.expm1(-np.nan_to_num(length * most, nan=0.0)) * FOLLOWED_UP
        dim = weight <= self.negligible
        np.add.at(self.price, k, np.where(dim, weight, 0.0))
        self.color[0][k, :, i] = np.where(dim[..., None], np.inf, 0.0)
        self.color[1][k, :, i] = np.where(dim[..., None], -np.inf, 1.0)
        visible = np.flatnonzero(~dim.all(axis=1) & good.all(axis=1))
        if not visible.size:
            return
        k, i, dim = k[visible], i[visible], dim[visible][..., None]
        around = torch.from_numpy(self.radii[1][k] + DIRECTION_ROUNDING).to(field.device)
        encoded = field.encode(torch.from_numpy(direction[k]).to(field.device), around, field.direction)
        which = torch.from_numpy(visible).to(field.device)
        low, high, _ = brightness(field.color(pieces.select(which), *encoded), self.bernstein)
        low, high = low.cpu().numpy(), high.cpu().numpy()
        good = (low <= high) & ~dim
        self.color[0][k, :, i] = np.where(good, low, self.color[0][k, :, i])
        self.color[1][k, :, i] = np.where(good, high, self.color[1][k, :, i])

    def composite(self, shift: tuple[Range, Range] | None) -> tuple[np.ndarray, np.ndarray]:
        """[k, parts, 3] bounds of what the rays show, after a ``shift`` of colours."""
        color = self.color
        if shift is not None:
            color = color.copy()
            nonempty = color[0, ..., 0] <= color[1, ..., 0]
            color[0][nonempty], color[1][nonempty] = shifted_bounds(color[0][nonempty], color[1][nonempty], *shift)
        k, parts, count = self.low.shape
        rows = k * parts
        low = np.tile(np.array(self.owner.sampling.background, np.float64), (rows, 1))
        high = low.copy()
        composite(
            self.low.reshape(rows, count), self.high.reshape(rows, count), self.density.reshape(2, rows, count - 1),
            color.reshape(2, rows, count - 1, 3), low, high,
        )  # fmt: skip
        slack = SAMPLE_ROUNDING * (2 * count + 5) + self.price.reshape(rows, 1) * FOLLOWED_UP
        low, high = np.clip(low - slack, 0.0, 1.0), np.clip(high + slack, 0.0, 1.0)
        # what is not a number says nothing
        low, high = np.where(low <= high, low, 0.0), np.where(low <= high, high, 1.0)
        return low.reshape(k, parts, 3), high.reshape(k, parts, 3)
