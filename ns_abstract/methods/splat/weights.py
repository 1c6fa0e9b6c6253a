"""Blending weights of selected Gaussians: pictures in which these are white, all others black (design.md, Q1, Q2).

A pixel of gsplat is a sum of colours, each times its Gaussian's weight. So a channel of such a picture is the sum of
the weights of the white Gaussians. Nothing else in the program depends on colours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ns_abstract.arithmetic.outward import outward
from ns_abstract.arithmetic.rounding import FRAGMENT_ROUNDING, Arithmetic
from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox, PoseForms
from ns_abstract.io.errors import InputError
from ns_abstract.methods.splat.activate import Splats
from ns_abstract.methods.splat.bounds import SceneSums
from ns_abstract.methods.splat.constants import Rasteriser
from ns_abstract.methods.splat.frame import SplatFrame, SplatSample, TileBounds, VisibleContext
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.methods.splat.scene import Float64Array, SplatScene
from ns_abstract.methods.splat.stage_data import CellPoses, SubBoxes
from ns_abstract.methods.splat.sub_box_bounds import SubBoxBounds, part_ends
from ns_abstract.methods.splat.variations import VariedSplats, selected
from ns_abstract.refine.protocol import MOST_PLANES, SceneSample, WeightPlane

if TYPE_CHECKING:
    import torch

    from ns_abstract.methods.splat.reference import Reference


def plane_mask(scene: SplatScene, opacity: Float64Array, plane: WeightPlane) -> np.ndarray:
    """Return [N] bool the Gaussians that the plane's selection picks. Raises InputError where it picks none."""
    if plane.select is None:
        return np.ones(scene.count, bool)
    try:
        mask = selected(scene, opacity, plane.select)
    except InputError as error:
        raise InputError(error.problem, field=f"select.{error.field}", fix=error.fix) from None
    if not mask.any():
        raise InputError(f"picks none of {scene.count} Gaussians", field="select", fix="widen the selection")
    return mask


@dataclass(frozen=True)
class WhiteGaussians:
    """The Gaussians that are white in each channel: those that are selected and nearer than a distance.

    Attributes:
        selected: [N, 3] bool.
        nearer: [3] depths of centres, normalised units; infinite: no limit.
    """

    selected: np.ndarray
    nearer: Float64Array

    @classmethod
    def of(cls, masks: Sequence[np.ndarray], nearer: Sequence[float | None]) -> WhiteGaussians:
        """Return one channel for each of at most three masks [N]; the other channels stay black."""
        black = [np.zeros_like(masks[0])] * (MOST_PLANES - len(masks))
        distances = [np.inf if distance is None else distance for distance in nearer]
        return cls(np.stack([*masks, *black], axis=1), np.array(distances + [np.inf] * len(black)))

    def at(self, depth: Float64Array) -> Float64Array:
        """Return colours [N, 3] of Gaussians at ``depth`` [N]."""
        if np.isinf(self.nearer).all():
            return self.selected.astype(np.float64)
        return (self.selected & ((depth[:, None] < self.nearer) | np.isinf(self.nearer))).astype(np.float64)

    def between(self, numbers: np.ndarray, low: Float64Array, high: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return bounds [k, 3] of the colours of Gaussians ``numbers`` [k] with depths in [low, high].

        A depth of NaN may be any.
        """
        chosen = self.selected[numbers]
        anywhere = np.isinf(self.nearer)
        surely, maybe = high[:, None] < self.nearer, ~(low[:, None] >= self.nearer)
        return (chosen & (surely | anywhere)).astype(np.float64), (chosen & (maybe | anywhere)).astype(np.float64)


class WeightBounds(SubBoxBounds):
    """Bounds of blending weights: `SubBoxBounds` with the colours of `WhiteGaussians`."""

    white: WhiteGaussians

    def _colors(
        self, forms: PoseForms, camera_magnitude: np.ndarray, candidates: np.ndarray, alive: np.ndarray, n: int
    ) -> np.ndarray:
        """Return [n, 6] centres and radii by channel (design.md, Q2)."""
        numbers = candidates[alive]
        if np.isinf(self.white.nearer).all():
            colors = np.zeros((n, 6))
            colors[alive, 0::2] = self.white.selected[numbers]
            return colors
        low, high = self.white.between(numbers, *self._camera_depth_bounds(forms, camera_magnitude, candidates, alive))
        colors = np.zeros((n, 6))
        colors[alive, 0::2], colors[alive, 1::2] = 0.5 * (low + high), 0.5 * (high - low)
        return colors

    def _camera_depth_bounds(
        self, forms: PoseForms, camera_magnitude: np.ndarray, candidates: np.ndarray, alive: np.ndarray
    ) -> tuple[Float64Array, Float64Array]:
        """Return bounds [k] of the depths of candidates ``alive`` over the cell, in every evaluation of the program."""
        m = forms.rotation.basis.monomials
        low, high = forms.rotation.bounds()
        most = np.maximum(np.abs(low), np.abs(high)).ravel()
        poses = CellPoses(forms.rotation.data, forms.offset.data, forms.origin, camera_magnitude, most)
        away = np.zeros((candidates.size, 3))
        away[alive] = self.varied.mean_middle[candidates[alive]] - forms.origin
        depths = self._depths(poses, candidates, alive, away, m) + forms.offset.data[: m + 1, 2]
        # every monomial lies in [-1, 1]
        center, reach = depths[:, 0], np.abs(depths[:, 1:]).sum(axis=1)
        reach = reach + FRAGMENT_ROUNDING * (np.abs(center) + reach)
        return center - reach, center + reach


class SplatWeightFrame(SplatFrame):
    """A frame of blending weights; see `ns_abstract.refine.protocol.WeightFrame`.

    Args:
        white: The white Gaussians.
        rasteriser, arithmetic, pose_set, varied, sums, reference: As in `SplatFrame`.
    """

    def __init__(
        self,
        white: WhiteGaussians,
        splats: Splats,
        rasteriser: Rasteriser,
        arithmetic: Arithmetic,
        pose_set: PoseBox,
        varied: VariedSplats,
        sums: SceneSums,
        reference: Callable[[], Reference],
    ) -> None:
        self.white, self._renders = white, reference
        # no colour of the scene's, none of its shifts and no background is left
        black = replace(
            splats, sh=np.zeros((splats.count, 1, 3)), degree=0, background=np.zeros(3), color_shift=np.empty((0, 3))
        )
        super().__init__(black, rasteriser, arithmetic, pose_set, varied=varied, sums=sums)
        self.bounds = WeightBounds(black, rasteriser, arithmetic, varied, sums)
        self.bounds.white = white
        self._black, self._rasteriser = black, rasteriser

    def precise(
        self, values: np.ndarray, tiles: np.ndarray | None = None, scene_sample: Splats | None = None
    ) -> np.ndarray:
        """Return float64 tiles of the weights at parameter values [d], before the rounding of `drawn`."""
        rotation, position = self.pose_set.world_to_camera(values)
        scene = self.varied.nearest if scene_sample is None else scene_sample
        colors = self.white.at((scene.means - position) @ rotation[2])
        weighted = replace(self._black, means=scene.means, opacity=scene.opacity, sh=colors[:, None])
        return self.renderer.tiles(self.camera, rotation, position, tiles, weighted)

    def of_sample(self, values: np.ndarray, sample: SceneSample | None) -> np.ndarray:
        """Return the tiles of weights at a pose, of the stored scene or of ``sample``."""
        if sample is None:
            return self.render(values)
        assert isinstance(sample, SplatSample)
        return self.drawn(values, None, sample.splats)

    def drawn_alone(
        self, context: VisibleContext, tiles: np.ndarray, pixels: np.ndarray
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Return a function that renders ``tiles`` from the Gaussians visible there alone; see `ElementFrame`."""
        some = self.candidates(tiles, context, pixels)
        assert some is not None
        some = np.sort(some)
        scene = self.varied.nearest
        drawn = replace(
            self._black, means=scene.means[some], axes=scene.axes[some], opacity=scene.opacity[some],
            sh=self._black.sh[some],
        )  # fmt: skip
        white = WhiteGaussians(self.white.selected[some], self.white.nearer)
        renderer = Renderer(drawn, self._rasteriser)

        def draw(values: np.ndarray) -> np.ndarray:
            check_cancelled()
            rotation, position = self.pose_set.world_to_camera(values)
            colors = white.at((drawn.means - position) @ rotation[2])
            scene_sample = replace(drawn, sh=colors[:, None])
            return renderer.tiles(self.camera, rotation, position, tiles, scene_sample, pixels).astype(np.float32)

        return draw

    def bound_sub_boxes(
        self, box: ParameterBox, tiles: np.ndarray, within: VisibleContext, pixels: np.ndarray, counts: np.ndarray,
        levels: Sequence[float],
    ) -> tuple[TileBounds, tuple[np.ndarray, np.ndarray]]:  # fmt: skip
        """Return bounds of one box with linear bounds, and over its sub-boxes (design.md, B13); see `ElementFrame`."""
        candidates = self.candidates(tiles, within, pixels)
        bounds = self._bound(box, tiles, within, candidates, True, pixels, SubBoxes(counts, tuple(levels)))
        assert bounds.parts is not None
        return bounds, outward(*part_ends(bounds.parts[pixels]))

    def differentiable(self, values: torch.Tensor) -> torch.Tensor:
        """Return weights [H, W, 3] at parameter values [d] by the reference renderer, differentiable in them."""
        import torch

        from ns_abstract.geometry.differentiable_pose import differentiable_pose

        rotation, position = self.pose_set.world_to_camera(values.detach().numpy())
        colors = self.white.at((self.varied.nearest.means - position) @ rotation[2])
        pose = differentiable_pose(self.pose_set)(values)
        return self._renders().recolored(torch.from_numpy(colors)).image(self.camera, pose)
