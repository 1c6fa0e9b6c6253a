"""Bounds of rays of a hash-grid field over boxes of poses (design.md, H); compare `ns_abstract.methods.nerf.bounds`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ns_abstract.arithmetic.outward import outward
from ns_abstract.arithmetic.simd.lanes import LINE
from ns_abstract.arithmetic.simd.products import ROWS
from ns_abstract.execution.cancellation import WorkCancelledError, check_cancelled
from ns_abstract.execution.threads import each
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.nerf.division import Division, division_for
from ns_abstract.methods.nerf.frame import FieldFrame
from ns_abstract.methods.nerf.hash_bounds import pieces
from ns_abstract.methods.nerf.hash_bounds.edges import edges_of
from ns_abstract.methods.nerf.hash_bounds.features import feature_room
from ns_abstract.methods.nerf.hash_bounds.forms import form_width
from ns_abstract.methods.nerf.hash_bounds.light import light_of
from ns_abstract.methods.nerf.hash_bounds.network import (
    HeadWeights,
    LayerZonotope,
    NetWeights,
    head_weights,
    net_weights,
    zonotope,
)
from ns_abstract.methods.nerf.hash_bounds.pieces import DensityArrays, FieldArrays, PieceRoom
from ns_abstract.methods.nerf.hash_field import LAYERS_LIMIT, DenseNet, HashEncoding, NerfactoField, NerfactoScene
from ns_abstract.methods.nerf.nerfacto_render import NerfactoRenderer, spacing
from ns_abstract.methods.nerf.ray_bundle import TAYLOR, RayBundle
from ns_abstract.methods.nerf.ray_field import BoundedRays, RayBounds, RayRequest

#: Harmonics of a direction.
HARMONICS = 16
#: Rays that are bounded together, and shares of a worker between two looks at the goal. Preferences.
_SHARE, _SHARES = 4, 4


@dataclass(frozen=True)
class HashTuning:
    """Preferences of the search for sub-boxes that are narrow enough; soundness does not depend on them."""

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
    most_pieces: int = 512
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
        """True: compiled kernels bound rays one after another."""
        return True

    def division(
        self, moves: np.ndarray, most_parts: int = _TUNING.most_first, deeper: int | None = None
    ) -> Division | None:
        """Return the parts of a box whose bounds are stored; None: it is too wide. ``moves`` [n, samples, d]."""
        finer = _TUNING.finer if moves.shape[2] == 1 else 0
        return division_for(moves, self.displacement, most_parts, 0, finer)

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
        """Return [n, d] sub-boxes by axis over which points move by at most ``displacement``; None: too many."""
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
            most = _TUNING.most_pieces + 16 * int(cells[some].prod(axis=1).max())
            pieces.bound_rays(
                self.arrays, rays, cells[some], _TUNING.deeper * d, most, goal[some], limits, shifts, room,
                counts, bounds_by_part[some], bounded[some],
            )  # fmt: skip
        self._rooms.append(room)

    def _learned(self, displacement: float, bounded: np.ndarray) -> float:
        """Return a better displacement of later rays' first sub-boxes."""
        if not self.dimensions:
            return displacement
        first, finite = bounded[:, 0].sum(), bounded[:, 2].sum()
        if finite == first == len(bounded):
            # the box is narrower than a piece may be
            return displacement
        factor = _TUNING.wider * (first / max(finite, 1)) ** (1.0 / self.dimensions)
        return max(_TUNING.least_displacement, displacement * min(max(factor, 0.25), 2.0))


def _density(encoding: HashEncoding, net: DenseNet, scale: float) -> DensityArrays:
    table = np.ascontiguousarray(encoding.table, np.float64)
    ranges = np.stack([table.min(axis=1), table.max(axis=1)], axis=1)
    resolutions = np.ascontiguousarray(encoding.resolutions, np.int64)
    return DensityArrays(table, resolutions, ranges, net_weights(net), float(scale))


def field_arrays(field: NerfactoField) -> FieldArrays:
    """Return the arrays of ``field`` for kernels."""
    last, piecewise = isinstance(field.background, str), field.spacing == "piecewise"
    place = spacing if piecewise else float
    return FieldArrays(
        tuple(_density(one.encoding, one.net, one.average_init_density) for one in field.proposals),
        _density(field.encoding, field.density_net, field.average_init_density),
        head_weights(field.color_net, HARMONICS),
        np.zeros(3) if last else np.ascontiguousarray(field.background, np.float64),
        last,
        (piecewise, place(field.near), place(field.far)),
    )


def _rooms(net: NetWeights, symbols: int, layers: int = 0) -> tuple[LayerZonotope, ...]:
    """Return memory for the neurons of every layer, at least ``layers``; ``symbols`` rows before its first ReLU."""
    rows = symbols + int(net.sizes[1:-1].sum())
    rooms = tuple(zonotope(rows, int(n)) for n in net.sizes[1:])
    return rooms + (zonotope(1, 1),) * (layers - len(rooms))


def piece_room(field: NerfactoField, arrays: FieldArrays, dimensions: int) -> PieceRoom:
    """Return scratch of one thread for sets of ``dimensions`` parameters."""
    n = form_width(dimensions)
    densities = (*arrays.proposals, arrays.density)
    features = [one.table.shape[0] * one.table.shape[2] for one in densities]
    pairs = zip(densities, features, strict=True)
    rooms = tuple(_rooms(one.net, n + 2 + count, LAYERS_LIMIT) for one, count in pairs)
    head: HeadWeights = arrays.head
    neurons = int(head.net.sizes[1])
    most = max(int(net.sizes.max()) for net in (head.net, *(one.net for one in densities)))
    forms, count = np.zeros((3, n + 3)), field.samples[-1]
    return PieceRoom(
        (np.zeros((24, n + 3)), np.zeros((2, n + 4))),
        (forms, forms.copy(), np.zeros((3, 3, n + 3)), np.zeros((3, 3, n + 3)), np.zeros(3, np.bool_)),
        (np.zeros((HARMONICS, n + 3)), np.zeros((n + 2, neurons)), np.zeros(neurons)),
        np.zeros((max(features), n + 3)),
        feature_room(max(one.table.shape[2] for one in densities)),
        tuple(edges_of(count, n) for count in field.samples),
        tuple(light_of(count, n) for count in field.samples),
        rooms,
        _rooms(head.net, rooms[-1][0].rows.shape[0]),
        (np.zeros((count, 3, n + 4)), np.zeros((2, count, 3)), np.zeros((2, count, 3))),
        np.zeros(most, np.int64),
        np.zeros((ROWS, 2 * LINE // 8)),
    )  # fmt: skip


class NerfactoFrame(FieldFrame):
    """Bounds and renders one frame's set of poses of a nerfacto."""

    #: Measured for one parameter.
    compiled = 152, 60.0

    def __init__(self, scene: NerfactoScene, pose_set: PoseBox, workers: int = 1) -> None:
        bounds = HashBounds(scene.field, pose_set.geometry.box.dimensions)
        at_once = workers * _SHARE * _SHARES
        super().__init__(pose_set, NerfactoRenderer(scene.field), bounds, _SHARE, at_once, workers)

    def _tried(self, calls: Sequence[Sequence[Any]]) -> list[RayBounds | None]:
        """Return bounds of rays by call, computed in threads; None: there was no time for a call."""

        def bounded(call: Sequence[Any]) -> RayBounds | None:
            try:
                return self.bounds.rays(*call)
            except WorkCancelledError:
                return None

        return each(bounded, calls) if self.workers > 1 else [bounded(call) for call in calls]
