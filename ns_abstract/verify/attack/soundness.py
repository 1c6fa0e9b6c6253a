"""Renderers of a set of poses for `ns_abstract.verify.attack.falsify`."""

from __future__ import annotations

import numpy as np
import torch

from ns_abstract.geometry.box import Float64Array
from ns_abstract.geometry.differentiable_pose import differentiable_pose
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import tile_grid
from ns_abstract.methods.nerf.hsv import color_shift
from ns_abstract.methods.nerf.render import NerfRenderer, Sampling, camera_rays
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.constants import Rasteriser
from ns_abstract.methods.splat.reference import Reference
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.verify.attack.falsify import DifferentiableRender, Render, RenderPixels


def compiled_renderer(scene: SplatScene, pose_set: PoseBox, rasteriser: Rasteriser) -> tuple[Render, RenderPixels]:
    """Return the compiled renderer of the set's camera, for `falsify`: whole images, and single pixels."""
    renderer = Renderer(activate(scene, rasteriser), rasteriser)
    camera, side = pose_set.camera, rasteriser.work_tile
    across, _ = tile_grid(camera, side)

    def render(values: Float64Array) -> Float64Array:
        return renderer.image(camera, *pose_set.world_to_camera(values))

    def probe(values: Float64Array, pixels: np.ndarray) -> Float64Array:
        rows, columns = pixels.T
        wanted, place = np.unique((rows // side) * across + columns // side, return_inverse=True)
        tiles = renderer.tiles(camera, *pose_set.world_to_camera(values), wanted)
        return tiles[place, rows % side, columns % side]

    return render, probe


def reference_renderer(
    scene: SplatScene, pose_set: PoseBox, rasteriser: Rasteriser, dtype: torch.dtype = torch.float64
) -> tuple[Render, RenderPixels, DifferentiableRender]:
    """Return the reference renderer of the set's camera, for `falsify`: images, single pixels, and the twin."""
    reference = Reference(scene, rasteriser, dtype)
    camera, pose = pose_set.camera, differentiable_pose(pose_set)

    def render(values: Float64Array) -> np.ndarray:
        with torch.no_grad():
            return reference.image(camera, torch.from_numpy(pose_set.pose(values))).numpy()

    def probe(values: Float64Array, pixels: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return reference.pixels(camera, torch.from_numpy(pose_set.pose(values)), torch.from_numpy(pixels)).numpy()

    def twin(values: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
        return reference.pixels(camera, pose(values), pixels)

    return render, probe, twin


def nerf_renderer(
    scene: NerfScene, pose_set: PoseBox, sampling: Sampling
) -> tuple[Render, RenderPixels, DifferentiableRender]:
    """Return the renderer of a NeRF at the set's camera, for `falsify`: images, single pixels, and the twin."""
    renderer = NerfRenderer(scene, sampling)
    camera, pose = pose_set.camera, differentiable_pose(pose_set)

    def render(values: Float64Array) -> Float64Array:
        return renderer.image(camera, pose_set.pose(values), color_shift(pose_set, values))

    def probe(values: Float64Array, pixels: np.ndarray) -> Float64Array:
        return renderer.pixels(camera, pose_set.pose(values), pixels, color_shift(pose_set, values))

    def twin(values: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
        rays = torch.from_numpy(camera_rays(camera, pixels.numpy()))
        return renderer.rays(pose(values), rays, color_shift(pose_set, values.unbind()))

    return render, probe, twin
