"""One frame of a splat scene, ready for refinement: bounds, renders and image motion of its pose set."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ns_abstract.arithmetic.outward import outward
from ns_abstract.arithmetic.rounding import LINEAR_ROUNDING, LINEAR_UP, Arithmetic
from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.execution.threads import each
from ns_abstract.geometry.box import ParameterBox, shared_out
from ns_abstract.geometry.enclosing_boxes import EnclosingBoxes
from ns_abstract.geometry.motion_cells import MotionCells, MotionField
from ns_abstract.geometry.poses import PoseBox, translation_only
from ns_abstract.geometry.tiles import in_tiles, laid_out, tile_grid
from ns_abstract.methods.splat.activate import Splats
from ns_abstract.methods.splat.bounds import SceneSums, Stages
from ns_abstract.methods.splat.constants import Rasteriser
from ns_abstract.methods.splat.depths import ACCUMULATION_HIGH, ACCUMULATION_LOW, DEPTH_HIGH, DEPTH_LOW
from ns_abstract.methods.splat.enclosing_cells import EnclosingContext, VisibleContext
from ns_abstract.methods.splat.image_motion import ImageMotion
from ns_abstract.methods.splat.lists import rectangles_by_place, summed_area, touching, visible_again
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.methods.splat.stage_data import SubBoxes
from ns_abstract.methods.splat.sub_box_bounds import SubBoxBounds, channel_differences, difference_ends, part_ends
from ns_abstract.methods.splat.variations import VariedSplats
from ns_abstract.refine.protocol import COLORS, Bounds, Frame, LinearSets, Score, SharedOrder

if TYPE_CHECKING:
    from ns_abstract.methods.splat.reference import Reference


@dataclass(frozen=True)
class FrameTuning:
    """Preferences of splats' frames; soundness does not depend on them."""

    #: Light that is not followed further: the part of the excess that may be allowed, and at most, and no less than
    #: so many times the rasteriser's stop.
    floor_share: float = 0.2
    brightest_floor: float = 2.0**-7
    worth_it: float = 1.5
    #: Where typical Gaussians move by more pixels, a cell is bounded over so many parts, not by forms (B12).
    wide: float = 0.35
    parts: int = 32
    #: More Gaussians over a pixel than that of a cell with parts: ranges of depths tell as much as pairs of uncertain
    #: order, in less time, and most blocks have too many of these.
    crowded: int = 1000
    #: A context that is larger than this part of the one around it is not kept beside it.
    worth_keeping: float = 0.8


_TUNING = FrameTuning()


@dataclass(frozen=True)
class TileBounds(Bounds):
    """Bounds of some tiles.

    Attributes:
        trivial: Number of blocks of pixels with too many open depth orders, of which nothing is known.
        parts: [t, side, side, 6, k] see `PixelBounds.parts`; None: the cell has no sub-boxes.
    """

    context: VisibleContext
    trivial: int = 0
    parts: np.ndarray | None = None


@dataclass(frozen=True)
class SplatSample:
    """A scene of a frame's set; see `ns_abstract.refine.protocol.SceneSample`.

    Attributes:
        frame: The frame.
        splats: The scene.
        reference: Makes the renderer with gradients.
    """

    frame: SplatFrame
    splats: Splats = field(repr=False)
    reference: Callable[[], Reference] | None = field(repr=False)

    def __call__(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        return self.frame.drawn(values, tiles, self.splats)

    def signed_gradient_step(
        self, box: ParameterBox, values: np.ndarray, score: Score, size: float
    ) -> tuple[np.ndarray, SplatSample]:
        from ns_abstract.methods.splat.signed_steps import signed_gradient_step

        frame = self.frame
        if self.reference is None:
            return values, self
        values, splats = signed_gradient_step(
            self.reference(), frame.pose_set, frame.varied, box, np.asarray(values, np.float64), self.splats,
            lambda show, pose: score(show(None), pose), size,
        )  # fmt: skip
        return values, SplatSample(frame, splats, self.reference)

    @property
    def nearest(self) -> SplatSample:
        return SplatSample(self.frame, self.frame.varied.nearest, self.reference)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        counts, splats = self.frame.varied.counts, self.splats
        arrays = {"mean": splats.means, "opacity": splats.opacity, "color": splats.color_shift}
        return {name: array for name, array in arrays.items() if counts[name]}


class SplatFrame(Frame):
    """Bounds and renders one frame's pose set.

    Args:
        splats: The activated scene.
        rasteriser, arithmetic: Of the bounded program.
        pose_set: The poses.
        order: Order of the forms: 1, or 2 for one parameter, which is the default for it.
        varied: The scenes of the set; None: ``splats`` alone.
        sheared: Whether cells may be sheared, so that rotations compensate the motion by other parameters (P2). Their
            parameters are then not those of ``pose_set``.
        layers: Whether accumulation and expected depth follow the colours, in renders and bounds.
        reference: Makes the renderer with gradients, for steps of `scene_samples`.
        sums: See `SubBoxBounds`.
    """

    #: What tiles share is most of the work: every call bounds as many as it is given.
    tilewise = False
    tiles_at_once: int | None = None
    stages = (*Stages._fields, "render")
    #: Poses rendered in every part of a cell that is split.
    witnesses = 1

    def __init__(
        self,
        splats: Splats,
        rasteriser: Rasteriser,
        arithmetic: Arithmetic,
        pose_set: PoseBox,
        order: int | None = None,
        varied: VariedSplats | None = None,
        sheared: bool = False,
        layers: bool = False,
        reference: Callable[[], Reference] | None = None,
        sums: SceneSums | None = None,
    ) -> None:
        self.channels = 5 if layers else COLORS
        self.pose_set = pose_set
        self.camera = pose_set.camera
        self.box = pose_set.box
        self.order = order or (2 if self.box.dimensions == 1 else 1)
        self._reference = reference
        self.bounds = SubBoxBounds(splats, rasteriser, arithmetic, varied, sums)
        self.varied = self.bounds.varied
        self.renderer = Renderer(self.varied.nearest, rasteriser)
        self.side = rasteriser.work_tile
        self._stop = rasteriser.transmittance_min
        self._floor = -1.0
        self.across, self.down = tile_grid(self.camera, self.side)
        self._image_motion = ImageMotion(pose_set, splats.means, self.renderer)
        if sheared and (shear := self._image_motion.shear()):
            self.pose_set = pose_set.sheared(shear)
            self.box = self.pose_set.box
            self._image_motion = ImageMotion(self.pose_set, splats.means, self.renderer)
        self._enclosing = EnclosingBoxes(self.box, self.motion, self._context)

    def warm_up(self, stage: str | None = None) -> None:
        """Compile the kernels that this frame needs, or those of one of `stages`."""
        box = self._narrow
        if stage is None:
            self.bound(box, np.arange(1))
        elif stage != "render":
            whole, self.bounds.stages = self.bounds.stages, self.bounds.stages.alone(stage)
            try:
                self.bound(box, np.arange(1))
            finally:
                self.bounds.stages = whole
        if stage in (None, "render"):
            self.render(box.middle)

    @property
    def _narrow(self) -> ParameterBox:
        """Return a narrow cell at the set's lower ends."""
        box = self.box
        for axis in range(box.dimensions):
            box = box.split(axis, 1024)[0]
        return box

    def warm_up_sub_boxes(self) -> None:
        """Compile the kernels that `sub_box_ends` needs besides the frame's own."""
        if self.box.dimensions > 1:
            forms = self.pose_set.enclosure(self._narrow, self.order)
            self.bounds.warm_up(self.camera, forms, shared_out(np.ones(self.box.dimensions), _TUNING.parts))

    def render(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        """Return tiles [t, side, side, channels] float32 of the image at parameter values [d]."""
        check_cancelled()
        return self.drawn(values, tiles, None)

    def drawn(self, values: np.ndarray, tiles: np.ndarray | None, scene_sample: Splats | None) -> np.ndarray:
        """Return the result of `render`, for another scene of the set if one is given."""
        return self.precise(values, tiles, scene_sample).astype(np.float32)

    def precise(
        self, values: np.ndarray, tiles: np.ndarray | None = None, scene_sample: Splats | None = None
    ) -> np.ndarray:
        """Return the result of `drawn` before rounding: float64."""
        draw = self.renderer.tiles if self.channels == COLORS else self.renderer.layer_tiles
        return draw(self.camera, *self.pose_set.world_to_camera(values), tiles, scene_sample)

    def scene_samples(self, seed: int) -> Iterator[SplatSample]:
        """Yield other scenes of the set without end; none where nothing varies."""
        if self.varied.varies:
            for splats in self.varied.scene_samples(np.random.default_rng(seed)):
                yield SplatSample(self, splats, self._reference)

    def set_tolerance(self, excess: float) -> float:
        """Let later bounds be looser by a small fraction of ``excess`` on average, where that saves time (B6).

        Returns:
            The light up to which fragments are left out; 0: none are.
        """
        floor = min(_TUNING.floor_share * excess, _TUNING.brightest_floor)
        self._floor = floor if floor > _TUNING.worth_it * self._stop > 0.0 else -1.0
        return max(self._floor, 0.0)

    def plan(self, visible: int | None, lower: np.ndarray, upper: np.ndarray) -> list[str]:
        """Return sentences on what was left out for this frame, given the bounds of refinement."""
        varied = self.varied
        total, plan = varied.nearest.count, []
        unknown = ~in_tiles((lower > 0.0) | (upper < 1.0), self.side).any(axis=(1, 2, 3))
        if unknown.any():
            plan.append(f"nothing is known of {unknown.sum():,} of {unknown.size:,} tiles: they are left at [0, 1]")
        if visible is not None and visible < total:
            plan.append(
                f"{total - visible:,} of {total:,} Gaussians left out: no pose of the set shows them "
                "(behind, beside, hidden by others or below the alpha threshold)"
            )
        for quantity, name in (("mean", "mean"), ("opacity", "opacity"), ("color", "colour")):
            if count := varied.counts[quantity]:
                plan.append(f"scene variations: the {name} of {count:,} of {total:,} Gaussians varies")
            elif varied.varies:
                plan.append(f"ranges of the {name} left out: none varies")
        if not varied.counts["mean"] and translation_only(self.pose_set.enclosure(self.box, 1)):
            plan.append("depth-order rules left out but for near-ties: translations never change the order")
        return plan

    def shared_order(self, other: Frame) -> SharedOrder | None:
        from ns_abstract.methods.splat.shared_order import shared_order

        return shared_order(self, other) if isinstance(other, SplatFrame) else None

    def feasible(self, box: ParameterBox) -> ParameterBox | None:
        return self.pose_set.feasible(box)

    def bound(
        self, box: ParameterBox, tiles: np.ndarray, within: VisibleContext | None = None, keep_linear: bool = False,
        pixels: np.ndarray | None = None,
    ) -> TileBounds:  # fmt: skip
        """Return bounds of ``tiles`` over ``box``, reusing the context ``within``; with ``pixels``, of these alone."""
        return self._bound(box, tiles, within, self.candidates(tiles, within, pixels), keep_linear, pixels)

    def bound_parts(
        self, boxes: Sequence[ParameterBox], tiles: np.ndarray, within: VisibleContext | None, keep_linear: bool,
        pixels: np.ndarray | None,
    ) -> list[TileBounds]:  # fmt: skip
        candidates = self.candidates(tiles, within, pixels)
        return each(lambda box: self._bound(box, tiles, within, candidates, keep_linear, pixels), boxes)

    def sub_box_ends(
        self, box: ParameterBox, counts: np.ndarray | MotionCells, tiles: np.ndarray, pixels: np.ndarray,
        goals: np.ndarray, differences: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray] | None:  # fmt: skip
        """Return lower and upper bounds [n, 3, k] of n pixels over k sub-boxes, or None (design.md, U5, B14, B15)."""
        if box.dimensions < 2:
            return None
        check_cancelled()
        forms = self.pose_set.enclosure(box, self.order)
        projected = self.bounds.project(self.camera, forms, self.candidates(tiles, self.enclosing(box), pixels))
        crowded = in_tiles(self.element_counts(box), self.side)[tiles][pixels] > _TUNING.crowded
        ends: list[tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]] = []
        for chosen in (~differences, differences):
            if not chosen.any():
                continue
            some, scale = pixels.copy(), 1.0
            some[pixels], wanted = chosen, goals[chosen]
            if chosen is differences:
                projected, scale = channel_differences(projected)
                wanted = 0.5 + scale * wanted
            bounds = self.bounds.sub_boxes(self.camera, forms, projected, tiles, some, counts, wanted, crowded[chosen])
            ends.append((chosen, difference_ends(bounds, scale) if chosen is differences else part_ends(bounds)))
        lower, upper = (np.empty((len(goals), *ends[0][1][0].shape[1:])) for _ in range(2))
        for chosen, (low, high) in ends:
            lower[chosen], upper[chosen] = low, high
        return lower, upper

    def motion_field(self, box: ParameterBox) -> MotionField:
        """Return the estimated motion of the picture's blocks over a cell of poses (design.md, B16)."""
        return MotionField(self._image_motion.of_squares(box), self._image_motion.side)

    def parallax(self, box: ParameterBox) -> np.ndarray:
        """Return pixels [d] by which typical Gaussians move over each parameter's range relative to their block."""
        return self._image_motion.parallax(box)

    def enclosing(self, box: ParameterBox) -> EnclosingContext | None:
        """Return the context of a wider cell around ``box``, for `bound`; None: there is none."""
        return self._enclosing.around(box)

    def element_counts(self, box: ParameterBox) -> np.ndarray:
        """Return the estimated number [H, W] of Gaussians that bounds of each pixel over a cell look at."""
        context = self.enclosing(box)
        return np.zeros((self.camera.height, self.camera.width), np.int64) if context is None else context.counts

    def _context(self, box: ParameterBox) -> EnclosingContext:
        """Return the Gaussians that a cell may show."""
        projected = self.bounds.project(self.camera, self.pose_set.enclosure(box, self.order))
        marks = np.zeros(projected.candidates.size, np.uint8)
        marks[projected.alive] = 1
        gaussians = projected.gaussians
        visible, reach = visible_again(marks, projected.candidates, gaussians.box, gaussians.tiles, self.side)
        return EnclosingContext(visible, reach, rectangles_by_place(reach, self.camera.height, self.camera.width))

    def motion(self, box: ParameterBox) -> np.ndarray:
        """Return the estimated motion [d] in pixels of typical Gaussians over each parameter's range."""
        return self._image_motion.typical(box)

    def depths(self) -> np.ndarray:
        """Return depths [n] of typical Gaussians in the picture of the middle pose."""
        return self._image_motion.depths()

    def _bound(
        self, box: ParameterBox, tiles: np.ndarray, within: VisibleContext | None, candidates: np.ndarray | None,
        keep_linear: bool, pixels: np.ndarray | None, sub_boxes: SubBoxes | None = None,
    ) -> TileBounds:  # fmt: skip
        """Return `bound`, given the candidates; with ``sub_boxes`` bounds over these, too."""
        check_cancelled()
        forms = self.pose_set.enclosure(box, self.order)
        layers = self.channels > COLORS
        parts = None if keep_linear or layers else self._parts(box)
        cell = self.bounds.cell(
            self.camera, forms, tiles, candidates, keep_linear, self._floor, layers, pixels, parts, sub_boxes=sub_boxes
        )
        lower, upper = cell.lower, cell.upper
        if cell.layers is not None:
            low, high = (
                cell.layers[..., [a, b]] for a, b in ((ACCUMULATION_LOW, DEPTH_LOW), (ACCUMULATION_HIGH, DEPTH_HIGH))
            )
            lower, upper = np.concatenate([lower, low], axis=-1), np.concatenate([upper, high], axis=-1)
        lower, upper = outward(lower, upper)
        # hardly smaller: not worth its memory
        hands_on = within is not None and cell.visible.size > _TUNING.worth_keeping * within.visible.size
        context = within if within is not None and hands_on else VisibleContext(cell.visible, cell.reach)
        linear = None
        if keep_linear:
            assert cell.linear is not None
            linear = linear_sets(cell.linear, cell.lower, cell.upper, box.dimensions)
        slopes = cell.slopes if parts is None else self._all_slopes(box, cell.slopes, parts)
        return TileBounds(lower, upper, slopes, context, linear, cell.linear, int(cell.statistics[3]), cell.parts)

    @cached_property
    def _pace(self) -> np.ndarray:
        """Motion [d] in pixels of typical Gaussians for each unit of a parameter; 0 where none moves."""
        width = np.array(self.box.upper) - np.array(self.box.lower)
        moved = np.nan_to_num(np.array(self.motion(self.box), np.float64), nan=0.0, posinf=0.0)
        return moved / np.where(width > 0.0, width, np.inf)

    def _moved(self, box: ParameterBox) -> np.ndarray:
        """Return the motion [d] in pixels of typical Gaussians over a cell along each axis."""
        return self._pace * (np.array(box.upper) - np.array(box.lower))

    def _parts(self, box: ParameterBox) -> np.ndarray | None:
        """Return numbers of parts [d] along the axes of a cell that is too wide for forms (B12); None: it is not.

        Forms of one parameter follow much more motion, and colours that vary with a parameter need forms.
        """
        moved = self._moved(box)
        if box.dimensions < 2 or not np.all(self._pace > 0.0) or np.linalg.norm(moved) <= _TUNING.wide:
            return None
        return shared_out(moved, _TUNING.parts)

    def _all_slopes(self, box: ParameterBox, slopes: np.ndarray, parts: np.ndarray) -> np.ndarray:
        """Return ``slopes`` [d] found over ``parts``, estimated from the motion for axes that are not divided."""
        moved = self._moved(box)
        rate = slopes[parts > 1].sum() / moved[parts > 1].sum()
        return np.where(parts > 1, slopes, rate * moved)

    def candidates(
        self, tiles: np.ndarray, within: VisibleContext | None, pixels: np.ndarray | None
    ) -> np.ndarray | None:
        """Return the Gaussians that may be visible on ``pixels`` in a cell ``within`` another; None: all."""
        if within is None:
            return None
        if tiles.size == self.tile_count and pixels is None:
            return within.visible
        chosen = np.zeros((self.tile_count, self.side, self.side), bool)
        chosen[tiles] = True if pixels is None else pixels
        table = summed_area(laid_out(chosen, self.across))
        return within.visible[touching(np.arange(within.visible.size), within.reach, table)]


def linear_sets(forms: np.ndarray, lower: np.ndarray, upper: np.ndarray, d: int) -> LinearSets:
    """Return linear lower and upper bounds of clamped pixels from their forms (design.md, B9).

    Args:
        forms: [..., m + 1] polynomial coefficients and radius before the clamp to [0, 1].
        lower, upper: [...] bounds of the clamped values.
        d: Number of parameters.

    Returns:
        A_lower [..., d], b_lower [...], A_upper, b_upper, float32, rounded outward.
    """
    slope = forms[..., 1 : 1 + d]
    steep = np.abs(slope).sum(axis=-1)
    radius = forms[..., -1] * LINEAR_UP
    sink, rise = -radius, radius.copy()
    row = 1 + d
    if forms.shape[-1] > d + 2:
        for k in range(d):
            for l in range(k, d):
                c = forms[..., row]
                # p_k^2 lies in [0, 1], p_k p_l in [-1, 1]
                sink += np.minimum(c, 0.0) if k == l else -np.abs(c)
                rise += np.maximum(c, 0.0) if k == l else np.abs(c)
                row += 1
    center = forms[..., 0]
    # rounding of the sums above and of the slopes to float32
    a = slope.astype(np.float32)
    slack = np.abs(a.astype(np.float64) - slope).sum(axis=-1) + LINEAR_ROUNDING * (np.abs(center) + steep + rise - sink)
    b_lower, b_upper = center + sink - slack, center + rise + slack
    # the clamp lowers values above 1 and raises values below 0
    b_lower = b_lower - np.maximum(0.0, b_upper + steep - 1.0)
    b_upper = b_upper + np.maximum(0.0, steep - (center + sink - slack))
    flat_lower, flat_upper = ~(b_lower >= lower), ~(b_upper <= upper)
    A_lower, A_upper = a.copy(), a.copy()
    A_lower[flat_lower], A_upper[flat_upper] = 0.0, 0.0
    low, high = outward(np.where(flat_lower, lower, b_lower), np.where(flat_upper, upper, b_upper))
    return A_lower, low, A_upper, high
