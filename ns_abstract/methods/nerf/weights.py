"""Frames of blending weights of a NeRF's samples; see `ns_abstract.refine.protocol.WeightFrame`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.differentiable_pose import differentiable_pose
from ns_abstract.geometry.poses import COLOR_SHIFTS, PoseBox
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf.bounds import NerfBounds
from ns_abstract.methods.nerf.frame import NerfFrame, RayCellBounds
from ns_abstract.methods.nerf.render import NerfRenderer, Sampling
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.nerf.white import WhiteSamples
from ns_abstract.refine.protocol import MOST_PLANES, SceneSample, WeightPlane


def white_samples(planes: Sequence[WeightPlane], sampling: Sampling) -> WhiteSamples:
    """Return which samples the planes choose.

    Raises:
        InputError: A selection is one of Gaussians, or the samples' places depend on the picture.
    """
    if sampling.kind != "uniform":
        raise InputError(
            "weights are bounded of uniform samples", field="--sampling", fix="use uniform, or a property of colours"
        )
    lower, upper = np.full((MOST_PLANES, 3), np.inf), np.full((MOST_PLANES, 3), -np.inf)
    nearer = np.full(MOST_PLANES, np.inf)
    for k, plane in enumerate(planes):
        lower[k], upper[k] = -np.inf, np.inf
        if plane.select is not None:
            others = replace(plane.select, box=None)
            if plane.select.box is None or others != type(others)():
                raise InputError("a NeRF has no Gaussians", field="select", fix="give a box alone")
            lower[k], upper[k] = plane.select.box
        if plane.nearer is not None:
            nearer[k] = plane.nearer
    return WhiteSamples(lower, upper, nearer)


class NerfWeightFrame(NerfFrame):
    """A NeRF's frame of weights. Shifts of colours change none.

    Args:
        scene, sampling, pose_set, device, workers: As `NerfFrame` takes them.
        pixels: [H, W] the rays that are read; nothing is said of others.

    Raises:
        InputError: See `white_samples`.
    """

    def __init__(
        self,
        scene: NerfScene,
        sampling: Sampling,
        pose_set: PoseBox,
        planes: Sequence[WeightPlane],
        pixels: np.ndarray,
        device: str = "cpu",
        workers: int = 1,
    ) -> None:
        white = white_samples(planes, sampling)
        # the poses alone, and black behind the last sample
        super().__init__(scene, replace(sampling, background=(0.0,) * 3), pose_set.geometry, device, workers)
        self.renderer = NerfRenderer(scene, self._recipe[1], device=device, white=white)
        self._recipe = (*self._recipe, None, white)
        self.bounds = NerfBounds(*self._recipe)
        # the brightest first, so that few of them may say enough
        rays, weights = np.flatnonzero(pixels), np.zeros(pixels.size)
        weights[rays] = self.render(self.box.middle, rays).max(axis=(1, 2, 3))
        self.rays = rays[np.argsort(-weights[rays], kind="stable")]
        self._dimensions = pose_set.box.dimensions

    def of_sample(self, values: np.ndarray, sample: SceneSample | None) -> np.ndarray:
        """See `ns_abstract.refine.protocol.WeightFrame`; 0 on rays that are not read."""
        tiles = np.zeros((self.tile_count, 1, 1, 3), np.float32)
        tiles[self.rays] = self.render(values[: self.box.dimensions], self.rays)
        return tiles

    def differentiable(self, values: torch.Tensor) -> torch.Tensor:
        """See `ns_abstract.refine.protocol.WeightFrame`."""
        return self.renderer.picture(self.camera, differentiable_pose(self.pose_set)(values[: self.box.dimensions]))

    def sets(
        self, box: ParameterBox, weigh: Callable[[], np.ndarray | None] | None = None, most: int | None = None
    ) -> RayCellBounds:
        """See `NerfFrame.sets`; rays that are not read have zeros."""
        plain = super().sets(box.without(COLOR_SHIFTS), weigh, most)
        assert plain.linear is not None
        d, more = self.box.dimensions, self._dimensions - self.box.dimensions
        linear = list(plain.linear)
        for k in (0, 2):
            linear[k] = np.concatenate([linear[k], np.zeros((*linear[k].shape[:-1], more), np.float32)], axis=-1)
        slopes = np.concatenate([plain.slopes[:d], np.zeros(more)])
        return replace(plain, linear=(linear[0], linear[1], linear[2], linear[3]), slopes=slopes)
