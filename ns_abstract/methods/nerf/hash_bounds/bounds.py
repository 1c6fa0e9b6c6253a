"""Bounds of rays of a hash-grid field over boxes of poses (design.md, H); compare `ns_abstract.methods.nerf.bounds`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ns_abstract.arithmetic.outward import outward
from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.methods.nerf.division import Division, division_for
from ns_abstract.methods.nerf.hash_bounds import pieces
from ns_abstract.methods.nerf.hash_bounds.arrays import field_arrays, piece_room
from ns_abstract.methods.nerf.hash_field import NerfactoField
from ns_abstract.methods.nerf.ray_bundle import TAYLOR, RayBundle
from ns_abstract.methods.nerf.ray_field import BoundedRays, RayBounds, RayRequest


@dataclass(frozen=True)
class HashTuning:
    """Steps of the search for pieces that are narrow enough. None of them decides whether a bound holds."""

    #: Distance whose points tell how far a ray moves, normalised units, and half of what they move by on a first piece.
    distance: float = 1.0
    displacement: float = 1e-4
    #: First pieces of later rays are so much wider than the pieces that were kept.
    wider: float = 1.4
    least_displacement: float = 1e-9
    #: Most first pieces of a box; beyond, nothing is known until it is split.
    most_first: int = 4096
    #: Halvings of first pieces by axis, and pieces of a ray beside 16 for each first one.
    deeper: int = 7
    most: int = 512
    #: Parts of the tolerance: a form's rest that is good, light behind which samples are left open (where samples are
    #: placed, and of a picture), and a weight whose colour is left open.
    rest: float = 0.25
    dark_places: float = 1e-4
    dark: float = 0.02
    dim: float = 0.005
    #: Halvings of a division's cells into parts.
    finer: int = 2
    #: Rays between looks whether there is time.
    rays: int = 4


_TUNING = HashTuning()


class HashBounds(BoundedRays):
    """Bounds of a hash-grid field's rays."""

    def __init__(self, field: NerfactoField, dimensions: int) -> None:
        self.source, self.dimensions = field, dimensions
        self.arrays = field_arrays(field)
        #: A point's distance stands for all of a ray.
        self.distances, self.lengths = np.array([min(_TUNING.distance, 0.5 * field.far)]), np.zeros(1)
        self.taylor = TAYLOR
        #: Where to begin to look for `RayBounds.displacement`.
        self.displacement = _TUNING.displacement
        self._rooms: list[pieces.PieceRoom] = []

    @property
    def compiled(self) -> bool:
        """Rays are bounded one after another by compiled kernels."""
        return True

    def division(self, moves: np.ndarray, most: int = _TUNING.most_first, deeper: int | None = None) -> Division | None:
        """The parts for which bounds over a box are kept; None: the box is too wide. ``moves`` [n, samples, d]."""
        finer = _TUNING.finer if moves.shape[2] == 1 else 0
        return division_for(moves, self.displacement, most, 0, finer)

    def bounded(self, request: RayRequest, division: Division | None) -> RayBounds:
        # opacities are not told, so those that are known are not looked at
        n, d, displacement = len(request.pixels), request.box.dimensions, self.displacement
        tolerance = request.tolerance
        bundle = RayBundle(request.pose_set, request.box, request.pixels, self.taylor)
        moves = bundle.displacement(self.distances, self.lengths)[:, 0]
        counts = np.ones(d, np.int64) if division is None else np.array(division.parts, np.int64)
        alpha = np.ones((n, 1), np.float32)
        cells = self._first_cells(moves, displacement)
        ranges = np.array(request.shifts, np.float64).reshape(-1, 2, 2)
        bounds_by_part = np.zeros((n, max(1, len(ranges)), max(1, int(counts.prod())), 2, 3))
        bounds_by_part[..., 1, :] = 1.0
        bounded = np.zeros((n, 3), np.int64)
        if cells is not None and bundle.finite:
            goal = np.stack([np.full((n, 3), np.inf), np.full((n, 3), -np.inf), np.full((n, 3), tolerance)], axis=1)
            if (aim := request.aim) is not None:
                goal[:, 0], goal[:, 1], goal[:, 2] = aim[0], aim[1], _TUNING.rest * tolerance
            self._run(bundle, cells, goal, tolerance, ranges, counts, bounds_by_part, bounded)
            displacement = self._learned(displacement, bounded)
        low, high = bounds_by_part[..., 0, :], bounds_by_part[..., 1, :]
        result = RayBounds(low.min(axis=(1, 2)), high.max(axis=(1, 2)), alpha, int(bounded[:, 1].sum()), displacement)
        if division is not None:
            shape = n, low.shape[1], *division.parts, 3
            result.parts = np.stack(outward(low.reshape(shape), high.reshape(shape)))
        return result

    def _first_cells(self, moves: np.ndarray, displacement: float) -> np.ndarray | None:
        """[n, d] pieces by axis on which points move by at most ``displacement``; None where these are too many."""
        if not np.isfinite(moves).all():
            return None
        d = moves.shape[1]
        cells = np.maximum(np.ceil(moves * d / displacement), 1.0)
        if d and cells.prod(axis=1).max() > _TUNING.most_first:
            return None
        return cells.astype(np.int64)

    def _run(
        self, bundle: RayBundle, cells: np.ndarray, goal: np.ndarray, tolerance: float, shifts: np.ndarray,
        counts: np.ndarray, bounds_by_part: np.ndarray, bounded: np.ndarray,
    ) -> None:  # fmt: skip
        d = cells.shape[1]
        origin_radius, direction_radius = bundle.rounded
        limits = pieces.WorkLimits((_TUNING.dark_places * tolerance, _TUNING.dark * tolerance), _TUNING.dim * tolerance)
        room = self._rooms.pop() if self._rooms else piece_room(self.source, self.arrays, d)
        for start in range(0, len(cells), _TUNING.rays):
            check_cancelled()
            some = slice(start, start + _TUNING.rays)
            rays = pieces.RayPolynomials(
                bundle.origin, origin_radius, bundle.direction[some], direction_radius[some], bundle.exponents
            )
            most = _TUNING.most + 16 * int(cells[some].prod(axis=1).max())
            pieces.bound_rays(
                self.arrays, rays, cells[some], _TUNING.deeper * d, most, goal[some], limits, shifts, room,
                counts, bounds_by_part[some], bounded[some],
            )  # fmt: skip
        self._rooms.append(room)

    def _learned(self, displacement: float, bounded: np.ndarray) -> float:
        """Where later rays had better begin."""
        if not self.dimensions:
            return displacement
        first, finite = bounded[:, 0].sum(), bounded[:, 2].sum()
        if finite == first == len(bounded):
            # the box is narrower than a piece may be
            return displacement
        factor = _TUNING.wider * (first / max(finite, 1)) ** (1.0 / self.dimensions)
        return max(_TUNING.least_displacement, displacement * min(max(factor, 0.25), 2.0))
