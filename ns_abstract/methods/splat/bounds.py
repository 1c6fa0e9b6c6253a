"""Bounds of a splat scene's picture over one cell of camera poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ns_abstract.arithmetic.forms import Basis
from ns_abstract.arithmetic.rounding import (
    FRAGMENT_ROUNDING,
    GRAM_ROOM,
    GRAM_UP,
    REAL,
    REGION,
    SHIFTED_ROUNDING,
    STILL_POSITION,
    SUB_BOX_OVERLAP,
    TIE_ROUNDING,
    Arithmetic,
    Charges,
    charges,
)
from ns_abstract.execution.threads import thread_group, threads
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.motion_cells import MotionCells
from ns_abstract.geometry.poses import PoseForms
from ns_abstract.geometry.tiles import tile_grid
from ns_abstract.methods.splat.activate import Splats
from ns_abstract.methods.splat.colors import color_magnitudes, fixed_colors, gathered, moving_colors
from ns_abstract.methods.splat.constants import Rasteriser, RasterRules, raster_rules
from ns_abstract.methods.splat.gaussians import covariance_noise, gaussian_stage
from ns_abstract.methods.splat.lists import TileLists, depth_order, pixel_sets, tile_lists, tile_mask, visible_again
from ns_abstract.methods.splat.pixel_regions import exponent_limits
from ns_abstract.methods.splat.pixels import pixel_stage
from ns_abstract.methods.splat.projection_errors import columns
from ns_abstract.methods.splat.stage_data import (
    CellPoses,
    Colors,
    Cutoffs,
    FormShape,
    Parts,
    PixelBounds,
    PixelInputs,
    ProjectedCell,
    ProjectedGaussians,
    SceneColors,
    SceneGaussians,
    SubBoxes,
    ViewingAxes,
    cell_parts,
    check_parts,
    form_shape,
)
from ns_abstract.methods.splat.variations import VariedSplats

#: Most pairs of fragments whose depth order is examined in one block of pixels.
PAIR_LIMIT = 30_000
#: The same where bounds over many sub-boxes come of it: blocks with more pairs take longest and exclude least.
PART_PAIR_LIMIT = 3_000


class Stages(NamedTuple):
    """The kernels of a cell, which write into given memory; the slowest to compile comes first."""

    pixel_stage: Callable[..., object] = pixel_stage
    gaussian_stage: Callable[..., object] = gaussian_stage
    moving_colors: Callable[..., object] = moving_colors

    def alone(self, stage: str) -> Stages:
        """Return the stages with no-ops in place of all but one; the bounds of `SplatBounds.cell` then mean nothing."""
        # no Gaussian is seen
        nothing = Stages(lambda *_: None, lambda *arguments: arguments[-1].fill(0), lambda *_: None)
        return nothing._replace(**{stage: getattr(self, stage)})


@dataclass
class CellBounds:
    """Bounds of some tiles over one cell.

    Attributes:
        wanted: [t] tile numbers, row-major.
        lower, upper: [t, side, side, 3] float64 enclosures of every image of the cell.
        visible: [n] scene indices of the Gaussians that some pose of the cell may show on the requested pixels.
        reach: [n, 4] rectangles of pixels outside of which they are invisible: columns first and past, rows likewise.
        linear: [t, side, side, 3, m + 1] polynomial coefficients and radius, or None.
        layers: [t, side, side, 4] accumulation and expected depth as in `PixelBounds.layers`, or None.
        slopes: [d] mean absolute linear coefficients; 0 for pixels that were not requested.
        statistics: Counts of blocks, layers, uncertain pairs, blocks with too many depth orders, and pixels whose
            results were not numbers.
        parts: [t, side, side, 6, parts] as in `PixelBounds`, or None.
    """

    wanted: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    visible: np.ndarray
    reach: np.ndarray
    linear: np.ndarray | None
    layers: np.ndarray | None
    slopes: np.ndarray
    statistics: np.ndarray
    parts: np.ndarray | None


class SceneSums:
    """Quantities of a scene that do not depend on the pose; each is computed at first use.

    Args:
        splats: The activated scene.
        varied: The set of scenes.
        rules: The rasteriser's.
        charges: For the program's rounding.
    """

    def __init__(self, splats: Splats, varied: VariedSplats, rules: RasterRules, charges: Charges) -> None:
        self._splats, self._varied, self._rules, self._charges = splats, varied, rules, charges

    @cached_property
    def gaussians(self) -> SceneGaussians:
        """The arrays that the per-Gaussian stage reads."""
        axes, varied = self._splats.axes, self._varied
        return SceneGaussians(
            means=varied.mean_middle,
            mean_radius=varied.mean_radius,
            axes=axes,
            extents=np.sqrt(np.square(axes).sum(axis=1).max(axis=1, initial=0.0)),
            noise=covariance_noise(axes, self._charges),
            opacity_low=varied.opacity_low,
            opacity_high=varied.opacity_high,
            exponent_limits=exponent_limits(varied.opacity_high, self._rules.alpha_min, self._charges),
        )

    @cached_property
    def color_radius(self) -> float:
        """Bound of the float error of view-independent colours."""
        if self._splats.degree > 0:
            return 0.0
        return self._charges.plain_color * float(np.abs(self._splats.sh).max(initial=1.0))

    @cached_property
    def color_magnitudes(self) -> np.ndarray:
        """[N, 6] see `colors.color_magnitudes`."""
        return color_magnitudes(self._splats.sh, self._splats.degree)

    @cached_property
    def plain_colors(self) -> np.ndarray | None:
        """View-independent colours where they vary, else None; see `_shifted_colors`."""
        return _shifted_colors(self._varied, self._charges)

    @cached_property
    def largest_mean(self) -> float:
        """Greatest absolute coordinate of a mean, world units."""
        return float(np.abs(self._splats.means).max(initial=0.0))

    @cached_property
    def least_step(self) -> float:
        """Least difference other than 0 between two coordinates of means along one axis, world units."""
        steps = [np.diff(np.unique(column)) for column in self._splats.means.T]
        return min(float(step.min(initial=np.inf)) for step in steps)


def _divided(
    basis: Basis, parts: np.ndarray | MotionCells | None, keep_parts: bool, sub_boxes: SubBoxes | None
) -> tuple[FormShape, Parts]:
    """Return the forms of a cell, and its equal parts or sub-boxes, if it is divided; see `SplatBounds.cell`."""
    if parts is not None:
        return divided_by(basis, parts, SUB_BOX_OVERLAP * keep_parts)
    if sub_boxes is None:
        return form_shape(basis), cell_parts(np.ones(basis.dimensions, np.int64))
    counts = sub_boxes.counts
    check_parts(counts, basis.dimensions)
    return form_shape(basis, 0, int(counts.prod())), cell_parts(counts, SUB_BOX_OVERLAP, sub_boxes.levels)


def divided_by(basis: Basis, parts: np.ndarray | MotionCells, overlap: float) -> tuple[FormShape, Parts]:
    """Return the forms of a cell that is bounded over ``parts``, and these parts; see `cell_parts`."""
    if not isinstance(parts, MotionCells):
        check_parts(parts, basis.dimensions)
        return form_shape(basis, int(parts.prod())), cell_parts(parts, overlap)
    check_parts(parts.counts, 2)
    equal = cell_parts(parts.counts, overlap)._replace(motion=parts.motion, side=parts.side)
    return form_shape(basis, int(parts.counts.prod()), by_motion=True), equal


def _cell_poses(forms: PoseForms) -> CellPoses:
    """Return the cell's poses in the form that the per-Gaussian stage takes."""
    rotation, position = (
        np.maximum(np.abs(low), np.abs(high)) for low, high in (forms.rotation.bounds(), forms.position.bounds())
    )
    return CellPoses(forms.rotation.data, forms.offset.data, forms.origin, position, rotation.ravel())


class SplatBounds:
    """Bounds the pictures of one scene.

    Args:
        splats: The activated scene.
        rasteriser: The rules of the bounded program.
        arithmetic: The arithmetic of that program.
        varied: The set of scenes that is bounded with each pose; None: ``splats`` alone.
        sums: The `SceneSums` of this scene, to be shared with other frames.

    Attributes:
        stages: The compiled kernels that `cell` runs.
    """

    stages = Stages()

    def __init__(
        self,
        splats: Splats,
        rasteriser: Rasteriser,
        arithmetic: Arithmetic,
        varied: VariedSplats | None = None,
        sums: SceneSums | None = None,
    ) -> None:
        self.splats = splats
        self.varied = VariedSplats.fixed(splats) if varied is None else varied
        self.rasteriser = rasteriser
        self.arithmetic = arithmetic
        rules = raster_rules(rasteriser, splats.antialiased)
        # G12: tiles from 1.5 on change no picture in real numbers, and our renderer has none
        self.rules = rules._replace(tile_room=0.0) if arithmetic == REAL else rules
        self.side = rasteriser.work_tile
        self.charges = charges(arithmetic)
        self._buffers: dict[tuple[int, str], np.ndarray] = {}
        self._sums = SceneSums(splats, self.varied, self.rules, self.charges) if sums is None else sums
        self._seen_from: dict[int, tuple[tuple[float, ...], np.ndarray]] = {}

    def _tied(self, origin: np.ndarray) -> bool:
        """Return whether means are surely equal where their differences to ``origin`` [3] are (design.md, O1)."""
        largest = self._sums.largest_mean + float(np.abs(origin).max())
        # two roundings of the differences
        return self.varied.mean_radius.shape[0] == 0 and self._sums.least_step > TIE_ROUNDING * largest

    def _buffer(self, name: str, shape: tuple[int, ...], dtype: type = np.float64) -> np.ndarray:
        """Return uninitialised memory that begins at a cache line and is reused by calls of the same thread group."""
        size, key = math.prod(shape), (thread_group(), name)
        buffer = self._buffers.get(key)
        if buffer is None or buffer.size < size:
            room = np.empty(size * np.dtype(dtype).itemsize + 64, np.uint8)
            start = -room.ctypes.data % 64
            buffer = self._buffers[key] = room[start : start + room.size - 64].view(dtype)
        return buffer[:size].reshape(shape)

    def cell(
        self,
        camera: PinholeCamera,
        forms: PoseForms,
        wanted: np.ndarray | None = None,
        candidates: np.ndarray | ProjectedCell | None = None,
        keep_linear: bool = False,
        floor: float = -1.0,
        layers: bool = False,
        pixels: np.ndarray | None = None,
        parts: np.ndarray | MotionCells | None = None,
        keep_parts: bool = False,
        sub_boxes: SubBoxes | None = None,
    ) -> CellBounds:
        """Return bounds of the tiles ``wanted`` over the poses enclosed by ``forms`` (design.md, G10).

        Args:
            camera: Intrinsics and size.
            forms: The cell's poses.
            wanted: Tile numbers; all if None.
            candidates: Scene indices that may be visible there (from an enclosing cell), or the result of `project` for
                the cell, if that is known; all if None.
            keep_linear: Whether to return the linear sets.
            floor: Fragments that get no more light than this may have any colour that is there (B6); negative, and for
                rasterisers without early termination: every fragment counts.
            layers: Whether to bound accumulation and expected depth, too.
            pixels: [t, side, side] the requested pixels, the others have no meaningful bounds; all if None.
            parts: [d] numbers of parts along the cell's axes, powers of two and at least `PART_LANES` together: bound
                pixels by intervals over each of them, not by forms (B12).
            keep_parts: Whether to return bounds over each of these parts.
            sub_boxes: Bound pixels by forms over each of these, too, and return these bounds as ``parts`` (B13).

        Raises:
            ValueError: Linear sets, layers or ``sub_boxes`` are requested together with ``parts``, or numbers of parts
                or sub-boxes are not as above.
        """
        if parts is not None and (keep_linear or layers or sub_boxes is not None):
            raise ValueError("intervals over parts of a cell have no linear sets and no layers, nor sub-boxes")
        shape, equal = _divided(forms.rotation.basis, parts, keep_parts, sub_boxes)
        with_ends = keep_parts or sub_boxes is not None
        across, down = tile_grid(camera, self.side)
        wanted = np.asarray(np.arange(across * down) if wanted is None else wanted, np.int64)
        projected = candidates if isinstance(candidates, ProjectedCell) else self.project(camera, forms, candidates)
        candidates, poses, gaussians, alive, colors, background, color_error = projected
        offsets, entries = tile_lists(
            self._listed(alive, candidates, gaussians), gaussians.tiles, tile_mask(wanted, across * down), across
        )
        m = shape.monomials
        common = np.zeros(m + 1)
        if layers:
            colors = _four_channels(colors, self._depths(poses, candidates, alive, gaussians.delta, m), alive, m)
            common = np.ascontiguousarray(poses.offset[: m + 1, 2])
        bounds = self._allocate_bounds(wanted.size, candidates.size, shape, keep_linear, layers, with_ends)
        inputs = PixelInputs(
            gaussians,
            self._viewing_axes(forms, poses.rotation_magnitude, gaussians),
            camera.intrinsics,
            Colors(colors, background, color_error, 4 if layers else 3, common),
            self.rules,
            self.charges,
            self._cutoffs(floor, PART_PAIR_LIMIT if keep_parts else PAIR_LIMIT),
            shape,
            equal,
        )
        sets = pixel_sets(pixels, wanted.size, self.side)
        self.stages.pixel_stage(TileLists(wanted, offsets, entries), sets, inputs, bounds)
        return CellBounds(
            wanted, bounds.lower, bounds.upper,
            *visible_again(bounds.marks, candidates, gaussians.box, gaussians.tiles, self.side),
            bounds.linear if keep_linear else None, bounds.layers if layers else None,
            bounds.slopes.sum(axis=0) / (max(wanted.size, 1) * self.side**2 * 3), bounds.statistics.sum(axis=0),
            bounds.parts if with_ends else None,
        )  # fmt: skip

    def project(self, camera: PinholeCamera, forms: PoseForms, candidates: np.ndarray | None = None) -> ProjectedCell:
        """Return the Gaussians ``candidates``, all if None, projected over the poses enclosed by ``forms``."""
        if candidates is None:
            candidates = np.arange(self.splats.count, dtype=np.int32)
        poses = _cell_poses(forms)
        gaussians, alive = self._projected(candidates, poses, camera, form_shape(forms.rotation.basis))
        colors = self._colors(forms, poses.camera_magnitude, candidates, alive, candidates.size)
        return ProjectedCell(
            candidates, poses, gaussians, alive, colors, self.splats.background, self._sums.color_radius
        )

    def _projected(
        self, candidates: np.ndarray, poses: CellPoses, camera: PinholeCamera, shape: FormShape
    ) -> tuple[ProjectedGaussians, np.ndarray]:
        """Return the candidates' forms, and the numbers [k] of the candidates that some pose shows."""
        n = candidates.size
        gaussians, state = self._room(n, shape.monomials), self._buffer("state", (n,), np.uint8)
        self.stages.gaussian_stage(
            candidates, self._sums.gaussians, poses, camera.intrinsics, self.rules, self.charges, shape, gaussians,
            state,
        )  # fmt: skip
        return gaussians, np.flatnonzero(state)

    def _allocate_bounds(
        self, tiles: int, gaussians: int, shape: FormShape, keep_linear: bool, layers: bool, with_ends: bool
    ) -> PixelBounds:
        """Return uninitialised output of the pixel stage for ``tiles`` tiles and ``gaussians`` candidates."""
        shaped = (tiles, self.side, self.side, 3)
        return PixelBounds(
            lower=np.zeros(shaped),
            upper=np.zeros(shaped),
            linear=np.zeros((tiles if keep_linear else 0, *shaped[1:], shape.monomials + 1)),
            layers=np.zeros((tiles if layers else 0, self.side, self.side, 4)),
            slopes=np.zeros((tiles, shape.dimensions)),
            statistics=np.zeros((threads(), 5), np.int64),
            # memory is taken where it is written: for the pixels that are wanted
            parts=np.empty((tiles if with_ends else 0, self.side, self.side, 6, max(shape.parts, shape.sub_boxes))),
            marks=np.zeros(gaussians, np.uint8),
        )

    def _room(self, n: int, m: int) -> ProjectedGaussians:
        """Return memory for ``n`` Gaussians' forms of ``m`` coefficients."""
        return ProjectedGaussians(
            record=self._buffer("record", (n, columns(6 if self.splats.antialiased else 5, m))),
            box=self._buffer("box", (n, 4)),
            tiles=self._buffer("tiles", (n, 8), np.int32),
            depth=self._buffer("depth", (n,)),
            delta=self._buffer("delta", (n, 3)),
            depth_error=self._buffer("depth_error", (n,)),
        )

    def _listed(self, alive: np.ndarray, candidates: np.ndarray, gaussians: ProjectedGaussians) -> np.ndarray:
        """Return the rows ``alive`` of ``gaussians``, nearest first; they are the scene's ``candidates[alive]``."""
        return depth_order(alive, gaussians.depth)

    def _viewing_axes(
        self, forms: PoseForms, rotation_magnitude: np.ndarray, gaussians: ProjectedGaussians
    ) -> ViewingAxes:
        """Return the quantities that decide the depth order of ``gaussians``."""
        rotation = forms.rotation.data
        # the third row of the rotation; its float32 rounding is the same for every Gaussian
        slope = np.ascontiguousarray(rotation[:, 6:9])
        slope[form_shape(forms.rotation.basis).monomials] += self.charges.viewing_axis * rotation_magnitude[6:9]
        return ViewingAxes(slope, np.ascontiguousarray(rotation[0]), self._tied(forms.origin))

    def _depths(
        self, poses: CellPoses, candidates: np.ndarray, alive: np.ndarray, delta: np.ndarray, m: int
    ) -> np.ndarray:
        """Return forms [k, m + 1] of the depths of candidates ``alive`` [k] less the offset's (design.md, D1)."""
        axis, most = poses.rotation[: m + 1, 6:9], poses.rotation_magnitude[6:9]
        away = delta[alive]
        forms = away @ axis.T
        # float error of the coordinate, and what ranges of means add to it (G2, S2)
        sizes = np.abs(self.varied.mean_middle[candidates[alive]])
        spread = np.zeros_like(sizes)
        if self.varied.mean_radius.shape[0]:
            spread = self.varied.mean_radius[candidates[alive]]
        error = self.charges.camera_coordinate * ((sizes + spread + poses.camera_magnitude) @ most) + spread @ most
        # the rows' own radii, and the rounding of delta and of three products and sums
        sizes = np.abs(away)
        error += sizes @ axis[m] + FRAGMENT_ROUNDING * (sizes @ np.abs(axis[:m]).sum(axis=0))
        forms[:, m] = error * REGION
        return forms

    def _cutoffs(self, floor: float, pairs: int) -> Cutoffs:
        """Return the limits for fragments that get no more light than ``floor``; ``pairs``: see `Cutoffs` (B6, B8)."""
        stop, fade = self.rules.transmittance_min, 0.0
        if stop > 0.0 < floor:
            # each fragment that is drawn dims the light by the least alpha or more, and is added with one rounding
            most = math.log(max(floor / stop, 1.0)) / -math.log1p(-self.rules.alpha_min) + 4.0
            fade = (1.1 + 4.0 * floor) * most * self.charges.left_out
        else:
            floor = -1.0
        return Cutoffs(floor, fade, self.rasteriser.alpha_negligible * self.splats.count, pairs)

    def _colors(
        self, forms: PoseForms, camera_magnitude: np.ndarray, candidates: np.ndarray, alive: np.ndarray, n: int
    ) -> np.ndarray:
        """Return colours of the visible Gaussians: [n, 3], [n, 6] (centre, radius) or forms."""
        splats, varied = self.splats, self.varied
        if splats.degree == 0:
            if self._sums.plain_colors is not None:
                return self._sums.plain_colors if n == splats.count else self._sums.plain_colors[candidates]
            if n == splats.count:
                return np.ascontiguousarray(splats.sh[:, 0])
            return splats.sh[candidates, 0]
        # torch.inverse of the view matrix, of 1 + |T| (design.md, C3)
        position_error = self.charges.camera_position * (1.0 + float(camera_magnitude.sum()))
        if self.rasteriser.eye_from_view:
            position_error += _gram_deviation(forms) * float(camera_magnitude.sum())
        scene = SceneColors(
            varied.mean_middle, varied.mean_radius, varied.shift_low, varied.shift_high, splats.sh,
            self._sums.color_magnitudes, splats.degree,
        )  # fmt: skip
        position = forms.position
        if not np.any(position.linear) and float(position.radius.max()) < STILL_POSITION:
            position_error += 2.0 * float(position.radius.max())
            view = (*position.center.tolist(), position_error)
            cached = self._seen_from.get(thread_group())
            if cached is None or cached[0] != view:
                # of every Gaussian: cells that only turn the camera share them
                colors = self._buffer("colors", (splats.count, 6))
                fixed_colors(scene, position.center, position_error, self.charges, colors)
                cached = self._seen_from[thread_group()] = view, colors
            colors = cached[1]
            return colors if n == splats.count else gathered(colors, candidates, alive, self._buffer("some", (n, 6)))
        indices = np.empty((alive.size, 2), np.int64)
        indices[:, 0], indices[:, 1] = alive, candidates[alive]
        self._seen_from.pop(thread_group(), None)
        shape = form_shape(position.basis)
        colors = self._buffer("colors", (n, 3 * (shape.monomials + 1)))
        self.stages.moving_colors(
            indices, scene, position.data, forms.origin, position_error, self.charges, shape, colors
        )
        return colors


def _four_channels(colors: np.ndarray, depths: np.ndarray, alive: np.ndarray, m: int) -> np.ndarray:
    """Return [n, 4 (m + 1)] colours of any shape of `Colors.values`, and ``depths`` [k, m + 1] of rows ``alive``."""
    n = colors.shape[0]
    wide = np.zeros((n, 4, m + 1))
    columns = colors.shape[1] // 3
    parts = colors.reshape(n, 3, columns)
    if columns == m + 1:
        wide[:, :3] = parts
    else:
        wide[:, :3, 0] = parts[:, :, 0]
        if columns == 2:
            wide[:, :3, m] = parts[:, :, 1]
    wide[alive, 3] = depths
    return wide.reshape(n, 4 * (m + 1))


def _gram_deviation(forms: PoseForms) -> float:
    """Return the largest distance of R^T R from the identity (Frobenius norm), the same at every pose of a set (C4)."""
    matrix = forms.rotation.data[0].reshape(3, 3)
    radius = float(np.linalg.norm(forms.rotation.data[forms.rotation.basis.monomials]))
    middle = float(np.linalg.norm(matrix.T @ matrix - np.eye(3)))
    return (middle + 2.0 * float(np.linalg.norm(matrix)) * radius + radius * radius) * GRAM_UP + GRAM_ROOM


def _shifted_colors(varied: VariedSplats, charges: Charges) -> np.ndarray | None:
    """Return [N, 6] centre and radius by channel of view-independent colours (S4); None where none varies."""
    if not varied.shift_low.size:
        return None
    color, top = varied.stored.sh[:, 0], varied.stored.color_max
    low, high = (np.clip(color + end, 0.0, top) for end in (varied.shift_low, varied.shift_high))
    moved = (varied.shift_low != 0.0) | (varied.shift_high != 0.0)
    size = color + np.maximum(np.abs(varied.shift_low), np.abs(varied.shift_high))
    # one addition and the ends' own rounding
    radius = 0.5 * (high - low) + (charges.shifted_color + SHIFTED_ROUNDING) * size
    colors = np.stack([np.where(moved, 0.5 * (low + high), color), np.where(moved, radius, 0.0)], axis=-1)
    return np.ascontiguousarray(colors.reshape(-1, 6))
