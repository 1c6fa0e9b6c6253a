"""Bounds of a bundle of rays by cells of every sample: densities, colours, compositing (design.md, F6-F8, F10, F14).

Every sample of a ray gets cells of its own width: where the field is rough over the sample's path, the box is cut
finer. The polynomials that come out of the network are then cut into parts at no cost, and compositing is done
part by part, where it is exact for independent samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ns_abstract.arithmetic.outward import outward
from ns_abstract.arithmetic.rounding import DENSITY_ROUNDING, DIRECTION_ROUNDING, KEPT_LIGHT_UP, SAMPLE_ROUNDING
from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.methods.nerf.division import Division, RayCells, join_cells
from ns_abstract.methods.nerf.hsv import shifted_bounds
from ns_abstract.methods.nerf.layer_polynomials import PostActivation, PreActivation
from ns_abstract.methods.nerf.outputs import bounds_by_part, brightness, greatest, opacity
from ns_abstract.methods.nerf.ray_bundle import RayBundle
from ns_abstract.methods.nerf.ray_field import RAY_TUNING, RayBounds, RayField, RayRequest, Shifts
from ns_abstract.methods.nerf.samples import composite, field_hulls
from ns_abstract.methods.nerf.white import WhiteSamples

#: Samples of a ray that are bounded between two updates of the transmittance.
_BLOCK = 8
#: Width of an opacity's bounds, by the network's error alone, from which on a whole cell counts as lost (too wide).
_LOST = 0.5
#: Shares of first cells that were lost, and factors of the width of later first cells: the first share that is
#: exceeded counts.
_LOST_SHARES = ((0.25, 0.6), (0.04, 0.87))
#: Share of lost cells below which later first cells are wider, and the factor of their width.
_FEW_LOST, _WIDER = 0.01, 1.08
#: A sample's cell is halved if this may remove at least this share of a part's excess width.
_SHARE = 0.125
#: Most rounds of halving where the colours' bounds are too wide.
_ROUNDS = 32
#: Factor of the tolerance for bins, whose bounds are loose anyhow.
_SWEPT = 8.0


class SampleCellBounds:
    """Bounds a bundle of n rays by cells of every sample; see `BoundedRays.rays`.

    Arrays by sample, ray and part of the box are [samples, n, parts].
    """

    def __init__(
        self,
        owner: RayField,
        bundle: RayBundle,
        division: Division,
        moves: np.ndarray,
        request: RayRequest,
        displacement: float,
        edges: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        self.edges, alphas = edges, request.most_alpha
        self.owner, self.bundle, self.division = owner, bundle, division
        self.tolerance, self.aim = request.tolerance * (_SWEPT if owner.swept else 1.0), request.aim
        self.basis, self.field = owner.basis, owner.field
        n, samples = moves.shape[:2]
        parts = math.prod(division.parts)
        self.alpha_low, self.alpha_high = np.zeros((samples, n, parts)), np.ones((samples, n, parts))
        self.color_low, self.color_high = np.zeros((samples, n, parts, 3)), np.ones((samples, n, parts, 3))
        # widths of opacities (open) and colours (vague) by the network's error alone; level of the cells they are from
        self.open, self.vague = (np.ones((samples, n, parts), np.float32) for _ in range(2))
        self.level = np.full((samples, n, parts), -1, np.int8)
        # upper bounds of the transmittance before each sample, and behind all samples so far
        self.before, self.light = np.ones((samples, n, parts), np.float32), np.ones((n, parts))
        self.cells, self.displacement = 0, displacement
        # first cells of samples, those of them that were lost, and whether some sample has several first cells
        self.tried, self.lost, self.wide = 0, 0, False
        # the first level whose cells are narrow enough for the sample
        self.start = division.first(moves, displacement)
        self.quiet = np.zeros((n, samples), bool)
        if alphas is not None:
            self.quiet = alphas <= RAY_TUNING.quiet * self.tolerance
            for i, k in np.argwhere(self.quiet):
                self.alpha_high[k, i] = alphas[i, k]
        self._levels: dict[int, tuple[Tensor, Tensor, np.ndarray]] = {}

    def run(self, shifts: list[Shifts], by_part: bool = False) -> RayBounds:
        """Bound block after block of samples, nearest first, then halve cells where colours are too wide.

        ``by_part``: keep the bounds of every part.
        """
        samples = self.owner.distances.size
        for first in range(0, samples, _BLOCK):
            block = np.arange(first, min(samples, first + _BLOCK))
            if not (self.light > self._dark).any():
                break
            self.before[block] = self.light
            self._bound_block(block)
            self.light *= np.prod(1.0 - self._anywhere(self.alpha_low[block], np.minimum), axis=0)
        self._learn()
        self._improve()
        color, bounded = (self.color_low, self.color_high), []
        for shift in shifts:
            check_cancelled()
            self.color_low, self.color_high = self._shifted(color, shift)
            bounded.append(self._composite())
        low, high = (np.stack(ends, axis=1) for ends in zip(*(bounded or [self._composite()]), strict=True))
        alpha = self.alpha_high.max(axis=2).T.astype(np.float32)
        return RayBounds(
            low.min(axis=(1, 2)), high.max(axis=(1, 2)), np.nextafter(alpha, np.float32(2.0)), self.cells,
            self.displacement,
            np.stack(outward(self._poses(low, np.min), self._poses(high, np.max))) if by_part else None,
        )  # fmt: skip

    def _poses(self, values: np.ndarray, end: Callable[..., np.ndarray]) -> np.ndarray:
        """Reshape bounds ``values`` [n, shifts, parts, 3] to [n, shifts, *parts, 3]; ``end`` unites parts of bins."""
        apart = values.reshape(*values.shape[:2], *self.division.parts, 3)
        return end(apart, axis=-2) if self.owner.swept else apart

    @property
    def _dark(self) -> float:
        """Transmittance up to which further samples are not bounded."""
        return 0.1 * self.tolerance

    @property
    def _negligible(self) -> float:
        """Weight of a sample up to which its colour is not bounded."""
        return (0.1 if self.owner.swept else 0.5) * self.tolerance

    def _level(self, level: int) -> tuple[Tensor, Tensor, np.ndarray]:
        """Return monomials at all nodes [cells, nodes, M], a Bernstein matrix [parts, b, m], `Division.members`."""
        if level not in self._levels:
            low, high = self.division.boxes(level)
            nodes = 0.5 * (low + high)[:, None] + 0.5 * (high - low)[:, None] * self.basis.nodes
            monomials = np.prod(nodes[:, :, None, :] ** self.bundle.exponents, axis=-1)
            self._levels[level] = (
                torch.from_numpy(monomials).to(self.owner.device),
                self.field.bernstein(self.division.inner(level)),
                self.division.members(level),
            )
        return self._levels[level]

    def _rows(self, level: int, items: RayCells) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return index arrays (sample, ray, part) of the parts [k, parts of a cell] in the cells ``items``."""
        return items.sample[:, None], items.ray[:, None], self._level(level)[2][items.cell]

    def _bound_block(self, block: np.ndarray) -> None:
        """Bound the samples numbered ``block`` of all rays, halving cells whose weights are too wide."""
        waiting: dict[int, list[RayCells]] = {}
        for level in range(self.division.levels + 1):
            ray, place = np.nonzero((self.start[:, block] == level) & ~self.quiet[:, block])
            if not ray.size:
                continue
            members = self._level(level)[2]
            bright = self.light[:, members].max(axis=2) > self._dark  # [n, cells]
            item, cell = np.nonzero(bright[ray])
            if not item.size:
                continue
            waiting[level] = [RayCells(ray[item], cell, block[place[item]])]
        self.wide |= any(level > 0 for level in waiting)
        for level in range(self.division.levels + 1):
            if level not in waiting:
                continue
            items = join_cells(waiting.pop(level))
            again = []
            for start in range(0, len(items), self.owner.batch):
                batch = items.take(slice(start, start + self.owner.batch))
                halve, lost, visible = self._bound_batch(level, batch, RAY_TUNING.coarse)
                again.append(batch.take(halve))
                first = self.start[batch.ray, batch.sample] == level
                self.lost += int((lost & first).sum())
                self.tried += int((visible & first).sum())
            coarse = join_cells(again)
            below = self.division.below[level]
            if below < 0 or not len(coarse):
                continue
            children = self.division.children(level, coarse.cell)
            finer = RayCells(np.tile(coarse.ray, 2), children, np.tile(coarse.sample, 2))
            waiting.setdefault(below, []).append(finer)

    def _learn(self) -> None:
        """Update the width of later rays' first cells: narrower if many cells were lost, wider if few were."""
        if self.tried < 32:
            return
        for share, narrower in _LOST_SHARES:
            if self.lost > share * self.tried:
                self.displacement *= narrower
                return
        # cells that the box itself makes narrow do not show what wider ones would bear
        if self.wide and self.lost < _FEW_LOST * self.tried:
            self.displacement *= _WIDER

    def _improve(self) -> None:
        """Halve, in rounds, the cells of samples that widen the colours most, on parts whose bounds miss the aim."""
        rays = np.arange(self.light.shape[0])
        below = np.array([*self.division.below, -1])
        for _ in range(_ROUNDS):
            low, high, impact = self._impact(rays)
            # cells of level -1 were never bounded
            able = below[self.level[:, rays]] >= 0
            threshold = np.full(impact.shape[1:], self.tolerance)
            if self.aim is not None:
                excess = np.maximum(high - self.aim[1][rays, None], self.aim[0][rays, None] - low).max(axis=2)
                able &= excess > 0.0
                threshold = np.minimum(_SHARE * excess, np.where(able, impact, 0.0).max(axis=0))
                threshold = np.maximum(threshold, _SHARE * 0.5 * self.tolerance)
            sample, ray, part = np.nonzero(able & (impact >= threshold))
            if not sample.size:
                return
            ray = rays[ray]
            level = below[self.level[sample, ray, part]]
            for deeper in np.unique(level):
                which = level == deeper
                cell = self._cell_of(deeper)[part[which]]
                unique_cells = np.unique(np.stack([ray[which], sample[which], cell]), axis=1)
                for start in range(0, unique_cells.shape[1], self.owner.batch):
                    rays_here, samples, cells = unique_cells[:, start : start + self.owner.batch]
                    items = RayCells(rays_here, cells, samples)
                    self._bound_batch(int(deeper), items, math.inf)
            rays = np.unique(ray)

    def _cell_of(self, level: int) -> np.ndarray:
        """Return [parts] numbers of the cells of ``level`` in which the parts lie."""
        members = self._level(level)[2]
        return np.argsort(members, axis=None) // members.shape[1]

    def _impact(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lower and upper bounds [r, parts, 3] of ``rays``, and about how much each sample widens them.

        The latter is [samples, r, parts]: the widening by the network's error alone, which halving removes.
        """
        alpha_low, alpha_high = self._anywhere(self.alpha_low[:, rays], np.minimum), self.alpha_high[:, rays]
        top = self._anywhere(alpha_high, np.maximum)
        light = np.ones_like(alpha_low)
        np.cumprod(1.0 - alpha_low[:-1], axis=0, out=light[1:])
        self.before[:, rays] = light
        color_low, color_high, rest = self._mixtures(rays, True)
        span = np.empty_like(alpha_low)
        low, high = self._background(len(rays)), self._background(len(rays))
        for k in range(len(span) - 1, -1, -1):
            rise, fall = color_high[k] - high, color_low[k] - low
            span[k] = np.maximum(color_high[k] - low, high - color_low[k]).max(axis=-1)
            high += np.where(rise > 0.0, top[k][..., None], alpha_low[k][..., None]) * rise
            low += np.where(fall < 0.0, top[k][..., None], alpha_low[k][..., None]) * fall
        return low - rest, high + rest, light * (self.open[:, rays] * span + alpha_high * self.vague[:, rays])

    def _anywhere(self, values: np.ndarray, end: np.ufunc, axis: int = -1) -> np.ndarray:
        """Return ``values`` by part, or for bins their ``end`` (minimum, maximum) over all parts of the same bin.

        With hierarchical sampling the last axis of parts is the place in the bin, where a sample may be anywhere.
        """
        if not self.owner.swept:
            return values
        inner = self.division.parts[-1]
        axis %= values.ndim
        shape = (*values.shape[:axis], values.shape[axis] // inner, inner, *values.shape[axis + 1 :])
        return np.repeat(end.reduce(values.reshape(shape), axis=axis + 1), inner, axis=axis)

    def _mixtures(self, rays: np.ndarray | slice, apart: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray | float]:
        """Return bounds of the colours of samples or bins, and the radius that composited bounds are widened by (F10).

        ``apart``: parts of a bin of negligible weight widen the result instead of the bin's colour.
        """
        low, high = self.color_low[:, rays], self.color_high[:, rays]
        if not self.owner.swept:
            return low, high, 0.0
        weight = self.before[:, rays] * self.alpha_high[:, rays]
        dim = (weight <= self._negligible) & apart
        alone = self._anywhere(dim, np.logical_and)[..., None]
        low = self._anywhere(np.where(dim[..., None], np.inf, low), np.minimum, -2)
        high = self._anywhere(np.where(dim[..., None], -np.inf, high), np.maximum, -2)
        rest = self._anywhere(np.where(dim & ~alone[..., 0], weight, 0.0), np.maximum).sum(axis=0)
        # the light before a sample is kept in float32
        return np.where(alone, 0.0, low), np.where(alone, 1.0, high), (rest * KEPT_LIGHT_UP)[..., None]

    def _background(self, count: int) -> np.ndarray:
        """Return the background colour, repeated to [count, parts, 3]."""
        return np.tile(np.array(self.owner.sampling.background, np.float64), (count, self.light.shape[1], 1))

    def _bound_batch(self, level: int, items: RayCells, coarse: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Bound the cells ``items`` of one level; return three masks [k] of them.

        They are: a weight is wider than ``coarse``; the cell is lost (`_LOST`); the network was evaluated.
        """
        check_cancelled()
        halve, lost, tried = (np.zeros(len(items), bool) for _ in range(3))
        lines, radius = self.bundle.points(
            items.ray, self.owner.distances[items.sample], 0.5 * self.owner.lengths[items.sample]
        )
        which, sure = self._occupied(level, items, lines, radius)
        if which.size:
            items, lines, radius, sure = items.take(which), lines[which], radius[which], sure[which]
            halve[which], lost[which] = self._bound_field(level, items, lines, radius, sure, coarse)
            tried[which] = True
        return halve, lost, tried

    def _occupied(
        self, level: int, items: RayCells, lines: np.ndarray, radius: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return numbers of ``items`` that may meet occupied voxels, and [k] whether an item lies in these alone (F11).

        The other items' opacities are set to 0. ``lines``, ``radius``: see `RayBundle.points`.
        """
        everything = np.arange(len(items))
        if self.owner.occupancy is None:
            return everything, np.ones(len(items), bool)
        low, high = self.division.boxes(level)
        ends = self.bundle.ranges(lines, radius, low[items.cell], high[items.cell])
        empty, sure = self.owner.occupancy.look(*ends)
        gone = items.take(empty)
        if len(gone):
            rows = self._rows(level, gone)
            self.alpha_low[rows] = self.alpha_high[rows] = 0.0
            self.open[rows] = self.vague[rows] = 0.0
            self.level[rows] = self.division.levels
        return everything[~empty], sure

    def _bound_field(
        self, level: int, items: RayCells, lines: np.ndarray, radius: np.ndarray, sure: np.ndarray, coarse: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the first two masks of `_bound_batch`, for cells ``items`` of a level, by the network's bounds."""
        device, field = self.owner.device, self.field
        monomials, bernstein, _ = self._level(level)
        self.cells += len(items)
        there = monomials[torch.from_numpy(items.cell).to(device)]
        nodes = there @ torch.from_numpy(lines).to(device)
        encoded = field.encode(nodes, torch.from_numpy(radius).to(device), field.position)
        pieces, density = field.base(*encoded)
        halve, lost = np.zeros((2, len(items)), bool)
        differing = np.flatnonzero(~self._leave_alike(level, items, density))
        if not differing.size:
            return halve, lost
        items, sure, density = (
            items.take(differing),
            sure[differing],
            density.without_columns(torch.from_numpy(differing).to(device)),
        )
        low, high, error = bounds_by_part(density, bernstein)
        length = torch.from_numpy(self.owner.lengths[items.sample]).to(device)[:, None]
        alpha_low, alpha_high = opacity(low[..., 0], length, up=False), opacity(high[..., 0], length, up=True)
        bad = density.failed[:, None]
        alpha_low, alpha_high = torch.where(bad, 0.0, alpha_low), torch.where(bad, 1.0, alpha_high)
        # width by the network's error alone, without the colours' change over the cell
        middle = 0.5 * (low[..., 0] + high[..., 0])
        open_ = opacity(middle + error[:, :1], length, up=True) - opacity(middle - error[:, :1], length, up=False)
        open_ = torch.where(bad, 1.0, open_).cpu().numpy()
        low_a, high_a = alpha_low.cpu().numpy(), alpha_high.cpu().numpy()
        if not sure.all():
            low_a = np.where(sure[:, None], low_a, 0.0)
            open_ = np.where(sure[:, None], open_, high_a)
        rows = self._rows(level, items)
        light = self.before[rows]
        self._keep(self.alpha_low, self.alpha_high, rows, low_a, high_a)
        self.open[rows] = np.minimum(self.open[rows], open_)
        self.level[rows] = level
        halved = (open_ * light).max(axis=1) > coarse
        halve[differing], lost[differing] = halved, halved & (open_.min(axis=1) > _LOST)
        shines = (high_a * light).max(axis=1) > self._negligible
        # cells that will be halved get their colours from the halves
        final = ~halved | (self.division.below[level] < 0)
        coloured = np.flatnonzero(shines & final & ~density.failed.cpu().numpy())
        if coloured.size:
            which = torch.from_numpy(differing[coloured]).to(device)
            self._color(level, items.take(coloured), pieces.select(which), there[which])
        return halve, lost

    def _leave_alike(self, level: int, items: RayCells, density: PreActivation) -> np.ndarray:
        """Return [k] whether an item's opacity is negligible on its whole cell; then only its upper bound is stored."""
        length = torch.from_numpy(self.owner.lengths[items.sample]).to(density.poly.device)
        most = opacity(greatest(density)[:, 0], length, up=True)
        alike = ((most <= RAY_TUNING.alike * self.tolerance) & ~density.failed).cpu().numpy()
        gone, high = items.take(alike), most.cpu().numpy()[alike, None]
        rows = self._rows(level, gone)
        self.alpha_high[rows] = np.minimum(self.alpha_high[rows], high)
        self.open[rows] = np.minimum(self.open[rows], high)
        self.level[rows] = level
        return alike

    def _color(self, level: int, items: RayCells, pieces: PostActivation, there: Tensor) -> None:
        """Bound the colours of the cells ``items`` from their base outputs ``pieces``.

        ``there`` [k, nodes, M] are the monomials at the cells' nodes.
        """
        if self.owner.white is not None:
            self._bound_selected(self.owner.white, level, items)
            return
        device, field = self.owner.device, self.field
        bernstein = self._level(level)[1]
        direction = there @ torch.from_numpy(self.bundle.direction[items.ray]).to(device)
        radius = self.bundle.direction_radius[items.ray] + DIRECTION_ROUNDING
        encoded = field.encode(direction, torch.from_numpy(radius).to(device), field.direction)
        color = field.color(pieces, *encoded)
        low, high, error = brightness(color, bernstein)
        where = self._rows(level, items)
        self._keep(self.color_low, self.color_high, where, low.cpu().numpy(), high.cpu().numpy())
        slack = 2.0 * torch.tanh(0.25 * error.amax(dim=1))
        slack = torch.where(color.failed, 1.0, slack).cpu().numpy()
        self.vague[where] = np.minimum(self.vague[where], slack[:, None])

    def _bound_selected(self, white: WhiteSamples, level: int, items: RayCells) -> None:
        """Store bounds of the colours of cells ``items``, where selected samples are white and all others black (Q3).

        A ray's colour is then the blending weight of what is selected. ``level``: the level of division of the cells.
        """
        distance = self.owner.distances[items.sample]
        lines, radius = self.bundle.points(items.ray, distance, 0.5 * self.owner.lengths[items.sample])
        low, high = self.division.boxes(level)
        ends = self.bundle.ranges(lines, radius, low[items.cell], high[items.cell])
        least, most = white.between(*ends, distance)
        where = self._rows(level, items)
        self._keep(self.color_low, self.color_high, where, least[:, None], most[:, None])
        self.vague[where] = np.minimum(self.vague[where], (most - least).max(axis=1)[:, None])

    @staticmethod
    def _keep(lower: np.ndarray, upper: np.ndarray, rows: tuple, low: np.ndarray, high: np.ndarray) -> None:
        """Intersect ``lower`` and ``upper`` at ``rows`` with new bounds, but for new ones that are NaN or reversed."""
        old_low, old_high = lower[rows], upper[rows]
        good = (low <= high) & np.isfinite(low) & np.isfinite(high)
        low = np.where(good, np.maximum(low, old_low), old_low)
        high = np.where(good, np.minimum(high, old_high), old_high)
        crossed = ~(low <= high)
        lower[rows] = np.where(crossed, old_low, low)
        upper[rows] = np.where(crossed, old_high, high)

    def _shifted(self, color: tuple[np.ndarray, np.ndarray], shift: Shifts) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds of ``color`` after ``shift`` of hue and saturation; [0, 1] for negligible weights."""
        visible = self.before * self.alpha_high > RAY_TUNING.unseen
        low, high = np.zeros_like(color[0]), np.ones_like(color[1])
        low[visible], high[visible] = shifted_bounds(color[0][visible], color[1][visible], *shift)
        return low, high

    def _composite(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds [n, parts, 3] of the rays' colours by part, the best of all rules (design.md, F8)."""
        low, high = self._composited(False)
        if self.owner.swept:
            other_low, other_high = self._composited(True)
            low, high = np.maximum(low, other_low), np.minimum(high, other_high)
        if self.edges is not None:
            other_low, other_high = self._sampled(*self.edges)
            low, high = np.maximum(low, other_low), np.minimum(high, other_high)
        return low, high

    def _sampled(self, edges_low: np.ndarray, edges_high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds [n, parts, 3] of the rays' colours by part, from bounds of the fine samples' edges (F14)."""
        owner, inner = self.owner, self.division.parts[-1]
        rows, samples, n = len(edges_low), self.alpha_low.shape[0], self.alpha_low.shape[1]

        def along(values: np.ndarray) -> np.ndarray:
            """[samples, n, parts, ...] as [n parts of the poses, parts of the ray, ...]."""
            apart = values.reshape(samples, n, rows // n, inner, *values.shape[3:])
            return np.ascontiguousarray(np.moveaxis(apart, 0, 2)).reshape(rows, samples * inner, *values.shape[3:])

        with np.errstate(divide="ignore"):
            density_low = -np.log1p(-self.alpha_low) / owner.lengths[:, None, None] * (1.0 - DENSITY_ROUNDING)
            density_high = -np.log1p(-self.alpha_high) / owner.lengths[:, None, None] * (1.0 + DENSITY_ROUNDING)
        weight = self.before * self.alpha_high
        dim = weight <= self._negligible
        # a part of negligible weight takes the others' colours; its weight widens the result
        price = along(np.where(dim, weight, 0.0)).reshape(rows, samples, inner).max(axis=2).sum(axis=1)
        colors = np.stack([
            along(np.where(dim[..., None], np.inf, self.color_low)),
            along(np.where(dim[..., None], -np.inf, self.color_high)),
        ])  # fmt: skip
        count = edges_low.shape[1] - 1
        density, color = np.empty((2, rows, count)), np.empty((2, rows, count, 3))
        near, far = owner.sampling.near, owner.sampling.far
        field_hulls(
            edges_low, edges_high, near, (far - near) / (samples * inner),
            np.stack([along(density_low), along(density_high)]), colors, density, color,
        )  # fmt: skip
        low = np.tile(np.array(owner.sampling.background, np.float64), (rows, 1))
        high = low.copy()
        composite(edges_low, edges_high, density, color, low, high)
        slack = SAMPLE_ROUNDING * (2 * count + 7) + (price * KEPT_LIGHT_UP)[:, None]
        ends = np.clip(low - slack, 0.0, 1.0), np.clip(high + slack, 0.0, 1.0)
        low, high = (np.repeat(end.reshape(n, rows // n, 3), inner, axis=1) for end in ends)
        return low, high

    def _composited(self, apart: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds [n, parts, 3] of the rays' colours by part, sample by sample (F8); see `_mixtures`."""
        low, high = self._background(len(self.light)), self._background(len(self.light))
        color_low, color_high, rest = self._mixtures(slice(None), apart)
        for k in range(self.alpha_low.shape[0] - 1, -1, -1):
            least = self._anywhere(self.alpha_low[k], np.minimum)[..., None]
            most = self._anywhere(self.alpha_high[k], np.maximum)[..., None]
            rise, fall = color_high[k] - high, color_low[k] - low
            high += np.where(rise > 0.0, most, least) * rise
            low += np.where(fall < 0.0, most, least) * fall
        slack = SAMPLE_ROUNDING * (self.alpha_low.shape[0] + self.owner.sampling.importance + 5)
        low, high = low - rest - slack, high + rest + slack
        return np.clip(low, 0.0, 1.0), np.clip(high, 0.0, 1.0)
