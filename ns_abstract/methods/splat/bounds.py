"""Bounds of a splat scene's picture over one cell of camera poses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import get_num_threads

from ns_abstract.arithmetic.forms import Basis
from ns_abstract.arithmetic.units import UNIT64, Arithmetic
from ns_abstract.methods.splat.activate import Splats
from ns_abstract.methods.splat.colors import color_reach, fixed_colors, gathered, moving_colors
from ns_abstract.methods.splat.constants import Rasteriser, rules_array
from ns_abstract.methods.splat.gaussians import covariance_noise, gaussian_stage
from ns_abstract.methods.splat.lists import depth_order, marked, tile_lists, tile_mask
from ns_abstract.methods.splat.pixels import pixel_stage
from ns_abstract.methods.splat.records import columns, faint_exponents
from ns_abstract.methods.splat.render import camera_array
from ns_abstract.methods.splat.variations import VariedSplats
from ns_abstract.sets.path import Camera
from ns_abstract.sets.poses import PoseForms
from ns_abstract.sets.tiles import tile_grid

#: Most pairs of layers whose depth order is examined in one block of pixels.
PAIR_LIMIT = 30_000


@dataclass
class CellBounds:
    """Bounds of some tiles over one cell.

    Attributes:
        wanted: [t] tile numbers, row-major.
        lower, upper: [t, side, side, 3] float64 enclosures of every image of the cell.
        visible: [n] scene indices of the Gaussians that some pose of the cell may show in these tiles.
        reach: [n, 4] their ranges of tiles: columns first and past, rows first and past.
        linear: [t, side, side, 3, m + 1] polynomial coefficients and radius, or None.
        slopes: [d] mean absolute linear coefficients.
        statistics: Blocks, layers, uncertain pairs, blocks that gave up on order, pixels with results that were not
            numbers.
    """

    wanted: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    visible: np.ndarray
    reach: np.ndarray
    linear: np.ndarray | None
    slopes: np.ndarray
    statistics: np.ndarray


class SplatBounds:
    """Bounds the pictures of one scene.

    Args:
        splats: The activated scene.
        rasteriser: The rules of the bounded program.
        arithmetic: What that program computes with.
        varied: The set of scenes that is bounded with each pose; None: ``splats`` alone.
    """

    def __init__(
        self, splats: Splats, rasteriser: Rasteriser, arithmetic: Arithmetic, varied: VariedSplats | None = None
    ) -> None:
        self.splats = splats
        self.varied = VariedSplats.fixed(splats) if varied is None else varied
        self.rasteriser = rasteriser
        self.arithmetic = arithmetic
        self.rules = rules_array(rasteriser)
        self.side = rasteriser.work_tile
        a = arithmetic
        self._errors = np.array([a.unit, a.flush, a.division, a.sqrt, a.rsqrt, a.exp, a.overflow])
        self._buffers: dict[str, np.ndarray] = {}
        self._faint = faint_exponents(self.varied.opacity_high, self.rules[7], a.unit)
        self._extents = np.sqrt(np.square(splats.axes).sum(axis=1).max(axis=1, initial=0.0))
        self._noise = covariance_noise(splats.axes, a.unit, a.flush)
        self._color_radius = 8.0 * a.unit * float(np.abs(splats.sh).max(initial=1.0)) if splats.degree == 0 else 0.0
        self._color_reach = color_reach(splats.sh, splats.degree) if splats.degree > 0 else None
        self._seen_from: tuple[tuple[float, ...], np.ndarray] | None = None
        self._plain_colors = _shifted_colors(self.varied, a.unit) if splats.degree == 0 else None

    def _buffer(self, name: str, shape: tuple[int, ...], dtype: type = np.float64) -> np.ndarray:
        """Uninitialised memory that begins with a cache line and is kept from call to call."""
        size = math.prod(shape)
        kept = self._buffers.get(name)
        if kept is None or kept.size < size:
            room = np.empty(size * np.dtype(dtype).itemsize + 64, np.uint8)
            start = -room.ctypes.data % 64
            kept = self._buffers[name] = room[start : start + room.size - 64].view(dtype)
        return kept[:size].reshape(shape)

    def cell(
        self,
        camera: Camera,
        forms: PoseForms,
        wanted: np.ndarray | None = None,
        candidates: np.ndarray | None = None,
        keep_linear: bool = False,
        floor: float = -1.0,
    ) -> CellBounds:
        """Bounds of the tiles ``wanted`` over the poses enclosed by ``forms``.

        Args:
            camera: Intrinsics and size.
            forms: The cell's poses.
            wanted: Tile numbers; all if None.
            candidates: Scene indices that may be visible (from an enclosing cell); all if None.
            keep_linear: Whether to return the linear sets.
            floor: What no more light comes to may have any colour that is there (B6); negative, and for rasterisers
                without a stop: every layer counts.
        """
        splats = self.splats
        basis: Basis = forms.rotation.basis
        d, order, m = basis.dimensions, basis.order, basis.monomials
        across, down = tile_grid(camera, self.side)
        if wanted is None:
            wanted = np.arange(across * down)
        wanted = np.asarray(wanted, np.int64)
        if candidates is None:
            candidates = np.arange(splats.count, dtype=np.int32)
        n = candidates.size
        view = camera_array(camera)
        rotation, offset = forms.rotation.data, forms.offset.data
        low, high = forms.rotation.bounds()
        rotation_reach = np.maximum(np.abs(low), np.abs(high)).ravel()
        low, high = forms.position.bounds()
        camera_reach = np.maximum(np.abs(low), np.abs(high))
        record = self._buffer("record", (n, columns(6 if splats.antialiased else 5, m)))
        box = self._buffer("box", (n, 4))
        tiles = self._buffer("tiles", (n, 8), np.int32)
        depth = self._buffer("depth", (n,))
        delta = self._buffer("delta", (n, 3))
        depth_error = self._buffer("depth_error", (n,))
        state = self._buffer("state", (n,), np.uint8)
        gaussian_stage(
            candidates, self.varied.mean_middle, splats.axes, self._extents, self._noise,
            self.varied.opacity_low, self.varied.opacity_high, self._faint, self.varied.mean_radius,
            rotation, offset, forms.origin, camera_reach, rotation_reach, view, self.rules, self._errors,
            d, order, m, splats.antialiased, record, box, tiles, depth, delta, depth_error, state,
        )  # fmt: skip
        alive = np.flatnonzero(state)
        colors = self._colors(forms, camera_reach, candidates, alive, n)
        mask = tile_mask(wanted, across * down)
        offsets, entries = tile_lists(depth_order(alive, depth), tiles, mask, across)
        # the third row of the rotation; its float32 rounding is the same for every Gaussian
        slope = np.ascontiguousarray(rotation[:, 6:9])
        slope[m] += 4.0 * self.arithmetic.unit * rotation_reach[6:9]
        lower = np.zeros((wanted.size, self.side, self.side, 3))
        upper = np.zeros((wanted.size, self.side, self.side, 3))
        linear = np.zeros((wanted.size if keep_linear else 0, self.side, self.side, 3, m + 1))
        slopes = np.zeros((wanted.size, d))
        threads = get_num_threads()
        statistics = np.zeros((threads, 5), np.int64)
        marks = np.zeros(n, np.uint8)
        negligible = self.rasteriser.alpha_negligible * splats.count
        stop, alpha_min = self.rules[9], self.rules[7]
        if stop > 0.0 < floor:
            # each layer that is drawn dims the light by the least alpha or more, and is added with one rounding (B8)
            most = math.log(max(floor / stop, 1.0)) / -math.log1p(-alpha_min) + 4.0
            fade = (1.1 + 4.0 * floor) * most * (self.arithmetic.unit + 8.0 * UNIT64)
        else:
            floor, fade = -1.0, 0.0
        pixel_stage(
            wanted, offsets, entries, record, box, tiles, depth, delta, depth_error, colors, self._color_radius,
            slope, np.ascontiguousarray(rotation[0]), view, self.rules, self._errors,
            splats.background, floor, fade, negligible, PAIR_LIMIT, d, order, m,
            splats.antialiased, threads, lower, upper, linear, slopes, statistics, marks,
        )  # fmt: skip
        return CellBounds(
            wanted, lower, upper, *marked(marks, candidates, tiles),
            linear if keep_linear else None, slopes.sum(axis=0) / (max(wanted.size, 1) * self.side**2 * 3),
            statistics.sum(axis=0),
        )  # fmt: skip

    def _colors(
        self, forms: PoseForms, camera_reach: np.ndarray, candidates: np.ndarray, alive: np.ndarray, n: int
    ) -> np.ndarray:
        """Colours of the visible Gaussians: [n, 3], [n, 6] (centre, radius) or forms."""
        splats, varied = self.splats, self.varied
        basis = forms.position.basis
        if splats.degree == 0:
            if self._plain_colors is not None:
                return self._plain_colors if n == splats.count else self._plain_colors[candidates]
            if n == splats.count:
                return np.ascontiguousarray(splats.sh[:, 0])
            return splats.sh[candidates, 0]
        unit = self.arithmetic.unit
        # torch.inverse of the view matrix: 80 units of 1 + |T| (design.md, C3)
        position_error = 80.0 * unit * (1.0 + float(camera_reach.sum()))
        if not np.any(forms.position.linear) and float(forms.position.radius.max()) < 1e-9:
            position_error += 2.0 * float(forms.position.radius.max())
            view = (*forms.position.center.tolist(), position_error)
            if self._seen_from is None or self._seen_from[0] != view:
                # of every Gaussian: cells that only turn the camera share them
                colors = self._buffer("colors", (splats.count, 6))
                fixed_colors(
                    varied.mean_middle, varied.mean_radius, varied.color_low, varied.color_high, splats.sh,
                    self._color_reach, splats.degree, forms.position.center, position_error, unit, colors,
                )  # fmt: skip
                self._seen_from = view, colors
            colors = self._seen_from[1]
            return colors if n == splats.count else gathered(colors, candidates, alive, self._buffer("some", (n, 6)))
        indices = np.empty((alive.size, 2), np.int64)
        indices[:, 0], indices[:, 1] = alive, candidates[alive]
        self._seen_from = None
        colors = self._buffer("colors", (n, 3 * (basis.monomials + 1)))
        moving_colors(
            indices, varied.mean_middle, varied.mean_radius, varied.color_low, varied.color_high,
            splats.sh, self._color_reach, splats.degree, forms.position.data, forms.origin, position_error, unit,
            basis.dimensions, basis.order, basis.monomials, colors,
        )  # fmt: skip
        return colors


def _shifted_colors(varied: VariedSplats, unit: float) -> np.ndarray | None:
    """[N, 6] centre and radius by channel of view-independent colours (design.md, S4); None where none varies."""
    if not varied.color_low.size:
        return None
    color, top = varied.stored.sh[:, 0], varied.stored.color_max
    low, high = (np.clip(color + end, 0.0, top) for end in (varied.color_low, varied.color_high))
    moved = (varied.color_low != 0.0) | (varied.color_high != 0.0)
    size = color + np.maximum(np.abs(varied.color_low), np.abs(varied.color_high))
    # one addition and the ends' own rounding
    radius = 0.5 * (high - low) + (4.0 * unit + 8.0 * UNIT64) * size
    found = np.stack([np.where(moved, 0.5 * (low + high), color), np.where(moved, radius, 0.0)], axis=-1)
    return np.ascontiguousarray(found.reshape(-1, 6))
