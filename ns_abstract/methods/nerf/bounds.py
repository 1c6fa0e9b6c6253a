"""Bounds of rays over a box of poses, by cells of every sample or by followed samples (docs/dev/design.md, F6-F16)."""

from __future__ import annotations

import math

import numpy as np

from ns_abstract.arithmetic.outward import outward
from ns_abstract.methods.nerf.division import ENDS, Division, division_for, regroup_parts
from ns_abstract.methods.nerf.ray_bundle import RayBundle
from ns_abstract.methods.nerf.ray_field import RAY_TUNING, RayBounds, RayField, RayRequest, typical_displacement
from ns_abstract.methods.nerf.sample_cells import SampleCellBounds
from ns_abstract.methods.nerf.sample_paths import BundleBounds, SamplePaths

#: Halvings below cells of the starting width, by number of parameters (one level may concern any axis).
_DEEPER = {0: 0, 1: 2}
_DEEPER_MORE = 6
#: Halvings of the deepest cells into parts, by axis; the cells of a line have two or three parts as it is.
_FINER = {2: 1}
#: Most parts of one box.
_PARTS = 4096


#: Where samples are followed: halvings below first cells by axis, of the deepest cells into parts, and the least way.
_FOLLOWED_DEEPER = 3
_FOLLOWED_FINER, _FOLLOWED_FINER_MORE = {1: 2, 2: 2}, 1
#: Rays that one cell leaves so open are bounded by bins, too.
_LOOSE = 0.5
#: Numbers (rays, samples, parts) that are worked on together.
_NUMBERS = 1 << 21


class NerfBounds(RayField):
    """Bounds of a scene's rays; arguments as of `RayField`."""

    def bounded(self, request: RayRequest, division: Division | None) -> RayBounds:
        if self.paths is None:
            return self._apart(request, division, division is not None, self.displacement)
        ray_bounds, alone = self._followed(self.paths, request, division)
        loose = np.flatnonzero(alone & ((ray_bounds.upper - ray_bounds.lower).max(axis=1) > _LOOSE))
        if not loose.size:
            return ray_bounds
        # narrower boxes would not help: samples anywhere in their bins
        bins = self._apart(request.take(loose), None, division is not None, RAY_TUNING.displacement)
        ray_bounds.lower[loose] = np.maximum(ray_bounds.lower[loose], bins.lower)
        ray_bounds.upper[loose] = np.minimum(ray_bounds.upper[loose], bins.upper)
        ray_bounds.alpha[loose] = bins.alpha
        if ray_bounds.parts is not None and bins.parts is not None:
            low, high = (
                regroup_parts(*side, ray_bounds.parts.shape[3:-1]) for side in zip(bins.parts, ENDS, strict=True)
            )
            ray_bounds.parts[0][loose] = np.maximum(ray_bounds.parts[0][loose], low)
            ray_bounds.parts[1][loose] = np.minimum(ray_bounds.parts[1][loose], high)
        ray_bounds.cells += bins.cells
        return ray_bounds

    def _nothing(self, request: RayRequest, parts: tuple[int, ...] | None) -> RayBounds:
        """Return the trivial bounds of any rays; also by ``parts``, if there are any."""
        n = len(request.pixels)
        trivial = np.zeros((n, 3)), np.ones((n, 3)), np.ones((n, self.distances.size), np.float32), 0, self.displacement
        if parts is None:
            return RayBounds(*trivial)
        low = np.zeros((n, max(1, len(request.shifts)), *parts, 3), np.float32)
        return RayBounds(*trivial, np.stack([low, np.ones_like(low)]))

    def _followed(
        self, paths: SamplePaths, request: RayRequest, given: Division | None
    ) -> tuple[RayBounds, np.ndarray]:
        """Return bounds from followed samples, [0, 1] where the box is too wide, and [n] whether it is one cell."""
        bundle = RayBundle(request.pose_set, request.box, request.pixels, paths.degree)
        moves = bundle.displacement(self.distances, self.lengths)
        division = self.division(moves) if given is None else given
        parts = None if given is None else given.parts
        if division is None or not bundle.finite:
            return self._nothing(request, parts), np.zeros(len(moves), bool)
        start = division.first(moves, self.displacement).max(axis=1)
        work = BundleBounds(paths, bundle, division, start, request.tolerance, request.aim, request.shifts)
        work.run()
        n, shifts = len(moves), work.lower.shape[2]
        # [n, shifts, *parts, 3]
        low, high = (np.moveaxis(end, 2, 1).reshape(n, shifts, *division.parts, 3) for end in (work.lower, work.upper))
        rays = RayBounds(
            work.lower.min(axis=(1, 2)), work.upper.max(axis=(1, 2)), np.ones((n, self.distances.size), np.float32),
            work.cells, max(RAY_TUNING.least_followed, self.displacement * work.factor),
            None if given is None else np.stack(outward(low, high)),
        )  # fmt: skip
        return rays, start == 0

    def _apart(self, request: RayRequest, given: Division | None, by_part: bool, displacement: float) -> RayBounds:
        """Return bounds from cells of every sample, or of the bins that samples lie in."""
        n, samples, box = len(request.pixels), self.distances.size, request.box
        bundle = RayBundle(request.pose_set, box, request.pixels, self.taylor, self.swept)
        moves = bundle.displacement(self.distances, self.lengths)
        division = given
        if division is None:
            d = moves.shape[2]
            division = division_for(
                moves, displacement, _PARTS, _DEEPER.get(d, _DEEPER_MORE), _FINER.get(d, 0), self.swept
            )
        if division is None or not bundle.finite:
            parts = (1,) * box.dimensions if division is None else division.parts[: box.dimensions]
            return self._nothing(request, parts if by_part else None)
        if n > 1 and n * samples * math.prod(division.parts) > _NUMBERS:
            halves = [
                self._apart(request.take(which), given, by_part, displacement)
                for which in (np.arange(n // 2), np.arange(n // 2, n))
            ]
            lower, upper, alpha = (
                np.concatenate([getattr(half, name) for half in halves]) for name in ("lower", "upper", "alpha")
            )
            parts = [half.parts for half in halves if half.parts is not None]
            return RayBounds(
                lower, upper, alpha, halves[0].cells + halves[1].cells, typical_displacement(halves),
                np.concatenate(parts, axis=1) if parts else None,
            )  # fmt: skip
        edges = None
        if self.paths is not None:
            edges = self._edges(self.paths, RayBundle(request.pose_set, box, request.pixels, self.taylor), division)
        work = SampleCellBounds(self, bundle, division, moves, request, displacement, edges)
        return work.run(request.shifts, by_part)

    def _edges(self, paths: SamplePaths, bundle: RayBundle, division: Division) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds [n parts, .] of the fine samples' edges by parts of the poses (design.md, F14)."""
        monomials = np.prod(paths.coarse.basis.nodes[:, None, :] ** bundle.exponents, axis=-1)
        origin, direction = monomials @ bundle.origin, monomials @ bundle.direction
        low, high = paths.edges(
            np.broadcast_to(origin, direction.shape), direction, bundle.rounded, division.parts[:-1]
        )
        return low.reshape(-1, low.shape[2]), high.reshape(-1, high.shape[2])

    def division(self, moves: np.ndarray, most_parts: int = _PARTS, deeper: int | None = None) -> Division | None:
        """Return `division_for` samples that move by ``moves`` [n, samples, d], with the widest usable cells."""
        d = moves.shape[2]
        if self.paths is None:
            usual, finer = _DEEPER.get(d, _DEEPER_MORE), _FINER.get(d, 0)
        else:
            usual, finer = _FOLLOWED_DEEPER * d, _FOLLOWED_FINER.get(d, _FOLLOWED_FINER_MORE)
        return division_for(moves, self.displacement, most_parts, usual if deeper is None else deeper, finer)
