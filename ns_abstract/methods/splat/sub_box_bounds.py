"""Bounds of a splat scene's pixels over many sub-boxes of one cell (design.md, B12, B14)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ns_abstract.arithmetic.rounding import CHANNEL_DIFFERENCE_ROUNDING, SUB_BOX_OVERLAP, UP
from ns_abstract.execution.threads import lane, threads
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.motion_cells import MotionCells
from ns_abstract.geometry.poses import PoseForms
from ns_abstract.geometry.tiles import laid_out, tile_grid
from ns_abstract.methods.splat.bounds import SplatBounds, divided_by
from ns_abstract.methods.splat.depth_range_pixels import depth_range_stage
from ns_abstract.methods.splat.lists import TileLists, pixel_sets, summed_area, tile_lists, tile_mask, touching
from ns_abstract.methods.splat.stage_data import (
    CellPoses,
    ColorEnds,
    Colors,
    FormShape,
    PixelInputs,
    ProjectedCell,
    ProjectedGaussians,
    strips_of,
)
from ns_abstract.refine.protocol import CHANNEL_DIFFERENCES, COLORS, FIRST_CHANNELS, SECOND_CHANNELS


class SubBoxBounds(SplatBounds):
    """`SplatBounds` with bounds over sub-boxes; takes the same arguments."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._latest: dict[int, tuple[ParameterBox, ProjectedCell] | None] = {}
        self._differences: dict[int, tuple[ProjectedCell, float] | None] = {}

    def _projected(
        self, candidates: np.ndarray, poses: CellPoses, camera: PinholeCamera, shape: FormShape
    ) -> tuple[ProjectedGaussians, np.ndarray]:
        # it takes the memory of the last one, of which the differences are
        self._latest[lane()] = self._differences[lane()] = None
        return super()._projected(candidates, poses, camera, shape)

    def projected_box(self, camera: PinholeCamera, forms: PoseForms, box: ParameterBox) -> ProjectedCell:
        """`project` all Gaussians over ``box`` with poses ``forms``, unless the lane's last projection was that."""
        latest = self._latest.get(lane())
        if latest is None or latest[0] != box:
            latest = self._latest[lane()] = box, self.project(camera, forms)
        return latest[1]

    def projected_differences(
        self, camera: PinholeCamera, forms: PoseForms, box: ParameterBox
    ) -> tuple[ProjectedCell, float]:
        """`channel_differences` of `projected_box`, unless the lane's last were that."""
        projected = self.projected_box(camera, forms, box)
        differences = self._differences.get(lane())
        if differences is None:
            differences = self._differences[lane()] = channel_differences(projected)
        return differences

    def warm_up(self, camera: PinholeCamera, forms: PoseForms, counts: np.ndarray) -> None:
        """Compile what `by_depth_ranges` needs; arguments are as of `sub_boxes`."""
        pixels = np.ones((1, self.side, self.side), bool)
        out, goals = np.empty((*pixels.shape, 6, int(counts.prod()))), np.full((pixels.size, 6), np.inf)
        self.by_depth_ranges(camera, forms, self.project(camera, forms), np.arange(1), pixels, counts, goals, out)

    def sub_boxes(
        self, camera: PinholeCamera, forms: PoseForms, projected: ProjectedCell, wanted: np.ndarray,
        pixels: np.ndarray, counts: np.ndarray | MotionCells, goals: np.ndarray | None = None,
    ) -> np.ndarray:  # fmt: skip
        """Bounds [t, side, side, 6, k] of ``pixels`` of the tiles ``wanted`` over sub-boxes (design.md, B12, B14).

        They are the least of the three channels, then the most. Ends that are no numbers bound nothing; what stands at
        other pixels means nothing.

        Args:
            camera, forms, wanted, pixels: As of `cell`.
            projected: What `project` returns of the cell.
            counts: [d] sub-boxes along the cell's axes, powers of two, at least `PART_LANES` together; or cells of the
                image motion in their place.
            goals: [n, 6] see `depth_range_stage`, for pixels whose depth orders are too many; None: none is wanted.
        """
        cell = self.cell(camera, forms, wanted, projected, pixels=pixels, parts=counts, keep_parts=True)
        out = cell.parts
        assert out is not None
        if goals is not None and cell.statistics[3]:
            unknown = (out[pixels][:, :3] == 0.0).all(axis=(1, 2)) & (out[pixels][:, 3:] == 1.0).all(axis=(1, 2))
            asked = np.where(unknown[:, None], goals, np.nan)
            self.by_depth_ranges(camera, forms, projected, wanted, pixels, counts, asked, out)
        return out

    def by_depth_ranges(
        self, camera: PinholeCamera, forms: PoseForms, projected: ProjectedCell, wanted: np.ndarray,
        pixels: np.ndarray, counts: np.ndarray | MotionCells, goals: np.ndarray, out: np.ndarray,
    ) -> None:  # fmt: skip
        """Write ends of the ``n`` pixels to ``out`` from the ranges of the Gaussians' depths (design.md, B14).

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
        chosen = np.zeros((across * down, self.side, self.side), bool)
        chosen[wanted] = pixels
        # a pixel's middle lies half a pixel behind its number; what is not a number leaves nothing out
        box, size = gaussians.box[alive], np.repeat([across, down], 2) * self.side
        reach = np.where(np.isnan(box), [0, np.inf] * 2, np.floor(box + [-0.5, 1.5] * 2)).clip(0, size).astype(np.int32)
        touched = touching(np.arange(alive.size), reach, summed_area(laid_out(chosen, across)))
        alive = alive[touched]
        order = alive[np.argsort(gaussians.depth[alive], kind="stable")]
        shown = tile_mask(wanted[pixels.any(axis=(1, 2))], across * down)
        lists = TileLists(wanted, *tile_lists(order, gaussians.tiles, shown, across))
        by_pixel = np.full((*pixels.shape, 6), np.nan)
        by_pixel[pixels] = goals
        depth_range_stage(
            lists, pixel_sets(~np.isnan(by_pixel).all(axis=-1), wanted.size, self.side), by_pixel, inputs,
            strips_of(inputs.parts), _color_ends(colors, alive, background), threads(), out,
        )  # fmt: skip


def channel_differences(projected: ProjectedCell) -> tuple[ProjectedCell, float]:
    """The cell with differences of channels for colours, in memory of its own, and their scale (design.md, B15).

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
    """The ends of rows ``alive`` of `Colors.values`."""
    parts = colors[alive].reshape(alive.size, 3, colors.shape[1] // 3)
    spread = np.abs(parts[..., 1:]).sum(axis=-1) * UP
    ends = np.concatenate([spread - parts[..., 0], spread + parts[..., 0]], axis=1).T
    values, behind = np.empty((6, len(colors))), np.concatenate([-background, background])
    values[:, alive] = ends
    # the other end of each row's colours, with its sign
    opposite = np.minimum(-ends.max(axis=1, initial=-np.inf)[[3, 4, 5, 0, 1, 2]], behind)
    bright = max(1.0, float(ends.max(initial=-np.inf)), float(np.abs(background).max()))
    return ColorEnds(values, behind, opposite, bright)


def part_ends(parts: np.ndarray | None, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds [n, 3, k] of the ``n`` chosen ``pixels`` [t, side, side] from `PixelBounds.parts`."""
    assert parts is not None
    ends = parts[pixels]
    lower, upper = ends[:, :COLORS], ends[:, COLORS:]
    # crossed or not a number: nothing is known
    sane = lower <= upper
    return np.where(sane, lower, 0.0).clip(0.0, 1.0), np.where(sane, upper, 1.0).clip(0.0, 1.0)


def difference_ends(parts: np.ndarray, pixels: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Bounds [n, 3, k] of `CHANNEL_DIFFERENCES`, from ``parts`` for those of the colours (design.md, B15)."""
    ends = parts[pixels]
    lower, upper = ends[:, :COLORS], ends[:, COLORS:]
    # [0, 1] stands for nothing that is known (design.md, B15)
    sane = (lower <= upper) & ~((lower == 0.0) & (upper == 1.0)) & (scale > 0.0)
    with np.errstate(all="ignore"):
        lower, upper = (
            (lower - 0.5 - CHANNEL_DIFFERENCE_ROUNDING) / scale,
            (upper - 0.5 + CHANNEL_DIFFERENCE_ROUNDING) / scale,
        )
    return np.where(sane, lower, -np.inf), np.where(sane, upper, np.inf)
