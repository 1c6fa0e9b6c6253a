"""Bounds of hierarchically sampled rays from the path of every sample over a cell of poses (design.md, F16).

The coarse pass bounds each sample's distance by a linear function of the pose and a short radius. The fine field is
bounded there and nowhere else; the place within the radius is one more parameter of its polynomials.
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

#: Parts of a cell along each axis, by number of parameters, for which samples are bounded at little cost.
_INNER = {1: 16, 2: 4}
_INNER_MORE = 2


@dataclass(frozen=True)
class FollowTuning:
    """Preferences of bounds by sample paths. None of them decides whether a bound holds."""

    #: Cells of rays that are bounded together, and samples between two updates of the transmittance.
    cells: int = 16
    block: int = 48
    #: Transmittance below which samples, and weight below which colours are not bounded, as shares of the tolerance.
    dark: float = 2.0**-4
    negligible: float = 2.0**-9
    #: Shares of first cells that were halved above and below which later first cells become narrower and wider, by
    #: these factors; and the least number of cells to decide that.
    many_lost: float = 0.5
    narrower: float = 0.6
    few_lost: float = 0.15
    wider: float = 1.25
    few: int = 8
    #: Width of a part's bounds, in tolerances, above which a cell is halved if there is no aim.
    enough: float = 2.0


_TUNING = FollowTuning()


@dataclass(frozen=True)
class SampleLines:
    """Linear bounds of sample midpoints on cells: ``|m - (middle + slope p)| <= rest`` for p in [-1, 1]^d.

    Attributes:
        middle, rest: [k, S] distances at the cell's middle, and radii.
        slope: [k, S, d] change of distance over half of each parameter's range.
    """

    middle: np.ndarray
    slope: np.ndarray
    rest: np.ndarray

    @staticmethod
    def around(low: np.ndarray, high: np.ndarray, counts: tuple[int, ...], straight: bool, far: float) -> SampleLines:
        """Return lines that enclose the bounds ``low``, ``high`` [k, parts, S] of midpoints on equal parts of k cells.

        ``counts`` are the parts by axis. ``straight``: slopes are 0. ``far``: the largest distance, for rounding.
        """
        d = len(counts)
        places = np.array(list(np.ndindex(*counts)), np.float64).reshape(low.shape[1], d)
        middles = (2.0 * places + 1.0) / np.array(counts) - 1.0
        slope = np.zeros((low.shape[0], low.shape[2], d))
        if d and not straight:
            size = np.square(middles).sum(axis=0)
            slope = np.einsum("pj,kps->ksj", middles / np.maximum(size, NONZERO), 0.5 * (low + high))
        # within a part, a bound may belong to any pose
        room = (np.abs(slope) / np.array(counts)).sum(axis=2)
        along = np.einsum("pj,ksj->kps", middles, slope)
        least, most = (low - along).min(axis=1) - room, (high - along).max(axis=1) + room
        rest = 0.5 * (most - least)
        return SampleLines(0.5 * (least + most), slope, rest * FOLLOWED_UP + LINE_ROUNDING * far)


class SamplePaths:
    """Bounds of a scene's fields for sample paths, shared by all bundles of rays.

    ``coarse`` bounds the coarse field over poses, ``fine`` the fine one over poses and the place within a path's
    radius. ``sampling`` is hierarchical; ``batch`` is the number of samples that are bounded together.
    """

    def __init__(
        self, coarse: FieldBounds, fine: FieldBounds, sampling: Sampling, occupancy: OccupancyGrid | None, batch: int
    ) -> None:
        self.coarse, self.fine, self.sampling, self.occupancy, self.batch = coarse, fine, sampling, occupancy, batch

    @cached_property
    def degree(self) -> int:
        """Degree of the Taylor models of poses; a point at a distance linear in the pose has one more."""
        return max(1, min(TAYLOR, self.fine.basis.degree - 1))

    @property
    def straight(self) -> bool:
        """Whether the fine field's degree is too low for distances with a slope, which are then 0."""
        return self.degree >= self.fine.basis.degree

    def edges(
        self, origin: np.ndarray, direction: np.ndarray, radii: tuple[np.ndarray, np.ndarray], counts: tuple[int, ...]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds [k, parts, S + 1] of the fine samples' edges, as distances, by part of k cells (F14).

        Args:
            origin, direction: [k, nodes, 3] of rays at the nodes of the coarse field's polynomials.
            radii: [3] and [k, 3] error bounds of these.
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
        """Return `FieldBounds.base` of points ``nodes`` [k, nodes, 3] with error bounds ``radius`` [k, 3]."""
        there, around = (torch.from_numpy(a).to(field.device) for a in (nodes, radius))
        return field.base(*field.encode(there, around, field.position))

    def look(self, field: FieldBounds, nodes: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return [k] whether points of a piece may, and [k] whether all of them must, lie in occupied voxels (F11).

        ``nodes`` [k, nodes, 3] are the points at the nodes of ``field``'s basis, ``radius`` [k, 3] their error bounds.
        """
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
        members: [cells, stored parts of a cell] flat numbers of the parts whose bounds are stored.
        counts: Computed parts of a cell by axis, for which bounds are computed.
        part: [stored parts of a cell] the computed part that holds each stored one.
    """

    boxes: tuple[np.ndarray, np.ndarray]
    members: np.ndarray
    counts: tuple[int, ...]
    part: np.ndarray

    @staticmethod
    def of(division: Division, level: int) -> _Level:
        """Return the cells of ``level`` of a ``division``."""
        inner, most = division.inner(level), _INNER.get(division.dimensions, _INNER_MORE)
        counts = tuple(max(k for k in range(1, most + 1) if n % k == 0) for n in inner)
        part = np.arange(math.prod(counts)).reshape(counts)
        for axis, (n, k) in enumerate(zip(inner, counts, strict=True)):
            part = part.repeat(n // k, axis=axis)
        return _Level(division.boxes(level), division.members(level), counts, part.ravel())


class BundleBounds:
    """Bounds of one bundle of n rays, cell after cell; cells whose colours are too wide are halved.

    Args:
        bundle: The rays over a box of poses; not swept.
        division: Cells of the box, and the parts whose bounds are stored.
        start: [n] the level of each ray's first cells.
        tolerance: Width of colours that is aimed at.
        aim: [n, 3] lower and upper colours; bounds between them are not refined (before the shifts).
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
        """Fill in `lower` and `upper` of all rays, level by level."""
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
        """Return bounds of all samples of the given ``cells`` of one level."""
        owner, radii = self.owner, (self._radii[0], self._radii[1][cells.ray])
        counts = self._level(level).counts
        low, high = owner.edges(*self._at(owner.coarse, level, cells), radii, counts)
        return FollowedSamples(owner, self._at(owner.fine, level, cells), radii, low, high, counts, self.tolerance)

    def _level(self, level: int) -> _Level:
        if level not in self._levels:
            self._levels[level] = _Level.of(self.division, level)
        return self._levels[level]

    def _at(self, field: FieldBounds, level: int, cells: RayCells) -> tuple[np.ndarray, np.ndarray]:
        """Return origins and directions [k, nodes, 3] of ``cells`` at a field's nodes."""
        d = self.division.dimensions
        low, high = (ends[cells.cell] for ends in self._level(level).boxes)
        places = 0.5 * (low + high)[:, None] + 0.5 * (high - low)[:, None] * field.basis.nodes[:, :d]
        monomials = np.prod(places[:, :, None, :] ** self.bundle.exponents, axis=-1)
        return monomials @ self.bundle.origin, monomials @ self.bundle.direction[cells.ray]

    def _bound(self, level: int, cells: RayCells) -> NDArray[np.bool_]:
        """Intersect bounds with those of ``cells`` of one level; return [k] whether their colours are too wide."""
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
        """Factor of the width of later first cells: halving a cell costs three cells, two narrower ones cost two."""
        if self.tried < _TUNING.few:
            return 1.0
        share = self.lost / self.tried
        return _TUNING.narrower if share > _TUNING.many_lost else _TUNING.wider if share < _TUNING.few_lost else 1.0


class FollowedSamples:
    """Bounds of densities and colours of the S fine samples on k cells of rays, by part of the cells.

    ``rays``: origins and directions [k, nodes, 3] at the fine field's nodes, with error bounds ``radii``; ``low``,
    ``high`` [k, parts, S + 1] bound the samples' edges; ``counts``: parts by axis.
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
        # total weight of the samples whose colours are left out
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
        """Bound the samples ``block`` of the cells numbered ``bright``; ``light`` [k, parts]: transmittance before."""
        cell, sample = (a.ravel() for a in np.meshgrid(bright, np.arange(block.start, block.stop), indexing="ij"))
        batch = self.owner.batch
        for first in range(0, cell.size, batch):
            check_cancelled()
            self._batch(cell[first : first + batch], sample[first : first + batch], light)

    def _batch(self, k: np.ndarray, i: np.ndarray, light: np.ndarray) -> None:
        """Bound density and colour of the samples ``i`` [b] of the cells ``k`` [b]; ``light``: see `_block`."""
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
        """Lower and upper bounds [k, parts, 3] of the rays' colours, after a ``shift`` of all samples' colours."""
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
        # NaN becomes [0, 1]
        low, high = np.where(low <= high, low, 0.0), np.where(low <= high, high, 1.0)
        return low.reshape(k, parts, 3), high.reshape(k, parts, 3)
