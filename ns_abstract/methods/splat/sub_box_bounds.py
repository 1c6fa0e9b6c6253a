"""Bounds of a splat scene's pixels over many sub-boxes of one cell (design.md, B14)."""

from __future__ import annotations

import numpy as np

from ns_abstract.arithmetic.rounding import CHANNEL_DIFFERENCE_ROUNDING, SUB_BOX_OVERLAP, UP
from ns_abstract.execution.threads import threads
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.motion_cells import MotionCells
from ns_abstract.geometry.poses import PoseForms
from ns_abstract.geometry.tiles import tile_grid
from ns_abstract.methods.splat.bounds import SplatBounds, divided_by
from ns_abstract.methods.splat.depth_range_pixels import depth_range_stage
from ns_abstract.methods.splat.lists import TileLists, pixel_sets, tile_lists, tile_mask
from ns_abstract.methods.splat.stage_data import (
    ColorEnds,
    Colors,
    PixelInputs,
    ProjectedCell,
    strips_of,
)
from ns_abstract.refine.protocol import CHANNEL_DIFFERENCES, COLORS, FIRST_CHANNELS, SECOND_CHANNELS

#: Lower and upper bounds of three channels where nothing is known.
_NOTHING = np.repeat([0.0, 1.0], COLORS)[:, None]


class SubBoxBounds(SplatBounds):
    """`SplatBounds` with bounds over sub-boxes; takes the same arguments."""

    def warm_up(self, camera: PinholeCamera, forms: PoseForms, counts: np.ndarray) -> None:
        """Compile the kernels of `by_depth_ranges`, whose arguments these are."""
        pixels = np.ones((1, self.side, self.side), bool)
        goals = np.full((pixels.size, 6), np.inf)
        self.by_depth_ranges(camera, forms, self.project(camera, forms), np.arange(1), pixels, counts, goals)

    def sub_boxes(
        self, camera: PinholeCamera, forms: PoseForms, projected: ProjectedCell, wanted: np.ndarray,
        pixels: np.ndarray, counts: np.ndarray | MotionCells, goals: np.ndarray, crowded: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """Return bounds [n, 6, k] of the ``n`` ``pixels`` of the tiles ``wanted`` over sub-boxes (design.md, B12, B14).

        They are the least of the three channels, then the largest; 0 and 1 where none is known or needed.

        Args:
            camera, forms, wanted, pixels: As of `cell`.
            projected: The result of `project` for the cell, at least of the Gaussians that may be visible on
                ``pixels``.
            counts: [d] sub-boxes along the cell's axes, powers of two, at least `PART_LANES` together; or cells of the
                image motion in their place.
            goals: [n, 6] see `depth_range_stage`.
            crowded: [n] the pixels with too many pairs of open order: ranges of depths bound these.
        """
        shape, _ = divided_by(forms.rotation.basis, counts, SUB_BOX_OVERLAP)
        ends, unknown = np.empty((len(goals), 6, shape.parts)), crowded
        if not crowded.all():
            unknown, some = crowded.copy(), pixels.copy()
            some[pixels] = ~crowded
            cell = self.cell(camera, forms, wanted, projected, pixels=some, parts=counts, keep_parts=True)
            assert cell.parts is not None
            ordered = cell.parts[some]
            unknown[~crowded] = (ordered == _NOTHING).all(axis=(1, 2))
            ends[~crowded] = ordered
        if unknown.any():
            some = pixels.copy()
            some[pixels] = unknown
            ends[unknown] = self.by_depth_ranges(camera, forms, projected, wanted, some, counts, goals[unknown])
        return ends

    def by_depth_ranges(
        self, camera: PinholeCamera, forms: PoseForms, projected: ProjectedCell, wanted: np.ndarray,
        pixels: np.ndarray, counts: np.ndarray | MotionCells, goals: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """Return bounds [n, 6, k] of the ``n`` ``pixels`` from the ranges of the Gaussians' depths (design.md, B14).

        Arguments are those of `sub_boxes`.
        """
        across, down = tile_grid(camera, self.side)
        shape, parts = divided_by(forms.rotation.basis, counts, SUB_BOX_OVERLAP)
        _, poses, gaussians, alive, colors, background, color_error = projected
        inputs = PixelInputs(
            gaussians, self._viewing_axes(forms, poses.rotation_magnitude, gaussians), camera.intrinsics,
            Colors(colors, background, color_error, 3, np.zeros(shape.monomials + 1)),
            self.rules, self.charges, self._cutoffs(-1.0, 1), shape, parts,
        )  # fmt: skip
        order = alive[np.argsort(gaussians.depth[alive], kind="stable")]
        shown = tile_mask(wanted[pixels.any(axis=(1, 2))], across * down)
        lists = TileLists(wanted, *tile_lists(order, gaussians.tiles, shown, across))
        by_pixel = np.full((*pixels.shape, 6), np.nan)
        by_pixel[pixels] = goals
        # memory is taken where it is written: for the pixels that are wanted
        out = np.empty((*pixels.shape, 6, shape.parts))
        out[pixels] = _NOTHING
        depth_range_stage(
            lists, pixel_sets(~np.isnan(by_pixel).all(axis=-1), wanted.size, self.side), by_pixel, inputs,
            strips_of(inputs.parts), _color_ends(colors, alive, background), threads(), out,
        )  # fmt: skip
        return out[pixels]


def channel_differences(projected: ProjectedCell) -> tuple[ProjectedCell, float]:
    """Return the cell with differences of channels as colours, in memory of its own, and their scale (B15).

    The three channels are ``1/2 + scale * (first - second)`` for the pairs of `CHANNEL_DIFFERENCES`. The scale keeps
    them in [0, 1]; it is 0 where colours have no finite bound.
    """
    alive, background = projected.alive, projected.background
    columns = projected.colors.shape[1] // 3
    forms = projected.colors[alive].reshape(alive.size, 3, columns)
    sizes = np.abs(forms).sum(axis=-1)
    brightest = sizes.max(initial=max(1.0, float(np.abs(background).max()))) * UP
    if not np.isfinite(brightest):
        return projected, 0.0
    scale = 0.5 / float(brightest)
    # the sizes are at most 1/2 with the scale
    forms *= scale
    differences = np.empty_like(forms)
    for k, (first, second) in enumerate(CHANNEL_DIFFERENCES):
        np.subtract(forms[:, first], forms[:, second], out=differences[:, k])
        if columns > 1:
            differences[:, k, -1] = (forms[:, first, -1] + forms[:, second, -1]) * UP + CHANNEL_DIFFERENCE_ROUNDING
    differences[..., 0] += 0.5
    colors = np.empty_like(projected.colors)
    colors[alive] = differences.reshape(alive.size, 3 * columns)
    behind = background[FIRST_CHANNELS] - background[SECOND_CHANNELS]
    return projected._replace(
        colors=colors,
        background=scale * behind + 0.5,
        color_error=projected.color_error + CHANNEL_DIFFERENCE_ROUNDING,
    ), scale


def _color_ends(colors: np.ndarray, alive: np.ndarray, background: np.ndarray) -> ColorEnds:
    """Return the ends of the rows ``alive`` of `Colors.values`."""
    parts = colors[alive].reshape(alive.size, 3, colors.shape[1] // 3)
    spread = np.abs(parts[..., 1:]).sum(axis=-1) * UP
    ends = np.concatenate([spread - parts[..., 0], spread + parts[..., 0]], axis=1).T
    values, behind = np.empty((6, len(colors))), np.concatenate([-background, background])
    values[:, alive] = ends
    # the other end of each row's colours, with its sign
    opposite = np.minimum(-ends.max(axis=1, initial=-np.inf)[[3, 4, 5, 0, 1, 2]], behind)
    bright = max(1.0, float(ends.max(initial=-np.inf)), float(np.abs(background).max()))
    return ColorEnds(values, behind, opposite, bright)


def part_ends(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper bounds [n, 3, k] of the colours from the result of `SubBoxBounds.sub_boxes`."""
    lower, upper = ends[:, :COLORS], ends[:, COLORS:]
    # crossed or not a number: nothing is known
    sane = lower <= upper
    return np.where(sane, lower, 0.0).clip(0.0, 1.0), np.where(sane, upper, 1.0).clip(0.0, 1.0)


def difference_ends(ends: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds [n, 3, k] of `CHANNEL_DIFFERENCES`, from ``ends`` of the scaled colours (design.md, B15)."""
    lower, upper = ends[:, :COLORS], ends[:, COLORS:]
    # [0, 1] stands for nothing that is known (design.md, B15)
    sane = (lower <= upper) & ~((lower == 0.0) & (upper == 1.0)) & (scale > 0.0)
    with np.errstate(all="ignore"):
        lower, upper = (
            (lower - 0.5 - CHANNEL_DIFFERENCE_ROUNDING) / scale,
            (upper - 0.5 + CHANNEL_DIFFERENCE_ROUNDING) / scale,
        )
    return np.where(sane, lower, -np.inf), np.where(sane, upper, np.inf)
